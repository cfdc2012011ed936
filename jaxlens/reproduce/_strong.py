"""The strong-lensing side of the experiment: fits of the mock that know nothing of the truth."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlens import config, io, strong, workflow, workflow_simulate
from jaxlens import lens as lensing
from jaxlens._config import dumps
from jaxlens._types import ComplexMap, Map
from jaxlens.config_simulate import Simulate
from jaxlens.grid import Grid, rebin
from jaxlens.lens import Lens
from jaxlens.simulate import StrongMock

FIELD_MASS_MSUN_H = 3e10
"""Least mass of the members of the `field` model (our choice: below it a member moves no image)."""

_INSIDE = 8
# Points per side of a pixel over which a model is averaged.


@dataclass(frozen=True)
class SLModel:
    """A fitted strong-lensing model.

    Attributes:
        name: `rectangle`, `field` or `shear`.
        setup: the problem.
        fit: the best start, of the problem filled up by `strong.rounded`.
        members: number of member galaxies of the model.
    """

    name: str
    setup: workflow.Setup
    fit: strong.StrongFit
    members: int


def write_problem(mock: StrongMock, said: Simulate, members: str, folder: Path) -> None:
    """Write `strong.toml` and its catalogues, so that `jaxlens strong` fits the same; boxes are the paper's.

    Args:
        mock: the cluster with its images.
        said: the configuration of the simulation.
        members: `rectangle` around the images as in the paper, or `field`.
        folder: where; made if needed.
    """
    chosen = said.model_copy(update={"strong": said.strong.model_copy(update={"members": members})})
    columns = workflow_simulate.member_columns(mock)
    if members == "field":
        keep = (columns["bcg"] == 1) | (columns["mass_msun"] * said.cosmology.h >= FIELD_MASS_MSUN_H)
        columns = {name: values[keep] for name, values in columns.items()}
    with io.staging(folder) as stage:
        io.write_table(stage / "members.ecsv", columns)
        io.write_table(stage / "images.ecsv", workflow_simulate.image_columns(mock))
        table = workflow_simulate.strong_configuration(mock, chosen, widen=False)
        (stage / "strong.toml").write_text(dumps(table), encoding="utf-8")


def fit_model(
    name: str, folder: Path, seed: int, *, on_start: Callable[[strong.Start], None] | None = None
) -> SLModel:
    """Fit the problem of a folder from its default starts."""
    setup = workflow.assemble(config.read(folder / "strong.toml"), folder / "strong.toml")
    assert setup.config is not None
    fit = strong.fit(
        strong.rounded(setup.problem),
        key=jax.random.key(seed),
        n_starts=setup.config.fit.starts,
        start=setup.start,
        on_start=on_start,
    )
    members = setup.model.members
    return SLModel(name, setup, fit, 0 if members is None else len(members.luminosity))


def with_shear(model: SLModel) -> SLModel:
    """The same model with one free external shear, fitted from the optimum without it."""
    check = strong.shear_check(model.fit.u, strong.rounded(model.setup.problem))
    more = strong.with_shear(model.setup.problem)
    return replace(model, name="shear", setup=replace(model.setup, problem=more), fit=check.with_shear)


_kappa_and_gamma = jax.jit(lensing.kappa_and_gamma)


def on_pixels(lens: Lens, grid: Grid, ratio: float) -> tuple[Map, ComplexMap]:
    """Convergence and reduced shear of a lens, averaged over the pixels of a map.

    g = gamma/(1 - kappa) of the averages, as for the mock.

    Args:
        lens: the lens.
        grid: pixels of the map.
        ratio: D_LS/D_S.
    """
    points = Grid((_INSIDE * grid.shape[0], _INSIDE * grid.shape[1]), grid.pixel / _INSIDE, grid.centre)
    kappa, shear = (rebin(ratio * part, points, _INSIDE)[0] for part in _kappa_and_gamma(lens, points.theta))
    return kappa, shear / (1.0 - kappa)


_WINDOW, _MARGIN = 16.0, 25.0
# Half the side of the window of predicted images is a multiple of the one, and larger than the field of the
# observed ones by the other at least, arcsec: clusters share compiled programs.


def _predicted(fit: strong.StrongFit, images: strong.ImageCatalogue) -> strong.PredictedImages:
    """Images of the sources by `tensor`."""
    half = 0.5 * float(np.ptp(np.asarray(images.theta), axis=0).max())
    margin = _WINDOW * math.ceil((half + _MARGIN) / _WINDOW) - half
    whole = strong.rounded_images(images)
    found = strong.predict(
        strong.Prediction(fit.lens, fit.dls_ds), whole, definitions=("tensor",), margin=margin
    )["tensor"]
    return found.first(images.n_images, images.n_systems)


def statistics(model: SLModel) -> dict[str, Any]:
    """The numbers of the paper: systems, images, rms and reduced chi^2, counted both ways.

    Images are predicted for the paper's model alone; of the others the source-plane chi^2 says as much.
    A reduced chi^2 without degrees of freedom is None.
    """
    images, fit = model.setup.problem.images, model.fit
    n, k = 2 * images.n_images, len(fit.u)
    said: dict[str, Any] = {
        "n_systems": images.n_systems,
        "n_images": images.n_images,
        "n_parameters": k,
        "n_members": model.members,
        "chi2_source_plane": float(fit.chi2),
        "at_bound": list(fit.at_bound),
        "starts": len(fit.starts),
        "starts_agreeing": fit.agreeing,
        "converged": fit.converged,
    }
    if model.name != "rectangle":
        return said
    predicted = _predicted(fit, images)
    chi2, dof = predicted.chi2(images), n - k - 2 * images.n_systems
    return said | {
        "n_produced": predicted.n_produced,
        "rms_arcsec": predicted.rms(images),
        "chi2_image_plane": chi2,
        "chi2_nu": chi2 / (n - k) if n > k else None,
        "chi2_nu_with_sources": chi2 / dof if dof > 0 else None,
    }
