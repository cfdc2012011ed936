"""Point mass."""

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, ArrayLike, Float, Point, Scalar
from jaxlens.cosmology import LensPlane
from jaxlens.profiles._profile import as_float, register
from jaxlens.units import ARCSEC


class PointMass(eqx.Module):
    """A point mass, psi = theta_e^2 ln(r / 1 arcsec).

    Attributes:
        theta_e: Einstein radius for D_LS/D_S = 1, shape `(*n)`, arcsec.
    """

    theta_e: Float[Array, "*n"] = eqx.field(converter=as_float)


# Protects the logarithm and the division at the mass itself, arcsec^2.
_R2_FLOOR = 1e-24


def einstein_radius(mass: ArrayLike, plane: LensPlane) -> Array:
    """theta_e = sqrt(M/(pi Sigma_cr_inf))/D_L of a mass in Msun, for D_LS/D_S = 1, arcsec."""
    return jnp.sqrt(as_float(mass) / (jnp.pi * plane.sigma_cr_inf)) / (plane.d_l * ARCSEC)


def potential(p: PointMass, x: Point) -> Scalar:
    """psi = theta_e^2 ln r, arcsec^2, r in arcsec."""
    return 0.5 * p.theta_e**2 * jnp.log(jnp.maximum(x @ x, _R2_FLOOR))


def deflection(p: PointMass, x: Point) -> tuple[Scalar, Scalar]:
    """alpha = theta_e^2 x/r^2, arcsec."""
    mean = p.theta_e**2 / jnp.maximum(x @ x, _R2_FLOOR)
    return mean * x[0], mean * x[1]


def kappa(p: PointMass, x: Point) -> Scalar:
    """Zero everywhere but at the mass."""
    return jnp.zeros_like(x[0]) * p.theta_e


register(
    PointMass,
    potential=potential,
    deflection=deflection,
    kappa=kappa,
    singular=True,
    example=lambda: PointMass(theta_e=3.0),
)
