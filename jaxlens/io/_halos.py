"""The lens of a table of potentials, as published models are distributed."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxlens.io._table import Rows, read_table
from jaxlens.lens import Component, Lens
from jaxlens.profiles import Shear, dpie


def read_lenstool_halos(path: str | Path) -> Lens:
    """The lens of a table of potentials in Lenstool's numbers.

    Columns `halo_id, profile, x_arcsec, y_arcsec, ellipticity, angle_deg, core_radius_arcsec,
    cut_radius_arcsec, v_disp_kms, gamma`. Profiles are `dPIE_81` (converted by
    `profiles.dpie.from_lenstool`) and `external_shear` (for D_LS/D_S = 1); pa = rad(angle_deg) for both.

    Returns:
        Components `halo` (dPIEs named O1, O2, ..., as Lenstool numbers the potentials that are fitted one by
        one), `shear`, and `members` (all other dPIEs), each where there are any.

    Raises:
        ValueError: if a cell cannot be used or a profile is unknown.
    """
    numbers = ("ellipticity", "angle_deg", "core_radius_arcsec", "cut_radius_arcsec", "v_disp_kms", "gamma")
    needed = {"dPIE_81": numbers[:5], "external_shear": ("angle_deg", "gamma")}
    rows = read_table(
        path,
        ("halo_id", "profile", "x_arcsec", "y_arcsec", *numbers),
        text=("halo_id", "profile"),
        empty=numbers,
    )
    kind = rows["profile"]
    rows.require(
        "profile", np.isin(kind, list(needed)), f"is not a known profile; use one of {', '.join(needed)}."
    )
    for profile, names in needed.items():
        for name in names:
            rows.require(
                name,
                np.isfinite(rows[name]) | (kind != profile),
                f"is missing for the profile {profile}; fill it in.",
            )
    named = np.array([one[:1] == "O" and one[1:].isdigit() for one in rows["halo_id"].tolist()])
    is_dpie = kind == "dPIE_81"
    rows.require(
        "cut_radius_arcsec",
        ~(is_dpie & ~(rows["cut_radius_arcsec"] > rows["core_radius_arcsec"])),
        "is not larger than the core radius; a dPIE needs core < cut.",
    )
    components = {
        "halo": _dpies(rows, is_dpie & named),
        "shear": _shears(rows, kind == "external_shear"),
        "members": _dpies(rows, is_dpie & ~named),
    }
    return Lens({name: one for name, one in components.items() if one is not None})


def _centre_and_angle(rows: Rows, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    centre = np.stack([rows["x_arcsec"][which], rows["y_arcsec"][which]], axis=1)
    return centre, np.deg2rad(rows["angle_deg"][which])


def _dpies(rows: Rows, which: np.ndarray) -> Component | None:
    if not which.any():
        return None
    sigma, core, cut, ellipticity = (
        jnp.asarray(rows[name][which])
        for name in ("v_disp_kms", "core_radius_arcsec", "cut_radius_arcsec", "ellipticity")
    )
    return Component(
        dpie.from_lenstool(sigma, core, cut, ellipticity=ellipticity), *_centre_and_angle(rows, which)
    )


def _shears(rows: Rows, which: np.ndarray) -> Component | None:
    if not which.any():
        return None
    return Component(Shear(gamma=jnp.asarray(rows["gamma"][which])), *_centre_and_angle(rows, which))
