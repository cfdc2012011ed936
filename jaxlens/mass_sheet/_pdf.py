"""The distribution of lambda over pixels: kernel density, its peak, and robust numbers."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from jaxlens._types import Array, Bool, Float, Map, Scalar
from jaxlens.mass_sheet._maps import ratio
from jaxlens.radial import quantiles

CLIP = (0.01, 0.99)
"""The kernel density is that of the sample between these quantiles, so that outliers do not set its width."""

POINTS = 256
"""Grid on which the peak is looked for; 20 to 60 bandwidths span it."""

STEPS, ROUNDING = 12, 4.0
"""Most Newton steps from the best grid point, and the length of the last one in roundings of lambda: 4 steps
get there unless the peak is flat."""

TUKEY = 6.0
"""Cut of the biweight in median absolute deviations."""


class Distribution(eqx.Module):
    """How lambda is distributed over pixels.

    Attributes:
        peak: lambda_P, the maximum of the kernel density, `()`.
        biweight: Tukey's biweight location, `()`; scatters half as much as the peak.
        median, lo, hi: 50, 16 and 84 % quantiles, `()`.
        half_width: (hi - lo)/2, `()`.
        asymmetry: (hi + lo - 2 median)/(hi - lo), `()`; 0 if symmetric. Moments are useless here: one pixel
            on a subhalo makes the skewness.
        count: pixels, counted as often as they weigh, `()`; 0 marks that the others mean nothing.
    """

    peak: Scalar
    biweight: Scalar
    median: Scalar
    lo: Scalar
    hi: Scalar
    half_width: Scalar
    asymmetry: Scalar
    count: Scalar


Weights = Float[Array, "*m"] | Bool[Array, "*m"] | None
"""How often each value counts; or which values count, which is much faster; None: all do."""


def _flat(values: Array, weight: Array | None) -> tuple[Array, Array, Array]:
    """Values, how often each counts, and the same as `quantiles` is given it, `(m,)` each."""
    flat = values.ravel()
    given = jnp.ones(flat.shape, bool) if weight is None else weight.ravel()
    times = jnp.maximum(given.astype(flat.dtype), 0.0)
    return jnp.where(times > 0.0, flat, 0.0), times, given if given.dtype == bool else times


def _clip(values: Array, weight: Array, low: Array, high: Array) -> Array:
    """Weights of the sample between two quantiles."""
    return jnp.where((values >= low) & (values <= high), weight, 0.0)


def _clipped(values: Array, weight: Array | None) -> tuple[Array, Array, Array, Array]:
    """Values, their weights between the quantiles of `CLIP`, and these quantiles."""
    flat, times, counted = _flat(values, weight)
    low, high = lax.stop_gradient(quantiles(flat, counted, jnp.asarray(CLIP, flat.dtype)))
    return flat, _clip(flat, times, low, high), low, high


def _width(values: Array, weight: Array) -> Array:
    total = jnp.sum(weight)
    mean = jnp.sum(weight * values) / jnp.maximum(total, 1.0)
    variance = jnp.sum(weight * (values - mean) ** 2) / jnp.maximum(total - 1.0, 1.0)
    # The floor makes a kernel of a sample without spread, and keeps its derivative finite.
    tiny = (1e-9 * jnp.maximum(jnp.abs(mean), 1e-6)) ** 2
    return jnp.sqrt(jnp.maximum(variance, tiny)) * jnp.maximum(total, 1.0) ** -0.2


def bandwidth(values: Float[Array, "*m"], weight: Weights = None) -> Scalar:
    """Scott's bandwidth, n^(-1/5) times the standard deviation, of the sample clipped to 1-99 %, `()`."""
    return _width(*_clipped(values, weight)[:2])


def median(kappa: Map, reference: Map, weight: Map | Bool[Array, "y x"] | None = None) -> Scalar:
    """Median of lambda = (kappa - 1)/(reference - 1) over pixels, `()`; differentiable, 0 if none counts.

    Args:
        kappa, reference: convergences smoothed alike, `(y, x)`.
        weight: how often each pixel counts, or whether it does, `(y, x)`; once if None.
    """
    found = ratio(kappa, reference, weight)
    given = found.weight > 0.0 if weight is None or weight.dtype == bool else found.weight
    return quantiles(found.lam.ravel(), given.ravel(), jnp.asarray([0.5], found.lam.dtype))[0]


def density(values: Float[Array, "*m"], x: Float[Array, " k"], weight: Weights = None) -> Float[Array, " k"]:
    """Gaussian kernel density of the sample clipped to 1-99 %, bandwidth of Scott; integrates to 1.

    Args:
        values: lambda of the pixels, any shape.
        x: where it is wanted, `(k,)`.
        weight: how often each pixel counts, shape of `values`; 0 leaves it out.

    Returns:
        The density, `(k,)`; 0 without a sample. Differentiable in `values` and `x`.
    """
    flat, inside, _, _ = _clipped(values, weight)
    h = _width(flat, inside)

    def one(at: Array) -> Array:
        return jnp.sum(inside * jnp.exp(-0.5 * ((flat - at) / h) ** 2))

    return lax.map(one, x) / (jnp.maximum(jnp.sum(inside), 1.0) * h * jnp.sqrt(2.0 * jnp.pi))


