"""Distributions of the mass-sheet factor, and the data they come from."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlens.grid import Grid
from jaxlens.plotting._style import COLOURS, COLUMN, PAGE, array, figure, number, styled


class Curve(NamedTuple):
    """A density on a figure of distributions.

    Attributes:
        x: lambda, `(k,)`.
        density: of pixels, `(k,)`.
        peak: lambda_P, marked by a vertical line; None for no line.
        scatter: standard deviation of the density between realisations, `(k,)`, shaded; None for none.
    """

    x: Any
    density: Any
    peak: Any = None
    scatter: Any = None


STYLES = ((COLOURS[0], "-", "--"), (COLOURS[6], "-", ":"), (COLOURS[4], "--", "-."), (COLOURS[2], "-.", "-"))
"""Colour, line and line of the peak of each curve in turn."""


@styled
def lambda_pdf(
    curves: Mapping[str, Curve],
    *,
    reference: Any = None,
    reference_label: str = "noiseless",
    x_label: str = r"$\lambda$",
    x_range: tuple[float, float] | None = None,
    title: str = "",
) -> Figure:
    """Distributions of lambda over pixels with their peaks.

    Args:
        curves: by label, in the order of the legend.
        reference: value of lambda to mark, e.g. the noiseless one.
        reference_label: its name.
        x_label: what is distributed.
        x_range: of the axis; by default where a density exceeds 0.5 % of its maximum.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if there is no curve, or one has lengths that differ.
    """
    if not curves:
        raise ValueError("`curves` is empty; give at least one distribution.")
    fig = figure(COLUMN, 2.6)
    ax = fig.add_subplot()
    low, high, top = np.inf, -np.inf, 0.0
    # Room for the legend, so that it hides no peak; lines end below it.
    room = 1.12 + 0.13 * (len(curves) + (reference is not None))
    upright: Any = {"lw": 0.8, "ymax": 1.04 / room}
    for (label, curve), (colour, line, peak_line) in zip(curves.items(), _styles(len(curves)), strict=True):
        x, density = array(curve.x), array(curve.density)
        if x.shape != density.shape or x.ndim != 1:
            raise ValueError(f"`curves`: {label} has x {x.shape} and density {density.shape}; give one each.")
        if curve.scatter is not None:
            spread = array(curve.scatter)
            ax.fill_between(
                x,
                np.maximum(density - spread, 0.0),
                density + spread,
                color=colour,
                alpha=0.18,
                lw=0,
                zorder=2,
            )
        name = label if curve.peak is None else rf"{label}, $\lambda_P = {number(curve.peak):.3f}$"
        ax.plot(x, density, line, color=colour, label=name, zorder=4)
        if curve.peak is not None:
            ax.axvline(number(curve.peak), color=colour, ls=peak_line, zorder=3, gid="peak", **upright)
        seen = x[density > 5e-3 * density.max()]
        low, high = min(low, seen.min()), max(high, seen.max())
        top = max(top, density.max() + (0.0 if curve.scatter is None else array(curve.scatter).max()))
    if reference is not None:
        style: Any = {"color": "0.45", "zorder": 1, "label": reference_label, "gid": "reference", **upright}
        ax.axvline(number(reference), **style)
    ax.set_xlim(*(x_range or (low, high)))
    ax.set_ylim(0.0, top * room)
    ax.set_xlabel(x_label)
    ax.set_ylabel("probability density")
    ax.legend(loc="upper center", handlelength=1.8)
    if title:
        ax.set_title(title)
    return fig


def _styles(n: int) -> list[tuple[str, str, str]]:
    return [STYLES[i % len(STYLES)] for i in range(n)]


@styled
def shear_input(n_gal: Any, weight: Any, g: Any, smoothed: Any, grid: Grid, *, title: str = "") -> Figure:
    """The input of a reconstruction: galaxies per pixel, mask, reduced shear as observed and smoothed.

    Args:
        n_gal: galaxies in each pixel, `(y, x)`.
        weight: 0 in masked pixels, `(y, x)`.
        g, smoothed: complex reduced shear before and after smoothing, `(y, x)`.
        grid: their grid.
        title: above the figure.

    Returns:
        The figure, two columns wide.

    Raises:
        ValueError: if shapes disagree.
    """
    maps = {"n_gal": n_gal, "weight": weight, "g": g, "smoothed": smoothed}
    shown: dict[str, Any] = {name: np.asarray(values) for name, values in maps.items()}
    for name, values in shown.items():
        if values.shape != grid.shape:
            raise ValueError(
                f"`{name}` has shape {values.shape} but `grid.shape` is {grid.shape}; "
                "give the map's own grid."
            )
    used = array(shown["weight"]) > 0.0
    fig = figure(PAGE, 0.48 * PAGE * grid.shape[0] / grid.shape[1] + 0.95)
    axes = fig.subplots(2, 3, sharex=True, sharey=True)
    extent = tuple(edge / 60.0 for edge in grid.extent)
    panels: list[tuple[np.ndarray, str, Any, float | None]] = [
        (array(shown["n_gal"]), r"$N_{\rm pix}$", "viridis", None),
        (shown["g"].real, r"$g_1$", "RdBu_r", _limit(shown["g"], used)),
        (shown["g"].imag, r"$g_2$", "RdBu_r", _limit(shown["g"], used)),
        (used.astype(float), "mask (white: used)", ListedColormap(["0.25", "white"]), None),
        (shown["smoothed"].real, r"$g_1^{\rm sm}$", "RdBu_r", _limit(shown["smoothed"], used)),
        (shown["smoothed"].imag, r"$g_2^{\rm sm}$", "RdBu_r", _limit(shown["smoothed"], used)),
    ]
    for ax, (values, label, colours, limit) in zip(axes.ravel(), panels, strict=True):
        _panel(ax, np.where(used, values, np.nan) if limit else values, extent, label, colours, limit)
    for ax in axes[-1]:
        ax.set_xlabel(r"$\theta_1$ [arcmin]")
    for ax in axes[:, 0]:
        ax.set_ylabel(r"$\theta_2$ [arcmin]")
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


def _limit(g: np.ndarray, used: np.ndarray) -> float:
    return float(np.percentile(np.abs(g[used]), 99.0)) or 1.0


def _panel(ax: Axes, values: np.ndarray, extent: Any, label: str, colours: Any, limit: float | None) -> None:
    low, high = (-limit, limit) if limit else (None, None)
    ax.set_facecolor("0.25")
    shown = ax.imshow(
        values, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high, interpolation="nearest"
    )
    ax.set_title(label)
    if not isinstance(colours, ListedColormap) or colours.N > 2:
        extend = "both" if limit else "neither"
        bar = ax.figure.colorbar(shown, ax=ax, fraction=0.046, pad=0.03, extend=extend)
        bar.ax.yaxis.set_major_locator(MaxNLocator(5))
