"""Best values, errors and correlations of the free numbers."""

from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxlens.plotting._style import COLOURS, PAGE, array, darker, figure, styled

_SYMBOLS = {
    "x": r"$x$",
    "y": r"$y$",
    "e": r"$e$",
    "ellipticity": r"$\varepsilon$",
    "gamma": r"$\gamma$",
    "kappa": r"$\kappa$",
    "pa": r"$\phi$",
    "concentration": r"$c$",
    "mass_vir": r"$M_{\rm vir}$",
    "mass_200c": r"$M_{200}$",
    "mass": r"$M$",
    "r_s": r"$r_{\rm s}$",
    "r_core": r"$r_{\rm core}$",
    "r_cut": r"$r_{\rm cut}$",
    "r_core_ref": r"$r_{\rm core,ref}$",
    "r_cut_ref": r"$r_{\rm cut,ref}$",
    "sigma_v": r"$\sigma_v$",
    "sigma_lt": r"$\sigma_{\rm LT}$",
    "sigma_ref": r"$\sigma_{\rm ref}$",
}
_MINUS = "\N{MINUS SIGN}"
_UNITS = {"arcsec": "arcsec", "km_s": "km/s", "msun": r"M$_\odot$", "kpc": "kpc", "deg": "deg"}


def symbol(name: str) -> tuple[str, str, str]:
    """Owner, symbol (mathtext) and unit of a number such as `O1.r_core_arcsec`, as figures write them.

    >>> symbol("O1.x_arcsec")
    ('O1', '$x$', 'arcsec')
    >>> symbol("z.12")
    ('system 12', '$z$', '')
    """
    owner, dot, number = name.partition(".")
    if not dot:
        owner, number = "", name
    if owner == "z":
        return f"system {number}", r"$z$", ""
    unit = next((ending for ending in _UNITS if number.endswith(f"_{ending}")), "")
    stem = number.removesuffix(f"_{unit}") if unit else number
    return owner, _SYMBOLS.get(stem, stem.replace("_", " ")), _UNITS.get(unit, "")


def rounded(value: float, error: float) -> str:
    """`value ± error` with two digits of the error, as a paper prints it.

    >>> rounded(1223.737, 14.75), rounded(0.517298, 0.0110379)
    ('1224 ± 15', '0.517 ± 0.011')
    """
    if not np.isfinite(value) or not np.isfinite(error) or error <= 0.0:
        return f"{value:.4g}".replace("-", _MINUS)
    if abs(value) >= 1e5 or max(abs(value), error) < 1e-3:
        power = int(np.floor(np.log10(max(abs(value), error))))
        return rf"({rounded(value / 10.0**power, error / 10.0**power)})$\times 10^{{{power}}}$"
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f}".replace("-", _MINUS)


@styled
def covariance(
    names: Iterable[str],
    values: Any,
    covariance: Any,
    *,
    units: Iterable[str] | None = None,
    at_bound: Collection[str] = (),
    limit: int = 12,
    title: str = "",
) -> Figure:
    """The Laplace covariance of the free numbers.

    Up to `limit` numbers: a corner of 1 and 2 sigma ellipses (39.3 and 86.5 % of a two-dimensional
    normal distribution) on axes that span 3 sigma either way, correlation coefficients in the upper
    half, best values with 1 sigma errors beside the rows. More: the correlation matrix.

    Args:
        names: of the numbers, `(n,)`, e.g. `O1.r_core_arcsec`.
        values: best values, `(n,)`.
        covariance: `(n, n)`, in the numbers' own units.
        units: of the numbers; without, those their names end in.
        at_bound: names of the numbers whose error means nothing, because they are at their bound.
        limit: largest n for which the corner is drawn.
        title: above the figure.

    Returns:
        The figure, at most two columns wide.

    Raises:
        ValueError: if shapes disagree.
    """
    names, best, matrix = list(names), array(values), array(covariance)
    n = len(names)
    if n == 0 or best.shape != (n,) or matrix.shape != (n, n):
        raise ValueError(
            f"{n} `names`, `values` of shape {best.shape} and `covariance` of shape {matrix.shape} "
            "do not belong together; give n, (n,) and (n, n), n at least 1."
        )
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    # A number without spread has no correlation.
    scale = np.where(sigma > 0.0, sigma, 1.0)
    correlation = np.clip(matrix / np.outer(scale, scale), -1.0, 1.0)
    labels = [_Label(*symbol(name), name in at_bound) for name in names]
    if units is not None:
        given = [_UNITS.get(unit.lower(), unit) for unit in units]
        labels = [label._replace(unit=unit) for label, unit in zip(labels, given, strict=True)]
    if n <= limit:
        return _corner(labels, best, sigma, correlation, title)
    return _matrix(labels, correlation, title)


class _Label(NamedTuple):
    owner: str
    symbol: str
    unit: str
    at_bound: bool

    @property
    def lines(self) -> list[str]:
        return [part for part in (self.owner, self.symbol) if part]

    @property
    def colour(self) -> str:
        return darker(COLOURS[1]) if self.at_bound else "black"


