"""A lens as a glafic input file."""

import math
from pathlib import Path
from typing import Any

from jaxlens.cosmology import LensPlane
from jaxlens.glafic._forms import (
    HUBBLE_MPC_H,
    MPC_METRE,
    NFW_B_NORM,
    NFW_RS_NORM,
    SCHWARZSCHILD_M,
    SIGMA_CRIT_NORM,
    contrast,
    degrees,
    hubble_distance,
)
from jaxlens.io import atomic
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, NFW, SIE, Hernquist, PointMass, Shear, Sheet, nfw, profile_of
from jaxlens.units import ARCSEC, C_KM_S

Row = tuple[str, list[float]]
"""A lens model and its eight parameters."""


def lens_rows(component: Component, plane: LensPlane, where: str) -> list[Row]:
    """One row for each profile of a component."""
    p: Any = component.params
    z_l, d_l = float(plane.z_l), float(hubble_distance(plane))
    z_fid = z_l + 1.0  # any redshift behind the lens will do: strengths are given for it
    ratio, delta = float(plane.dls_ds(z_fid)), float(contrast(plane))
    rows: list[Row] = []
    for k in range(len(component)):
        x, y = (float(v) for v in component.centre[k])
        pa = float(component.pa[k])
        e = getattr(p, "e", None)
        ellipse = [x, y, 0.0, 0.0] if e is None else [x, y, float(e[k]), degrees(pa)]
        if isinstance(p, NFW):
            kappa_s, r_s = float(p.kappa_s[k]), float(p.r_s[k])
            # With A = cbrt(M): r_s = a A/c, kappa_s = k A c^2/m(c), so c^3/m(c) = a kappa_s/(k r_s).
            a = NFW_RS_NORM / delta ** (1 / 3) / (d_l * HUBBLE_MPC_H * ARCSEC)
            amplitude = 0.25 * NFW_B_NORM * delta ** (2 / 3) * d_l
            c = nfw.concentration_of(a * kappa_s / (amplitude * r_s))
            rows.append(("anfw", [z_l, (r_s * c / a) ** 3, *ellipse, c, 0.0]))
        elif isinstance(p, Hernquist):
            r_s = float(p.r_s[k])
            area = 2.0 * math.pi * (r_s * ARCSEC * d_l * HUBBLE_MPC_H) ** 2
            rows.append(
                ("ahern", [z_l, float(p.kappa_s[k]) * area * SIGMA_CRIT_NORM / d_l, *ellipse, r_s, 0.0])
            )
        elif isinstance(p, DPIE):
            sigma = _sigma(float(p.b[k]), where)
            rows.append(("jaffe", [z_l, sigma, *ellipse, float(p.r_cut[k]), float(p.r_core[k])]))
        elif isinstance(p, SIE):
            rows.append(("sie", [z_l, _sigma(float(p.b[k]), where), *ellipse, float(p.r_core[k]), 0.0]))
        elif isinstance(p, PointMass):
            square = (float(p.theta_e[k]) * ARCSEC) ** 2
            mass = square * d_l * HUBBLE_MPC_H * MPC_METRE / (2.0 * SCHWARZSCHILD_M)
            rows.append(("point", [z_l, mass, x, y, 0.0, 0.0, 0.0, 0.0]))
        elif isinstance(p, Shear):
            gamma = float(p.gamma[k]) * ratio
            rows.append(("pert", [z_l, z_fid, x, y, gamma, math.degrees(pa), 0.0, 0.0]))
        elif isinstance(p, Sheet):
            rows.append(("pert", [z_l, z_fid, x, y, 0.0, 0.0, 0.0, float(p.kappa[k]) * ratio]))
        else:
            raise ValueError(
                f"{where} is a {profile_of(p).name}, for which glafic has no exact counterpart; it holds "
                "NFW, Hernquist, DPIE, SIE, PointMass, Shear and Sheet. Take it out, or replace it."
            )
    return rows


def _sigma(b: float, where: str) -> float:
    if b < 0.0:
        raise ValueError(f"{where} has the negative strength {b:g} arcsec, and so no velocity dispersion.")
    return C_KM_S * math.sqrt(b * ARCSEC / (4.0 * math.pi))


def head_lines(plane: LensPlane) -> list[str]:
    omega = float(plane.cosmology.omega_m)
    return [
        f"omega {omega!r}",
        f"lambda {1.0 - omega!r}",
        "weos -1.0",
        f"hubble {float(plane.cosmology.h)!r}",
    ]


def words_of(values: list[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def startup_lines(rows: list[Row], points: list[list[float]]) -> list[str]:
    return [
        f"startup {len(rows)} 0 {len(points)}",
        *(f"lens {kind} {words_of(values)}" for kind, values in rows),
        *(f"point {words_of(values)}" for values in points),
        "end_startup",
    ]


def save(path: Path, lines: list[str]) -> None:
    with atomic(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write(path: str | Path, lens: Lens, plane: LensPlane) -> None:
    """Write a lens as a glafic input file that reads back to 1e-12 in the deflection.

    Every profile becomes one `lens` (dPIEs are `jaffe`, shear and mass sheet are `pert` for a source at
    z_l + 1): glafic's galaxy file is in single precision and is not used.

    Args:
        path: the file; replaced in one step.
        lens: the lens.
        plane: its plane.

    Raises:
        ValueError: if glafic has no exact counterpart of a profile; the message names it.
    """
    rows = [
        row
        for name, component in lens.components.items()
        for row in lens_rows(component, plane, f"Component {name!r}")
    ]
    save(Path(path), [*head_lines(plane), "", *startup_lines(rows, []), "", "start_command", "quit"])
