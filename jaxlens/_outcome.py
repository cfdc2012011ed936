"""A strong-lensing fit with everything derived from it: predicted images, numbers, errors and intervals."""

from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from jaxlens import posterior
from jaxlens._types import Array
from jaxlens.analysis_strong import Analysis
from jaxlens.strong import (
    DEFINITIONS,
    ImageCatalogue,
    PredictedImages,
    Prediction,
    StrongFit,
    edge,
    physical,
    predict,
    reported,
    without_edges,
)
from jaxlens.workflow import Setup

N_INTERVAL = 4096
"""Draws of the numbers for their intervals: the ends are then good to 2 % of the error."""

UNITS = {"_arcsec": "arcsec", "_km_s": "km/s", "_msun": "Msun", "_msun_h": "Msun/h", "_deg": "deg"}


@dataclass(frozen=True)
class Outcome:
    """A fit with everything derived from it.

    Attributes:
        setup: the problem.
        fit: the best start.
        predicted: predicted images by source definition.
        values: reported numbers by name.
        errors: their standard errors (Laplace, numbers at their bound held there); NaN for those. To first
            order: they may reach beyond the box.
        intervals: 16th and 84th percentile of Laplace draws, which stay inside the box; NaN at a bound.
        covariance: of the reported numbers, in the order of `values`, `(n, n)`.
        seed: of the starts.
        plane: where the chi^2 was formed.
        definition: source position of the image-plane stage, if there was one.
        analysis: what was asked beyond the fit.
    """

    setup: Setup
    fit: StrongFit
    predicted: dict[str, PredictedImages]
    values: dict[str, float]
    errors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    covariance: np.ndarray
    seed: int
    plane: str
    definition: str
    analysis: Analysis = field(default_factory=Analysis)

    @property
    def images(self) -> ImageCatalogue:
        """The observed images."""
        return self.setup.problem.images

    @property
    def main(self) -> PredictedImages:
        """The predicted images of the definition `tensor`."""
        return self.predicted["tensor"]


def derive(
    setup: Setup,
    fit: StrongFit,
    *,
    seed: int = 0,
    plane: str = "source",
    definition: str = "tensor",
    analysis: Analysis | None = None,
) -> Outcome:
    """Predicted images, reported numbers and errors of a fit."""
    predicted = predict(Prediction(fit.lens, fit.dls_ds), setup.problem.images, definitions=DEFINITIONS)

    def numbers(u: Any) -> dict[str, Any]:
        return reported(setup.model, physical(setup.problem.bounds, u))

    @jax.jit  # one program for all three
    def everything(u: Array, many: Array) -> tuple[dict[str, Array], ...]:
        return numbers(u), jax.jacfwd(numbers)(u), jax.vmap(numbers)(many)

    many = posterior.draw_numbers(setup.problem, fit, jax.random.key(seed), N_INTERVAL)
    values, slopes, columns = everything(fit.u, many)
    intervals = {
        name: interval(float(values[name]), np.asarray(column), periodic=name.endswith(".pa_deg"))
        for name, column in columns.items()
    }
    rows = np.stack([np.asarray(slopes[name]) for name in values])
    held = without_edges(fit.covariance, edge(setup.problem.bounds, fit.u))
    covariance = rows @ np.asarray(held) @ rows.T
    variance = np.diag(covariance)
    spread = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    return Outcome(
        setup=setup,
        fit=fit,
        predicted=predicted,
        values={name: float(value) for name, value in values.items()},
        errors=dict(zip(values, spread.tolist(), strict=True)),
        intervals=intervals,
        covariance=covariance,
        seed=seed,
        plane=plane,
        definition=definition,
        analysis=analysis or Analysis(),
    )


def interval(value: float, draws: np.ndarray, *, periodic: bool = False) -> tuple[float, float]:
    """16th and 84th percentile of draws `(n,)`; NaN where they do not move, as for a number at its bound.

    Position angles (`periodic`, in degrees) are counted from `value`, so that the seam at 90 degrees is none.
    """
    if periodic:
        draws = value + (draws - value + 90.0) % 180.0 - 90.0
    low, high = np.percentile(draws, [15.865, 84.135]).tolist()
    return (low, high) if high > low else (np.nan, np.nan)


def unit_of(name: str) -> str:
    """The unit that the name of a number ends in; empty for dimensionless ones."""
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def bound_names(outcome: Outcome) -> set[str]:
    """Reported names of the numbers at their bound: a shape stands for its elongation and angle."""
    names = set()
    for key in outcome.fit.at_bound:
        owner, _, number = key.partition(".")
        if number == "shape":
            names |= {
                name
                for name in outcome.values
                if name.startswith(f"{owner}.") and name.endswith((".e", ".ellipticity", ".gamma"))
            }
        elif owner == "dls_ds":
            names.add(f"z.{number}")
        elif number != "pa":
            names.add(key)
    return names
