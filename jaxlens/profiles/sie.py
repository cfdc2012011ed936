"""Singular or cored isothermal ellipsoid."""

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, Float, Point, Scalar
from jaxlens.profiles import _isothermal
from jaxlens.profiles._profile import as_float, register


class SIE(eqx.Module):
    """Isothermal ellipsoid, kappa = b/(2 sqrt(r_core^2 + xi^2)), xi^2 = q x^2 + y^2/q.

    Attributes:
        b: 4 pi (sigma_v/c)^2 for D_LS/D_S = 1, shape `(*n)`, arcsec.
        e: ellipticity 1 - b/a of the convergence, `(*n)`.
        r_core: core radius, `(*n)`, arcsec; floored at 1e-10. Without a core the centre is singular.
    """

    b: Float[Array, "*n"] = eqx.field(converter=as_float)
    e: Float[Array, "*n"] = eqx.field(converter=as_float, default=0.0)
    r_core: Float[Array, "*n"] = eqx.field(converter=as_float, default=0.0)


def potential(p: SIE, x: Point) -> Scalar:
    """psi, arcsec^2; zero at the centre."""
    part = _isothermal.part(p.b, p.r_core, p.e, x)
    a_x, a_y = _isothermal.deflection(part)
    return x[0] * a_x + x[1] * a_y - _isothermal.log_term(part, x)


def deflection(p: SIE, x: Point) -> tuple[Scalar, Scalar]:
    """Gradient of `potential`, arcsec."""
    return _isothermal.deflection(_isothermal.part(p.b, p.r_core, p.e, x))


def field(p: SIE, x: Point) -> tuple[Scalar, ...]:
    """Deflection [arcsec] and second derivatives (xx, xy, yy) of `potential`."""
    part = _isothermal.part(p.b, p.r_core, p.e, x)
    return *_isothermal.deflection(part), *_isothermal.hessian(part, x)


def kappa(p: SIE, x: Point) -> Scalar:
    """The convergence, in closed form."""
    q = 1.0 - p.e
    return 0.5 * p.b / jnp.sqrt(p.r_core**2 + q * x[0] ** 2 + x[1] ** 2 / q)


register(
    SIE,
    potential=potential,
    deflection=deflection,
    field=field,
    kappa=kappa,
    strength="b",
    singular=True,
    example=lambda: SIE(b=12.0, e=0.3),
)
