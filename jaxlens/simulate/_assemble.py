"""From the numbers of a simulated cluster to profiles of the engine."""

import math

import numpy as np

from jaxlens import profiles
from jaxlens.lens import Component, Lens
from jaxlens.simulate import _contraction, _expansion, _triaxial
from jaxlens.simulate._settings import ClusterSettings
from jaxlens.simulate._truth import ClumpTruth, Place
from jaxlens.units import ARCSEC, C2_4PIG


def lens_of(
    clumps: list[ClumpTruth], subhaloes: dict[str, np.ndarray], settings: ClusterSettings, place: Place
) -> Lens:
    """The lens of what was drawn, for D_LS/D_S = 1; components without members are left out."""
    centre = np.array([[c.x_arcsec, c.y_arcsec] for c in clumps])
    pa = np.array([c.pa_rad for c in clumps])
    components = {"halo": _halo(clumps, settings, place)}

    bcg_mass, bcg_r_s = (
        np.array([getattr(c, n) for c in clumps]) for n in ("bcg_mass_msun", "bcg_r_s_arcsec")
    )
    if (has := bcg_mass > 0.0).any():
        area = 2.0 * math.pi * (bcg_r_s * place.mpc_per_arcsec) ** 2
        galaxy = profiles.Hernquist(
            kappa_s=(bcg_mass / area / place.sigma_cr)[has], r_s=bcg_r_s[has], e=1.0 - settings.bcg_axis_ratio
        )
        components["bcg"] = Component(galaxy, centre=centre[has], pa=pa[has])

    if len(subhaloes["mass_msun"]):
        d_l = place.mpc_per_arcsec / ARCSEC
        spheres = profiles.TSIS(
            # 4 G M/(c^2 D_L), in radian^2.
            theta_e=np.sqrt(subhaloes["mass_msun"] / (math.pi * C2_4PIG * d_l)) / ARCSEC,
            r_t=1e-3 * subhaloes["r_t_kpc"] / place.mpc_per_arcsec,
        )
        at = np.stack([subhaloes["x_arcsec"], subhaloes["y_arcsec"]], axis=1)
        components["subhaloes"] = Component(spheres, centre=at)
    return Lens(components)


def _halo(clumps: list[ClumpTruth], settings: ClusterSettings, place: Place) -> Component:
    """The smooth haloes, with the scale radius of the whole halo and the smooth mass.

    NFW profiles; or, when they are cut or contracted, the terms of `_expansion.expand`, all in one component.
    """
    parts = []
    for c in clumps:
        density = c.rho_s_msun_mpc3 * c.smooth_mass_msun / c.mass_msun
        shape = _triaxial.Projection(c.f, c.q, c.pa_rad)
        kappa_s, r_s = _triaxial.flattened(
            density * c.r_s_mpc / place.sigma_cr, c.r_s_mpc / place.mpc_per_arcsec, shape
        )
        cores, values = np.ones(1), np.ones(1)
        if _expands(settings):
            cores, values = _terms(c, settings, place)
            values = 2.0 * values
        each = np.ones_like(cores)
        parts.append(
            [
                kappa_s * values,
                r_s * cores,
                (1.0 - c.q) * each,
                c.x_arcsec * each,
                c.y_arcsec * each,
                c.pa_rad * each,
            ]
        )
    strength, r_s, e, x, y, pa = np.concatenate(parts, axis=1)
    params = profiles.CSE(strength, r_s, e) if _expands(settings) else profiles.NFW(strength, r_s, e)
    return Component(params, centre=np.stack([x, y], axis=1), pa=pa)


def _expands(settings: ClusterSettings) -> bool:
    return settings.contraction or settings.los_cut == "rvir"


def _terms(c: ClumpTruth, settings: ClusterSettings, place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Cores (in units of r_s) and strengths of the terms of a cut or contracted halo."""
    density = _expansion.nfw
    if settings.contraction and c.bcg_mass_msun > 0.0:
        r_g = c.bcg_r_s_arcsec * place.mpc_per_arcsec / c.r_s_mpc
        density = _contraction.contracted(c.concentration, c.bcg_mass_msun / c.mass_msun, r_g)
    edge = c.concentration if settings.los_cut == "rvir" else None
    return _expansion.expand(density, edge)[:2]
