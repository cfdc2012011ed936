"""The command `jaxlens weak`: its files, its null tests, and what it says of input it cannot use."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from typer.testing import CliRunner

from jaxlens import _nulls_weak, analysis_weak, cli, io, results_weak, weak, workflow_weak
from jaxlens.analysis_weak import Options, Outcome
from jaxlens.grid import Grid

DRAWS = "8"


def invoke(*arguments: str) -> Any:
    result = CliRunner().invoke(cli.app, ["weak", *arguments], env={"COLUMNS": "200", "NO_COLOR": "1"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


class Run(NamedTuple):
    out: Path
    said: str
    content: dict[str, Any]
    outcome: Outcome


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """`jaxlens weak as1063`, once for all tests that look at its files."""
    out = tmp_path_factory.mktemp("weak") / "as1063"
    outcomes: list[Outcome] = []
    write = results_weak.write

    def recording(outcome: Outcome, directory: str | Path) -> dict[str, Any]:
        outcomes.append(outcome)
        return write(outcome, directory)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results_weak, "write", recording)
        result = invoke("as1063", "--out", str(out), "--bootstrap", DRAWS, "--no-cache")
    assert result.exit_code == 0, result.stderr
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return Run(out, result.stderr, content, outcomes[0])


# --- a cluster -------------------------------------------------------------------------------------


def test_every_file_is_written_and_nothing_else(run: Run):
    figures = {
        f"{name}.{end}" for name in ("maps", "sticks", "profile", "iteration") for end in ("pdf", "png")
    }
    maps = {
        "kappa_E.fits",
        "kappa_B.fits",
        "kappa_B_beyond_E.fits",
        "snr.fits",
        "shear.fits",
        "aperture_mass.fits",
    }
    assert {path.name for path in run.out.iterdir()} == figures | maps | {"summary.json", "profile.ecsv"}


def test_the_cluster_is_where_its_brightest_galaxy_is(run: Run):
    peak = run.content["peak"]
    assert np.hypot(peak["x_arcsec"], peak["y_arcsec"]) < 30.0  # two pixels, one sigma of the smoothing
    assert 0.5 < peak["x_error_arcsec"] < 30.0 and 0.5 < peak["y_error_arcsec"] < 30.0
    assert 7.0 < run.content["peak_snr"]["value"] < 14.0  # 9 to 11 for 64 maps
    assert run.content["converged"] is True and run.content["spectral_radius"] < 0.2


def test_the_e_mode_is_significant_and_what_it_leaves_is_noise(run: Run):
    e, b, beyond = (run.content[name] for name in ("e_mode", "b_mode", "b_mode_beyond_e"))
    assert e["significance"] > 10.0 and e["exceeded"] == 0.0
    assert e["chi2"] > b["chi2"]
    assert abs(beyond["significance"]) < 2.5
    assert run.content["null_maps"] == 16


def test_the_profile_is_that_of_the_catalogue(run: Run):
    setup = workflow_weak.load("as1063")
    expected = weak.tangential_profile(setup.galaxies, setup.edges, setup.centre)
    table = Table.read(run.out / "profile.ecsv")
    np.testing.assert_allclose(table["g_t"], expected.g_t, rtol=1e-12)
    np.testing.assert_allclose(table["g_x_error"], expected.sigma_x, rtol=1e-12)
    # Two estimates of one error; 200 samples know it within 5 %, the scatter of few galaxies within 20 %.
    np.testing.assert_allclose(table["g_t_bootstrap"], table["g_t_error"], rtol=0.3)
    assert run.content["tangential_snr"] == pytest.approx(10.54, abs=0.01)
    nfw = run.content["nfw"]
    mass, calibration = nfw["mass_msun"], nfw["calibration"]
    # Published: 1.7 to 2.9e15 within r_200. With an uncalibrated shape sample it would be 6e14.
    assert nfw["converged"] and 1e15 < mass["value"] < 4e15 and mass["error"] < mass["value"]
    assert nfw["calibration_prior"] == {"value": 0.46, "error": 0.05}
    assert abs(calibration["value"] - 0.46) < 0.05 and calibration["error"] <= 0.05
    assert "shape calibration 0.4" in run.said and "(prior 0.46 +- 0.05)" in run.said


def test_maps_carry_lens_sources_settings_and_coordinates(run: Run):
    peak = run.content["peak"]
    for name in ("kappa_E", "kappa_B", "snr"):
        header = fits.getheader(run.out / f"{name}.fits")
        assert (header["ZLENS"], header["ZSOURCE"], header["SCHEME"]) == (0.3475, 1.5, "A2")
        assert (header["RIDGE"], header["PADDING"], header["SMOOTHAS"]) == (0.01, 2.0, 30.0)
        assert header["DLSDS"] == pytest.approx(float(workflow_weak.load("as1063").depth.mean))
        assert (header["SHEET"], header["CALIBR"], header["SHEARAX"]) == ("free", "none", "west")
        column, row = WCS(header).world_to_pixel_values(peak["ra_deg"], peak["dec_deg"])
        values = io.read_map(run.out / f"{name}.fits").values
        if name == "kappa_E":
            place = round(float(row)), round(float(column))
            assert values[place] == peak["kappa"]
            assert peak["kappa_error"] == run.outcome.sigma[place]
    assert f"peak of kappa = {peak['kappa']:.2f} +- {peak['kappa_error']:.2f} at" in run.said
    assert "kappa holds up to a mass sheet" in run.said
    header = io.read_shear_map(run.out / "shear.fits").header
    assert "SMOOTHAS" not in header and header["SMOOTHBY"] == 30.0 and header["SHEARAX"] == "west"


def test_the_shear_map_reads_back_and_gives_the_same_convergence(run: Run):
    again = workflow_weak.field(str(run.out / "shear.fits"))
    first = run.outcome.field
    np.testing.assert_array_equal(again.shear.g, first.shear.g)
    np.testing.assert_array_equal(again.shear.weight, first.shear.weight)
    assert (again.grid, again.smoothing, again.header["ZSOURCE"]) == (first.grid, 30.0, 1.5)
    kappa = weak.reconstruct(again.shear, again.grid, smoothing=again.smoothing).kappa
    np.testing.assert_array_equal(kappa, io.read_map(run.out / "kappa_E.fits").values)


def test_the_aperture_mass_has_its_layers(run: Run):
    cube = io.read_cube(run.out / "aperture_mass.fits", ("SIGNAL", "NOISE", "SNR", "COUNT", "COVERAGE"))
    assert (cube.header["RADIUS"], cube.header["MINCOVER"]) == (90.0, 0.7)
    known = cube.layers["NOISE"] > 0.0
    # Nothing is said where there are no data, or where much of the aperture has none.
    cover = cube.layers["COVERAGE"]
    np.testing.assert_array_equal(known, run.outcome.used & (cover >= 0.7))
    assert 0 < known.sum() < run.outcome.used.sum() and np.isnan(cube.layers["SIGNAL"][~known]).all()
    row, column = np.unravel_index(np.nanargmax(cube.layers["SIGNAL"]), cover.shape)
    assert np.hypot(cube.grid.x[column], cube.grid.y[row]) < 30.0
    ratio = cube.layers["SIGNAL"][known] / cube.layers["NOISE"][known]
    np.testing.assert_allclose(cube.layers["SNR"][known], ratio, rtol=1e-12)
    assert ratio.max() > 7.0


def test_the_screen_says_what_the_summary_says(run: Run):
    assert "Abell S1063: 2134 of 4049 galaxies, 256 unmasked pixels of 15 arcsec, scheme A2" in run.said
    assert results_weak.verdict(run.content) in run.said
    assert "tangential shear 10.5 sigma" in run.said
    assert "diverges" not in run.said and "not converged" not in run.said


def test_an_error_while_writing_leaves_nothing(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(results_weak, "figures", lambda _: {})

    def full(*_: Any, **__: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(io, "write_cube", full)
    with pytest.raises(OSError, match="no space left"):
        results_weak.write(run.outcome, tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("radius", "converged", "message"),
    [(1.3, False, r"the iteration diverges \(spectral radius 1\.30\)"), (0.5, False, "more --iterations")],
)
def test_a_map_that_has_not_converged_says_so(run: Run, radius: float, converged: bool, message: str):
    content = {**run.content, "spectral_radius": radius, "converged": converged}
    assert re.search(message, results_weak.verdict(content))


# --- a shear map -----------------------------------------------------------------------------------

GRID = Grid((15, 18), 10.0, (5.0, -3.0))  # odd, and not square
PEAK = (22.0, -18.0)


def lens_shear(strength: float, noise: float = 0.02) -> np.ndarray:
    """Shear of a singular isothermal sphere with a core, by its own formula."""
    z = np.asarray(GRID.theta) - np.array(PEAK)
    x, y = z[..., 0], z[..., 1]
    r = np.hypot(x, y) + 1e-9
    off = np.random.default_rng(1).normal(size=(2, *GRID.shape)) * noise
    return -strength * r / (r**2 + 100.0) * ((x + 1j * y) / r) ** 2 + off[0] + 1j * off[1]


def test_a_shear_map_is_mapped_without_what_needs_a_catalogue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    g = lens_shear(3.0)
    weight = np.ones(GRID.shape)
    weight[2:5, 10:13] = 0.0
    io.write_shear_map(tmp_path / "sis.fits", g, weight, weight.astype(int), GRID)
    out = tmp_path / "out"
    result = invoke(str(tmp_path / "sis.fits"), "--out", str(out), "--bootstrap", DRAWS, "--no-cache")
    assert result.exit_code == 0, result.stderr
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    peak = content["peak"]
    assert abs(peak["x_arcsec"] - PEAK[0]) < 5.0 and abs(peak["y_arcsec"] - PEAK[1]) < 5.0  # half a pixel
    assert content["smoothing_arcsec"] == 20.0
    assert content["nfw"] is content["dls_ds"] is peak["ra_deg"] is peak["x_error_arcsec"] is None
    assert not (out / "profile.ecsv").exists() and not (out / "aperture_mass.fits").exists()
    assert "ZSOURCE" in fits.getheader(out / "kappa_E.fits")
    # The same field with a shear far above 1: the iteration diverges and says so. Its figures take long.
    monkeypatch.setattr(results_weak, "figures", lambda _: {})
    io.write_shear_map(tmp_path / "large.fits", 60.0 * g, weight, weight.astype(int), GRID)
    out = tmp_path / "large"
    result = invoke(str(tmp_path / "large.fits"), "--out", str(out), "--bootstrap", DRAWS, "--no-cache")
    assert result.exit_code == 0 and "the iteration diverges (spectral radius" in result.stderr
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["converged"] is False
    io.write_shear_map(tmp_path / "huge.fits", 3000.0 * g, weight, weight.astype(int), GRID)
    out = tmp_path / "huge"
    result = invoke(str(tmp_path / "huge.fits"), "--out", str(out), "--bootstrap", DRAWS, "--no-cache")
    assert result.exit_code == 1 and "Nothing was written." in result.stderr and not out.exists()


def test_a_lens_in_a_map_is_no_noise(tmp_path: Path):
    """Noiseless shear: what the turned pixels show is what the smoothing removed, not the lens itself."""
    g = lens_shear(3.0, noise=0.0)
    for name, shear in (("a", g), ("b", np.conj(g))):
        ones, by = np.ones(GRID.shape), {"SMOOTHBY": 8.0}
        io.write_shear_map(tmp_path / f"{name}.fits", shear, ones, ones.astype(int), GRID, header=by)
    field = workflow_weak.field(str(tmp_path / "a.fits"))
    found = analysis_weak.derive(field, Options(draws=8))
    whole = _nulls_weak.null_maps(jax.random.split(jax.random.key(0), 8), field.shear, GRID, 1.0)
    turned = weak.reconstruct_many(whole, GRID, smoothing=8.0).kappa
    assert found.sigma.mean() < 0.4 * float(jnp.std(turned))
    # A map whose shear counts from East is the same field once its frame is said.
    mirrored = workflow_weak.field(str(tmp_path / "b.fits"), "east")
    assert mirrored.axis == "east"
    np.testing.assert_array_equal(mirrored.shear.g, field.shear.g)
    with pytest.raises(ValueError, match="--axis is 'east', but as1063 is a catalogue"):
        workflow_weak.field("as1063", "east")


# --- the pieces ------------------------------------------------------------------------------------


def test_noise_against_null_maps_has_chi2_one_and_scales_with_the_square():
    rng = np.random.default_rng(2)
    nulls, used = rng.normal(size=(12, 40, 50)) * 0.3, np.ones((40, 50), bool)
    noise = rng.normal(size=(40, 50)) * 0.3
    found = _nulls_weak.against(noise, nulls, used)
    # F(1, 12) of 2000 pixels: its mean is known within 0.04; without the correction it would be 1.2.
    assert found.chi2 == pytest.approx(1.0, abs=0.1)
    assert abs(found.significance) < 3.0
    assert _nulls_weak.against(3.0 * noise, nulls, used).chi2 == pytest.approx(9.0 * found.chi2)
    # Number by number, in a loop: each null map against the variance that the others have.
    expected, n = [], len(nulls)
    for i, one in enumerate(nulls):
        others = [nulls[j] ** 2 for j in range(n) if j != i]
        # A variance of n - 1 maps: the mean of 1/chi^2 with n - 1 degrees of freedom is 1/(n - 3).
        expected.append(np.mean(one**2 / (sum(others) / (n - 1))) * (n - 3) / (n - 1))
    # A map between them.
    weaker = noise * np.sqrt(np.median(expected) / found.chi2)
    chi2 = np.mean(weaker**2 / np.mean(nulls**2, axis=0)) * (n - 2) / n
    made = _nulls_weak.against(weaker, nulls, used)
    assert made.chi2 == pytest.approx(chi2, rel=1e-12)
    assert made.significance == pytest.approx((chi2 - 1.0) / np.std(expected, ddof=1), rel=1e-9)
    share = [float(np.mean(np.array(expected) > chi2)), made.exceeded]
    assert share[0] == share[1] and 0.0 < share[0] < 1.0


def test_the_highest_point_is_found_within_a_pixel_and_only_where_there_are_data():
    grid = Grid((20, 24), 5.0, (3.0, -4.0))
    x, y = np.moveaxis(np.asarray(grid.theta), -1, 0)
    kappa = np.exp(-0.5 * ((x - 13.2) ** 2 + (y + 21.4) ** 2) / 15.0**2)
    used = np.ones(grid.shape, bool)
    kappa[18, 2], used[18, 2] = 5.0, False
    used, values = jnp.asarray(used), jnp.asarray(kappa)
    np.testing.assert_allclose(weak.peak(values, grid, used).theta, (13.2, -21.4), atol=0.1)
    there = weak.peak(values, grid)
    assert there.pixel.tolist() == [18, 2] and float(there.value) == 5.0
    # A pixel on the edge is not refined, nor is one beside a NaN.
    edge = weak.peak(values.at[0, 7].set(9.0), grid)
    np.testing.assert_array_equal(edge.theta[1], grid.theta[0, 7, 1])
    beside = weak.peak(values.at[5, 7].set(9.0).at[5, 8].set(-jnp.inf).at[4, 7].set(jnp.nan), grid, used)
    np.testing.assert_array_equal(beside.theta, grid.theta[5, 7])


def test_the_residual_b_mode_is_that_of_explicit_least_squares():
    """Dense matrices of NumPy's FFT on an 8 x 8 field, a lens and noise, two masked pixels."""
    n, p, ridge = 8, 16, 1e-2
    rng = np.random.default_rng(3)
    k_y, k_x = np.fft.fftfreq(p)[:, None], np.fft.fftfreq(p)[None, :]
    k2 = k_x**2 + k_y**2
    band = (k2 > 0.0) & (k2 < 0.25 * (1.0 - 1e-12))
    safe = np.where(band, k2, 1.0)
    c, s = (np.where(band, part / safe, 0.0) for part in (k_x**2 - k_y**2, 2.0 * k_x * k_y))
    unit = np.fft.fft2(np.eye(p * p).reshape(-1, p, p))
    parts = [np.fft.ifft2(part * unit).real[:, :n, :n].reshape(p * p, -1).T for part in (c, s)]
    weight = np.ones((n, n))
    weight[3, 4] = weight[6, 1] = 0.0
    g = rng.normal(size=(n, n)) * 0.1 + 1j * rng.normal(size=(n, n)) * 0.1
    kappa = rng.normal(size=(n, n)) * 0.1
    known = weight.ravel() > 0.0
    d = np.concatenate([part[known] for part in parts])

    def fit(shear: np.ndarray) -> np.ndarray:
        return np.linalg.solve(d.T @ d + ridge * np.eye(p * p), d.T @ shear)

    gamma = (g * (1.0 - kappa)).ravel()[known]
    both = np.concatenate([gamma.real, gamma.imag])
    rest = both - d @ fit(both)
    half = len(gamma)
    turned = np.concatenate([rest[half:], -rest[:half]])  # -i (a + i b) = b - i a
    expected = fit(turned).reshape(p, p)[:n, :n]
    one = weak.ShearMap(jnp.asarray(g), jnp.asarray(weight), jnp.asarray(weight, int))
    shear = jax.tree.map(lambda part: part[None], one)
    found = weak.residual_b_mode(
        shear, jnp.asarray(kappa)[None], Grid((n, n), 1.0), scheme="A1", smoothing=0.0
    )
    # Conjugate gradients stop at 1e-4 of the data.
    np.testing.assert_allclose(found[0], expected, atol=1e-3 * np.abs(expected).max())
    with pytest.raises(ValueError, match="fits nothing"):
        weak.residual_b_mode(shear, jnp.asarray(kappa)[None], Grid((n, n), 1.0), scheme="K1")


