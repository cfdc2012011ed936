"""What a population says, as a page."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import reproduce
from jaxlens.report import Figure, Page, Section, Table, html

CAPTIONS = {
    "shares": "Share of the clusters in which each statement holds, with its binomial error.",
    "transition": "Transition radius found by the excess variance of the mean map, with its interval, and "
    "radius at which the shape errors of both maps are equal, against properties of the clusters.",
    "lambda_bias": "Bias of lambda_P at 100-300 kpc/h against the mass sheet of the strong-lensing map "
    "itself: an error proportional to 1 - kappa is absorbed and cannot be seen in lambda.",
    "success": "Share of single noise maps in which a transition is found, and share of their intervals that "
    "hold the transition of the mean map.",
    "profiles": "lambda_rec(r) of every cluster over the true value.",
}
"""Of the figures."""


def _share(hits: int, n: int) -> str:
    """A share with its binomial error."""
    if not n:
        return "no cluster"
    p = (hits + 1.0) / (n + 2.0)
    return f"{hits} of {n}: {hits / n:.2f} +- {math.sqrt(p * (1.0 - p) / n):.2f}"


def facts(columns: Mapping[str, np.ndarray]) -> dict[str, str]:
    """What the table says about the transition and lambda_P, in words.

    Args:
        columns: from `columns`.
    """
    good = columns["failed"] == ""
    pick = lambda name: np.asarray(columns[name])[good]
    crossing, found = pick("shape_crossing_kpc_h"), pick("transition_kpc_h")
    both = np.isfinite(crossing)
    near = both & (np.abs(found - crossing) < 75.0)
    bias = pick("lambda_rec") / pick("lambda_true") - 1.0
    expected = 1.0 / pick("lambda_sl") - 1.0
    line = lambda values: (
        f"median {np.nanmedian(values):.3f}, 16-84 % "
        + " to ".join(f"{one:.3f}" for one in np.nanpercentile(values, [16.0, 84.0]))
    )
    if not good.any():
        return {"clusters": "all failed"}
    together = np.isfinite(bias) & np.isfinite(expected)
    said = {
        "clusters with a crossing of the shape errors": _share(int(both.sum()), int(good.sum())),
        "transition of the mean map within 75 kpc/h of it": _share(int(near.sum()), int(both.sum())),
        "transition found without a crossing": _share(
            int((~both & np.isfinite(found)).sum()), int((~both).sum())
        ),
        "lambda_P within 1 %": _share(int((np.abs(bias) < 0.01).sum()), int(good.sum())),
        "bias of lambda_P": line(bias),
        "share of single maps with a transition": line(pick("transition_share_found")),
    }
    if np.isfinite(pick("transition_interval_holds_mean")).any():
        said["intervals that hold the transition of the mean map"] = line(
            pick("transition_interval_holds_mean")
        )
    if together.sum() > 2:
        rest = bias[together] - expected[together]
        said["bias of lambda_P beyond the strong-lensing map's own mass sheet"] = line(rest)
    return said


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
    content = {"made_with": made_with, "clusters": rows, "statements": reproduce.tally(rows)}
    laws = [(name, str(value)) for name, value in made_with["laws"].items()]
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
                Section("laws", "What was drawn", [Table(("number", "law"), laws)]),
            ),
        )
    )
