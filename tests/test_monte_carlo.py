"""The Monte Carlo: one program, the same bytes for any chunk and after a resume, failures apart."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _mock import H, two_clumps  # pyright: ignore[reportMissingImports]
from numpy.testing import assert_allclose, assert_array_equal

from jaxlens import io, mass_sheet, radial, transition, weak
from jaxlens import monte_carlo as mc
from jaxlens.grid import Grid
from jaxlens.monte_carlo._measure import aligned_clean
from jaxlens.monte_carlo._run import _of_shear

KEY = jax.random.key(11)
N = 130


def made_setup() -> mc.Setup:
    """Pixels of 20 arcsec; a strong-lensing map whose error grows outwards; benchmarks have 48 x 48."""
    mock = two_clumps(n=24, oversample=4)
    rng = np.random.default_rng(0)
    ripple = np.asarray(weak.smooth(jnp.asarray(rng.normal(size=mock.kappa.shape)), mock.grid, 20.0))
    error = 0.03 * ripple / ripple.std() * np.clip((mock.radius - 150.0) / 200.0, 0.0, 1.0)
    kappa_sl = mock.kappa + error
    gamma = mock.g * (1.0 - mock.kappa) + np.asarray(weak.shear_of(jnp.asarray(error)))
    return mc.prepare(
        jnp.asarray(mock.g),
        jnp.asarray(mock.kappa),
        jnp.asarray(kappa_sl),
        weak.mean_counts(mock.grid, mock.plane, density=60.0),
        jnp.asarray(mock.weight),
        mock.grid,
        position=mock.grid.theta * float(mock.plane.kpc_per_arcsec) * H,
        edges=np.arange(50.0, 701.0, 50.0),
        g_sl=jnp.asarray(gamma / (1.0 - kappa_sl)),
    )


@pytest.fixture(scope="module")
def setup() -> mc.Setup:
    return made_setup()


@pytest.fixture(scope="module")
def plain(setup: mc.Setup) -> mc.LambdaProfiles:
    return mc.lambda_profiles(KEY, setup, N, keep_maps=True)


def same_bytes(one: Any, other: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


class Stopped(RuntimeError):
    """The process is gone."""


def test_same_bytes_for_any_chunk_and_after_a_resume(
    setup: mc.Setup, plain: mc.LambdaProfiles, tmp_path: Path
):
    seen: list[tuple[int, int]] = []
    files = io.BlockFiles(tmp_path / "state", mc.fingerprint(KEY, setup))

    def stop(done: int, total: int) -> None:
        seen.append((done, total))
        if done == 64:
            raise Stopped

    with pytest.raises(Stopped):
        mc.lambda_profiles(KEY, setup, N, chunk=1, keep_maps=True, checkpoint=files, on_progress=stop)
    assert [path.name for path in (tmp_path / "state").iterdir()] == ["block_00000.npz"]
    resumed = mc.lambda_profiles(KEY, setup, N, chunk=2, keep_maps=True, checkpoint=files, on_progress=stop)
    assert seen == [(64, N), (128, N), (N, N)]
    same_bytes(resumed, plain)
    # All blocks are on disk: nothing is computed again, and a shorter run is the beginning of it.
    first = mc.lambda_profiles(KEY, setup, 10, keep_maps=True, checkpoint=files)
    same_bytes(first.measured, jax.tree.map(lambda part: part[:10], plain.measured))
    other = io.BlockFiles(tmp_path / "state", mc.fingerprint(jax.random.key(12), setup))
    with pytest.raises(ValueError, match=r"block_00000.npz belongs to another computation"):
        mc.lambda_profiles(KEY, setup, N, keep_maps=True, checkpoint=other)
    with pytest.raises(ValueError, match=r"state of block 0 does not belong .*maps"):
        mc.lambda_profiles(KEY, setup, N, checkpoint=files)
    files.path(0).write_bytes(files.path(0).read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"block_00000.npz cannot be read .* delete it"):
        files.load(0)


@pytest.mark.long
def test_same_bytes_after_kill_9(setup: mc.Setup, plain: mc.LambdaProfiles, tmp_path: Path):
    """A process that computes more blocks than it will live to see."""
    program = """
