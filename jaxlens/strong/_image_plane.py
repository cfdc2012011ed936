"""The image-plane stage: a soft Gauss-Newton in which an image that vanishes costs a finite penalty.

All image positions theta_k and sources beta are unknowns of

    chi^2 = sum_k |theta_k - theta_obs,k|^2/sigma_k^2 + |beta - beta(theta_k; p)|^2/s^2,

which is the image-plane chi^2 for s -> 0. Linearised at the current theta_k it is the source-plane
problem with b_k = beta(theta_k) + A_k (theta_obs,k - theta_k) and C_k = sigma^2 A_k A_k^T + s^2 I, so
its Jacobian is the implicit-function one without an inverse of A: d b_k/dp at fixed theta_k and A_k.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxlens import lens as _lens
from jaxlens import lens_equation
from jaxlens._types import Array, ScalarLike
from jaxlens.strong import _chi2
from jaxlens.strong._chi2 import ImageCatalogue, Prediction, Problem
from jaxlens.strong._solver import levenberg_marquardt, linearised_program

FLOORS = (0.1, 0.02, 0.005)
"""Softening s of the constraint, arcsec of the source plane."""

ROUNDS = 6
"""Runs at each softening; image positions are carried from run to run."""

STEPS = 10
"""Levenberg-Marquardt steps of one run."""

CHANGE_TOLERANCE = 1e-6
"""A run that lowers chi^2 by less than this fraction is the last of its softening."""

LOST = 10.0
"""What an image without a counterpart costs on top of its source-plane residual, in units of its error.

