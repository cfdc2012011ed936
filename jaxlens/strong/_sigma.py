"""Position errors that are not known: rescaled after the fit, or a free factor of it.

The Laplace covariance with a free factor f = exp(tau) comes from the second derivatives of

    -ln p = |d|^2/(2 f^2) + N tau + |prior rows|^2/2,   d the rows with the catalogue's errors,

which are J^T J/f^2 in the model's numbers, -2 J^T d/f^2 mixed and 2 |d|^2/f^2 in tau; the first is the
Gauss-Newton one, the other two are exact.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, ScalarLike
from jaxlens.strong import _bounds, _chi2
from jaxlens.strong._bounds import Box
from jaxlens.strong._chi2 import SIGMA, Problem
from jaxlens.strong._solver import value_and_jacobian

LIMITS = (0.1, 10.0)
"""The box of the free factor, uniform in its logarithm (our choice)."""


def free_sigma(problem: Problem, limits: tuple[float, float] = LIMITS) -> Problem:
    """The same problem with a free factor on all position errors, `errors.sigma_scale`.

    Args:
        problem: the fit.
        limits: of the factor.

    Raises:
        ValueError: if the limits are not positive and ascending, or no image is left to tell the factor from
            the positions of the sources.
    """
    if not 0.0 < limits[0] < limits[1]:
        raise ValueError(f"`limits` is {limits}; give two positive, ascending factors.")
    if n_constraints(problem) <= 0:
        raise ValueError("Every system has one image: nothing says how large the position errors are.")
    bounds = {**problem.bounds, SIGMA: Box(*limits, log=True, weak=False)}
    return replace(problem, bounds=bounds)


def n_constraints(problem: Problem) -> int:
    """2 N_img - 2 N_sys: image coordinates, less those of the sources."""
    return 2 * (problem.images.n_images - problem.images.n_systems)


def degrees_of_freedom(problem: Problem) -> int:
    """`n_constraints` less the free numbers of the model (not the factor on the errors)."""
    return n_constraints(problem) - _bounds.total_size(without(problem).bounds)


def without(problem: Problem) -> Problem:
    """The problem without the free factor."""
    bounds = {name: bound for name, bound in problem.bounds.items() if name != SIGMA}
    return replace(problem, bounds=bounds)


def scaled(problem: Problem, factor: ScalarLike) -> Problem:
    """The problem with all position errors times `factor`."""
    return replace(problem, images=_chi2.scale_sigma(problem.images, factor))


def place(problem: Problem) -> int:
    """Where the factor stands in u."""
    before = {name: bound for name, bound in problem.bounds.items() if name < SIGMA}
    return _bounds.total_size(before)


def best_factor(u: Array, problem: Problem) -> float:
    """The factor that maximises the posterior, sources integrated over, for the model at u; inside its box.

    f^2 = chi^2/(2 N_img - 2 N_sys). With the sources at their best positions it would be chi^2/(2 N_img),
    too small however many systems there are: each brings two numbers of its own (Neyman & Scott 1948).

    Args:
        u: unbounded vector of the model's numbers, `(n - 1,)`.
        problem: with the free factor.
    """
    box = problem.bounds[SIGMA]
    assert isinstance(box, Box)
    chi2 = float(chi2_at(u, without(problem)))
    return float(np.clip((chi2 / n_constraints(problem)) ** 0.5, float(box.lo), float(box.hi)))


@eqx.filter_jit
def chi2_at(u: Array, problem: Problem) -> Array:
    """Source-plane chi^2 of the data with the catalogue's errors, `()`."""
    return _chi2.chi2_source(problem.predict(u), problem.images)


@eqx.filter_jit
def free_information(u: Array, problem: Problem) -> Array:
    """Second derivatives of -ln p with the free factor at u `(n,)`; see the head of this module."""
    r, jacobian = value_and_jacobian(lambda v: _chi2.residuals(v, problem), u)
    k, n_data = place(problem), 2 * problem.images.n_images
    # d ln f/du: the rows are d/f, so that their own derivative by tau is -d/f.
    tau = jax.grad(lambda v: jnp.log(_bounds.physical(problem.bounds, v)[SIGMA]))(u)[k]
    data, slopes = r[:n_data], jacobian[:n_data]
    mixed = -2.0 * tau * (slopes.T @ data)
    total = jacobian.T @ jacobian
    total = total.at[k, :].set(mixed).at[:, k].set(mixed)
    return total.at[k, k].set(2.0 * tau**2 * (data @ data))
