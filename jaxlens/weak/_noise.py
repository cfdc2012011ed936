"""Galaxy counts, intrinsic ellipticities, and the mean ellipticity of each pixel."""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Complex

from jaxlens._types import Array, ComplexMap, Int, Map, RandomKey
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.weak._shear import ShearMap


def mean_counts(
    grid: Grid,
    plane: LensPlane,
    *,
    density: float = 432.0,
    depletion: float = 0.3,
    scale_kpc: float = 300.0,
) -> Map:
    """Expected galaxies per pixel, n_0 (1 - d exp(-R/R_s)) A_pix, `(y, x)`, as stated in the paper.

    Args:
        grid: the grid; R is the distance from the origin of its frame.
        plane: the lens plane.
        density: n_0, galaxies per square arcmin.
        depletion: d, by magnification and cluster galaxies, in [0, 1].
        scale_kpc: R_s, kpc (physical, no h).
    """
    if not 0.0 <= depletion <= 1.0 or not density >= 0.0 or not scale_kpc > 0.0:
        raise ValueError(
            f"`density` {density}, `depletion` {depletion}, `scale_kpc` {scale_kpc}: give a density >= 0, "
            "a depletion between 0 and 1 and a positive scale."
        )
    radius = grid.radius * plane.kpc_per_arcsec
    return density * (grid.pixel / 60.0) ** 2 * (1.0 - depletion * jnp.exp(-radius / scale_kpc))


def observed_ellipticity(eps_int: Complex[Array, "*b"], g: Complex[Array, "*b"]) -> Complex[Array, "*b"]:
    """Image ellipticity of a source: (e + g)/(1 + g* e) for |g| <= 1, (1 + g e*)/(e* + g*) for |g| > 1.

    Seitz & Schneider (1997). Its mean over isotropic sources is g, or 1/g* for |g| > 1.

    Args:
        eps_int: intrinsic complex ellipticity (a - b)/(a + b) exp(2 i phi).
        g: reduced shear, same shape.
    """
    # With n = e + g and d = 1 + g* e the branches are n/d and d*/n*: both n d* over a square.
    (e1, e2), (g1, g2) = (eps_int.real, eps_int.imag), (g.real, g.imag)
    n1, n2 = e1 + g1, e2 + g2
    d1, d2 = 1.0 + g1 * e1 + g2 * e2, g1 * e2 - g2 * e1
    square = jnp.where(g1**2 + g2**2 > 1.0, n1**2 + n2**2, d1**2 + d2**2)
    return lax.complex((n1 * d1 + n2 * d2) / square, (n2 * d1 - n1 * d2) / square)


class NoisyShear(ShearMap):
    """A `ShearMap` with shape noise.

    Attributes:
        overflow: more galaxies were drawn than there was room for, `()`; the surplus was left out.
    """

    overflow: Bool[Array, ""]


def capacity_of(mean: float) -> int:
    """Room for a Poisson number of galaxies with this mean: 8 standard deviations above it."""
    return int(mean + 8.0 * mean**0.5 + 16.0)


def _poisson(key: RandomKey, mean: Map) -> Int[Array, "y x"]:
    """Poisson numbers: one uniform number per pixel and the inverse of the distribution, term by term.

    As many steps as the largest number, each over all pixels; rejection costs six times more at a mean of 12.
    It is left to means so large that the first term, exp(-mean), underflows.
    """

    def direct(key: RandomKey) -> Array:
        u = jax.random.uniform(key, mean.shape, mean.dtype)
        eps = float(jnp.finfo(mean.dtype).eps)

        def beyond(carry: tuple[Array, ...]) -> Array:
            step, term, total, _ = carry
            # A u above the rounded sum of all terms must not count on for ever.
            return (u > total) & ((term > eps) | (step < mean))

        def body(carry: tuple[Array, ...]) -> tuple[Array, ...]:
            step, term, total, number = carry
            number = number + beyond(carry)
            term = term * mean / (step + 1.0)
            return step + 1.0, term, total + term, number

        first = jnp.exp(-mean)
        zero = jnp.zeros((), mean.dtype)
        start = (zero, first, first, jnp.zeros(mean.shape, jnp.int32))
        return lax.while_loop(lambda carry: jnp.any(beyond(carry)), body, start)[-1]

    rejection = lambda key: jax.random.poisson(key, mean, dtype=jnp.int32)
    largest = -0.9 * math.log(float(jnp.finfo(mean.dtype).tiny))  # 78 in single, 637 in double precision
    return lax.cond(jnp.max(mean) <= largest, direct, rejection, key)


def shape_noise(
    key: RandomKey,
    g: ComplexMap,
    counts: Map,
    *,
    capacity: int,
    weight: Map | None = None,
    sigma_eps: float = 0.24,
) -> NoisyShear:
    """One realisation of the mean ellipticity per pixel, with Poisson counts.

    Each galaxy has intrinsic components drawn from a Gaussian of width sigma_eps and is sheared exactly, so
    the mean is Gaussian only for |g| below about 0.2. **The Gaussian numbers have 24 random bits** (single
    precision) whatever the dtype of `g`; all that follows has that dtype. Not differentiable.

    Args:
        key: used once.
        g: true reduced shear, `(y, x)`.
        counts: expected galaxies per pixel, `(y, x)`, see `mean_counts`.
        capacity: room for galaxies in the whole map, see `capacity_of(float(counts.sum()))`.
        weight: mask or weight, `(y, x)`; all 1 if None.
        sigma_eps: standard deviation of each intrinsic component.

    Returns:
        Mean ellipticities (0 where there is no galaxy), `weight` with 0 in empty pixels, and counts.
    """
    if capacity < 1:
        raise ValueError(f"`capacity` is {capacity}; give `capacity_of` of the expected number of galaxies.")
    key_n, key_eps = jax.random.split(key)
    real = g.real.dtype
    n_gal = _poisson(key_n, counts)
    # Galaxies stand pixel by pixel in one list; places after the last galaxy belong to no pixel. What the
    # list really holds, should it overflow, ends at `ends`. Without the barriers of this function the draws
    # are computed once for each use.
    everything = jnp.cumsum(n_gal.ravel())
    ends = lax.optimization_barrier(jnp.minimum(everything, capacity))
    pixel = jnp.cumsum(jnp.zeros(capacity + 1, jnp.int32).at[ends].add(1))[:-1]
    eps = sigma_eps * jax.random.normal(key_eps, (2, capacity), jnp.float32).astype(real)
    flat = jnp.concatenate([g.ravel(), jnp.zeros(1, g.dtype)])
    eps, pixel = lax.optimization_barrier((eps, pixel))
    sheared = lax.optimization_barrier(flat[pixel])
    seen = lax.optimization_barrier(observed_ellipticity(lax.complex(eps[0], eps[1]), sheared))
    sums = jax.ops.segment_sum(seen, pixel, g.size + 1, indices_are_sorted=True)[:-1]
    held = jnp.diff(ends, prepend=0).reshape(g.shape)
    mean = sums.reshape(g.shape) / jnp.maximum(held, 1).astype(real)
    base = jnp.ones(g.shape, real) if weight is None else weight.astype(real)
    return NoisyShear(
        g=mean,
        weight=jnp.where(held > 0, base, 0.0),
        n_gal=held,
        overflow=everything[-1] > capacity,
    )
