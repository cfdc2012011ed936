"""Lenstool's potentials in its own numbers, as kinds of component of `strong.ClusterModel`."""

import jax.numpy as jnp

from jaxlens import profiles
from jaxlens._types import Array
from jaxlens.cosmology import LensPlane
from jaxlens.profiles import dpie
from jaxlens.strong import Form, register_form
from jaxlens.units import ARCSEC


def piemd(plane: LensPlane, ellipticity: Array, sigma_lt: Array, core: Array) -> profiles.SIE:
    """profil 8, the dPIE without a cut radius: b = f 6 pi (sigma/c)^2, r_core = f core.

    f = 2 sqrt(q)/(1 + q) makes the elliptical radius area-preserving, as for the dPIE. The factor 6 pi is
    quoted from secondary sources, not checked against the original.
    """
    q = dpie.axis_ratio(ellipticity)
    f = 2.0 * jnp.sqrt(q) / (1.0 + q)
    return profiles.SIE(b=1.5 * f * dpie.strength(sigma_lt), e=1.0 - q, r_core=f * core)


def nfw(plane: LensPlane, e: Array, r_s: Array, concentration: Array) -> profiles.NFW:
    """profil 12, round: rho_s = (200/3) rho_crit(z_l) c^3/[ln(1+c) - c/(1+c)], scale radius in arcsec."""
    c = concentration
    delta = 200.0 / 3.0 * c**3 / (jnp.log1p(c) - c / (1.0 + c))
    rho_s = delta * plane.cosmology.critical_density(plane.z_l)
    return profiles.NFW(kappa_s=rho_s * r_s * ARCSEC * plane.d_l / plane.sigma_cr_inf, r_s=r_s, e=e)


register_form("lenstool_piemd", Form(("sigma_lt_km_s", "r_core_arcsec"), piemd, shape="ellipticity"))
register_form("lenstool_nfw", Form(("r_s_arcsec", "concentration"), nfw, shape=None))
register_form(
    "lenstool_sis",
    Form(
        ("sigma_v_km_s",),
        lambda plane, e, sigma: profiles.SIE(b=dpie.strength(sigma), e=e, r_core=0.0 * sigma),
        shape=None,
    ),
)

_CENTRE = {"x_centre": "x_arcsec", "y_centre": "y_arcsec"}
_ELLIPSE = {**_CENTRE, "ellipticite": "ellipticity", "angle_pos": "pa"}

PROFILES: dict[int, tuple[str, dict[str, str]]] = {
    81: (
        "dpie_lenstool",
        {
            **_ELLIPSE,
            "core_radius": "r_core_arcsec",
            "cut_radius": "r_cut_arcsec",
            "v_disp": "sigma_lt_km_s",
        },
    ),
    8: ("lenstool_piemd", {**_ELLIPSE, "core_radius": "r_core_arcsec", "v_disp": "sigma_lt_km_s"}),
    12: ("lenstool_nfw", {**_CENTRE, "scale_radius": "r_s_arcsec", "concentration": "concentration"}),
    1: ("lenstool_sis", {**_CENTRE, "v_disp": "sigma_v_km_s"}),
    14: ("shear", {"gamma": "gamma", "angle_pos": "pa"}),
}
"""By the number of `profil`: kind of component, and the names of its numbers here by their keys there.

Profiles 1 and 12 put the ellipticity into the potential, so that only round ones have a counterpart."""

ROUND = (1, 12)
"""Profiles that are read only with ellipticite 0."""

LENGTHS = ("core_radius", "cut_radius", "scale_radius")
"""Keys that also exist in kpc, with the ending `_kpc`, which then wins."""
