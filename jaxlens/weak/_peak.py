"""The highest point of a map."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from jaxlens._types import Array, Bool, Float, Int, Map, Scalar
from jaxlens.grid import Grid


class Peak(NamedTuple):
    """The highest point of a map.

    Attributes:
        theta: its position, refined by a parabola along each axis on which both neighbours are lower,
            `(2,)`, arcsec.
        value: of the highest pixel, `()`.
        pixel: its row and column, `(2,)`.
    """

    theta: Float[Array, "2"]
    value: Scalar
    pixel: Int[Array, "2"]


@eqx.filter_jit
def peak(values: Map, grid: Grid, used: Bool[Array, "y x"] | None = None) -> Peak:
    """The highest pixel of a map, and where within a pixel of it a parabola has its top.

    Args:
        values: the map, `(y, x)`.
        grid: its grid.
        used: pixels among which to look, `(y, x)`; all if None, but never a NaN.
    """
    known = ~jnp.isnan(values) if used is None else used & ~jnp.isnan(values)
    seen = jnp.where(known, values, -jnp.inf)
    row, column = jnp.divmod(jnp.argmax(seen), grid.shape[1])

    def shift(line: Array, at: Array) -> Array:
        """In pixels; 0 at the edge, or beside a pixel that is unused and higher, or not finite."""
        left, middle, right = (line[jnp.clip(at + i, 0, len(line) - 1)] for i in (-1, 0, 1))
        bend = left - 2.0 * middle + right
        good = (at > 0) & (at < len(line) - 1) & (jnp.maximum(left, right) <= middle)
        good &= (bend < 0.0) & jnp.isfinite(bend)
        return jnp.where(good, 0.5 * (left - right) / jnp.where(good, bend, 1.0), 0.0)

    off = jnp.stack([shift(values[row], column), shift(values[:, column], row)])
    return Peak(grid.theta[row, column] + grid.pixel * off, values[row, column], jnp.stack([row, column]))
