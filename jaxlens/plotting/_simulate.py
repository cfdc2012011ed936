"""Simulated fields: the cluster on the sky, the galaxies behind it, and the weak-lensing data."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxlens._types import ScalarLike
from jaxlens.grid import Grid
from jaxlens.plotting._labels import halo
from jaxlens.plotting._maps import Curves, draw_curves, draw_images, kappa_norm, pale
from jaxlens.plotting._style import (
    COLOURS,
    PAGE,
    RADIAL,
    TANGENTIAL,
    array,
    figure,
    number,
    plain_log,
    scale_bar,
    sky_axes,
    styled,
)

MEMBER = COLOURS[2]


def _members(ax: Axes, theta: np.ndarray, luminosity: np.ndarray, bcg: np.ndarray) -> None:
    """Circles whose area grows with the luminosity; crosses for central galaxies."""
    satellites = ~bcg
    size = np.clip(14.0 * np.sqrt(luminosity[satellites]), 0.6, 14.0)
    ax.scatter(*theta[satellites].T, s=size, facecolors="none", edgecolors=MEMBER, linewidths=0.6, zorder=3)
    ax.plot(*theta[bcg].T, "x", color="black", ms=5, mew=1.2, ls="", zorder=7, path_effects=halo(2.4))


@styled
def simulated_cluster(
    kappa: Any,
    grid: Grid,
    *,
    members: Any,
    luminosity: Any,
    bcg: Any,
    tangential: Curves = (),
    radial: Curves = (),
    theta: Any,
    systems: Iterable[Any],
    z_s: ScalarLike,
    kpc_per_arcsec: ScalarLike | None = None,
    title: str = "",
) -> Figure:
    """The convergence of a simulated cluster: the whole field, and its core with critical curves and images.

    Args:
        kappa: convergence, `(y, x)`.
        grid: its grid.
        members: positions of the galaxies, `(n, 2)`, arcsec.
        luminosity: L/L_ref, `(n,)`.
        bcg: which are central galaxies, `(n,)` bool.
        tangential, radial: critical curves, lists of `(m, 2)`, arcsec.
        theta: detected images, `(i, 2)`, arcsec.
        systems: the system of each, `(i,)`.
        z_s: redshift of the sources of kappa and curves.
        kpc_per_arcsec: for scale bars.
        title: above the figure.

    Returns:
        The figure, two columns wide.

    Raises:
        ValueError: if shapes disagree.
    """
    values = array(kappa)
    if values.shape != grid.shape:
        raise ValueError(
            f"`kappa` has shape {values.shape} but `grid.shape` is {grid.shape}; give the map's own grid."
        )
    galaxies, light, central = array(members), array(luminosity), np.asarray(bcg, bool)
    images = array(theta).reshape(-1, 2)
    fig = figure(PAGE, 4.35)
    axes = fig.subplots(1, 2)
    norm, extend = kappa_norm(values)
    half = min(1.2 * float(np.abs(images).max(initial=30.0)), grid.extent[1])
    core = (-half, half, -half, half)
    for ax, extent in zip(axes, (grid.extent, core), strict=True):
        shown = ax.imshow(
            values,
            origin="lower",
            extent=grid.extent,
            cmap=pale(),
            norm=norm,
            interpolation="nearest",
            zorder=0,
        )
        sky_axes(ax, extent)
        draw_curves(ax, tangential, TANGENTIAL, width=1.1)
        draw_curves(ax, radial, RADIAL, width=0.9)
        _members(ax, galaxies, light, central)
        if kpc_per_arcsec is not None:
            scale_bar(ax, number(kpc_per_arcsec))
        bar = fig.colorbar(
            shown,
            cax=ax.inset_axes((0.0, 1.03, 1.0, 0.04)),
            orientation="horizontal",
            extend=extend,
            extendfrac=0.03,
        )
        bar.set_label(rf"$\kappa$ ($z_s = {number(z_s):g}$)")
        bar.ax.xaxis.set_ticks_position("top")
        bar.ax.xaxis.set_label_position("top")
        plain_log(bar.ax.xaxis)
    axes[0].plot([-half, half, half, -half, -half], [-half, -half, half, half, -half], "k-", lw=0.7, zorder=5)
    axes[1].set_ylabel("")
    if len(images):
        draw_images(axes[1], images, systems)
    entry = lambda label, **how: Line2D([], [], label=label, **how)
    dot = {"ls": "", "mfc": "none"}
    lines = ((tangential, "tangential critical curve", TANGENTIAL), (radial, "radial critical curve", RADIAL))
    fig.legend(
        handles=[
            *(entry(name, color=colour, lw=1.1) for curves, name, colour in lines if len(list(curves))),
            entry("members", marker="o", ms=3.2, mec=MEMBER, **dot),
            entry("central galaxies", marker="x", ms=5, color="black", ls=""),
            entry("images (one symbol a system)", marker="o", ms=4.6, mec="black", **dot),
        ],
        loc="outside lower center",
        ncols=5,
        handlelength=1.6,
        columnspacing=1.2,
    )
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


@styled
def source_population(
    z: Any,
    mag: Any,
    *,
    expected: Any,
    area: float,
    systems: Any,
    image_radius: Any,
    image_mag: Any,
    detected: Any,
    limit: tuple[float, float, float],
    title: str = "",
) -> Figure:
    """Redshifts and magnitudes of the sources, and magnitudes of their images against the limit.

    Args:
        z: redshifts of all sources, `(s,)`.
        mag: their apparent magnitudes without the lens, `(s,)`.
        expected: expected counts, with fields `z` and `per_z` (per arcsec^2 and unit redshift).
        area: of the box of the sources, arcsec^2.
        systems: indices of the sources of systems, `(n,)`.
        image_radius: distance of all images from the centre, `(i,)`, kpc.
        image_mag: their magnitudes, `(i,)`.
        detected: which are brighter than the limit, `(i,)` bool.
        limit: limiting magnitude far away, its loss at the centre, and the radius of the loss in kpc.
        title: above the figure.

    Returns:
        The figure, two columns wide.
    """
    z, mag, chosen = array(z), array(mag), np.asarray(systems, int)
    fig = figure(PAGE, 2.55)
    left, middle, right = fig.subplots(1, 3)
    grey = "0.75"
    bins = np.arange(0.0, np.ceil(2.0 * max(z.max(initial=1.0), array(expected.z).max())) / 2.0 + 0.25, 0.5)
    left.hist(z, bins, color=grey, label="sources")
    left.plot(
        array(expected.z), 0.5 * area * array(expected.per_z), "-", color=COLOURS[0], lw=1.0, label="expected"
    )
    left.hist(z[chosen], bins, color=COLOURS[1], label="systems")
    left.set_yscale("log")
    left.set_ylim(0.5, 20.0 * max(1.0, float(0.5 * area * array(expected.per_z).max())))
    left.set_xlim(0.0, bins[-1])
    left.set_xlabel(r"source redshift $z_s$")
    left.set_ylabel(r"number per $\Delta z = 0.5$")
    left.legend(loc="upper right", handlelength=1.4)

    steps = np.arange(np.floor(mag.min(initial=24.0)), np.ceil(mag.max(initial=32.0)) + 0.25, 0.5)
    middle.hist(mag, steps, color=grey, label="sources")
    middle.hist(mag[chosen], steps, color=COLOURS[1], label="systems")
    middle.set_yscale("log")
    middle.set_ylim(bottom=0.5)
    middle.set_xlabel("apparent magnitude without the lens")
    middle.set_ylabel(r"number per $\Delta m = 0.5$")
    middle.legend(loc="upper left", handlelength=1.4)

    radius, magnitude, seen = array(image_radius), array(image_mag), np.asarray(detected, bool)
    right.plot(radius[~seen], magnitude[~seen], ".", color=grey, ms=2.0, label="images", rasterized=True)
    right.plot(radius[seen], magnitude[seen], ".", color=COLOURS[1], ms=3.5, label="brighter than the limit")
    far = float(np.ceil(radius.max(initial=200.0) / 50.0) * 50.0)
    r = np.linspace(0.0, far, 200)
    right.plot(r, limit[0] - limit[1] * np.exp(-r / limit[2]), "-", color="black", lw=1.0, label="limit")
    right.set_xlim(0.0, far)
    faint = np.percentile(magnitude, 98.0) if len(magnitude) else 32.0
    right.set_ylim(min(faint + 1.0, 36.0), magnitude.min(initial=26.0) - 0.5)
    right.set_xlabel("distance from the centre [kpc]")
    right.set_ylabel("apparent magnitude of images")
    right.legend(loc="lower right", handlelength=1.2, borderaxespad=0.3)
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


@styled
def weak_data(
    n_gal: Any,
    mask: Any,
    g: Any,
    grid: Grid,
    *,
    kpc_per_arcsec: ScalarLike | None = None,
    title: str = "",
) -> Figure:
    """Weak-lensing data on the pixels of a map: galaxies, mask, and both components of the observed shear.

    Args:
        n_gal: galaxies per pixel, `(y, x)`.
        mask: 1 for pixels that are used, `(y, x)`.
        g: observed reduced shear, `(y, x)` complex.
        grid: pixels.
        kpc_per_arcsec: for a scale bar.
        title: above the figure.

    Returns:
        The figure, two columns wide.

    Raises:
        ValueError: if shapes disagree.
    """
    observed = np.asarray(g)
    panels: list[tuple[str, np.ndarray, str | Colormap, tuple[float, float] | None]] = [
        (r"$N_{\rm pix}$", array(n_gal), "viridis", None),
        ("mask", array(mask), ListedColormap(["0.15", "0.92"]), (-0.5, 1.5)),
        (r"$\hat g_1$", np.real(observed), "RdBu_r", (-0.5, 0.5)),
        (r"$\hat g_2$", np.imag(observed), "RdBu_r", (-0.5, 0.5)),
    ]
    for label, values, *_ in panels:
        if values.shape != grid.shape:
            raise ValueError(
                f"{label} has shape {values.shape} but `grid.shape` is {grid.shape}; give its own grid."
            )
    fig = figure(PAGE, 2.6 if title else 2.45)
    axes = fig.subplots(1, 4, sharey=True)
    for ax, (label, values, cmap, limits) in zip(axes, panels, strict=True):
        sky_axes(ax, grid.extent)
        norm = Normalize(*limits) if limits else Normalize(values.min(), values.max())
        beyond = limits is not None and label != "mask" and bool(np.any(np.abs(values) > limits[1]))
        shown = ax.imshow(
            values,
            origin="lower",
            extent=grid.extent,
            cmap=cmap,
            norm=norm,
            interpolation="nearest",
            zorder=0,
        )
        bar = fig.colorbar(
            shown,
            cax=ax.inset_axes((0.0, 1.04, 1.0, 0.06)),
            orientation="horizontal",
            extend="both" if beyond else "neither",
            extendfrac=0.04,
        )
        bar.set_label(label)
        bar.ax.xaxis.set_ticks_position("top")
        bar.ax.xaxis.set_label_position("top")
        bar.ax.xaxis.set_major_locator(MaxNLocator(5))
        if label == "mask":
            bar.set_ticks([0.0, 1.0])
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.set_xlabel(r"$\theta_1$ [arcsec]")
        ax.set_ylabel(r"$\theta_2$ [arcsec]" if ax is axes[0] else "")
    if kpc_per_arcsec is not None:
        scale_bar(axes[0], number(kpc_per_arcsec))
    if title:
        fig.suptitle(title, fontsize=9)
    return fig
