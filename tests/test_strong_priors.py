"""Prior laws, errors of positions and source positions in the posterior: against SciPy and integrals."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats as _stats

from jaxlens import strong
from jaxlens.cosmology import LensPlane, redshift_of_dls_ds
from jaxlens.lens import Component, Lens
from jaxlens.profiles import Sheet
from jaxlens.strong import _sigma

PLANE = LensPlane.at(0.3)
stats: Any = _stats  # its type stubs know no `logpdf`

# Two systems of three and two images; rows of systems are shuffled in value, not in order.
THETA = np.array([[0.9, 0.3], [-0.7, 0.1], [0.1, -0.6], [1.0, -0.8], [-0.9, 0.9]])
IMAGES = strong.ImageCatalogue(
    THETA, np.array([0, 0, 0, 1, 1]), np.array([2.0, 3.0]), np.array([0.2, 0.3, 0.4, 0.25, 0.5]), ("1", "2")
)


def sheet(params: Any) -> strong.Prediction:
    """A sheet of mass, under which beta = (1 - kappa) theta and everything has a closed form."""
    kappa = jnp.reshape(params["S.kappa"], (1,))
    lens = Lens({"S": Component(Sheet(kappa=kappa), jnp.zeros((1, 2)), jnp.zeros(1))})
    return strong.Prediction(lens, jnp.ones(2))


def problem(box: strong.Box, *priors: Any, weak: float = 0.0) -> strong.Problem:
    return strong.Problem(sheet, {"S.kappa": box}, IMAGES, tuple(priors), weak)


def chi2(kappa: float, factor: float = 1.0) -> float:
    """At theta the residuals of a sheet do not depend on kappa: A = (1 - kappa) 1."""
    total = 0.0
    for k in ([0, 1, 2], [3, 4]):
        w = 1.0 / (factor * np.asarray(IMAGES.sigma_pos)[k]) ** 2
        mean = (w[:, None] * THETA[k]).sum(axis=0) / w.sum()
        total += float((w[:, None] * (THETA[k] - mean) ** 2).sum())
    return total


LAWS = {
    "normal in a linear box": (
        strong.Box(0.1, 0.9),
        strong.NormalPrior("S.kappa", 0.35, 0.1),
        stats.norm(0.35, 0.1).logpdf,
    ),
    "normal in a logarithmic box": (
        strong.Box(0.1, 0.9, log=True),
        strong.NormalPrior("S.kappa", 0.35, 0.1),
        stats.norm(0.35, 0.1).logpdf,
    ),
    "log-normal in a linear box": (
        strong.Box(0.1, 0.9),
        strong.LogNormalPrior("S.kappa", 0.35, 0.4),
        stats.lognorm(0.4, scale=0.35).logpdf,
    ),
    "log-normal in a logarithmic box": (
        strong.Box(0.1, 0.9, log=True),
        strong.LogNormalPrior("S.kappa", 0.35, 0.4),
        stats.lognorm(0.4, scale=0.35).logpdf,
    ),
    "uniform": (strong.Box(0.1, 0.9), None, stats.uniform(0.1, 0.8).logpdf),
    "uniform in the logarithm": (strong.Box(0.1, 0.9, log=True), None, stats.loguniform(0.1, 0.9).logpdf),
}


@pytest.mark.parametrize(("box", "prior", "logpdf"), LAWS.values(), ids=list(LAWS))
def test_the_prior_has_the_density_of_its_law(box: strong.Box, prior: Any, logpdf: Any) -> None:
    """p(u) = p(x) |dx/du|, with p(x) from SciPy and the slope by differences, up to one constant."""
    one = problem(box, *(() if prior is None else (prior,)))
    u = jnp.linspace(-3.0, 3.0, 13)
    ours = np.asarray(jax.vmap(lambda v: strong.log_prior(v[None], one))(u))
    value = lambda v: np.asarray(jax.vmap(lambda w: box.physical(w[None]))(v))
    slope = (value(u + 1e-5) - value(u - 1e-5)) / 2e-5
    expected = logpdf(value(u)) + np.log(slope)
    # 1e-8: the central differences.
    assert_allclose(ours - ours[0], expected - expected[0], rtol=1e-8, atol=1e-8)


def test_a_redshift_prior_is_normal_in_the_redshift() -> None:
    box = strong.Box(PLANE.dls_ds(0.5), PLANE.dls_ds(6.0), weak=False)
    prior = strong.RedshiftPrior("2", PLANE, 2.0, 0.5)
    one = strong.Problem(lambda p: sheet({"S.kappa": jnp.asarray(0.3)}), {"dls_ds.2": box}, IMAGES, (prior,))
    z = np.linspace(1.0, 4.0, 7)
    u = jnp.stack([box.unbounded(PLANE.dls_ds(v)) for v in z])
    ours = np.asarray(jax.vmap(lambda v: strong.log_prior(v, one))(u))
    inverse = lambda v: np.asarray(jax.vmap(lambda w: redshift_of_dls_ds(PLANE, w))(v))
    ratio = lambda v: jax.vmap(box.physical)(v)
    slope = (inverse(ratio(u + 1e-4)) - inverse(ratio(u - 1e-4))) / 2e-4
    expected = stats.norm(2.0, 0.5).logpdf(z) + np.log(slope)
    assert_allclose(ours - ours[0], expected - expected[0], rtol=1e-6, atol=1e-6)
    gradient = jax.grad(lambda v: strong.log_prior(v, one))(u[3])
    step = lambda s: float(strong.log_prior(u[3] + s, one))
    assert_allclose(gradient[0], (step(1e-4) - step(-1e-4)) / 2e-4, rtol=1e-6)


def test_rows_of_a_log_normal_prior() -> None:
    prior = strong.LogNormalPrior("S.kappa", 0.35, 0.4)
    assert_allclose(prior({"S.kappa": jnp.asarray(0.7)}), np.log(2.0) / 0.4, rtol=1e-14)


REFUSED = {
    "box below 0": (strong.Box(-0.1, 0.9), ("S.kappa", 0.3, 0.4), "`S.kappa` needs a box above 0"),
    "box at 0": (strong.Box(0.0, 0.9), ("S.kappa", 0.3, 0.4), "begins at 0"),
    "negative median": (strong.Box(0.1, 0.9), ("S.kappa", -0.3, 0.4), "`S.kappa` has the median -0.3"),
    "no width": (strong.Box(0.1, 0.9), ("S.kappa", 0.3, 0.0), "`S.kappa` has the width 0"),
    "not free": (strong.Box(0.1, 0.9), ("S.mass", 0.3, 0.4), "`S.mass`, which is not free; free are S.kappa"),
}


@pytest.mark.parametrize(("box", "law", "said"), REFUSED.values(), ids=list(REFUSED))
def test_an_impossible_law_is_refused_by_name(box: strong.Box, law: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        problem(box, strong.LogNormalPrior(*law))


def test_a_log_normal_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"`S.shape`, a Disc; free its elongation"):
        strong.Problem(
            sheet, {"S.shape": strong.Disc(0.3)}, IMAGES, (strong.LogNormalPrior("S.shape", 0.1, 0.2),)
        )


# --- source positions ---------------------------------------------------------------------------------


def integral_over_sources(kappa: float, factor: float) -> float:
    """ln of the likelihood integrated over both sources on a grid, up to a constant."""
    total = 0.0
    sigma = factor * np.asarray(IMAGES.sigma_pos)
    for k in ([0, 1, 2], [3, 4]):
        beta = (1.0 - kappa) * THETA[k]
        side = np.linspace(-3.0, 3.0, 801) * (1.0 - kappa)  # many standard deviations about the middle
        x, y = np.meshgrid(beta[:, 0].mean() + side, beta[:, 1].mean() + side)
        exponent, norm = np.zeros_like(x), 0.0
        for (bx, by), s in zip(beta, sigma[k], strict=True):
            width = s * (1.0 - kappa)
            exponent -= 0.5 * ((x - bx) ** 2 + (y - by) ** 2) / width**2
            norm -= 2.0 * np.log(s)  # the density of an observed position: two coordinates
        peak = exponent.max()
        cell = (side[1] - side[0]) ** 2
        total += norm + peak + np.log(np.exp(exponent - peak).sum() * cell)
    return total


def test_marginal_sources_are_the_integral_over_them() -> None:
    one = strong.free_sigma(problem(strong.Box(0.1, 0.9)))
    places = [(0.2, 1.0), (0.6, 1.0), (0.4, 1.7)]
    u = [strong.unbounded(one.bounds, {"S.kappa": k, strong.SIGMA: f}) for k, f in places]
    ours = np.array([float(strong.log_likelihood(v, one, sources="marginal")) for v in u])
    numeric = np.array([integral_over_sources(*place) for place in places])
    # 1e-6: the sums of smooth peaks, which reach 4 standard deviations beyond the outermost image.
    assert_allclose(ours - ours[0], numeric - numeric[0], rtol=1e-6)
    profile = np.array([float(strong.log_likelihood(v, one)) for v in u])
    by_hand = [-0.5 * chi2(k, f) - 10.0 * np.log(f) for k, f in places]
    assert_allclose(profile, by_hand, rtol=1e-10)


def test_an_unknown_treatment_of_sources_is_named() -> None:
    one = problem(strong.Box(0.1, 0.9))
    with pytest.raises(ValueError, match="`sources` is 'mean'; choose one of profile, marginal"):
        strong.log_posterior(jnp.zeros(1), one, sources="mean")


# --- position errors ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def free() -> tuple[strong.Problem, strong.StrongFit]:
    """Free position errors; kappa is held by its prior alone, because the residuals do not depend on it."""
    one = strong.free_sigma(problem(strong.Box(0.1, 0.9), strong.NormalPrior("S.kappa", 0.35, 0.02)))
    return one, strong.fit(one, n_starts=1)


def test_a_free_factor_is_that_of_the_constraints(free: tuple[strong.Problem, strong.StrongFit]) -> None:
    one, fit = free
    # 10 coordinates, less 4 of the sources.
    factor = np.sqrt(chi2(0.3) / 6.0)
    assert 1.0 < factor < 10.0
    assert_allclose(fit.sigma_scale, factor, rtol=1e-6)
    assert_allclose(fit.params[strong.SIGMA], factor, rtol=1e-6)
    assert_allclose(fit.chi2, chi2(0.3), rtol=1e-9)
    assert_allclose(fit.params["S.kappa"], 0.35, rtol=1e-6)
    # A variance from 6 normal numbers: 1/sqrt(12) in its logarithm's half, by the second derivative.
    slope = jax.grad(lambda v: jnp.log(strong.physical(one.bounds, v)[strong.SIGMA]))(fit.u)
    error = float(jnp.sqrt(slope @ fit.covariance @ slope))
    assert_allclose(error, 1.0 / np.sqrt(12.0), rtol=1e-5)


def test_the_free_factor_is_the_peak_of_the_marginal_posterior(
    free: tuple[strong.Problem, strong.StrongFit],
) -> None:
    one, fit = free
    gradient = jax.grad(lambda v: strong.log_likelihood(v, one, sources="marginal"))(fit.u)
    at = _sigma.place(one)
    # The likelihood depends on u through chi^2 of order 100: 1e-4 of it per unit of u.
    assert abs(float(gradient[at])) < 1e-4


def test_rescaled_errors_give_chi2_nu_of_one() -> None:
    one = problem(strong.Box(0.1, 0.9), strong.NormalPrior("S.kappa", 0.35, 0.02))
    fit = strong.fit(one, n_starts=1)
    again = strong.rescale(fit, one)
    assert strong.degrees_of_freedom(one) == 5
    assert_allclose(again.sigma_scale, np.sqrt(chi2(0.3) / 5.0), rtol=1e-6)
    assert_allclose(float(again.chi2 / again.sigma_scale**2) / 5.0, 1.0, rtol=1e-12)
    assert_allclose(again.u, fit.u)
    assert_allclose(fit.sigma_scale, 1.0)
    # Here the prior alone holds kappa: a prior is not rescaled.
    assert_allclose(again.covariance, fit.covariance, rtol=1e-6)


def test_no_degrees_of_freedom() -> None:
    pair = strong.ImageCatalogue(THETA[3:], [0, 0], [2.0], [0.2, 0.2], ("1",))
    bounds: strong.Bounds = {"S.kappa": strong.Box(0.1, 0.9), "a": strong.Box(0.0, 1.0)}
    one = strong.Problem(lambda p: strong.Prediction(sheet(p).lens, jnp.ones(1)), bounds, pair)
    fit = strong.fit(one, n_starts=1)
    with pytest.raises(ValueError, match=r"has 0 degrees of freedom: chi2_nu is not defined"):
        strong.rescale(fit, one)
    single = strong.ImageCatalogue(THETA[:1], [0], [2.0], [0.2], ("1",))
    with pytest.raises(ValueError, match="Every system has one image"):
        strong.free_sigma(strong.Problem(one.build, bounds, single))
    with pytest.raises(ValueError, match=r"`limits` is \(0.0, 1.0\)"):
        strong.free_sigma(one, (0.0, 1.0))
    free = strong.free_sigma(one)
    with pytest.raises(ValueError, match="is free in this fit"):
        strong.rescale(fit, free)


def test_numbers_at_their_bound_are_held_fixed() -> None:
    root = np.random.default_rng(4).normal(size=(6, 4))
    information = root.T @ root
    covariance = strong.laplace_covariance(jnp.asarray(information))
    edge = jnp.array([False, True, False, False])
    found = np.asarray(strong.without_edges(covariance, edge))
    kept = np.ix_([0, 2, 3], [0, 2, 3])
    assert_allclose(found[kept], np.linalg.inv(information[kept]), rtol=1e-9)
    assert not found[1].any() and not found[:, 1].any()
    assert_allclose(strong.without_edges(covariance, jnp.zeros(4, bool)), covariance)
