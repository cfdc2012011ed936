"""The lens on the sky: convergence, critical curves, caustics, images."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlens._types import ScalarLike
from jaxlens.grid import Grid
from jaxlens.plotting._labels import halo, place_labels
from jaxlens.plotting._style import (
    CAUSTIC,
    PAGE,
    RADIAL,
    TANGENTIAL,
    array,
    cycle,
    darker,
    figure,
    number,
    plain_log,
    scale_bar,
    sky_axes,
    styled,
)

Curves = Iterable[Any]
"""Polylines, each `(m, 2)` in arcsec."""

# Ends at 60 % grey, so that curves and names are legible on the densest parts.
_GREY = LinearSegmentedColormap.from_list("pale", ["#ffffff", "#d9d9d9", "#6e6e6e"])


def pale() -> LinearSegmentedColormap:
    """The greys of convergence maps."""
    return _GREY


def system_index(systems: Iterable[Any]) -> np.ndarray:
    """0, 1, ... for each image's system, in order of first appearance, `(i,)`."""
    names = [str(name) for name in systems]
    order = {name: index for index, name in enumerate(dict.fromkeys(names))}
    return np.array([order[name] for name in names], dtype=int)


def draw_curves(
    ax: Axes, curves: Curves, colour: str, *, width: float = 1.1, style: str = "-", zorder: int = 4
) -> None:
    """Draw polylines `(m, 2)`."""
    for curve in curves:
        points = array(curve)
        if len(points):
            ax.plot(points[:, 0], points[:, 1], style, color=colour, lw=width, zorder=zorder)


def kappa_norm(kappa: np.ndarray) -> tuple[Normalize, str]:
    """Logarithmic between percentiles where the map is positive, else linear; and what the ends cut."""
    finite = kappa[np.isfinite(kappa)]
    if not finite.size:
        raise ValueError("`kappa` has no finite value; there is nothing to show.")
    low, high = np.percentile(finite, [0.5, 99.8])
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    cut = extend[bool(finite.min() < low), bool(finite.max() > high)]
    if low > 0.0 and high > 3.0 * low:
        return LogNorm(low, high), cut
    return Normalize(low, high if high > low else low + 1.0), cut


@styled
def kappa_map(
    kappa: Any,
    grid: Grid,
    *,
    tangential: Curves = (),
    radial: Curves = (),
    caustics: Curves = (),
    theta: Any = None,
    systems: Iterable[Any] | None = None,
    image_ids: Iterable[str] | None = None,
    z_s: ScalarLike | None = None,
    kappa_label: str = r"$\kappa$",
    kpc_per_arcsec: ScalarLike | None = None,
    title: str = "",
) -> Figure:
    """Convergence with critical curves, caustics and the observed images.

    Caustics are lines of the source plane, drawn dashed on the same angular scale. Images of one
    system share colour and symbol.

    Args:
        kappa: convergence, `(y, x)`.
        grid: its grid.
        tangential, radial: critical curves, lists of `(m, 2)`, arcsec.
        caustics: lists of `(m, 2)`, arcsec.
        theta: observed images, `(i, 2)`, arcsec.
        systems: the system of each image, `(i,)` names or indices; without, all are one.
        image_ids: names written beside the images, `(i,)`; without, none.
        z_s: source redshift of curves, for the legend.
        kappa_label: what the colour bar says.
        kpc_per_arcsec: for a scale bar.
        title: above the figure.

    Returns:
        The figure, two columns wide.

    Raises:
        ValueError: if shapes disagree, or the map has no finite value.
    """
    values = array(kappa)
    if values.shape != grid.shape:
        raise ValueError(
            f"`kappa` has shape {values.shape} but `grid.shape` is {grid.shape}; give the map's own grid."
        )
    fig = figure(PAGE, 6.9)
    ax = fig.add_subplot()
    sky_axes(ax, grid.extent)
    norm, extend = kappa_norm(values)
    shown = ax.imshow(
        values, origin="lower", extent=grid.extent, cmap=_GREY, norm=norm, interpolation="nearest", zorder=0
    )
    bar = fig.colorbar(shown, cax=ax.inset_axes((1.015, 0.0, 0.03, 1.0)), extend=extend, extendfrac=0.025)
    bar.set_label(kappa_label)
    if isinstance(norm, LogNorm):
        plain_log(bar.ax.yaxis)
    if kpc_per_arcsec is not None:
        scale_bar(ax, number(kpc_per_arcsec))
    at = "" if z_s is None else rf" ($z_s = {number(z_s):.4g}$)"
    handles = []
    for curves, colour, style, width, name in (
        (tangential, TANGENTIAL, "-", 1.3, f"tangential critical curve{at}"),
        (radial, RADIAL, "-", 1.0, "radial critical curve"),
        (caustics, CAUSTIC, "--", 0.8, "caustics (source plane)"),
    ):
        lines = list(curves)
        draw_curves(ax, lines, colour, width=width, style=style)
        if lines:
            handles.append(Line2D([], [], color=colour, ls=style, lw=width, label=name))
    if title:
        ax.set_title(title)
    if theta is not None:
        handles.append(
            Line2D([], [], ls="", marker="o", mfc="none", mec="black", ms=5, label="observed images")
        )
    fig.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=2.4, columnspacing=1.6)
    if theta is not None:
        _draw_images(fig, ax, array(theta), systems, image_ids)
    return fig


def draw_images(ax: Axes, theta: np.ndarray, systems: Iterable[Any] | None) -> np.ndarray:
    """Symbols at images `(i, 2)`, those of one system alike; returns the index of the system of each."""
    index = np.zeros(len(theta), int) if systems is None else system_index(systems)
    if len(index) != len(theta):
        raise ValueError(f"{len(index)} `systems` for {len(theta)} images; give the system of each image.")
    for one in np.unique(index):
        colour, marker = cycle(int(one))
        here = theta[index == one]
        ax.plot(
            *here.T,
            marker,
            ms=4.6,
            mfc="none",
            mec=colour,
            mew=1.0,
            ls="",
            zorder=6,
            path_effects=halo(2.4),
            gid="images",
        )
    return index


def _draw_images(
    fig: Figure, ax: Axes, theta: np.ndarray, systems: Iterable[Any] | None, image_ids: Iterable[str] | None
) -> None:
    index = draw_images(ax, theta, systems)
    if image_ids is not None:
        place_labels(
            fig, ax, theta, [str(name) for name in image_ids], [darker(cycle(int(one))[0]) for one in index]
        )
