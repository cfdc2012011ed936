"""What all figures share: sizes, colours, axes of the sky, saving."""

import os
import secrets
from collections.abc import Callable, Sequence
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from jaxlens._types import ScalarLike
from jaxlens.plotting._labels import halo

COLUMN, PAGE = 3.4, 7.1
"""Width of one column and of both, inches."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito's set, told apart with any colour vision (its yellow left out: too light on paper)."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "h", "<", ">", "p", "d")

TANGENTIAL, RADIAL, CAUSTIC = COLOURS[1], COLOURS[0], COLOURS[2]

STYLE: Any = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.0,
    "legend.fontsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.1,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.top": True,
    "ytick.right": True,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "axes.unicode_minus": True,
}

_FORMATS: tuple[dict[str, Any], ...] = ({"metadata": {"CreationDate": None}}, {"dpi": 200})

P = ParamSpec("P")
R = TypeVar("R")


def styled(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function under `STYLE`, leaving matplotlib's own settings as they were."""

    @wraps(function)
    def under_style(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return function(*args, **kwargs)

    return under_style


def figure(width: float, height: float, *, constrained: bool = True) -> Figure:
    """An empty figure of `width` x `height` inches that needs no window system."""
    made = Figure(figsize=(width, height), layout="constrained" if constrained else None)
    FigureCanvasAgg(made)
    return made


def array(values: Any) -> np.ndarray:
    """NumPy floats of anything array-like."""
    return np.asarray(values, dtype=float)


def number(value: ScalarLike) -> float:
    """A plain number of any scalar."""
    return np.asarray(value, dtype=float).item()


def cycle(index: int) -> tuple[str, str]:
    """Colour and marker of the index-th system: 7 x 12 combinations before one repeats."""
    return COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)]


def darker(colour: str) -> str:
    """The same hue at 70 % of its brightness, for letters."""
    red, green, blue = (int(0.7 * int(colour[i : i + 2], 16)) for i in (1, 3, 5))
    return f"#{red:02x}{green:02x}{blue:02x}"


def plain_log(axis: Axis) -> None:
    """Ticks 1, 2, 5, 10, ... written as plain numbers on a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def nice(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `value`."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-12)) * power)


def sky_axes(ax: Axes, extent: Sequence[float]) -> None:
    """Equal scales, labels with directions, and a compass.

    Args:
        ax: the axes.
        extent: (left, right, bottom, top), arcsec; theta_1 grows to the right, towards West.
    """
    ax.set_aspect("equal")
    ax.set_xlim(extent[0], extent[1])
    ax.set_ylim(extent[2], extent[3])
    ax.set_xlabel(r"$\theta_1$ [arcsec]  (West $\rightarrow$)")
    ax.set_ylabel(r"$\theta_2$ [arcsec]  (North $\rightarrow$)")
    foot, length = (0.955, 0.045), 0.085
    for dx, dy, name in ((-length, 0.0, "E"), (0.0, length, "N")):
        tip = (foot[0] + dx, foot[1] + dy)
        arrow = {
            "arrowstyle": "-|>",
            "lw": 0.8,
            "color": "black",
            "shrinkA": 0,
            "shrinkB": 0,
            "mutation_scale": 7,
        }
        ax.annotate("", xy=tip, xytext=foot, xycoords="axes fraction", arrowprops=arrow, zorder=8)
        place = (tip[0] + 0.22 * dx, tip[1] + 0.22 * dy)
        text = ax.text(*place, name, transform=ax.transAxes, ha="center", va="center", fontsize=7, zorder=8)
        text.set_path_effects(halo())


def scale_bar(ax: Axes, kpc_per_arcsec: float) -> None:
    """A bar of a round number of kpc, about a fifth of the field, in the lower left."""
    left, right = ax.get_xlim()
    kpc = nice(0.25 * (right - left) * kpc_per_arcsec)
    fraction = kpc / kpc_per_arcsec / (right - left)
    ax.plot(
        [0.045, 0.045 + fraction],
        [0.045, 0.045],
        "-",
        color="black",
        lw=1.6,
        transform=ax.transAxes,
        zorder=8,
    )
    text = ax.text(
        0.045,
        0.06,
        f"{kpc:g} kpc",
        transform=ax.transAxes,
        ha="left",  # centred on a short bar it would cross the frame
        va="bottom",
        zorder=8,
    )
    text.set_path_effects(halo())


@styled
def save(fig: Figure, stem: str | Path) -> tuple[Path, Path]:
    """Write a figure as `<stem>.pdf` (vectors) and `<stem>.png` (200 dpi), each replaced in one step.

    The PDF holds no date: the same figure is the same file.

    Args:
        fig: the figure.
        stem: path without a suffix; missing directories are made.

    Returns:
        The two paths.
    """
    paths = (Path(f"{stem}.pdf"), Path(f"{stem}.png"))
    paths[0].parent.mkdir(parents=True, exist_ok=True)
    for path, options in zip(paths, _FORMATS, strict=True):
        content = BytesIO()
        fig.savefig(content, format=path.suffix[1:], **options)
        temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
        try:
            temporary.write_bytes(content.getvalue())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    return paths
