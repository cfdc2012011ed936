"""From the numbers of a simulated cluster to profiles of the engine."""

import math

import numpy as np

from jaxlens import profiles
from jaxlens.lens import Component, Lens
from jaxlens.simulate import _triaxial
from jaxlens.simulate._settings import ClusterSettings
from jaxlens.simulate._truth import ClumpTruth, Place
from jaxlens.units import ARCSEC, C2_4PIG


def lens_of(
    clumps: list[ClumpTruth], subhaloes: dict[str, np.ndarray], settings: ClusterSettings, place: Place
) -> Lens:
    """The lens of what was drawn, for D_LS/D_S = 1; components without members are left out."""
    centre = np.array([[c.x_arcsec, c.y_arcsec] for c in clumps])
    pa = np.array([c.pa_rad for c in clumps])
    components = {"halo": _halo(clumps, centre, pa, place)}

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


def _halo(clumps: list[ClumpTruth], centre: np.ndarray, pa: np.ndarray, place: Place) -> Component:
    """The smooth haloes: NFW with the whole halo's scale radius and the smooth mass."""
    numbers = []
    for c in clumps:
        density = c.rho_s_msun_mpc3 * c.smooth_mass_msun / c.mass_msun
        shape = _triaxial.Projection(c.f, c.q, c.pa_rad)
        numbers.append(
            _triaxial.flattened(density * c.r_s_mpc / place.sigma_cr, c.r_s_mpc / place.mpc_per_arcsec, shape)
        )
    kappa_s, r_s = np.array(numbers).T
    return Component(
        profiles.NFW(kappa_s=kappa_s, r_s=r_s, e=1.0 - np.array([c.q for c in clumps])), centre=centre, pa=pa
    )
