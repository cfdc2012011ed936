"""glafic's mass models in its own numbers and norms, as kinds of component of `strong.ClusterModel`."""

import math

import jax.numpy as jnp

from jaxlens import profiles
from jaxlens._types import Array
from jaxlens.cosmology import LensPlane, nakamura_suto
from jaxlens.profiles import dpie
from jaxlens.strong import Form, register_form
from jaxlens.units import ARCSEC, C_KM_S

# Numbers of glafic 2.1.15, in its units: masses Msun/h, distances c/H0, c/H0 in Mpc/h.
HUBBLE_MPC_H = C_KM_S / 100.0
NFW_RS_NORM = 9.510361e-05  # Mpc/h (Msun/h)^(-1/3)
NFW_B_NORM = 6.34482175e-08  # (Msun/h)^(-1/3)
SIGMA_CRIT_NORM = 5.5467248e14  # h Msun/Mpc^2, times D_s/(D_l D_ls) in c/H0
SCHWARZSCHILD_M = 2953.339382  # of the Sun
MPC_METRE = 3.085677581e22


def hubble_distance(plane: LensPlane) -> Array:
    """Distance to the lens in c/H0."""
    return plane.d_l * plane.cosmology.h / HUBBLE_MPC_H


def contrast(plane: LensPlane, overdensity: Array | None = None) -> Array:
    """Mean density inside the virial radius over today's critical density.

    Without `overdensity` (relative to critical at the lens), that of Nakamura & Suto.
    """
    delta = nakamura_suto(plane.cosmology, plane.z_l) if overdensity is None else overdensity
    return delta * plane.cosmology.efunc2(plane.z_l)


def anfw(
    plane: LensPlane, e: Array, mass_h: Array, concentration: Array, overdensity: Array | None = None
) -> profiles.NFW:
    """glafic's `anfw`: mass in Msun/h and concentration, virial or for an overdensity."""
    d_l, delta, c = hubble_distance(plane), contrast(plane, overdensity), concentration
    r_s = NFW_RS_NORM * jnp.cbrt(mass_h / delta) / c / (d_l * HUBBLE_MPC_H * ARCSEC)
    shape = c**2 / (jnp.log1p(c) - c / (1.0 + c))
    return profiles.NFW(kappa_s=0.25 * NFW_B_NORM * jnp.cbrt(mass_h * delta**2) * shape * d_l, r_s=r_s, e=e)


def ahern(plane: LensPlane, e: Array, mass_h: Array, r_b: Array) -> profiles.Hernquist:
    """glafic's `ahern`: total mass in Msun/h, scale radius in arcsec."""
    d_l = hubble_distance(plane)
    area = 2.0 * jnp.pi * (r_b * ARCSEC * d_l * HUBBLE_MPC_H) ** 2
    return profiles.Hernquist(kappa_s=mass_h / area * d_l / SIGMA_CRIT_NORM, r_s=r_b, e=e)


def point(plane: LensPlane, e: Array, mass_h: Array) -> profiles.PointMass:
    """glafic's `point`: mass in Msun/h; theta_e^2 = 2 r_Schwarzschild/D_l."""
    d_l = hubble_distance(plane) * HUBBLE_MPC_H  # Mpc/h
    return profiles.PointMass(theta_e=jnp.sqrt(2.0 * SCHWARZSCHILD_M / MPC_METRE * mass_h / d_l) / ARCSEC)


register_form("glafic_anfw", Form(("mass_vir_msun_h", "concentration"), anfw))
register_form("glafic_anfw_critical", Form(("mass_vir_msun_h", "concentration", "overdensity"), anfw))
register_form("glafic_ahern", Form(("mass_msun_h", "r_s_arcsec"), ahern))
register_form(
    "glafic_jaffe",
    Form(
        ("sigma_v_km_s", "r_cut_arcsec", "r_core_arcsec"),
        lambda plane, e, sigma, cut, core: dpie.from_sigma_v(sigma, core, cut, e=e),
    ),
)
register_form("glafic_point", Form(("mass_msun_h",), point, shape=None))
register_form(
    "glafic_shear",
    Form(("z_fid",), lambda plane, gamma, z: profiles.Shear(gamma=gamma / plane.dls_ds(z)), shape="gamma"),
)
register_form(
    "glafic_sheet",
    Form(
        ("kappa", "z_fid"),
        lambda plane, e, kappa, z: profiles.Sheet(kappa=kappa / plane.dls_ds(z)),
        shape=None,
    ),
)

KINDS = {
    "anfw": ("glafic_anfw", {2: "mass_vir_msun_h", 7: "concentration"}),
    "nfw": ("glafic_anfw", {2: "mass_vir_msun_h", 7: "concentration"}),
    "ahern": ("glafic_ahern", {2: "mass_msun_h", 7: "r_s_arcsec"}),
    "hern": ("glafic_ahern", {2: "mass_msun_h", 7: "r_s_arcsec"}),
    "jaffe": ("glafic_jaffe", {2: "sigma_v_km_s", 7: "r_cut_arcsec", 8: "r_core_arcsec"}),
    "sie": ("sie", {2: "sigma_v_km_s", 7: "r_core_arcsec"}),
    "point": ("glafic_point", {2: "mass_msun_h"}),
}
"""Lens models by name: kind of component and its numbers by their place. `nfw` and `hern` are the same mass
distributions as `anfw` and `ahern`; glafic integrates them numerically to 5e-4, here they are the sums."""

ELLIPSE = {3: "x_arcsec", 4: "y_arcsec", 5: "e", 6: "pa"}
"""Numbers that all of them share (a point has no shape)."""

GALAXIES = {2: "sigma_ref_km_s", 7: "r_cut_ref_arcsec"}
"""Numbers of `gals`."""

_CENTRE = {2: "z_fid", 3: "x_arcsec", 4: "y_arcsec"}
PERT = ({**_CENTRE, 5: "gamma", 6: "pa"}, {**_CENTRE, 8: "kappa"})
"""Numbers of the shear and of the mass sheet that `pert` stands for."""


def radians(degrees: float) -> float:
    """glafic's angle, from +y counter-clockwise, as ours, from +x."""
    return math.radians(degrees + 90.0)


def degrees(pa: float) -> float:
    """Our angle in rad as glafic's, in [-180, 180)."""
    return (math.degrees(pa) + 90.0) % 360.0 - 180.0