def peak(values: Float[Array, "*m"], weight: Weights = None) -> Scalar:
    """lambda_P: where `density` is largest, to rounding, `()`.

    The best point of a grid (of the binned sample), then Newton steps on the exact density. Differentiable in
    `values` by the implicit function theorem, the bandwidth included; which pixels are clipped is held fixed.

    Args:
        values: lambda of the pixels, any shape.
        weight: how often each pixel counts, shape of `values`; 0 leaves it out.
    """
    flat, inside, low, high = _clipped(values, weight)
    return _peak(flat, inside, low, high, _width(flat, inside))


def _peak(flat: Array, inside: Array, low: Array, high: Array, width: Array) -> Array:
    still, held, h = lax.stop_gradient((flat, inside, width))
    step = jnp.maximum((high - low) / (POINTS - 1), 1e-6 * h)
    # Each value is shared between its two neighbours on the grid.
    place = jnp.clip((still - low) / step, 0.0, POINTS - 1.0)
    left = jnp.minimum(place.astype(int), POINTS - 2)
    right_share = place - left.astype(place.dtype)
    counts = jnp.zeros(POINTS, flat.dtype)
    counts = counts.at[left].add(inside * (1.0 - right_share)).at[left + 1].add(inside * right_share)
    eps = float(jnp.finfo(flat.dtype).eps)
    apart = (jnp.arange(POINTS, dtype=flat.dtype) * (step / h)) ** 2
    kernel = jnp.exp(-0.5 * apart)
    near = jnp.abs(jnp.arange(POINTS)[:, None] - jnp.arange(POINTS)[None, :])
    start = low + step * jnp.argmax(kernel[near] @ counts).astype(flat.dtype)

    def slopes(x: Array, values: Array, times: Array, h: Array) -> tuple[Array, Array]:
        u = (values - x) / h
        # One product for both, so that the kernel is worked out once.
        kernel = times * jnp.exp(-0.5 * u**2)
        first, second = jnp.matmul(jnp.stack([u, u**2 - 1.0]), kernel, precision="highest")
        return first / h, second / h**2

    def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, x, _ = state
        first, second = slopes(x, still, held, h)
        move = jnp.where(second < 0.0, -first / jnp.where(second < 0.0, second, -1.0), jnp.sign(first) * step)
        moved = jnp.clip(x + move, start - 2.0 * step, start + 2.0 * step)
        return number + 1, moved, jnp.abs(moved - x) > ROUNDING * eps * (jnp.abs(x) + h)

    going = lambda state: state[2] & (state[0] < STEPS)
    x = lax.while_loop(going, newton, (jnp.zeros((), jnp.int32), start, jnp.ones((), bool)))[1]
    # A last step with a frozen curvature carries the derivative.
    curved = lax.stop_gradient(slopes(x, still, held, h)[1])
    step_first = slopes(lax.stop_gradient(x), flat, inside, width)[0]
    return lax.stop_gradient(x) - jnp.where(
        curved < 0.0, step_first / jnp.where(curved < 0.0, curved, -1.0), 0.0
    )


def biweight(values: Float[Array, "*m"], weight: Weights = None) -> Scalar:
    """Tukey's biweight location with the cut at 6 median absolute deviations, `()`.

    M + sum (x - M)(1 - u^2)^2/sum (1 - u^2)^2 over |u| < 1, u = (x - M)/(6 MAD), M the median.
    """
    flat, times, counted = _flat(values, weight)
    return _biweight(flat, times, counted, quantiles(flat, counted, jnp.asarray([0.5], flat.dtype))[0])


def _biweight(flat: Array, times: Array, counted: Array, median: Array) -> Array:
    away = flat - median
    mad = quantiles(jnp.abs(away), counted, jnp.asarray([0.5], flat.dtype))[0]
    u = away / (TUKEY * jnp.where(mad > 0.0, mad, 1.0))
    w = jnp.where((jnp.abs(u) < 1.0) & (mad > 0.0), times * (1.0 - u**2) ** 2, 0.0)
    total = jnp.sum(w)
    return median + jnp.sum(away * w) / jnp.where(total > 0.0, total, 1.0)


def distribution(values: Float[Array, "*m"], weight: Weights = None) -> Distribution:
    """Peak, biweight, quantiles and shape of the distribution of lambda over pixels.

    Args:
        values: lambda of the pixels, any shape.
        weight: how often each pixel counts, shape of `values`; 0 leaves it out. Or which pixels count.

    Returns:
        Scalars; `vmap` over realisations. Differentiable in `values`.
    """
    return distribution_and_bandwidth(values, weight)[0]


def distribution_and_bandwidth(
    values: Float[Array, "*m"], weight: Weights = None
) -> tuple[Distribution, Scalar]:
    """`distribution` and `bandwidth` (`()`) of one sample, which is sorted once; arguments as for these."""
    flat, times, counted = _flat(values, weight)
    levels = jnp.asarray((0.5, 0.16, 0.84, *CLIP), flat.dtype)
    median, lo, hi, low, high = quantiles(flat, counted, levels)
    low, high = lax.stop_gradient((low, high))
    inside = _clip(flat, times, low, high)
    width, spread = _width(flat, inside), hi - lo
    found = Distribution(
        peak=_peak(flat, inside, low, high, width),
        biweight=_biweight(flat, times, counted, median),
        median=median,
        lo=lo,
        hi=hi,
        half_width=0.5 * spread,
        asymmetry=jnp.where(
            spread > 0.0, (hi + lo - 2.0 * median) / jnp.where(spread > 0.0, spread, 1.0), 0.0
        ),
        count=jnp.sum(times),
    )
    return found, width
