"""Truncated isothermal sphere: the subhaloes of a cluster."""

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, Float, Point, Scalar
from jaxlens.profiles._isothermal import arctan_ratio
from jaxlens.profiles._profile import as_float, register


class TSIS(eqx.Module):
    """Singular isothermal sphere cut at the (three-dimensional) radius r_t.

    With u = R/r_t, w = sqrt(1 - u^2) and theta_e^2 = 4 G M/(c^2 D_L) for the total mass M:
    psi = theta_e^2 [u arccos u - 2 w + ln(1 + w)] for u < 1, theta_e^2 ln u outside;
    kappa = theta_e^2 arccos(u)/(2 r_t^2 u) inside, 0 outside (Metcalf & Madau 2001).

    Attributes:
        theta_e: Einstein radius of the total mass as a point, D_LS/D_S = 1, shape `(*n)`, arcsec.
        r_t: truncation radius, `(*n)`, arcsec.
    """

    theta_e: Float[Array, "*n"] = eqx.field(converter=as_float)
    r_t: Float[Array, "*n"] = eqx.field(converter=as_float)


# Below this radius (arcsec) the direction of a point from the centre has no meaning in double precision.
_R_FLOOR = 1e-12


def _arccos(u: Array) -> Array:
    """arccos u = 2 atan sqrt[(1-u)/(1+u)] for 0 <= u < 1: vectorises where the library's does not."""
    w = (1.0 - u) / (1.0 + u)
    return 2.0 * jnp.sqrt(w) * arctan_ratio(w, halvings=2)


def _radius(p: TSIS, x: Point) -> tuple[Scalar, Scalar, Array]:
    """u, w (1 outside, so that nothing there is 0/0) and whether the point is inside."""
    u = jnp.sqrt(jnp.maximum(x[0] ** 2 + x[1] ** 2, _R_FLOOR**2)) / p.r_t
    inside = u < 1.0
    return u, jnp.sqrt(jnp.where(inside, 1.0 - u**2, 1.0)), inside


def potential(p: TSIS, x: Point) -> Scalar:
    """psi, arcsec^2; zero at the truncation radius."""
    u, w, inside = _radius(p, x)
    u_in = jnp.where(inside, u, 0.5)
    core = u_in * _arccos(u_in) - 2.0 * w + jnp.log1p(w)
    return p.theta_e**2 * jnp.where(inside, core, jnp.log(u))


def _mean_kappa(p: TSIS, u: Scalar, w: Scalar, inside: Array) -> Scalar:
    """alpha/R."""
    u_in = jnp.where(inside, u, 0.5)
    enclosed = jnp.where(inside, u * (_arccos(u_in) + u / (1.0 + w)), 1.0)
    return (p.theta_e / p.r_t) ** 2 * enclosed / u**2


def deflection(p: TSIS, x: Point) -> tuple[Scalar, Scalar]:
    """alpha = M_2D(R)/(pi Sigma_cr R), arcsec."""
    mean = _mean_kappa(p, *_radius(p, x))
    return mean * x[0], mean * x[1]


def field(p: TSIS, x: Point) -> tuple[Scalar, ...]:
    """Deflection [arcsec] and second derivatives (xx, xy, yy) of `potential`."""
    u, w, inside = _radius(p, x)
    mean = _mean_kappa(p, u, w, inside)
    # d alpha/dR: -theta_e^2/(r_t^2 (1 + w)) inside, -alpha/R outside.
    slope = jnp.where(inside, -((p.theta_e / p.r_t) ** 2) / (1.0 + w), -mean)
    stretch = (slope - mean) / (u * p.r_t) ** 2
    second = mean + stretch * x[0] ** 2, stretch * x[0] * x[1], mean + stretch * x[1] ** 2
    return mean * x[0], mean * x[1], *second


def kappa(p: TSIS, x: Point) -> Scalar:
    """The convergence, in closed form."""
    u, _, inside = _radius(p, x)
    u_in = jnp.where(inside, u, 0.5)
    return jnp.where(inside, 0.5 * (p.theta_e / p.r_t) ** 2 * _arccos(u_in) / u_in, 0.0)


register(
    TSIS,
    potential=potential,
    deflection=deflection,
    field=field,
    kappa=kappa,
    singular=True,
    example=lambda: TSIS(theta_e=2.0, r_t=15.0),
)
