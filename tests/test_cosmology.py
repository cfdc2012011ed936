"""Distances and lensing geometry against astropy, lenstronomy and finite differences."""

# astropy makes its constants and cosmologies at run time, where the type checker does not see them.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy import constants
from astropy import units as u
from astropy.cosmology import FlatLambdaCDM
from numpy.testing import assert_allclose
from support import differences, table

from jaxlens import cosmology as cosmo
from jaxlens.cosmology import FlatLCDM, LensPlane, bryan_norman, nakamura_suto, redshift_of_dls_ds
from jaxlens.profiles import dpie, nfw


# A function, for a module of tests makes no JAX array at import either.
def redshifts() -> jax.Array:
    return jnp.geomspace(0.01, 20.0, 40)


# lenstronomy's constants: GM_sun is 2.8e-4 and the megaparsec 5e-10 away from the IAU's.
GM_SUN_RATIO = 6.67384e-11 * 1.9891e30 / 1.3271244e20


def astropy_of(universe: FlatLCDM) -> FlatLambdaCDM:
    # Tcmb0 = 0: without radiation, as here.
    return FlatLambdaCDM(H0=100.0 * float(universe.h), Om0=float(universe.omega_m), Tcmb0=0.0)


@pytest.mark.parametrize(("h", "omega_m"), [(0.7, 0.3), (0.674, 0.315), (1.0, 0.1), (0.5, 0.9)])
def test_distances_equal_astropy(h: float, omega_m: float):
    universe = FlatLCDM(h=h, omega_m=omega_m)
    reference = astropy_of(universe)
    # astropy integrates to about 1e-13 (elliptic integrals); 48 nodes are good to 1e-14.
    z = redshifts()
    assert_allclose(
        universe.comoving_distance(z), reference.comoving_distance(np.asarray(z)).value, rtol=1e-10
    )
    plane = LensPlane(universe, 0.3)
    behind = z[z > 0.3]
    d_ls = reference.angular_diameter_distance(0.3, np.asarray(behind)).value
    d_s = reference.angular_diameter_distance(np.asarray(behind)).value
    assert_allclose(plane.dls_ds(behind), d_ls / d_s, rtol=1e-10)
    assert_allclose(plane.d_l, reference.angular_diameter_distance(0.3).value, rtol=1e-10)
    assert_allclose(plane.kpc_per_arcsec, 1.0 / reference.arcsec_per_kpc_proper(0.3).value, rtol=1e-10)


def test_critical_densities_equal_astropy():
    universe = FlatLCDM(h=0.7, omega_m=0.3)
    reference = astropy_of(universe)
    # GM_sun/M_sun for G on both sides: astropy's critical density uses CODATA's G and a mass of the Sun
    # from the same G, so the kilogram cancels and 1e-9 holds.
    expected = reference.critical_density(0.3).to_value("Msun/Mpc3")
    assert_allclose(universe.critical_density(0.3), expected, rtol=1e-9)
    assert_allclose(universe.omega_m_at(0.3), reference.Om(0.3), rtol=1e-13)


def test_sigma_cr_and_time_delay_from_astropy_constants():
    plane = LensPlane.at(0.3)
    reference = astropy_of(plane.cosmology)
    d_l, d_s = (reference.angular_diameter_distance(z) for z in (0.3, 2.0))
    d_ls = reference.angular_diameter_distance(0.3, 2.0)
    sigma_cr = constants.c**2 / (4 * np.pi * constants.G) * d_s / (d_l * d_ls)
    # Limited by G M_sun of the two sources of constants (equal by definition), hence 1e-9.
    assert_allclose(plane.sigma_cr(2.0), sigma_cr.to_value("Msun/Mpc2"), rtol=1e-9)
    assert_allclose(plane.sigma_cr_inf, float(plane.sigma_cr(2.0) * plane.dls_ds(2.0)), rtol=1e-14)
    delay = 1.3 / constants.c * d_l * d_s / d_ls * u.arcsec.to(u.rad) ** 2
    assert_allclose(plane.time_delay_scale(2.0), delay.to_value("day"), rtol=1e-10)


def test_no_lensing_of_sources_in_front():
    plane = LensPlane.at(0.3)
    assert_allclose(plane.dls_ds(jnp.array([0.0, 0.2, 0.3])), 0.0, atol=1e-15)
    assert np.isinf(plane.sigma_cr(0.2))
    slope = jax.grad(lambda z: plane.dls_ds(z))(0.0)
    assert slope == 0.0


