"""Sweeps that the paper announces: density of galaxies and depth of strong lensing against the transition."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import io, monte_carlo
from jaxlens.config_simulate import Simulate
from jaxlens.reproduce import _strong
from jaxlens.reproduce._analysis import errors, excess
from jaxlens.reproduce._cluster import Builder, ClusterRun, Variant, fit_seed, noise_key
from jaxlens.reproduce._clusters import stamp
from jaxlens.simulate import Mock, mock, strong_mock

VALUES: dict[str, tuple[float, ...]] = {
    "n0": (50.0, 100.0, 200.0, 432.0, 800.0),
    "m_tele": (28.0, 28.5, 29.0, 29.5, 30.0),
}
"""Galaxies per arcmin^2 far from the core, and the limiting magnitude of the images (our choice)."""

LABELS = {"n0": r"$n_0$ [arcmin$^{-2}$]", "m_tele": r"$m_{\rm tele}$ [AB mag]"}


def _row(
    value: float, made: Mock, said: Simulate, model: _strong.SLModel, builder: Builder, n: int
) -> dict[str, Any]:
    """One point of a sweep."""
    kappa_sl, g_sl = _strong.on_pixels(model.fit.lens, builder.grid, builder.ratio)
    setup = builder.setup(kappa_sl, g_sl)
    noisy = monte_carlo.lambda_profiles(noise_key(made.strong.seed), setup, n)
    variant = Variant(setup, monte_carlo.noiseless(setup)[0], noisy)
    found = ClusterRun(made.strong.seed, said, made, {}, {"rectangle": variant}, n)
    outcome, wrong = excess(found, variant), errors(found, variant)
    lam = np.asarray(noisy.good.rec.median)[:, 0] / float(variant.clean.a2.median[-1]) - 1.0
    return {
        "value": value,
        "n_systems": made.strong.catalogue.n_systems,
        "n_images": made.strong.catalogue.n_images,
        "transition_kpc_h": outcome.mean_radius,
        "transition_lo_kpc_h": float(outcome.mean.lo) if math.isfinite(outcome.mean_radius) else math.nan,
        "transition_hi_kpc_h": float(outcome.mean.hi) if math.isfinite(outcome.mean_radius) else math.nan,
        "share_found": outcome.share,
        "shape_crossing_kpc_h": wrong.first,
        "lambda_bias": float(lam.mean()),
        "lambda_scatter": float(lam.std(ddof=1)),
    }


def sweep(
    name: str,
    seed: int,
    settings: Simulate,
    folder: Path,
    *,
    n: int = 256,
    values: Sequence[float] | None = None,
    on_step: Callable[[str], object] = lambda _: None,
) -> list[dict[str, Any]]:
    """One cluster with other galaxy densities (`n0`) or depths of strong lensing (`m_tele`).

    Cluster, sources and noise keys are those of the seed throughout: points differ by the swept number
    alone. Finished points are kept in the folder and not computed again.

    Args:
        name: `n0` or `m_tele`.
        seed: of the cluster.
        settings: the configuration of the simulation.
        folder: for one file per point and the strong-lensing problems.
        n: noise realisations.
        values: default `VALUES`.
        on_step: called with the name of each step.

    Returns:
        Rows with the transition, its interval, the crossing of the shape errors, and bias and scatter of
        lambda_P (median, 100-300 kpc/h) in units of the true value.

    Raises:
        ValueError: for an unknown name, or a file of other settings.
    """
    if name not in VALUES:
        raise ValueError(f"`name` is {name!r}; sweep one of {', '.join(VALUES)}.")
    made_with = {"seed": seed, **stamp(settings, n)}
    made: Mock | None = None
    base: _strong.SLModel | None = None
    rows: list[dict[str, Any]] = []
    for value in VALUES[name] if values is None else values:
        path = folder / f"{name}_{value:g}.json"
        if path.exists():
            said = json.loads(path.read_text(encoding="utf-8"))
            if said["made_with"] != made_with:
                raise ValueError(f"{path} was made with other settings; give an empty directory.")
            rows.append(said["row"])
            continue
        if made is None:
            made = mock(seed, settings.settings, on_step=on_step)
        on_step(f"{name} = {value:g}")
        if name == "n0":
            if base is None:
                base = _fitted(made, settings, folder / "strong", seed)
            density = replace(made.strong.settings.shear, density_arcmin2=value)
            row = _row(value, made, settings, base, Builder(made, settings, density), n)
        else:
            deeper = replace(settings.settings, images=replace(settings.images, m_tele=value))
            other = replace(made, strong=strong_mock(seed, deeper))
            if not other.strong.catalogue.n_systems:
                rows.append({"value": value, "failed": "no multiple images"})
                continue
            model = _fitted(other, settings, folder / f"strong_{value:g}", seed)
            row = _row(value, other, settings, model, Builder(other, settings), n)
        io.write_json(path, {"made_with": made_with, "row": row})
        rows.append(json.loads(path.read_text(encoding="utf-8"))["row"])
    return rows


def _fitted(made: Mock, settings: Simulate, folder: Path, seed: int) -> _strong.SLModel:
    _strong.write_problem(made.strong, settings, "rectangle", folder)
    return _strong.fit_model("rectangle", folder, fit_seed(seed))
