"""Leave one system out: refit, and predict what was left out.

For every system the whole model is fitted again in the source plane to the others, from the optimum; then the
left-out system is predicted by the lens so found. A system is left out by position errors without bound, so
that shapes do not change and the refits are runs of the program that made the fit. A free redshift of the
left-out system has nothing left to hold it; like the source position it is fitted to the system's own images.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as _lens
from jaxlens._types import Array
from jaxlens.strong import _bounds, _chi2, _descent, _predict, _sigma
from jaxlens.strong._chi2 import SIGMA, ImageCatalogue, Problem
from jaxlens.strong._solver import levenberg_marquardt, linearised_program

UNBOUNDED = 1e8
"""Factor on the position errors of a system that is left out: it weighs 1e-16 of what it did."""

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


def _jacobian_at(ratio: Array, hessian: Array) -> Array:
    return jnp.eye(2)[None] - ratio[:, None, None] * hessian


@eqx.filter_jit
def _own_redshift(u: Array, problem: Problem, own: Array, turn: Array) -> Array:
    """u with its number `turn (n,)` where it suits the images `own (i,)` best; the lens stays."""
    images = problem.images
    # Only the distance ratio moves, so that the lens is evaluated once.
    alpha, hessian = _lens.alpha_and_hessian(problem.predict(u).lens, images.theta)
    weight = jnp.repeat(own.astype(u.dtype), 2)

    def rows(t: Array) -> Array:
        v = u + t[0] * turn
        ratio = problem.predict(v).dls_ds[images.source]
        beta_k = images.theta - ratio[:, None] * alpha
        seen = _chi2.seen_from(beta_k, _jacobian_at(ratio, hessian), images, 0.0)
        data = _chi2.whiten(beta_k - seen.beta[images.source], seen.covariance)
        return jnp.concatenate([weight * data.ravel(), _chi2.prior_residuals(v, problem)])

    return u + levenberg_marquardt(linearised_program(rows), jnp.zeros(1, u.dtype), _descent.STEPS)[0] * turn


def _turn(problem: Problem, system: str, n: int) -> np.ndarray | None:
    """The unit vector `(n,)` of a system's free redshift; None where it is known."""
    names = sorted(problem.bounds)
    name = f"dls_ds.{system}"
    if name not in names:
        return None
    before = sum(problem.bounds[one].size for one in names[: names.index(name)])
    return np.eye(n)[before]


def leave_one_out(
    u: Array, problem: Problem, *, on_system: Callable[[int], None] | None = None
) -> LeaveOneOut:
    """Fit again without each system, and predict it; see `LeaveOneOut` for what is measured.

    Costs, for each system, about as much as one start of a fit from a good start; the program is that of
    `fit`, so that nothing is compiled for it after a fit. Refits are those of the source plane, also where
    the fit itself ended in the image plane.

    Args:
        u: unbounded vector of the optimum, `(n,)`.
        problem: the fit. A free factor on the position errors is held at its value.
        on_system: called with the index of every system before it is left out.
    """
    images = problem.images
    if SIGMA in problem.bounds:
        factor = _bounds.physical(problem.bounds, u)[SIGMA]
        u = jnp.delete(u, _sigma.place(problem))
        problem = _sigma.scaled(_sigma.without(problem), factor)
    source = np.asarray(images.source)
    models, converged = [], []
    in_source, theta = np.full(len(source), np.nan), np.full((len(source), 2), np.nan)
    for index, system in enumerate(images.systems):
        if on_system:
            on_system(index)
        own = source == index
        wide = jnp.asarray(np.where(own, UNBOUNDED, 1.0)) * problem.images.sigma_pos
        part = eqx.tree_at(lambda one: one.images.sigma_pos, problem, wide)
        end = _descent.settle(u, part)
        v = end.end.u
        turn = _turn(problem, system, len(u))
        if turn is not None:
            # Nothing held it during the refit: it begins where the fit had it.
            v = jnp.where(jnp.asarray(turn) == 1.0, u, v)
            v = _own_redshift(v, problem, jnp.asarray(own), jnp.asarray(turn))
        prediction = _predict.predicted(v, problem)
        seen = _predict.sources(prediction, problem.images)
        near = _predict.follow(prediction, problem.images, seen.beta)
        reached = own & np.asarray(near.found)
        theta[reached] = np.asarray(near.theta)[reached]
        in_source[own] = np.linalg.norm(np.asarray(seen.beta_k) - np.asarray(seen.beta)[source], axis=1)[own]
        models.append(np.asarray(v))
        converged.append(end.converged)
    offset = np.linalg.norm(theta - np.asarray(images.theta), axis=1)
    normalised = offset / np.asarray(images.sigma_pos)
    return LeaveOneOut(np.stack(models), np.array(converged), in_source, theta, offset, normalised, images)
