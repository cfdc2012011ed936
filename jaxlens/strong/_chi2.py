"""Multiple images as data, and chi^2 as a vector of whitened residuals in the source plane.

    chi^2 = sum_systems min_beta sum_k (beta_k - beta)^T G_k (beta_k - beta),
    G_k = (sigma_k^2 A_k A_k^T + s^2 I)^-1,   A_k = d beta/d theta at the observed image.

The source positions beta are eliminated in closed form (variable projection). s = 0 is the linearised
image-plane chi^2 of the literature (Oguri 2010, sec. 3.2); s > 0, in arcsec of the source plane, keeps
it bounded where det A = 0 at an observed image.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxlens import lens as _lens
from jaxlens._types import Array, Float, Int, Scalar, ScalarLike
from jaxlens.lens import Lens
from jaxlens.profiles._profile import as_float
from jaxlens.strong import _bounds, _priors
from jaxlens.strong._bounds import Bounds, Params

SIGMA = "errors.sigma_scale"
"""Name of the free factor on all position errors, see `jaxlens.strong.free_sigma`."""


class Prediction(eqx.Module):
    """What a model says about the data.

    Attributes:
        lens: the lens.
        dls_ds: distance ratio of every system, `(s,)`.
    """

    lens: Lens
    dls_ds: Float[Array, " s"]


class ImageCatalogue(eqx.Module):
    """Observed multiple images, sorted by system.

    Attributes:
        theta: positions, `(i, 2)`, arcsec.
        source: index of each image's system, `(i,)`, non-decreasing from 0.
        z_s: redshift of every system, `(s,)`; NaN where it is not known.
        sigma_pos: position error per axis, `(i,)`, arcsec.
        systems: names of the systems.
        image_ids: names of the images.
    """

    theta: Float[Array, "i 2"] = eqx.field(converter=as_float)
    source: Int[Array, " i"] = eqx.field(converter=jnp.asarray)
    z_s: Float[Array, " s"] = eqx.field(converter=as_float)
    sigma_pos: Float[Array, " i"] = eqx.field(converter=as_float)
    systems: tuple[str, ...] = eqx.field(static=True, default=())
    image_ids: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def n_images(self) -> int:
        return self.theta.shape[0]

    @property
    def n_systems(self) -> int:
        return self.z_s.shape[0]


class Problem(eqx.Module):
    """A fit: a model, the boxes of its free numbers, the images, and the priors.

    Attributes:
        build: pure function from the free numbers (by name) to a `Prediction`.
        bounds: the boxes, by name; u holds them in alphabetical order of the names.
        images: the data.
        priors: callables params -> residual or vector of residuals (in units of their sigma); laws of single
            numbers are `NormalPrior`, `LogNormalPrior`, `RedshiftPrior`, a `Box` itself is the uniform one.
        weak_prior: weight of the weak prior rows, `()`; 0 for none, 0.55 is close to uniform in every `Box`.
    """

    build: Callable[[Params], Prediction]
    bounds: Bounds
    images: ImageCatalogue
    priors: tuple[Callable[[Params], Any], ...] = ()
    weak_prior: Scalar = eqx.field(converter=as_float, default=0.0)

    def __check_init__(self) -> None:
        """Laws must be possible in their boxes."""
        _priors.refuse_impossible(self.priors, self.bounds)

    def predict(self, u: Array) -> Prediction:
        """The model at the unbounded vector u `(n,)`."""
        params = _bounds.physical(self.bounds, u)
        params.pop(SIGMA, None)  # a number of the data, not of the model
        return self.build(params)

    def images_at(self, u: Array) -> ImageCatalogue:
        """The images with the position errors at u: the catalogue's, times the free factor if any."""
        if SIGMA not in self.bounds:
            return self.images
        return scale_sigma(self.images, _bounds.physical(self.bounds, u)[SIGMA])


def scale_sigma(images: ImageCatalogue, factor: ScalarLike) -> ImageCatalogue:
    """The images with all position errors times `factor`."""
    return eqx.tree_at(lambda one: one.sigma_pos, images, factor * images.sigma_pos)


class Sources(NamedTuple):
    """Sources seen from the images: ray-traced positions, their covariance and the best source."""

    beta_k: Array  # (i, 2)
    jacobian: Array  # (i, 2, 2)
    covariance: Array  # (i, 3): xx, xy, yy
    beta: Array  # (s, 2)


def covariance_in_source_plane(jacobian: Array, sigma_pos: Array, floor: ScalarLike) -> Array:
    """sigma^2 A A^T + s^2 I as (xx, xy, yy), `(i, 3)`, arcsec^2."""
    a, b, c, d = jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0], jacobian[:, 1, 1]
    s2 = sigma_pos**2
    return jnp.stack(
        [s2 * (a * a + b * b) + floor**2, s2 * (a * c + b * d), s2 * (c * c + d * d) + floor**2], axis=1
    )


_FLAT = 1e-12
# Smallest det C/(tr C)^2, the square of the axis ratio of A: when s = 0 an image on a critical curve has
# infinite G. Below this, |mu| of about a million, rounding in the determinants would take over.


def _determinant(c: Array) -> Array:
    return jnp.maximum(c[:, 0] * c[:, 2] - c[:, 1] ** 2, _FLAT * (c[:, 0] + c[:, 2]) ** 2)


def _inverse(c: Array) -> Array:
    return jnp.stack([c[:, 2], -c[:, 1], c[:, 0]], axis=1) / _determinant(c)[:, None]


