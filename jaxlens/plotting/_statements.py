"""Statements over clusters, and sweeps of one number."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxlens.plotting._style import COLOURS, COLUMN, PAGE, array, figure, styled


@styled
def statement_shares(
    names: Sequence[str], held: Any, undecided: Any, failed: Any, error: Any, *, title: str = ""
) -> Figure:
    """Counts of clusters by verdict for each statement, with the binomial error of the share that holds.

    Args:
        names: of the statements.
        held, undecided, failed: clusters by verdict, `(k,)` each.
        error: of held over all, `(k,)`.
        title: above the figure.

    Returns:
        The figure, two columns wide.
    """
    parts = [array(part) for part in (held, undecided, failed)]
    total = np.maximum(sum(parts), 1.0)
    rows = np.arange(len(names))
    fig = figure(PAGE, 0.8 + 0.22 * len(names))
    ax = fig.add_subplot()
    left = np.zeros(len(names))
    labels = ("holds", "undecided", "does not hold")
    for part, colour, label, hatch in zip(
        parts, (COLOURS[2], "0.8", COLOURS[1]), labels, ("", "//", "xx"), strict=True
    ):
        ax.barh(rows, part / total, left=left, color=colour, label=label, hatch=hatch, ec="white", lw=0.4)
        left = left + part / total
    style: Any = {"fmt": "none", "ecolor": "black", "elinewidth": 0.9, "capsize": 2}
    ax.errorbar(parts[0] / total, rows, xerr=array(error), **style)
    ax.set_yticks(rows, [name.replace("_", " ") for name in names])
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("share of clusters")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.0 + 0.5 / (0.22 * len(names) + 0.8)), ncols=3)
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


@styled
def statement_values(
    values: Any,
    errors: Any,
    clusters: Sequence[str],
    *,
    claimed: tuple[float, float],
    x_label: str,
    title: str = "",
) -> Figure:
    """The number behind one statement in every cluster, beside the range that is claimed.

    Args:
        values, errors: of each cluster, `(n,)`; NaN where it was not measured.
        clusters: their names.
        claimed: (low, high), shaded; infinite for an open end.
        x_label: what the number is.
        title: above the figure.

    Returns:
        The figure, one column wide.
    """
    value, error = array(values), array(errors)
    rows = np.arange(len(value))
    fig = figure(COLUMN, 0.9 + 0.16 * max(len(value), 6))
    ax = fig.add_subplot()
    ax.errorbar(value, rows, xerr=error, fmt="o", color=COLOURS[0], ms=3.6, elinewidth=0.9, capsize=1.5)
    seen = np.concatenate([(value - error)[np.isfinite(value)], (value + error)[np.isfinite(value)]])
    ends = [end for end in claimed if np.isfinite(end)]
    low, high = np.min([*seen, *ends]), np.max([*seen, *ends])
    margin = 0.08 * (high - low) or 0.1
    ax.set_xlim(low - margin, high + margin)
    ax.axvspan(
        max(claimed[0], low - margin),
        min(claimed[1], high + margin),
        color=COLOURS[2],
        alpha=0.18,
        lw=0,
        label="claimed",
    )
    for row in rows[~np.isfinite(value)]:
        ax.annotate("not measured", (0.02, row), xycoords=("axes fraction", "data"), fontsize=7, va="center")
    ax.set_yticks(rows, clusters)
    ax.set_ylim(len(value) - 0.5, -0.5)
    ax.set_ylabel("seed")
    ax.set_xlabel(x_label)
    if title:
        ax.set_title(title)
    return fig


@styled
def sweep(
    rows: Sequence[Mapping[str, Any]], *, x_label: str, at: float | None = None, title: str = ""
) -> Figure:
    """Transition radius and error of lambda_P against one number of the simulation.

    Args:
        rows: from `reproduce.sweep`; those that failed are left out.
        x_label: the number.
        at: its value in the paper, marked.
        title: above the figure.

    Returns:
        The figure, one column wide.
    """
    known = [row for row in rows if "failed" not in row]
    column = lambda key: array([np.nan if row[key] is None else row[key] for row in known])
    x, r = column("value"), column("transition_kpc_h")
    fig = figure(COLUMN, 4.0)
    top, bottom = fig.subplots(2, 1, sharex=True)
    bars = np.stack([r - column("transition_lo_kpc_h"), column("transition_hi_kpc_h") - r])
    known_r = np.isfinite(r)
    top.errorbar(
        x[known_r],
        r[known_r],
        np.maximum(bars[:, known_r], 0.0),
        fmt="o",
        color=COLOURS[0],
        ms=4,
        capsize=1.5,
        label="excess variance, mean map",
    )
    crossing = column("shape_crossing_kpc_h")
    top.plot(x, crossing, "D", color=COLOURS[1], ms=4, mfc="none", label="equal shape errors")
    style: Any = {"xycoords": ("data", "axes fraction"), "rotation": 90, "fontsize": 7, "ha": "center"}
    for value in x[~known_r]:
        top.annotate("not found", (value, 0.03), **style)
    top.set_ylabel(r"transition radius [kpc $h^{-1}$]")
    bottom.plot(
        x, 100.0 * np.abs(column("lambda_bias")), "o-", color=COLOURS[0], ms=4, label="bias, absolute"
    )
    bottom.plot(
        x, 100.0 * column("lambda_scatter"), "D--", color=COLOURS[1], ms=4, label="scatter of one map"
    )
    bottom.set_ylabel(r"error of $\lambda_P$ [%]")
    bottom.set_xlabel(x_label)
    bottom.set_ylim(bottom=0.0)
    for ax in (top, bottom):
        if at is not None:
            ax.axvline(at, color="0.4", lw=0.7, ls=":")
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.25 * (high - low))
        ax.legend(loc="upper right", fontsize=7.0)
    fig.align_ylabels([top, bottom])
    if title:
        fig.suptitle(title, fontsize=9)
    return fig
