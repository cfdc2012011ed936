"""One cored steep ellipsoid (CSE): sums of them make any convergence that depends on xi alone."""

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, Float, Point, Scalar
from jaxlens.profiles._profile import as_float, register


class CSE(eqx.Module):
    """kappa = kappa_0 (1 + xi^2/r_s^2)^(-3/2), xi^2 = q x^2 + y^2/q (Oguri 2021, eqs. 16-19).

    With X, Y in units of t = r_s/sqrt(q), P^2 = q^2 (1 + X^2) + Y^2, D = X^2 + Y^2 + 2 P + 1 + q^2:
    psi = t^2 kappa_0 q ln[D/(1 + q)^2], zero at the centre.

    Attributes:
        kappa_0: convergence at the centre for D_LS/D_S = 1, shape `(*n)`; negative in most sums.
        r_s: core radius, `(*n)`, arcsec.
        e: ellipticity 1 - b/a of the convergence, `(*n)`.
    """

    kappa_0: Float[Array, "*n"] = eqx.field(converter=as_float)
    r_s: Float[Array, "*n"] = eqx.field(converter=as_float)
    e: Float[Array, "*n"] = eqx.field(converter=as_float, default=0.0)


def _parts(p: CSE, point: Point) -> tuple[Array, ...]:
    """q, t, X, Y, P and D."""
    q = 1.0 - p.e
    t = p.r_s / jnp.sqrt(q)
    x, y = point[0] / t, point[1] / t
    root = jnp.sqrt(q**2 * (1.0 + x**2) + y**2)
    return q, t, x, y, root, x**2 + y**2 + 2.0 * root + 1.0 + q**2


def potential(p: CSE, x: Point) -> Scalar:
    """psi, arcsec^2; zero at the centre."""
    q, t, _, _, _, d = _parts(p, x)
    return p.kappa_0 * t**2 * q * jnp.log(d / (1.0 + q) ** 2)


def deflection(p: CSE, x: Point) -> tuple[Scalar, Scalar]:
    """Gradient of `potential`, arcsec."""
    q, t, x_t, y_t, root, d = _parts(p, x)
    scale = 2.0 * p.kappa_0 * q * t / (root * d)
    return scale * x_t * (root + q**2), scale * y_t * (root + 1.0)


def kappa(p: CSE, x: Point) -> Scalar:
    """The convergence, in closed form."""
    q = 1.0 - p.e
    return p.kappa_0 * (1.0 + (q * x[0] ** 2 + x[1] ** 2 / q) / p.r_s**2) ** -1.5


register(
    CSE,
    potential=potential,
    deflection=deflection,
    kappa=kappa,
    strength="kappa_0",
    example=lambda: CSE(kappa_0=0.4, r_s=12.0, e=0.3),
)
