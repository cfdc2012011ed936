"""The radius at which strong and weak lensing change places, with and without the truth."""

from jaxlens.transition._errors import (
    Crossings,
    MapErrors,
    ShapeErrors,
    comparable,
    crossings,
    map_errors,
    shape_errors,
)
from jaxlens.transition._excess import (
    FEWEST,
    STAY,
    Excess,
    Moments,
    Transition,
    combined,
    excess_variance,
    first_rise,
    hold_ends,
    mean_moments,
    moments,
    smooth_profile,
)
from jaxlens.transition._external import External, with_external
from jaxlens.transition._scatter import (
    ScatterCriterion,
    ScatterMinimum,
    scatter_criterion,
    scatter_minimum,
)
from jaxlens.transition._sheet import aligned, sheet_between

RULE = {"sheet": "all annuli", "annuli_above_1": STAY, "fewest_pixels": FEWEST}
"""How a transition is found, for files that are kept: results of another rule are not mixed with these."""

__all__ = [
    "FEWEST",
    "RULE",
    "STAY",
    "Crossings",
    "Excess",
    "External",
    "MapErrors",
    "Moments",
    "ScatterCriterion",
    "ScatterMinimum",
    "ShapeErrors",
    "Transition",
    "aligned",
    "combined",
    "comparable",
    "crossings",
    "excess_variance",
    "first_rise",
    "hold_ends",
    "map_errors",
    "mean_moments",
    "moments",
    "scatter_criterion",
    "scatter_minimum",
    "shape_errors",
    "sheet_between",
    "smooth_profile",
    "with_external",
]
