"""Lenses: stacked profiles on the sky, and what they do to light.

A lens knows no source redshift. psi, alpha, kappa and gamma are for D_LS/D_S = 1; functions that
need a source take its distance ratio `dls_ds`. Functions accept any leading shape of positions,
`theta (..., 2)`, are differentiable in all their float arguments, and keep the memory of large maps
bounded by working through tiles of positions: `WIDE` ones for values, `TILE` ones for derivatives.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxlens._component import Component, sum_of
from jaxlens._types import Array, Hessian, Points, ScalarLike, Spin2, Values
from jaxlens.cosmology import LensPlane
from jaxlens.profiles._profile import as_float

TILE = 1024
"""Positions whose derivatives are worked on at a time: there are as many of each as members times numbers."""
WIDE = 65536
"""Positions whose values are worked on at a time where there are more than half as many: enough of them for
XLA to share among cores. Fewer stay in a core's cache, `TILE` at a time (both measured)."""


class Lens(eqx.Module):
    """A sum of components by name, e.g. `halo`, `bcg`, `members`.

    Attributes:
        components: the components; names carry no meaning.
    """

    components: dict[str, Component]

    def __init__(self, components: Mapping[str, Component] | None = None, **more: Component):
        self.components = {**(components or {}), **more}
        if not self.components:
            raise ValueError("A lens needs at least one component.")


def _tile(kind: str, lens: Lens, points: Array) -> tuple[Array, ...]:
    """Sum over components at positions `(i, 2)`: a tuple of `(i,)`."""
    sums = [sum_of(kind, component, points) for component in lens.components.values()]
    return tuple(jax.tree.reduce(jnp.add, list(parts)) for parts in zip(*sums, strict=True))


def _by_tiles(kind: str, lens: Lens, points: Array) -> tuple[Array, ...]:
    """`_tile` at a multiple of `TILE` positions, one tile after the other."""
    # Reverse mode evaluates a tile again instead of keeping the partial derivatives of all of them.
    parts = jax.lax.map(jax.checkpoint(partial(_tile, kind, lens)), points.reshape(-1, TILE, 2))
    return tuple(part.ravel() for part in parts)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _wide(kind: str, lens: Lens, points: Array) -> tuple[Array, ...]:
    """`_by_tiles` with the values of all positions at once."""
    return _tile(kind, lens, points)


