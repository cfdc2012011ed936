"""Errors of lambda_rec: each ingredient drawn alone and with the others."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import mass_sheet, radial, transition
from jaxlens._types import Array, Map
from jaxlens.maps_real import Inversion

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


def statistics(wl: Array, sl: Array, rings: radial.Annuli, inner: Array) -> tuple[Array, Array]:
    """Median lambda_rec in annuli `(n, b)` and in the inner range `(n,)` of maps `(n, y, x)`."""

    def one(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        lam = mass_sheet.ratio(pair[0], pair[1])
        profile = radial.profile_in(lam.lam, rings, lam.weight)
        middle = radial.quantiles(lam.lam.ravel(), (inner * lam.weight).ravel(), jnp.array([0.5]))[0]
        return profile.median, middle

    return jax.lax.map(one, (wl, sl))


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
    """Transition radius of every pair of maps `(n, y, x)`, their sectors resampled; NaN without one."""
    s = rings.n_sectors

    def one(x: tuple[Array, Array, Array]) -> Array:
        key, wl, sl = x
        lam = mass_sheet.ratio(wl, sl)
        middle = radial.quantiles(lam.lam.ravel(), (inner * lam.weight).ravel(), jnp.array([0.5]))[0]
        found = transition.moments(mass_sheet.regauge(wl, middle), sl, rings, bias)
        often = jnp.bincount(jax.random.randint(key, (s,), 0, s), length=s).astype(wl.dtype)
        found = transition.Moments(found.total * often[None, :], found.count * often[None, :])
        excess = transition.excess_variance(key, found, rings, sigma2 / middle**2, bias, n=1)
        made = excess.transition
        return jnp.where(made.found, made.radius, jnp.nan)

    return jax.lax.map(one, (keys, wl, sl))


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
    """lambda_rec for draws of one ingredient after the other, then of all; pairs are (best, draws)."""
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
            radius = np.asarray(radii(jax.random.split(key, n), wl, sl, rings, inner, sigma2, bias))
        else:
            lam, one = statistics(wl, sl, rings, inner)
            profile[source], middle[source] = np.asarray(lam), np.asarray(one)
    return Budget(profile, middle, radius)
