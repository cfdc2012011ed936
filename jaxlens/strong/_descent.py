"""One start of a fit: Levenberg-Marquardt on the source-plane residuals.

The schedule that makes random starts safe: the floor s of the source-plane covariance is lowered from
1 arcsec to 0.01 arcsec, a few dozen steps each, and then removed. Large s makes the misfit nearly
quadratic in the source positions, small s lets the magnifications weigh the images.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array
from jaxlens.strong import _bounds, _chi2
from jaxlens.strong._chi2 import Problem
from jaxlens.strong._solver import levenberg_marquardt, value_and_jacobian

FLOORS = (1.0, 0.1, 0.01, 0.0)
"""Floors s of the annealing, arcsec of the source plane (our choice, measured on five clusters)."""

STEPS = 40
"""Steps of one Levenberg-Marquardt run; the last floor is repeated until it has converged."""

MAX_ROUNDS = 10
"""Runs of `STEPS` steps at the last floor before a start is called not converged."""

RELEASE = 1.5
"""|u| to which a number at its bound is set back once before its start ends (our choice)."""

GRADIENT_TOLERANCE = 1e-4
"""Largest cosine between the residual vector and a column of the Jacobian at a minimum."""

EXACT = 1e-10
"""A chi^2 below this is a perfect fit, whose residuals are rounding errors without a direction."""

CHANGE_TOLERANCE = 1e-6
"""Largest relative fall of chi^2 in the last run at a minimum."""


class Start(NamedTuple):
    """One start of a fit, with what became of it. Plain Python numbers.

    Attributes:
        number: 1 is the given (or central) start.
        chi2: chi^2 of data and priors at its end; after an image-plane stage, that of this stage.
        chi2_data: chi^2 of the data alone.
        converged: gradient and last change below their tolerances; this, the next three and the steps are
            those of the descent in the source plane.
        gradient: largest cosine between residuals and Jacobian columns.
        change: relative fall of chi^2 in the last run.
        steps: Levenberg-Marquardt steps taken.
        seconds: wall-clock time.
        at_bound: names of numbers at their bound.
    """

    number: int
    chi2: float
    chi2_data: float
    converged: bool
    gradient: float
    change: float
    steps: int
    seconds: float
    at_bound: tuple[str, ...]


class Data(NamedTuple):
    problem: Problem
    floor: Array


@eqx.filter_jit
def linearised(u: Array, data: Data) -> tuple[Array, Array]:
    """Residuals at u, `(m,)`, and their Jacobian, `(m, n)`; a program that others share."""
    return value_and_jacobian(lambda v: _chi2.residuals(v, data.problem, data.floor), u)


class End(NamedTuple):
    """Where a run ended: u, steps taken, total chi^2, chi^2 of the data, gradient cosine, J^T J."""

    u: Array
    steps: Array
    chi2: Array
    chi2_data: Array
    cosine: Array
    information: Array


@eqx.filter_jit
def run(u: Array, data: Data) -> End:
    """One run of at most `STEPS` steps from u, and the state at its end: one program for all floors."""
    u, steps, r, jacobian = levenberg_marquardt(lambda v: linearised(v, data), u, STEPS)
    lengths = jnp.linalg.norm(jacobian, axis=0) * jnp.linalg.norm(r)
    # Floor: a number on which no residual depends has a zero column. Numbers at a bound drift outwards for
    # ever without changing anything: their gradient says nothing about convergence.
    cosines = jnp.abs(jacobian.T @ r) / jnp.maximum(lengths, 1e-300)
    cosine = jnp.max(jnp.where(_bounds.edge(data.problem.bounds, u), 0.0, cosines))
    n_data = 2 * data.problem.images.n_images
    return End(u, steps, r @ r, jnp.sum(r[:n_data] ** 2), cosine, jacobian.T @ jacobian)


def chi2_and_information(u: Array, problem: Problem) -> tuple[Array, Array]:
    """Source-plane chi^2 of the data at u, `()`, and J^T J of all source-plane rows, `(n, n)`."""
    return _moments(u, Data(problem, jnp.asarray(FLOORS[-1])))


@eqx.filter_jit
def _moments(u: Array, data: Data) -> tuple[Array, Array]:
    r, jacobian = linearised(u, data)
    return jnp.sum(r[: 2 * data.problem.images.n_images] ** 2), jacobian.T @ jacobian


class Descent(NamedTuple):
    """Where a descent ended, the steps so far, the last relative fall of chi^2, and if it has converged."""

    end: End
    steps: int
    change: float
    converged: bool


def _through(
    u: Array, problem: Problem, floors: Sequence[float], steps: int, tick: Callable[[float, int], None]
) -> Descent:
    """Down through the floors; the last one is repeated until it has converged."""
    for floor in floors[:-1]:
        tick(floor, steps)
        end = run(u, Data(problem, jnp.asarray(floor)))
        u, steps = end.u, steps + int(end.steps)
    last = Data(problem, jnp.asarray(floors[-1]))
    end = run(u, last)
    steps += int(end.steps)
    tick(floors[-1], steps)
    change, converged = math.inf, False
    for _ in range(MAX_ROUNDS - 1):
        before, end = float(end.chi2), run(end.u, last)
        steps += int(end.steps)
        tick(floors[-1], steps)
        after = float(end.chi2)
        change = (before - after) / max(after, 1e-300)
        settled = change < CHANGE_TOLERANCE and float(end.cosine) < GRADIENT_TOLERANCE
        converged = settled or after < EXACT
        if converged or not math.isfinite(after):
            break
    return Descent(end, steps, change, converged)


def settle(u: Array, problem: Problem) -> Descent:
    """Down from u `(n,)`, near a minimum, without any floor."""
    return _through(u, problem, FLOORS[-1:], 0, lambda floor, steps: None)


def descend(u: Array, problem: Problem, number: int, tick: Callable[[float, int], None]) -> tuple[End, Start]:
    """The end of one start from u `(n,)`; `tick` is called with (floor, steps so far) between runs."""
    began = time.perf_counter()
    found = _through(u, problem, FLOORS, 0, tick)
    edge = _bounds.edge(problem.bounds, found.end.u)
    if np.asarray(edge).any():
        # The gradient vanishes at the edge of a box: a number that an early floor sent there is stuck. Set
        # free once; it goes back when it belongs there.
        freed = jnp.where(edge, jnp.clip(found.end.u, -RELEASE, RELEASE), found.end.u)
        again = _through(freed, problem, FLOORS[-2:], found.steps, tick)
        if float(again.end.chi2) < float(found.end.chi2):
            found = again
        else:
            found = found._replace(steps=again.steps)
    end, steps, change, converged = found
    start = Start(
        number=number,
        chi2=float(end.chi2),
        chi2_data=float(end.chi2_data),
        converged=converged,
        gradient=float(end.cosine),
        change=float(change),
        steps=steps,
        seconds=time.perf_counter() - began,
        at_bound=tuple(_bounds.at_bound(problem.bounds, end.u)),
    )
    return end, start
