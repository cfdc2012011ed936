"""Projected masses and Einstein radii of lenses."""

import jax
import jax.numpy as jnp

from jaxlens import lens as _lens
from jaxlens._types import Array, ScalarLike, Values
from jaxlens.cosmology import LensPlane
from jaxlens.lens import Lens
from jaxlens.profiles._profile import as_float
from jaxlens.units import ARCSEC

N_ANGLES = 512
"""Points of a circle on which a flux is integrated."""

_STEP = 1e-4
# Relative step of the slope in `einstein_radius`: its error, 1e-8, is that of the derivative.


def _centred(centre: tuple[ScalarLike, ScalarLike]) -> Array:
    return jnp.stack([as_float(part) for part in centre])


def mean_kappa(
    lens: Lens,
    radius: Values,
    *,
    centre: tuple[ScalarLike, ScalarLike] = (0.0, 0.0),
    n_angles: int = N_ANGLES,
) -> Values:
    """Mean convergence inside circles, for D_LS/D_S = 1, by Gauss's theorem.

    <kappa>(<R) = (1/(2 pi R)) times the integral of alpha . n over the angle, exact for any mass inside,
    singular or not. The sum over equal angles converges exponentially; with 512 angles the error is below
    1e-6 unless a member sits on the circle itself (then 1e-3 of its own mass).

    Args:
        lens: the lens.
        radius: radii R > 0, `(...)`, arcsec.
        centre: of the circles, arcsec.
        n_angles: points of a circle.
    """
    phi = 2.0 * jnp.pi * jnp.arange(n_angles) / n_angles
    normal = jnp.stack([jnp.cos(phi), jnp.sin(phi)], axis=-1)
    r = as_float(radius)
    shape = (*r.shape, n_angles, 2)
    unit = jnp.broadcast_to(normal, shape)
    theta = jnp.broadcast_to(_centred(centre), shape) + r[..., None, None] * unit
    flux = jnp.sum(_lens.alpha(lens, theta) * unit, axis=-1)
    return jnp.mean(flux, axis=-1) / r


def mass_within(
    lens: Lens,
    plane: LensPlane,
    radius: Values,
    *,
    centre: tuple[ScalarLike, ScalarLike] = (0.0, 0.0),
    n_angles: int = N_ANGLES,
) -> Values:
    """Projected mass M(<R) = pi R^2 <kappa> Sigma_cr, Msun.

    Args:
        lens: the lens.
        plane: its plane.
        radius: radii, `(...)`, arcsec; divide kpc by `plane.kpc_per_arcsec`.
        centre: of the circles, arcsec.
        n_angles: points of a circle, see `mean_kappa`.
    """
    r = as_float(radius)
    area = jnp.pi * (r * ARCSEC * plane.d_l) ** 2
    return area * plane.sigma_cr_inf * mean_kappa(lens, r, centre=centre, n_angles=n_angles)


@jax.jit
def einstein_radius(
    lens: Lens,
    dls_ds: ScalarLike,
    *,
    centre: tuple[ScalarLike, ScalarLike] = (0.0, 0.0),
    largest: ScalarLike = 200.0,
) -> Array:
    """Radius inside which the mean convergence of a source plane is 1, arcsec, `()`.

    By bisection between 1e-3 and `largest`, in which the mean convergence should fall; 0 when it is
    below 1 throughout, NaN when it is above 1 at `largest`. Differentiable in the lens and `dls_ds` by the
    implicit function theorem; the derivative of a radius that does not exist is 0.
    `jaxlens.critical.einstein_radius` is the other definition, by the area of the critical curve.
    """
    still = jax.lax.stop_gradient((lens, as_float(dls_ds), _centred(centre)))

    def excess(lens: Lens, ratio: Array, middle: Array, r: Array) -> Array:
        return ratio * mean_kappa(lens, r, centre=(middle[0], middle[1])) - 1.0

    def halve(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        lo, hi = ends
        mid = 0.5 * (lo + hi)
        inside = excess(*still, mid) > 0.0
        return (jnp.where(inside, mid, lo), jnp.where(inside, hi, mid)), None

    start = (as_float(1e-3), as_float(largest))
    lo, hi = jax.lax.scan(halve, start, None, length=50)[0]
    r = jax.lax.stop_gradient(0.5 * (lo + hi))
    # One evaluation for the last step, its slope (central difference) and both ends of the bracket.
    radii = jnp.stack([r, (1.0 + _STEP) * r, (1.0 - _STEP) * r, *start])
    found = excess(lens, as_float(dls_ds), _centred(centre), radii)
    slope = jax.lax.stop_gradient((found[1] - found[2]) / (2.0 * _STEP * r))
    exists = (found[3] > 0.0) & (found[4] <= 0.0)
    # A last Newton step with a frozen slope carries the derivative.
    step = jnp.where(exists, found[0], 0.0) / jnp.where(exists, slope, 1.0)
    return jnp.where(exists, r - step, jnp.where(found[3] > 0.0, jnp.nan, 0.0))
