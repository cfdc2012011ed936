"""The mass-sheet factor lambda: maps of it, its distribution over pixels, and what undoes it."""

from jaxlens.mass_sheet._errors import blocks, bootstrap
from jaxlens.mass_sheet._maps import (
    FLOOR,
    Decomposition,
    Factor,
    decompose,
    from_redshift_pair,
    ratio,
    regauge,
    transform,
    transform_potential,
)
from jaxlens.mass_sheet._pdf import (
    Distribution,
    bandwidth,
    biweight,
    density,
    distribution,
    distribution_and_bandwidth,
    median,
    peak,
)

__all__ = [
    "FLOOR",
    "Decomposition",
    "Distribution",
    "Factor",
    "bandwidth",
    "biweight",
    "blocks",
    "bootstrap",
    "decompose",
    "density",
    "distribution",
    "distribution_and_bandwidth",
    "from_redshift_pair",
    "median",
    "peak",
    "ratio",
    "regauge",
    "transform",
    "transform_potential",
]
