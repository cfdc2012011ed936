"""What a population says, as a page."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import reproduce
from jaxlens.population._table import applicable
from jaxlens.report import Figure, Page, Section, Table, html
from jaxlens.reproduce import NEAR

Rate = tuple[np.ndarray, float, float]
"""Shares by cluster `(n,)`, their pooled value and its error."""

CAPTIONS = {
    "shares": "Share of the clusters in which each statement holds, with its binomial error; clusters "
    "without a crossing are left out of statements about one.",
    "transition": "Transition radius found by the excess variance of the mean map, with its interval, and "
    "radius at which the shape errors of both maps are equal, against properties of the clusters.",
    "lambda_bias": "Bias of lambda_P at 100-300 kpc/h against the mass sheet of the strong-lensing map "
    "itself in that range: an error proportional to 1 - kappa is absorbed and cannot be seen in lambda. "
    "Filled: over the true median of that range, to be compared with the line; open: over that of "
    "100-700 kpc/h, the definition of the paper. Bars are the scatter of single maps, not the "
    "error of the mean.",
    "success": "Above: share of single noise maps in which a transition is found, by cluster, with and "
    "without a crossing of the shape errors, and within 75 kpc/h of it. Below: share of the "
    "intervals of these maps that hold the crossing and the transition of the mean map. Points: "
    "pooled over clusters (coverage weighted by the transitions found), with the error of a "
    "bootstrap over clusters. Dashed: what the interval promises.",
    "profiles": "lambda_rec(r) of every cluster, mean of single maps, over the true value at 100-700 kpc/h.",
}
"""Of the figures."""


def _share(hits: int, n: int) -> str:
    """A share with its binomial error."""
    if not n:
        return "no cluster"
    p = (hits + 1.0) / (n + 2.0)
    return f"{hits} of {n}: {hits / n:.2f} +- {math.sqrt(p * (1.0 - p) / n):.2f}"


def _line(values: np.ndarray) -> str:
    """Median and central 68 %."""
    if not np.isfinite(values).any():
        return "none"
    low, middle, high = np.nanpercentile(values, [16.0, 50.0, 84.0])
    return f"median {middle:.3f}, 16-84 % {low:.3f} to {high:.3f}"


def pooled(share: np.ndarray, weight: np.ndarray, *, samples: int = 1000) -> tuple[float, float]:
    """Weighted mean of shares and its error, by a bootstrap over clusters.

    Maps of one cluster are not independent of each other.

    Args:
        share: of each cluster, `(n,)`; NaN where it has none.
        weight: number of maps behind it, `(n,)`.
        samples: of the bootstrap.

    Returns:
        Both; NaN without a cluster of positive weight, the error NaN with a single one.
    """
    use = np.isfinite(share) & (weight > 0.0)
    hits, number = (share * weight)[use], weight[use]
    if not use.any():
        return math.nan, math.nan
    picked = np.random.default_rng(0).integers(len(hits), size=(samples, len(hits)))
    each = hits[picked].sum(axis=1) / number[picked].sum(axis=1)
    return float(hits.sum() / number.sum()), float(each.std(ddof=1)) if len(hits) > 1 else math.nan


def success_rates(columns: Mapping[str, np.ndarray]) -> tuple[dict[str, Rate], dict[str, Rate]]:
    """How often single maps have a transition, and how often its interval is right.

    Args:
        columns: from `columns`; failed clusters are left out.

    Returns:
        Shares of the maps in which one is found, by what was there to find; shares of the intervals, of maps
        in which one was found, that hold a radius.
    """
    good = columns["failed"] == ""
    pick = lambda name: np.asarray(columns[name])[good]
    crossing, share, count = (
        pick(name) for name in ("shape_crossing_kpc_h", "transition_share_found", "transitions_found")
    )
    there, even = np.isfinite(crossing), np.ones(len(crossing))
    rate = lambda values, weight, use: (values[use], *pooled(values[use], weight[use]))
    every = np.ones(len(crossing), bool)
    found = {
        "found, given a crossing": rate(share, even, there),
        f"within {NEAR:g} kpc/h of it, given a crossing": rate(
            pick("transition_share_near_crossing"), even, there
        ),
        "found, given no crossing": rate(share, even, ~there),
    }
    covered = {
        "interval holds the crossing": rate(pick("transition_interval_holds_crossing"), count, there),
        "interval holds that of the mean map": rate(pick("transition_interval_holds_mean"), count, every),
    }
    return found, covered


def facts(columns: Mapping[str, np.ndarray]) -> dict[str, str]:
    """What the table says about the transition and lambda_P, in words.

    Args:
        columns: from `columns`.
    """
    good = columns["failed"] == ""
    if not good.any():
        return {"clusters": "all failed"}
    pick = lambda name: np.asarray(columns[name])[good]
    count = int(good.sum())
    crossing, found = pick("shape_crossing_kpc_h"), pick("transition_kpc_h")
    both, has = np.isfinite(crossing), np.isfinite(found)
    lasting, all_over = pick("lasting_crossing_kpc_h"), pick("wl_better_all_over") == 1.0
    lasts = np.isfinite(lasting)
    near = both & (np.abs(found - crossing) < NEAR)
    bias = pick("lambda_rec") / pick("lambda_true") - 1.0
    rest = pick("lambda_rec") / pick("lambda_true_inner") - 1.0 / pick("lambda_sl")
    margin = pick("caustic_margin_arcsec")
    said = {
        "clusters with a crossing of the shape errors": _share(int(both.sum()), count),
        "mean map: transition found, given a crossing": _share(int((both & has).sum()), int(both.sum())),
        f"mean map: transition within {NEAR:g} kpc/h of it, given a crossing": _share(
            int(near.sum()), int(both.sum())
        ),
        "mean map: transition found, given no crossing": _share(int((~both & has).sum()), int((~both).sum())),
        f"mean map: transition within {NEAR:g} kpc/h of a crossing that lasts, given one": _share(
            int((lasts & (np.abs(found - lasting) < NEAR)).sum()), int(lasts.sum())
        ),
        "clusters in which weak lensing has the smaller shape error all over": _share(
            int(all_over.sum()), count
        ),
        "mean map: says so, given that": _share(
            int((all_over & (pick("transition_is_inside") == 1.0)).sum()), int(all_over.sum())
        ),
    }
    for part in success_rates(columns):
        for label, (values, value, error) in part.items():
            known = int(np.isfinite(values).sum())
            said[f"single maps: {label}"] = (
                f"{value:.2f} +- {error:.2f} ({known} clusters)" if known else "no cluster"
            )
    return said | {
        "mean lambda_P, a median, within 1 % of the true median (the statement takes peaks)": _share(
            int((np.abs(bias) < 0.01).sum()), count
        ),
        "bias of lambda_P(100-300 kpc/h) against the truth at 100-700 kpc/h, as in the paper": _line(bias),
        "bias against the truth at 100-300 kpc/h, beyond the strong-lensing map's own mass sheet": _line(
            rest
        ),
        "clusters whose main caustic leaves the box of the sources (systems are missed)": _share(
            int((margin < 0.0).sum()), count
        ),
        "clusters without a closed critical curve": _share(int(np.isnan(margin).sum()), count),
    }


def reasons(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Why clusters failed: reason (numbers as #), clusters and their first seeds; the most frequent first."""
    found: dict[str, list[int]] = {}
    for row in rows:
        if "failed" in row:
            found.setdefault(re.sub(r"\d[\d.]*(e[+-]?\d+)?", "#", row["failed"]), []).append(row["seed"])
    first = lambda seeds: ", ".join(map(str, seeds[:5])) + (", ..." if len(seeds) > 5 else "")
    ordered = sorted(found.items(), key=lambda one: (-len(one[1]), one[0]))
    return [(reason, str(len(seeds)), first(seeds)) for reason, seeds in ordered]


