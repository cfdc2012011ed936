"""Errors of lambda_rec: each ingredient drawn alone and with the others."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import mass_sheet, radial, transition
from jaxlens._types import Array, Map
from jaxlens.maps_real import STAY, Inversion

SOURCES = ("shape noise", "photometric redshifts", "strong lensing", "calibration", "together")
"""Sources of error, each by itself and all at once."""


@dataclass(frozen=True)
class Budget:
    """lambda_rec when the ingredients are drawn anew.

    Attributes:
        profile: medians in the annuli by source of error, `(n, b)` each.
        inner: medians of the inner range by source, `(n,)` each.
        radius: transition with everything but shape noise drawn, and sectors resampled, `(n,)`, kpc/h; NaN
            where there is none.
    """

    profile: dict[str, np.ndarray]
    inner: dict[str, np.ndarray]
    radius: np.ndarray

    @property
    def share(self) -> float:
        """Share of the draws that have a transition."""
        return float(np.isfinite(self.radius).mean())

    @property
    def interval(self) -> tuple[float, float] | None:
        """16 and 84 % of the radii of those."""
        found = self.radius[np.isfinite(self.radius)]
        if not len(found):
            return None
        low, high = np.percentile(found, [15.87, 84.13])
        return float(low), float(high)

    def error(self, source: str) -> np.ndarray:
        """Half the width that holds 68 % of the draws in each annulus, `(b,)`."""
        low, high = np.percentile(self.profile[source], [15.87, 84.13], axis=0)
        return 0.5 * (high - low)

    def inner_interval(self, source: str = "together") -> tuple[float, float]:
        """16 and 84 % of lambda of the inner range."""
        low, high = np.percentile(self.inner[source], [15.87, 84.13])
        return float(low), float(high)


@eqx.filter_jit
def statistics(wl: Array, sl: Array, rings: radial.Annuli, inner: Array) -> tuple[Array, Array]:
    """Median lambda_rec in annuli `(n, b)` and in the inner range `(n,)` of maps `(n, y, x)`."""

    def one(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        lam = mass_sheet.ratio(pair[0], pair[1])
        return radial.profile_in(lam.lam, rings, lam.weight).median, mass_sheet.median(*pair, inner)

    return jax.lax.map(one, (wl, sl))


@eqx.filter_jit
def aligned_variance(noisy: Array, clean: Map, sl: Map, rings: radial.Annuli, inner: Array) -> Array:
    """Variance of the noise in the annuli once each map has lost its own mass sheet, `(b,)`.

    A map takes part of its noise for its sheet, so that this is smaller than that of the map in the inner
    range and larger far outside of it. Times lambda^2 of the map without noise, as `excess_of` wants it.

    Args:
        noisy: reconstructions with noise, `(n, y, x)`.
        clean: the same without, `(y, x)`.
        sl: convergence that is compared, `(y, x)`.
        rings: annuli.
        inner: 1 in pixels of the inner range, `(y, x)`.
    """
    lam = mass_sheet.median(clean, sl, inner)
    best = mass_sheet.regauge(clean, lam)
    square = lambda kappa: radial.mean_in(
        (mass_sheet.regauge(kappa, mass_sheet.median(kappa, sl, inner)) - best) ** 2, rings
    )
    return lam**2 * jnp.mean(jax.lax.map(square, noisy), axis=0)


def excess_of(
    wl: Map, sl: Map, rings: radial.Annuli, inner: Array, sigma2: Array, bias: Map, often: Array | None = None
) -> transition.Excess:
    """Excess variance of one pair of maps, corrected by the median lambda of the inner range.

    Args:
        wl, sl: convergence for the same sources, smoothed alike, `(y, x)`.
        rings: annuli.
        inner: 1 in pixels of the inner range, `(y, x)`.
        sigma2: variance of the noise of `wl` in the annuli, from `aligned_variance`, `(b,)`.
        bias: error of the method, `(y, x)`.
        often: how often each sector counts, `(s,)`; once if None.
    """
    middle = mass_sheet.median(wl, sl, inner)
    found = transition.moments(mass_sheet.regauge(wl, middle), sl, rings, bias)
    if often is not None:
        found = transition.Moments(found.total * often[None, :], found.count * often[None, :])
    # The key is that of a bootstrap whose one sample is not used.
    return transition.excess_variance(
        jax.random.key(0), found, rings, sigma2 / middle**2, bias, stay=STAY, n=1
    )


@eqx.filter_jit
def radii(
    keys: Array,
    wl: Array,
    sl: Array,
    rings: radial.Annuli,
    inner: Array,
    sigma2: Array,
    bias: Map,
) -> Array:
    """Transition radius of every pair of maps `(n, y, x)`, their sectors resampled; NaN without one.

    The variance of the noise is that of each map, `(n, b)`: ellipticities divided by a smaller calibration
    are noisier.
    """
    s = rings.n_sectors

    def one(x: tuple[Array, Array, Array, Array]) -> Array:
        key, wl, sl, variance = x
        often = jnp.bincount(jax.random.randint(key, (s,), 0, s), length=s).astype(wl.dtype)
        made = excess_of(wl, sl, rings, inner, variance, bias, often).transition
        return jnp.where(made.found, made.radius, jnp.nan)

    return jax.lax.map(one, (keys, wl, sl, sigma2))


def budget_of(
    key: Array,
    invert: Inversion,
    observed: Array,
    nulls: Array,
    ratio: tuple[float, Array],
    factors: Array,
    calibration: tuple[float, Array],
    smooth: tuple[Array, Array],
    rings: radial.Annuli,
    inner: Array,
    sigma2: Array,
    bias: Map,
) -> Budget:
    """lambda_rec for draws of one ingredient after the other, then of all; pairs are (best, draws).

    Args:
        key: of the sectors that are resampled.
        invert: the reconstruction.
        observed: reduced shear before calibration, `(y, x)`.
        nulls: shape noise to be added to it, `(n, y, x)`.
        ratio: D_LS/D_S of the map.
        factors: on the ellipticities, for the draws of D_LS/D_S, `(n,)`.
        calibration: by which ellipticities are divided.
        smooth: smoothed convergence of the lens for D_LS/D_S = 1, `(y, x)` and `(n, y, x)`.
        rings: annuli.
        inner: 1 in pixels of the inner range, `(y, x)`.
        sigma2: variance of the noise of the map with the best calibration, from `aligned_variance`, `(b,)`.
        bias: error of the method for the best lens, `(y, x)`; that of the draws differs little.
    """
    n = len(nulls)
    profile, middle = {}, {}
    radius = np.zeros(0)
    for source in (*SOURCES, "transition"):
        drawn = lambda name, source=source: (
            source in (name, "together") or (source == "transition" and name != SOURCES[0])
        )
        noise = nulls if drawn(SOURCES[0]) else jnp.zeros_like(nulls)
        depth = drawn(SOURCES[1])
        factor, b = (factors, ratio[1]) if depth else (jnp.ones(n), jnp.full(n, ratio[0]))
        lens = smooth[1] if drawn(SOURCES[2]) else jnp.broadcast_to(smooth[0], (n, *smooth[0].shape))
        m = calibration[1] if drawn(SOURCES[3]) else jnp.full(n, calibration[0])
        each = lambda values: values[:, None, None]
        wl = invert.many((observed[None] + noise) * each(factor / m))
        sl = each(b) * lens
        if source == "transition":
            # The noise of the map scales with what its ellipticities were multiplied by.
            variance = sigma2[None] * (factor * calibration[0] / m)[:, None] ** 2
            radius = np.asarray(radii(jax.random.split(key, n), wl, sl, rings, inner, variance, bias))
        else:
            lam, one = statistics(wl, sl, rings, inner)
            profile[source], middle[source] = np.asarray(lam), np.asarray(one)
    return Budget(profile, middle, radius)
