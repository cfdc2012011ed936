"""Weak lensing on the sky: convergence maps with their null test, and shear sticks."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlens._types import ScalarLike
from jaxlens.grid import Grid
from jaxlens.plotting._labels import halo
from jaxlens.plotting._style import (
    COLOURS,
    COLUMN,
    PAGE,
    array,
    figure,
    nice,
    number,
    scale_bar,
    sky_axes,
    styled,
)


def _checked(name: str, values: Any, grid: Grid) -> np.ndarray:
    found = np.asarray(values)
    if found.shape != grid.shape:
        raise ValueError(
            f"`{name}` has shape {found.shape} but `grid.shape` is {grid.shape}; give the map's own grid."
        )
    return found


def _panel(ax: Axes, values: np.ndarray, grid: Grid, *, limit: float, cmap: str, label: str) -> None:
    """A map about zero with its colour bar on top."""
    sky_axes(ax, grid.extent)
    norm = Normalize(-limit, limit)
    shown = ax.imshow(
        values, origin="lower", extent=grid.extent, cmap=cmap, norm=norm, interpolation="nearest", zorder=0
    )
    finite = values[np.isfinite(values)]
    low, high = bool(np.any(finite < -limit)), bool(np.any(finite > limit))
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    bar = ax.figure.colorbar(
        shown,
        cax=ax.inset_axes((0.0, 1.03, 1.0, 0.05)),
        orientation="horizontal",
        extend=extend[low, high],
        extendfrac=0.04,
    )
    bar.set_label(label)
    bar.ax.xaxis.set_ticks_position("top")
    bar.ax.xaxis.set_label_position("top")
    bar.ax.xaxis.set_major_locator(MaxNLocator(5))


def _contours(ax: Axes, values: np.ndarray, grid: Grid, levels: np.ndarray, colour: str, style: str) -> int:
    """Draw those levels that the map reaches; returns how many."""
    finite = np.ma.masked_invalid(values)  # contours end at the mask
    inside = levels[(levels > finite.min()) & (levels < finite.max())]
    if len(inside):
        x, y = array(grid.x), array(grid.y)
        ax.contour(x, y, finite, levels=inside, colors=colour, linestyles=style, linewidths=0.7, zorder=3)
    return len(inside)


def _steps(largest: float) -> np.ndarray:
    """Levels of signal to noise: from 2 in steps of 1, above 10 in wider steps, so that about ten remain."""
    step = next(step for step in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, np.inf) if largest <= 10.0 * step)
    return np.arange(max(step, 2.0), largest, step) if step < np.inf else largest * np.linspace(0.1, 0.9, 9)


def _said(levels: np.ndarray, sign: str = "") -> str:
    """The numbers of contours, shortened."""
    words = [f"{sign}{level:.3g}" for level in levels]
    return ", ".join(words if len(words) < 4 else [*words[:2], "...", words[-1]])


@styled
def shear_maps(
    kappa_e: Any,
    kappa_b: Any,
    grid: Grid,
    *,
    kappa_b_rest: Any = None,
    snr: Any = None,
    weight: Any = None,
    peak: Any = None,
    density: Any = None,
    density_label: str = "galaxies",
    snr_label: str = r"S/N",
    kpc_per_arcsec: ScalarLike | None = None,
    title: str = "",
) -> Figure:
    """E mode, B mode and signal to noise of a reconstructed convergence.

    E and B share one colour scale, symmetric about zero, up to the largest |E|: the B mode, zero but for
    noise and errors, shows what to believe of the E mode. In a small field some shear can be read as either;
    `kappa_b_rest` is the B mode beyond that. Signal to noise is drawn as contours on the
    E mode (their levels are stated; negative dashed) and as a map.

    Args:
        kappa_e, kappa_b: convergence and its B mode, `(y, x)`.
        grid: their grid.
        kappa_b_rest: B mode of the shear that the E mode does not explain, `(y, x)`; a panel of its own.
        snr: signal to noise of the E mode, `(y, x)`; a panel of its own.
        weight: pixels of weight 0 are left white, `(y, x)`.
        peak: position to mark, `(2,)`, arcsec.
        density: surface density of galaxies, `(y, x)`, drawn as contours on the last panel.
        density_label: what its contours are.
        snr_label: what the signal to noise is of.
        kpc_per_arcsec: for a scale bar.
        title: above the figure.

    Returns:
        The figure, two columns wide.

    Raises:
        ValueError: if shapes disagree.
    """
    maps = {"kappa_e": kappa_e, "kappa_b": kappa_b}
    if kappa_b_rest is not None:
        maps["kappa_b_rest"] = kappa_b_rest
    if snr is not None:
        maps["snr"] = snr
    shown = {name: array(_checked(name, values, grid)) for name, values in maps.items()}
    ratio = grid.shape[0] / grid.shape[1]
    n = len(shown)
    fig = figure(PAGE, PAGE / n * ratio * 0.93 + 1.05)
    axes = np.atleast_1d(fig.subplots(1, n, sharey=True))
    used = np.ones(grid.shape, bool) if weight is None else array(_checked("weight", weight, grid)) > 0.0
    largest = np.max(np.abs(shown["kappa_e"][used & np.isfinite(shown["kappa_e"])]), initial=0.0)
    limits = {"kappa_e": largest, "kappa_b": largest, "kappa_b_rest": largest}
    if snr is not None:
        limits["snr"] = np.max(np.abs(shown["snr"][used & np.isfinite(shown["snr"])]), initial=0.0)
    labels = {"kappa_e": r"$\kappa_{\rm E}$", "kappa_b": r"$\kappa_{\rm B}$", "snr": snr_label}
    labels["kappa_b_rest"] = r"$\kappa_{\rm B}$ that E leaves over"
    for ax, (name, values) in zip(axes, shown.items(), strict=True):
        white = np.where(used, values, np.nan)
        cmap = "PuOr_r" if name == "snr" else "RdBu_r"
        _panel(ax, white, grid, limit=float(limits[name]) or 1.0, cmap=cmap, label=labels[name])
        if ax is not axes[0]:
            ax.set_ylabel("")
        if peak is not None:
            x, y = array(peak)
            ax.plot(x, y, "+", color="black", ms=9, mew=1.2, zorder=6, path_effects=halo(2.2), gid="peak")
    if snr is not None:
        steps = _steps(float(limits["snr"]))
        values = np.where(used, shown["snr"], np.nan)
        up = _contours(axes[0], values, grid, steps, "black", "solid")
        down = _contours(axes[0], values, grid, -steps[::-1], "black", "dashed")
        said = [_said(steps[:up])] * (up > 0)
        said += ["dashed " + _said(steps[:down], "\N{MINUS SIGN}")] * (down > 0)
        if said:
            fig.supxlabel(f"contours on the first map: S/N = {'; '.join(said)}", fontsize=8)
    if density is not None:
        values = array(_checked("density", density, grid))
        top = float(values.max())
        _contours(axes[-1], values, grid, top * np.array([0.2, 0.4, 0.6, 0.8]), COLOURS[2], "solid")
        axes[-1].plot([], [], "-", color=COLOURS[2], lw=0.9, label=density_label)
        axes[-1].legend(loc="upper left", framealpha=0.8, frameon=True, edgecolor="none", handlelength=1.2)
    if kpc_per_arcsec is not None:
        scale_bar(axes[0], number(kpc_per_arcsec))
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


@styled
def shear_sticks(
    g: Any,
    weight: Any,
    grid: Grid,
    *,
    kappa: Any = None,
    kappa_label: str = r"$\kappa$",
    step: int = 1,
    smoothing: ScalarLike | None = None,
    centre: Any = None,
    kpc_per_arcsec: ScalarLike | None = None,
    title: str = "",
) -> Figure:
    """Reduced shear as sticks along the direction of stretching, on the convergence if it is given.

    The length is proportional to |g|, the angle from +theta_1 is arg(g)/2. A stick of known length is drawn
    below the map.

    Args:
        g: complex reduced shear, `(y, x)`.
        weight: only pixels of positive weight have a stick, `(y, x)`.
        grid: their grid.
        kappa: convergence, `(y, x)`.
        kappa_label: what the colour bar says.
        step: draw every `step`-th pixel of each axis.
        smoothing: standard deviation of the Gaussian that `g` was smoothed with, arcsec, to be stated.
        centre: position to mark, `(2,)`, arcsec.
        kpc_per_arcsec: for a scale bar.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if shapes disagree, or no pixel has weight.
    """
    shear = _checked("g", g, grid).astype(complex)
    use = array(_checked("weight", weight, grid)) > 0.0
    chosen = np.zeros(grid.shape, bool)
    chosen[step // 2 :: step, step // 2 :: step] = True
    use = use & chosen & np.isfinite(shear)
    if not use.any():
        raise ValueError("No pixel has positive weight and a finite shear; there is no stick to draw.")
    fig = figure(COLUMN, COLUMN * grid.shape[0] / grid.shape[1] + 0.55)
    ax = fig.add_subplot()
    if kappa is not None:
        values = array(_checked("kappa", kappa, grid))
        limit = float(np.nanmax(np.abs(values))) or 1.0
        _panel(ax, values, grid, limit=limit, cmap="RdBu_r", label=kappa_label)
    else:
        sky_axes(ax, grid.extent)
    size, angle = np.abs(shear[use]), 0.5 * np.angle(shear[use])
    # The longest of all but a few sticks spans one and a half times their distance.
    unit = 1.5 * step * grid.pixel / max(float(np.percentile(size, 98)), 1e-12)
    theta = np.stack(np.meshgrid(array(grid.x), array(grid.y)), axis=-1)[use]
    sticks = ax.quiver(
        theta[:, 0],
        theta[:, 1],
        unit * size * np.cos(angle),
        unit * size * np.sin(angle),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        pivot="mid",
        headwidth=0.0,
        headlength=0.0,
        headaxislength=0.0,
        width=0.0035,
        color="black",
        zorder=4,
    )
    key = nice(float(np.percentile(size, 98)))
    # Beside the label of the axis, or in a line of its own below it, where nothing else stands.
    label = f"$|g| = {key:g}$"
    if smoothing is not None and number(smoothing) > 0.0:
        label += rf", shear smoothed with $\sigma = {number(smoothing):g}$ arcsec"
        fig.supxlabel(" ", fontsize=8)
    ax.quiverkey(sticks, 0.19, 0.022, unit * key, label, coordinates="figure", labelpos="E", labelsep=0.06)
    if centre is not None:
        x, y = array(centre)
        ax.plot(x, y, "x", color=COLOURS[1], ms=6, mew=1.4, zorder=6, path_effects=halo(2.4), gid="centre")
    if kpc_per_arcsec is not None:
        scale_bar(ax, number(kpc_per_arcsec))
    if title:
        fig.suptitle(title, fontsize=9)
    return fig
