"""Statistics of maps in annuli whose edges may be traced."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from jaxlens._types import Array, Bool, Float, Int, Map

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


@jax.custom_jvp
def _ascending(values: Array) -> Array:
    """`values (m,)` in ascending order, sorted as whole numbers of the same order.

    XLA sorts those five times as fast on a CPU as floating-point numbers, or as two arrays together.
    """
    values = jnp.where(jnp.isnan(values), jnp.nan, values)  # after all numbers, whatever its sign
    bits = jnp.dtype(f"int{8 * values.dtype.itemsize}")
    # Negative numbers descend with their bits; what is below the sign is turned over, there and back.
    turn = lambda whole: whole ^ ((whole >> (jnp.iinfo(bits).bits - 1)) & jnp.iinfo(bits).max)
    whole = lax.sort(turn(lax.bitcast_convert_type(values, bits)))
    return lax.bitcast_convert_type(turn(whole), values.dtype)


@_ascending.defjvp
def _ascending_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (values,), (moved,) = primals, tangents
    ordered, place = lax.sort((values, jnp.arange(len(values))), num_keys=1)
    return ordered, moved[place]


def quantiles(
    values: Float[Array, " m"], weight: Float[Array, " m"] | Bool[Array, " m"], levels: Float[Array, " l"]
) -> Float[Array, " l"]:
    """Quantiles of a sample in which each value stands `weight` times, by linear interpolation.

    For whole weights those of the values written out as often as they count; for weights 0 and 1 those of
    the chosen values. 0 if nothing counts. Differentiable in `values`.

    Args:
        values: the sample, `(m,)`; a value of weight 0 has no influence.
        weight: how often each counts, >= 0, `(m,)`; or which of them count, which is much faster.
        levels: between 0 and 1, `(l,)`.
    """
    if weight.dtype == bool:
        ordered = _ascending(jnp.where(weight, values, jnp.inf))
        end, index = jnp.sum(weight).astype(levels.dtype), lambda number: number.astype(jnp.int32)
    else:
        used = weight > 0.0
        ordered, times = lax.sort(
            (jnp.where(used, values, jnp.inf), jnp.where(used, weight, 0.0)), dimension=0, num_keys=1
        )
        ends = jnp.cumsum(times)
        end = ends[-1]
        index = lambda number: jnp.minimum(jnp.searchsorted(ends, number, side="right"), len(ends) - 1)
    last = jnp.maximum(end - 1.0, 0.0)
    place = levels * last
    below = jnp.floor(place)

    def at(number: Array) -> Array:
        found = ordered[index(number)]
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
        return quantiles(flat, inside, jnp.asarray(LEVELS, flat.dtype)), inside.sum()

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
