"""From a simulated field to what an observer has: tables, and the configurations that analyse them."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import config, config_simulate, config_weak
from jaxlens._config import ConfigError
from jaxlens.simulate import ClumpTruth, Mock, StrongMock, check

SIGMA_FIT = 0.15
"""Position error in the catalogue of images whose positions have none, arcsec."""

EDGES_ARCSEC = (20.0, 40.0, 60.0, 80.0, 110.0, 140.0, 180.0, 230.0)
"""Edges of the tangential profile in `weak.toml`; those inside the field are written (our choice)."""


def load(path: Path | None = None, seed: int | None = None) -> config_simulate.Simulate:
    """The configuration of a file, or the default one; with another seed if one is given.

    Raises:
        ConfigError: if the file cannot be read, or says something it may not, or what memory does not hold.
    """
    if path is None:
        said = config_simulate.Simulate()
    elif path.is_dir():
        said = config_simulate.read(path / "config.toml")
    else:
        said = config_simulate.read(path)
    said = said if seed is None else said.model_copy(update={"seed": seed})
    try:
        check(said.cluster, said.sources, said.settings.cosmology)
    except ValueError as error:
        raise ConfigError(f"{path or 'The default settings'}: {error}") from error
    return said


# --- tables -------------------------------------------------------------------------------------


def member_columns(mock: StrongMock) -> dict[str, np.ndarray]:
    """Columns of `members.ecsv`: central galaxies, then the satellites inside the field, brightest first.

    L/L_ref refers to the brightest satellite of the whole cluster, the paper's reference galaxy.
    """
    found, said = mock.cluster.subhaloes, mock.settings.cluster
    half = 30.0 * said.field_arcmin
    inside = (np.abs(found["x_arcsec"]) <= half) & (np.abs(found["y_arcsec"]) <= half)
    order = np.flatnonzero(inside)
    order = order[np.argsort(-found["luminosity_b"][order], kind="stable")]
    central = [one for one in mock.cluster.clumps if one.bcg_mass_msun > 0.0]
    stars = np.array([one.bcg_mass_msun for one in central])
    light = found["luminosity_b"]
    reference = light.max() if len(light) else (stars / said.mass_to_light).max(initial=1.0)
    join = lambda first, name: np.concatenate([np.asarray(first, float), found[name][order]])
    luminosity = join(stars / said.mass_to_light, "luminosity_b")
    names = [f"bcg{k + 1}" for k in range(len(central))] + [f"m{k + 1}" for k in range(len(order))]
    return {
        "member_id": np.array(names, dtype=str),
        "x_arcsec": join([one.x_arcsec for one in central], "x_arcsec"),
        "y_arcsec": join([one.y_arcsec for one in central], "y_arcsec"),
        "luminosity": luminosity / reference,
        "bcg": np.array([1] * len(central) + [0] * len(order)),
        "mass_msun": join(stars, "mass_msun"),
        "stellar_mass_msun": join(stars, "stellar_mass_msun"),
        "luminosity_b_lsun": luminosity,
    }


def source_columns(mock: StrongMock) -> dict[str, np.ndarray]:
    """Columns of `sources.ecsv`: every source, with its images and its system (0: none)."""
    sources, images, catalogue = mock.sources, mock.images, mock.catalogue
    n = len(sources)
    system = np.zeros(n, int)
    system[catalogue.source] = np.arange(catalogue.n_systems) + 1
    return {
        "source": np.arange(n) + 1,
        "x_arcsec": sources.beta[:, 0],
        "y_arcsec": sources.beta[:, 1],
        "z": sources.z,
        "dls_ds": sources.dls_ds,
        "mag_uv": sources.mag_uv,
        "mag": sources.mag,
        "n_images": np.bincount(images.source, minlength=n),
        "n_detected": np.bincount(images.source[images.mag < images.limit], minlength=n),
        "system": system,
    }


def image_columns(mock: StrongMock) -> dict[str, np.ndarray]:
    """Columns of `images.ecsv`: the catalogue that `jaxlens strong` fits, with the truth beside it."""
    catalogue, sources = mock.catalogue, mock.sources
    truth, system = catalogue.truth, catalogue.system
    first = np.searchsorted(system, system)
    number = np.arange(len(system)) - first + 1
    sigma = mock.settings.images.sigma_pos_arcsec or SIGMA_FIT
    return {
        "system": np.array([str(k + 1) for k in system], dtype=str),
        "image_id": np.array([f"{k + 1}.{i}" for k, i in zip(system, number, strict=True)], dtype=str),
        "x_arcsec": catalogue.theta[:, 0],
        "y_arcsec": catalogue.theta[:, 1],
        "sigma_arcsec": np.full(len(system), sigma),
        "z_spec": sources.z[truth.source],
        "mag": truth.mag,
        "mag_limit": truth.limit,
        "mu": truth.mu,
        "x_true_arcsec": truth.theta[:, 0],
        "y_true_arcsec": truth.theta[:, 1],
        "beta_x_arcsec": sources.beta[truth.source, 0],
        "beta_y_arcsec": sources.beta[truth.source, 1],
        "source": truth.source + 1,
    }


def galaxy_columns(mock: Mock) -> dict[str, np.ndarray]:
    """Columns of `galaxies.ecsv`, the catalogue that `jaxlens weak` maps; `use` is 0 in masked pixels."""
    found = mock.galaxies
    return {
        "x_arcsec": found.theta[:, 0],
        "y_arcsec": found.theta[:, 1],
        "e1": np.real(found.eps),
        "e2": np.imag(found.eps),
        "z_phot": found.z,
        "use": found.use.astype(int),
    }


# --- configurations -----------------------------------------------------------------------------


def _box(
    low: float, high: float, truth: float | None, *, log: bool = False, most: float = np.inf
) -> dict[str, Any]:
    """The paper's box; where a given truth lies outside, widened beyond it (our choice)."""
    truth = low if truth is None else truth
    low = low if truth >= low else float(f"{0.3 * truth:.1g}")
    high = high if truth <= high else float(f"{min(2.0 * truth, most):.1g}")
    return {"min": low, "max": high, **({"log": True} if log else {})}


