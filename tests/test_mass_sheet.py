"""The mass-sheet factor: maps, distribution and errors, against SciPy, Astropy and exact identities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize_scalar
from scipy.stats import gaussian_kde
from support import differences

from jaxlens import lens, mass_sheet, profiles, radial, weak
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Component, Lens

GRID = Grid((20, 24), 10.0)
RNG = np.random.default_rng(3)
KAPPA = np.asarray(0.9 * jnp.exp(-((GRID.radius / 45.0) ** 2))) + 0.05
distribution = jax.jit(mass_sheet.distribution)


def samples(kind: str, n: int = 1475, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if kind == "gauss":
        return rng.normal(1.14, 0.02, n)
    if kind == "two":
        return np.concatenate([rng.normal(1.1, 0.01, n // 3), rng.normal(1.2, 0.02, n - n // 3)])
    return 1.15 + 0.01 * rng.standard_t(1.5, n)  # heavy tails


# --- maps ------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(lam=st.floats(0.3, 3.0), other=st.floats(0.3, 3.0))
def test_lambda_is_that_of_the_transformation(lam: float, other: float):
    kappa = jnp.asarray(KAPPA)
    moved = mass_sheet.transform(kappa, lam)
    found = mass_sheet.ratio(moved, kappa)
    used = np.asarray(found.weight) > 0
    assert used.any()
    assert_allclose(np.asarray(found.lam)[used], lam, rtol=1e-12)
    assert_allclose(mass_sheet.regauge(moved, lam), kappa, atol=1e-13)
    # A mass sheet common to both maps changes nothing.
    both = mass_sheet.ratio(mass_sheet.transform(moved, other), mass_sheet.transform(kappa, other), floor=0.0)
    plain = mass_sheet.ratio(moved, kappa, floor=0.0)
    assert_allclose(both.lam, plain.lam, rtol=1e-9)


def test_reduced_shear_and_potential_follow_the_transformation():
    plane = LensPlane.at(z_l=0.3)
    halo = Lens(halo=Component(profiles.nfw.from_mass(5e14, 5.0, plane, e=0.2), (3.0, -2.0), 0.4))
    theta, lam = jnp.array([[40.0, -25.0], [70.0, 10.0]]), 1.3
    kappa, gamma = lens.kappa_and_gamma(halo, theta)
    g = gamma / (1.0 - kappa)
    assert_allclose(lam * gamma / (1.0 - mass_sheet.transform(kappa, lam)), g, rtol=1e-12)
    psi = lambda x: mass_sheet.transform_potential(lens.psi(halo, x), x, lam)
    half_trace = jax.vmap(lambda x: 0.5 * jnp.trace(jax.hessian(psi)(x)))(theta)
    assert_allclose(half_trace, mass_sheet.transform(kappa, lam), rtol=1e-9)


def test_pixels_at_kappa_one_have_no_weight_and_no_nan():
    reference = jnp.asarray(KAPPA).at[10, 12].set(1.0).at[3, 3].set(1.0 - 0.5 * mass_sheet.FLOOR)
    weight = jnp.ones(GRID.shape).at[0, 0].set(0.0)
    kappa = jnp.asarray(KAPPA + 0.1).at[0, 0].set(jnp.nan)
    found = mass_sheet.ratio(kappa, reference, weight)
    for place in ((10, 12), (3, 3), (0, 0)):
        assert float(found.weight[place]) == 0.0 and float(found.lam[place]) == 1.0
    assert np.isfinite(found.lam).all()
    slopes = jax.grad(lambda a, b: jnp.sum(mass_sheet.ratio(a, b, weight).lam), (0, 1))(kappa, reference)
    assert all(np.isfinite(slope).all() for slope in slopes)
    assert float(slopes[0][10, 12]) == 0.0


def test_the_decomposition_is_a_product_and_knows_a_perfect_model():
    truth = jnp.asarray(KAPPA)
    wl = mass_sheet.transform(truth, 1.15) + 0.01 * jnp.asarray(RNG.normal(size=GRID.shape))
    sl = truth + 0.03 * jnp.asarray(RNG.normal(size=GRID.shape))
    parts = mass_sheet.decompose(wl, sl, truth)
    assert_allclose(parts.lam_rec, parts.lam_map * parts.sl_factor, rtol=1e-12)
    perfect = mass_sheet.decompose(wl, truth, truth)
    assert_array_equal(perfect.sl_factor, jnp.ones(GRID.shape))
    assert_array_equal(perfect.lam_rec, perfect.lam_map)


def test_a_redshift_pair_of_one_plane_gives_one():
    plane = LensPlane.at(z_l=0.3)
    halo = Lens(halo=Component(profiles.nfw.from_mass(5e14, 5.0, plane, e=0.3), (3.0, -2.0), 0.4))
    kappa = lens.kappa(halo, GRID.theta)
    near, far = plane.dls_ds(0.8), plane.dls_ds(3.0)
    r = near / far
    assert_allclose(r, plane.sigma_cr(3.0) / plane.sigma_cr(0.8), rtol=1e-12)
    assert_allclose(mass_sheet.from_redshift_pair(near * kappa, far * kappa, r), 1.0, atol=1e-12)
    moved = [mass_sheet.transform(d * kappa, 0.87) for d in (near, far)]
    assert_allclose(mass_sheet.from_redshift_pair(moved[0], moved[1], r), 0.87, atol=1e-12)
    with pytest.raises(ValueError, match=r"`ratio_kappa` is 1.0; two source redshifts"):
        mass_sheet.from_redshift_pair(kappa, kappa, 1.0)
    jax.jit(mass_sheet.from_redshift_pair)(kappa, kappa, 1.0)  # traced: no value to look at


def test_one_regauge_in_the_package():
    assert weak.regauge is mass_sheet.regauge


# --- distribution ----------------------------------------------------------------------------------


def scipy_peak(values: np.ndarray) -> float:
    low, high = np.percentile(values, [1.0, 99.0])
    kde = gaussian_kde(values[(values >= low) & (values <= high)])
    fine = np.linspace(low, high, 4001)
    best = fine[np.argmax(kde(fine))]
    step = fine[1] - fine[0]
    found = minimize_scalar(
        lambda x: -kde(x)[0], bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-10}
    )
    return float(found.x)


@pytest.mark.parametrize("kind", ["gauss", "two", "heavy"])
def test_the_peak_is_that_of_scipy(kind: str):
    for seed in range(4):
        values = samples(kind, seed=seed)
        found = distribution(jnp.asarray(values))
        # SciPy's own minimiser stops at about 1e-8 of the value.
        assert abs(float(found.peak) - scipy_peak(values)) < 1e-6
        expected = np.percentile(values, [50, 16, 84])
        assert_allclose([found.median, found.lo, found.hi], expected, rtol=1e-12)
        assert float(found.count) == len(values)


def test_the_density_is_that_of_scipy():
    values = samples("heavy")
    low, high = np.percentile(values, [1.0, 99.0])
    kde = gaussian_kde(values[(values >= low) & (values <= high)])
    x = np.linspace(low - 0.02, high + 0.02, 300)
    ours = np.asarray(mass_sheet.density(jnp.asarray(values), jnp.asarray(x)))
    assert_allclose(ours, kde(x), rtol=1e-10, atol=1e-12)
    assert_allclose(mass_sheet.bandwidth(jnp.asarray(values)), np.sqrt(kde.covariance[0, 0]), rtol=1e-10)


def test_the_biweight_is_that_of_astropy():
    from astropy.stats import biweight_location

    for kind in ("gauss", "two", "heavy"):
        values = samples(kind)
        assert_allclose(mass_sheet.biweight(jnp.asarray(values)), biweight_location(values), rtol=1e-12)


def test_weights_count_as_repeats_and_zero_leaves_out():
    values = samples("two", n=200)
    times = np.random.default_rng(1).integers(0, 4, 200)
    spoilt = np.where(times > 0, values, np.nan)
    found = distribution(jnp.asarray(spoilt), jnp.asarray(times, float))
    plain = distribution(jnp.asarray(np.repeat(values, times)))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(plain), strict=True):
        assert_allclose(one, other, rtol=1e-10)


@pytest.mark.parametrize("kind", ["gauss", "two", "heavy"])
def test_chosen_values_are_those_of_weight_one(kind: str):
    values, chosen = jnp.asarray(samples(kind)), jnp.asarray(RNG.uniform(size=1475) < 0.8)
    weighted = jax.jit(mass_sheet.distribution_and_bandwidth)(values, chosen.astype(float))
    found = jax.jit(mass_sheet.distribution_and_bandwidth)(values, chosen)
    jax.tree.map(lambda a, b: assert_allclose(a, b, rtol=1e-13), found, weighted)
    assert_allclose(found[1], mass_sheet.bandwidth(values, chosen), rtol=1e-13)
    assert_allclose(found[0].peak, mass_sheet.peak(values, chosen), rtol=1e-13)


def test_a_sample_of_one_value_or_of_none_is_no_nan():
    one = mass_sheet.distribution(jnp.full(50, 1.2))
    assert_allclose([one.peak, one.biweight, one.median], 1.2, rtol=1e-8)
    assert float(one.half_width) == 0.0 and float(one.asymmetry) == 0.0
    none = mass_sheet.distribution(jnp.full(50, 1.2), jnp.zeros(50))
    assert float(none.count) == 0.0 and all(np.isfinite(leaf) for leaf in jax.tree.leaves(none))
    slope = jax.grad(lambda v: mass_sheet.peak(v))(jnp.full(50, 1.2))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("name", ["peak", "biweight", "median", "half_width"])
def test_derivatives_agree_with_differences(name: str):
    values = jnp.asarray(samples("two", n=150))
    direction = jnp.asarray(np.random.default_rng(5).normal(size=150))
    # Towards both of them: a shift of all samples, and a random one.
    f = jax.jit(lambda t: getattr(distribution(values + t[0] + t[1] * direction), name))
    slope = jax.grad(f)(jnp.zeros(2))
    assert_allclose(slope, differences(f, np.zeros(2), 1e-8), rtol=1e-5, atol=1e-7)
    assert_allclose(slope[0], 0.0 if name == "half_width" else 1.0, atol=1e-9)


# --- errors ----------------------------------------------------------------------------------------


def test_blocks_are_forty_arcsec_squares():
    number = np.asarray(mass_sheet.blocks(GRID))
    assert number.shape == GRID.shape
    assert len(np.unique(number)) == 5 * 6
    assert (number[:4, :4] == number[0, 0]).all() and number[4, 0] != number[0, 0] != number[0, 4]


def test_the_block_bootstrap_knows_that_neighbours_are_alike():
    """The scatter of the median over 150 noise maps smoothed by 1.5 pixels, against one map's bootstrap."""
    grid, rng = Grid((40, 40), 10.0), np.random.default_rng(2)
    noise = jnp.asarray(rng.normal(size=(150, 40, 40)))
    maps = 1.15 + jax.jit(jax.vmap(lambda v: weak.smooth(v, grid, 15.0)))(noise)
    true = float(jnp.std(jnp.median(maps.reshape(150, -1), axis=1)))
    weight = jnp.ones(grid.shape)
    error = jax.jit(mass_sheet.bootstrap, static_argnames=("grid", "side", "n"))
    block = np.mean([float(error(jax.random.key(i), maps[i], weight, grid, n=60).median) for i in range(5)])
    pixel = float(error(jax.random.key(9), maps[0], weight, grid, side=10.0, n=60).median)
    # Measured: true .0254, blocks .0164 (they are shorter than the correlation); a mean of 5 scatters by 6 %.
    assert 0.5 * true < block < 0.85 * true
    assert pixel < 0.4 * true


