"""Elliptical dual pseudo-isothermal profile (dPIE, truncated PIEMD)."""

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, ArrayLike, Float, Point, Scalar
from jaxlens.profiles import _isothermal
from jaxlens.profiles._profile import as_float, register
from jaxlens.units import ARCSEC, C_KM_S


class DPIE(eqx.Module):
    """Difference of two cored isothermal ellipsoids, cores r_core and r_cut.

    kappa = (b/2) [1/sqrt(r_core^2 + xi^2) - 1/sqrt(r_cut^2 + xi^2)], xi^2 = q x^2 + y^2/q
    (Kassiola & Kovner 1993; Eliasdottir et al. 2007). A mass profile for r_core < r_cut.

    Attributes:
        b: 4 pi (sigma_v/c)^2 for D_LS/D_S = 1, shape `(*n)`, arcsec.
        r_core: core radius, `(*n)`, arcsec; floored at 1e-10.
        r_cut: truncation radius, `(*n)`, arcsec.
        e: ellipticity 1 - b/a of the convergence, `(*n)`.
    """

    b: Float[Array, "*n"] = eqx.field(converter=as_float)
    r_core: Float[Array, "*n"] = eqx.field(converter=as_float)
    r_cut: Float[Array, "*n"] = eqx.field(converter=as_float)
    e: Float[Array, "*n"] = eqx.field(converter=as_float, default=0.0)


def strength(sigma_v: ArrayLike) -> Array:
    """b = 4 pi (sigma_v/c)^2 in arcsec, of a velocity dispersion in km/s."""
    return 4.0 * jnp.pi * (as_float(sigma_v) / C_KM_S) ** 2 / ARCSEC


def from_sigma_v(
    sigma_v: ArrayLike,
    r_core: ArrayLike,
    r_cut: ArrayLike,
    *,
    e: ArrayLike = 0.0,
) -> DPIE:
    """The dPIE with b = 4 pi (sigma_v/c)^2.

    Args:
        sigma_v: velocity dispersion, `(*n)`, km/s.
        r_core, r_cut: radii, `(*n)`, arcsec.
        e: ellipticity 1 - b/a, `(*n)`.
    """
    return DPIE(*jnp.broadcast_arrays(strength(sigma_v), as_float(r_core), as_float(r_cut), as_float(e)))


def axis_ratio(ellipticity: ArrayLike) -> Array:
    """q = b/a of the mass with (a^2-b^2)/(a^2+b^2) = `ellipticity`; in (0, 1]."""
    ellipticity = as_float(ellipticity)
    return jnp.sqrt((1.0 - ellipticity) / (1.0 + ellipticity))


def from_lenstool(
    sigma_lt: ArrayLike,
    r_core: ArrayLike,
    r_cut: ArrayLike,
    *,
    ellipticity: ArrayLike = 0.0,
) -> DPIE:
    """The dPIE of Lenstool's numbers (profile 81).

    With q the axis ratio, eps = (1-q)/(1+q) and f = sqrt(1 - eps^2): r_core = f core,
    r_cut = f cut, b = f 6 pi (sigma_lt/c)^2 cut/(cut - core) (Eliasdottir et al. 2007; the factor f
    turns the radius x^2/(1+eps)^2 + y^2/(1-eps)^2 into the area-preserving one).

    Args:
        sigma_lt: fiducial velocity dispersion, `(*n)`, km/s.
        r_core, r_cut: core and cut radii, `(*n)`, arcsec.
        ellipticity: (a^2-b^2)/(a^2+b^2) of the mass, `(*n)`.
    """
    sigma_lt, core, cut, ell = jnp.broadcast_arrays(
        as_float(sigma_lt), as_float(r_core), as_float(r_cut), as_float(ellipticity)
    )
    q = axis_ratio(ell)
    f = 2.0 * jnp.sqrt(q) / (1.0 + q)
    return DPIE(
        b=1.5 * f * strength(sigma_lt) * cut / (cut - core), r_core=f * core, r_cut=f * cut, e=1.0 - q
    )


def _parts(p: DPIE, x: Point) -> tuple[_isothermal.Part, _isothermal.Part]:
    return _isothermal.part(p.b, p.r_core, p.e, x), _isothermal.part(p.b, p.r_cut, p.e, x)


def potential(p: DPIE, x: Point) -> Scalar:
    """psi, arcsec^2; zero at the centre."""
    core, cut = _parts(p, x)
    a_x, a_y = _isothermal.deflection_difference(core, cut)
    return x[0] * a_x + x[1] * a_y - _isothermal.log_term(core, x) + _isothermal.log_term(cut, x)


def deflection(p: DPIE, x: Point) -> tuple[Scalar, Scalar]:
    """Gradient of `potential`, arcsec."""
    return _isothermal.deflection_difference(*_parts(p, x))


def field(p: DPIE, x: Point) -> tuple[Scalar, ...]:
    """Deflection [arcsec] and second derivatives (xx, xy, yy) of `potential`."""
    core, cut = _parts(p, x)
    second = zip(_isothermal.hessian(core, x), _isothermal.hessian(cut, x), strict=True)
    return *_isothermal.deflection_difference(core, cut), *(a - b for a, b in second)


def kappa(p: DPIE, x: Point) -> Scalar:
    """The convergence, in closed form."""
    q = 1.0 - p.e
    xi2 = q * x[0] ** 2 + x[1] ** 2 / q
    return 0.5 * p.b * (1.0 / jnp.sqrt(p.r_core**2 + xi2) - 1.0 / jnp.sqrt(p.r_cut**2 + xi2))


register(
    DPIE,
    potential=potential,
    deflection=deflection,
    field=field,
    kappa=kappa,
    strength="b",
    example=lambda: DPIE(b=1.2, r_core=0.15, r_cut=12.0, e=0.25),
)
