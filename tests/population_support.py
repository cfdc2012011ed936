"""Rows of clusters without the work, and the populations they belong to."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import population
from jaxlens.config_population import Population
from jaxlens.config_simulate import Simulate
from jaxlens.reproduce import CLAIMS, OURS

SEEDS = list(range(20, 28))
R = [125.0, 175.0, 225.0]


def small_row(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """A row without the work, a function of seed and settings; in `settings.name` a directory of marks.

    A file `kill_<seed>` there is a process that dies of signal 9 in the middle of this cluster, once.
    """
    del cache
    time.sleep(4.0 if (Path(settings["name"]) / "slow").exists() else 0.05)
    mark = Path(settings["name"]) / f"kill_{seed}"
    if mark.exists():
        mark.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 25:
        return {"seed": seed, "failed": "Seed 25 gives no multiple images."}
    rng = np.random.default_rng(seed)
    found = {
        name: float(rng.normal(1.0, 0.1))
        for name in ("lambda_true", "lambda_rec", "lambda_sl", "lambda_rec_scatter")
    }
    verdict = "holds here" if seed % 2 else "undecided"
    return {
        "seed": seed,
        "truth": {
            "mass_msun": [c["mass_msun_h"] / 0.7 for c in settings["cluster"]["clumps"]],
            "z_l": settings["cluster"]["z_l"], "concentration": float(rng.uniform(3, 6)),
            "substructure_fraction": 0.15, "n0_arcmin2": 432.0, "mass_ratio": 0.8,
            "caustic_margin_arcsec": [1.0, -2.0, None][seed % 3],
        },
        "strong": {"n_systems": 20, "n_images": 60, "rms_arcsec": 0.15},
        "statements": {
            claim.key: {"value": 1.0, "error": None, "verdict": verdict} for claim in (*CLAIMS, *OURS)
        },
        **found,
        "lambda_true_inner": found["lambda_true"] + 0.01,
        "shape_crossing_kpc_h": 200.0 if seed % 3 else None,
        "transition_kpc_h": 210.0 if seed % 4 else None,
        "transition_lo_kpc_h": 180.0, "transition_hi_kpc_h": 240.0,
        "transition_share_found": 0.5, "transition_interval_holds_mean": 0.6, "transitions_found": n // 2,
        "rmse_crossing_kpc_h": 300.0, "lasting_crossing_kpc_h": 220.0 if seed % 2 else None,
        "wl_better_all_over": seed == 22, "transition_is_inside": seed == 22,
        "profiles": {"r_kpc_h": R, "lambda_rec": rng.normal(1.0, 0.01, 3).tolist()},
        "realisations": n,
    }  # fmt: skip


def population_in(folder: Path) -> Population:
    """The default one, whose clusters are called by the directory of marks."""
    base = Population()
    return base.model_copy(update={"simulate": base.simulate.model_copy(update={"name": str(folder)})})


def clusters_in(folder: Path, seeds: list[int] = SEEDS) -> dict[int, Simulate]:
    return {seed: population.settings_of(seed, population_in(folder)) for seed in seeds}


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def broken_row(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """Seed 20 is out of memory, seed 21 on a machine without a package; others are whole."""
    if seed == 20:
        return {"seed": seed, "failed": "MemoryError: no message", "try_again": True}
    if seed == 21:
        raise ModuleNotFoundError("No module named 'optimistix'")
    return small_row(seed, settings, n, cache)


def other_versions(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    return small_row(seed, settings, n, cache) | {"versions": population.versions() | {"jax": "0.0.1"}}


def same_versions(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    return small_row(seed, settings, n, cache) | {"versions": population.versions()}
