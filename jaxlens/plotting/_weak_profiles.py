"""Weak lensing in numbers: tangential profile, and the iteration on the reduced shear."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlens._types import ScalarLike
from jaxlens.plotting._style import COLOURS, COLUMN, array, figure, number, plain_log, styled


@styled
def tangential_profile(
    r: Any,
    g_t: Any,
    g_x: Any,
    sigma_t: Any,
    sigma_x: Any,
    *,
    edges: Any = None,
    model_r: Any = None,
    model: Any = None,
    model_band: tuple[Any, Any] | None = None,
    model_label: str = "NFW",
    kpc_per_arcsec: ScalarLike | None = None,
    title: str = "",
) -> Figure:
    """Tangential shear with a model, and the cross shear below it.

    Bins with an infinite error are left out.

    Args:
        r: radii, `(b,)`, arcsec.
        g_t, g_x: tangential and cross component, `(b,)`.
        sigma_t, sigma_x: their errors, `(b,)`.
        edges: of the bins, `(b + 1,)`, arcsec, drawn as horizontal bars.
        model_r, model: radii [arcsec] and tangential shear of a model, `(m,)`.
        model_band: its lower and upper 1-sigma limit, `(m,)` each.
        model_label: its name.
        kpc_per_arcsec: for a second axis in kpc.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if lengths disagree.
    """
    columns = {"r": r, "g_t": g_t, "g_x": g_x, "sigma_t": sigma_t, "sigma_x": sigma_x}
    at = {name: array(values) for name, values in columns.items()}
    for name, values in at.items():
        if values.shape != at["r"].shape:
            raise ValueError(f"`{name}` has shape {values.shape} but `r` has {at['r'].shape}; one per bin.")
    use = np.isfinite(at["sigma_t"]) & np.isfinite(at["sigma_x"])
    x_error = None
    if edges is not None:
        ends = array(edges)
        if ends.shape != (len(use) + 1,):
            raise ValueError(f"`edges` has shape {ends.shape} for {len(use)} bins; give one more than bins.")
        x_error = np.stack([at["r"] - ends[:-1], ends[1:] - at["r"]])[:, use]
    fig = figure(COLUMN, 3.5)
    top, bottom = fig.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    style: Any = {
        "ls": "",
        "marker": "o",
        "ms": 3.6,
        "lw": 1.0,
        "elinewidth": 0.9,
        "capsize": 0.0,
        "zorder": 4,
    }
    for ax, name, colour in ((top, "t", COLOURS[0]), (bottom, "x", COLOURS[1])):
        values, errors = at[f"g_{name}"][use], at[f"sigma_{name}"][use]
        ax.errorbar(at["r"][use], values, errors, x_error, color=colour, **style)
        ax.axhline(0.0, color="black", lw=0.5, ls=":", zorder=1)
    if model is not None:
        radii, curve = array(model_r), array(model)
        top.plot(radii, curve, "-", color="black", zorder=3, label=model_label)
        if model_band is not None:
            low, high = (array(edge) for edge in model_band)
            top.fill_between(radii, low, high, color="black", alpha=0.15, lw=0, zorder=2)
        top.legend(loc="upper right")
    bottom.set_xscale("log")
    plain_log(bottom.xaxis)
    top.set_ylabel(r"$g_{\rm t}$")
    bottom.set_ylabel(r"$g_\times$")
    bottom.set_xlabel(r"$r$ [arcsec]")
    reach = np.max(np.abs(at["g_x"][use]) + at["sigma_x"][use], initial=1e-12)
    bottom.set_ylim(-1.15 * reach, 1.15 * reach)
    if kpc_per_arcsec is not None:
        scale = number(kpc_per_arcsec)
        kpc = top.secondary_xaxis("top", functions=(lambda x: x * scale, lambda x: x / scale))
        kpc.set_xlabel(r"$r$ [kpc]")
        plain_log(kpc.xaxis)
        top.tick_params(top=False, which="both")
    fig.align_ylabels([top, bottom])
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


@styled
def iteration_history(
    change: Any,
    *,
    spectral_radius: ScalarLike | None = None,
    used: int | None = None,
    title: str = "",
) -> Figure:
    """How much the convergence changes in each iteration of the reduced shear.

    The error of the iteration is linear: in the end each change is the spectral radius times the one before,
    drawn as a line through the last change; it shrinks if the radius is below 1.

    Args:
        change: rms of kappa^(j) - kappa^(j-1), `(t,)`, j = 1, 2, ...
        spectral_radius: of the iteration.
        used: iteration whose result is used, to mark.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if there is no iteration.
    """
    values = array(change)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"`change` has shape {values.shape}; give one number for each iteration.")
    steps = np.arange(1, len(values) + 1)
    fig = figure(COLUMN, 2.5)
    ax = fig.add_subplot()
    positive = np.isfinite(values) & (values > 0.0)
    ax.plot(steps[positive], values[positive], "o-", color=COLOURS[0], ms=3.6, label="change")
    if spectral_radius is not None and positive.any():
        rho, last = number(spectral_radius), np.flatnonzero(positive)[-1]
        if rho > 0.0:
            ax.plot(
                steps,
                values[last] * rho ** (steps - steps[last]).astype(float),
                "--",
                color=COLOURS[1],
                zorder=1,
                label=rf"$\propto \rho^{{\,j}}$, $\rho = {rho:.2f}$" + ("" if rho < 1.0 else "  (diverges)"),
            )
    if used is not None:
        ax.axvline(used, color="black", lw=0.6, ls=":", label="used")
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlim(0.7, len(values) + 0.3)
    ax.set_xlabel("iteration $j$")
    ax.set_ylabel(r"rms of $\kappa^{(j)} - \kappa^{(j-1)}$")
    ax.legend(loc="best")
    if title:
        ax.set_title(title)
    return fig
