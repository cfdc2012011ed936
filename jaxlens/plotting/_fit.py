"""How well a fit does: residuals on the sky, and its starts."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxlens._types import ScalarLike
from jaxlens.plotting._labels import place_labels
from jaxlens.plotting._maps import Curves, draw_curves
from jaxlens.plotting._style import (
    COLOURS,
    COLUMN,
    PAGE,
    TANGENTIAL,
    array,
    darker,
    figure,
    nice,
    number,
    plain_log,
    sky_axes,
    styled,
)

_FAILED = COLOURS[1]


@styled
def residual_vectors(
    observed: Any,
    predicted: Any,
    *,
    produced: Any = None,
    image_ids: Iterable[str] | None = None,
    sigma_pos: ScalarLike | None = None,
    tangential: Curves = (),
    exaggeration: ScalarLike | None = None,
    source_definition: str = "",
    n_labels: int = 6,
    title: str = "",
) -> Figure:
    """Image-plane residuals, predicted minus observed, as arrows, and the histogram of their lengths.

    Args:
        observed: observed images, `(i, 2)`, arcsec.
        predicted: their predicted counterparts, `(i, 2)`, arcsec; NaN where the model has none.
        produced: whether the model has a counterpart, `(i,)` bool; without, where `predicted` is finite.
        image_ids: names; those of the largest residuals and of the missing images are written.
        sigma_pos: position error per axis to mark in the histogram, arcsec.
        tangential: critical curve for orientation, lists of `(m, 2)`, arcsec.
        exaggeration: how much longer than the residual an arrow is; without, a round number.
        source_definition: how source positions were defined, beside the rms.
        n_labels: how many of the largest residuals are named.
        title: above the figure.

    Returns:
        The figure, two columns wide.

    Raises:
        ValueError: if shapes disagree.
    """
    seen, model = array(observed), array(predicted)
    if seen.shape != model.shape or seen.ndim != 2 or seen.shape[-1] != 2:
        raise ValueError(
            f"`observed` has shape {seen.shape}, `predicted` {model.shape}; both must be (images, 2)."
        )
    hit = np.logical_and.reduce(np.isfinite(model), axis=1)
    if produced is not None:
        hit = hit & np.asarray(produced, bool)
    shift = np.where(hit[:, None], model - seen, 0.0)
    length = np.hypot(*shift.T)
    curves = [array(curve) for curve in tangential]
    extent = _field(seen)
    typical = float(np.percentile(length[hit], 90)) if hit.any() else 0.0
    if exaggeration is None:
        longer = nice(max(0.1 * (extent[1] - extent[0]) / typical, 1.0)) if typical > 0.0 else 1.0
    else:
        longer = number(exaggeration)

    fig = figure(PAGE, 4.6)
    ax, counts = fig.subplots(1, 2, width_ratios=(2.0, 1.0))
    sky_axes(ax, extent)
    draw_curves(ax, curves, "#a0a0a0", width=0.8, zorder=1)
    ax.plot(*seen[hit].T, "o", ms=2.6, color="black", zorder=3)
    ax.plot(*seen[~hit].T, "X", ms=6.5, mfc=_FAILED, mec="white", mew=0.6, zorder=5)
    arrows = ax.quiver(
        *seen[hit].T,
        *(longer * shift[hit]).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.0042,
        headwidth=4.0,
        color=COLOURS[0],
        zorder=4,
    )
    key = nice(max(typical, 1e-3))
    ax.quiverkey(
        arrows,
        0.09,
        0.05,
        longer * key,
        f"{key:g} arcsec",
        labelpos="E",
        coordinates="axes",
        fontproperties={"size": 8},
    )
    handles = [
        Line2D([], [], marker="o", ms=2.6, color="black", ls="", label="observed image"),
        Line2D(
            [],
            [],
            marker=r"$\rightarrow$",
            ms=11,
            color=COLOURS[0],
            ls="",
            label=f"residual × {longer:g}",
        ),
    ]
    if (~hit).any():
        handles.append(
            Line2D([], [], marker="X", ms=6.5, mfc=_FAILED, mec="white", ls="", label="not produced")
        )
    if curves:
        handles.append(Line2D([], [], color="#a0a0a0", lw=0.8, label="tangential critical curve"))
    fig.legend(handles=handles, loc="outside lower center", ncols=4)
    if title:
        fig.suptitle(title, fontsize=9)
    error = None if sigma_pos is None else number(sigma_pos)
    _histogram(counts, length[hit], int(hit.sum()), len(seen), error, source_definition)
    if image_ids is not None:
        largest = np.argsort(np.where(hit, length, np.inf))[::-1][: n_labels + int((~hit).sum())]
        colours = ["black" if hit[one] else darker(_FAILED) for one in largest]
        along = np.linspace(0.0, longer, 9)[:, None, None] * shift[hit] + seen[hit]
        every = [str(name) for name in image_ids]
        names = [every[one] for one in largest]
        place_labels(fig, ax, seen[largest], names, colours, avoid=along.reshape(-1, 2), size=7.0)
    return fig


def _field(points: np.ndarray) -> tuple[float, float, float, float]:
    """A square around the points with a margin, (left, right, bottom, top)."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.65 * max(float((high - low).max()), 1.0)
    return (middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half)