# --- mistakes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing"], "nothing is neither a file, nor a directory holding weak.toml"),
        (["nothing.fits"], "nothing.fits does not exist; check the name"),
        (["macs1149"], "has no weak.toml; it holds strong.toml"),
        (["as1063", "--scheme", "A3"], "--scheme is A3 and --model is None; A3 needs a model to start from"),
        (["as1063", "--model", "m"], "--scheme is A2 and --model is 'm'; A3 needs a model"),
        (["as1063", "--scheme", "A3", "--model", "nothing.toml"], "nothing.toml"),
        (["as1063", "--scheme", "B1"], "--scheme is 'B1'; give one of K1, K2, A1, A2, A3."),
        (["as1063", "--smoothing", "0"], "--smoothing is 0.0; give the standard deviation"),
        (["as1063", "--smoothing", "nan"], "--smoothing is nan; give the standard deviation"),
        (["as1063", "--ridge", "0"], "--ridge is 0.0; give a positive number"),
        (["as1063", "--padding", "0.5"], "--padding is 0.5; give 1 to 16"),
        (["as1063", "--axis", "up"], "--axis is up; give west, east or north"),
        (["as1063", "--axis", "east"], "as1063 is a catalogue; set `axis` in its weak.toml"),
    ],
)
def test_a_mistake_is_one_message_and_exit_code_2(tmp_path: Path, arguments: list[str], message: str):
    result = invoke(*arguments, "--out", str(tmp_path / "out"), "--no-cache")
    assert result.exit_code == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


def test_too_few_draws_are_refused():
    with pytest.raises(ValueError, match="--bootstrap at least 8"):
        Options(draws=4)
    assert jax.config.read("jax_enable_x64")


def test_results_that_cannot_be_written_are_refused_before_the_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(analysis_weak, "derive", lambda *_, **__: pytest.fail("the map was begun"))
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    result = invoke("as1063", "--out", str(tmp_path / "file" / "below"), "--no-cache")
    assert result.exit_code == 2
    assert "is a file; give the name of a directory for the results" in " ".join(result.stderr.split())
