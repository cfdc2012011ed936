"""Elliptical Hernquist galaxy as a sum of 41 cored steep ellipsoids."""

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, ArrayLike, Float, Point, Scalar
from jaxlens.cosmology import LensPlane
from jaxlens.profiles import _cse
from jaxlens.profiles._profile import as_float, register
from jaxlens.units import ARCSEC


class Hernquist(eqx.Module):
    """Hernquist (1990) galaxy with elliptical convergence.

    kappa = kappa_s [(2 + u^2) G(u) - 3]/(u^2 - 1)^2, u = xi/r_s, xi^2 = q x^2 + y^2/q,
    G(u) = arccosh(1/u)/sqrt(1-u^2). The tabulated sum gives kappa to 2.4e-5 and the deflection to
    3.3e-6 for 1e-4 < u < 1e3 (Oguri 2021, Table 2).

    Attributes:
        kappa_s: M/(2 pi r_s^2 Sigma_cr) for D_LS/D_S = 1, shape `(*n)`, dimensionless.
        r_s: scale radius, `(*n)`, arcsec.
        e: ellipticity 1 - b/a of the convergence, `(*n)`.
    """

    kappa_s: Float[Array, "*n"] = eqx.field(converter=as_float)
    r_s: Float[Array, "*n"] = eqx.field(converter=as_float)
    e: Float[Array, "*n"] = eqx.field(converter=as_float, default=0.0)


def from_mass(mass: ArrayLike, r_s: ArrayLike, plane: LensPlane, *, e: ArrayLike = 0.0) -> Hernquist:
    """The Hernquist galaxy of a total mass, kappa_s = M/(2 pi r_s^2 Sigma_cr_inf).

    Args:
        mass: total mass, `(*n)`, Msun (no h).
        r_s: scale radius, `(*n)`, arcsec.
        plane: the lens plane.
        e: ellipticity 1 - b/a, broadcast against `mass`.
    """
    mass, r_s, e = jnp.broadcast_arrays(as_float(mass), as_float(r_s), as_float(e))
    area = 2.0 * jnp.pi * (r_s * ARCSEC * plane.d_l) ** 2  # Mpc^2
    return Hernquist(kappa_s=mass / area / plane.sigma_cr_inf, r_s=r_s, e=e)


def convergence_shape(u: Scalar) -> Scalar:
    """kappa/kappa_s of the Hernquist profile (Keeton 2001, eq. 48); 4/15 at u = 1.

    A series about u = 1 replaces the quotient where it is 0/0. Differentiable for u > 0.
    """
    d = u - 1.0
    near = jnp.abs(d) < 1e-2
    # Taylor series about u = 1; the next term is below 4e-13 for |d| < 1e-2, where the quotient
    # itself has lost as many digits.
    series = 4 / 15 + d * (-16 / 35 + d * (8 / 15 + d * (-368 / 693 + d * (1468 / 3003 - d * 928 / 2145))))
    inside = u < 1.0
    low = jnp.where(near | ~inside, 0.5, u)
    high = jnp.where(near | inside, 2.0, u)
    below = jnp.arccosh(1.0 / low) / jnp.sqrt(1.0 - low**2)
    above = jnp.arccos(1.0 / high) / jnp.sqrt(high**2 - 1.0)
    safe = jnp.where(near, 0.5, u)
    quotient = ((2.0 + safe**2) * jnp.where(inside, below, above) - 3.0) / (safe**2 - 1.0) ** 2
    return jnp.where(near, series, quotient)


def potential(p: Hernquist, x: Point) -> Scalar:
    """psi = kappa_s times the CSE sum, arcsec^2."""
    return p.kappa_s * _cse.potential("hernquist", p.r_s, p.e, x)


def deflection(p: Hernquist, x: Point) -> tuple[Scalar, Scalar]:
    """Gradient of `potential`, arcsec."""
    a_x, a_y = _cse.deflection("hernquist", p.r_s, p.e, x)
    return p.kappa_s * a_x, p.kappa_s * a_y


def field(p: Hernquist, x: Point) -> tuple[Scalar, ...]:
    """Deflection [arcsec] and second derivatives (xx, xy, yy) of `potential`."""
    return tuple(p.kappa_s * v for v in _cse.field("hernquist", p.r_s, p.e, x))


def kappa(p: Hernquist, x: Point) -> Scalar:
    """The exact convergence."""
    q = 1.0 - p.e
    return p.kappa_s * convergence_shape(jnp.sqrt(q * x[0] ** 2 + x[1] ** 2 / q) / p.r_s)


register(
    Hernquist,
    potential=potential,
    deflection=deflection,
    field=field,
    kappa=kappa,
    strength="kappa_s",
    example=lambda: Hernquist(kappa_s=2.5, r_s=4.0, e=0.3),
)