def solve(covariance: Array, vector: Array) -> Array:
    """C^-1 vector for symmetric 2 x 2 matrices (xx, xy, yy) `(i, 3)` and vectors `(i, 2)`."""
    g = _inverse(covariance)
    x, y = vector[:, 0], vector[:, 1]
    return jnp.stack([g[:, 0] * x + g[:, 1] * y, g[:, 1] * x + g[:, 2] * y], axis=1)


def source_information(covariance: Array, source: Array, n_systems: int) -> Array:
    """det(sum_k G_k) of every system, `(s,)`; images sorted by system."""
    t = jax.ops.segment_sum(_inverse(covariance), source, n_systems, indices_are_sorted=True)
    return t[:, 0] * t[:, 2] - t[:, 1] ** 2


def weighted_source(beta_k: Array, covariance: Array, source: Array, n_systems: int) -> Array:
    """beta* = (sum G_k)^-1 sum G_k beta_k of every system, `(s, 2)`; images sorted by system."""
    g = _inverse(covariance)
    terms = jnp.concatenate([g, solve(covariance, beta_k)], axis=1)
    t = jax.ops.segment_sum(terms, source, n_systems, indices_are_sorted=True)
    det = t[:, 0] * t[:, 2] - t[:, 1] ** 2
    return (
        jnp.stack([t[:, 2] * t[:, 3] - t[:, 1] * t[:, 4], t[:, 0] * t[:, 4] - t[:, 1] * t[:, 3]], axis=1)
        / det[:, None]
    )


def whiten(difference: Array, covariance: Array) -> Array:
    """L^-1 difference with covariance = L L^T, `(i, 2)`: no inverse of A is ever formed."""
    xx, xy, yy = covariance[:, 0], covariance[:, 1], covariance[:, 2]
    l_xx = jnp.sqrt(jnp.maximum(xx, _FLAT * (xx + yy)))
    l_yx = xy / l_xx
    l_yy = jnp.sqrt(_determinant(covariance)) / l_xx
    first = difference[:, 0] / l_xx
    return jnp.stack([first, (difference[:, 1] - l_yx * first) / l_yy], axis=1)


def seen_from(beta_k: Array, jacobian: Array, images: ImageCatalogue, floor: ScalarLike) -> Sources:
    """`Sources` from the ray-traced observed images `(i, 2)` and their Jacobian matrices `(i, 2, 2)`."""
    covariance = covariance_in_source_plane(jacobian, images.sigma_pos, floor)
    beta = weighted_source(beta_k, covariance, images.source, images.n_systems)
    return Sources(beta_k, jacobian, covariance, beta)


def sources(prediction: Prediction, images: ImageCatalogue, floor: ScalarLike = 0.0) -> Sources:
    """Ray-trace the observed images and find the best source of every system (definition `tensor`)."""
    ratio = prediction.dls_ds[images.source]
    return seen_from(
        *_lens.source_and_jacobian(prediction.lens, images.theta, ratio), images=images, floor=floor
    )


def mean_sources(s: Sources, images: ImageCatalogue) -> dict[str, Array]:
    """Source positions `(s, 2)` by the definitions `mean` and `mu_mean`, arcsec."""
    det = s.jacobian[:, 0, 0] * s.jacobian[:, 1, 1] - s.jacobian[:, 0, 1] * s.jacobian[:, 1, 0]

    def mean(weight: Array) -> Array:
        rows = jnp.concatenate([weight[:, None], weight[:, None] * s.beta_k], axis=1)
        total = jax.ops.segment_sum(rows, images.source, images.n_systems, indices_are_sorted=True)
        return total[:, 1:] / total[:, :1]

    # Floor: an image on a critical curve would otherwise be the source all by itself.
    weight = 1.0 / jnp.maximum(jnp.abs(det), 1e-8)
    return {"mean": mean(jnp.ones_like(weight)), "mu_mean": mean(weight)}


def source_positions(prediction: Prediction, images: ImageCatalogue) -> dict[str, Array]:
    """Source positions `(s, 2)` by the definitions `tensor`, `mean` and `mu_mean`, arcsec."""
    s = sources(prediction, images)
    return {"tensor": s.beta, **mean_sources(s, images)}


def source_plane_residuals(prediction: Prediction, images: ImageCatalogue, floor: ScalarLike = 0.0) -> Array:
    """Whitened residuals `(i, 2)` whose sum of squares is the source-plane chi^2.

    Args:
        prediction: lens and distance ratios.
        images: the data.
        floor: s, arcsec of the source plane.
    """
    s = sources(prediction, images, floor)
    return whiten(s.beta_k - s.beta[images.source], s.covariance)


def prior_residuals(u: Array, problem: Problem) -> Array:
    """Rows of all priors, `(m,)`: the user's, then the weak prior."""
    params = _bounds.physical(problem.bounds, u)
    rows = [jnp.atleast_1d(as_float(prior(params))).ravel() for prior in problem.priors]
    return jnp.concatenate([*rows, _bounds.weak_rows(problem.bounds, u, problem.weak_prior)])


def residuals(u: Array, problem: Problem, floor: ScalarLike = 0.0) -> Array:
    """All rows of the least-squares problem, `(2 i + m,)`: data, then priors.

    Args:
        u: unbounded vector, `(n,)`.
        problem: the fit.
        floor: s, arcsec of the source plane.
    """
    data = source_plane_residuals(problem.predict(u), problem.images_at(u), floor)
    return jnp.concatenate([data.ravel(), prior_residuals(u, problem)])


def chi2_source(prediction: Prediction, images: ImageCatalogue, floor: ScalarLike = 0.0) -> Array:
    """Source-plane chi^2 of the data alone, `()`."""
    return jnp.sum(source_plane_residuals(prediction, images, floor) ** 2)
