"""lambda(r) of real clusters: maps, error budget, twins, and the command `jaxlens real`."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from numpy.testing import assert_allclose
from scipy import ndimage
from support import strict
from typer.testing import CliRunner

from jaxlens import (
    analysis_real,
    budget_real,
    cli,
    datasets,
    maps_real,
    results_real,
    twin_real,
    weak,
    workflow_real,
)
from jaxlens import lens as lensing
from jaxlens._config import ConfigError
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Lens
from jaxlens.profiles import nfw

DRAWS = 16
OPTIONS = workflow_real.Options(draws=DRAWS, starts=1, joint=False, fields=0)


class Run(NamedTuple):
    out: Path
    said: str
    content: dict[str, Any]
    found: analysis_real.Analysis


@pytest.fixture(scope="module")
def cluster() -> workflow_real.Cluster:
    return workflow_real.load("as1063")


@pytest.fixture(scope="module")
def run(as1063_run, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The command, with the fit that `jaxlens strong` has made already."""
    out = tmp_path_factory.mktemp("real") / "out"
    made, write = [], results_real.write

    def recording(found: analysis_real.Analysis, directory: Path) -> dict[str, Any]:
        made.append(found)
        return write(found, directory)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis_real.strong, "fit", lambda *_, **__: as1063_run.outcome.fit)
        patch.setattr(results_real, "write", recording)
        command = ["real", "as1063", "--out", str(out), "--draws", str(DRAWS), "--no-cache"]
        result = CliRunner().invoke(cli.app, command, env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.stderr
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return Run(out, result.stderr, content, made[0])


def test_maps_of_a_lens_are_smoothed_beyond_their_edge():
    plane = LensPlane.at(0.3)
    halo = nfw.from_mass(np.array([8e14]), np.array([4.0]), plane, e=0.2)
    lens = Lens(halo=strict(halo, np.array([[12.0, -20.0]]), np.array([0.4])))
    grid = Grid((8, 10), 15.0, (5.0, -3.0))
    found = maps_real.maps_of(lens, grid, 30.0)
    # Independent: SciPy's Gaussian on a field that is three times as wide.
    wide = Grid((8 * 3 + 120, 10 * 3 + 120), 5.0, (5.0, -3.0))
    fine = np.asarray(lensing.kappa(lens, wide.theta))
    smooth = ndimage.gaussian_filter(fine, 6.0, truncate=8.0, mode="nearest")[60:-60, 60:-60]
    expected = smooth.reshape(8, 3, 10, 3).mean(axis=(1, 3))
    # The map of the lens ends three standard deviations beyond the edge; 4e-4 measured.
    assert_allclose(found.smooth, expected, atol=1e-3)
    g = maps_real.reduced(found, 0.7)
    assert_allclose(g, 0.7 * found.gamma / (1.0 - 0.7 * found.kappa), atol=1e-14)


def test_ellipticities_show_the_inverse_of_strong_shear():
    maps = maps_real.Maps(jnp.zeros((1, 2)), jnp.array([[0.2, 0.9]]), jnp.array([[0.2 + 0.1j, 0.3 + 0.4j]]))
    g = np.asarray(maps_real.reduced(maps, 1.0))
    assert_allclose(g, [[(0.2 + 0.1j) / 0.8, 0.1 / (0.3 - 0.4j)]], rtol=1e-12)


def test_the_inversion_is_that_of_the_weak_command(cluster: workflow_real.Cluster):
    sample = cluster.samples[0]
    field = sample.field
    once = maps_real.Inversion.of(sample).many(jnp.asarray(field.shear.g)[None])[0]
    # By conjugate gradients instead of a dense matrix.
    again = weak.reconstruct(field.shear, field.grid, smoothing=field.smoothing, cg_tol=1e-8).kappa
    assert_allclose(once, again, atol=1e-5)


def test_samples_follow_their_selection(cluster: workflow_real.Cluster):
    full, some = cluster.samples
    assert (full.calibration, some.calibration) == ((0.5, 0.1), (1.0, 0.2))
    assert full.dls_ds == pytest.approx(float(cluster.plane.dls_ds(1.5)), rel=1e-12)
    used = np.asarray(some.setup.galaxies.weight) > 0.0
    assert np.isfinite(some.setup.table.z[used]).all()
    assert some.setup.table.z[used].min() >= 0.3475 + 0.15
    keys = jax.random.split(jax.random.key(0), 400)
    for one in cluster.samples:
        ratio, factor = (np.asarray(part) for part in workflow_real.depth_draws(one, keys))
        # Redshift errors scatter galaxies to z = 0 and back: the mean moves by a few percent.
        assert ratio.mean() == pytest.approx(one.dls_ds, rel=0.05)
        assert 0.0 < ratio.std() < 0.05
        assert factor.mean() == pytest.approx(1.0, abs=0.05)
    # Certain redshifts leave nothing to draw.
    table = some.setup.table._replace(z_lo=some.setup.table.z, z_hi=some.setup.table.z)
    sure = dataclasses.replace(some.setup, table=table)
    certain = dataclasses.replace(some, field=dataclasses.replace(some.field, setup=sure))
    ratio, factor = workflow_real.depth_draws(certain, keys[:4])
    assert_allclose(ratio, some.dls_ds, rtol=1e-12)
    assert_allclose(factor, 1.0, rtol=1e-12)


@pytest.mark.long
def test_a_noiseless_map_of_the_model_has_the_expected_lambda(cluster: workflow_real.Cluster, run: Run):
    sample, fit = cluster.samples[0], run.found.fit
    lens = cluster.strong.problem.predict(fit.u).lens
    field = sample.field
    g = maps_real.reduced(maps_real.maps_of(lens, field.grid, field.smoothing), sample.dls_ds)
    shear = weak.ShearMap(sample.calibration[0] * g, field.shear.weight, field.shear.n_gal)
    perfect = dataclasses.replace(
        sample, field=dataclasses.replace(field, shear=shear), calibration=(sample.calibration[0], 0.0)
    )
    draws = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (DRAWS, *leaf.shape)), lens)
    one = analysis_real.compare(dataclasses.replace(cluster, published=None), perfect, lens, draws, OPTIONS)
    columns = results_real.table(one)
    assert_allclose(columns["lambda_rec"], columns["lambda_expected"], rtol=1e-9)
    assert one.found.excess is not None
    assert not bool(one.found.excess.transition.found)
    assert np.asarray(one.found.excess.q).max() < 0.0  # no difference, less the noise that was subtracted
    # What does not vary has no error, what does has.
    assert columns["error_strong"].max() < 1e-12
    assert columns["error_calibration"].max() < 1e-12
    assert columns["error_shape_noise"].min() > 0.01
    # Maps are far from linear in neither: both add up in quadrature, but for 16 draws.
    both = np.hypot(columns["error_shape_noise"], columns["error_redshifts"])
    assert_allclose(np.median(columns["error"] / both), 1.0, atol=0.3)


