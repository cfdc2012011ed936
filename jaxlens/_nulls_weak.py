"""Null maps and bootstrap samples, and a map against null maps."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import weak
from jaxlens._types import Array
from jaxlens.grid import Grid


@eqx.filter_jit
def null_maps(
    keys: Array,
    shear: weak.ShearMap,
    grid: Grid,
    factor: Array | float,
    galaxies: weak.Galaxies | None = None,
) -> weak.ShearMap:
    """Shear maps of randomly turned galaxies, or pixels, each followed by its twin turned by 45 degrees more.

    Args:
        keys: one for each pair.
        shear: weights, counts and, without galaxies, the shear whose pixels are turned.
        grid: its pixels.
        factor: by which mean ellipticities are multiplied.
        galaxies: the catalogue.
    """

    def pair(key: Array) -> weak.ShearMap:
        if galaxies is not None:
            g = weak.to_grid(weak.scramble(key, galaxies), grid).g * factor
        else:
            g = shear.g * jnp.exp(1j * jax.random.uniform(key, shear.g.shape, maxval=2.0 * jnp.pi))
        return jax.vmap(lambda g: weak.ShearMap(g, shear.weight, shear.n_gal))(jnp.stack([g, 1j * g]))

    pairs = jax.lax.map(pair, keys)
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), pairs)


@eqx.filter_jit
def samples(keys: Array, galaxies: weak.Galaxies, grid: Grid, factor: Array | float) -> weak.ShearMap:
    """Shear maps of bootstrap samples of the galaxies, with a leading axis."""

    def one(key: Array) -> weak.ShearMap:
        made = weak.to_grid(weak.resample(key, galaxies), grid)
        return weak.ShearMap(made.g * factor, made.weight, made.n_gal)

    return jax.lax.map(one, keys)


class Mode(NamedTuple):
    """A map against null maps.

    Attributes:
        chi2: mean of (kappa/sigma)^2 over unmasked pixels; 1 is expected of noise.
        significance: (chi2 - 1) over its scatter between null maps, which knows that pixels are correlated.
        exceeded: share of the null maps with a larger chi2.
    """

    chi2: float
    significance: float
    exceeded: float


def against(kappa: np.ndarray, nulls: np.ndarray, used: np.ndarray) -> Mode:
    """A map against null maps; each null map is compared with the noise of the others.

    The noise of n maps has n degrees of freedom, so that chi^2 is too large by n/(n - 2).
    """
    values, squares = kappa[used] ** 2, nulls[:, used] ** 2
    n, total = len(squares), squares.sum(axis=0)
    chi2 = float(np.mean(values / total)) * (n - 2)
    null = np.mean(squares / (total - squares), axis=1) * (n - 3)
    scatter = float(np.std(null, ddof=1))
    return Mode(chi2, (chi2 - 1.0) / scatter, float(np.mean(null > chi2)))
