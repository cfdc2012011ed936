"""Transition radii on hand-built maps whose transition is known, and on maps that have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support import differences

from jaxlens import mass_sheet, radial, transition
from jaxlens.grid import Grid

GRID = Grid((60, 60), 25.0)  # positions are taken as kpc/h
EDGES = jnp.arange(50.0, 701.0, 50.0)
RINGS = radial.annuli(GRID.theta, EDGES)
RADIUS = GRID.radius
TRUTH = 0.6 / (1.0 + RADIUS / 150.0)
SIGMA = 0.02


def maps(seed: int, *, slope: float = 2e-4, start: float = 150.0) -> tuple[jax.Array, jax.Array]:
    """White weak-lensing noise, and a strong-lensing error that grows with radius from `start`."""
    rng = np.random.default_rng(seed)
    wl = TRUTH + SIGMA * jnp.asarray(rng.normal(size=GRID.shape))
    error = slope * jnp.maximum(RADIUS - start, 0.0)
    return wl, TRUTH + error * jnp.asarray(rng.normal(size=GRID.shape))


@jax.jit
def excess(wl: jax.Array, sl: jax.Array) -> transition.Excess:
    sigma2 = jnp.full(len(EDGES) - 1, SIGMA**2)
    return transition.excess_variance(
        jax.random.key(0), transition.moments(wl, sl, RINGS), RINGS, sigma2, n=200
    )


def test_the_excess_variance_finds_a_known_transition():
    """The error of the strong-lensing map is that of weak lensing at 150 + 0.02/2e-4 = 250 kpc/h."""
    radii = []
    for seed in range(6):
        found = excess(*maps(seed))
        assert found.transition.found
        assert float(found.lo) <= float(found.transition.radius) + 25.0
        assert float(found.lo) < float(found.hi) and float(found.share) > 0.9
        radii.append(float(found.transition.radius))
        # The excess is the variance of the strong-lensing map itself.
        expected = radial.mean_in((2e-4 * jnp.maximum(RADIUS - 150.0, 0.0)) ** 2, RINGS)
        assert_allclose(found.sl[6:], expected[6:], rtol=0.35)
    assert abs(np.mean(radii) - 250.0) < 15.0  # measured 246, single maps scatter by 10


def test_a_perfect_strong_lensing_map_has_no_transition():
    """Of 40 noise maps at most two have one by chance (the design figure is 2 to 4 %)."""
    null = [excess(maps(seed)[0], TRUTH).transition for seed in range(40)]
    by_chance = sum(bool(one.found | one.inside) for one in null)
    assert by_chance <= 2
    found = excess(TRUTH + 0.0 * TRUTH, TRUTH)
    assert not found.transition.found
    assert float(found.share) == float(found.lo) == float(found.hi) == float(found.transition.radius) == 0.0


def test_the_mean_over_maps_is_one_map_with_less_noise():
    many = [transition.moments(*maps(seed), RINGS) for seed in range(5)]
    stacked = jax.tree.map(lambda *each: jnp.stack(each), *many)
    mean = transition.mean_moments(stacked)
    assert_allclose(mean.mean, np.mean([one.mean for one in many], axis=0), rtol=1e-12)
    assert stacked.mean.shape == (5, len(EDGES) - 1)


def test_the_error_of_the_method_is_taken_out():
    wl, sl = maps(0)
    bias = 0.1 * jnp.cos(RADIUS / 50.0)
    plain, moved = transition.moments(wl, sl, RINGS), transition.moments(wl + bias, sl, RINGS, bias)
    assert_allclose(moved.total, plain.total, rtol=1e-10)


R = jnp.arange(75.0, 700.0, 50.0)


def test_a_rise_must_stay():
    q = jnp.array([0.1, 0.5, 1.5, 0.8, 0.5, 0.5, 1.5, 2.0, 2.0, 0.2, 0.2, 0.2, 0.2])
    found = transition.first_rise(R, q)
    assert found.found and int(found.index) == 5
    assert_allclose(found.radius, R[5] + 0.5 * 50.0)  # half the way from 0.5 to 1.5
    dip = jnp.where(jnp.arange(13) == 8, 0.9, q)
    assert transition.first_rise(R, dip).found and not transition.first_rise(R, dip, 3).found
    assert not transition.first_rise(R, q.at[6:].set(0.0).at[12:].set(2.0)).found  # one annulus is not two
    assert transition.first_rise(R, q.at[6:].set(0.0).at[11:].set(2.0)).found
    assert not transition.first_rise(R[:2], q[:2]).found


def test_above_1_all_over_is_no_transition():
    always = transition.first_rise(R, jnp.full(13, 3.0))
    assert always.inside and not always.found and float(always.radius) == 0.0
    # A later rise goes before it; one annulus above 1 is not enough.
    again = transition.first_rise(R, jnp.full(13, 3.0).at[4:6].set(0.5))
    assert again.found and not again.inside and float(again.radius) > float(R[5])
    once = transition.first_rise(R, jnp.full(13, 0.5).at[0].set(3.0))
    assert not once.inside and not once.found and float(once.radius) == 0.0
    # Better inside alone is not better all over; a single annulus below is noise.
    core = transition.first_rise(R, jnp.full(13, 0.5).at[:4].set(3.0))
    assert not core.inside and not core.found
    assert transition.first_rise(R, jnp.full(13, 3.0).at[12].set(0.5)).inside


def test_an_annulus_of_few_pixels_crosses_nothing():
    """Its ratio is 0 or noise: the first one that counts stands for it."""
    q, known = jnp.array([0.0, 3.0, 3.0, 3.0, 0.0]), jnp.array([False, True, True, True, False])
    assert_allclose(transition.smooth_profile(q, known), 3.0)
    wl, sl = maps(0, slope=2e-3, start=0.0)
    hole = jnp.where((RADIUS < 95.0) | ((RADIUS < 100.0) & (GRID.theta[..., 0] > 0.0)), 0.0, 1.0)
    rings = radial.annuli(GRID.theta, EDGES, weight=hole)
    assert 0 < int(rings.count[0]) < transition.FEWEST
    found = transition.excess_variance(
        jax.random.key(0), transition.moments(wl, sl, rings), rings, jnp.full(len(R), SIGMA**2), n=50
    )
    assert found.transition.inside and not found.transition.found and float(found.q[0]) == float(found.q[1])
    assert float(found.share_inside) > 0.9 and float(found.share) == float(found.lo) == 0.0


def test_a_wrong_core_does_not_move_the_sheet_of_all_annuli():
    """A strong-lensing map that is wrong by a mass sheet inside 250 kpc/h pulls lambda of an inner range."""
    wl, _ = maps(2)
    wrong = jnp.where(RADIUS < 250.0, mass_sheet.transform(TRUTH, 0.9), TRUTH)
    # The wrong core has 1/8 of the pixels: it moves the median of a sample of scatter 0.025 by 0.004.
    assert_allclose(transition.sheet_between(wl, wrong, RINGS), 1.0, atol=8e-3)
    moved = transition.aligned(mass_sheet.transform(wl, 1.3), wrong, RINGS)
    assert_allclose(moved, transition.aligned(wl, wrong, RINGS), rtol=1e-9)
    median = transition.sheet_between(wl, wrong, RINGS, (RADIUS < 250.0).astype(float))
    assert abs(float(median) - 1.0 / 0.9) < 0.02


def test_the_radius_is_differentiable():
    q = jnp.linspace(0.1, 3.1, 13)
    f = jax.jit(lambda q: transition.first_rise(R, q).radius)
    assert_allclose(jax.grad(f)(q), differences(f, q, 1e-5), atol=1e-7)


def test_smoothing_of_a_profile():
    assert_allclose(transition.smooth_profile(jnp.full(6, 2.0)), 2.0)
    assert_allclose(
        transition.smooth_profile(jnp.array([0.0, 0.0, 4.0, 0.0])), np.array([0.0, 1.0, 2.0, 4.0 / 3.0])
    )


# --- with the truth ---------------------------------------------------------------------------------


@settings(deadline=None, max_examples=20)
@given(a=st.floats(0.5, 2.0), b=st.floats(0.5, 2.0))
def test_shape_errors_do_not_know_mass_sheets(a: float, b: float):
    wl, sl = maps(3)
    found = shape(mass_sheet.transform(wl, a), mass_sheet.transform(sl, b))
    plain = shape(wl, sl)
    assert_allclose(found.wl, plain.wl, rtol=1e-9)
    assert_allclose(found.sl, plain.sl, rtol=1e-9, atol=1e-15)
    assert_allclose([found.lam_wl, found.lam_sl], [a * plain.lam_wl, b * plain.lam_sl], rtol=1e-9)


shape = jax.jit(lambda wl, sl: transition.shape_errors(wl, sl, TRUTH, RINGS))


def test_errors_against_the_truth_and_their_region():
    wl, sl = maps(1)
    found = transition.map_errors(wl, sl, TRUTH, RINGS)
    used = np.asarray(RINGS.cell) // 12
    for b in range(len(EDGES) - 1):
        for errors, kappa in ((found.wl, wl), (found.sl, sl)):
            assert_allclose(errors[b], np.sqrt(np.mean(np.asarray(kappa - TRUTH)[used == b] ** 2)), rtol=1e-9)
    region = np.asarray(R)[np.asarray(found.comparable)]
    assert region.min() >= 175.0 and region.max() <= 425.0 and 275.0 in region
    assert_array_equal(transition.comparable(jnp.array([1.0, 1.0]), jnp.array([1.66, 1.67])), [True, False])


def test_crossings_have_a_place_and_a_direction():
    first, second = jnp.array([0.0, 2.0, 2.0, 0.0]), jnp.ones(4)
    found = transition.crossings(jnp.arange(4.0), first, second)
    assert_allclose(found.radius, [0.5, 0.0, 2.5])
    assert_array_equal(found.direction, [1, 0, -1])


# --- scatter ----------------------------------------------------------------------------------------


def test_the_first_minimum_of_the_scatter():
    found = transition.scatter_minimum(R[:7], jnp.array([5.0, 4.0, 3.0, 4.0, 5.0, 2.0, 1.0]))
    assert found.found and int(found.index) == 2
    assert_allclose([found.radius, found.lo, found.hi], [175.0, 175.0, 225.0])
    for monotonic in (jnp.arange(7.0), -jnp.arange(7.0), jnp.ones(7)):
        assert not transition.scatter_minimum(R[:7], monotonic).found
    with pytest.raises(ValueError, match="`scatter` has 2 annuli"):
        transition.scatter_minimum(R[:2], jnp.ones(2))


def test_the_criterion_stands_beside_its_null_distribution():
    rng = np.random.default_rng(0)
    profile = np.array([5.0, 4.0, 3.0, 4.0, 5.0, 4.0, 3.0])
    clear = jnp.asarray(profile + 0.01 * rng.normal(size=(40, 7)))
    null = jnp.asarray(np.linspace(5.0, 1.0, 7) + 1e-3 * rng.normal(size=(30, 7)))
    found = transition.scatter_criterion(R[:7], clear, null)
    assert int(found.minimum.index) == 2 and float(found.agreement) == 1.0
    assert_allclose(found.shares, [0, 0, 1, 0, 0, 0, 0])
    assert not found.null_minimum.found
    assert float(found.null_agreement) == 0.0 and float(found.null_shares.sum()) == 0.0
    # Pure noise "agrees" with itself as often as chance allows, and the null distribution says so.
    noise = jnp.asarray(rng.normal(size=(400, 7)))
    blind = transition.scatter_criterion(R[:7], noise[:200], noise[200:])
    assert abs(float(blind.agreement) - float(blind.null_agreement)) < 0.2


# --- combination ------------------------------------------------------------------------------------


def test_the_combined_map_beats_both():
    wl, sl = maps(2)
    found = excess(wl, sl)
    both = transition.combined(wl, sl, found, RINGS, RADIUS)
    errors = [np.asarray(radial.rmse_in(kappa - TRUTH, RINGS)) for kappa in (both, wl, sl)]
    better = np.minimum(errors[1], errors[2])
    assert (errors[0][2:] < 1.1 * better[2:]).all()  # inside, the strong-lensing map is exact
    assert (errors[0][:2] < 1e-3).all()
    assert (errors[0][5:9] < 0.95 * better[5:9]).all()
    perfect = transition.combined(wl, TRUTH, excess(TRUTH, TRUTH), RINGS, RADIUS)
    assert_array_equal(perfect, TRUTH)


@jax.jit
def external(wl: jax.Array, sl: jax.Array, lam: float, error: float) -> transition.External:
    sigma2 = jnp.full(len(EDGES) - 1, SIGMA**2)
    return transition.with_external(jax.random.key(1), wl, sl, RINGS, lam, error, sigma2, n=200)


def test_an_external_lambda_says_which_probe_is_better():
    wl, sl = maps(4, start=100.0, slope=3e-4)  # equal at 167 kpc/h
    found = external(mass_sheet.transform(wl, 1.15), sl, 1.15, 0.005)
    better = np.asarray(found.better)
    assert (better[:1] == -1).all() and (better[4:] == 1).all()
    assert_allclose(found.wl, SIGMA**2, rtol=0.12)  # the error of lambda adds a little


def test_an_external_lambda_sees_the_sheet_that_lambda_p_hides():
    """A strong-lensing map that is a mass-sheet transform of the truth is perfect for every lambda_rec."""
    wl, _ = maps(5)
    sl = mass_sheet.transform(TRUTH, 1.06)
    lam = mass_sheet.distribution(mass_sheet.ratio(wl, sl).lam, RINGS.used.astype(float)).median
    blind = excess(mass_sheet.regauge(wl, lam), sl)
    assert not blind.transition.found
    seen = external(wl, sl, 1.0, 0.005)
    assert (np.asarray(seen.better)[4:] == 1).all()
    assert_allclose(np.sqrt(seen.sl[6:]), 0.06 * (1.0 - np.asarray(TRUTH).mean()), rtol=0.4)
    # A lambda that is hardly known decides nothing.
    vague = external(wl, sl, 1.0, 0.2)
    assert (np.asarray(vague.better) != 1).all()