def test_virial_overdensities():
    universe = FlatLCDM(h=0.7, omega_m=0.3)
    # Values quoted for z = 0.3, Omega_m = 0.3 (glafic prints 123.390 x critical), to their digits.
    assert_allclose(bryan_norman(universe, 0.3), 125.07, atol=5e-3)
    assert_allclose(nakamura_suto(universe, 0.3), 123.39009071855702, rtol=1e-12)
    # Bryan & Norman by hand: 18 pi^2 at Omega_m(z) = 1.
    assert_allclose(bryan_norman(FlatLCDM(h=0.7, omega_m=1.0), 0.3), 18 * np.pi**2, rtol=1e-14)


def test_overdensity_by_name_or_number():
    universe = FlatLCDM(h=0.7, omega_m=0.3)
    assert cosmo.overdensity(200.0, universe, 0.3) == 200.0
    assert cosmo.overdensity("bryan_norman", universe, 0.3) == bryan_norman(universe, 0.3)
    with pytest.raises(ValueError, match="choose one of"):
        cosmo.overdensity("virial", universe, 0.3)


def test_lenstronomy_distances_and_conversions():
    ref = table("lenstronomy/cosmology.csv")
    plane, z_s = LensPlane.at(0.3), jnp.asarray(ref["z_source"])
    # lenstronomy takes its distances from astropy.
    assert_allclose(plane.d_l, ref["D_d_Mpc"][0], rtol=1e-10)
    assert_allclose(plane.dls_ds(z_s), ref["D_ds_Mpc"] / ref["D_s_Mpc"], rtol=1e-10)
    assert_allclose(plane.dls_ds(z_s) / plane.dls_ds(2.0), ref["eta_vs_z2"], rtol=1e-10)
    # After the ratio of the constants what is left is the megaparsec, 5e-10.
    assert_allclose(plane.sigma_cr(z_s), ref["Sigma_cr_Msun_Mpc2"] * GM_SUN_RATIO, rtol=2e-9)

    halo = nfw.from_mass(1e15 / 0.7, 4.0, plane, definition=200.0)
    # Its critical density uses astropy's constants (hence r_s agrees as it is), its Sigma_cr its own.
    assert_allclose(halo.r_s, ref["nfw_M200c_1e15_over_0.7_c4_Rs_arcsec"][0], rtol=1e-9)
    at_r_s = 4.0 * halo.kappa_s * halo.r_s * (1.0 - np.log(2.0)) * plane.dls_ds(z_s)
    assert_allclose(at_r_s, ref["same_alpha_Rs_arcsec"] / GM_SUN_RATIO, rtol=2e-9)

    # Its sigma is the one of b = 4 pi (sigma/c)^2; kappa = sigma_0 Ra Rs/(Rs - Ra) [1/sqrt(..) - 1/sqrt(..)].
    galaxy = dpie.from_sigma_v(200.0, 0.05, 12.0)
    sigma_0 = galaxy.b * plane.dls_ds(z_s) * (12.0 - 0.05) / (2.0 * 0.05 * 12.0)
    assert_allclose(sigma_0, ref["dpie_sigma_200kms_Ra0.05_Rs12_sigma0"], rtol=1e-9)


def geometry(x: jax.Array) -> jax.Array:
    """Everything a lens model takes from (h, omega_m, z_l, z_s), each number of order one."""
    h, omega_m, z_l, z_s = x
    plane = LensPlane(FlatLCDM(h, omega_m), z_l)
    universe = plane.cosmology
    return jnp.stack(
        [
            plane.d_l / 1e3,
            plane.dls_ds(z_s),
            plane.sigma_cr(z_s) / 1e15,
            plane.time_delay_scale(z_s) / 40.0,
            bryan_norman(universe, z_l) / 100.0,
            nakamura_suto(universe, z_l) / 100.0,
            universe.critical_density(z_l) / 1e11,
        ]
    )


@pytest.mark.parametrize("x", [(0.7, 0.3, 0.35, 2.0), (0.65, 0.25, 0.54, 9.0)])
def test_gradients_equal_finite_differences(x: tuple[float, ...]):
    at = jnp.array(x)
    expected = differences(jax.jit(geometry), at, 1e-3).T
    # Fourth-order differences with a step of 1e-3: truncation and rounding are both below 1e-9.
    assert_allclose(jax.jit(jax.jacfwd(geometry))(at), expected, rtol=1e-8, atol=1e-9)
    assert_allclose(jax.jit(jax.jacrev(geometry))(at), expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("z_l", [0.1, 0.3475, 0.9])
def test_redshift_of_dls_ds_inverts(z_l: float):
    plane = LensPlane.at(z_l)
    for z_s in (z_l + 0.02, 1.5, 6.0, 20.0):
        # 60 halvings of ln(1 + z) < 7 reach rounding; d(ratio)/dz is smallest at z = 20, hence 1e-10.
        assert_allclose(redshift_of_dls_ds(plane, plane.dls_ds(z_s)), z_s, rtol=1e-10)