def test_masked_pixels_have_no_influence_on_the_bootstrap():
    weight = jnp.ones(GRID.shape).at[:, :10].set(0.0)
    lam = jnp.asarray(1.1 + 0.01 * RNG.normal(size=GRID.shape))
    run = jax.jit(lambda m: mass_sheet.bootstrap(jax.random.key(0), m, weight, GRID, n=20))
    clean, dirty = run(lam), run(lam.at[:, :10].set(1e9))
    for one, other in zip(jax.tree.leaves(clean), jax.tree.leaves(dirty), strict=True):
        assert_array_equal(one, other)
    assert float(clean.peak) > 0.0


# --- annuli of a fixed grid ------------------------------------------------------------------------


def test_annuli_give_what_the_general_profile_gives():
    edges = jnp.array([0.0, 20.0, 55.0, 90.0, 400.0, 500.0])
    weight = jnp.asarray((RNG.uniform(size=GRID.shape) > 0.2).astype(float))
    values = jnp.asarray(RNG.normal(size=GRID.shape)).at[2, 2].set(jnp.nan)
    weight = weight.at[2, 2].set(0.0)
    rings = radial.annuli(GRID.theta, edges, weight=weight)
    found, known = radial.profile_in(values, rings), radial.profile(values, GRID.radius, edges, weight)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(known), strict=True):
        assert_allclose(one, other, rtol=1e-12)
    assert_allclose(
        radial.rmse_in(values, rings), radial.rmse(values, GRID.radius, edges, weight), rtol=1e-12
    )
    assert_array_equal(rings.count, known.count)
    total, count = radial.sector_sums(jnp.asarray(np.asarray(GRID.theta)[..., 1]), rings)
    assert_array_equal(count.sum(axis=1), known.count)
    assert (np.asarray(total[1:4, :6]) > 0).all() and (np.asarray(total[1:4, 6:]) < 0).all()
    assert_allclose(radial.scatter(found), 0.5 * (known.hi - known.lo), rtol=1e-12)
    half = weight * (GRID.radius > 30.0)
    left, right = radial.profile_in(values, rings, half), radial.profile(values, GRID.radius, edges, half)
    assert_allclose(left.median, right.median, rtol=1e-12)
    line = radial.to_pixels(2.0 * rings.r, rings, jnp.asarray([[72.5, 1e3]]))
    assert_allclose(line, [[145.0, 2.0 * rings.r[-1]]])


@pytest.mark.parametrize("edges", [[10.0], [10.0, 5.0], [-1.0, 5.0]])
def test_bad_edges_are_refused(edges: list[float]):
    with pytest.raises(ValueError, match=r"`edges` is .*; give at least two increasing radii"):
        radial.annuli(GRID.theta, jnp.asarray(edges))
    with pytest.raises(ValueError, match=r"`position` has shape .* and `weight` \(3, 3\)"):
        radial.annuli(GRID.theta, jnp.array([1.0, 2.0]), weight=jnp.ones((3, 3)))
