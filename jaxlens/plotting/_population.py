"""Figures over many clusters."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxlens.plotting._style import COLOURS, COLUMN, PAGE, array, figure, styled


@styled
def transition_against(
    properties: Mapping[str, Any], radius: Any, low: Any, high: Any, crossing: Any, *, title: str = ""
) -> Figure:
    """Transition radii of many clusters against their properties, two panels a row.

    Args:
        properties: values of the clusters by label, `(n,)` each.
        radius, low, high: transition of the mean over realisations and its interval, `(n,)`, kpc/h; NaN
            where it was not found: those are marked along the lower edge.
        crossing: radius of equal shape errors, `(n,)`, kpc/h; NaN without one.
        title: above the figure.

    Returns:
        The figure, two columns wide.
    """
    r, known, cross = array(radius), np.isfinite(array(radius)), array(crossing)
    bars = np.stack([r - array(low), array(high) - r])
    rows = -(-len(properties) // 2)
    fig = figure(PAGE, 0.4 + 2.3 * rows)
    axes = np.atleast_1d(fig.subplots(rows, 2, sharey=True)).ravel()
    for ax, (label, values) in zip(axes, properties.items(), strict=False):
        x = array(values)
        ax.errorbar(
            x[known], r[known], np.maximum(bars[:, known], 0.0), fmt="o", color=COLOURS[0], ms=3.4,
            elinewidth=0.6, capsize=0, label="excess variance, mean map",
        )  # fmt: skip
        ax.plot(x, cross, "D", color=COLOURS[1], ms=3.6, mfc="none", mew=0.8, label="equal shape errors")
        none = x[~known]
        ax.plot(
            none, np.full(len(none), 0.02), "x", color="0.35", ms=4, transform=ax.get_xaxis_transform(),
            label="not found", clip_on=False,
        )  # fmt: skip
        ax.set_xlabel(label)
        ax.set_ylim(bottom=0.0)
    for ax in axes[len(properties) :]:
        ax.set_axis_off()
    for ax in axes[::2]:
        ax.set_ylabel(r"transition radius [kpc $h^{-1}$]")
    handles, labels = axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper center", ncols=3)
    if title:
        axes[0].set_title(title)
    return fig


@styled
def lambda_bias(
    sl_factor: Any, bias: Any, error: Any, *, inner: Any | None = None, title: str = ""
) -> Figure:
    """Bias of lambda_P of many clusters against the mass sheet of their own strong-lensing maps.

    lambda_rec = lambda_map lambda_SL^-1 pixel by pixel, so that the bias is 1/lambda_SL - 1 (the line), if
    its true value is that of the same pixels.

    Args:
        sl_factor: median of (kappa_sl - 1)/(kappa - 1) at 100-300 kpc/h, `(n,)`.
        bias: lambda_P over its true value, minus 1, mean over realisations, `(n,)`.
        error: its scatter over realisations, `(n,)`.
        inner: the same over the true value at 100-300 kpc/h, `(n,)`; drawn with the scatter then, and `bias`,
            whose truth is that of 100-700 kpc/h, as open circles.
        title: above the figure.

    Returns:
        The figure, one column wide.
    """
    x, y = array(sl_factor), 100.0 * array(bias)
    fig = figure(COLUMN, 2.9)
    ax = fig.add_subplot()
    known = np.isfinite(x) & np.isfinite(y)
    ends = [x[known].min(), x[known].max()] if known.any() else [0.95, 1.05]
    margin = max(0.1 * (ends[1] - ends[0]), 0.005)
    line = np.linspace(ends[0] - margin, ends[1] + margin, 101)
    ax.axhspan(-1.0, 1.0, color=COLOURS[2], alpha=0.15, lw=0, label="within 1 %")
    ax.plot(line, 100.0 * (1.0 / line - 1.0), color="0.3", lw=0.9, label=r"$1/\lambda_{\rm SL} - 1$")
    style: Any = {"fmt": "o", "color": COLOURS[0], "ms": 3.4, "elinewidth": 0.6}
    if inner is None:
        ax.errorbar(x, y, 100.0 * array(error), label="clusters", **style)
    else:
        ax.errorbar(x, 100.0 * array(inner), 100.0 * array(error), label="truth at 100-300", **style)
        ax.plot(x, y, "o", color=COLOURS[1], ms=3.4, mfc="none", mew=0.7, label="truth at 100-700")
    ax.set_xlim(line[0], line[-1])
    ax.set_xlabel(r"own mass sheet of the strong-lensing map, $\lambda_{\rm SL}$")
    ax.set_ylabel(r"bias of $\lambda_P$ [%]")
    ax.legend(loc="upper right")
    if title:
        ax.set_title(title)
    return fig


@styled
def success(
    found: Mapping[str, tuple[Any, float, float]],
    covered: Mapping[str, tuple[Any, float, float]],
    *,
    nominal: float = 0.68,
    title: str = "",
) -> Figure:
    """How often single maps have a transition, above, and how often their intervals are right, below.

    Args:
        found: by label, the share of the maps of each cluster, `(n,)` and NaN where it has none, and their
            pooled value with its error, drawn as a point.
        covered: the same for the intervals of maps with a transition.
        nominal: what the interval promises.
        title: above the figure.

    Returns:
        The figure, one column wide.
    """
    fig = figure(COLUMN, 4.6)
    upper, lower = fig.subplots(2, sharex=True)
    bins = np.linspace(0.0, 1.0, 21).tolist()
    for ax, parts in ((upper, found), (lower, covered)):
        tops = []
        for (label, (values, _, _)), colour in zip(parts.items(), COLOURS, strict=False):
            known = array(values)[np.isfinite(array(values))]
            made, _, _ = ax.hist(
                known, bins, histtype="step", color=colour, lw=1.2, label=f"{label} ({len(known)})"
            )
            tops.append(float(np.max(np.asarray(made))))
        top = max([*tops, 1.0])
        for row, ((_, value, error), colour) in enumerate(zip(parts.values(), COLOURS, strict=False)):
            height = top * (1.1 + 0.12 * row)
            ax.errorbar([value], [height], xerr=[error], fmt="o", color=colour, ms=3.6, elinewidth=0.9)
        ax.set_ylim(0.0, top * (1.35 + 0.25 * len(parts)))
        ax.set_ylabel("clusters")
        ax.legend(loc="upper left")
    lower.axvline(nominal, color="0.3", lw=0.8, ls="--")
    lower.set_xlim(0.0, 1.0)
    lower.set_xlabel("share of single maps")
    if title:
        upper.set_title(title)
    return fig


@styled
def many_profiles(radius: Any, ratio: Any, *, title: str = "") -> Figure:
    """lambda_rec(r) over its true value in every cluster, with the median and 16-84 % over clusters.

    Args:
        radius: of the annuli, `(b,)`, kpc/h.
        ratio: profiles, `(n, b)`.
        title: above the figure.

    Returns:
        The figure, one column wide.
    """
    r, each = array(radius), array(ratio)
    fig = figure(COLUMN, 2.8)
    ax = fig.add_subplot()
    for index, one in enumerate(each):
        ax.plot(r, one, color="0.6", lw=0.5, alpha=0.7, label="one cluster" if index == 0 else None)
    lo, mid, hi = np.nanpercentile(each, [16.0, 50.0, 84.0], axis=0)
    ax.fill_between(r, lo, hi, color=COLOURS[0], alpha=0.25, lw=0, label="16-84 % of clusters")
    ax.plot(r, mid, color=COLOURS[0], label="median")
    ax.axhline(1.0, color="0.2", lw=0.7, ls=":")
    spread = max(np.nanmax(np.abs(np.concatenate([lo, hi]) - 1.0)), 0.01)
    ax.set_ylim(1.0 - 2.0 * spread, 1.0 + 2.6 * spread)
    ax.set_xlim(r[0], r[-1])
    ax.set_xlabel(r"$r$ [kpc $h^{-1}$]")
    ax.set_ylabel(r"$\lambda_{\rm rec}(r)/\lambda_{\rm true}$")
    ax.legend(loc="upper right", ncols=1)
    if title:
        ax.set_title(title)
    return fig
