"""Models compared: information criteria, and the check with an external shear."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array
from jaxlens.strong import _bounds, _sigma
from jaxlens.strong._bounds import Disc
from jaxlens.strong._chi2 import SIGMA, Problem
from jaxlens.strong._fit import fit
from jaxlens.strong._model import FORMS, ClusterModel, Ingredient, reported
from jaxlens.strong._result import StrongFit

SHEAR = "external_shear"
"""Name of the component that the check adds."""

MAX_SHEAR = 0.3
"""Largest shear of the check (our choice)."""


class Criteria(NamedTuple):
    """Information criteria of a fit: smaller is better, only differences for the same images mean something.

    Attributes:
        bic: -2 ln L + k ln(2 N_img) (Schwarz 1978).
        aic: -2 ln L + 2 k (Akaike 1974).
        minus_2_log_l: chi^2 of the data with the catalogue's position errors; with a free factor f on them,
            chi^2/f^2 + 4 N_img ln f.
        n_fitted: k, the free numbers and the 2 N_sys source coordinates.
        n_data: 2 N_img.
    """

    bic: float
    aic: float
    minus_2_log_l: float
    n_fitted: int
    n_data: int


def criteria(fit: StrongFit, problem: Problem) -> Criteria:
    """Information criteria of a fit. Priors do not enter; factors 2 pi sigma^2 of the errors are left out."""
    images = problem.images
    n_data, k = 2 * images.n_images, len(fit.u) + 2 * images.n_systems
    total = float(fit.chi2)
    if SIGMA in problem.bounds:
        factor = float(fit.sigma_scale)
        total = total / factor**2 + 2.0 * n_data * float(np.log(factor))
    return Criteria(total + k * float(np.log(n_data)), total + 2.0 * k, total, k, n_data)


class ShearCheck(NamedTuple):
    """A model with and without one free external shear, both at their source-plane optima.

    Attributes:
        without, with_shear: the fits.
        problem: the model with the shear.
        gamma, gamma_error: its strength for D_LS/D_S = 1, and its standard error (Laplace).
        pa_deg, pa_deg_error: its direction from +theta_1 towards +theta_2, degrees.
        delta_chi2: chi^2 of the data with less that without it.
        delta_prior: the same of the priors.
        delta_bic, delta_aic: the same of the criteria; below 0 the shear is worth its two numbers.
    """

    without: StrongFit
    with_shear: StrongFit
    problem: Problem
    gamma: float
    gamma_error: float
    pa_deg: float
    pa_deg_error: float
    delta_chi2: float
    delta_prior: float
    delta_bic: float
    delta_aic: float


def with_shear(problem: Problem, limit: float = MAX_SHEAR) -> Problem:
    """The same problem with one more component, a free external shear below `limit`.

    Raises:
        ValueError: if the model is not a `ClusterModel`, has a free shear, or something of its name.
    """
    model = problem.build
    if not isinstance(model, ClusterModel):
        raise ValueError("`problem.build` is not a ClusterModel; add the shear to the model itself.")
    free = {key.partition(".")[0] for key in problem.bounds}
    for one in model.ingredients:
        if FORMS[one.form].shape == "gamma" and one.name in free:
            raise ValueError(
                f"The model has a free external shear already ({one.name}); a second one is the same thing. "
                "Leave that one out to see what it changes."
            )
    if SHEAR in {one.name for one in model.ingredients} | free:
        raise ValueError(f"The model has a component `{SHEAR}`, the name of the check's own; rename it.")
    more = replace(model, ingredients=(*model.ingredients, Ingredient(SHEAR, "shear", {})))
    return replace(problem, build=more, bounds={**problem.bounds, f"{SHEAR}.shape": Disc(limit)})


def shear_check(u: Array, problem: Problem, limit: float = MAX_SHEAR) -> ShearCheck:
    """Fit with one free external shear from the optimum without it, and compare.

    Both fits are made in the source plane with the position errors of the catalogue (times a free factor, if
    there is one, held at its value). The one with shear starts at no shear, so that it finds the optimum
    nearby, not one of another shape of the whole model.

    Args:
        u: unbounded vector of the optimum, `(n,)`.
        problem: the fit.
        limit: largest shear.

    Raises:
        ValueError: as `with_shear`.
    """
    if SIGMA in problem.bounds:
        factor = _bounds.physical(problem.bounds, u)[SIGMA]
        u = jnp.delete(u, _sigma.place(problem))
        problem = _sigma.scaled(_sigma.without(problem), factor)
    more = with_shear(problem, limit)
    base = fit(problem, starts=[u])
    at = _bounds.total_size({name: one for name, one in problem.bounds.items() if name < f"{SHEAR}.shape"})
    found = fit(more, starts=[jnp.insert(base.u, jnp.array([at, at]), 0.0)])
    model = more.build
    assert isinstance(model, ClusterModel)

    def numbers(v: Array) -> Array:
        said = reported(model, _bounds.physical(more.bounds, v))
        return jnp.stack([said[f"{SHEAR}.gamma"], said[f"{SHEAR}.pa_deg"]])

    value, slope = np.asarray(numbers(found.u)), np.asarray(jax.jacfwd(numbers)(found.u))
    error = np.sqrt(np.einsum("ij,jk,ik->i", slope, np.asarray(found.covariance), slope))
    before, after = criteria(base, problem), criteria(found, more)
    return ShearCheck(
        without=base,
        with_shear=found,
        problem=more,
        gamma=float(value[0]),
        gamma_error=float(error[0]),
        pa_deg=float(value[1]),
        pa_deg_error=float(error[1]),
        delta_chi2=float(found.chi2 - base.chi2),
        delta_prior=float(found.chi2_prior - base.chi2_prior),
        delta_bic=after.bic - before.bic,
        delta_aic=after.aic - before.aic,
    )
