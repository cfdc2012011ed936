"""Two convergence maps of one cluster, weak and strong lensing, compared as lambda(r)."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import mass_sheet, radial, transition
from jaxlens._types import Array
from jaxlens.transition import FEWEST
from jaxlens.workflow_lambda import Options, Pair

_distribution = eqx.filter_jit(mass_sheet.distribution)
_bootstrap = eqx.filter_jit(mass_sheet.bootstrap)
# Compiled once for all pairs of maps of one shape.


@dataclass(frozen=True)
class Outcome:
    """What the comparison of two maps says.

    Attributes:
        pair: the maps.
        options: how.
        rings: annuli, kpc/h.
        lam: lambda_rec.
        inner, outer, everything: distribution of lambda_rec in the inner range, beyond it, and in both.
        inner_error, outer_error, everything_error: its errors by a block bootstrap.
        kappa_corr: corrected by the median of the inner range, `(y, x)`.
        excess: excess variance, or None without a noise map.
        scatter: the paper's criterion on this one map.
        kappa_both: combined map, or None.
        external: which probe is better, or None without an external lambda or a noise map.
        shape, errors: against the truth, or None.
    """

    pair: Pair
    options: Options
    rings: radial.Annuli
    lam: mass_sheet.Factor
    inner: mass_sheet.Distribution
    outer: mass_sheet.Distribution
    everything: mass_sheet.Distribution
    inner_error: mass_sheet.Distribution
    outer_error: mass_sheet.Distribution
    everything_error: mass_sheet.Distribution
    kappa_corr: np.ndarray
    excess: transition.Excess | None
    scatter: transition.ScatterMinimum
    kappa_both: np.ndarray | None
    external: transition.External | None
    shape: transition.ShapeErrors | None
    errors: transition.MapErrors | None

    @property
    def radius(self) -> np.ndarray:
        """Distance of the pixels from the centre, `(y, x)`, kpc/h."""
        return radius_of(self.pair, self.options)

    def within(self, low: float, high: float) -> np.ndarray:
        """Weight of lambda_rec in a range of radii, `(y, x)`."""
        inside = (self.radius >= low) & (self.radius < high)
        return np.where(inside, np.asarray(self.lam.weight), 0.0)


def position_of(pair: Pair, options: Options) -> np.ndarray:
    """Pixels relative to the centre, `(y, x, 2)`, kpc/h."""
    scale = float(pair.plane.kpc_per_arcsec) * options.h
    return (np.asarray(pair.grid.theta) - np.array([options.x, options.y])) * scale


def radius_of(pair: Pair, options: Options) -> np.ndarray:
    """Distance from the centre, `(y, x)`, kpc/h."""
    return np.hypot(*np.moveaxis(position_of(pair, options), -1, 0))


def derive(
    pair: Pair, options: Options, bias: np.ndarray | None = None, sigma2: Array | None = None
) -> Outcome:
    """Compare two maps: lambda_rec, its distributions and profile, transition, corrected and combined map.

    Args:
        pair: the maps.
        options: how.
        bias: error of the weak-lensing method, `(y, x)`, see `transition.moments`; 0 if None.
        sigma2: variance of the noise in the annuli of `rings_of`, `(b,)`; None takes that of `pair.sigma`,
            which holds the part that a map takes for its mass sheet as well.

    Raises:
        ValueError: if too few annuli, see `rings_of`, or too few pixels of the inner range, are known in
            both maps.
    """
    radius = radius_of(pair, options)
    wl, sl = jnp.asarray(pair.kappa_wl), jnp.asarray(pair.kappa_sl)
    lam = _lambda(pair)
    rings = rings_of(pair, options)
    keys = jax.random.split(jax.random.key(options.seed), 5)
    ends = np.asarray(rings.edges)
    ranges = (options.inner, (options.inner[1], float(ends[-1])), (options.inner[0], float(ends[-1])))
    found, wrong = [], []
    for key, (low, high) in zip(keys[:3], ranges, strict=True):
        inside = jnp.where((radius >= low) & (radius < high), lam.weight, 0.0)
        if int((inside > 0.0).sum()) < FEWEST:
            raise ValueError(
                f"Only {int((inside > 0.0).sum())} pixels between {low:g} and {high:g} kpc/h are known in "
                f"both maps ({FEWEST} are needed); check the centre (--x, --y) and the mask, or give "
                "another --inner."
            )
        found.append(_distribution(lam.lam, inside))
        wrong.append(_bootstrap(key, lam.lam, inside, pair.grid, n=options.bootstrap))
    corrected = mass_sheet.regauge(wl, found[0].median)
    scatter = transition.scatter_minimum(
        rings.r, radial.scatter(radial.profile_in(lam.lam, rings, lam.weight))
    )
    excess = both = external = shape = errors = None
    if pair.sigma is not None:
        if sigma2 is None:
            sigma2 = radial.mean_in(jnp.asarray(pair.sigma) ** 2, rings)
        off = None if bias is None else jnp.asarray(bias)
        middle = transition.sheet_between(wl, sl, rings) if options.sheet == "all" else found[0].median
        clean = transition.moments(mass_sheet.regauge(wl, middle), sl, rings, off)
        excess = transition.excess_variance(
            keys[3], clean, rings, sigma2 / middle**2, off, stay=options.stay, n=500
        )
        both = np.asarray(transition.combined(corrected, sl, excess, rings, jnp.asarray(radius)))
        if options.lam is not None and options.lam_error is not None:
            external = transition.with_external(
                keys[4], wl, sl, rings, options.lam, options.lam_error, sigma2 / options.lam**2
            )
    if pair.kappa_true is not None:
        true = jnp.asarray(pair.kappa_true)
        shape = transition.shape_errors(wl, sl, true, rings)
        errors = transition.map_errors(corrected, sl, true, rings)
    (inner, outer, everything), (inner_error, outer_error, everything_error) = found, wrong
    return Outcome(
        pair=pair,
        options=options,
        rings=rings,
        lam=lam,
        inner=inner,
        outer=outer,
        everything=everything,
        inner_error=inner_error,
        outer_error=outer_error,
        everything_error=everything_error,
        kappa_corr=np.asarray(corrected),
        excess=excess,
        scatter=scatter,
        kappa_both=both,
        external=external,
        shape=shape,
        errors=errors,
    )


def rings_of(pair: Pair, options: Options) -> radial.Annuli:
    """The longest run of annuli that hold enough pixels; a mask near the centre may leave a gap.

    Raises:
        ValueError: if there are fewer than `options.stay` and one more.
    """
    position = position_of(pair, options)
    weight = np.asarray(_lambda(pair).weight)
    n = round((options.r_max - options.r_min) / options.width)
    edges = options.r_min + options.width * np.arange(max(n, 1) + 1)
    count = np.asarray(radial.annuli(position, edges, weight=weight).count)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], count >= FEWEST, [False]])))
    runs = ends.reshape(-1, 2) if len(ends) else np.zeros((1, 2), int)
    first, last = (int(end) for end in runs[np.argmax(runs[:, 1] - runs[:, 0])])
    if last - first < options.stay + 1:
        raise ValueError(
            f"{pair.name}: only {last - first} annuli of {options.width:g} kpc/h hold {FEWEST} pixels "
            f"known in both maps ({options.stay + 1} are needed); check the centre (--x, --y) and the "
            "mask, or give another --width."
        )
    return radial.annuli(position, edges[first : last + 1], weight=weight)


def _lambda(pair: Pair) -> mass_sheet.Factor:
    return mass_sheet.ratio(*(jnp.asarray(part) for part in (pair.kappa_wl, pair.kappa_sl, pair.weight)))
