"""From a key to noisy shear and its reconstructions."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from jaxlens import weak
from jaxlens._types import Array, Float, RandomKey
from jaxlens.monte_carlo._setup import Setup, reconstruct


def draw(key: RandomKey, number: int | Array, setup: Setup) -> weak.NoisyShear:
    """Realisation `number` of the noisy shear: the same whatever the mask, the method and the other numbers.

    Args:
        key: of the cluster.
        number: of the realisation, >= 0.
        setup: from `prepare`.
    """
    return _draw(key, jnp.asarray(number), setup)


@eqx.filter_jit
def _draw(key: RandomKey, number: Array, setup: Setup) -> weak.NoisyShear:
    return weak.shape_noise(
        jax.random.fold_in(key, number),
        setup.g,
        setup.counts,
        capacity=setup.capacity,
        sigma_eps=setup.sigma_eps,
    )


def smoothed(noisy: weak.NoisyShear, setup: Setup) -> Array:
    """Smoothed reduced shear in unmasked pixels, 0 in masked ones, `(y, x)` complex.

    An unmasked pixel without galaxies gets the mean of its surroundings.
    """
    weight = noisy.weight * setup.weight
    value = weak.smooth(noisy.g, setup.grid, setup.smoothing, weight)
    return jnp.where(setup.weight > 0.0, value, jnp.zeros((), value.dtype))


def reconstructions(g: Array, setup: Setup) -> dict[str, weak.ReconstructionBatch]:
    """A2 and K2 of many smoothed shear maps, `(m, y, x)`."""
    return reconstruct(g, setup.weight, setup.grid, setup.inverse, setup.n_iter, setup.mask)


def draws(key: RandomKey, first: Array, setup: Setup, m: int) -> tuple[Array, Array, Array]:
    """Smoothed shear of `m` realisations, their empty unmasked pixels, and whether a draw overflowed."""

    def one(number: Array) -> tuple[Array, Array, Array]:
        noisy = draw(key, number, setup)
        empty = jnp.sum((noisy.n_gal == 0) & (setup.weight > 0.0))
        return smoothed(noisy, setup), empty, noisy.overflow

    return lax.map(one, first + jnp.arange(m))  # measured faster than vmap on a CPU


def noise_maps(key: RandomKey, number: int, setup: Setup) -> dict[str, Float[Array, "y x"]]:
    """Reconstructions of one realisation by method, `(y, x)` each: the maps behind `lambda_profiles`.

    They agree with those of the block to rounding: a matrix product rounds by its size.
    """
    return _maps(key, jnp.asarray(number), setup)


@eqx.filter_jit
def _maps(key: RandomKey, number: Array, setup: Setup) -> dict[str, Array]:
    g, _, _ = draws(key, number, setup, 1)
    return {name: made.kappa[0] for name, made in reconstructions(g, setup).items()}