def _halo(number: int, one: ClumpTruth, h: float, widen: bool) -> dict[str, Any]:
    known = lambda value: value if widen else None
    return {
        "name": f"halo{number}",
        "profile": "nfw",
        **_around(one),
        "e": _box(0.1, 0.7, known(1.0 - one.q), most=0.95),
        "pa_deg": "free",
        "mass_vir_msun_h": _box(1e14, 1e15, known(one.smooth_mass_msun * h), log=True),
        "concentration": _box(1.0, 6.0, known(one.concentration)),
    }


def _galaxy(number: int, one: ClumpTruth, h: float, e: float, widen: bool) -> dict[str, Any]:
    known = lambda value: value if widen else None
    return {
        "name": f"bcg{number}",
        "profile": "hernquist",
        **_around(one),
        "e": _box(0.1, 0.7, known(e), most=0.95),
        "pa_deg": "free",
        "mass_msun_h": _box(8e11, 8e12, known(one.bcg_mass_msun * h), log=True),
        "r_s_arcsec": _box(0.5, 40.0, known(one.bcg_r_s_arcsec), log=True),
    }


def _around(one: ClumpTruth) -> dict[str, Any]:
    """Within 5 arcsec of the observed central galaxy on each axis."""
    places = {"x_arcsec": round(one.x_arcsec, 1), "y_arcsec": round(one.y_arcsec, 1)}
    return {key: {"min": at - 5.0, "max": at + 5.0} for key, at in places.items()}


def strong_configuration(
    mock: StrongMock, said: config_simulate.Simulate, *, widen: bool = True
) -> dict[str, Any]:
    """`strong.toml`: the paper's model, for each clump an NFW halo and a Hernquist galaxy of 6 numbers each.

    Members are round dPIE profiles with sigma ~ L^0.25 and r_cut ~ L^0.5. The boxes are those stated in
    the paper; those of the Hernquist radius are our choice.

    Args:
        mock: the cluster with its images.
        said: the configuration of the simulation.
        widen: widen boxes of haloes and central galaxies that do not hold the truth, so that a fit can reach
            it. Those of the members stay: no dPIE scaling relation is the truth of the subhaloes. A test of
            the method that must not know the truth says False.

    Returns:
        The table, which `jaxlens.config.parse` accepts.
    """
    h, cluster = said.cosmology.h, mock.settings.cluster
    members: dict[str, Any] = {
        "file": "members.ecsv",
        "convention": "dpie",
        "shape": "round",
        "sigma_ref_km_s": {"min": 80.0, "max": 300.0},
        "r_cut_ref_arcsec": {"min": 1.0, "max": 50.0, "log": True},
    }
    if said.strong.members == "rectangle":
        members["within_images_arcsec"] = said.strong.padding_arcsec
    components = [_halo(k, one, h, widen) for k, one in enumerate(mock.cluster.clumps, start=1)]
    components += [
        _galaxy(k, one, h, 1.0 - cluster.bcg_axis_ratio, widen)
        for k, one in enumerate(mock.cluster.clumps, start=1)
        if one.bcg_mass_msun > 0.0
    ]
    table: dict[str, Any] = {
        "name": said.name,
        "z_l": cluster.z_l,
        "cosmology": said.cosmology.model_dump(),
        "images": {"file": "images.ecsv"},
        **({"members": members} if _has_members(mock, said) else {}),
        "component": components,
        "fit": {"starts": said.strong.starts, "plane": "source"},
    }
    config.parse(table, "strong.toml")
    return table


def _has_members(mock: StrongMock, said: config_simulate.Simulate) -> bool:
    columns, theta = member_columns(mock), mock.catalogue.theta
    place = np.stack([columns["x_arcsec"], columns["y_arcsec"]], axis=1)[columns["bcg"] == 0]
    if said.strong.members == "rectangle" and len(theta):
        margin = said.strong.padding_arcsec
        return bool(np.all((place >= theta.min(0) - margin) & (place <= theta.max(0) + margin), axis=1).any())
    return len(place) > 0


def weak_configuration(mock: Mock, said: config_simulate.Simulate) -> dict[str, Any]:
    """`weak.toml`: the galaxies on the pixels of the mock; a table that `config_weak.parse` accepts."""
    shear = mock.strong.settings.shear
    several = len(shear.bins) > 1
    table: dict[str, Any] = {
        "name": said.name,
        "z_l": mock.strong.settings.cluster.z_l,
        "cosmology": said.cosmology.model_dump(),
        "shear": {"file": "galaxies.ecsv", "axis": "west", "x_axis": "west"},
        # Every galaxy lies behind the lens, however close.
        "select": {"z_margin": 0.0},
        "depth": {"z_s": shear.bins[0].z_s, "per_galaxy": several},
        "map": {
            "pixel_arcsec": shear.grid.pixel,
            "sigma_arcsec": said.weak.sigma_pixels * shear.grid.pixel,
            "side_arcsec": shear.field_arcsec,
        },
        "profile": {
            "edges_arcsec": _edges(0.5 * shear.field_arcsec),
            "overdensity": "bryan_norman",
        },
    }
    config_weak.parse(table, "weak.toml")
    return table


def _edges(half: float) -> list[float]:
    inside = [edge for edge in EDGES_ARCSEC if edge <= half]
    return inside if len(inside) > 2 else [round(half * part, 3) for part in (0.1, 0.3, 0.6, 1.0)]
