"""Annuli, projected masses and Einstein radii against closed forms and published values."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal

from jaxlens import datasets, lens, profiles, radial
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid


def test_profile_is_numpys_percentile_of_each_annulus() -> None:
    grid = Grid((40, 40), 2.0)
    rng = np.random.default_rng(1)
    values, weight = rng.normal(size=(40, 40)), (rng.uniform(size=(40, 40)) > 0.3).astype(float)
    edges = np.array([0.0, 8.0, 20.0, 35.0, 200.0, 300.0])
    found = radial.profile(jnp.asarray(values), grid.radius, jnp.asarray(edges), jnp.asarray(weight))
    r = np.asarray(grid.radius)
    for b in range(4):
        used = values[(r >= edges[b]) & (r < edges[b + 1]) & (weight > 0)]
        assert int(found.count[b]) == len(used)
        expected = np.percentile(used, [50, 16, 84])
        assert_allclose([found.median[b], found.lo[b], found.hi[b]], expected, rtol=1e-12)
    assert int(found.count[4]) == 0
    assert float(found.median[4]) == 0.0


def test_a_masked_pixel_has_no_influence() -> None:
    grid = Grid((8, 8), 1.0)
    values = jnp.arange(64.0).reshape(8, 8)
    weight = jnp.ones((8, 8)).at[3, 4].set(0.0)
    edges = jnp.array([0.0, 3.0, 6.0])
    spoilt = values.at[3, 4].set(jnp.nan)
    clean, dirty = (radial.profile(v, grid.radius, edges, weight) for v in (values, spoilt))
    assert bool(jnp.array_equal(clean.median, dirty.median))
    clean_rms, dirty_rms = (radial.rmse(v, grid.radius, edges, weight) for v in (values, spoilt))
    assert bool(jnp.array_equal(clean_rms, dirty_rms))


def test_rmse_of_each_annulus() -> None:
    grid = Grid((30, 30), 1.0)
    difference = np.random.default_rng(2).normal(size=(30, 30))
    edges = np.array([0.0, 5.0, 12.0, 500.0, 600.0])
    r = np.asarray(grid.radius)
    expected = [np.sqrt(np.mean(difference[(r >= a) & (r < b)] ** 2)) for a, b in pairwise(edges[:4])]
    found = radial.rmse(jnp.asarray(difference), grid.radius, jnp.asarray(edges))
    assert_allclose(found[:3], expected, rtol=1e-12)
    assert float(found[3]) == 0.0
    slope = jax.grad(lambda v: radial.rmse(v, grid.radius, jnp.asarray(edges)).sum())(jnp.asarray(difference))
    assert np.all(np.isfinite(np.asarray(slope)))


def test_profile_runs_over_realisations() -> None:
    grid = Grid((16, 16), 1.0)
    maps = jax.random.normal(jax.random.key(0), (5, 16, 16))
    edges = jnp.array([0.0, 4.0, 8.0])
    many = jax.vmap(lambda v: radial.profile(v, grid.radius, edges))(maps)
    assert many.median.shape == (5, 2)
    assert_allclose(many.median[3], radial.profile(maps[3], grid.radius, edges).median)


def test_mean_kappa_of_closed_forms() -> None:
    radii = jnp.array([0.5, 3.0, 20.0])
    sphere = lens.Lens(one=lens.Component(profiles.SIE(b=10.0), (2.0, 1.0)))
    assert_allclose(radial.mean_kappa(sphere, radii, centre=(2.0, 1.0)), 10.0 / radii, rtol=1e-9)
    # A point mass off centre counts wholly inside the circle and not at all outside; the convergence
    # of the sum is exponential in 512 angles.
    point = lens.Lens(one=lens.Component(profiles.PointMass(theta_e=3.0), (2.0, 1.0)))
    assert_allclose(radial.mean_kappa(point, radii[1:]), 9.0 / radii[1:] ** 2, rtol=1e-8)
    assert abs(float(radial.mean_kappa(point, radii[0]))) < 1e-12


def test_mass_is_the_sum_of_kappa_over_pixels() -> None:
    plane = LensPlane.at(0.3)
    halo = profiles.nfw.from_mass(8e14, 5.0, plane, e=0.3)
    model = lens.Lens(halo=lens.Component(halo, (3.0, -1.0), 0.6))
    grid = Grid.square(101.0, 0.1)
    inside = grid.radius < 50.0
    pixel = (grid.pixel * plane.d_l * np.pi / 648000.0) ** 2
    total = jnp.sum(jnp.where(inside, lens.kappa(model, grid.theta), 0.0)) * pixel * plane.sigma_cr_inf
    # 785 000 pixels: the staircase of the circle is a few 1e-5 of its area.
    assert_allclose(radial.mass_within(model, plane, jnp.asarray(50.0)), total, rtol=1e-4)


def test_published_masses_of_abell_s1063() -> None:
    """Projected masses made from the published model by an independent program (0.1 % is its grid)."""
    plane = LensPlane.at(0.3475)
    radii = jnp.array([50.0, 100.0, 200.0, 250.0]) / plane.kpc_per_arcsec
    found = radial.mass_within(datasets.reference_lens("as1063"), plane, radii)
    assert_allclose(found, [2.478e13, 7.641e13, 2.031e14, 2.668e14], rtol=1e-3)


def test_einstein_radius_and_its_derivative() -> None:
    def radius(b: jax.Array) -> jax.Array:
        cored = lens.Lens(one=lens.Component(profiles.SIE(b=b, r_core=1.0), (1.0, 1.0)))
        return radial.einstein_radius(cored, 0.8, centre=(1.0, 1.0))

    # mean kappa = 1 at r^2 = b (b - 2 s) with b the strength times D_LS/D_S.
    assert_allclose(radius(jnp.asarray(10.0)), np.sqrt(8.0 * 6.0), rtol=1e-12)
    # 1e-7: the slope is a central difference with a relative step of 1e-4.
    assert_allclose(jax.grad(radius)(jnp.asarray(10.0)), 0.8 * 7.0 / np.sqrt(48.0), rtol=1e-7)
    assert float(radius(jnp.asarray(1.0))) == 0.0
    assert np.isnan(float(radius(jnp.asarray(300.0))))  # still above 1 at the largest radius, 200


def test_einstein_radius_of_a_sheet_has_a_finite_derivative() -> None:
    """The mean convergence is flat: no radius, and no slope to divide by."""

    def radius(kappa: jax.Array) -> jax.Array:
        return radial.einstein_radius(lens.Lens(one=lens.Component(profiles.Sheet(kappa=kappa))), 1.0)

    value, slope = jax.value_and_grad(radius)(jnp.asarray(0.5))
    assert float(value) == 0.0
    assert float(slope) == 0.0


# --- quantiles -------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(
    values=hnp.arrays(np.float64, st.integers(1, 60), elements=st.floats(-1e3, 1e3)),
    data=st.data(),
    kind=st.sampled_from([np.float64, np.float32]),
)
def test_quantiles_of_chosen_values_are_those_of_numpy(
    values: np.ndarray, data: st.DataObject, kind: type
) -> None:
    values = values.astype(kind)
    chosen = np.array(data.draw(st.lists(st.booleans(), min_size=len(values), max_size=len(values))), bool)
    levels = jnp.asarray([0.0, 0.16, 0.5, 0.84, 1.0], kind)
    found = radial.quantiles(jnp.asarray(values), jnp.asarray(chosen), levels)
    assert found.dtype == kind
    if not chosen.any():
        assert_array_equal(found, np.zeros(5))
        return
    expected = np.quantile(values[chosen].astype(float), np.asarray(levels, float))
    # The place between two values has the rounding of the type.
    assert_allclose(found, expected, rtol=1e-6, atol=1e-4 if kind is np.float32 else 1e-9)
    weighted = radial.quantiles(jnp.asarray(values), jnp.asarray(chosen, kind), levels)
    assert_array_equal(found, weighted)


def test_quantiles_know_signs_zeros_and_infinities_and_put_nan_last() -> None:
    values = jnp.array([jnp.inf, -0.0, 3.0, -jnp.nan, -2.0, 0.0, jnp.nan, -5.0])
    levels = jnp.linspace(0.0, 1.0, 8)
    found = radial.quantiles(values, jnp.ones(8, bool), levels)
    assert_allclose(found[:5], [-5.0, -2.0, 0.0, 0.0, 3.0], atol=1e-12)  # a place in rounding


def test_the_derivative_of_a_quantile_goes_to_its_values() -> None:
    values, levels = jnp.array([3.0, -1.0, 2.0, 9.0, -4.0]), jnp.array([0.5, 0.4])
    chosen = jnp.array([True, True, True, False, True])  # -4, -1, 2, 3: the middle is that of -1 and 2
    expected = np.array([[0.0, 0.5, 0.5, 0.0, 0.0], [0.0, 0.8, 0.2, 0.0, 0.0]])
    for derivative in (jax.jacfwd, jax.jacrev):
        found = derivative(lambda v: radial.quantiles(v, chosen, levels))(values)
        assert_allclose(found, expected, atol=1e-12)
        rows = jax.vmap(derivative(lambda v: radial.quantiles(v, chosen, levels)))(
            jnp.stack([values, values])
        )
        assert_allclose(rows[1], expected, atol=1e-12)
