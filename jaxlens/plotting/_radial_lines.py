"""Several quantities as functions of radius on one axis, and the null test of the scatter criterion."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxlens.plotting._style import COLOURS, COLUMN, array, figure, number, styled

_STYLES = ("o-", "s--", "D-.", "^:", "v-", "P--")


class Line(NamedTuple):
    """A profile in annuli.

    Attributes:
        value: `(b,)`.
        error: half the height of its bars, `(b,)`; None for none.
        lo, hi: ends of a shaded band, `(b,)`; None for none.
    """

    value: Any
    error: Any = None
    lo: Any = None
    hi: Any = None


@styled
def radial_lines(
    edges: Any,
    lines: Mapping[str, Line],
    *,
    y_label: str,
    level: float | None = None,
    marks: Mapping[str, Any] | None = None,
    log: bool = False,
    unit: str = r"kpc $h^{-1}$",
    title: str = "",
) -> Figure:
    """Profiles in annuli on one axis.

    Args:
        edges: of the annuli, `(b + 1,)`.
        lines: by label, in the order of the legend.
        y_label: what they are.
        level: a horizontal line, e.g. 1 for a ratio.
        marks: radii to mark by vertical lines, by label; those that are not finite are left out.
        log: logarithmic axis; values of 0 and below are then not drawn.
        unit: of the radii.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if lengths disagree.
    """
    ends = array(edges)
    r = 0.5 * (ends[:-1] + ends[1:])
    fig = figure(COLUMN, 2.7)
    ax = fig.add_subplot()
    for index, (label, line) in enumerate(lines.items()):
        value = array(line.value)
        if value.shape != r.shape:
            raise ValueError(f"`{label}` has {value.size} entries for {r.size} annuli; give one each.")
        if log:
            value = np.where(value > 0.0, value, np.nan)
        colour, style = COLOURS[index % len(COLOURS)], _STYLES[index % len(_STYLES)]
        if line.lo is not None and line.hi is not None:
            ax.fill_between(r, array(line.lo), array(line.hi), color=colour, alpha=0.18, lw=0, zorder=1)
        error = None if line.error is None else array(line.error)
        ax.errorbar(
            r, value, error, fmt=style, color=colour, ms=3.2, elinewidth=0.8, label=label, zorder=3 + index
        )
    if level is not None:
        ax.axhline(level, color="0.4", lw=0.7, ls=":", zorder=2)
    for index, (label, at) in enumerate((marks or {}).items()):
        if np.isfinite(number(at)):
            style = ("--", ":", "-.")[index % 3]
            name = f"{label}: {number(at):.0f} {unit}"
            ax.axvline(number(at), color="black", lw=0.9, ls=style, zorder=2, label=name)
    if log:
        ax.set_yscale("log")
    ax.set_xlim(ends[0], ends[-1])
    ax.set_xlabel(f"$r$ [{unit}]")
    ax.set_ylabel(y_label)
    low, high = ax.get_ylim()
    entries = 0.085 * len(ax.get_legend_handles_labels()[0]) + 0.05
    # Room for the legend above everything that is drawn.
    ax.set_ylim(
        low, high * (high / low) ** entries if log else high + entries * (high - low) / (1.0 - entries)
    )
    ax.legend(loc="upper right", fontsize=7.0, handlelength=1.8, labelspacing=0.25)
    if title:
        ax.set_title(title)
    return fig


@styled
def scatter_criterion(
    edges: Any,
    scatter: Any,
    null: Any,
    shares: Any,
    null_shares: Any,
    *,
    labels: tuple[str, str] = ("fitted SL map", "perfect SL map"),
    crossing: Any = None,
    unit: str = r"kpc $h^{-1}$",
    title: str = "",
) -> Figure:
    """The scatter of lambda_rec(r), and where single realisations have its first minimum.

    Args:
        edges: of the annuli, `(b + 1,)`.
        scatter, null: scatter of every realisation with the fitted and with a perfect map, `(n, b)`.
        shares, null_shares: shares of the realisations with the first minimum in each annulus, `(b,)`.
        labels: of both.
        crossing: radius at which the shape errors are equal, marked; None if there is none.
        unit: of the radii.
        title: above the figure.

    Returns:
        The figure, one column wide.
    """
    ends = array(edges)
    r, width = 0.5 * (ends[:-1] + ends[1:]), np.diff(ends)
    fig = figure(COLUMN, 3.8)
    top, bottom = fig.subplots(2, 1, sharex=True, height_ratios=(1.3, 1.0))
    for values, label, colour, style in (
        (array(scatter), labels[0], COLOURS[1], "o-"),
        (array(null), labels[1], COLOURS[0], "s--"),
    ):
        lo, hi = np.percentile(values, [16.0, 84.0], axis=0)
        top.fill_between(r, lo, hi, color=colour, alpha=0.18, lw=0)
        top.plot(r, values.mean(axis=0), style, color=colour, ms=3.2, label=label)
    for shift, values, colour in ((-0.2, array(shares), COLOURS[1]), (0.2, array(null_shares), COLOURS[0])):
        bottom.bar(r + shift * width, values, 0.38 * width, color=colour)
    if crossing is not None and np.isfinite(number(crossing)):
        for ax in (top, bottom):
            label = "equal shape errors" if ax is top else None
            ax.axvline(number(crossing), color="black", lw=0.9, ls="--", label=label)
    top.set_ylabel(r"scatter of $\lambda_{\rm rec}$")
    top.legend(loc="upper right", fontsize=7.0)
    bottom.set_ylabel("share of realisations")
    bottom.set_xlabel(f"$r$ of the first minimum [{unit}]")
    bottom.set_xlim(ends[0], ends[-1])
    fig.align_ylabels([top, bottom])
    if title:
        fig.suptitle(title, fontsize=9)
    return fig
