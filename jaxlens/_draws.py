"""Laplace draws about the best fit, and how well they fit the images; see `jaxlens.posterior`."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, Float, RandomKey
from jaxlens.lens import Lens
from jaxlens.strong import (
    SIGMA,
    Angle,
    Bounds,
    Problem,
    StrongFit,
    chi2_source,
    degrees_of_freedom,
    edge,
    total_size,
    without_edges,
)

N_DRAWS = 64
"""Draws that the command stores: the error of an error is then 9 %."""

FAR = 2.0
"""Draws whose chi^2 rises by more than so many times what is expected are no posterior (our choice)."""

_PRIOR = 0.55  # close to a uniform prior in the box, see `strong.Box`


class Quality(NamedTuple):
    """How well the draws of a lens still fit the images.

    Attributes:
        chi2: source-plane chi^2 of every draw, `(draws,)`, with the position errors that the draws are for.
        chi2_best: that of the best fit.
        expected_rise: mean rise of chi^2 over the draws of a normal posterior, at most: the number of
            constraints or of free numbers, whichever is smaller.
    """

    chi2: np.ndarray
    chi2_best: float
    expected_rise: float

    @property
    def rise(self) -> float:
        """Median of chi^2 over the draws, less that of the best fit; NaN counts as infinite."""
        return float(np.median(np.nan_to_num(self.chi2, nan=np.inf))) - self.chi2_best

    @property
    def warning(self) -> str | None:
        """What a user of the draws must know, or None."""
        if not self.rise > FAR * self.expected_rise:
            return None
        return (
            f"the Laplace draws fit the images far worse than the best model: chi2 rises by {self.rise:.1f} "
            f"(median) where at most {self.expected_rise:g} is expected. The posterior is not normal; take "
            "errors made of these draws (of masses, maps and counter-images) as too large"
        )


class Draws(NamedTuple):
    """Draws of a lens.

    Attributes:
        lenses: the lens with a leading axis of draws on every array.
        quality: how well they fit.
    """

    lenses: Lens
    quality: Quality


@eqx.filter_jit
def _drawn(problem: Problem, u: Array) -> tuple[Lens, Array]:
    """Lens and chi^2 of every row of u `(draws, n)`."""

    def one(row: Array) -> tuple[Lens, Array]:
        prediction = problem.predict(row)
        return prediction.lens, chi2_source(prediction, problem.images)

    return jax.lax.map(one, u)


def draws(problem: Problem, fit: StrongFit, key: RandomKey, n: int = N_DRAWS) -> Draws:
    """Lenses at `draw_numbers`, and how well they fit.

    Args:
        problem: the fit's problem.
        fit: its result.
        key: random key.
        n: number of draws.
    """
    lenses, chi2 = _drawn(problem, draw_numbers(problem, fit, key, n))
    n_free = total_size(problem.bounds) - (SIGMA in problem.bounds)
    expected = min(n_free, degrees_of_freedom(problem) + n_free)
    scale = float(fit.sigma_scale) ** -2
    return Draws(lenses, Quality(scale * np.asarray(chi2), scale * float(fit.chi2), float(expected)))


def draw_lenses(problem: Problem, fit: StrongFit, key: RandomKey, n: int = N_DRAWS) -> Lens:
    """The lenses of `draws` alone, with a leading axis of `n` on every array."""
    return draws(problem, fit, key, n).lenses


def draw_numbers(problem: Problem, fit: StrongFit, key: RandomKey, n: int = N_DRAWS) -> Float[Array, "d n"]:
    """Normal draws of the unbounded numbers about the best fit, `(d, n)`.

    The draws are normal in the unbounded coordinates, with the Laplace covariance; where the fit had no
    weak prior, the variance is that of the data and a uniform prior in the box together, so that numbers
    that the data leave free stay inside it. Numbers at their bound are held there (`strong.without_edges`):
    a normal law about the edge of a box is not the posterior there, and its correlations spoil the others.

    Args:
        problem: the fit's problem.
        fit: its result.
        key: random key.
        n: number of draws.
    """
    at_edge = edge(problem.bounds, fit.u)
    held = without_edges(fit.covariance, at_edge)
    spread = _covariance(np.asarray(held), problem.bounds, float(problem.weak_prior))
    values, vectors = np.linalg.eigh(spread)
    # Rounding of the held rows would show as its square root.
    root = np.where(np.asarray(at_edge)[:, None], 0.0, vectors * np.sqrt(np.maximum(values, 0.0)))
    return _normal(key, fit.u, jnp.asarray(root), n)


@partial(jax.jit, static_argnums=3)
def _normal(key: RandomKey, u: Array, root: Array, n: int) -> Array:
    return u[None] + jax.random.normal(key, (n, len(u)), u.dtype) @ root.T


def _covariance(covariance: np.ndarray, bounds: Bounds, weak_prior: float) -> np.ndarray:
    """The covariance with the prior of the box where the fit had none; angles have none."""
    has_row = [
        (bounds[name].weak and weak_prior > 0.0) or isinstance(bounds[name], Angle)
        for name in sorted(bounds)
        for _ in range(bounds[name].size)
    ]
    extra = np.where(has_row, 0.0, _PRIOR)
    # (C^-1 + D^2)^-1 = C - C D (1 + D C D)^-1 D C, without inverting a nearly singular C.
    inner = np.eye(len(extra)) + extra[:, None] * covariance * extra[None]
    return covariance - (covariance * extra[None]) @ np.linalg.solve(inner, extra[:, None] * covariance)
