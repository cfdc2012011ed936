"""The files of the experiment: figures, tables, `summary.json`, and `report.html` that holds it all."""

import math
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlens import io, plotting, radial
from jaxlens.report import Section, html
from jaxlens.reproduce._analysis import Analysis
from jaxlens.reproduce._cluster import FIRST, ClusterRun
from jaxlens.reproduce._figures import figures
from jaxlens.reproduce._numbers import numbers, own_numbers
from jaxlens.reproduce._page import page
from jaxlens.reproduce._paper import rows
from jaxlens.reproduce._statements import OURS, judge
from jaxlens.reproduce._strong import statistics


def summary(found: ClusterRun, made: Analysis, seconds: dict[str, float]) -> dict[str, Any]:
    """The content of `summary.json`."""
    strong = {name: statistics(model) for name, model in found.models.items()}
    table = rows(found, strong["rectangle"])
    transitions = {
        name: {
            "mean_kpc_h": one.mean_radius,
            "mean_interval_kpc_h": [float(one.mean.lo), float(one.mean.hi)] if one.mean.share > 0.0 else None,
            "mean_is_inside": bool(one.mean.transition.inside),
            "share_found": one.share,
            "share_inside": float(one.inside.mean()),
            "one_map_16_84_kpc_h": _percentiles(one.radius),
            "interval_coverage": _coverage(one.lo, one.hi, one.radius, one.mean_radius),
            "means_of_30_kpc_h": one.groups.tolist(),
            "means_of_30_inside": one.groups_inside.tolist(),
        }
        for name, one in made.excess.items()
    }
    wrong = made.errors
    return {
        "seed": found.seed,
        "name": found.settings.name,
        "version": metadata.version("jaxlens-cluster"),
        "realisations": found.n,
        "realisations_bad": found.base.noisy.n_bad,
        "realisations_with_empty_pixels": found.base.noisy.n_empty,
        "strong": strong,
        "numbers": {
            row.key: {
                "what": row.text,
                "paper": row.paper,
                "value": row.measured.value,
                "error": row.measured.error,
                "unit": row.unit,
            }
            for row in table
        },
        "statements": {one.claim.key: one.summary() for one in judge(numbers(found, made))},
        "own_statements": {one.claim.key: one.summary() for one in judge(own_numbers(made), OURS)},
        "transition": transitions,
        "crossings_kpc_h": {
            "rmse": [[at, way] for at, way in wrong.crossings],
            "shape": [[at, way] for at, way in wrong.shape_crossings],
        },
        "scatter_minimum_kpc_h": {
            "fitted": float(made.criterion.minimum.radius),
            "perfect": float(made.criterion.null_minimum.radius),
            "agreement": float(made.criterion.agreement),
            "null_agreement": float(made.criterion.null_agreement),
        },
        "seconds": seconds,
        "machine": {"cpu": platform.machine(), "jax": jax.__version__, "devices": jax.device_count()},
    }


def _percentiles(radius: np.ndarray) -> list[float] | None:
    known = radius[np.isfinite(radius)]
    return None if not len(known) else [float(x) for x in np.percentile(known, [16.0, 84.0])]


def _coverage(lo: np.ndarray, hi: np.ndarray, radius: np.ndarray, truth: float) -> float | None:
    """Share of the realisations with a transition whose interval holds the radius of the mean."""
    known = np.isfinite(radius)
    if not known.any() or not math.isfinite(truth):
        return None
    return float(((lo <= truth) & (truth <= hi))[known].mean())


def profile_columns(found: ClusterRun, made: Analysis) -> dict[str, np.ndarray]:
    """Columns of `profiles.ecsv`, one row for each annulus from 100 kpc/h."""
    edges = np.asarray(found.base.setup.rings.edges)[FIRST:]
    good, wrong, split = found.base.noisy.good, made.errors, made.decomposition
    mean = lambda values: np.asarray(values).mean(axis=0)[FIRST:]
    q = lambda name: np.asarray(made.excess[name].mean.q)[FIRST:]
    return {
        "r_in_kpc_h": edges[:-1],
        "r_out_kpc_h": edges[1:],
        "n_pixels": np.asarray(found.base.setup.rings.count)[FIRST:],
        "lambda_rec": mean(good.rec_profile.median),
        "lambda_rec_scatter": mean(radial.scatter(good.rec_profile)),
        "lambda_map": split["first_median"],
        "lambda_map_scatter": split["first_scatter"],
        "second_factor": split["second_median"],
        "kappa_wl_corrected": mean(good.kappa.median),
        "rmse_wl": wrong.wl,
        "rmse_sl": wrong.sl,
        "shape_error_wl": wrong.shape_wl,
        "shape_error_sl": wrong.shape_sl,
        "lambda_error_scatter": made.lambda_errors["scatter"],
        "lambda_error_bias": made.lambda_errors["bias"],
        "excess_ratio": q("rectangle"),
        "combined_over_better": made.combined["ratio"],
        "combined_over_better_true_lambda": made.combined_true["ratio"],
    }