@pytest.mark.long
def test_the_files_of_the_command(run: Run):
    kinds = ("lambda", "budget", "calibration", "excess")
    stems = {f"{kind}_{key}" for kind in kinds for key in ("full", "photo_z")}
    names = {f"{stem}.{end}" for stem in stems for end in ("png", "pdf")}
    for key in ("full", "photo_z"):
        names |= {f"{kind}_{key}.fits" for kind in ("kappa_wl", "kappa_wl_noise", "kappa_sl", "lambda_rec")}
        names |= {f"lambda_{key}.ecsv"}
    assert {path.name for path in run.out.iterdir()} == names | {"summary.json", "report.html"}
    for key, one in run.content["samples"].items():
        made = Table.read(run.out / f"lambda_{key}.ecsv")
        low, high = one["inner_kpc_h"]
        # The headline is the median of the pixels of the file, in the annuli of the inner range.
        with fits.open(run.out / f"lambda_rec_{key}.fits") as hdus:
            lam = np.array(hdus[0].data, float)  # pyright: ignore[reportAttributeAccessIssue]
        outcome = next(o for o in run.found.outcomes if o.sample.key == key)
        radius = outcome.found.radius
        inside = np.isfinite(lam) & (radius >= low) & (radius < high)
        assert np.median(lam[inside]) == pytest.approx(one["lambda"]["value"], abs=1e-6)
        assert np.all(np.asarray(made["error"]) > 0.0)
        begin, end = one["lambda"]["interval"]["together"]
        assert begin < end
        assert set(one["lambda"]["interval"]) == set(budget_real.SOURCES)
    assert "138 per arcmin^2, calibration 0.5 +- 0.1" in run.said
    assert "not found" in run.said or "kpc/h" in run.said


