"""The command `jaxlens simulate`: its files, that the other commands read them, and what it refuses."""

import json
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from typer.testing import CliRunner

from jaxlens import (
    cli,
    config_simulate,
    io,
    results_simulate,
    simulate,
    strong,
    weak,
    workflow,
    workflow_simulate,
    workflow_weak,
)
from jaxlens import lens as lens_module
from jaxlens._config import ConfigError
from jaxlens.grid import resample

SMALL = """
name = "Small"
seed = 1

[cluster]
m_min_msun_h = 4e11

[[cluster.clumps]]
mass_msun_h = 6.75e14
x_kpc_h = -30.0
concentration = 3.4
axis_ratios = [0.6, 0.8]

[[cluster.clumps]]
mass_msun_h = 5.25e14
x_kpc_h = 30.0
concentration = 3.4
axis_ratios = [0.6, 0.8]

[images]
half_width_arcsec = 60.0

[shear]
map_pixels = 512
mode = "padded"
"""


def invoke(*arguments: str) -> Any:
    result = CliRunner().invoke(cli.app, ["simulate", *arguments], env={"COLUMNS": "200", "NO_COLOR": "1"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


class Run(NamedTuple):
    out: Path
    said: str
    content: dict[str, Any]
    mock: simulate.Mock
    config: config_simulate.Simulate


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A small cluster, written once for all tests that look at its files."""
    folder = tmp_path_factory.mktemp("simulate")
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    made = []
    write = results_simulate.write

    def recording(mock: simulate.Mock, said: config_simulate.Simulate, out: Path) -> dict[str, Any]:
        made.append((mock, said))
        return write(mock, said, out)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results_simulate, "write", recording)
        result = invoke("--out", str(folder / "out"), "--config", str(folder / "small.toml"), "--no-cache")
    assert result.exit_code == 0, result.stderr
    content = json.loads((folder / "out" / "summary.json").read_text(encoding="utf-8"))
    return Run(folder / "out", result.stderr, content, *made[0])


def test_every_file_is_written_and_nothing_else(run: Run):
    data = {
        "config.toml", "galaxies.ecsv", "images.ecsv", "kappa_true.fits", "lens_true.toml", "members.ecsv",
        "shear.fits", "sources.ecsv", "strong.toml", "subhaloes.ecsv", "summary.json", "truth.fits",
        "weak.toml",
    }  # fmt: skip
    figures = {f"{name}.{end}" for name in ("kappa", "sources", "weak_data") for end in ("pdf", "png")}
    assert {path.name for path in run.out.iterdir()} == data | figures


def test_the_summary_counts(run: Run):
    content, strong_mock = run.content, run.mock.strong
    assert (
        content["n_systems"] == strong_mock.catalogue.n_systems == len(set(_column(run, "images", "system")))
    )
    assert content["n_images"] == len(_column(run, "images", "system"))
    assert content["n_sources_expected"] == pytest.approx(662.1, abs=0.1)
    assert content["n_galaxies_expected"] == pytest.approx(26720.62, abs=0.01)
    assert content["n_galaxies"] == len(_column(run, "galaxies", "e1"))
    with fits.open(run.out / "kappa_true.fits") as hdus:
        values, header = np.array(hdus[0].data, float), hdus[0].header  # pyright: ignore[reportAttributeAccessIssue]
    assert content["kappa_mean_z2"] == pytest.approx(values.mean(), rel=1e-6)
    assert header["ZSOURCE"] == 2.0
    assert header["DLSDS"] == pytest.approx(0.76941531, abs=1e-8)
    assert str(content["n_systems"]) in run.said


def _column(run: Run, table: str, name: str) -> np.ndarray:
    return np.asarray(Table.read(run.out / f"{table}.ecsv")[name])


def test_the_written_lens_has_the_written_images(run: Run):
    lens = io.read_lens(run.out / "lens_true.toml")[0]
    theta = jnp.asarray(np.stack([_column(run, "images", f"{c}_true_arcsec") for c in "xy"], axis=1))
    beta = np.stack([_column(run, "images", f"beta_{c}_arcsec") for c in "xy"], axis=1)
    ratio = run.mock.cluster.plane.dls_ds(jnp.asarray(_column(run, "images", "z_spec")))
    assert np.abs(np.asarray(lens_module.ray_trace(lens, theta, ratio)) - beta).max() < 1e-6
    assert np.all(_column(run, "images", "mag") < _column(run, "images", "mag_limit"))


def test_the_model_of_the_paper_reads_the_directory(run: Run):
    setup = workflow.load(str(run.out))
    problem = setup.problem
    assert strong.total_size(problem.bounds) == 26
    assert problem.images.n_images == run.content["n_images"]
    assert np.all(np.asarray(problem.images.sigma_pos) == 0.15)
    members = setup.model.members
    assert members is not None
    theta, images = np.asarray(members.theta), np.asarray(problem.images.theta)
    assert np.all((theta >= images.min(0) - 10.0) & (theta <= images.max(0) + 10.0))
    assert np.asarray(members.luminosity).max() <= 1.0
    # The residuals exist at the middle of the boxes: the problem can be fitted as it lies.
    rows = strong.residuals(jnp.zeros(26), problem)
    assert np.all(np.isfinite(np.asarray(rows)))


def test_the_galaxies_make_the_same_map_by_the_weak_command(run: Run):
    setup, by_map = workflow_weak.load(str(run.out)), workflow_weak.field(str(run.out / "shear.fits"))
    made, one = setup.shear, run.mock.bins[0]
    used = np.asarray(one.shear.weight) > 0.0
    assert setup.grid == by_map.grid == run.mock.strong.settings.shear.grid
    assert np.abs(np.asarray(made.g) - np.asarray(one.shear.g))[used].max() < 1e-12
    assert np.all(np.asarray(made.weight)[~used] == 0.0)
    assert np.array_equal(np.asarray(by_map.shear.g)[used], np.asarray(one.shear.g)[used])
    assert np.array_equal(np.asarray(by_map.shear.weight), np.asarray(one.shear.weight))
    assert by_map.smoothing == setup.config.map.sigma_arcsec == 15.0
    assert float(setup.depth.mean) == pytest.approx(0.76941531, abs=1e-8)


def test_truth_on_the_pixels(run: Run):
    truth = io.read_cube(run.out / "truth.fits", ("KAPPA", "G1", "G2", "MASK"))
    kappa = io.read_map(run.out / "kappa_true.fits")
    again, _ = resample(jnp.asarray(kappa.values), kappa.grid, (48, 48))
    assert np.abs(truth.layers["KAPPA"] - np.asarray(again)).max() < 1e-5  # single precision
    assert np.array_equal(truth.layers["MASK"] == 1, np.hypot(truth.layers["G1"], truth.layers["G2"]) <= 0.5)


def test_the_configuration_makes_the_same_bytes_again(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(results_simulate, "figures", lambda *_: {})
    said = workflow_simulate.load(run.out)
    assert said == run.config
    again = simulate.mock(said.seed, said.settings)
    results_simulate.write(again, said, tmp_path)
    for path in run.out.iterdir():
        if path.suffix not in (".pdf", ".png"):
            assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


def test_another_seed_is_another_cluster(run: Run):
    keys, others = simulate.stage_keys(1), simulate.stage_keys(2)
    settings = run.config.settings
    one, other = (
        simulate.draw_sources(k["sources"], settings.sources, run.mock.cluster.plane) for k in (keys, others)
    )
    assert np.array_equal(one.z, run.mock.strong.sources.z)
    assert len(one) != len(other) or not np.array_equal(one.z, other.z)


def test_two_bins_are_written_with_their_redshifts(run: Run):
    said = config_simulate.parse(
        {
            **tomllib.loads(SMALL),
            "shear": {"map_pixels": 512, "bins": [{"z_s": 1.0, "share": 0.3}, {"z_s": 3.0, "share": 0.7}]},
        },
        "test",
    )
    keys, field = simulate.stage_keys(1), run.mock.field
    bins, galaxies = simulate.shear_field(
        keys["counts"], keys["ellipticities"], field, run.mock.cluster.plane, said.settings.shear
    )
    mock = simulate.Mock(
        simulate.StrongMock(1, said.settings, *_parts(run.mock.strong)), field, bins, galaxies
    )
    table = workflow_simulate.weak_configuration(mock, said)
    assert table["depth"] == {"z_s": 1.0, "per_galaxy": True}
    assert set(workflow_simulate.galaxy_columns(mock)["z_phot"]) == {1.0, 3.0}
    content = results_simulate.summary(mock, said)
    assert [one["z_s"] for one in content["bins"]] == [1.0, 3.0]
    assert sum(one["n_galaxies"] for one in content["bins"]) == content["n_galaxies"] == len(galaxies)
    assert isinstance(bins[1].shear, weak.ShearMap)


def _parts(mock: simulate.StrongMock) -> tuple[Any, ...]:
    return mock.cluster, mock.sources, mock.images, mock.catalogue, mock.caustic


def test_the_default_configuration_is_complete():
    said = config_simulate.Simulate()
    assert config_simulate.parse(tomllib.loads(config_simulate.text(said)), "test") == said
    assert said.settings == simulate.Settings()
    assert said.seed == simulate.DEFAULT_SEED


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[cluster.clumps]]\nmass_msun_h = -1e14", "`mass_msun_h` is -1"),
        ("[[shear.bins]]\nz_s = 0.2", "`shear.bins[0].z_s` is 0.2, not behind the lens"),
        ("[cluster]\nz_l = 9.5", "not behind the lens"),
        ("[shear]\npixel = 10", "shear.pixel: is not known; remove it, or use one of field_arcmin, pixels"),
        ("[shear.bin]\nz_s = 1.0", "shear.bin: is not known"),
        ("[[cluster.clumps]]\nmass_msun_h = 5e14\nx_kpc_h = 2000.0", "`clumps[1].x_kpc_h` puts the clump"),
        ("[shear]\ndensity_arcmin2 = 0.0", "shear: `density_arcmin2` is 0.0"),
        ("[shear]\nmap_pixels = 200000", "`map_pixels` is 200000; 320 GB a map are too much for memory"),
        ('[sources.depth]\nlow_z = "best"', "sources.depth: `low_z` is 'best'"),
        ("[images]\nsigma_pos_arcsec = nan", "images.sigma_pos_arcsec: "),
        ("seed = -1", "seed: "),
        ("name = ", "is not valid TOML"),
    ],
)
def test_a_bad_configuration_is_refused_before_any_work(text: str, said: str, tmp_path: Path):
    if "x_kpc_h" in text:
        text = f"[cluster]\ncentre = 'given'\n[[cluster.clumps]]\nmass_msun_h = 6e14\n{text}"
    (tmp_path / "bad.toml").write_text(text, encoding="utf-8")
    result = invoke("--out", str(tmp_path / "out"), "--config", str(tmp_path / "bad.toml"))
    assert result.exit_code == 2
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_missing_configuration_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match="does not exist"):
        workflow_simulate.load(tmp_path / "none.toml")


def test_a_file_in_the_way_is_named(tmp_path: Path):
    (tmp_path / "out").write_text("", encoding="utf-8")
    result = CliRunner().invoke(cli.app, ["simulate", "--out", str(tmp_path / "out" / "deeper")])
    assert result.exit_code == 2
    assert "is a file" in result.stderr
