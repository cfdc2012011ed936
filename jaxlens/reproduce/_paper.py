"""The numbers that the paper states, beside those of a run."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxlens.reproduce._cluster import ClusterRun
from jaxlens.reproduce._statements import Measured


@dataclass(frozen=True)
class Row:
    """A number of the paper and that of a run.

    Attributes:
        key: short name.
        text: what it is.
        paper: the paper's number.
        measured: the run's; its error is the scatter of one noise realisation.
        unit: of both.
        figure: stem of the figure that shows it.
    """

    key: str
    text: str
    paper: float
    measured: Measured
    unit: str = ""
    figure: str = ""


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def rows(found: ClusterRun, strong: dict[str, Any]) -> list[Row]:
    """Every number of the paper beside the run's.

    The absolute lambda_P is a gauge: it depends on padding, ridge and band of the reconstruction, so that
    differences between its values mean more than the values.

    Args:
        found: the run.
        strong: statistics of the paper's strong-lensing model, from `statistics`.
    """
    clean, good = found.base.clean, found.base.noisy.good

    def over_maps(one: Any, which: int) -> Measured:
        peaks = np.asarray(one.peak)[:, which]
        return Measured(float(peaks.mean()), float(peaks.std(ddof=1)))

    lam = "peak lambda_P of"
    return [
        Row("n_systems", "multiple-image systems", 22, Measured(strong["n_systems"])),
        Row("n_images", "multiple images", 68, Measured(strong["n_images"])),
        Row("rms", "rms of the image positions", 0.186, Measured(strong["rms_arcsec"]), "arcsec"),
        Row("chi2_nu", "reduced chi^2, sources not counted", 0.95, Measured(_or_nan(strong["chi2_nu"]))),
        Row("a2", f"{lam} A2, noiseless", 1.146, Measured(float(clean.a2.peak[-1])), figure="pdf_noiseless"),
        Row("k2", f"{lam} K2, noiseless", 1.175, Measured(float(clean.k2.peak[-1])), figure="pdf_noiseless"),
        Row("a2_noisy", f"{lam} A2, with noise", 1.146, over_maps(good.a2, -1), figure="pdf_noisy"),
        Row("k2_noisy", f"{lam} K2, with noise", 1.163, over_maps(good.k2, -1), figure="pdf_noisy"),
        Row(
            "rec_inner",
            f"{lam} lambda_rec, 100-300 kpc/h",
            1.141,
            over_maps(good.rec, 0),
            figure="pdf_ranges",
        ),
        Row(
            "rec_outer",
            f"{lam} lambda_rec, 300-700 kpc/h",
            1.124,
            over_maps(good.rec, 1),
            figure="pdf_ranges",
        ),
        Row(
            "rec_all", f"{lam} lambda_rec, 100-700 kpc/h", 1.124, over_maps(good.rec, -1), figure="pdf_ranges"
        ),
    ]