@pytest.mark.long
def test_pixels_near_critical_curves_are_left_out(cluster: workflow_real.Cluster, run: Run):
    lens = cluster.strong.problem.predict(run.found.fit.u).lens
    for outcome, sample in zip(run.found.outcomes, cluster.samples, strict=True):
        grid = sample.field.grid
        # The mean of a pixel, from twice as many points a side as the mask takes.
        places = grid.pixel * ((np.arange(6) + 0.5) / 6.0 - 0.5)
        parts = [
            [
                part(lens, jnp.asarray(np.asarray(grid.theta) + np.array([x, y])))
                for x in places
                for y in places
            ]
            for part in (lensing.gamma, lensing.kappa)
        ]
        gamma, kappa = (np.mean(np.asarray(part), axis=0) for part in parts)
        g = np.abs(sample.dls_ds * gamma / (1.0 - sample.dls_ds * kappa))
        used = np.asarray(outcome.sample.field.shear.weight) > 0.0
        known = np.asarray(sample.field.shear.weight) > 0.0
        assert not used[(g > 0.6) & (g < 1.6)].any()
        assert np.array_equal(used[g < 0.4], known[g < 0.4])
        assert used.sum() < known.sum()


@pytest.mark.long
def test_the_report_stands_alone(run: Run):
    page = (run.out / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 8
    assert "http" not in page.replace("http://www.w3.org", "")
    for line in results_real.verdict(run.content).splitlines():
        assert line.split(":")[0] in page


@pytest.mark.long
def test_a_twin_has_the_images_and_shear_of_its_lens(cluster: workflow_real.Cluster, run: Run):
    u, lens = run.found.fit.u, cluster.published
    assert lens is not None
    made, truth = twin_real.twin(cluster, u, lens, jax.random.key(1), substructure=False)
    images, real = made.strong.problem.images, cluster.strong.problem.images
    assert images.n_images == real.n_images
    assert truth.images_kept > 0.9
    ratio = made.strong.problem.predict(u).dls_ds[images.source]
    back = np.asarray(lensing.ray_trace(lens, images.theta, ratio))
    assert len(back) == 50
    # Without noise the images of a system have one source; magnification only shrinks 0.5 arcsec of noise.
    spread = [np.ptp(back[np.asarray(images.source) == s], axis=0).max() for s in range(images.n_systems)]
    assert np.median(spread) < 1.0
    for one, other in zip(made.samples, cluster.samples, strict=True):
        assert np.array_equal(np.asarray(one.field.shear.weight), np.asarray(other.field.shear.weight))
    again, _ = twin_real.twin(cluster, u, lens, jax.random.key(1), substructure=False)
    assert np.array_equal(
        np.asarray(again.samples[0].field.shear.g), np.asarray(made.samples[0].field.shear.g)
    )
    result = twin_real.judge(analysis_real.compare(made, made.samples[0], lens, _same(lens), OPTIONS), truth)
    # The model is the truth: only noise, calibration and depth are left, and no transition.
    assert np.isnan(result.radius_true)
    assert result.radius_inside is None
    assert abs(result.lam - result.lam_true) < 4.0 * (result.interval[1] - result.interval[0])


def _same(lens: Lens) -> Lens:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (DRAWS, *leaf.shape)), lens)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("macs1149",), "has no weak.toml"),
        (("cosmos",), "has no strong.toml"),
        (("as1063", "--width", "-1"), "--width is -1"),
        (("as1063", "--width", "300"), "annuli of 300 kpc/h"),
    ],
)
def test_what_cannot_be_done_is_refused(
    arguments: tuple[str, ...], said: str, tmp_path: Path, as1063_run, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(analysis_real.strong, "fit", lambda *_, **__: as1063_run.outcome.fit)
    command = ["real", *arguments, "--out", str(tmp_path / "out"), "--draws", "16"]
    result = CliRunner().invoke(cli.app, command, env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


def test_probes_in_different_frames_are_refused(tmp_path: Path):
    for file in datasets.path("as1063").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    text = (tmp_path / "weak.toml").read_text(encoding="utf-8")
    (tmp_path / "weak.toml").write_text(text.replace("342.18322", "342.28322"), encoding="utf-8")
    with pytest.raises(ConfigError, match="give both in one frame"):
        workflow_real.load(str(tmp_path))
