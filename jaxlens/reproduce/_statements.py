"""What the paper says, as ranges of measured numbers, and whether a run agrees.

A statement holds here when the measured number and its error lie inside the range that it claims, it does not
when they lie outside, and it is undecided when the range ends within the error. The rule is the same for all,
so that no statement is judged more kindly than another.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from jaxlens.report import Verdict


@dataclass(frozen=True)
class Measured:
    """A number of a run.

    Attributes:
        value: the number; NaN where the run could not measure it.
        error: its standard error; 0 when it has no Monte-Carlo scatter (a noiseless map).
    """

    value: float
    error: float = 0.0


@dataclass(frozen=True)
class Claim:
    """A statement of the paper as a range of one measured number.

    Attributes:
        key: short name, the same in every file.
        text: what is claimed.
        quantity: the number that decides.
        low: least value with which the claim is true.
        high: largest value with which the claim is true.
        unit: unit of the number, or nothing.
        figure: stem of the figure that shows it.
    """

    key: str
    text: str
    quantity: str
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    figure: str = ""

    def judge(self, measured: Measured) -> Verdict:
        """Whether the claim holds for a measured number."""
        if not math.isfinite(measured.value) or math.isnan(measured.error):
            return "undecided"
        least, most = measured.value - measured.error, measured.value + measured.error
        if self.low <= least and most <= self.high:
            return "holds here"
        if most < self.low or least > self.high:
            return "does not hold here"
        return "undecided"

    @property
    def range(self) -> str:
        """The claimed range in words."""
        unit = f" {self.unit}" if self.unit else ""
        if self.low == -math.inf:
            return f"below {self.high:g}{unit}"
        if self.high == math.inf:
            return f"above {self.low:g}{unit}"
        return f"{self.low:g} to {self.high:g}{unit}"


CLAIMS: tuple[Claim, ...] = (
    Claim(
        "a2_is_sharp",
        "Without noise A2 recovers the truth up to one uniform factor; the errors of K2 vary over the field.",
        "half-width of the K2 PDF over that of A2, noiseless",
        low=3.0,
        figure="pdf_noiseless",
    ),
    Claim(
        "k2_is_shifted",
        "Without noise the K2 PDF peaks higher than that of A2.",
        "peak of K2 minus peak of A2, noiseless",
        low=0.01,
        figure="pdf_noiseless",
    ),
    Claim(
        "a2_peak_stays",
        "Shape noise leaves the A2 peak where it is.",
        "size of the mean shift of the A2 peak by noise",
        high=0.003,
        figure="pdf_noisy",
    ),
    Claim(
        "k2_peak_moves",
        "Shape noise moves the K2 peak down.",
        "mean shift of the K2 peak by noise",
        high=-0.003,
        figure="pdf_noisy",
    ),
    Claim(
        "k2_is_asymmetric",
        "With shape noise the K2 PDF is visibly asymmetric, that of A2 is not.",
        "quantile asymmetry of K2 minus that of A2",
        low=0.1,
        figure="pdf_noisy",
    ),
    Claim(
        "lambda_within_1_percent",
        "Compared with strong lensing at 100-300 kpc/h, the peak is within 1 % of the true value.",
        "lambda_P(100-300)/true - 1",
        low=-1.0,
        high=1.0,
        unit="%",
        figure="pdf_ranges",
    ),
    Claim(
        "full_range_more_biased",
        "The full range 100-700 kpc/h gives a more biased value than 100-300 kpc/h.",
        "|bias(100-700)| - |bias(100-300)|",
        low=0.0,
        unit="%",
        figure="pdf_ranges",
    ),
    Claim(
        "inner_scatter_is_counts",
        "The large scatter of the innermost annuli comes from the low density of background galaxies there.",
        "scatter at 100-150 kpc/h over that without depletion of the counts",
        low=1.1,
        figure="depletion",
    ),
    Claim(
        "scatter_has_minimum",
        "The scatter of lambda_rec falls with radius, reaches a minimum and rises.",
        "fraction of realisations whose scatter has a first minimum followed by a rise",
        low=0.5,
        figure="lambda_profile",
    ),
    Claim(
        "minimum_means_transition",
        "That minimum tells where the probes change places.",
        "share of realisations with their minimum within one annulus of the mean's, fitted minus perfect "
        "strong-lensing map",
        low=0.2,
        figure="scatter_criterion",
    ),
    Claim(
        "errors_cross_at_minimum",
        "The errors of the two probes become comparable where the scatter is least.",
        "distance of the crossing of the shape errors from the first minimum of the mean scatter",
        high=75.0,
        unit="kpc/h",
        figure="lambda_profile",
    ),
    Claim(
        "sl_inside_wl_outside",
        "Strong lensing is better inside the transition, corrected weak lensing outside.",
        "fraction of annuli on the side that is claimed, by the paper's RMSE",
        low=0.9,
        figure="lambda_profile",
    ),
    Claim(
        "second_factor_outside",
        "In the outermost annuli the deviation of (kappa_true - 1)/(kappa_sl - 1) from one decreases again.",
        "its mean size at 550-700 kpc/h over its maximum",
        high=1.0,
        figure="decomposition",
    ),
    Claim(
        "first_factor_outside",
        "In the outermost annuli the scatter of (kappa_wl - 1)/(kappa_true - 1) stays as it is.",
        "scatter at 550-700 kpc/h over that at 400-550",
        low=0.8,
        high=1.25,
        figure="decomposition",
    ),
    Claim(
        "tightest_where_comparable",
        "lambda is constrained best where the two probes have comparable precision.",
        "distance of the annulus with the least error of lambda_P from the crossing of the shape errors",
        high=75.0,
        unit="kpc/h",
        figure="lambda_error",
    ),
    Claim(
        "mask_is_immaterial",
        "A mask at |g| > 0.7 instead of 0.5 leaves lambda_rec(r) unchanged.",
        "largest change of the scatter inside 300 kpc/h",
        high=10.0,
        unit="%",
        figure="mask",
    ),
    Claim(
        "external_shear_hurts",
        "A fit with external shear is less accurate overall.",
        "RMSE of strong lensing at 100-700 kpc/h, with shear over without",
        low=1.0,
        figure="external_shear",
    ),
    Claim(
        "combined_is_better",
        "The probes complement each other: the combined map is at least as good as the better of the two.",
        "largest RMSE of the combined map over the better probe, outside 100 kpc/h, with lambda_P",
        high=1.0,
        figure="combined",
    ),
)
"""The statements, in the order of the paper."""


OURS: tuple[Claim, ...] = (
    Claim(
        "excess_null",
        "With a perfect strong-lensing map the excess variance finds no transition.",
        'share of realisations with "not found"',
        low=0.95,
        figure="excess_variance",
    ),
    Claim(
        "excess_right",
        "On means of 30 realisations the excess variance finds the crossing of the shape errors.",
        "share of the means within 75 kpc/h of it",
        low=0.9,
        figure="excess_variance",
    ),
    Claim(
        "combined_with_true_lambda",
        "Given the true lambda the combined map is at least as good as the better probe.",
        "largest RMSE of the combined map over the better probe, outside 100 kpc/h, less its error",
        high=1.0,
        figure="combined",
    ),
)
"""Statements of this package about its own estimators, judged alike."""


@dataclass(frozen=True)
class Judged:
    """A claim beside what a run measured.

    Attributes:
        claim: the statement.
        measured: the number.
        verdict: whether it holds.
    """

    claim: Claim
    measured: Measured
    verdict: Verdict

    def summary(self) -> dict[str, Any]:
        """Plain numbers and text for a JSON file; an open end of the range is null."""
        limits = {key: value for key, value in asdict(self.claim).items() if key in ("low", "high")}
        return {
            "statement": self.claim.text,
            "quantity": self.claim.quantity,
            "unit": self.claim.unit,
            "value": self.measured.value,
            "error": self.measured.error,
            **limits,
            "verdict": self.verdict,
            "figure": self.claim.figure,
        }


def judge(measured: Mapping[str, Measured], claims: Iterable[Claim] = CLAIMS) -> list[Judged]:
    """Every claim beside its number.

    Args:
        measured: numbers by the key of the claim; a claim without one is undecided.
        claims: the claims.

    Raises:
        KeyError: if a number belongs to no claim.
    """
    claims = tuple(claims)
    unknown = sorted(set(measured) - {claim.key for claim in claims})
    if unknown:
        raise KeyError(f"No claim is called {', '.join(unknown)}.")
    nothing = Measured(math.nan, math.nan)
    return [Judged(c, m, c.judge(m)) for c in claims for m in [measured.get(c.key, nothing)]]
