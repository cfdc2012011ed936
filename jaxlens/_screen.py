"""What the command shows: tables of rich, and remarks."""

import math
from typing import Any

from rich import box
from rich.table import Table

from jaxlens import results
from jaxlens.prediction import CounterImages
from jaxlens.results import Outcome

_WIDTH = "half the width that holds 68 % of the draws"

DESCRIPTIONS = {
    "x_error_arcsec": f"{_WIDTH}; NaN for the given image, which is data",
    "y_error_arcsec": f"{_WIDTH}; NaN for the given image, which is data",
    "mu_error": _WIDTH,
    "delay_days": "arrival time after the first image",
    "delay_error_days": f"{_WIDTH}; 0 for the first image",
    "found": "share of the draws that have the image",
    "given": "the image that was asked about",
}
"""What the columns of a table of images are, where their names do not say."""


def numbers(outcome: Outcome) -> Table:
    """The fitted numbers with their errors."""
    view = Table(title=f"{outcome.setup.name}: fitted numbers", title_justify="left")
    view.add_column("number")
    view.add_column("value", justify="right")
    view.add_column("error", justify="right")
    view.add_column("16 - 84 %", justify="right")
    view.add_column("unit")
    view.add_column("")
    at_bound = results.bound_names(outcome)
    for name, value in outcome.values.items():
        flag = "at its bound" if name in at_bound else ""
        low, high = outcome.intervals[name]
        between = f"{low:.4g} - {high:.4g}" if math.isfinite(low) else ""
        error = _error(outcome.errors[name])
        view.add_row(name, f"{value:.4g}", error, between, results.unit_of(name), flag)
    return view


def _error(error: float) -> str:
    return f"{error:.2g}" if math.isfinite(error) else ""


def images(columns: dict[str, Any], z: float) -> Table:
    """The counter-images, each number with its error."""
    title = f"Images of the source at z = {z:g} (* the given one)"
    view = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    heads = {
        "x_arcsec": ('x ["]', 2),
        "y_arcsec": ('y ["]', 2),
        "mu": ("mu", 1),
        "delay_days": ("delay [d]", 1),
    }
    view.add_column("#", justify="right", no_wrap=True)
    for head, _ in heads.values():
        view.add_column(head, justify="right", no_wrap=True)
    view.add_column("kind", no_wrap=True)
    if "found" in columns:
        view.add_column("found", justify="right", no_wrap=True)
    for k, number in enumerate(columns["image"]):
        cells = []
        for name, (_, digits) in heads.items():
            stem, _, unit = name.partition("_")
            error = columns.get(f"{stem}_error_{unit}".rstrip("_"))
            cell = f"{columns[name][k]:.{digits}f}"
            if error is not None and math.isfinite(error[k]):
                cell += f" ± {error[k]:.{digits}f}"
            cells.append(cell)
        share = [f"{columns['found'][k]:.2f}"] if "found" in columns else []
        star = "*" if columns["given"][k] else ""
        view.add_row(f"{star}{number}", *cells, str(columns["kind"][k]), *share)
    return view


def remarks(found: CounterImages, warning: str | None = None, sigma: float = 0.0) -> str:
    """What a reader of the table must know; `warning` is about its draws, `sigma` as in `counter_images`."""
    lines = [] if warning is None else [f"warning: {warning}"]
    if found.n_draws:
        lines.append(f"errors: half the width that holds 68 % of {found.n_draws} draws")
        lines.append("found: share of the draws that have the image")
        lines.append(
            f"every draw is asked about a place of its own, {sigma:g} arcsec about the given image (*)"
            if sigma
            else "the given image (*) has no error of position: each draw is asked about just that place; "
            "--sigma gives it one"
        )
    else:
        lines.append("no errors: the model comes without draws of its posterior")
    if not found.complete:
        lines.append(
            "an image may be missing: their number and parities do not add up; give a wider --half-width"
        )
    return "\n".join(lines)
