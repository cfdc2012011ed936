"""The error of lambda_P from one map: bootstrap of blocks of pixels."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxlens._types import Array, Float, Map, RandomKey
from jaxlens.grid import Grid
from jaxlens.mass_sheet._pdf import Distribution, distribution

BLOCK = 40.0
"""Side of a block, arcsec, for everybody; see `bootstrap` for what it misses."""


def blocks(grid: Grid, side: float = BLOCK) -> np.ndarray:
    """Number of the square block that each pixel lies in, `(y, x)`.

    Args:
        grid: the grid.
        side: of a block, arcsec; rounded to whole pixels, at least one.
    """
    size = max(1, round(side / grid.pixel))
    rows, columns = (np.arange(n) // size for n in grid.shape)
    return (rows[:, None] * (columns[-1] + 1) + columns[None, :]).astype(np.int32)


def bootstrap(
    key: RandomKey,
    lam: Map,
    weight: Map,
    grid: Grid,
    *,
    side: float = BLOCK,
    n: int = 200,
) -> Distribution:
    """Standard errors of `distribution` from one map, by drawing blocks of pixels with replacement.

    Smoothing makes neighbours alike. On maps smoothed by 15 arcsec single pixels give 0.2 (median) to
    0.45 (peak) of the true error, blocks of 40 arcsec 0.6 to 0.7, blocks of 80 arcsec 0.85 to 0.9 where the
    field holds enough of them. Where a model of the noise exists the Monte Carlo is the better error.

    Args:
        key: used once.
        lam: map of lambda, `(y, x)`.
        weight: pixels of weight 0 are left out, `(y, x)`.
        grid: its grid.
        side: of a block, arcsec.
        n: samples.

    Returns:
        Standard deviation over the samples of each number of a `Distribution`, `()` each.
    """
    number = blocks(grid, side)
    size = int(number.max()) + 1
    times = (weight > 0.0).astype(lam.dtype)
    held: Float[Array, " k"] = jax.ops.segment_sum(times.ravel(), number.ravel(), size)
    known = held > 0.0
    log_p = jnp.where(known, 0.0, -jnp.inf)
    draws = jnp.sum(known)

    def one(key: Array) -> Distribution:
        picked = jax.random.categorical(key, log_p, shape=(size,))
        taken = (jnp.arange(size) < draws).astype(lam.dtype)
        often = jax.ops.segment_sum(taken, picked, size)
        return distribution(lam, times * often[number])

    found = lax.map(one, jax.random.split(key, n))
    return jax.tree.map(lambda part: jnp.std(part, ddof=1), found)
