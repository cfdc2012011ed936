"""The mass sheet between two maps, over all annuli."""

from jaxlens._types import Map, Scalar
from jaxlens.mass_sheet import median, regauge
from jaxlens.radial import Annuli


def sheet_between(kappa: Map, reference: Map, rings: Annuli, weight: Map | None = None) -> Scalar:
    """Median of (kappa - 1)/(reference - 1) over all annuli, `()`; differentiable.

    Args:
        kappa, reference: maps smoothed alike, `(y, x)`.
        rings: annuli, see `radial.annuli`.
        weight: further pixels to leave out, `(y, x)`.
    """
    used = rings.used if weight is None else rings.used & (weight > 0.0)
    return median(kappa, reference, used)


def aligned(kappa_wl: Map, kappa_sl: Map, rings: Annuli) -> Map:
    """The weak-lensing map with the mass sheet of the strong-lensing one, for `moments`, `(y, x)`.

    All annuli say what the sheet is, as in `shape_errors`: lambda_P of an inner range would carry the error
    of the strong-lensing map there to all radii.
    """
    return regauge(kappa_wl, sheet_between(kappa_wl, kappa_sl, rings))
