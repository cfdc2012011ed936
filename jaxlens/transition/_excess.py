"""The transition from the variance that weak-lensing noise does not explain: no truth is needed."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool

from jaxlens._types import Array, Float, Int, Map, RandomKey, Scalar
from jaxlens.radial import Annuli, mean_in, sector_sums, to_pixels

STAY = 2
"""Annuli in which the ratio must stay above 1, see `excess_variance`."""

FEWEST = 8
"""Pixels of an annulus whose ratio counts."""


class Moments(eqx.Module):
    """Sums of d^2 in annuli and sectors, d = kappa_wl' - kappa_sl - b: what the estimator needs of a map.

    Attributes:
        total: sum of d^2, `(b, s)`.
        count: pixels, `(b, s)`.
    """

    total: Float[Array, "*n b s"]
    count: Float[Array, "*n b s"]

    @property
    def mean(self) -> Float[Array, "*n b"]:
        """<d^2> of each annulus, `(b,)`; 0 in empty ones."""
        return self.total.sum(axis=-1) / jnp.maximum(self.count.sum(axis=-1), 1.0)


def moments(
    kappa_wl: Map, kappa_sl: Map, rings: Annuli, bias: Map | None = None, weight: Map | None = None
) -> Moments:
    """`Moments` of one pair of maps.

    Args:
        kappa_wl: weak-lensing map without its mass sheet, kappa_wl', see `aligned`, `(y, x)`.
        kappa_sl: strong-lensing map, smoothed alike, `(y, x)`.
        rings: annuli and sectors.
        bias: error b of the weak-lensing method, `(y, x)`: the noiseless reconstruction of the reduced
            shear of the strong-lensing model itself, aligned likewise, minus that model; 0 if None.
        weight: further pixels to leave out, `(y, x)`.
    """
    d = kappa_wl - kappa_sl if bias is None else kappa_wl - kappa_sl - bias
    return Moments(*sector_sums(d**2, rings, weight))


def mean_moments(many: Moments) -> Moments:
    """The mean over realisations, `(n, b, s)` to `(b, s)`: as one map with the noise of n."""
    return Moments(many.total.mean(axis=0), many.count.mean(axis=0))


class Transition(eqx.Module):
    """A transition radius, or that there is none.

    Attributes:
        found: the ratio rises through 1, `()`.
        radius: r_t, unit of the annuli, `()`; without `found` 0 and without a meaning.
        index: annulus below r_t, `()`.
        inside: the ratio is above 1 in the innermost annuli and never falls below it for as many: weak
            lensing is better all over, and a transition can only lie further in, `()`. Never with `found`.
    """

    found: Bool[Array, ""]
    radius: Scalar
    index: Int[Array, ""]
    inside: Bool[Array, ""]


def hold_ends(values: Float[Array, " b"], known: Bool[Array, " b"]) -> Float[Array, " b"]:
    """A profile whose annuli before the first and behind the last known one have its value, `(b,)`.

    So that nothing crosses 1 there.
    """
    first, last = jnp.argmax(known), len(values) - 1 - jnp.argmax(known[::-1])
    return values[jnp.clip(jnp.arange(len(values)), first, last)]


def smooth_profile(values: Float[Array, " b"], known: Bool[Array, " b"] | None = None) -> Float[Array, " b"]:
    """[1/4 1/2 1/4] along the annuli; at both ends the weights inside are scaled to 1.

    Args:
        values: of the annuli, `(b,)`.
        known: those that count, all if None, `(b,)`; the ends are held, see `hold_ends`.
    """
    good = jnp.ones(values.shape, bool) if known is None else known
    weigh = lambda a: 0.25 * a[:-2] + 0.5 * a[1:-1] + 0.25 * a[2:]
    weight = weigh(jnp.pad(good.astype(values.dtype), 1))
    smooth = weigh(jnp.pad(jnp.where(good, values, 0.0), 1)) / jnp.where(weight > 0.0, weight, 1.0)
    return hold_ends(smooth, good)


def first_rise(r: Float[Array, " b"], q: Float[Array, " b"], stay: int = STAY) -> Transition:
    """First radius where q rises through 1 and stays above for `stay` annuli.

    Linear between the middles of the annuli; differentiable in q. It is the first rise, not the only one,
    and q may have been above 1 before or fall again behind the `stay` annuli. A q that is above 1 in the
    first `stay` annuli, and later never below for as many, rises nowhere and is `inside`.
    """
    b = len(r)
    if b < stay + 1:
        none = jnp.zeros((), bool)
        return Transition(none, jnp.zeros((), r.dtype), jnp.zeros((), jnp.int32), none)
    above = q >= 1.0
    kept = jnp.stack([above[1 + k : b - stay + 1 + k] for k in range(stay)]).all(axis=0)
    rises = ~above[: b - stay] & kept
    found = jnp.any(rises)
    index = jnp.argmax(rises).astype(jnp.int32)
    low, high = q[index], q[index + 1]
    share = (1.0 - low) / jnp.where(found, high - low, 1.0)
    below = jnp.stack([~above[1 + k : b - stay + 1 + k] for k in range(stay)]).all(axis=0)
    inside = above[:stay].all() & ~found & ~below.any()
    return Transition(
        found, jnp.where(found, r[index] + share * (r[index + 1] - r[index]), 0.0), index, inside
    )


class Excess(eqx.Module):
    """The excess variance of annuli and the transition in it.

    Attributes:
        r: middles of the annuli, `(b,)`.
        q: (<d^2> - sigma_WL^2)/(sigma_WL^2 + <b^2>), smoothed; above 1 weak lensing is better, `(b,)`.
        wl: sigma_WL^2 + <b^2>, variance of the weak-lensing map, `(b,)`.
        sl: the same of the strong-lensing map, q times `wl`, not below 0, `(b,)`.
        transition: of q.
        lo, hi: 16 and 84 % of the radii of the samples that have one, `()`.
        share: share of the samples that have one, `()`.
        share_inside: share of the samples that are `inside`, `()`.
    """

    r: Float[Array, " b"]
    q: Float[Array, " b"]
    wl: Float[Array, " b"]
    sl: Float[Array, " b"]
    transition: Transition
    lo: Scalar
    hi: Scalar
    share: Scalar
    share_inside: Scalar


def excess_variance(
    key: RandomKey,
    found: Moments,
    rings: Annuli,
    sigma_wl2: Float[Array, " b"],
    bias: Map | None = None,
    *,
    stay: int = STAY,
    n: int = 500,
) -> Excess:
    """Transition radius without the truth, from the variance of kappa_wl' - kappa_sl.

    Where strong lensing is good the difference of the maps has the variance of weak-lensing noise; what is
    beyond it is the error of the strong-lensing map: q = (<d^2> - sigma_WL^2)/(sigma_WL^2 + <b^2>) is the
    ratio of the error variances. The transition is the first radius where q, smoothed by [1/4 1/2 1/4],
    rises through 1 and stays above for two annuli; annuli with fewer than 8 pixels do not count. An error
    of the strong-lensing map that is proportional to 1 - kappa is absorbed by the mass sheet and not seen.

    The rule is our choice, made on simulated clusters: the sheet of all annuli, not lambda_P, which a wrong
    strong-lensing map pulls where it is measured, and two annuli. Of five clusters that had no part in it
    means of 30 maps lie within 75 kpc/h of the crossing of the true errors in 22 of 40 cases, and in 22 of 24
    where their variances soon differ by half or more. With a perfect strong-lensing map at least 98 % of
    single maps have no transition (`benchmarks/transition.py`).

    The interval is that of a bootstrap over the sectors of the annuli. Measured on simulated clusters, it
    holds the value of many noise maps in 50 to 75 % of cases: a little too narrow.

    Args:
        key: of the bootstrap, used once.
        found: moments of one pair of maps, or their mean over realisations.
        rings: annuli and sectors.
        sigma_wl2: variance of the noise of kappa_wl' in each annulus, from the Monte Carlo, `(b,)`.
        bias: error of the method, see `moments`.
        stay: annuli in which q must stay above 1.
        n: samples of the bootstrap.

    Returns:
        `Excess`; no transition is data, not an error.
    """
    b2 = jnp.zeros_like(sigma_wl2) if bias is None else mean_in(bias**2, rings)
    wl = sigma_wl2 + b2
    safe = jnp.where(wl > 0.0, wl, 1.0)
    known = found.count.sum(axis=1) >= FEWEST

    def ratio_of(total: Array, count: Array) -> Array:
        d2 = total.sum(axis=1) / jnp.maximum(count.sum(axis=1), 1e-9)
        return smooth_profile(jnp.where(wl > 0.0, (d2 - sigma_wl2) / safe, 0.0), known)

    q = ratio_of(found.total, found.count)
    s = rings.n_sectors

    def one(key: Array) -> tuple[Array, Array, Array]:
        often = jnp.bincount(jax.random.randint(key, (s,), 0, s), length=s).astype(q.dtype)
        made = first_rise(rings.r, ratio_of(found.total * often[None, :], found.count * often[None, :]), stay)
        return made.found, made.radius, made.inside

    has, radii, within = jax.vmap(one)(jax.random.split(key, n))
    ordered = jnp.sort(jnp.where(has, radii, jnp.inf))
    last = jnp.maximum(has.sum() - 1, 0)
    at = lambda level: jnp.where(has.any(), ordered[jnp.round(level * last).astype(int)], 0.0)
    share = jnp.mean(has.astype(q.dtype))
    return Excess(
        rings.r,
        q,
        wl,
        jnp.maximum(q * wl, 0.0),
        first_rise(rings.r, q, stay),
        at(0.16),
        at(0.84),
        share,
        jnp.mean(within.astype(q.dtype)),
    )


def combined(kappa_corr: Map, kappa_sl: Map, excess: Excess, rings: Annuli, radius: Map) -> Map:
    """Both maps weighted by the inverse of their variances, `(y, x)`.

    Variances are those of `excess_variance`, sigma_WL^2 + <b^2> and the excess, as functions of the radius;
    where strong lensing shows no excess it gets all the weight. They are those of the aligned map: an error
    of the lambda that corrected `kappa_corr` is not in the weights.

    Args:
        kappa_corr, kappa_sl: maps smoothed alike, `(y, x)`.
        excess: from `excess_variance`.
        rings: its annuli.
        radius: of the pixels, unit of the annuli, `(y, x)`.
    """
    wl, sl = to_pixels(excess.wl, rings, radius), to_pixels(excess.sl, rings, radius)
    total = wl + sl
    share = jnp.where(total > 0.0, sl / jnp.where(total > 0.0, total, 1.0), 0.5)
    return share * kappa_corr + (1.0 - share) * kappa_sl