def _corner(
    labels: list[_Label], best: np.ndarray, sigma: np.ndarray, correlation: np.ndarray, title: str
) -> Figure:
    n = len(labels)
    left, bottom, top = 1.1, 0.55, 0.3 if title else 0.08  # margins, inches
    cell = min((PAGE - left - 0.05) / n, 1.4)
    width, height = left + n * cell + 0.05, bottom + n * cell + top
    fig = figure(width, height, constrained=False)
    axes = fig.subplots(n, n, squeeze=False)
    fig.subplots_adjust(left / width, bottom / height, 1.0 - 0.05 / width, 1.0 - top / height, 0.06, 0.06)
    letters = float(np.clip(72.0 / n, 6.2, 8.0))
    for row in range(n):
        for column in range(n):
            ax: Axes = axes[row, column]
            ax.set_xticks([-2, 0, 2], labels=[])
            ax.set_yticks([-2, 0, 2] if row > column else [], labels=["", "", ""] if row > column else [])
            ax.tick_params(length=2, width=0.4)
            ax.set_xlim(-3, 3)
            if row == column:
                _marginal(ax)
            elif row > column:
                _ellipses(ax, correlation[row, column])
            else:
                _coefficient(ax, correlation[row, column], letters)
        label = labels[row]
        value = rounded(best[row], sigma[row])
        note = ["at its bound"] if label.at_bound else []
        unit = f" [{label.unit}]" if label.unit else ""
        axes[row, 0].text(
            -0.08,
            0.5,
            "\n".join([" ".join(label.lines) + unit, value, *note]),
            transform=axes[row, 0].transAxes,
            ha="right",
            va="center",
            fontsize=letters,
            color=label.colour,
            linespacing=1.25,
        )
        axes[n - 1, row].set_xlabel("\n".join(label.lines), fontsize=letters, labelpad=2, color=label.colour)
    note = r"axes: $\pm 3\sigma$ about the best value, ticks at $\pm 2\sigma$; ellipses: 1 and 2 $\sigma$"
    fig.text(1.0 - 0.05 / width, 0.05 / height, note, ha="right", va="bottom", fontsize=7.0)
    if title:
        fig.suptitle(title, fontsize=9, y=1.0 - 0.06 / height, va="top")
    return fig


def _marginal(ax: Axes) -> None:
    t = np.linspace(-3.0, 3.0, 121)
    density = np.exp(-0.5 * t**2)
    ax.fill_between(t, density, where=(np.abs(t) <= 1.0).tolist(), color=COLOURS[5], alpha=0.6, lw=0)
    ax.plot(t, density, color=COLOURS[0], lw=0.9)
    ax.set_ylim(0.0, 1.1)


def _ellipses(ax: Axes, rho: float) -> None:
    ax.set_ylim(-3, 3)
    # Axes of the 1 sigma ellipse of two unit normal variables: sqrt(1 ± rho) along the diagonals.
    for k, alpha in ((2.0, 0.35), (1.0, 0.7)):
        width, height = (2.0 * k * np.sqrt(max(1.0 + s * rho, 1e-4)) for s in (1.0, -1.0))
        ax.add_patch(
            Ellipse((0, 0), width, height, angle=45.0, fc=COLOURS[5], ec=COLOURS[0], lw=0.6, alpha=alpha)
        )
    ax.plot(0, 0, "+", color="black", ms=3.5, mew=0.7)


def _coefficient(ax: Axes, rho: float, letters: float) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_facecolor(_shade(rho))
    for spine in ax.spines.values():
        spine.set_linewidth(0.3)
        spine.set_color("#bbbbbb")
    dark = abs(rho) > 0.65
    text = f"{rho:+.2f}".replace("-", _MINUS)
    ax.text(
        0.5,
        0.5,
        text,
        transform=ax.transAxes,
        ha="center",
        va="center",
        fontsize=letters,
        color="white" if dark else "black",
    )


def _shade(rho: float) -> tuple[float, float, float]:
    """White at 0 to blue at -1 and vermilion at +1."""
    end = np.array([0x00, 0x5A, 0x9C] if rho < 0.0 else [0xC0, 0x4A, 0x00]) / 255.0
    red, green, blue = 1.0 - abs(rho) * (1.0 - end)
    return (float(red), float(green), float(blue))


def _matrix(labels: list[_Label], correlation: np.ndarray, title: str) -> Figure:
    n = len(labels)
    fig = figure(PAGE, 6.4)
    ax = fig.add_subplot()
    ax.imshow(np.array([[_shade(rho) for rho in row] for row in correlation]), interpolation="nearest")
    letters = float(np.clip(220.0 / n, 3.5, 8.0))
    names = [" ".join(label.lines) for label in labels]
    ax.set_xticks(np.arange(n), labels=names, rotation=90, fontsize=letters)
    ax.set_yticks(np.arange(n), labels=names, fontsize=letters)
    for tick, label in zip([*ax.get_xticklabels(), *ax.get_yticklabels()], [*labels, *labels], strict=True):
        tick.set_color(label.colour)
    ax.tick_params(length=0)
    heading = "correlation coefficients of the free numbers"
    if n <= 26:
        heading += ", per cent"
        for (row, column), rho in np.ndenumerate(correlation):
            colour = "white" if abs(rho) > 0.65 else "black"
            text = f"{round(100.0 * rho)}".replace("-", _MINUS)
            ax.text(column, row, text, ha="center", va="center", fontsize=0.8 * letters, color=colour)
    if any(label.at_bound for label in labels):
        heading += " (coloured names: at their bound)"
    ax.set_title(f"{title}: {heading}" if title else heading)
    ramp = ListedColormap([_shade(rho) for rho in np.linspace(-1.0, 1.0, 201)])
    shades = ScalarMappable(Normalize(-1.0, 1.0), ramp)
    bar = fig.colorbar(shades, cax=ax.inset_axes((1.015, 0.0, 0.03, 1.0)))
    bar.set_label("correlation coefficient")
    return fig