Our choice: the farthest pair that `predict` makes, 5 arcsec, at an error of 0.5 arcsec. Without it a fit may
lower its chi^2 by losing an image (measured on Abell 2744 with sources at the mean weighted by |mu|).
"""

_INNER = 5  # updates of the image positions within one residual
_CAP = 0.5  # largest move of an image in one update, arcsec


def relax(prediction: Prediction, images: ImageCatalogue, theta: Array, floor: ScalarLike) -> Array:
    """Image positions `(i, 2)` that minimise the soft chi^2 at fixed lens, by `_INNER` linearised updates."""
    ratio = prediction.dls_ds[images.source]
    sigma2 = images.sigma_pos[:, None] ** 2

    def update(theta: Array, _: None) -> tuple[Array, None]:
        beta_k, a = _lens.source_and_jacobian(prediction.lens, theta, ratio)
        b = beta_k + jnp.einsum("kij,kj->ki", a, images.theta - theta)
        c = _chi2.covariance_in_source_plane(a, images.sigma_pos, floor)
        beta = _chi2.weighted_source(b, c, images.source, images.n_systems)
        pull = _chi2.solve(c, beta[images.source] - b)
        step = images.theta + sigma2 * jnp.einsum("kji,kj->ki", a, pull) - theta
        length = jnp.linalg.norm(step, axis=1, keepdims=True)
        return theta + step * jnp.minimum(1.0, _CAP / jnp.maximum(length, 1e-300)), None

    return jax.lax.scan(update, theta, None, length=_INNER)[0]


def image_plane_residuals(
    prediction: Prediction, images: ImageCatalogue, theta: Array, floor: ScalarLike
) -> Array:
    """Whitened residuals `(i, 2)` of the soft image-plane problem, image positions started at `theta`.

    Differentiable as Gauss-Newton needs it: image positions and A_k are frozen.
    """
    ratio = prediction.dls_ds[images.source]
    still = jax.lax.stop_gradient(prediction)
    theta = jax.lax.stop_gradient(relax(still, images, theta, floor))
    a = jax.lax.stop_gradient(_lens.jacobian(still.lens, theta, still.dls_ds[images.source]))
    b = _lens.ray_trace(prediction.lens, theta, ratio) + jnp.einsum("kij,kj->ki", a, images.theta - theta)
    c = _chi2.covariance_in_source_plane(a, images.sigma_pos, floor)
    beta = _chi2.weighted_source(b, c, images.source, images.n_systems)
    return _chi2.whiten(b - beta[images.source], c)


def definition_residuals(prediction: Prediction, images: ImageCatalogue, definition: str) -> Array:
    """(theta_k - theta_obs,k)/sigma_k `(i, 2)` for the sources of one definition, images followed by Newton.

    The (first) derivative is the implicit-function one. An image that Newton does not reach from its observed
    position contributes its source-plane residual r instead, lengthened so that its square is
    r^2 + `LOST`^2: finite, pulling where r does, and dear enough that no fit gains by losing an image.

    Args:
        prediction: lens and distance ratios.
        images: the data.
        definition: `mean` or `mu_mean`, see `jaxlens.strong.source_positions`.
    """
    ratio = prediction.dls_ds[images.source]
    still = jax.lax.stop_gradient(prediction)
    beta = _chi2.mean_sources(_chi2.sources(still, images), images)[definition]
    theta, found = jax.lax.stop_gradient(
        lens_equation.images_from(still.lens, images.theta, beta[images.source], still.dls_ds[images.source])
    )
    # The model at observed and predicted positions in one evaluation, which is one derivative to compile.
    traced, a = _lens.source_and_jacobian(
        prediction.lens, jnp.concatenate([images.theta, theta]), jnp.concatenate([ratio, ratio])
    )
    n = images.n_images
    seen = _chi2.seen_from(traced[:n], a[:n], images, FLOORS[0])
    beta = _chi2.mean_sources(seen, images)[definition][images.source]
    # At an image this Newton step has no length, and the derivative of the implicit function theorem.
    at_image = jnp.where(found[:, None, None], jax.lax.stop_gradient(a[n:]), jnp.eye(2)[None])
    step = jnp.linalg.solve(at_image, (beta - traced[n:])[..., None])[..., 0]
    direct = (theta + step - images.theta) / images.sigma_pos[:, None]
    instead = _chi2.whiten(seen.beta_k - seen.beta[images.source], seen.covariance)
    # Floor: a residual that is exactly 0 has no direction to be lengthened in.
    instead = instead * jnp.sqrt(
        1.0 + LOST**2 / jnp.maximum(jnp.sum(instead**2, axis=1, keepdims=True), 1e-12)
    )
    return jnp.where(found[:, None], direct, instead)


class _Data(NamedTuple):
    problem: Problem
    theta: Array
    floor: Array


def _soft_rows(u: Array, data: _Data) -> Array:
    rows = image_plane_residuals(data.problem.predict(u), data.problem.images, data.theta, data.floor)
    return jnp.concatenate([rows.ravel(), _chi2.prior_residuals(u, data.problem)])


def _definition_rows(definition: str) -> Callable[[Array, _Data], Array]:
    def rows(u: Array, data: _Data) -> Array:
        data_rows = definition_residuals(data.problem.predict(u), data.problem.images, definition)
        return jnp.concatenate([data_rows.ravel(), _chi2.prior_residuals(u, data.problem)])

    return rows


# At module level, so that a second call finds its program compiled.
_ROWS = {"tensor": _soft_rows, "mean": _definition_rows("mean"), "mu_mean": _definition_rows("mu_mean")}


class _End(NamedTuple):
    u: Array
    theta: Array
    chi2: Array
    information: Array


@eqx.filter_jit
def _run(u: Array, data: _Data, definition: str) -> _End:
    rows = _ROWS[definition]
    u, _, r, jacobian = levenberg_marquardt(linearised_program(lambda v: rows(v, data)), u, STEPS)
    theta = data.theta
    if definition == "tensor":
        theta = relax(data.problem.predict(u), data.problem.images, theta, data.floor)
    return _End(u, theta, r @ r, jacobian.T @ jacobian)


class Polished(NamedTuple):
    """Where the image-plane stage ended.

    Attributes:
        u: unbounded vector, `(n,)`.
        chi2: total chi^2 of the stage, `()`.
        information: J^T J there, `(n, n)`.
        converged: the last run lowered chi^2 by less than `CHANGE_TOLERANCE` of it (for `tensor`: at the
            last softening), instead of being the last that was allowed.
    """

    u: Array
    chi2: Array
    information: Array
    converged: bool


def polish(u: Array, problem: Problem, definition: str = "tensor") -> Polished:
    """Move from a source-plane optimum to the nearest image-plane optimum.

    Args:
        u: unbounded vector, `(n,)`.
        problem: the fit.
        definition: of the source position. `tensor` minimises over the sources as well (softly, down to
            a softening of `FLOORS[-1]`); `mean` and `mu_mean` fix them at the mean of the ray-traced images,
            plain or weighted by |mu|, as several published models do.

    Returns:
        Where it ended, and whether it has converged.

    Raises:
        ValueError: if the definition is not one that can be fitted.
    """
    if definition not in _ROWS:
        raise ValueError(f"`definition` is {definition!r}; choose one of {', '.join(_ROWS)}.")
    best: _End | None = None
    converged = False
    for floor in FLOORS if definition == "tensor" else FLOORS[-1:]:
        start = (u, problem.images.theta) if best is None else (best.u, best.theta)
        best = _run(start[0], _Data(problem, start[1], jnp.asarray(floor)), definition)
        converged = False
        for _ in range(ROUNDS - 1):
            end = _run(best.u, _Data(problem, best.theta, jnp.asarray(floor)), definition)
            if not float(end.chi2) < float(best.chi2) * (1.0 - CHANGE_TOLERANCE):
                converged = bool(jnp.isfinite(best.chi2))
                break
            best = end
    assert best is not None
    return Polished(best.u, best.chi2, best.information, converged)
