"""The table of a population and its profiles, as arrays for Parquet and FITS."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxlens.reproduce import CLAIMS, NOT_APPLICABLE, OURS

CODES = {"holds here": 1, "does not hold here": 0, "undecided": -1, "failed": -2, NOT_APPLICABLE: -3}
"""Verdicts as numbers in the table."""

NUMBERS = (
    "lambda_true", "lambda_true_inner", "lambda_rec", "lambda_rec_scatter", "lambda_rec_noiseless",
    "lambda_sl", "shape_crossing_kpc_h", "shape_crossing_error_kpc_h", "rmse_crossing_kpc_h",
    "transition_kpc_h", "transition_lo_kpc_h", "transition_hi_kpc_h", "transitions_found",
    "transition_share_found", "transition_is_inside", "transition_share_inside",
    "lasting_crossing_kpc_h", "wl_better_all_over",
    "transition_share_near_crossing", "transition_interval_holds_mean", "transition_interval_holds_crossing",
    "scatter_minimum_kpc_h",
)  # fmt: skip
"""Numbers of a row that go into the table as they are."""

TRUTH = (
    "z_l", "mass_ratio", "separation_kpc_h", "pa_difference_deg", "concentration_scatter", "concentration",
    "substructure_fraction", "cos_line_of_sight", "n0_arcmin2", "m_tele", "kappa_mean",
    "caustic_margin_arcsec",
)  # fmt: skip
"""Properties of a cluster in the table."""

STRONG = ("n_systems", "n_images", "n_members", "rms_arcsec", "chi2_nu", "starts_agreeing", "converged")
"""Numbers of the strong-lensing model in the table."""


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


NEEDS = {
    "errors_cross_at_minimum": "shape_crossing_kpc_h",
    "tightest_where_comparable": "shape_crossing_kpc_h",
    "excess_right": "shape_crossing_kpc_h",
    "sl_inside_wl_outside": "rmse_crossing_kpc_h",
}
"""Statements about a crossing of errors, and the number of a row that is missing without one."""


def applicable(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows with the verdict "not applicable" for statements about a crossing where there is none.

    One cluster without a crossing leaves such a statement open, or contradicts it; a share over clusters
    says how often it is right where it says something.
    """
    result = []
    for row in rows:
        said = dict(row.get("statements", {}))
        for key, number in NEEDS.items():
            value = row.get(number)
            if key in said and (value is None or math.isnan(value)):
                said[key] = {**said[key], "verdict": NOT_APPLICABLE}
        result.append({**row, "statements": said} if said else dict(row))
    return result


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """The table: one row per cluster, failed ones with their reason and NaN.

    Args:
        rows: from `run`.

    Returns:
        Columns by name, `(n,)` each: `seed, failed` (text), `total_mass_msun`, those of `TRUTH` (the
        concentration is a mean by mass), `STRONG` and `NUMBERS`, and for every statement its number, error
        and verdict (1 holds, 0 does not, -1 undecided, -2 the cluster failed, -3 not applicable, see
        `applicable`).
    """
    rows = applicable(rows)
    inside = lambda row, part: row.get(part) or {}
    masses = [inside(row, "truth").get("mass_msun") or [math.nan] for row in rows]
    found: dict[str, np.ndarray] = {
        "seed": np.array([row["seed"] for row in rows], np.int64),
        "failed": np.array([row.get("failed", "") for row in rows], dtype=str),
        "total_mass_msun": np.array([sum(one) for one in masses]),
        "members": np.array([inside(row, "truth").get("members", "") for row in rows], dtype=str),
    }
    for part, names in (("truth", TRUTH), ("strong", STRONG)):
        for name in names:
            found[name] = np.array([_number(inside(row, part).get(name)) for row in rows])
    for name in NUMBERS:
        found[name] = np.array([_number(row.get(name)) for row in rows])
    for claim in (*CLAIMS, *OURS):
        said = [inside(row, "statements").get(claim.key, {}) for row in rows]
        found[claim.key] = np.array([_number(one.get("value")) for one in said])
        found[f"{claim.key}_error"] = np.array([_number(one.get("error")) for one in said])
        found[f"{claim.key}_verdict"] = np.array([CODES[one.get("verdict", "failed")] for one in said])
    return found


def profiles(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Profiles of the clusters that did not fail: `seed (n,)`, and every profile `(n, annulus)`."""
    good = [row for row in rows if "failed" not in row]
    names = list(good[0]["profiles"]) if good else []
    stack = lambda name: np.array([[_number(one) for one in row["profiles"][name]] for row in good])
    return {"seed": np.array([row["seed"] for row in good], np.int64)} | {name: stack(name) for name in names}
