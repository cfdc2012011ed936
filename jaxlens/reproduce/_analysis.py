"""What a cluster's Monte Carlo says: profiles, transitions, and the number behind every statement."""

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import mass_sheet, radial, transition
from jaxlens._types import Array, Map, RandomKey
from jaxlens.reproduce._cluster import BOOTSTRAP, FIRST, ClusterRun, Variant, key_of
from jaxlens.reproduce._statements import Measured
from jaxlens.transition import Excess

GROUP = 30
"""Realisations whose mean is one sharper map, see `transition.excess_variance`."""

NEAR = 75.0
"""A transition this close to the crossing of the shape errors counts as right, kpc/h."""

WIDTH = 50.0
"""Of the annuli, kpc/h."""


@dataclass(frozen=True)
class Errors:
    """Errors of both probes in annuli, `(b,)` each, root mean squares over realisations.

    Attributes:
        wl, sl: against the truth, weak lensing corrected by lambda_P.
        shape_wl, shape_sl: with both maps regauged to the truth.
        crossings, shape_crossings: radii of equal errors, kpc/h, and direction (+1: from strong to weak); the
            second in all annuli, those of the excess variance, with which it is compared.
        lasting: what the rule of the excess variance makes of the true ratio (shape_sl/shape_wl)^2.
        spread: standard error of the first shape crossing from strong to weak, kpc/h; NaN without one.
    """

    wl: np.ndarray
    sl: np.ndarray
    shape_wl: np.ndarray
    shape_sl: np.ndarray
    crossings: list[tuple[float, int]]
    shape_crossings: list[tuple[float, int]]
    spread: float
    lasting: transition.Transition

    @property
    def first(self) -> float:
        """First shape crossing from strong to weak lensing, kpc/h; NaN without one."""
        return next((r for r, way in self.shape_crossings if way > 0), math.nan)


@dataclass(frozen=True)
class ExcessOutcome:
    """The excess-variance transition of one variant.

    Attributes:
        mean: on the mean over all realisations.
        radius: of each realisation, `(n,)`, kpc/h; NaN where none was found.
        inside: where weak lensing is better all over instead, `(n,)`, see `transition.Transition`.
        lo, hi: ends of its interval, `(n,)`.
        groups, groups_inside: the same of the means of `GROUP` realisations, `(g,)`.
        q_groups: their ratios in the annuli, `(g, b)`.
    """

    mean: Excess
    radius: np.ndarray
    inside: np.ndarray
    lo: np.ndarray
    hi: np.ndarray
    groups: np.ndarray
    groups_inside: np.ndarray
    q_groups: np.ndarray

    @property
    def mean_radius(self) -> float:
        """Radius on the mean, kpc/h; NaN if not found."""
        found = self.mean.transition
        return float(found.radius) if bool(found.found) else math.nan

    @property
    def share(self) -> float:
        """Share of the realisations with a transition."""
        return float(np.isfinite(self.radius).mean())

    def near(self, radius: float) -> float:
        """Share of the realisations with a transition within `NEAR` of a radius in kpc/h; NaN without one."""
        return float((np.abs(self.radius - radius) < NEAR).mean()) if math.isfinite(radius) else math.nan

    def covers(self, radius: float) -> float:
        """Share of the intervals, of realisations with a transition, that hold a radius in kpc/h; or NaN."""
        found = np.isfinite(self.radius)
        if not (found.any() and math.isfinite(radius)):
            return math.nan
        return float(((self.lo <= radius) & (radius <= self.hi))[found].mean())

    @property
    def coverage(self) -> float:
        """`covers` the radius on the mean."""
        return self.covers(self.mean_radius)


def mean_and_error(values: np.ndarray) -> Measured:
    """Mean over realisations and its standard error."""
    return Measured(float(np.mean(values)), float(np.std(values, ddof=1) / math.sqrt(len(values))))


