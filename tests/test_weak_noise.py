"""Shape noise: the exact transformation, means, counts, empty pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from jaxlens import weak
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.weak._noise import _poisson


@pytest.mark.parametrize("g", [0.3 - 0.2j, 1.6 + 0.7j])
def test_ellipticity_is_that_of_the_lensed_ellipse(g: complex):
    # An ellipse x^T Q^-1 x = 1 with (a - b)/(a + b) exp(2 i phi) = eps; the image has A^-1 Q A^-T.
    eps = 0.25 + 0.15j
    q = np.array(
        [[1 + abs(eps) ** 2 + 2 * eps.real, 2 * eps.imag], [2 * eps.imag, 1 + abs(eps) ** 2 - 2 * eps.real]]
    )
    a = np.array([[1 - g.real, -g.imag], [-g.imag, 1 + g.real]])
    image = np.linalg.inv(a) @ q @ np.linalg.inv(a).T
    spin = image[0, 0] - image[1, 1] + 2j * image[0, 1]
    expected = spin / (np.trace(image) + 2 * np.sqrt(np.linalg.det(image)))
    ours = weak.observed_ellipticity(jnp.array([eps]), jnp.array([g]))
    assert_allclose(ours, [expected], rtol=1e-13)


@pytest.mark.parametrize("g", [0.0, 0.1 - 0.05j, 0.45j, 2.0 - 1.0j])
def test_mean_over_directions_is_g_or_its_inverse(g: complex):
    phase = np.exp(1j * np.linspace(0.0, 2 * np.pi, 400, endpoint=False))
    eps = weak.observed_ellipticity(jnp.asarray(0.3 * phase), jnp.full(400, g, complex))
    expected = g if abs(g) <= 1 else 1.0 / np.conj(g)
    assert_allclose(jnp.mean(eps), expected, atol=1e-13)


def test_counts_follow_the_depleted_density():
    grid, plane = Grid((48, 48), 10.0), LensPlane.at(z_l=0.3)
    counts = weak.mean_counts(grid, plane)
    r = np.asarray(grid.radius) * float(plane.kpc_per_arcsec)
    assert_allclose(counts, 12.0 * (1.0 - 0.3 * np.exp(-r / 300.0)), rtol=1e-12)
    with pytest.raises(ValueError, match=r"`depletion` 1\.5"):
        weak.mean_counts(grid, plane, depletion=1.5)


def test_realisation_has_the_right_counts_means_and_scatter():
    # 900 pixels of 20 galaxies: standard errors below are of the statistic; limits 5 sigma, one run in 10^6.
    g = jnp.full((30, 30), 0.2 - 0.1j)
    counts = jnp.full((30, 30), 20.0)
    weight = jnp.ones((30, 30)).at[0, 0].set(0.0)
    draw = jax.jit(
        lambda key: weak.shape_noise(key, g, counts, capacity=weak.capacity_of(18000.0), weight=weight)
    )
    one = draw(jax.random.key(4))
    assert not one.overflow and one.weight[0, 0] == 0.0
    assert abs(int(one.n_gal.sum()) - 18000) < 5 * np.sqrt(18000)
    assert abs(np.var(np.asarray(one.n_gal)) / 20.0 - 1.0) < 5 * np.sqrt(2 / 900 + 1 / 18000)
    error = np.asarray(one.g - g)
    scatter = 0.24 / np.sqrt(20.0)
    assert np.all(np.abs([np.real(error).mean(), np.imag(error).mean()]) < 5 * scatter / 30.0)
    # |g| = 0.22 narrows the scatter by 5 %; <1/N> is 1.06/<N>.
    assert abs(np.std(error) / np.sqrt(2) / scatter - 0.98) < 5 / np.sqrt(2 * 1800)
    other = draw(jax.random.key(5))
    assert not np.array_equal(one.g, other.g)


@pytest.mark.parametrize(("mean", "dtype"), [(0.3, jnp.float64), (12.0, jnp.float32), (150.0, jnp.float64)])
def test_counts_are_poisson_numbers(mean: float, dtype: type):
    """Pearson's chi^2 of 40 000 pixels; a false alarm once in 10^5."""
    drawn = np.asarray(_poisson(jax.random.key(1), jnp.full((200, 200), mean, dtype))).ravel()
    number = np.arange(drawn.max() + 1)
    expected = stats.poisson.pmf(number, mean) * drawn.size
    often = expected > 5.0
    found = np.bincount(drawn, minlength=len(number))
    chi2 = np.sum(((found - expected) ** 2 / expected)[often])
    assert stats.chi2.sf(chi2, often.sum() - 1) > 1e-5


def test_counts_of_no_and_of_very_many_galaxies():
    mean = jnp.array([[0.0, 1e4]])
    drawn = _poisson(jax.random.key(2), mean)
    assert drawn[0, 0] == 0 and abs(int(drawn[0, 1]) - 10_000) < 500


def test_sums_are_those_of_each_pixel():
    g = jnp.asarray(np.random.default_rng(0).normal(size=(4, 5)) * 0.1 + 0.2j)
    counts = jnp.asarray(np.random.default_rng(1).uniform(0.0, 3.0, (4, 5)))
    one = weak.shape_noise(jax.random.key(0), g, counts, capacity=200, sigma_eps=0.0)
    empty = np.asarray(one.n_gal) == 0
    assert empty.any()
    assert_allclose(one.g, np.where(empty, 0.0, g), rtol=1e-14)  # no intrinsic shape: exactly g
    assert_allclose(one.weight, ~empty)


def test_overflow_is_flagged():
    g, counts = jnp.zeros((4, 4), complex), jnp.full((4, 4), 10.0)
    one = weak.shape_noise(jax.random.key(0), g, counts, capacity=50)
    assert one.overflow and int(one.n_gal.sum()) == 50 and np.isfinite(one.g).all()
