"""Elliptical NFW halo as a sum of 44 cored steep ellipsoids."""

import math

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, ArrayLike, Float, Point, Scalar
from jaxlens.cosmology import LensPlane, overdensity
from jaxlens.profiles import _cse
from jaxlens.profiles._profile import as_float, register
from jaxlens.units import ARCSEC


class NFW(eqx.Module):
    """Navarro, Frenk & White halo with elliptical convergence, kappa = 2 kappa_s F(xi/r_s).

    F(u) = (1 - arccosh(1/u)/sqrt(1-u^2))/(u^2-1) and xi^2 = q x^2 + y^2/q. The tabulated sum gives
    kappa to 3.8e-5 and the deflection to 4.6e-6 for 1e-4 < xi/r_s < 1e3 (Oguri 2021, Table 1).

    Attributes:
        kappa_s: rho_s r_s / Sigma_cr for D_LS/D_S = 1, shape `(*n)`, dimensionless.
        r_s: scale radius, `(*n)`, arcsec.
        e: ellipticity 1 - b/a of the convergence, `(*n)`.
    """

    kappa_s: Float[Array, "*n"] = eqx.field(converter=as_float)
    r_s: Float[Array, "*n"] = eqx.field(converter=as_float)
    e: Float[Array, "*n"] = eqx.field(converter=as_float, default=0.0)


def from_mass(
    mass: ArrayLike,
    concentration: ArrayLike,
    plane: LensPlane,
    *,
    e: ArrayLike = 0.0,
    definition: str | float = "bryan_norman",
) -> NFW:
    """The NFW of a mass M = (4 pi/3) r_Delta^3 Delta rho_crit(z) and c = r_Delta/r_s.

    Args:
        mass: M_Delta, `(*n)`, Msun (no h).
        concentration: r_Delta/r_s, `(*n)`.
        plane: the lens plane.
        e: ellipticity 1 - b/a, broadcast against `mass`.
        definition: overdensity relative to critical: `"bryan_norman"`, `"nakamura_suto"` or a number.

    Returns:
        NFW with arrays of the broadcast shape of the arguments.
    """
    mass, c, e = jnp.broadcast_arrays(as_float(mass), as_float(concentration), as_float(e))
    rho = overdensity(definition, plane.cosmology, plane.z_l) * plane.cosmology.critical_density(plane.z_l)
    r_delta = jnp.cbrt(3.0 * mass / (4.0 * jnp.pi * rho))  # Mpc
    r_s = r_delta / c
    rho_s_r_s = mass / (4.0 * jnp.pi * r_s**2 * (jnp.log1p(c) - c / (1.0 + c)))  # Msun/Mpc^2
    return NFW(kappa_s=rho_s_r_s / plane.sigma_cr_inf, r_s=r_s / (plane.d_l * ARCSEC), e=e)


def concentration_of(ratio: float) -> float:
    """The concentration c at which c^3/[ln(1+c) - c/(1+c)] equals `ratio` (> 0); to rounding.

    It turns kappa_s and r_s back into a mass and a concentration. On the host, not differentiable.
    """
    if not ratio > 0.0:
        raise ValueError(f"`ratio` is {ratio}; an NFW with kappa_s > 0 and r_s > 0 has a positive one.")

    def excess(log_c: float) -> tuple[float, float]:
        c = math.exp(log_c)
        # ln(1+c) - c/(1+c) loses its digits for small c: c^2/2 - 2 c^3/3 + 3 c^4/4.
        m = math.log1p(c) - c / (1.0 + c) if c > 1e-3 else c**2 * (0.5 - c * (2.0 / 3.0 - 0.75 * c))
        return 3.0 * log_c - math.log(m) - math.log(ratio), 3.0 - c**2 / ((1.0 + c) ** 2 * m)

    log_c = math.log(ratio)
    for _ in range(60):
        value, slope = excess(log_c)
        log_c -= value / slope
        if abs(value) < 1e-15:
            break
    return math.exp(log_c)


def convergence_shape(u: Scalar) -> Scalar:
    """F(u) = kappa/(2 kappa_s) of the NFW (Bartelmann 1996; Wright & Brainerd 2000); F(1) = 1/3.

    A series about u = 1 replaces the quotient where it is 0/0. Differentiable for u > 0.
    """
    d = u - 1.0
    near = jnp.abs(d) < 3e-3
    # Taylor series of F about u = 1; the next term is below 2e-16 for |d| < 3e-3.
    series = 1 / 3 + d * (-2 / 5 + d * (13 / 35 + d * (-20 / 63 + d * (61 / 231 - d * 94 / 429))))
    inside = u < 1.0
    low = jnp.where(near | ~inside, 0.5, u)
    high = jnp.where(near | inside, 2.0, u)
    below = (jnp.arccosh(1.0 / low) / jnp.sqrt(1.0 - low**2) - 1.0) / (1.0 - low**2)
    above = (1.0 - jnp.arccos(1.0 / high) / jnp.sqrt(high**2 - 1.0)) / (high**2 - 1.0)
    return jnp.where(near, series, jnp.where(inside, below, above))


def potential(p: NFW, x: Point) -> Scalar:
    """psi = 4 kappa_s times the CSE sum, arcsec^2."""
    return 4.0 * p.kappa_s * _cse.potential("nfw", p.r_s, p.e, x)


def deflection(p: NFW, x: Point) -> tuple[Scalar, Scalar]:
    """Gradient of `potential`, arcsec."""
    a_x, a_y = _cse.deflection("nfw", p.r_s, p.e, x)
    return 4.0 * p.kappa_s * a_x, 4.0 * p.kappa_s * a_y


def field(p: NFW, x: Point) -> tuple[Scalar, ...]:
    """Deflection [arcsec] and second derivatives (xx, xy, yy) of `potential`."""
    return tuple(4.0 * p.kappa_s * v for v in _cse.field("nfw", p.r_s, p.e, x))


def kappa(p: NFW, x: Point) -> Scalar:
    """The exact convergence 2 kappa_s F(xi/r_s)."""
    q = 1.0 - p.e
    return 2.0 * p.kappa_s * convergence_shape(jnp.sqrt(q * x[0] ** 2 + x[1] ** 2 / q) / p.r_s)


register(
    NFW,
    potential=potential,
    deflection=deflection,
    field=field,
    kappa=kappa,
    strength="kappa_s",
    example=lambda: NFW(kappa_s=0.3, r_s=40.0, e=0.3),
)