def quotient(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """above/below; without a warning NaN where an annulus has no pixel, and both are 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return above / below


def scatter_of(variant: Variant) -> np.ndarray:
    """Scatter of lambda_rec of every good realisation in every annulus, `(n, b)`."""
    return np.asarray(radial.scatter(variant.noisy.good.rec_profile))


def null_scatter(variant: Variant) -> np.ndarray:
    """The same of lambda_map: what a perfect strong-lensing map would give, `(n, b)`."""
    return np.asarray(radial.scatter(variant.noisy.good.a2_profile))


def _crossings(r: np.ndarray, sl: np.ndarray, wl: np.ndarray) -> list[tuple[float, int]]:
    found = transition.crossings(jnp.asarray(r), jnp.asarray(sl), jnp.asarray(wl))
    pairs = zip(np.asarray(found.radius), np.asarray(found.direction), strict=True)
    return [(float(at), int(way)) for at, way in pairs if way]


def errors(found: ClusterRun, variant: Variant) -> Errors:
    """Errors of both probes from 100 kpc/h outwards; crossings of the shape errors from the first annulus."""
    setup, good = variant.setup, variant.noisy.good
    r, true = found.r[FIRST:], setup.kappa_true
    shapes = transition.shape_errors(setup.clean["A2"], setup.kappa_sl, true, setup.rings)
    sl = np.asarray(radial.rmse_in(setup.kappa_sl - true, setup.rings))[FIRST:]
    shape_sl = np.asarray(shapes.sl)
    rms = lambda many: np.sqrt(np.mean(np.asarray(many) ** 2, axis=0))
    each = np.asarray(good.shape)
    rng = np.random.default_rng(0)
    again = [rms(each[rng.integers(len(each), size=len(each))]) for _ in range(200)]
    first = lambda one: next((at for at, way in _crossings(found.r, shape_sl, one) if way > 0), math.nan)
    radii = [first(one) for one in again]
    known = np.array([one for one in radii if math.isfinite(one)])
    wl, shape_wl = rms(good.rmse)[FIRST:], rms(each)
    return Errors(
        wl,
        sl,
        shape_wl[FIRST:],
        shape_sl[FIRST:],
        _crossings(r, sl, wl),
        _crossings(found.r, shape_sl, shape_wl),
        float(known.std(ddof=1)) if len(known) > len(radii) // 2 else math.nan,
        _lasting(setup.rings, shape_sl, shape_wl),
    )


def _lasting(rings: radial.Annuli, sl: np.ndarray, wl: np.ndarray) -> transition.Transition:
    """The rule of the excess variance on the true errors, not smoothed."""
    ratio = transition.hold_ends(jnp.asarray(quotient(sl, wl) ** 2), rings.count >= transition.FEWEST)
    return transition.first_rise(rings.r, ratio)


@eqx.filter_jit
def _excess_of(
    key: RandomKey, many: transition.Moments, rings: radial.Annuli, sigma2: Array, bias: Map
) -> Excess:
    """The excess variance of each of the leading axis of `many`."""

    def one(given: tuple[Array, transition.Moments]) -> Excess:
        number, moments = given
        return transition.excess_variance(jax.random.fold_in(key, number), moments, rings, sigma2, bias)

    return jax.lax.map(one, (jnp.arange(len(many.total)), many))


def excess(found: ClusterRun, variant: Variant) -> ExcessOutcome:
    """The excess-variance transition: on the mean, on every realisation, on means of 30."""
    setup, good = variant.setup, variant.noisy.good
    count = len(np.asarray(good.good))
    groups = count // GROUP
    means = jax.tree.map(
        lambda a: jnp.concatenate(
            [a, a[: groups * GROUP].reshape(groups, GROUP, *a.shape[1:]).mean(axis=1), a.mean(axis=0)[None]]
        ),
        good.moments,
    )
    each = _excess_of(key_of(found.seed, BOOTSTRAP), means, setup.rings, variant.noisy.sigma_wl2, setup.bias)
    radius = np.where(np.asarray(each.transition.found), np.asarray(each.transition.radius), np.nan)
    inside = np.asarray(each.transition.inside)
    return ExcessOutcome(
        mean=jax.tree.map(lambda a: a[-1], each),
        radius=radius[:count],
        inside=inside[:count],
        lo=np.asarray(each.lo)[:count],
        hi=np.asarray(each.hi)[:count],
        groups=radius[count:-1],
        groups_inside=inside[count:-1],
        q_groups=np.asarray(each.q)[count:-1],
    )


@eqx.filter_jit
def _combined_squares(
    maps: Array, lams: Array, sl: Map, true: Map, mean: Excess, rings: radial.Annuli, radius: Map
) -> tuple[Array, Array]:
    """Mean square error of the combined and of the weak-lensing map of each realisation, `(n, b)` each."""

    def one(given: tuple[Map, Array]) -> tuple[Array, Array]:
        corrected = mass_sheet.regauge(*given)
        both = transition.combined(corrected, sl, mean, rings, radius)
        square = lambda m: radial.mean_in((m - true) ** 2, rings)
        return square(both), square(corrected)

    return jax.lax.map(one, (maps, lams))


def combined_rmse(found: ClusterRun, outcome: ExcessOutcome, *, true_lambda: bool) -> dict[str, np.ndarray]:
    """RMSE of the combined map and of either probe in annuli from 100 kpc/h, over all realisations.

    Args:
        found: the cluster.
        outcome: its excess variance, which sets the weights.
        true_lambda: correct the weak-lensing maps by the lambda of the noiseless map instead of lambda_P.

    Returns:
        `combined`, `wl`, `sl`, `(b,)` each, and `error`, that of the ratio of `combined` to the better probe.
    """
    base = found.base
    setup, good = base.setup, np.asarray(base.noisy.measured.good)
    lams = jnp.asarray(base.noisy.measured.lam)
    if true_lambda:
        lams = jnp.full_like(lams, base.clean.a2.median[-1])
    maps = (setup.kappa_sl, setup.kappa_true)
    squares = _combined_squares(found.a2, lams, *maps, outcome.mean, setup.rings, setup.radius)
    both, wl = (np.asarray(a)[good][:, FIRST:] for a in squares)
    sl = np.asarray(radial.mean_in((setup.kappa_sl - setup.kappa_true) ** 2, setup.rings))[FIRST:]
    mean, mean_wl = both.mean(axis=0), wl.mean(axis=0)
    ratio = np.sqrt(quotient(mean, np.minimum(mean_wl, sl)))
    spread = both.std(axis=0, ddof=1) / math.sqrt(len(both))
    return {
        "combined": np.sqrt(mean),
        "wl": np.sqrt(mean_wl),
        "sl": np.sqrt(sl),
        "ratio": ratio,
        "error": 0.5 * ratio * quotient(spread, mean),
    }


def decomposition(found: ClusterRun) -> dict[str, np.ndarray]:
    """Both factors of lambda_rec in annuli from 100 kpc/h: scatter of the first, size of the second."""
    setup = found.base.setup
    second = mass_sheet.ratio(setup.kappa_true, setup.kappa_sl, setup.weight)
    profile = radial.profile_in(second.lam, setup.rings, second.weight)
    return {
        "first_scatter": null_scatter(found.base).mean(axis=0)[FIRST:],
        "first_median": np.asarray(found.base.noisy.good.a2_profile.median).mean(axis=0)[FIRST:],
        "second_median": np.asarray(profile.median)[FIRST:],
        "second_lo": np.asarray(profile.lo)[FIRST:],
        "second_hi": np.asarray(profile.hi)[FIRST:],
    }


def lambda_errors(found: ClusterRun) -> dict[str, np.ndarray]:
    """Error of lambda from each annulus alone, in units of the true value: scatter, bias, both."""
    true = float(found.base.clean.a2.median[-1])
    each = np.asarray(found.base.noisy.good.rec_profile.median)[:, FIRST:] / true - 1.0
    spread, bias = each.std(axis=0, ddof=1), each.mean(axis=0)
    return {"scatter": spread, "bias": bias, "total": np.hypot(spread, bias)}


@dataclass(frozen=True)
class Analysis:
    """Everything that figures, tables and statements need of a cluster beside its run.

    Attributes:
        errors: of both probes, `rectangle`.
        excess: transition of `rectangle`, and of `perfect` if it was run.
        criterion: the paper's criterion with its null.
        combined, combined_true: RMSE of the combined map with lambda_P, and with the true lambda.
        decomposition, lambda_errors: see the functions of these names.
    """

    errors: Errors
    excess: dict[str, ExcessOutcome]
    criterion: transition.ScatterCriterion
    combined: dict[str, np.ndarray]
    combined_true: dict[str, np.ndarray]
    decomposition: dict[str, np.ndarray]
    lambda_errors: dict[str, np.ndarray]


def analyse(found: ClusterRun) -> Analysis:
    """Measure everything of a cluster."""
    r = jnp.asarray(found.r[FIRST:])
    wrong = errors(found, found.base)
    outcomes = {
        name: excess(found, found.variants[name])
        for name in ("rectangle", "field", "perfect")
        if name in found.variants
    }
    criterion = transition.scatter_criterion(
        r,
        jnp.asarray(scatter_of(found.base)[:, FIRST:]),
        jnp.asarray(null_scatter(found.base)[:, FIRST:]),
    )
    main = outcomes["rectangle"]
    return Analysis(
        errors=wrong,
        excess=outcomes,
        criterion=criterion,
        combined=combined_rmse(found, main, true_lambda=False),
        combined_true=combined_rmse(found, main, true_lambda=True),
        decomposition=decomposition(found),
        lambda_errors=lambda_errors(found),
    )