@partial(_wide.defjvp, symbolic_zeros=True)
def _wide_jvp(kind: str, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    """What does not vary is no argument of what is differentiated: `sum_of` asks for that."""
    varies = jax.tree.map(lambda tangent: not isinstance(tangent, SymbolicZero), tangents)
    varying, still = eqx.partition(primals, varies)
    narrow = lambda varying: _by_tiles(kind, *eqx.combine(varying, still))
    return jax.jvp(narrow, (varying,), (eqx.filter(tangents, varies),))


def _evaluate(kind: str, lens: Lens, theta: Array) -> tuple[Array, ...]:
    """Sum over components at `theta (..., 2)`: a tuple of `(...)`, tile by tile."""
    theta = as_float(theta)
    if theta.shape[-1:] != (2,):
        raise ValueError(f"`theta` has shape {theta.shape}; its last axis must be (theta_1, theta_2).")
    # One type for all: a scan over members cannot change that of its sum on the way.
    theta = theta.astype(jnp.result_type(theta, *jax.tree.leaves(lens)))
    shape, flat = theta.shape[:-1], theta.reshape(-1, 2)
    count = flat.shape[0]
    if count <= TILE:
        parts = _tile(kind, lens, flat)
    else:
        # As few wide tiles as can be, all of one size, the last one filled up.
        tiles = -(-count // WIDE)
        size = -(-count // (tiles * TILE)) * TILE
        padded = jnp.pad(flat, ((0, tiles * size - count), (0, 0)), mode="edge")
        if count <= WIDE // 2:
            parts = _by_tiles(kind, lens, padded)
        else:
            parts = jax.lax.map(partial(_wide, kind, lens), padded.reshape(tiles, size, 2))
        parts = tuple(part.reshape(-1)[:count] for part in parts)
    return tuple(part.reshape(shape) for part in parts)


# --- the lens ----------------------------------------------------------------------------------


def psi(lens: Lens, theta: Points) -> Values:
    """Lens potential for D_LS/D_S = 1.

    Args:
        lens: the lens.
        theta: positions, `(..., 2)`, arcsec.

    Returns:
        psi, `(...)`, arcsec^2.
    """
    return _evaluate("potential", lens, theta)[0]


def alpha(lens: Lens, theta: Points) -> Points:
    """Deflection grad psi for D_LS/D_S = 1, `(..., 2)`, arcsec, at `theta (..., 2)`, arcsec."""
    return jnp.stack(_evaluate("deflection", lens, theta), axis=-1)


def alpha_and_hessian(lens: Lens, theta: Points) -> tuple[Points, Hessian]:
    """Deflection `(..., 2)` [arcsec] and Hessian of psi `(..., 2, 2)`, both for D_LS/D_S = 1.

    Cheaper than the two apart. `theta` is `(..., 2)`, arcsec.
    """
    a_x, a_y, xx, xy, yy = _evaluate("field", lens, theta)
    hessian = jnp.stack([jnp.stack([xx, xy], axis=-1), jnp.stack([xy, yy], axis=-1)], axis=-2)
    return jnp.stack([a_x, a_y], axis=-1), hessian


def kappa_and_gamma(lens: Lens, theta: Points) -> tuple[Values, Spin2]:
    """Convergence and complex shear for D_LS/D_S = 1, each `(...)`, at `theta (..., 2)`, arcsec."""
    _, _, xx, xy, yy = _evaluate("field", lens, theta)
    return 0.5 * (xx + yy), 0.5 * (xx - yy) + 1j * xy


def kappa(lens: Lens, theta: Points) -> Values:
    """Convergence (psi_11 + psi_22)/2 for D_LS/D_S = 1, `(...)`, at `theta (..., 2)`, arcsec."""
    return kappa_and_gamma(lens, theta)[0]


def gamma(lens: Lens, theta: Points) -> Spin2:
    """Complex shear (psi_11 - psi_22)/2 + i psi_12 for D_LS/D_S = 1, `(...)`, at `theta (..., 2)`, arcsec."""
    return kappa_and_gamma(lens, theta)[1]


def _per_point(dls_ds: ScalarLike | Array, extra: int) -> Array:
    ratio = as_float(dls_ds)
    return ratio.reshape(ratio.shape + (1,) * extra) if ratio.ndim else ratio


def ray_trace(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Points:
    """Source positions beta = theta - (D_LS/D_S) alpha(theta).

    Args:
        lens: the lens.
        theta: image positions, `(..., 2)`, arcsec.
        dls_ds: distance ratio of the source, scalar or `(...)`.

    Returns:
        beta, `(..., 2)`, arcsec.
    """
    return as_float(theta) - _per_point(dls_ds, 1) * alpha(lens, theta)


def source_and_jacobian(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> tuple[Points, Hessian]:
    """beta `(..., 2)` [arcsec] and A = d beta/d theta `(..., 2, 2)` in one evaluation; see `ray_trace`."""
    deflection, hessian = alpha_and_hessian(lens, theta)
    beta = as_float(theta) - _per_point(dls_ds, 1) * deflection
    identity = jnp.broadcast_to(jnp.eye(2, dtype=hessian.dtype), hessian.shape)
    return beta, identity - _per_point(dls_ds, 2) * hessian


def jacobian(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Hessian:
    """A = d beta/d theta, `(..., 2, 2)`; arguments as for `ray_trace`."""
    return source_and_jacobian(lens, theta, dls_ds)[1]


def mu(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Values:
    """Signed magnification 1/det A = 1/[(1-kappa)^2 - |gamma|^2], `(...)`; arguments as for `ray_trace`."""
    k, g = kappa_and_gamma(lens, theta)
    ratio = as_float(dls_ds)
    return 1.0 / ((1.0 - ratio * k) ** 2 - ratio**2 * (g.real**2 + g.imag**2))


def reduced_shear(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Spin2:
    """Complex reduced shear g = gamma/(1 - kappa), `(...)`; arguments as for `ray_trace`."""
    k, g = kappa_and_gamma(lens, theta)
    ratio = as_float(dls_ds)
    return ratio * g / (1.0 - ratio * k)


def fermat_potential(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Values:
    """|theta - beta|^2/2 - (D_LS/D_S) psi at the image positions `theta`, `(...)`, arcsec^2.

    beta is the source of each position itself; arguments as for `ray_trace`.
    """
    ratio = as_float(dls_ds)
    deflection = _per_point(ratio, 1) * alpha(lens, theta)
    return 0.5 * jnp.sum(deflection**2, axis=-1) - ratio * psi(lens, theta)


def time_delay(lens: Lens, theta: Points, plane: LensPlane, z_s: ScalarLike | Values) -> Values:
    """Arrival time of images relative to an unlensed ray, (1+z_l)/c D_L D_S/D_LS times the Fermat potential.

    Only differences between images of one source are observable: the zero point of psi is free.

    Args:
        lens: the lens.
        theta: image positions, `(..., 2)`, arcsec.
        plane: the lens plane.
        z_s: source redshift, scalar or `(...)`.

    Returns:
        Time, `(...)`, days.
    """
    return plane.time_delay_scale(z_s) * fermat_potential(lens, theta, plane.dls_ds(z_s))


def centres(lens: Lens) -> Array:
    """Positions of all profiles of all components, `(n, 2)`, arcsec."""
    return jnp.concatenate([component.centre for component in lens.components.values()])
