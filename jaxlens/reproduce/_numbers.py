"""The number behind every statement, with its error."""

import math

import numpy as np

from jaxlens.reproduce import _analysis
from jaxlens.reproduce._analysis import NEAR, WIDTH, Analysis, mean_and_error
from jaxlens.reproduce._cluster import FIRST, ClusterRun
from jaxlens.reproduce._statements import Measured

INNER, OUTER = 0, -1
"""Ranges 100-300 and 100-700 kpc/h of `monte_carlo.RANGES`."""


def numbers(found: ClusterRun, made: Analysis) -> dict[str, Measured]:
    """What the run measured for the statements of this package; no crossing, no right radius."""
    return {**_distributions(found), **_profiles(found, made), **_variants(found)}


def own_numbers(made: Analysis) -> dict[str, Measured]:
    """What the run measured for the statements of this package; no crossing, no right radius."""
    result: dict[str, Measured] = {}
    if "perfect" in made.excess:
        perfect = made.excess["perfect"]
        none = ~np.isfinite(perfect.radius) & ~perfect.inside
        result["excess_null"] = _share(float(none.sum()), len(none))
    groups = made.excess["rectangle"].groups
    if math.isfinite(made.errors.first) and len(groups):
        near = np.abs(np.nan_to_num(groups, nan=math.inf) - made.errors.first) < NEAR
        result["excess_right"] = _share(float(near.sum()), len(near))
    ratio, error = made.combined_true["ratio"], made.combined_true["error"]
    worst = int(np.argmax(ratio - error))
    # At or below 1 within its error: the error is in the value, so that a ratio of exactly 1 passes.
    result["combined_with_true_lambda"] = Measured(float(ratio[worst] - error[worst]))
    return result


def _distributions(found: ClusterRun) -> dict[str, Measured]:
    clean, good = found.base.clean, found.base.noisy.good
    true = float(clean.a2.peak[OUTER])
    shift = {
        name: np.asarray(getattr(good, name).peak)[:, OUTER] - float(getattr(clean, name).peak[OUTER])
        for name in ("a2", "k2")
    }
    a2, k2 = mean_and_error(shift["a2"]), mean_and_error(shift["k2"])
    asymmetry = np.asarray(good.k2.asymmetry)[:, OUTER] - np.asarray(good.a2.asymmetry)[:, OUTER]
    bias = 100.0 * (np.asarray(good.rec.peak) / true - 1.0)
    inner, whole = bias[:, INNER], bias[:, OUTER]
    signed = np.sign(whole.mean()) * whole - np.sign(inner.mean()) * inner
    return {
        "a2_is_sharp": Measured(float(clean.k2.half_width[OUTER] / clean.a2.half_width[OUTER])),
        "k2_is_shifted": Measured(float(clean.k2.peak[OUTER] - clean.a2.peak[OUTER])),
        "a2_peak_stays": Measured(abs(a2.value), a2.error),
        "k2_peak_moves": k2,
        "k2_is_asymmetric": mean_and_error(asymmetry),
        "lambda_within_1_percent": mean_and_error(inner),
        "full_range_more_biased": mean_and_error(signed),
    }


def _share(hits: float, n: int) -> Measured:
    """A share with its binomial error; one more hit and miss keep the error above 0."""
    p = (hits + 1.0) / (n + 2.0)
    return Measured(hits / n, math.sqrt(p * (1.0 - p) / n))


def _profiles(found: ClusterRun, made: Analysis) -> dict[str, Measured]:
    r = found.r[FIRST:]
    n = int(np.asarray(found.base.noisy.measured.good).sum())
    criterion, wrong = made.criterion, made.errors
    minimum = float(criterion.minimum.radius) if bool(criterion.minimum.found) else math.nan
    fitted, null = (_share(float(one) * n, n) for one in (criterion.agreement, criterion.null_agreement))
    crossing = next((at for at, way in wrong.crossings if way > 0), math.nan)
    if math.isfinite(crossing):
        good = np.where(r < crossing, wrong.sl < wrong.wl, wrong.wl < wrong.sl)
        sides = _share(float(good.sum()), len(r))
    else:
        sides = Measured(0.0)
    total = made.lambda_errors["total"]
    best = float(r[int(np.argmin(total))])
    split = made.decomposition
    size = np.abs(split["second_median"] - 1.0)
    outside, before = r > 550.0, (r > 400.0) & (r < 550.0)
    scatter = _analysis.null_scatter(found.base)[:, FIRST:]
    first = scatter[:, outside].mean(axis=1) / scatter[:, before].mean()
    ratio, error = made.combined["ratio"], made.combined["error"]
    worst = int(np.argmax(ratio))
    half = 0.5 * WIDTH
    return {
        "scatter_has_minimum": _share(float(np.asarray(criterion.shares).sum()) * n, n),
        "minimum_means_transition": Measured(fitted.value - null.value, math.hypot(fitted.error, null.error)),
        "errors_cross_at_minimum": Measured(abs(wrong.first - minimum), math.hypot(half, wrong.spread)),
        "sl_inside_wl_outside": sides,
        "second_factor_outside": Measured(float(size[outside].mean() / size[~outside].max())),
        "first_factor_outside": mean_and_error(first),
        "tightest_where_comparable": Measured(abs(best - wrong.first), math.hypot(half, wrong.spread)),
        "combined_is_better": Measured(float(ratio[worst]), float(error[worst])),
    }


def largest_change(other: np.ndarray, base: np.ndarray, inside: np.ndarray) -> Measured:
    """Largest change of the mean scatter in the annuli `inside`, percent, and its standard error.

    Annuli without scatter hold one unmasked pixel at most (behind the mask of a heavy cluster, some do) and
    say nothing; NaN where no other is left.

    Args:
        other, base: scatter of every realisation in every annulus, `(n, b)`.
        inside: annuli that count, `(b,)`.
    """
    own = base.mean(axis=0)
    use, known = inside & (own > 0.0), np.where(own > 0.0, own, 1.0)
    if not use.any():
        return Measured(math.nan)
    change = 100.0 * (other.mean(axis=0) / known - 1.0)
    error = 100.0 * other.std(axis=0, ddof=1) / known / math.sqrt(len(other))
    worst = int(np.argmax(np.where(use, np.abs(change), -1.0)))
    return Measured(float(abs(change[worst])), float(error[worst]))


def _variants(found: ClusterRun) -> dict[str, Measured]:
    base = _analysis.scatter_of(found.base)
    result: dict[str, Measured] = {}
    if "no_depletion" in found.variants:
        other = _analysis.scatter_of(found.variants["no_depletion"])[:, FIRST]
        first = base[:, FIRST]
        result["inner_scatter_is_counts"] = mean_and_error(_analysis.quotient(first, other.mean()))
    if "mask" in found.variants:
        other = _analysis.scatter_of(found.variants["mask"])[:, FIRST:]
        result["mask_is_immaterial"] = largest_change(other, base[:, FIRST:], found.r[FIRST:] < 300.0)
    if "shear" in found.variants:
        total = {
            name: float(np.sqrt(np.mean(_analysis.errors(found, found.variants[name]).sl ** 2)))
            for name in ("rectangle", "shear")
        }
        result["external_shear_hurts"] = Measured(total["shear"] / total["rectangle"])
    return result
