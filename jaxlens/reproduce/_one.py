"""One cluster from its seed to its verdicts, as plain data: the row of a table of many."""

import math
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from jaxlens import mass_sheet
from jaxlens.config_simulate import Simulate
from jaxlens.reproduce._analysis import Analysis, analyse
from jaxlens.reproduce._cluster import FIRST, VARIANTS, ClusterRun, run
from jaxlens.reproduce._numbers import INNER, OUTER, numbers, own_numbers
from jaxlens.reproduce._statements import OURS, judge
from jaxlens.reproduce._strong import statistics

SCRATCH = "jaxlens_cluster_"
"""Beginning of the name of the temporary directory of a cluster."""

VARIANTS_MANY = tuple(name for name in VARIANTS if name != "field")
"""Variants that the statements need."""


def _profiles(found: ClusterRun, made: Analysis) -> dict[str, list[float]]:
    """What a population keeps of lambda(r): means over realisations in the annuli of the figures."""
    good, mean = found.base.noisy.good, lambda many: np.asarray(many).mean(axis=0)[FIRST:]
    profiles = {
        "r_kpc_h": found.r[FIRST:],
        "lambda_rec": mean(good.rec_profile.median),
        "lambda_rec_lo": mean(good.rec_profile.lo),
        "lambda_rec_hi": mean(good.rec_profile.hi),
        "lambda_map": mean(good.a2_profile.median),
        "shape_error_wl": made.errors.shape_wl,
        "shape_error_sl": made.errors.shape_sl,
        "rmse_wl": made.errors.wl,
        "rmse_sl": made.errors.sl,
        "excess_ratio": np.asarray(made.excess["rectangle"].mean.q)[FIRST:],
    }
    return {name: np.asarray(values, float).tolist() for name, values in profiles.items()}


def _truth(found: ClusterRun) -> dict[str, Any]:
    """What the cluster is made of, for correlations."""
    clumps, said = found.mock.cluster.clumps, found.settings
    masses = [one.mass_msun for one in clumps]
    first = said.cluster.clumps[0].mass_msun_h
    weigh = lambda values: float(np.average(values, weights=masses))
    line_of_sight = [abs(one.turn[2][2]) for one in clumps]
    return {
        "z_l": said.cluster.z_l,
        "mass_msun": masses,
        "mass_ratio": said.cluster.clumps[1].mass_msun_h / first if len(clumps) > 1 else math.nan,
        "pa_difference_deg": said.cluster.pa_difference_deg,
        "concentration_scatter": said.cluster.concentration_scatter,
        "separation_kpc_h": math.dist(*said.cluster.positions_kpc_h()[:2]) if len(clumps) > 1 else 0.0,
        "concentration": weigh([one.concentration for one in clumps]),
        "concentrations": [one.concentration for one in clumps],
        "substructure_fraction": sum(one.subhalo_mass_msun for one in clumps) / sum(masses),
        "cos_line_of_sight": weigh(line_of_sight),
        "cos_lines_of_sight": line_of_sight,
        "n0_arcmin2": said.shear.density_arcmin2,
        "m_tele": said.images.m_tele,
        "members": said.strong.members,
        "kappa_mean": float(np.mean(np.asarray(found.mock.bins[0].kappa))),
        "caustic_margin_arcsec": found.mock.strong.caustic_margin,
    }


def one_cluster(
    seed: int, settings: Simulate, n: int, *, on_step: Callable[[str], object] = lambda _: None
) -> dict[str, Any]:
    """One cluster from its seed to its verdicts, as plain data; the same for the same seed and settings.

    lambda_true is the median of lambda_map at 100-700 kpc/h without noise, as in the paper; lambda_P
    (`lambda_rec`) and the strong-lensing map's own factor (`lambda_sl`) are medians at 100-300 kpc/h, as are
    `lambda_true_inner` and `lambda_rec_noiseless`, with which `lambda_sl` is to be compared. Numbers that
    need a crossing or a transition are NaN without one. `lasting_crossing_kpc_h` and `wl_better_all_over` are
    what the rule of the excess variance makes of the true errors.

    Args:
        seed: of everything.
        settings: the configuration of the simulation.
        n: noise realisations.
        on_step: called with the name of each step.
    """
    with TemporaryDirectory(prefix=SCRATCH) as folder:
        found = run(seed, settings, Path(folder), n=n, variants=VARIANTS_MANY, on_step=on_step)
    on_step("measuring")
    made = analyse(found)
    judged = judge(numbers(found, made)) + judge(own_numbers(made), OURS)
    main, good = made.excess["rectangle"], found.base.noisy.good
    setup = found.base.setup
    low, high = setup.ranges[INNER]
    inner = setup.weight * ((setup.radius >= low) & (setup.radius < high))
    lam, clean, transition = np.asarray(good.lam), found.base.clean, main.mean
    # The mean map has a radius, and the bootstrap an interval: each may be there without the other.
    interval = math.isfinite(main.mean_radius) and float(transition.share) > 0.0
    minimum, lasting = made.criterion.minimum, made.errors.lasting
    paper = (at for at, way in made.errors.crossings if way > 0)
    return {
        "seed": seed,
        "truth": _truth(found),
        "strong": statistics(found.models["rectangle"]),
        "statements": {
            one.claim.key: {
                "value": one.measured.value,
                "error": one.measured.error,
                "verdict": one.verdict,
            }
            for one in judged
        },
        "lambda_true": float(clean.a2.median[OUTER]),
        "lambda_true_inner": float(clean.a2.median[INNER]),
        "lambda_rec_noiseless": float(clean.rec.median[INNER]),
        "lambda_rec": float(lam.mean()),
        "lambda_rec_scatter": float(lam.std(ddof=1)),
        "lambda_sl": float(mass_sheet.median(setup.kappa_sl, setup.kappa_true, inner)),
        "shape_crossing_kpc_h": made.errors.first,
        "shape_crossing_error_kpc_h": made.errors.spread,
        "lasting_crossing_kpc_h": float(lasting.radius) if bool(lasting.found) else math.nan,
        "wl_better_all_over": bool(lasting.inside),
        "rmse_crossing_kpc_h": next(paper, math.nan),
        "transition_kpc_h": main.mean_radius,
        "transition_lo_kpc_h": float(transition.lo) if interval else math.nan,
        "transition_hi_kpc_h": float(transition.hi) if interval else math.nan,
        "transition_is_inside": bool(transition.transition.inside),
        "transition_share_found": main.share,
        "transition_share_inside": float(main.inside.mean()),
        "transition_share_near_crossing": main.near(made.errors.first),
        "transitions_found": int(np.isfinite(main.radius).sum()),
        "transition_of_means_kpc_h": main.groups.tolist(),
        "means_inside": main.groups_inside.tolist(),
        "excess_ratio_of_means": main.q_groups.tolist(),
        "transition_interval_holds_mean": main.coverage,
        "transition_interval_holds_crossing": main.covers(made.errors.first),
        "scatter_minimum_kpc_h": float(minimum.radius) if bool(minimum.found) else math.nan,
        "profiles": _profiles(found, made),
    }
