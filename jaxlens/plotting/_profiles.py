"""Radial profiles of lens models: enclosed mass and convergence."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxlens._types import ScalarLike
from jaxlens.plotting._style import COLOURS, PAGE, array, figure, number, plain_log, styled

_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))


@styled
def mass_profile(
    radius: Any,
    mass: Mapping[str, Any],
    kappa: Mapping[str, Any],
    *,
    reference: str | None = None,
    bands: Mapping[str, tuple[Any, Any]] | None = None,
    kappa_bands: Mapping[str, tuple[Any, Any]] | None = None,
    theta_e: Mapping[str, Any] | None = None,
    images: Any = None,
    kpc_per_arcsec: ScalarLike | None = None,
    kappa_label: str = r"$\kappa$ ($D_{\rm LS}/D_{\rm S} = 1$)",
    title: str = "",
) -> Figure:
    """M(<R) and kappa(R) of models, each with its ratio to one of them.

    Args:
        radius: R, `(b,)`, arcsec.
        mass: projected mass within R by model, each `(b,)`, Msun.
        kappa: mean convergence at R by model (the same names), each `(b,)`.
        reference: the model that ratios refer to; without, the last.
        bands: 16th and 84th percentiles of `mass` by model, each `(b,)`.
        kappa_bands: the same of `kappa`.
        theta_e: Einstein radii by model to mark, arcsec.
        images: distances of the images from the centre, `(i,)`, arcsec; shown as ticks at the lower edge.
        kpc_per_arcsec: for a second axis in kpc.
        kappa_label: of the convergence axis.
        title: above the figure.

    Returns:
        The figure, two columns wide.

    Raises:
        ValueError: if the two quantities are given for different models, or lengths differ.
    """
    if list(mass) != list(kappa) or not mass:
        raise ValueError(
            f"`mass` has the models {list(mass)}, `kappa` {list(kappa)}; give the same, at least one."
        )
    r = array(radius)
    for name in mass:
        if array(mass[name]).shape != r.shape or array(kappa[name]).shape != r.shape:
            raise ValueError(f"The profiles of {name!r} do not have the length of `radius`, {r.shape}.")
    base = list(mass)[-1] if reference is None else reference
    if base not in mass:
        raise ValueError(f"`reference` is {base!r}; choose one of {list(mass)}.")
    fig = figure(PAGE, 3.9)
    axes = fig.subplots(2, 2, sharex=True, height_ratios=(2.6, 1.0))
    _quantity(axes[:, 0], r, mass, bands or {}, base, r"$M({<}R)$ [M$_\odot$]")
    _quantity(axes[:, 1], r, kappa, kappa_bands or {}, base, kappa_label)
    for column in (0, 1):
        top, bottom = axes[:, column]
        for index, name in enumerate(mass):
            if theta_e and name in theta_e:
                top.axvline(
                    number(theta_e[name]), color=COLOURS[index], lw=0.7, ls=_DASHES[index % len(_DASHES)]
                )
        if images is not None:
            marks = array(images)
            top.plot(
                marks,
                np.full(marks.shape, 0.0),
                "|",
                color="black",
                ms=7,
                mew=0.5,
                transform=top.get_xaxis_transform(),
            )
        bottom.set_xlabel(r"$R$ [arcsec]")
        if kpc_per_arcsec is not None:
            scale = number(kpc_per_arcsec)
            kpc = top.secondary_xaxis("top", functions=(lambda x, s=scale: x * s, lambda x, s=scale: x / s))
            kpc.set_xlabel(r"$R$ [kpc]")
            plain_log(kpc.xaxis)
            top.tick_params(top=False, which="both")
    handles, names = axes[0, 0].get_legend_handles_labels()
    if theta_e:
        handles.append(axes[0, 0].axvline(np.nan, color="black", lw=0.7))
        names.append(r"$\theta_{\rm E}$ (vertical lines)")
    if images is not None:
        (tick,) = axes[0, 0].plot([], [], "|", color="black", ms=7, mew=0.5)
        handles.append(tick)
        names.append("images")
    fig.legend(handles, names, loc="outside lower center", ncols=4)
    fig.align_ylabels(axes)
    if title:
        fig.suptitle(title, fontsize=9)
    return fig


def _quantity(
    axes: Any,
    r: np.ndarray,
    values: Mapping[str, Any],
    bands: Mapping[str, tuple[Any, Any]],
    base: str,
    label: str,
) -> None:
    top: Axes = axes[0]
    bottom: Axes = axes[1]
    unit = array(values[base])
    for index, (name, given) in enumerate(values.items()):
        colour, dash = COLOURS[index % len(COLOURS)], _DASHES[index % len(_DASHES)]
        profile = array(given)
        top.plot(r, profile, color=colour, ls=dash, label=name)
        bottom.plot(r, profile / unit, color=colour, ls=dash)
        if name in bands:
            low, high = (array(edge) for edge in bands[name])
            top.fill_between(r, low, high, color=colour, alpha=0.25, lw=0)
            bottom.fill_between(r, low / unit, high / unit, color=colour, alpha=0.25, lw=0)
    top.set_xscale("log")
    plain_log(top.xaxis)
    top.set_yscale("log")
    top.set_xlim(r.min(), r.max())
    top.set_ylabel(label)
    bottom.set_ylabel(f"ratio to\n{base}")
