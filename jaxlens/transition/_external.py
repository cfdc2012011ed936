"""Which probe is better at which radius, once lambda is known from elsewhere."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxlens._types import Array, Float, Int, Map, RandomKey, ScalarLike
from jaxlens.mass_sheet import regauge
from jaxlens.profiles._profile import as_float
from jaxlens.radial import Annuli, mean_in, sector_sums
from jaxlens.transition._excess import smooth_profile


class External(eqx.Module):
    """Error variances of both maps, given lambda.

    Attributes:
        r: middles of the annuli, `(b,)`.
        wl: variance of the weak-lensing map: noise, method and the error of lambda, `(b,)`.
        sl: excess variance of the strong-lensing map, mass sheet included, not below 0, `(b,)`.
        p_wl: share of the samples in which weak lensing is better, `(b,)`.
        better: +1 weak lensing, -1 strong lensing, 0 undecided (`p_wl` between 0.16 and 0.84), `(b,)`.
    """

    r: Float[Array, " b"]
    wl: Float[Array, " b"]
    sl: Float[Array, " b"]
    p_wl: Float[Array, " b"]
    better: Int[Array, " b"]


def with_external(
    key: RandomKey,
    kappa_wl: Map,
    kappa_sl: Map,
    rings: Annuli,
    lam: ScalarLike,
    lam_error: ScalarLike,
    sigma_wl2: Float[Array, " b"],
    bias: Map | None = None,
    weight: Map | None = None,
    *,
    n: int = 500,
) -> External:
    """Which probe is better at which radius, with an external lambda and its error.

    lambda from, say, magnification or two redshift bins makes kappa_corr absolute, so that also an error of
    the strong-lensing map proportional to 1 - kappa shows: sl = <d^2> - sigma_WL^2 with d = kappa_corr -
    kappa_sl - b. The weak-lensing map carries the error of lambda, <(1 - kappa)^2> (lam_error/lam)^2.
    Samples draw lambda from a Gaussian, and the sectors of the annuli with replacement; all profiles are
    smoothed by [1/4 1/2 1/4].

    Args:
        key: of the samples, used once.
        kappa_wl: weak-lensing map, not corrected, `(y, x)`.
        kappa_sl: strong-lensing map, smoothed alike, `(y, x)`.
        rings: annuli and sectors.
        lam, lam_error: external mass-sheet factor and its standard error.
        sigma_wl2: variance of the noise of kappa_wl/lam in each annulus, `(b,)`.
        bias, weight: see `moments`.
        n: samples.
    """
    lam, error = as_float(lam), as_float(lam_error)
    b = jnp.zeros_like(kappa_wl) if bias is None else bias
    # d = a + c/lambda is linear in 1/lambda: three sums serve all samples.
    a, c = 1.0 - kappa_sl - b, kappa_wl - 1.0
    squares, count = zip(*(sector_sums(part, rings, weight) for part in (a * a, a * c, c * c)), strict=True)

    def excess(inverse: Array, often: Array) -> Array:
        aa, ac, cc = (jnp.sum(part * often[None, :], axis=1) for part in squares)
        n_pix = jnp.maximum(jnp.sum(count[0] * often[None, :], axis=1), 1e-9)
        return smooth_profile((aa + 2.0 * inverse * ac + inverse**2 * cc) / n_pix - sigma_wl2)

    s = rings.n_sectors
    sheet = mean_in((1.0 - regauge(kappa_wl, lam)) ** 2, rings, weight) * (error / lam) ** 2
    wl = smooth_profile(sigma_wl2 + mean_in(b**2, rings, weight) + sheet)

    def one(key: Array) -> Array:
        key_lam, key_sector = jax.random.split(key)
        often = jnp.bincount(jax.random.randint(key_sector, (s,), 0, s), length=s).astype(wl.dtype)
        drawn = lam + error * jax.random.normal(key_lam, (), wl.dtype)
        return excess(1.0 / drawn, often) > wl

    p_wl = jnp.mean(jax.vmap(one)(jax.random.split(key, n)).astype(wl.dtype), axis=0)
    better = (p_wl > 0.84).astype(jnp.int32) - (p_wl < 0.16).astype(jnp.int32)
    # The error of lambda is in the difference of the maps as well.
    sl = excess(1.0 / lam, jnp.ones(s, wl.dtype)) - smooth_profile(sheet)
    return External(rings.r, wl, jnp.maximum(sl, 0.0), p_wl, better)