def write(
    found: ClusterRun,
    made: Analysis,
    out: str | Path,
    *,
    seconds: dict[str, float] | None = None,
    more: Sequence[Section] = (),
) -> dict[str, Any]:
    """Write figures, tables, maps, summary and report to the directory `out`, all or none; the summary.

    Args:
        found, made: a cluster and its analysis.
        out: the directory.
        seconds: wall-clock time by stage, for the summary.
        more: further sections of the report.
    """
    content = summary(found, made, seconds or {})
    drawn = figures(found, made)
    setup, plane = found.base.setup, found.mock.cluster.plane
    bin_one = found.mock.bins[0]
    header = {
        "ZLENS": float(plane.z_l),
        "ZSOURCE": bin_one.z_s,
        "DLSDS": float(plane.dls_ds(bin_one.z_s)),
        "SMOOTHAS": setup.smoothing,
        "SEED": found.seed,
        "BUNIT": "",
    }
    mask = np.asarray(setup.weight) > 0.0
    good = np.flatnonzero(np.asarray(found.base.noisy.measured.good))
    maps = {
        "kappa_wl": np.asarray(found.a2[int(good[0])]),
        # Of the map as it is, like the map itself: `jaxlens lambda` corrects both.
        "kappa_wl_error": np.asarray(found.a2)[good].std(axis=0, ddof=1),
        "kappa_wl_noiseless": np.asarray(setup.clean["A2"]),
        "kappa_sl": np.asarray(setup.kappa_sl),
        "kappa_true": np.asarray(setup.kappa_true),
    }
    with io.staging(out) as stage:
        pictures = {name: plotting.save(one, stage / "figures" / name)[1] for name, one in drawn.items()}
        for name, values in maps.items():
            # Only weak lensing knows nothing of masked pixels; `jaxlens lambda` reads these maps as they are.
            known = np.where(mask, values, np.nan) if name.startswith("kappa_wl") else values
            io.write_map(stage / f"{name}.fits", known, setup.grid, header=header)
        io.write_table(stage / "profiles.ecsv", profile_columns(found, made), meta={"seed": found.seed})
        io.write_json(stage / "summary.json", content)
        text = html(page(found, made, content, pictures, more))
        (stage / "report.html").write_text(text, encoding="utf-8")
    return content


def verdict(content: dict[str, Any]) -> str:
    """The last lines on the screen."""
    strong, numbers_ = content["strong"]["rectangle"], content["numbers"]
    lines = [
        f"{strong['n_systems']} systems, {strong['n_images']} images; rms {strong['rms_arcsec']:.3f} arcsec, "
        f"chi^2/nu {numbers_['chi2_nu']['value']:.2f} (paper 22, 68, 0.186, 0.95)",
        f"lambda_P: A2 {numbers_['a2']['value']:.3f} without noise, {numbers_['a2_noisy']['value']:.3f} "
        f"with; "
        f"K2 {numbers_['k2']['value']:.3f}, {numbers_['k2_noisy']['value']:.3f}; lambda_rec 100-300 kpc/h "
        f"{numbers_['rec_inner']['value']:.3f}",
    ]
    main = content["transition"]["rectangle"]
    where = "not found" if not math.isfinite(main["mean_kpc_h"]) else f"{main['mean_kpc_h']:.0f} kpc/h"
    if main["mean_is_inside"]:
        where = "weak lensing better from the innermost annulus on"
    lines.append(
        f"transition by excess variance: {where}"
        f" on the mean, found in {100.0 * main['share_found']:.0f} % of single realisations"
    )
    said = [one["verdict"] for one in content["statements"].values()]
    lines.append(
        f"of {len(said)} statements of the paper {said.count('holds here')} hold here, "
        f"{said.count('does not hold here')} do not, {said.count('undecided')} are undecided: see report.html"
    )
    return "\n".join(lines)
