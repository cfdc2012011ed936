"""Laplace draws: their law against the covariance they are made of, their intervals, their one program."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxlens import posterior, results, strong
from jaxlens.lens import Component, Lens
from jaxlens.profiles import Sheet

COVARIANCE = np.array([[0.30, 0.12, 0.0], [0.12, 0.20, -0.05], [0.0, -0.05, 0.10]])
BEST = np.array([0.4, -0.3, 0.2])
N = 4096


class Counted:
    """A sheet of convergence `a`; counts how often it is traced."""

    traced = 0

    def __call__(self, params: dict[str, Any]) -> strong.Prediction:
        self.traced += 1
        one = Component(Sheet(kappa=params["a"][None]), jnp.zeros((1, 2)), jnp.zeros(1))
        return strong.Prediction(Lens({"sheet": one}), jnp.array([0.5]))


@pytest.fixture(scope="module")
def build() -> Counted:
    return Counted()


def setup(build: Counted, weak_prior: float) -> tuple[strong.Problem, strong.StrongFit]:
    """Three numbers whose Laplace covariance is `COVARIANCE`."""
    bounds: strong.Bounds = {"a": strong.Box(0.0, 1.0), "b": strong.Box(1.0, 9.0, log=True)}
    bounds["c"] = strong.Box(-2.0, 2.0)
    images = strong.ImageCatalogue([[0.0, 0.0], [0.1, 0.0], [0.0, 0.3]], [0, 0, 0], [2.0], [0.5] * 3)
    problem = strong.Problem(build, bounds, images, weak_prior=weak_prior)
    u = jnp.asarray(BEST)
    fit = strong.StrongFit(
        u=u,
        params=strong.physical(bounds, u),
        lens=problem.predict(u).lens,
        dls_ds=jnp.array([0.5]),
        chi2=jnp.asarray(1.0),
        chi2_prior=jnp.asarray(0.0),
        covariance=jnp.asarray(COVARIANCE),
        starts=(),
        at_bound=(),
        agreeing=1,
        converged=True,
        interrupted=False,
        seconds={},
    )
    return problem, fit


@pytest.mark.parametrize("weak_prior", [0.55, 0.0])
def test_draws_have_the_law_they_are_drawn_from(build: Counted, weak_prior: float) -> None:
    """Without a weak prior the prior of the box is added: (C^-1 + 0.55^2)^-1."""
    problem, fit = setup(build, weak_prior)
    many = np.asarray(posterior.draw_numbers(problem, fit, jax.random.key(3), N))
    expected = COVARIANCE if weak_prior else np.linalg.inv(np.linalg.inv(COVARIANCE) + 0.55**2 * np.eye(3))
    spread = np.sqrt(np.diag(expected))
    # Four standard errors: of the mean, of the covariance of normal numbers, of their quantiles at one sigma.
    assert_allclose(many.mean(axis=0), BEST, atol=4.0 * spread.max() / np.sqrt(N))
    error = np.sqrt((expected**2 + np.outer(spread, spread) ** 2) / N)
    assert np.all(np.abs(np.cov(many.T) - expected) < 4.0 * error)
    ends = np.array([results.interval(at, column) for at, column in zip(BEST, many.T, strict=True)])
    quantile_error = np.sqrt(0.15865 * 0.84135 / N) / 0.24197
    assert np.all(np.abs((ends - BEST[:, None]) / spread[:, None] - [-1.0, 1.0]) < 4.0 * quantile_error)


def test_intervals_are_the_quantiles_through_the_box(build: Counted) -> None:
    """The interval of a number is that of its u, mapped into the box, where mean and width are others."""
    problem, fit = setup(build, 0.55)
    many = posterior.draw_numbers(problem, fit, jax.random.key(3), N)
    box = problem.bounds["b"]
    u = np.asarray(many[:, 1])
    found = results.interval(float(fit.params["b"]), np.asarray(jax.vmap(box.physical)(many[:, 1:2])))
    expected = [1.0 * 9.0 ** (1.0 / (1.0 + np.exp(-end))) for end in np.percentile(u, [15.865, 84.135])]
    # 1e-3: the percentile is interpolated between two of 4096 draws, in u or in the number.
    assert_allclose(found, expected, rtol=1e-3)
    middle = float(fit.params["b"])
    assert found[1] - middle > 1.2 * (middle - found[0])


def test_intervals_of_angles_cross_the_seam() -> None:
    angles = 89.0 + np.random.default_rng(0).normal(scale=3.0, size=N)
    wrapped = (angles + 90.0) % 180.0 - 90.0
    low, high = results.interval(89.0, wrapped, periodic=True)
    assert_allclose((low, high), (86.0, 92.0), atol=0.3)


def test_draws_without_spread_have_no_interval() -> None:
    assert np.isnan(results.interval(1.0, np.ones(10))).all()


def test_all_draws_are_one_program(build: Counted) -> None:
    """The model is traced as often for 64 draws as for 3, and not again for other draws of as many."""
    problem, fit = setup(build, 0.55)
    counts = []
    for n, seed in ((3, 0), (64, 0), (64, 1)):
        before = build.traced
        lenses, _ = posterior.draws(problem, fit, jax.random.key(seed), n)
        counts.append(build.traced - before)
        assert lenses.components["sheet"].params.kappa.shape == (n, 1)
    assert counts == [counts[0], counts[0], 0]
    assert 1 <= counts[0] <= 2