def page(
    rows: Sequence[Mapping[str, Any]],
    columns: Mapping[str, np.ndarray],
    made_with: Mapping[str, Any],
    pictures: Mapping[str, Path],
) -> str:
    """The report on a population as HTML.

    Args:
        rows: from `run`.
        columns: the table.
        made_with: version, realisations, laws.
        pictures: PNG files by key of `CAPTIONS`.
    """
    content = {"made_with": made_with, "clusters": rows, "statements": reproduce.tally(applicable(rows))}
    laws = [(name, str(value)) for name, value in made_with["laws"].items()]
    why = reasons(rows)
    failed = (
        [Table(("reason", "clusters", "seeds"), why, numeric=frozenset({1}))] if why else ["None failed."]
    )
    images = [Figure(key, path.read_bytes(), CAPTIONS[key]) for key, path in pictures.items()]
    return html(
        Page(
            title="lambda(r) over a population of clusters",
            lead="Each cluster is drawn, fitted and reconstructed from a seed of its own.",
            facts={
                "jaxlens": made_with["version"],
                "clusters": str(len(rows)),
                "realisations of each": str(made_with["realisations"]),
            },
            sections=(
                Section("summary", "In short", [Table(("quantity", "value"), list(facts(columns).items()))]),
                reproduce.section(content, "This run:"),
                Section("figures", "Figures", images),
                Section("failures", "Clusters that failed", failed),
                Section("laws", "What was drawn", [Table(("number", "law"), laws)]),
            ),
        )
    )
