"""The command `jaxlens lambda`: from two maps to files, and what it refuses."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from jaxlens import io, mass_sheet, weak, workflow_lambda
from jaxlens.cli import app
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid, onto, rebin

GRID, FINE = Grid((40, 40), 12.0, (6.0, 0.0)), Grid((124, 120), 4.0, (6.0, 2.0))
SMOOTHING, LAM, Z_L = 15.0, 1.15, 0.3
REFERENCE = (342.2, -44.5)
PLANE = LensPlane.at(z_l=Z_L)
HEADER: dict[str, Any] = {"ZLENS": Z_L, "ZSOURCE": 2.0, "SMOOTHAS": SMOOTHING}


def field(grid: Grid) -> np.ndarray:
    """A cluster centred on theta = 0, for sources at z = 2."""
    return np.asarray(0.9 / (1.0 + (grid.radius / 40.0) ** 2) ** 0.6)


class Maps(NamedTuple):
    """Files of one mock."""

    wl: Path
    sl: Path
    truth: Path
    sigma: Path
    transition: float


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Maps:
    """Noise, and a strong-lensing map (finer, for z = 4) whose error exceeds it beyond a known radius."""
    where, rng = tmp_path_factory.mktemp("maps"), np.random.default_rng(1)
    ratio = float(PLANE.dls_ds(2.0))
    truth = weak.smooth(jnp.asarray(field(FINE)), FINE, SMOOTHING)
    noise = weak.smooth(jnp.asarray(rng.normal(size=GRID.shape)), GRID, SMOOTHING)
    noise = 0.015 * np.asarray(noise) / float(np.std(np.asarray(noise)))
    coarse, _ = onto(truth, FINE, GRID)
    wl = np.array(mass_sheet.transform(coarse + noise, LAM))
    wl[20, 20] = np.nan
    io.write_map(where / "wl.fits", wl, GRID, header={**HEADER, "DLSDS": ratio}, reference=REFERENCE)
    radius = np.asarray(FINE.radius) * float(PLANE.kpc_per_arcsec) * 0.7
    ripple = np.asarray(weak.smooth(jnp.asarray(rng.normal(size=FINE.shape)), FINE, 14.0))
    error = 0.04 * ripple / ripple.std() * np.clip((radius - 150.0) / 200.0, 0.0, 1.0)
    sl = (field(FINE) + error) * float(PLANE.dls_ds(4.0)) / ratio
    four = {"ZLENS": Z_L, "DLSDS": float(PLANE.dls_ds(4.0))}
    io.write_map(where / "sl.fits", sl, FINE, header=four, reference=REFERENCE)
    io.write_map(where / "truth.fits", field(FINE), FINE, header={"ZSOURCE": 2.0}, reference=REFERENCE)
    io.write_map(where / "sigma.fits", np.full(GRID.shape, 0.015 * LAM), GRID, reference=REFERENCE)
    return Maps(where / "wl.fits", where / "sl.fits", where / "truth.fits", where / "sigma.fits", 230.0)


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["lambda", *map(str, arguments), "--no-cache"])


@pytest.fixture(scope="module")
def results(maps: Maps, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lambda") / "out"
    done = run(
        "--wl", maps.wl, "--sl", maps.sl, "--truth", maps.truth, "--sigma", maps.sigma, "--out", out,
        "--lambda", LAM, "--lambda-error", 0.01, "--bootstrap", 40,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "transition by excess variance at" in done.output and "Results in" in done.output
    return out


def test_the_command_finds_lambda_and_the_transition(maps: Maps, results: Path):
    content = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    inner = content["lambda"]["100-300"]
    for name in ("peak", "median", "biweight"):
        assert abs(inner[name]["value"] - LAM) < 4.0 * inner[name]["error"] < 0.1
    found = content["transition"]
    assert found["found"] and abs(found["r_kpc_h"] - maps.transition) < 75.0
    low, high = found["range_kpc_h"]
    assert low < high
    assert_allclose(content["kappa_sl_scaled_by"], PLANE.dls_ds(2.0) / PLANE.dls_ds(4.0), rtol=1e-12)
    better = content["external"]["better"]
    assert better[0] != "weak lensing" and better[-1] == "weak lensing"
    truth = content["truth"]
    assert abs(truth["lambda_wl"] - LAM) < 0.01
    assert truth["crossings_shape"][0]["to"] == "weak lensing"
    assert abs(truth["crossings_shape"][0]["r_kpc_h"] - found["r_kpc_h"]) < 75.0


def test_the_files_read_back(results: Path):
    names = {path.name for path in results.iterdir()}
    stems = ("lambda_profile", "lambda_pdf", "kappa_profile")
    assert names == {
        "summary.json", "profiles.ecsv", "lambda_rec.fits", "kappa_wl_corrected.fits",
        "kappa_sl_matched.fits", "kappa_combined.fits",
        *(f"{stem}.{kind}" for stem in stems for kind in ("pdf", "png")),
    }  # fmt: skip
    wl, sl = (io.read_map(results / f"{name}.fits") for name in ("kappa_wl_corrected", "kappa_sl_matched"))
    assert wl.grid == GRID and wl.reference == pytest.approx(REFERENCE)
    assert wl.header["SMOOTHAS"] == SMOOTHING and wl.header["LAMBDA"] == pytest.approx(LAM, abs=0.02)
    assert np.isnan(wl.values[20, 20]) and np.isfinite(wl.values).sum() == wl.values.size - 1
    assert abs(np.nanmedian(wl.values - sl.values)) < 0.01
    both = io.read_map(results / "kappa_combined.fits").values
    low, high = np.minimum(wl.values, sl.values), np.maximum(wl.values, sl.values)
    inside = np.isfinite(both)
    assert (both[inside] >= low[inside] - 1e-12).all() and (both[inside] <= high[inside] + 1e-12).all()
    rows = io.read_table(results / "profiles.ecsv", ["r_kpc_h", "lambda_rec", "q", "rmse_wl", "sigma_sl"])
    assert len(rows) >= 8 and np.isfinite(rows["q"]).all()


def test_without_noise_there_is_no_transition_to_look_for(maps: Maps, tmp_path: Path):
    done = run("--wl", maps.wl, "--sl", maps.sl, "--out", tmp_path / "out", "--bootstrap", 20)
    assert done.exit_code == 0, done.output
    assert "it needs the noise of the weak-lensing map" in done.output
    content = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert content["transition"] is content["truth"] is content["external"] is None
    assert not (tmp_path / "out" / "kappa_combined.fits").exists()


def test_maps_are_brought_to_one_plane_grid_and_resolution(maps: Maps):
    pair = workflow_lambda.load(maps.wl, maps.truth, workflow_lambda.Options())
    expected, _ = onto(weak.smooth(jnp.asarray(field(FINE)), FINE, SMOOTHING), FINE, GRID)
    assert_allclose(pair.kappa_sl, expected, rtol=1e-12)
    assert pair.weight[20, 20] == 0.0 and pair.scale_sl == pytest.approx(1.0)


def copy(maps: Maps, where: Path, name: str, **header: Any) -> Path:
    """The same map with other keys; None takes one away."""
    found = io.read_map(getattr(maps, name))
    merged = {key: value for key, value in {**found.header, **header}.items() if value is not None}
    path = where / f"{name}.fits"
    io.write_map(path, found.values, found.grid, header=merged, reference=found.reference)
    return path


@pytest.mark.parametrize(
    ("name", "header", "extra", "message"),
    [
        ("wl", {"ZLENS": None}, (), "has no key ZLENS; add it to the header, or give --z-lens"),
        ("wl", {"SMOOTHAS": None}, (), "has no key SMOOTHAS; add it to the header, or give --smoothing-wl"),
        (
            "sl",
            {"DLSDS": None},
            (),
            "has no key ZSOURCE; add it to the header, or give --z-sl or --dls-ds-sl",
        ),
        ("sl", {"DLSDS": 1.5}, (), "D_LS/D_S is 1.5; sources lie behind the lens"),
        ("sl", {"SMOOTHAS": 30.0}, (), "is smoothed by 30 arcsec"),
        ("sl", {"ZLENS": 0.5}, (), "has ZLENS = 0.5"),
        ("sl", {}, ("--z-sl", "0.2"), "D_LS/D_S is 0; sources lie behind the lens: give --z-sl"),
        ("sl", {}, ("--width", "500"), "annuli of 500 kpc/h hold 8 pixels"),
        ("sl", {}, ("--r-max", "10"), "--r-max is 10"),
        ("sl", {}, ("--inner", "1", "5"), "pixels between 1 and 5 kpc/h are known in both maps"),
        ("sl", {}, ("--lambda", "1.1"), "--lambda and --lambda-error belong together"),
        ("sl", {}, ("--x", "5000"), "only 0 annuli"),
    ],
)
def test_bad_input_is_refused_by_name(
    maps: Maps, tmp_path: Path, name: str, header: dict[str, Any], extra: tuple[str, ...], message: str
):
    files = {"wl": maps.wl, "sl": maps.sl, name: copy(maps, tmp_path, name, **header)}
    done = run("--wl", files["wl"], "--sl", files["sl"], "--out", tmp_path / "out", *extra)
    assert done.exit_code == 2, done.output
    assert message in done.output
    assert not (tmp_path / "out").exists()


def test_maps_that_do_not_fit_together_are_refused(maps: Maps, tmp_path: Path):
    options = workflow_lambda.Options()
    found = io.read_map(maps.sl)
    bare = tmp_path / "bare.fits"
    io.write_map(bare, found.values, found.grid, header=found.header)
    with pytest.raises(ValueError, match=r"has RA and Dec, .*bare.fits has not"):
        workflow_lambda.load(maps.wl, bare, options)
    far = tmp_path / "far.fits"
    io.write_map(far, found.values, found.grid, header=found.header, reference=(10.0, 10.0))
    with pytest.raises(ValueError, match="more than a degree apart"):
        workflow_lambda.load(maps.wl, far, options)
    holes = tmp_path / "holes.fits"
    spoilt = found.values.copy()
    spoilt[3, 4] = np.nan
    io.write_map(holes, spoilt, found.grid, header=found.header, reference=REFERENCE)
    with pytest.raises(ValueError, match=r"holes.fits is nan at row 3, column 4"):
        workflow_lambda.load(maps.wl, holes, options)
    with pytest.raises(ValueError, match=r"--sigma .*sl.fits has the grid .*; give it on the same grid"):
        workflow_lambda.load(maps.wl, maps.sl, options, sigma=maps.sl)
    with pytest.raises(ValueError, match="say the same; give one of them"):
        workflow_lambda.load(maps.wl, maps.sl, options, sigma=maps.sigma, snr=maps.sigma)
    turned = tmp_path / "turned.fits"
    from astropy.io import fits

    header = fits.Header()
    step = found.grid.pixel / 3600.0
    for key, value in {
        "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": REFERENCE[0], "CRVAL2": REFERENCE[1],
        "CRPIX1": 60.0, "CRPIX2": 60.0, "CD1_1": -step, "CD2_2": step, "CD1_2": 0.1 * step,
    }.items():  # fmt: skip
        header[key] = value
    fits.PrimaryHDU(found.values, header).writeto(turned)
    with pytest.raises(ValueError, match=r"turned.fits .*axes are turned \(CD1_2"):
        workflow_lambda.load(maps.wl, turned, options)


def test_a_signal_to_noise_map_is_noise_and_mask(maps: Maps, tmp_path: Path):
    found = io.read_map(maps.wl)
    values = np.where(np.isfinite(found.values), found.values, 0.0) / 0.02
    values[:3] = 0.0
    io.write_map(tmp_path / "snr.fits", values, GRID, reference=REFERENCE)
    pair = workflow_lambda.load(maps.wl, maps.sl, workflow_lambda.Options(), snr=tmp_path / "snr.fits")
    assert pair.sigma is not None
    used = pair.weight > 0
    assert not used[:3].any() and used[3:].sum() == 37 * 40 - 1
    assert_allclose(pair.sigma[used], 0.02, rtol=1e-12)


def test_resampling_conserves_area_and_knows_what_it_covers():
    values = jnp.asarray(np.random.default_rng(0).normal(size=(12, 8)))
    grid = Grid((12, 8), 2.0)
    same, covered = onto(values, grid, grid)
    assert_allclose(same, values, rtol=1e-12)
    assert_allclose(covered, 1.0)
    blocks, coarse = rebin(values, grid, 4)
    assert_allclose(onto(values, grid, coarse)[0], blocks, rtol=1e-12)
    wide = Grid((20, 20), 1.7, (0.3, -0.4))
    mean, covered = onto(values, grid, wide)
    assert_allclose(float((mean * covered).sum()) * 1.7**2, float(values.sum()) * 4.0, rtol=1e-12)
    assert float(covered.min()) == 0.0
    moved, _ = onto(values, grid, Grid((12, 8), 2.0, (3.0, -5.0)), shift=(3.0, -5.0))
    assert_allclose(moved, values, rtol=1e-12)