def _histogram(
    ax: Axes,
    length: np.ndarray,
    n_produced: int,
    n_images: int,
    sigma_pos: float | None,
    source_definition: str,
) -> None:
    if length.size:
        bins = np.linspace(0.0, max(1.05 * float(length.max()), 1e-6), 13).tolist()
        ax.hist(length, bins, color=COLOURS[5], edgecolor="white", linewidth=0.5)
        rms = float(np.sqrt(np.mean(length**2)))
        suffix = f", source: {source_definition}" if source_definition else ""
        ax.axvline(rms, color=TANGENTIAL, lw=1.3, label=f"rms {rms:.3f} arcsec")
        ax.set_title(f"{n_produced} of {n_images} images produced{suffix}", fontsize=8)
        ax.set_xlim(0.0, bins[-1])
        if sigma_pos is not None:
            ax.axvline(
                sigma_pos,
                color="black",
                lw=1.0,
                ls=":",
                label=rf"$\sigma_{{\rm pos}}$ = {sigma_pos:g} arcsec",
            )
        ax.set_ylim(0.0, 1.28 * ax.get_ylim()[1])  # room for the legend above the bars
        ax.legend(loc="upper right", frameon=True, framealpha=1.0, edgecolor="none", borderpad=0.2)
    else:
        ax.set_title(f"0 of {n_images} images produced", fontsize=8)
    ax.set_xlabel(r"$|\theta_{\rm predicted} - \theta_{\rm observed}|$ [arcsec]")
    ax.set_ylabel("images")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))


@styled
def starts(
    chi2: Any,
    *,
    converged: Any = None,
    agree: float = 1e-3,
    label: str = r"$\chi^2$ (data and priors)",
    title: str = "",
) -> Figure:
    """chi^2 at the end of every start, sorted.

    Args:
        chi2: one per start, `(m,)`, in the order in which they were run; not finite for failed ones.
        converged: whether each converged, `(m,)` bool; without, all did.
        agree: starts within this of the lowest agree with it.
        label: of the ordinate.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if there is no start, or the lengths differ.
    """
    values = array(chi2)
    good = np.ones(len(values), bool) if converged is None else np.asarray(converged, bool)
    if values.ndim != 1 or not len(values) or good.shape != values.shape:
        raise ValueError(
            f"`chi2` has shape {values.shape}, `converged` {good.shape}; give one of each per start."
        )
    order = np.argsort(np.where(np.isfinite(values), values, np.inf), kind="stable")
    sorted_values, good = values[order], good[order]
    finite = np.isfinite(sorted_values)
    rank = np.arange(1, len(values) + 1)
    fig = figure(COLUMN, 2.9)
    ax = fig.add_subplot()
    lowest = float(sorted_values[0]) if finite[0] else np.nan
    near = finite & (sorted_values - lowest < agree)
    kinds: tuple[tuple[np.ndarray, str, str, str, str], ...] = (
        (near & good, "o", COLOURS[0], COLOURS[0], f"agree within {agree:g}"),
        (finite & ~near & good, "s", COLOURS[4], COLOURS[4], "converged elsewhere"),
        (finite & ~good, "D", "none", "black", "not converged"),
    )
    for which, marker, face, edge, name in kinds:
        if which.any():
            text = f"{name} ({which.sum()})"
            ax.plot(rank[which], sorted_values[which], marker, mfc=face, mec=edge, ms=4.5, label=text)
    if finite.any():
        text = f"lowest {lowest:.2f} (start {order[0]})"
        ax.plot(1, lowest, "*", ms=11, mfc="none", mec=_FAILED, mew=1.1, label=text)
        _chi2_axis(ax, lowest, float(sorted_values[finite][-1]), agree)
    if (~finite).any():
        height = np.full(len(values) - int(finite.sum()), 0.97)
        text = f"failed ({len(height)})"
        across = ax.get_xaxis_transform()
        ax.plot(rank[~finite], height, "x", color=_FAILED, ms=5, transform=across, label=text)
    ax.set_xlim(0.3, len(values) + 0.7)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel(r"starts, sorted by $\chi^2$")
    ax.set_ylabel(label)
    if title:
        ax.set_title(title)
    fig.legend(loc="outside lower center", ncols=2, handletextpad=0.3, columnspacing=1.0)
    return fig


def _chi2_axis(ax: Axes, lowest: float, highest: float, agree: float) -> None:
    """Logarithmic over a wide range; never magnified to differences that do not matter."""
    if lowest > 0.0 and highest > 5.0 * lowest:
        ax.set_yscale("log")
        plain_log(ax.yaxis)
        return
    ax.ticklabel_format(axis="y", useOffset=False)
    if highest - lowest < agree:
        half = max(0.02 * abs(lowest), agree)
        ax.set_ylim(lowest - half, lowest + half)
