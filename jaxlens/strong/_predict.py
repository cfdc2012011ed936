"""Predicted images, matched one to one with the observed ones, and the image-plane rms.

An rms depends on how the position of the source is defined, by up to 0.15 arcsec; the definitions are

- `tensor`: beta* of the source-plane chi^2, each image weighted by G_k = (sigma^2 A A^T)^-1;
- `mean`: the plain mean of the ray-traced images;
- `mu_mean`: their mean weighted by |mu_k|;
- `own`: the source that minimises the image-plane chi^2.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as _lens
from jaxlens import lens_equation
from jaxlens._types import Array
from jaxlens.strong import _chi2
from jaxlens.strong._chi2 import ImageCatalogue, Prediction, Problem

DEFINITIONS = ("tensor", "mean", "mu_mean", "own")

MAX_OFFSET = 5.0
"""A predicted image farther than this from an observed one, arcsec, is not its counterpart (our choice)."""

_SAME = 1e-3  # two predictions closer than this, arcsec, are one image


class PredictedImages(NamedTuple):
    """All images of the modelled sources, and which observed image each belongs to. NumPy arrays.

    Attributes:
        definition: how the source position is defined.
        beta: source positions, `(s, 2)`, arcsec.
        theta: counterpart of every observed image, `(i, 2)`, arcsec; the observed position itself
            where none is produced.
        mu: signed magnification there, `(i,)`.
        produced: whether the model has a counterpart of its own, `(i,)` bool.
        spare: predicted images without an observed counterpart: rows (system index, theta_1,
            theta_2, mu), `(m, 4)`.
        complete: whether no search overflowed and all image counts have the right parity.
    """

    definition: str
    beta: np.ndarray
    theta: np.ndarray
    mu: np.ndarray
    produced: np.ndarray
    spare: np.ndarray
    complete: bool

    @property
    def n_produced(self) -> int:
        return int(self.produced.sum())

    def first(self, n_images: int, n_systems: int) -> "PredictedImages":
        """Those of the first images and systems alone; `complete` stays that of all."""
        return self._replace(
            beta=self.beta[:n_systems],
            theta=self.theta[:n_images],
            mu=self.mu[:n_images],
            produced=self.produced[:n_images],
            spare=self.spare[self.spare[:, 0] < n_systems],
        )

    def rms(self, images: ImageCatalogue) -> float:
        """Root of the mean squared distance of produced images from the observed ones, arcsec."""
        distance2 = np.sum((self.theta - np.asarray(images.theta)) ** 2, axis=1)[self.produced]
        return float(np.sqrt(distance2.mean())) if distance2.size else float("nan")

    def chi2(self, images: ImageCatalogue) -> float:
        """Sum of |theta - theta_obs|^2/sigma^2 over the produced images."""
        distance2 = np.sum((self.theta - np.asarray(images.theta)) ** 2, axis=1)
        return float(np.sum((distance2 / np.asarray(images.sigma_pos) ** 2)[self.produced]))


@eqx.filter_jit
def predicted(u: Array, problem: Problem) -> Prediction:
    """The model at the unbounded vector u `(n,)`, compiled."""
    return problem.predict(u)


# Compiled once for all that ask: the fit, its predicted images, and the systems left out.
sources, _mean_sources = jax.jit(_chi2.sources), jax.jit(_chi2.mean_sources)


class Followed(NamedTuple):
    """The images that are reached from the observed positions, and what a step of the sources needs."""

    theta: Array  # (i, 2)
    found: Array  # (i,)
    mu: Array  # (i,)
    chi2: Array  # (s,), infinite for a system of which an image is lost
    normal: Array  # (s, 2, 2): J^T J of the image positions with respect to the source
    gradient: Array  # (s, 2): J^T r


@jax.jit
def follow(prediction: Prediction, images: ImageCatalogue, beta: Array) -> Followed:
    """Follow every observed image to the image of the source `beta (s, 2)` of its system."""
    ratio = prediction.dls_ds[images.source]
    theta, found = lens_equation.images_from(prediction.lens, images.theta, beta[images.source], ratio)
    a = _lens.jacobian(prediction.lens, theta, ratio)
    slope = jnp.linalg.inv(a) / images.sigma_pos[:, None, None]  # d theta/d beta
    r = (theta - images.theta) / images.sigma_pos[:, None]
    rows = jnp.concatenate(
        [
            jnp.einsum("kij,kil->kjl", slope, slope).reshape(-1, 4),
            jnp.einsum("kij,ki->kj", slope, r),
            jnp.where(found, jnp.sum(r**2, axis=1), jnp.inf)[:, None],
        ],
        axis=1,
    )
    t = jax.ops.segment_sum(rows, images.source, images.n_systems, indices_are_sorted=True)
    return Followed(theta, found, 1.0 / jnp.linalg.det(a), t[:, 6], t[:, :4].reshape(-1, 2, 2), t[:, 4:6])


def own_source(prediction: Prediction, images: ImageCatalogue, beta: Array, steps: int = 30) -> Array:
    """Source positions `(s, 2)` that minimise the image-plane chi^2, from `beta`, arcsec.

    Damped Gauss-Newton steps of every source. The images are followed from the observed positions; a
    system keeps its `beta` where no step keeps (or finds) all of them.
    """
    best = np.asarray(beta)
    at = jax.tree.map(np.asarray, follow(prediction, images, beta))
    damping = np.full(images.n_systems, 1e-3)
    for _ in range(steps):
        trace = np.trace(at.normal, axis1=1, axis2=2)
        damped = at.normal + (damping * trace)[:, None, None] * np.eye(2)
        usable = np.isfinite(damped).all(axis=(1, 2)) & np.isfinite(at.gradient).all(axis=1)
        step = np.linalg.solve(np.where(usable[:, None, None], damped, np.eye(2)), at.gradient[..., None])
        moved = np.where(usable[:, None], best - step[..., 0], best)
        there = jax.tree.map(np.asarray, follow(prediction, images, jnp.asarray(moved)))
        better = there.chi2 < at.chi2
        small = better & (there.chi2 > at.chi2 - 1e-10)
        best = np.where(better[:, None], moved, best)
        at = at._replace(
            chi2=np.where(better, there.chi2, at.chi2),
            normal=np.where(better[:, None, None], there.normal, at.normal),
            gradient=np.where(better[:, None], there.gradient, at.gradient),
        )
        damping = np.where(better, damping * 0.2, damping * 10.0)
        if (small | (~better & (damping > 1e2)) | ~usable).all():
            break
    return jnp.asarray(best)


def match(observed: np.ndarray, predicted: np.ndarray, max_offset: float = MAX_OFFSET) -> np.ndarray:
    """Index of the predicted image that belongs to each observed one, `(n,)`; -1 for none.

    One to one, with the smallest total distance; pairs farther apart than `max_offset` are not pairs.

    Args:
        observed: `(n, 2)`, arcsec.
        predicted: `(m, 2)`, arcsec.
        max_offset: arcsec.
    """
    index = np.full(len(observed), -1)
    if len(predicted):
        distance = np.linalg.norm(observed[:, None] - predicted[None], axis=2)
        # Far above any sum of allowed distances: a forbidden pair is used only when nothing else is left.
        from scipy.optimize import linear_sum_assignment  # costs 0.2 s, so only when it is needed

        rows, columns = linear_sum_assignment(np.where(distance <= max_offset, distance, 1e6))
        allowed = distance[rows, columns] <= max_offset
        index[rows[allowed]] = columns[allowed]
    return index


def predict(
    prediction: Prediction,
    images: ImageCatalogue,
    *,
    definitions: tuple[str, ...] = DEFINITIONS,
    max_offset: float = MAX_OFFSET,
    margin: float = 25.0,
) -> dict[str, PredictedImages]:
    """Solve the lens equation for every system and match its images with the observed ones.

    Args:
        prediction: lens and distance ratios.
        images: the observed images.
        definitions: source definitions wanted, of `DEFINITIONS`.
        max_offset: largest distance of a pair, arcsec.
        margin: images are searched in the square around all observed ones, this much larger, arcsec.

    Returns:
        One `PredictedImages` per definition. Not differentiable (it selects images).
    """
    observed = np.asarray(images.theta)
    source = np.asarray(images.source)
    low, high = observed.min(axis=0), observed.max(axis=0)
    half_width = float(0.5 * (high - low).max() + margin)
    centre = tuple(0.5 * (low + high))
    tiling = lens_equation.tile(prediction.lens, centre=centre, half_width=half_width)
    seen = sources(prediction, images)
    betas = {"tensor": seen.beta, **_mean_sources(seen, images)}
    if "own" in definitions:
        betas["own"] = own_source(prediction, images, betas["tensor"])
    out = {}
    for name in definitions:
        beta = betas[name]
        found = lens_equation.solve(prediction.lens, beta, prediction.dls_ds, tiling=tiling)
        near = follow(prediction, images, beta)
        out[name] = _paired(
            name,
            np.asarray(beta),
            found,
            np.asarray(near.theta),
            np.asarray(near.mu),
            np.asarray(near.found),
            observed,
            source,
            max_offset,
        )
    return out


def _paired(
    name: str,
    beta: np.ndarray,
    found: lens_equation.ImageSet,
    near: np.ndarray,
    near_mu: np.ndarray,
    converged: np.ndarray,
    observed: np.ndarray,
    source: np.ndarray,
    max_offset: float,
) -> PredictedImages:
    theta, mu, produced = observed.copy(), np.full(len(observed), np.nan), np.zeros(len(observed), bool)
    spare = []
    valid, all_theta, all_mu = (np.asarray(part) for part in (found.valid, found.theta, found.mu))
    for system in range(len(beta)):
        rows = np.flatnonzero(source == system)
        points, magnifications = list(all_theta[system][valid[system]]), list(all_mu[system][valid[system]])
        for row in rows[converged[rows]]:
            # An image followed from its observed position that the search did not list.
            if all(np.linalg.norm(near[row] - point) > _SAME for point in points):
                points.append(near[row])
                magnifications.append(near_mu[row])
        predicted = np.array(points).reshape(-1, 2)
        index = match(observed[rows], predicted, max_offset)
        hit = index >= 0
        produced[rows] = hit
        theta[rows[hit]] = predicted[index[hit]]
        mu[rows[hit]] = np.array(magnifications)[index[hit]]
        for k in sorted(set(range(len(predicted))) - set(index[hit])):
            spare.append((float(system), *predicted[k], magnifications[k]))
    complete = not bool(np.any(found.overflow)) and bool(np.all(found.parity_ok))
    return PredictedImages(name, beta, theta, mu, produced, np.array(spare).reshape(-1, 4), complete)


def rms_by_source(predicted: Mapping[str, PredictedImages], images: ImageCatalogue) -> dict[str, float]:
    """Image-plane rms of every source definition, arcsec."""
    return {name: one.rms(images) for name, one in predicted.items()}
