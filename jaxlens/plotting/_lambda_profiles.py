"""lambda and kappa as functions of radius."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxlens.plotting._style import COLOURS, COLUMN, PAGE, array, figure, number, styled

WL, SL, TRUTH = COLOURS[0], COLOURS[1], "0.35"

_MARKS: Any = {"ls": "", "elinewidth": 0.9, "capsize": 1.6, "capthick": 0.7, "ms": 3.8, "zorder": 4}


class Band(NamedTuple):
    """A profile with its scatter in annuli.

    Attributes:
        value: middle, `(b,)`.
        lo, hi: lower and upper end of the scatter, `(b,)`.
    """

    value: Any
    lo: Any
    hi: Any


def _bars(ax: Axes, r: np.ndarray, band: Band, **style: Any) -> None:
    value, lo, hi = (array(part) for part in band)
    ax.errorbar(
        r, value, np.stack([np.maximum(value - lo, 0.0), np.maximum(hi - value, 0.0)]), **_MARKS, **style
    )


def _region(ax: Axes, edges: np.ndarray, inside: Any, label: str | None) -> None:
    for index in np.flatnonzero(np.asarray(inside, bool)):
        ax.axvspan(edges[index], edges[index + 1], color=COLOURS[4], alpha=0.22, lw=0, zorder=0, label=label)
        label = None


@styled
def lambda_profile(
    edges: Any,
    lam: Band,
    *,
    lam_true: Any = None,
    true_label: str = r"$\lambda$, noiseless",
    lam_inner: Any = None,
    inner_label: str = r"$100-300\,{\rm kpc}\,h^{-1}$",
    rmse_sl: Any = None,
    rmse_wl: Any = None,
    rmse_label: str = "RMSE",
    sl_label: str = "strong lensing",
    wl_label: str = "weak lensing, corrected",
    region: Any = None,
    region_label: str = "transition region",
    transition: Any = None,
    transition_range: tuple[Any, Any] | None = None,
    unit: str = r"kpc $h^{-1}$",
    title: str = "",
) -> Figure:
    """lambda_rec(r), and below it the errors of both maps.

    Args:
        edges: of the annuli, `(b + 1,)`.
        lam: median and 16-84 % of lambda_rec, `(b,)` each.
        lam_true: lambda of the noiseless case, a dashed line.
        true_label: its name.
        lam_inner: lambda_P of the inner annuli, a dashed line.
        inner_label: their range.
        rmse_sl, rmse_wl: errors of both maps, `(b,)`; without them there is one panel. Errors of 0 are not
            drawn.
        rmse_label, sl_label, wl_label: what they are.
        region: annuli to shade, `(b,)` bool.
        region_label: what they are.
        transition: transition radius, a vertical line; None if there is none.
        transition_range: its 16 and 84 %, shaded.
        unit: of the radii.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if lengths disagree.
    """
    ends = array(edges)
    r = 0.5 * (ends[:-1] + ends[1:])
    given = {"lam": lam.value, "rmse_sl": rmse_sl, "rmse_wl": rmse_wl, "region": region}
    for name, values in given.items():
        if values is not None and len(np.asarray(values)) != len(r):
            raise ValueError(f"`{name}` has {len(np.asarray(values))} entries for {len(r)} annuli; one each.")
    errors = [(rmse_sl, SL, "D-", sl_label), (rmse_wl, WL, "s-", wl_label)]
    lower = any(values is not None for values, *_ in errors)
    fig = figure(COLUMN, 3.9 if lower else 2.6)
    heights = (1.5, 1.0) if lower else (1.0,)
    axes = list(np.atleast_1d(fig.subplots(len(heights), 1, sharex=True, height_ratios=heights)))
    top = axes[0]
    _bars(top, r, lam, color=COLOURS[6], marker="o", label=r"$\lambda_{\rm rec}$, median and 16-84 %")
    if lam_true is not None:
        top.axhline(number(lam_true), color="black", ls="--", lw=0.9, label=true_label)
    if lam_inner is not None:
        text = rf"$\lambda_P = {number(lam_inner):.3f}$, {inner_label}"
        top.axhline(number(lam_inner), color=COLOURS[1], ls="--", lw=0.9, label=text)
    top.set_ylabel(r"$\lambda_{\rm rec}(r)$")
    for ax in axes:
        if region is not None:
            _region(ax, ends, region, region_label if ax is axes[-1] else None)
        if transition is not None:
            if transition_range is not None:
                low, high = (number(edge) for edge in transition_range)
                ax.axvspan(low, high, color=COLOURS[2], alpha=0.2, lw=0, zorder=0)
            label = rf"$r_{{\rm t}} = {number(transition):.0f}$ {unit}" if ax is top else None
            ax.axvline(number(transition), color=COLOURS[2], lw=1.1, zorder=2, label=label, gid="transition")
    if lower:
        _errors(axes[1], r, errors, rmse_label)
    low, high = top.get_ylim()
    top.set_ylim(low, high + 0.45 * (high - low))  # room for the legend
    top.legend(loc="upper right", fontsize=7.0, handlelength=1.6, labelspacing=0.25)
    axes[-1].set_xlabel(f"$r$ [{unit}]")
    axes[-1].set_xlim(ends[0], ends[-1])
    fig.align_ylabels(axes)
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


def _errors(ax: Axes, r: np.ndarray, errors: list[tuple[Any, str, str, str]], name: str) -> None:
    for values, colour, style, label in errors:
        if values is not None:
            seen = np.where(array(values) > 0.0, array(values), np.nan)
            ax.plot(r, seen, style, color=colour, ms=3.2, label=label)
    ax.set_yscale("log")
    ax.set_ylabel(name)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high * (high / low) ** 0.6)
    ax.legend(loc="upper right", fontsize=7.0, handlelength=1.6, labelspacing=0.25)


@styled
def kappa_profiles(
    edges: Any,
    profiles: Mapping[str, Band],
    *,
    truth: Band | None = None,
    truth_label: str = "truth",
    inset: tuple[float, float] | None = (100.0, 330.0),
    unit: str = r"kpc $h^{-1}$",
    title: str = "",
) -> Figure:
    """kappa(r) of both reconstructions and of the truth, with the scatter in each annulus.

    Args:
        edges: of the annuli, `(b + 1,)`.
        profiles: by label, first weak, then strong lensing, then others; drawn side by side in each annulus.
        truth: drawn as a line with its scatter shaded.
        truth_label: its name.
        inset: range of radii to show larger; None for no inset.
        unit: of the radii.
        title: above the figure.

    Returns:
        The figure, one column wide.

    Raises:
        ValueError: if lengths disagree.
    """
    ends = array(edges)
    r, width = 0.5 * (ends[:-1] + ends[1:]), np.diff(ends)
    for label, band in {**profiles, **({} if truth is None else {truth_label: truth})}.items():
        if any(len(array(part)) != len(r) for part in band):
            raise ValueError(f"`{label}` has {len(array(band.value))} entries for {len(r)} annuli; one each.")
    styles = ((WL, "s"), (SL, "D"), (COLOURS[2], "o"), (COLOURS[3], "v"))
    fig = figure(COLUMN, 3.0)
    ax = fig.add_subplot()
    reach = None if inset is None else ax.inset_axes((0.46, 0.42, 0.52, 0.40))
    for panel in (ax,) if reach is None else (ax, reach):
        if truth is not None:
            value, lo, hi = (array(part) for part in truth)
            panel.fill_between(r, lo, hi, color=TRUTH, alpha=0.25, lw=0, zorder=1)
            panel.plot(r, value, "-", color=TRUTH, zorder=2, label=truth_label)
        shifts = 0.16 * width[:, None] * (np.arange(len(profiles)) - 0.5 * (len(profiles) - 1))[None, :]
        for index, (label, band) in enumerate(profiles.items()):
            colour, marker = styles[index % len(styles)]
            _bars(panel, r + shifts[:, index], band, color=colour, marker=marker, label=label)
    if reach is not None and inset is not None:
        reach.set_xlim(*inset)
        inside = (r >= inset[0]) & (r <= inset[1])
        if inside.any():
            bands = [*profiles.values(), *([] if truth is None else [truth])]
            low = min(float(array(band.lo)[inside].min()) for band in bands)
            high = max(float(array(band.hi)[inside].max()) for band in bands)
            reach.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
        reach.tick_params(labelsize=6.5)
    ax.set_xlim(ends[0], ends[-1])
    ax.set_xlabel(f"$r$ [{unit}]")
    ax.set_ylabel(r"$\kappa(r)$")
    ax.legend(loc="upper right", ncols=2, fontsize=7.0, handlelength=1.4, columnspacing=0.9)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.12 * (high - low))
    if title:
        ax.set_title(title)
    return fig


@styled
def lambda_maps(maps: Mapping[str, Any], weight: Any, grid: Any, *, title: str = "") -> Figure:
    """Maps of lambda on one colour scale about their common median; unused pixels stay grey.

    Args:
        maps: by label, `(y, x)` each, e.g. of A2 and K2.
        weight: pixels of weight 0 are not drawn, `(y, x)`.
        grid: their grid.
        title: above the figure.

    Returns:
        The figure, two columns wide.
    """
    used = array(weight) > 0.0
    shown = {label: np.where(used, array(values), np.nan) for label, values in maps.items()}
    everything = np.concatenate([values[used] for values in shown.values()])
    middle = float(np.median(everything))
    reach = float(np.percentile(np.abs(everything - middle), 95.0)) or 0.1
    count = len(shown)
    fig = figure(PAGE * min(1.0, 0.42 * count), PAGE * 0.36 + 0.4)
    axes = np.atleast_1d(fig.subplots(1, count, sharey=True))
    extent = tuple(edge / 60.0 for edge in grid.extent)
    image = None
    for ax, (label, values) in zip(axes, shown.items(), strict=True):
        ax.set_facecolor("0.6")
        image = ax.imshow(
            values,
            origin="lower",
            extent=extent,
            cmap="RdBu_r",
            vmin=middle - reach,
            vmax=middle + reach,
            interpolation="nearest",
        )
        ax.set_title(label)
        ax.set_xlabel(r"$\theta_1$ [arcmin]")
    axes[0].set_ylabel(r"$\theta_2$ [arcmin]")
    if image is not None:
        fig.colorbar(image, ax=list(axes), fraction=0.03, pad=0.02, extend="both", label=r"$\lambda$")
    if title:
        fig.suptitle(title, fontsize=9)
    return fig
