"""Flat LCDM distances and the lensing geometry of one lens plane, differentiable in every number."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, Scalar, ScalarLike, Values
from jaxlens.units import ARCSEC, C2_4PIG, C_KM_S, DAY_S, G_MPC_KM2_S2_MSUN, MPC_M

# 48 nodes in ln(1+z) give 1e-14 relative for 0 < z < 20 (measured against 200 nodes).
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)


def _as_float(x: ScalarLike | Array) -> Array:
    return jnp.asarray(x, dtype=jnp.result_type(float))


class FlatLCDM(eqx.Module):
    """A flat universe of cold matter and a cosmological constant (no radiation).

    Attributes:
        h: Hubble constant in units of 100 km/s/Mpc, shape `()`.
        omega_m: matter density parameter today, shape `()`.
    """

    h: Scalar = eqx.field(converter=_as_float)
    omega_m: Scalar = eqx.field(converter=_as_float)

    def efunc2(self, z: ScalarLike | Values) -> Array:
        """E(z)^2 = Omega_m (1+z)^3 + 1 - Omega_m, dimensionless, shape of `z`."""
        return self.omega_m * (1.0 + jnp.asarray(z)) ** 3 + 1.0 - self.omega_m

    def omega_m_at(self, z: ScalarLike | Values) -> Array:
        """Matter density parameter at redshift `z`, shape of `z`."""
        return self.omega_m * (1.0 + jnp.asarray(z)) ** 3 / self.efunc2(z)

    def critical_density(self, z: ScalarLike | Values) -> Array:
        """rho_crit(z) = 3 H(z)^2 / (8 pi G), Msun/Mpc^3, shape of `z`."""
        return 3.0 * (100.0 * self.h) ** 2 * self.efunc2(z) / (8.0 * jnp.pi * G_MPC_KM2_S2_MSUN)

    def comoving_distance(self, z: ScalarLike | Values) -> Array:
        """Line-of-sight comoving distance, c/H0 int dz/E(z), by Gauss-Legendre in ln(1+z).

        Args:
            z: redshift, any shape.

        Returns:
            Distance in Mpc, shape of `z`.
        """
        return _comoving_distance(self, _as_float(z))

    def angular_diameter_distance(self, z: ScalarLike | Values) -> Array:
        """D_A(z) = D_C/(1+z), Mpc, shape of `z`."""
        return self.comoving_distance(z) / (1.0 + jnp.asarray(z))


# One program each: a plane that is made outside of any other would compile dozens of small ones.
@jax.jit
def _comoving_distance(cosmology: FlatLCDM, z: Array) -> Array:
    log_1z = jnp.log1p(z)
    u = jnp.multiply.outer(0.5 * log_1z, 1.0 + jnp.asarray(_NODES, log_1z.dtype))
    integrand = jnp.exp(u) / jnp.sqrt(cosmology.efunc2(jnp.expm1(u)))
    weights = jnp.asarray(_WEIGHTS, log_1z.dtype)
    integral = 0.5 * log_1z * jnp.dot(integrand, weights, precision="highest")
    return C_KM_S / (100.0 * cosmology.h) * integral


def bryan_norman(cosmology: FlatLCDM, z: ScalarLike) -> Array:
    """Virial overdensity relative to the critical density, 18 pi^2 + 82 x - 39 x^2, x = Omega_m(z) - 1.

    Bryan & Norman 1998, eq. 6 (flat universe); 125.07 at z = 0.3 for Omega_m = 0.3.
    """
    x = cosmology.omega_m_at(z) - 1.0
    return 18.0 * jnp.pi**2 + 82.0 * x - 39.0 * x**2


def nakamura_suto(cosmology: FlatLCDM, z: ScalarLike) -> Array:
    """Virial overdensity relative to the critical density, as glafic uses it.

    177.6528 [1 + 0.40929 w^0.90524] times the mean density, w = 1/Omega_m(z) - 1
    (Nakamura & Suto 1997, coefficients quoted from secondary sources, not checked against the
    original); 123.390 at z = 0.3 for Omega_m = 0.3.
    """
    omega = cosmology.omega_m_at(z)
    w = 1.0 / omega - 1.0
    return 177.6528 * (1.0 + 0.40929 * w**0.90524) * omega


OVERDENSITIES = {"bryan_norman": bryan_norman, "nakamura_suto": nakamura_suto}


def overdensity(definition: str | float, cosmology: FlatLCDM, z: ScalarLike) -> Array:
    """Overdensity relative to the critical density at `z`.

    Args:
        definition: a key of `OVERDENSITIES`, or the number itself (200 for M_200c).
        cosmology: the universe.
        z: redshift of the halo.

    Raises:
        ValueError: if the name is unknown.
    """
    if isinstance(definition, str):
        if definition not in OVERDENSITIES:
            raise ValueError(
                f"`overdensity` is {definition!r}; choose one of {sorted(OVERDENSITIES)} "
                "or give a number such as 200.0."
            )
        return OVERDENSITIES[definition](cosmology, z)
    return _as_float(definition)


class LensPlane(eqx.Module):
    """A lens redshift in a cosmology. Distances are derived, never stored.

    Attributes:
        cosmology: the universe.
        z_l: lens redshift, shape `()`.
    """

    cosmology: FlatLCDM
    z_l: Scalar = eqx.field(converter=_as_float)

    @classmethod
    def at(cls, z_l: ScalarLike, cosmology: FlatLCDM | None = None) -> "LensPlane":
        """The lens plane at redshift `z_l`; without `cosmology`, h = 0.7 and Omega_m = 0.3."""
        return cls(FlatLCDM(h=0.7, omega_m=0.3) if cosmology is None else cosmology, z_l)

    @property
    def d_l(self) -> Scalar:
        """Angular-diameter distance to the lens, Mpc."""
        return self.cosmology.angular_diameter_distance(self.z_l)

    @property
    def kpc_per_arcsec(self) -> Scalar:
        """Physical (proper) kpc per arcsec at the lens."""
        return self.d_l * ARCSEC * 1e3

    @property
    def sigma_cr_inf(self) -> Scalar:
        """Critical surface density for D_LS/D_S = 1, c^2/(4 pi G D_L), Msun/Mpc^2."""
        return C2_4PIG / self.d_l

    def dls_ds(self, z_s: ScalarLike | Values) -> Array:
        """Distance ratio D_LS/D_S of a source at `z_s`, shape of `z_s`; 0 for z_s <= z_l."""
        return _dls_ds(self, _as_float(z_s))

    def sigma_cr(self, z_s: ScalarLike | Values) -> Array:
        """Critical surface density for a source at `z_s`, Msun/Mpc^2; infinite for z_s <= z_l."""
        return self.sigma_cr_inf / self.dls_ds(z_s)

    def time_delay_scale(self, z_s: ScalarLike | Values) -> Array:
        """Days per arcsec^2 of Fermat potential, (1+z_l)/c D_L D_S/D_LS, shape of `z_s`."""
        mpc_day = MPC_M / (C_KM_S * 1e3) / DAY_S
        return (1.0 + self.z_l) * self.d_l * mpc_day * ARCSEC**2 / self.dls_ds(z_s)


@jax.jit
def _dls_ds(plane: LensPlane, z_s: Array) -> Array:
    d_l, d_s = (plane.cosmology.comoving_distance(z) for z in (plane.z_l, z_s))
    behind = z_s > plane.z_l
    # The inner where keeps the gradient finite at z_s = 0.
    return jnp.where(behind, 1.0 - d_l / jnp.where(behind, d_s, 1.0), 0.0)


def redshift_of_dls_ds(plane: LensPlane, dls_ds: ScalarLike) -> Array:
    """Source redshift at which D_LS/D_S has the given value, by bisection in ln(1+z).

    Args:
        plane: the lens plane.
        dls_ds: distance ratio in (0, 1), scalar.

    Returns:
        Redshift between z_l and 1000, scalar. Differentiable by the implicit function theorem.
    """
    target = jax.lax.stop_gradient(_as_float(dls_ds))
    still = jax.lax.stop_gradient(plane)

    def halve(bounds: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        lo, hi = bounds
        mid = 0.5 * (lo + hi)
        below = still.dls_ds(jnp.expm1(mid)) < target
        return (jnp.where(below, mid, lo), jnp.where(below, hi, mid)), None

    start = (jnp.log1p(still.z_l), jnp.log1p(_as_float(1000.0)))
    (lo, hi), _ = jax.lax.scan(halve, start, None, length=60)
    z = jnp.expm1(0.5 * (lo + hi))
    # A last Newton step with a frozen slope carries the derivative.
    slope = jax.lax.stop_gradient(jax.grad(lambda v: still.dls_ds(v))(z))
    return z + (dls_ds - plane.dls_ds(z)) / slope
