"""External shear."""

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, Float, Point, Scalar
from jaxlens.profiles._profile import as_float, register


class Shear(eqx.Module):
    """Constant shear; its direction is the position angle of the component.

    In the sky frame psi = gamma/2 [(x^2 - y^2) cos 2 pa + 2 x y sin 2 pa] about the centre.

    Attributes:
        gamma: shear for D_LS/D_S = 1, shape `(*n)`, dimensionless.
    """

    gamma: Float[Array, "*n"] = eqx.field(converter=as_float)


def potential(p: Shear, x: Point) -> Scalar:
    """psi = gamma (x^2 - y^2)/2, arcsec^2."""
    return 0.5 * p.gamma * (x[0] ** 2 - x[1] ** 2)


def kappa(p: Shear, x: Point) -> Scalar:
    """Zero."""
    return jnp.zeros_like(x[0]) * p.gamma


register(Shear, potential=potential, kappa=kappa, strength="gamma", example=lambda: Shear(gamma=0.08))
