"""Statistics of maps in annuli whose edges may be traced."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from jaxlens._types import Array, Float, Int, Map

LEVELS = (0.5, 0.16, 0.84)
"""Median and central 68 % as the paper states them."""


class RadialProfile(eqx.Module):
    """A map in annuli.

    Attributes:
        r: middle of the bins, `(b,)`, in the unit of the edges.
        median, lo, hi: median, 16th and 84th percentile of the used pixels, `(b,)`; 0 in empty bins.
        count: number of used pixels, `(b,)`; 0 marks a bin whose other numbers mean nothing.
    """

    r: Float[Array, " b"]
    median: Float[Array, " b"]
    lo: Float[Array, " b"]
    hi: Float[Array, " b"]
    count: Int[Array, " b"]


def quantiles(
    values: Float[Array, " m"], weight: Float[Array, " m"], levels: Float[Array, " l"]
) -> Float[Array, " l"]:
    """Quantiles of a sample in which each value stands `weight` times, by linear interpolation.

    For whole weights those of the values written out as often as they count; for weights 0 and 1 those of
    the chosen values. 0 if nothing counts. Differentiable in `values`.

    Args:
        values: the sample, `(m,)`; a value of weight 0 has no influence.
        weight: how often each counts, >= 0, `(m,)`.
        levels: between 0 and 1, `(l,)`.
    """
    used = weight > 0.0
    ordered, times = lax.sort(
        (jnp.where(used, values, jnp.inf), jnp.where(used, weight, 0.0)), dimension=0, num_keys=1
    )
    end = jnp.cumsum(times)
    last = jnp.maximum(end[-1] - 1.0, 0.0)
    place = levels * last
    below = jnp.floor(place)

    def at(number: Array) -> Array:
        found = ordered[jnp.minimum(jnp.searchsorted(end, number, side="right"), len(end) - 1)]
        return jnp.where(jnp.isfinite(found), found, 0.0)

    low, high = at(below), at(jnp.minimum(below + 1.0, last))
    return low + (place - below) * (high - low)


def profile(values: Map, radius: Map, edges: Float[Array, " e"], weight: Map | None = None) -> RadialProfile:
    """Median and central 68 % of a map in annuli.

    Args:
        values: the map, `(y, x)`.
        radius: distance of each pixel, `(y, x)`.
        edges: increasing edges of the b bins, `(b + 1,)`, in the unit of `radius`.
        weight: map weight, `(y, x)`; pixels with weight 0 are not used, whatever they hold.

    Returns:
        The profile; `vmap` over realisations. Differentiable in `values`.
    """
    flat, r = values.ravel(), radius.ravel()
    used = jnp.ones_like(r, bool) if weight is None else weight.ravel() > 0
    flat = jnp.where(used, flat, 0.0)

    def one(low: Array, high: Array) -> tuple[Array, Array]:
        inside = used & (r >= low) & (r < high)
        return quantiles(flat, inside.astype(flat.dtype), jnp.asarray(LEVELS, flat.dtype)), inside.sum()

    found, count = jax.vmap(one)(edges[:-1], edges[1:])
    return RadialProfile(0.5 * (edges[:-1] + edges[1:]), found[:, 0], found[:, 1], found[:, 2], count)


def rmse(
    difference: Map, radius: Map, edges: Float[Array, " e"], weight: Map | None = None
) -> Float[Array, " b"]:
    """sqrt(<difference^2>) of the used pixels of each annulus, `(b,)`; 0 in empty bins. See `profile`."""
    square, r = difference.ravel() ** 2, radius.ravel()
    used = jnp.ones_like(r, bool) if weight is None else weight.ravel() > 0
    square = jnp.where(used, square, 0.0)

    def one(low: Array, high: Array) -> Array:
        inside = used & (r >= low) & (r < high)
        mean = jnp.sum(jnp.where(inside, square, 0.0)) / jnp.maximum(inside.sum(), 1)
        # The inner where keeps the gradient finite in an empty or perfect bin.
        return jnp.where(mean > 0.0, jnp.sqrt(jnp.where(mean > 0.0, mean, 1.0)), 0.0)

    return jax.vmap(one)(edges[:-1], edges[1:])
