"""Galaxies: which are used, what they weigh, and the shear map they become."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads
from support import angles

from jaxlens import weak
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid

GRID = Grid(shape=(5, 7), pixel=12.0, centre=(4.0, -9.0))


def sample(n: int = 400, seed: int = 0, *, half: float = 60.0) -> weak.Galaxies:
    """Galaxies of general weights, some of them 0, some outside of the grid."""
    rng = np.random.default_rng(seed)
    weight = rng.uniform(0.2, 3.0, n) * (rng.uniform(size=n) > 0.1)
    eps = rng.normal(scale=0.3, size=n) + 1j * rng.normal(scale=0.3, size=n)
    return weak.Galaxies(rng.uniform(-half, half, (n, 2)), eps, weight, rng.uniform(0.1, 0.9, n))


to_grid = jax.jit(lambda galaxies: weak.to_grid(galaxies, GRID))


# --- the map -------------------------------------------------------------------------------------


def test_a_map_is_the_weighted_mean_in_each_pixel():
    galaxies = sample()
    shear = to_grid(galaxies)
    left, right, bottom, top = GRID.extent
    edges = (np.linspace(bottom, top, 6), np.linspace(left, right, 8))
    y, x, w, eps = (
        np.asarray(v) for v in (galaxies.theta[:, 1], galaxies.theta[:, 0], galaxies.weight, galaxies.eps)
    )

    def total(weights: np.ndarray) -> np.ndarray:
        return np.histogram2d(y, x, bins=edges, weights=weights)[0]

    weight = total(w)
    np.testing.assert_allclose(shear.weight, weight, rtol=1e-13)
    mean = (total(w * np.real(eps)) + 1j * total(w * np.imag(eps))) / np.where(weight > 0.0, weight, 1.0)
    np.testing.assert_allclose(shear.g, mean, rtol=1e-12)
    np.testing.assert_array_equal(shear.n_gal, total((w > 0).astype(float)))
    assert shear.n_gal.sum() < (w > 0).sum()  # some lie outside


def test_rows_are_theta_2_and_columns_theta_1():
    x, y = float(GRID.x[5]), float(GRID.y[1])
    shear = to_grid(weak.Galaxies([[x, y], [x, y]], [0.2 + 0.1j, 0.4 - 0.3j], [1.0, 3.0]))
    assert np.argwhere(np.asarray(shear.n_gal)).tolist() == [[1, 5]]
    np.testing.assert_allclose(shear.g[1, 5], 0.35 - 0.2j)
    assert float(shear.weight[1, 5]) == 4.0


def test_lower_edges_belong_to_a_pixel_and_upper_ones_do_not():
    left, right, bottom, top = GRID.extent
    shear = to_grid(weak.Galaxies([[left, bottom], [right, bottom], [left, top]], [0.1, 0.2, 0.3]))
    assert shear.n_gal.sum() == shear.n_gal[0, 0] == 1


def test_an_empty_pixel_and_an_unmeasured_shape_are_zero_and_never_nan():
    shear = to_grid(weak.Galaxies([[0.0, 0.0], [0.0, 0.0]], [jnp.nan + 0j, 0.5j], [0.0, 2.0]))
    assert np.isfinite(np.asarray(shear.g)).all()
    assert (np.asarray(shear.weight) > 0).sum() == 1
    assert complex(shear.g[np.asarray(shear.weight) > 0][0]) == 0.5j


def test_the_map_is_differentiable_in_shapes_and_weights_also_in_empty_pixels():
    galaxies = sample(30, 1)

    def f(re: Any, im: Any, weight: Any) -> Any:
        shear = weak.to_grid(weak.Galaxies(galaxies.theta, re + 1j * im, weight), GRID)
        return jnp.sum(jnp.sin(3.0 * shear.g.real) + shear.g.imag**2 + jnp.cos(shear.weight))

    weight = jnp.where(galaxies.weight > 0.0, galaxies.weight, 0.5)
    check_grads(f, (galaxies.eps.real, galaxies.eps.imag, weight), order=1, modes=["rev"], rtol=1e-6)


def test_maps_of_many_noise_realisations_are_one_vmap():
    galaxies = sample(50, 2)
    keys = jax.random.split(jax.random.key(0), 3)
    many = jax.vmap(lambda key: to_grid(weak.scramble(key, galaxies)))(keys)
    one = to_grid(weak.scramble(keys[2], galaxies))
    np.testing.assert_allclose(many.g[2], one.g, rtol=1e-12, atol=1e-15)


# --- selection and weights -----------------------------------------------------------------------


def test_background_leaves_out_members_known_foreground_and_wild_shapes():
    eps = jnp.array([0.1, 0.1, 0.1, 0.1, 1.3, jnp.nan, 0.2]) + 0j
    z = jnp.array([1.0, 0.4, jnp.nan, 1.0, 1.0, 1.0, 0.5])
    member = jnp.array([False, False, False, True, False, False, False])
    use = weak.background(eps, z, member=member, z_min=0.5, max_eps=1.2)
    assert use.tolist() == [True, False, True, False, False, False, True]
    use = weak.background(eps, z, member=member, z_min=0.5, max_eps=1.2, require_z=True)
    assert use.tolist() == [True, False, False, False, False, False, True]
    assert not weak.background(eps, require_z=True).any()


def test_select_changes_weights_alone():
    galaxies = sample(20)
    use = np.arange(20) % 2 == 0
    kept = weak.select(galaxies, use)
    np.testing.assert_array_equal(kept.weight, np.where(use, galaxies.weight, 0.0))
    assert len(kept) == len(galaxies)


def test_shape_weights_make_the_variance_of_the_mean_smallest():
    sigma_m = jnp.array([0.0, 0.1, 0.4])
    weight = np.asarray(weak.shape_weight(sigma_m, 0.3))
    np.testing.assert_allclose(weight, 1.0 / (0.3**2 + np.asarray(sigma_m) ** 2))


# --- depth ---------------------------------------------------------------------------------------


def test_depth_is_the_weighted_moments():
    galaxies = sample()
    w, b = np.asarray(galaxies.weight), np.asarray(galaxies.dls_ds)
    found = weak.depth(galaxies)
    np.testing.assert_allclose(found.mean, np.average(b, weights=w))
    np.testing.assert_allclose(found.factor, np.average(b**2, weights=w) / np.average(b, weights=w) ** 2)


def test_to_single_plane_gives_the_shear_of_that_plane():
    # gamma and kappa at D_LS/D_S = 1; the galaxies of a pixel have ratios b.
    gamma, kappa = 0.05 + 0.02j, 0.08
    b = jnp.linspace(0.3, 0.9, 51)
    galaxies = weak.Galaxies(jnp.zeros((51, 2)), b * gamma / (1.0 - b * kappa), 1.0, b)
    one = Grid((1, 1), 10.0)
    depth = weak.depth(galaxies)
    g = weak.to_single_plane(weak.to_grid(galaxies, one), depth).g[0, 0]
    ratio = float(depth.factor * depth.mean)
    expected = ratio * gamma / (1.0 - ratio * kappa)
    # What is neglected is of order kappa^2: 2e-4 here, where leaving out the factor costs 7e-2.
    np.testing.assert_allclose(g, expected, rtol=5e-4)


def test_scaling_to_one_ratio_is_exact_to_first_order_and_keeps_inverse_variances():
    b = jnp.array([0.0, 0.2, 0.5, 0.8])
    galaxies = weak.Galaxies(jnp.zeros((4, 2)), b * (0.1 - 0.05j), 2.0, b)
    scaled = weak.to_ratio(galaxies, 0.5)
    np.testing.assert_allclose(scaled.eps[1:], 0.5 * (0.1 - 0.05j))
    np.testing.assert_allclose(scaled.weight, 2.0 * (np.asarray(b) / 0.5) ** 2)
    np.testing.assert_array_equal(scaled.dls_ds, 0.5)


def test_drawn_redshifts_have_the_percentiles_of_the_catalogue():
    n = 20000
    z = jnp.broadcast_to(jnp.array([1.0, 0.05, jnp.nan, 0.7])[:, None], (4, n)).reshape(-1)
    lo = jnp.broadcast_to(jnp.array([0.9, -0.5, jnp.nan, jnp.nan])[:, None], (4, n)).reshape(-1)
    hi = jnp.broadcast_to(jnp.array([1.4, 0.1, jnp.nan, jnp.nan])[:, None], (4, n)).reshape(-1)
    drawn = np.asarray(weak.draw_redshifts(jax.random.key(1), z, lo, hi)).reshape(4, n)
    # Errors of percentiles of 20000 draws: below 0.002 and 0.006; limits are four of them.
    np.testing.assert_allclose(np.percentile(drawn[0], [15.87, 50.0]), [0.9, 1.0], atol=0.01)
    np.testing.assert_allclose(np.percentile(drawn[0], 84.13), 1.4, atol=0.025)
    assert drawn[1].min() == 0.0
    assert np.isnan(drawn[2]).all()
    np.testing.assert_array_equal(drawn[3], 0.7)


def test_galaxies_in_front_of_the_lens_have_no_ratio():
    plane = LensPlane.at(0.3)
    b = plane.dls_ds(jnp.array([0.2, 0.3, 2.0]))
    assert b[:2].tolist() == [0.0, 0.0] and float(b[2]) > 0.7


# --- null maps and resampling --------------------------------------------------------------------


@given(angle=angles())
def test_turning_an_ellipse_by_half_a_turn_is_nothing(angle: float):
    galaxies = sample(10)
    once = weak.rotate(weak.rotate(galaxies, angle), np.pi - angle)
    np.testing.assert_allclose(once.eps, galaxies.eps, atol=1e-14)
    np.testing.assert_allclose(jnp.abs(weak.rotate(galaxies, angle).eps), jnp.abs(galaxies.eps), rtol=1e-12)


def test_a_turn_by_45_degrees_exchanges_the_modes():
    galaxies = sample(10)
    np.testing.assert_allclose(weak.rotate(galaxies).eps, 1j * galaxies.eps, rtol=1e-12)


def test_scrambling_keeps_sizes_and_loses_the_mean():
    galaxies = weak.Galaxies(jnp.zeros((5000, 2)), jnp.full(5000, 0.3 + 0.1j))
    turned = weak.scramble(jax.random.key(2), galaxies)
    np.testing.assert_allclose(jnp.abs(turned.eps), jnp.abs(galaxies.eps), rtol=1e-12)
    # Standard deviation of the mean 0.0032 per component; false alarm 2e-5.
    assert abs(complex(jnp.mean(turned.eps))) < 0.015


@given(seed=st.integers(0, 2**20))
def test_a_bootstrap_sample_has_as_many_galaxies(seed: int):
    galaxies = weak.Galaxies(jnp.zeros((200, 2)), jnp.zeros(200) + 0j, jnp.full(200, 0.5))
    drawn = np.asarray(weak.resample(jax.random.key(seed), galaxies).weight) / 0.5
    assert drawn.sum() == 200
    np.testing.assert_array_equal(drawn, np.round(drawn))
    assert drawn.max() > 1  # 200 draws without a repetition: 1e-85


def test_shape_scatter_is_per_component():
    rng = np.random.default_rng(0)
    eps = rng.normal(scale=0.3, size=40000) + 1j * rng.normal(scale=0.3, size=40000)
    found = float(weak.shape_scatter(weak.Galaxies(np.zeros((40000, 2)), eps)))
    assert found == pytest.approx(0.3, rel=0.02)  # its own error is 0.25 %
