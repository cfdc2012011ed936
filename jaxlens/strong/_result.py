"""What a fit returns, and its covariance."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, Float, Scalar
from jaxlens.lens import Lens
from jaxlens.profiles._profile import as_float
from jaxlens.strong import _descent, _sigma
from jaxlens.strong._bounds import Params
from jaxlens.strong._chi2 import SIGMA, Problem
from jaxlens.strong._descent import Start


class StrongFit(eqx.Module):
    """The best of the starts.

    Attributes:
        u: unbounded vector, `(n,)`.
        params: physical numbers by name.
        lens: the fitted lens.
        dls_ds: distance ratio of every system, `(s,)`.
        chi2: source-plane chi^2 of the data with the position errors of the catalogue, `()`.
        chi2_prior: sum of squares of all prior rows, `()`.
        covariance: Laplace covariance of u, `(n, n)`: inverse of J^T J of the source-plane rows at the end,
            also after an image-plane stage; with the position errors times `sigma_scale`.
        starts: all starts, in the order they were run.
        at_bound: names of numbers within 1 % of an edge of their box.
        agreeing: number of starts within `AGREE` of the best total chi^2.
        converged: gradient and last change below tolerance, or two starts agree.
        interrupted: the fit was stopped before all starts were run.
        seconds: wall-clock time by stage, `compile`, `fit`, `total`.
        polished: whether the image-plane stage has converged; None without one.
        image_plane_failed: the image-plane stage ended without a finite chi^2, and the numbers are those of
            the source plane.
        sigma_scale: factor on the position errors, `()`: 1, that of `rescale`, or the free one.
    """

    u: Float[Array, " n"]
    params: Params
    lens: Lens
    dls_ds: Float[Array, " s"]
    chi2: Scalar
    chi2_prior: Scalar
    covariance: Float[Array, "n n"]
    starts: tuple[Start, ...] = eqx.field(static=True)
    at_bound: tuple[str, ...] = eqx.field(static=True)
    agreeing: int = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    interrupted: bool = eqx.field(static=True)
    seconds: dict[str, float] = eqx.field(static=True)
    polished: bool | None = eqx.field(static=True, default=None)
    image_plane_failed: bool = eqx.field(static=True, default=False)
    sigma_scale: Scalar = eqx.field(converter=as_float, default=1.0)


def rescale(fit: StrongFit, problem: Problem) -> StrongFit:
    """The fit with position errors so scaled that chi2_nu = 1: another covariance, nothing else.

    The factor is sqrt(chi^2/nu) with the source-plane chi^2 of the data and nu = 2 N_img - 2 N_sys - n_free;
    it may be smaller than 1. Priors keep their widths: only a number that the data alone determine gets an
    error larger by exactly this factor. The best numbers are those of the unscaled errors.

    Args:
        fit: a result of `fit(problem)`.
        problem: the same problem, with fixed position errors.

    Raises:
        ValueError: if there are no degrees of freedom, or the factor was free in the fit.
    """
    nu = _sigma.degrees_of_freedom(problem)
    if SIGMA in problem.bounds:
        raise ValueError("The factor on the position errors is free in this fit; it cannot be rescaled, too.")
    if nu <= 0:
        raise ValueError(
            f"The fit has {nu} degrees of freedom: chi2_nu is not defined and position errors cannot be "
            "rescaled. Keep them fixed, or free fewer numbers."
        )
    factor = jnp.sqrt(fit.chi2 / nu)
    _, information = _descent.chi2_and_information(fit.u, _sigma.scaled(problem, factor))
    covariance = laplace_covariance(information)
    return eqx.tree_at(lambda one: (one.covariance, one.sigma_scale), fit, (covariance, factor))


@jax.jit
def laplace_covariance(information: Array) -> Array:
    """Inverse of J^T J, `(n, n)`; directions that the data leave free get the variance 1e12, not infinity."""
    values, vectors = jnp.linalg.eigh(information)
    return (vectors / jnp.maximum(values, 1e-12)[None]) @ vectors.T


def without_edges(covariance: Array, edge: Array) -> Array:
    """The covariance of the numbers that are not at their bound, those at their bound held fixed, `(n, n)`.

    At the edge of a box a step of u changes nothing, and its variance there says nothing about the number;
    through the correlations it spoils the others. C_ff - C_fb C_bb^-1 C_bf, which is the inverse of the
    information of the free numbers alone; zero in rows and columns of the fixed ones.

    Args:
        covariance: of u, `(n, n)`.
        edge: which entries of u are at a bound, `(n,)` bool, see `at_bound`.
    """
    c, b = np.array(covariance), np.asarray(edge)
    if b.any():
        c -= c[:, b] @ np.linalg.pinv(c[np.ix_(b, b)], hermitian=True) @ c[b, :]
        c[b, :] = 0.0
        c[:, b] = 0.0
    return jnp.asarray(c)
