"""The fit as a density for samplers: likelihood, priors, and what is done with the source positions."""

import jax.numpy as jnp

from jaxlens._types import Array, ScalarLike
from jaxlens.strong import _bounds, _chi2, _priors
from jaxlens.strong._chi2 import SIGMA, Problem

SOURCES = ("profile", "marginal")
"""What can be done with the source positions."""


def log_likelihood(u: Array, problem: Problem, *, floor: ScalarLike = 0.0, sources: str = "profile") -> Array:
    """ln p(images | u) up to a constant, `()`: -chi^2/2, and the terms that make it a density.

    Profile: each source at its best position beta*, as in the chi^2 of glafic. Marginal: the integral over
    all source positions, for which a uniform density is assumed. The chi^2 is quadratic in beta,

        int exp(-chi^2(beta)/2) d^2 beta = 2 pi det(sum_k G_k)^(-1/2) exp(-chi^2(beta*)/2),

    so that it costs nothing more. With a free factor f on the position errors (`free_sigma`) the term
    -2 N_img ln f is added; the determinants of the marginal density give back 2 N_sys ln f, one for each
    source coordinate. For floor > 0 the term is that of floor = 0.

    Args:
        u: unbounded vector, `(n,)`.
        problem: the fit.
        floor: s, arcsec of the source plane.
        sources: `profile` or `marginal`.

    Raises:
        ValueError: if `sources` is unknown.
    """
    if sources not in SOURCES:
        raise ValueError(f"`sources` is {sources!r}; choose one of {', '.join(SOURCES)}.")
    images = problem.images_at(u)
    seen = _chi2.sources(problem.predict(u), images, floor)
    rows = _chi2.whiten(seen.beta_k - seen.beta[images.source], seen.covariance)
    total = -0.5 * jnp.sum(rows**2)
    if sources == "marginal":
        determinants = _chi2.source_information(seen.covariance, images.source, images.n_systems)
        total = total - 0.5 * jnp.sum(jnp.log(determinants))
    if SIGMA in problem.bounds:
        factor = _bounds.physical(problem.bounds, u)[SIGMA]
        total = total - 2.0 * images.n_images * jnp.log(factor)
    return total


def log_prior(u: Array, problem: Problem) -> Array:
    """ln p(u) up to a constant, `()`; see `log_posterior`."""
    total = -0.5 * jnp.sum(_chi2.prior_residuals(u, problem) ** 2)
    replaced = problem.weak_prior > 0.0
    parts = _bounds.split(problem.bounds, u)
    for name, bound in problem.bounds.items():
        uniform = bound.log_prior(parts[name])
        if bound.weak and isinstance(bound, _bounds.Box):
            uniform = jnp.where(replaced, 0.0, uniform)
        elif bound.weak:  # as a density, a normal law of two components would push e to its limit
            uniform = uniform + 0.5 * jnp.sum((problem.weak_prior * parts[name]) ** 2)
        total = total + uniform
    params = _bounds.physical(problem.bounds, u)
    return total + _priors.log_measure(problem.priors, problem.bounds, params)


def log_posterior(u: Array, problem: Problem, *, floor: ScalarLike = 0.0, sources: str = "profile") -> Array:
    """ln p(u | images) up to a constant: the likelihood and all priors.

    The density is with respect to u, so that a sampler of unbounded vectors needs nothing else. Numbers in a
    box are uniform there (in their logarithm with `log=True`), those with a law of their own have its
    density cut off at the edges of the box; when `problem.weak_prior` is set, its rows stand for the uniform
    density of every `Box` they apply to. A `Disc` is uniform in e and angle in any case.

    Args:
        u: unbounded vector, `(n,)`.
        problem: the fit.
        floor: s, arcsec of the source plane.
        sources: `profile` puts every source at its best position for each u, as the fit does; `marginal`
            integrates over the source positions, see `log_likelihood`.

    Returns:
        Log density, `()`. Differentiable in u and in every array of `problem`.

    Raises:
        ValueError: if `sources` is unknown.
    """
    return log_likelihood(u, problem, floor=floor, sources=sources) + log_prior(u, problem)
