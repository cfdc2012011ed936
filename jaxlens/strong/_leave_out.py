"""Leave one system out: refit, and predict what was left out.

For every system the whole model is fitted again in the source plane to the others, from the optimum; then the
left-out system is predicted by the lens so found. All refits are one compiled program: a system is left out
by a weight of 0 on its rows, so that shapes do not change. A free redshift of the left-out system has nothing
left to hold it; it is fitted to the system's own images, as its source position is.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens_equation
from jaxlens._types import Array
from jaxlens.strong import _bounds, _chi2, _sigma
from jaxlens.strong._chi2 import SIGMA, ImageCatalogue, Problem
from jaxlens.strong._solver import levenberg_marquardt

STEPS, ROUNDS = 40, 3
"""Levenberg-Marquardt steps of one run, and runs of each refit."""

CHANGE_TOLERANCE = 1e-6
"""Largest relative fall of chi^2 in the last run of a refit that has converged."""

LIMIT = 3.0
"""Offset of a predicted image, in units of its position error, above which it is an outlier (our choice).

Two normal coordinates reach it in 1.1 % of all images; a model that is wrong reaches it more often.
"""


class LeaveOneOut(NamedTuple):
    """Every system as predicted by the model that was fitted to the others. NumPy arrays.

    The source of a left-out system is beta* of its own images (definition `tensor`) behind the lens of the
    others. Source plane: distance of each ray-traced image from it. Image plane: distance of the image that
    Newton's method reaches from the observed position; where it reaches none, there is no distance.

    Attributes:
        u: model of each refit, `(s, n)`.
        converged: whether it has converged, `(s,)` bool.
        offset_source: distance in the source plane, `(i,)`, arcsec.
        theta: predicted images, `(i, 2)`, arcsec; NaN where none is reached.
        offset: their distance from the observed ones, `(i,)`, arcsec; NaN where none is reached.
        normalised: `offset` over the position error of the image in the catalogue, `(i,)`.
        images: the observed images.
    """

    u: np.ndarray
    converged: np.ndarray
    offset_source: np.ndarray
    theta: np.ndarray
    offset: np.ndarray
    normalised: np.ndarray
    images: ImageCatalogue

    @property
    def n_found(self) -> int:
        """Images that are reached from their observed positions."""
        return int(np.isfinite(self.offset).sum())

    @property
    def rms(self) -> float:
        """Image-plane rms over the images that are reached, arcsec."""
        return float(np.sqrt(np.nanmean(self.offset**2))) if self.n_found else float("nan")

    @property
    def rms_source(self) -> float:
        """Source-plane rms over all images, arcsec."""
        return float(np.sqrt(np.mean(self.offset_source**2)))

    def outlying_images(self, limit: float = LIMIT) -> np.ndarray:
        """Images predicted more than `limit` position errors away, or not reached, `(i,)` bool."""
        return ~(self.normalised <= limit)

    def system_scores(self) -> np.ndarray:
        """Root of chi^2 per degree of freedom of every left-out system, `(s,)`: 2 n - 2 of them.

        Infinite where an image is not reached, NaN for a single image.
        """
        source = np.asarray(self.images.source)
        chi2 = np.bincount(source, np.where(np.isfinite(self.normalised), self.normalised**2, np.inf))
        freedom = 2.0 * np.bincount(source) - 2.0
        return np.sqrt(np.divide(chi2, freedom, out=np.full(len(chi2), np.nan), where=freedom > 0))

    def outlying_systems(self, limit: float = LIMIT) -> np.ndarray:
        """Systems whose `system_scores` exceed `limit`, `(s,)` bool."""
        return self.system_scores() > limit


@eqx.filter_jit
def _refits(u: Array, problem: Problem, turns: Array) -> tuple[Array, ...]:
    """All refits from u; `turns (s, n)` picks the free redshift of each system, zero where it is known."""
    images = problem.images
    n_rest = _chi2.prior_residuals(u, problem).shape[0]

    def rows(v: Array, keep: Array) -> Array:
        weight = jnp.concatenate([jnp.repeat(keep.astype(v.dtype), 2), jnp.ones(n_rest, v.dtype)])
        return weight * _chi2.residuals(v, problem)

    def one(item: tuple[Array, Array]) -> tuple[Array, ...]:
        system, turn = item
        own = images.source == system

        def run(v: Array, _: None) -> tuple[Array, Array]:
            v, _steps, r, _jacobian = levenberg_marquardt(lambda w: rows(w, ~own), v, STEPS)
            return v, r @ r

        v, totals = jax.lax.scan(run, u, None, length=ROUNDS)
        along = lambda t, at=v: rows(at + t[0] * turn, own)
        v = v + levenberg_marquardt(along, jnp.zeros(1, v.dtype), STEPS)[0] * turn
        prediction = problem.predict(v)
        seen = _chi2.sources(prediction, images)
        beta, ratio = seen.beta[images.source], prediction.dls_ds[images.source]
        theta, found = lens_equation.images_from(prediction.lens, images.theta, beta, ratio)
        change = (totals[-2] - totals[-1]) / jnp.maximum(totals[-1], 1e-300)
        converged = (change < CHANGE_TOLERANCE) | (totals[-1] < 1e-10)
        return v, converged, jnp.linalg.norm(seen.beta_k - beta, axis=1), theta, found

    return jax.lax.map(one, (jnp.arange(images.n_systems), turns))


def leave_one_out(u: Array, problem: Problem) -> LeaveOneOut:
    """Fit again without each system, and predict it; see `LeaveOneOut` for what is measured.

    Costs one compilation (seconds to a minute) and, for each system, about as much as one start of a fit from
    a good start. Refits are those of the source plane, also where the fit itself ended in the image plane.

    Args:
        u: unbounded vector of the optimum, `(n,)`.
        problem: the fit. A free factor on the position errors is held at its value.
    """
    images = problem.images
    if SIGMA in problem.bounds:
        factor = _bounds.physical(problem.bounds, u)[SIGMA]
        u = jnp.delete(u, _sigma.place(problem))
        problem = _sigma.scaled(_sigma.without(problem), factor)
    names = sorted(problem.bounds)
    turns = np.zeros((images.n_systems, len(u)))
    for index, system in enumerate(images.systems):
        name = f"dls_ds.{system}"
        if name in names:
            before = names[: names.index(name)]
            turns[index, sum(problem.bounds[one].size for one in before)] = 1.0
    v, converged, in_source, theta, found = (np.asarray(x) for x in _refits(u, problem, jnp.asarray(turns)))
    # Each image as seen by the refit without its own system.
    at = (np.asarray(images.source), np.arange(images.n_images))
    theta = np.where(found[at][:, None], theta[at], np.nan)
    offset = np.linalg.norm(theta - np.asarray(images.theta), axis=1)
    normalised = offset / np.asarray(images.sigma_pos)
    return LeaveOneOut(v, converged, in_source[at], theta, offset, normalised, images)