import sys
import conftest, test_monte_carlo as here
from jaxlens import io, monte_carlo
setup = here.made_setup()
files = io.BlockFiles(sys.argv[1], monte_carlo.fingerprint(here.KEY, setup))
monte_carlo.lambda_profiles(here.KEY, setup, 100_000, chunk=1, checkpoint=files)
"""
    state = tmp_path / "state"
    known = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [sys.executable, "-c", program, str(state)]
    with subprocess.Popen(command, env=known, stderr=subprocess.PIPE) as process:
        while not (state / "block_00000.npz").exists():
            assert process.poll() is None, process.communicate()[1]
            time.sleep(0.02)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    assert 1 <= len(list(state.glob("block_*.npz"))) < 100
    resumed = mc.lambda_profiles(KEY, setup, N, checkpoint=io.BlockFiles(state, mc.fingerprint(KEY, setup)))
    same_bytes(resumed, eqx.tree_at(lambda p: p.maps, plain, None))


def test_the_fingerprint_knows_key_maps_and_settings(setup: mc.Setup):
    name = mc.fingerprint(KEY, setup)
    assert name == mc.fingerprint(KEY, setup)
    moved = eqx.tree_at(lambda s: s.kappa_sl, setup, setup.kappa_sl + 1e-12)
    assert len({name, mc.fingerprint(jax.random.key(0), setup), mc.fingerprint(KEY, moved)}) == 3


def test_one_bad_realisation_touches_no_other(setup: mc.Setup):
    clean = aligned_clean(setup)
    rng = np.random.default_rng(1)
    shape = (64, *setup.grid.shape)
    g = 0.02 * (rng.normal(size=shape) + 1j * rng.normal(size=shape)) + np.asarray(setup.g * setup.weight)
    g = g * np.asarray(setup.weight)
    none = jnp.zeros(64, int)
    over = jnp.zeros(64, bool)
    run = eqx.filter_jit(_of_shear)
    good = run(jnp.asarray(g), none, over, setup, clean)
    row, column = np.argwhere(np.asarray(setup.weight) > 0)[0]
    spoilt = g.copy()
    spoilt[5, row, column] = np.nan
    bad = run(jnp.asarray(spoilt), none, over.at[7].set(True), setup, clean)
    assert np.flatnonzero(~np.asarray(bad.measured.good)).tolist() == [5, 7]
    assert int(bad.n_good) == 62 and np.isfinite(bad.kappa).all() and np.isfinite(bad.pdf).all()
    keep = np.setdiff1d(np.arange(64), [5, 7])
    for one, other in zip(jax.tree.leaves(bad.measured), jax.tree.leaves(good.measured), strict=True):
        assert_array_equal(one[keep], other[keep])
    assert np.isnan(bad.measured.lam[5]) and np.isnan(bad.measured.rec.peak[5]).all()


def test_every_number_is_that_of_the_maps(setup: mc.Setup, plain: mc.LambdaProfiles):
    """Realisation 3, measured again by the public functions on its own maps."""
    maps = mc.noise_maps(KEY, 3, setup)
    assert plain.maps is not None
    # A matrix product rounds by its size.
    assert_allclose(plain.maps[3], maps["A2"], atol=1e-12)
    one = jax.tree.map(lambda part: part[3], plain.measured)
    weight, radius = np.asarray(setup.weight), np.asarray(setup.radius)
    rec = mass_sheet.ratio(maps["A2"], setup.kappa_sl, setup.weight)
    for index, (low, high) in enumerate(mc.RANGES):
        inside = jnp.asarray(np.where((radius >= low) & (radius < high), np.asarray(rec.weight), 0.0))
        assert_allclose(one.rec.peak[index], mass_sheet.peak(rec.lam, inside), rtol=1e-9)
        chosen = np.asarray(rec.lam)[np.asarray(inside) > 0]
        assert_allclose(one.rec.median[index], np.median(chosen), rtol=1e-10)
        assert int(one.rec.count[index]) == len(chosen)
    for name, found in (("A2", one.a2), ("K2", one.k2)):
        lam = (np.asarray(maps[name]) - 1.0) / (np.asarray(setup.kappa_true) - 1.0)
        inside = (weight > 0) & (radius >= 100) & (radius < 700)
        assert_allclose(found.median[2], np.median(lam[inside]), rtol=1e-9)
    corrected = mass_sheet.regauge(maps["A2"], one.lam)
    assert_allclose(one.lam, one.rec.median[0])
    assert_allclose(one.rmse, radial.rmse_in(corrected - setup.kappa_true, setup.rings), rtol=1e-8)
    assert_allclose(one.kappa.median, radial.profile_in(corrected, setup.rings).median, rtol=1e-8)
    used = np.asarray(setup.rings.used)
    sheet = np.median((np.asarray(maps["A2"]) - 1.0)[used] / (np.asarray(setup.kappa_sl) - 1.0)[used])
    d = np.asarray(mass_sheet.regauge(maps["A2"], sheet) - setup.kappa_sl - setup.bias) ** 2
    assert_allclose(one.moments.total.sum(), d[used].sum(), rtol=1e-8)
    noise = transition.aligned(maps["A2"], setup.kappa_sl, setup.rings) - aligned_clean(setup)
    assert_allclose(one.noise2, radial.mean_in(noise**2, setup.rings), rtol=1e-8)


def test_empty_pixels_are_counted_and_draws_do_not_know_the_mask(setup: mc.Setup, plain: mc.LambdaProfiles):
    noisy = mc.draw(KEY, 3, setup)
    empty = int(((np.asarray(noisy.n_gal) == 0) & (np.asarray(setup.weight) > 0)).sum())
    assert int(plain.measured.empty[3]) == empty
    assert plain.n_empty == int((np.asarray(plain.measured.empty) > 0).sum())
    other = eqx.tree_at(lambda s: (s.weight, s.kappa_sl), setup, (0.0 * setup.weight, setup.kappa_true))
    assert_array_equal(mc.draw(KEY, 3, other).g, noisy.g)
    assert not np.array_equal(mc.draw(KEY, 4, setup).g, noisy.g)


def test_noise_does_not_move_a2_and_k2_is_broader(setup: mc.Setup, plain: mc.LambdaProfiles):
    free, _ = mc.noiseless(setup)
    assert plain.n_bad == 0
    good = plain.good
    shift = np.asarray(good.a2.median[:, 2]).mean() - float(free.a2.median[2])
    error = np.asarray(good.a2.median[:, 2]).std() / np.sqrt(N)
    assert abs(shift) < 4.0 * error + 2e-3  # 4 sigma; the ellipticity of few galaxies is not Gaussian
    assert float(free.k2.half_width[2]) > 3.0 * float(free.a2.half_width[2])
    # The mean map is that of the corrected ones, and densities integrate to one.
    assert_allclose(np.trapezoid(plain.pdf, plain.pdf_x, axis=1), 1.0, atol=0.05)
    assert_allclose(plain.sigma_wl2, np.mean(good.noise2, axis=0))
    inside = np.asarray(setup.rings.used)
    # The corrected map has the scatter of lambda_P as well: 18 % of the variance at most were measured.
    spread = np.asarray(radial.mean_in(plain.sigma**2, setup.rings))
    assert_allclose(spread[2:], plain.sigma_wl2[2:], rtol=0.25)
    assert spread[5:].sum() > plain.sigma_wl2[5:].sum()
    assert np.abs(np.asarray(plain.kappa) - np.asarray(setup.kappa_true))[inside].max() < 0.3


def test_densities_are_those_of_single_maps(setup: mc.Setup):
    from jaxlens.monte_carlo._measure import measure_all

    maps = mc.noise_maps(KEY, 0, setup)
    found = jax.jit(lambda maps: measure_all(maps, setup, jnp.ones((), bool), jnp.zeros((), int))[2])(maps)
    lam = mass_sheet.ratio(maps["A2"], setup.kappa_true, setup.weight)
    values, weight = setup.sample(lam.lam, lam.weight, -1)
    exact = mass_sheet.density(values, setup.pdf_x, weight)
    # The averaged density keeps the 2 % outside the clipped range, and shares values out on the grid.
    assert np.abs(np.asarray(found[0] - exact)).max() < 0.05 * float(exact.max())


def test_samples_hold_the_pixels_of_their_range(setup: mc.Setup):
    radius, known = np.asarray(setup.radius), np.asarray(setup.weight)
    value = jnp.arange(known.size, dtype=float).reshape(known.shape)
    for which, (low, high) in enumerate(setup.ranges):
        found, weight = setup.sample(value, setup.weight, which)
        assert len(found) % 256 == 0
        used = np.asarray(weight)
        assert used.dtype == bool
        assert set(np.asarray(found)[used]) == set(
            np.asarray(value)[(radius >= low) & (radius < high) & (known > 0.0)]
        )
        own = mass_sheet.ratio(setup.kappa_sl, setup.kappa_true, setup.weight)
        inner = setup.weight * ((setup.radius >= low) & (setup.radius < high))
        median = mass_sheet.median(setup.kappa_sl, setup.kappa_true, inner)
        sample = setup.sample(own.lam, own.weight, which)
        assert_allclose(mass_sheet.distribution(*sample).median, median, rtol=1e-14)


def test_the_mean_over_maps_finds_the_shape_crossing(setup: mc.Setup):
    perfect = eqx.tree_at(lambda s: (s.kappa_sl, s.bias), setup, (setup.kappa_true, 0.0 * setup.bias))
    bias = aligned_clean(perfect) - setup.kappa_true
    # Three times the error of the set-up, so that it exceeds that of weak lensing at some radius.
    wrong = setup.kappa_true + 3.0 * (setup.kappa_sl - setup.kappa_true)
    radii = []
    for kappa_sl in (wrong, setup.kappa_true):
        made = eqx.tree_at(lambda s: (s.kappa_sl, s.bias), setup, (kappa_sl, bias))
        many = mc.lambda_profiles(KEY, made, 64)
        found = transition.excess_variance(
            KEY, transition.mean_moments(many.good.moments), setup.rings, many.sigma_wl2, bias, n=100
        )
        shape = transition.shape_errors(setup.clean["A2"], kappa_sl, setup.kappa_true, setup.rings)
        wl = jnp.sqrt(jnp.mean(many.good.shape**2, axis=0))
        truth = transition.first_rise(setup.rings.r, (shape.sl / wl) ** 2)
        assert bool(found.transition.found) == bool(truth.found) and not found.transition.inside
        radii.append((float(found.transition.radius), float(truth.radius)))
    # Within 75 kpc/h, one and a half annuli, as is asked of means over maps.
    assert radii[0][1] > 0.0 and abs(radii[0][0] - radii[0][1]) < 75.0
    assert radii[1] == (0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"correct_by": "mean"}, "`correct_by` is 'mean'"),
        ({"dtype": "float16"}, "`dtype` is 'float16'"),
        ({"ranges": ((1e4, 2e4),)}, "10000-20000 kpc/h holds 0 unmasked pixels"),
        ({"counts": jnp.full((24, 24), -1.0)}, "`counts` has negative entries"),
        ({"kappa_sl": jnp.full((24, 24), jnp.nan)}, "`kappa_sl` is not finite"),
        ({"grid": Grid((3, 3), 10.0)}, r"`kappa_true` has shape \(24, 24\) but `grid.shape` is \(3, 3\)"),
    ],
)
def test_bad_input_is_refused(setup: mc.Setup, change: dict[str, Any], message: str):
    given: dict[str, Any] = {
        "g": setup.g, "kappa_true": setup.kappa_true, "kappa_sl": setup.kappa_sl, "counts": setup.counts,
        "weight": setup.weight, "grid": setup.grid, "position": setup.position, "edges": setup.rings.edges,
        "inverse": setup.inverse,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        mc.prepare(**{**given, **change})


def test_at_least_one_realisation(setup: mc.Setup):
    with pytest.raises(ValueError, match="`n` is 0 and `chunk` 4"):
        mc.lambda_profiles(KEY, setup, 0)
