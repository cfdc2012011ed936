"""A population: laws and draws, its table and its report."""

import gzip
import json
import math
import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from population_support import SEEDS, clusters_in, files_of, population_in, small_row
from pyarrow import parquet
from typer.testing import CliRunner

from jaxlens import _command_population, cli, config_population, io, plotting, population, reproduce
from jaxlens._config import ConfigError
from jaxlens.config_population import Law, Laws, Population
from jaxlens.simulate._triaxial import rotation

# --- laws and draws -----------------------------------------------------------------------------


def test_a_seed_gives_the_same_cluster_whatever_else_is_drawn():
    one = population.numbers_of(7, Laws())
    fixed = population.numbers_of(7, Laws(z_l=0.3))
    assert fixed["z_l"] == 0.3 and one["z_l"] != 0.3
    assert {k: v for k, v in one.items() if k != "z_l"} == {k: v for k, v in fixed.items() if k != "z_l"}
    assert population.numbers_of(8, Laws()) != one


@pytest.mark.parametrize(
    ("law", "value"),
    [
        (Law(uniform=(1.0, 3.0)), 1.5),
        (Law(log_uniform=(1.0, 16.0)), 2.0),
        (Law(normal=(2.0, 0.5)), 3.0),
        (Law(log_normal=(2.0, 0.5)), 2.0 * math.e),
    ],
)
def test_laws_have_their_quantiles(law: Law, value: float):
    """At a quarter of the uniform laws, and two standard deviations above the centre of the others."""
    assert_allclose(law.at(0.25, 2.0), value)


def test_draws_are_spread_over_their_law():
    n = 200
    drawn = np.array([population.numbers_of(seed, Laws())["mass_ratio"] for seed in range(n)])
    # Uniform between 0.5 and 1; five standard errors of mean and scatter.
    sigma = 0.5 / math.sqrt(12.0)
    assert_allclose(drawn.mean(), 0.75, atol=5.0 * sigma / math.sqrt(n))
    assert_allclose(drawn.std(), sigma, rtol=5.0 * math.sqrt(0.2 / n))
    assert len(set(drawn)) == n


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0])
def test_the_major_axis_has_its_angle_to_the_line_of_sight(angle: float):
    said = Population(population=Laws(major_axis_deg=angle))
    turns = []
    for seed in range(5):
        for clump in population.settings_of(seed, said).cluster.clumps:
            assert clump.orientation is not None
            turns.append(rotation(clump.orientation))
    for turn in turns:
        assert_allclose(turn[2, 2], math.cos(math.radians(angle)), atol=1e-12)
    assert not np.allclose(turns[0], turns[1]), "azimuth and roll are drawn"


def test_orientations_have_streams_of_their_own():
    """The same turns, and no other number changes, if a law is added before them."""
    laws = Laws(major_axis_deg=Law(uniform=(0.0, 90.0)))
    one, two = population.settings_of(3, Population(population=laws)).cluster.clumps
    drawn = np.random.default_rng([3, 1001])
    angle = math.radians(90.0 * drawn.random())
    assert two.orientation is not None and one.orientation != two.orientation
    assert_allclose(rotation(two.orientation)[2, 2], math.cos(angle), atol=1e-12)


def test_the_default_laws_keep_every_annulus_in_the_field():
    law = Laws().z_l
    assert isinstance(law, Law) and law.kind == "uniform"
    for z_l in law.numbers:
        population.settings_of(3, Population(population=Laws(z_l=z_l)))
    # 700 kpc/h are half of 8 arcmin at a redshift of 0.273 (h = 0.7, Omega_m = 0.3).
    population.settings_of(3, Population(population=Laws(z_l=0.274)))
    with pytest.raises(ValueError, match=r"Seed 3: z_l is 0.272 \(fixed\).* 698 kpc/h, less than the 700"):
        population.settings_of(3, Population(population=Laws(z_l=0.272)))
    with pytest.raises(ValueError, match=r"z_l is 0\.2\d* \(uniform \[0.2, 0.21\]\)"):
        population.settings_of(3, Population(population=Laws(z_l=Law(uniform=(0.2, 0.21)))))


def test_settings_hold_what_was_drawn():
    said = population.settings_of(3, Population())
    drawn = population.numbers_of(3, Laws())
    first, second = said.cluster.clumps
    assert_allclose(first.mass_msun_h + second.mass_msun_h, drawn["total_mass_msun_h"])
    assert_allclose(second.mass_msun_h / first.mass_msun_h, drawn["mass_ratio"])
    assert_allclose(second.x_kpc_h - first.x_kpc_h, drawn["separation_kpc_h"])
    assert (said.seed, said.cluster.z_l, first.orientation) == (3, drawn["z_l"], None)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[population]\nz_l = { uniform = [0.4, 0.2] }", r"population.z_l: .*low < high"),
        ("[population]\nn0 = { normal = [400, -1] }", r"population.n0: .*positive"),
        ("[population]\nn0 = { }", "holds no law"),
        ("[population]\nn0 = { gauss = [1, 2] }", "gauss"),
        (
            "[population]\nmass = 3",
            r"population.mass is not known|population.mass: is not known|mass: is not known",
        ),
        ("[population]\nmajor_axis_deg = 120.0", "give 0 to 90"),
        ("[cluster]\nz_l = -1", "z_l"),
        ("[cluster]\nz_l = 0.3", r"cluster.z_l is drawn .* give population.z_l instead"),
        ("[shear]\ndensity_arcmin2 = 100.0", r"shear.density_arcmin2 .* population.n0"),
        ('[strong]\nmembers = "field"', r"strong.members .* population.members"),
        ("seed = 3", r"seed is drawn for every cluster; give the option --seed"),
        ("[population]\nn0 = 0.0", r"population.n0 is 0; give 1 to"),
        ("[population]\nm_tele = { uniform = [28, 60] }", r"population.m_tele reaches 60; give 15 to 40"),
        ("[population]\nmass_ratio = -1.0", r"population.mass_ratio is -1"),
    ],
)
def test_mistakes_in_the_configuration_are_named(text: str, said: str, tmp_path: Path):
    path = tmp_path / "population.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        config_population.read(path)
    assert str(path) in str(caught.value)


def test_a_law_that_draws_no_cluster_is_refused_before_any_work(tmp_path: Path):
    path = tmp_path / "population.toml"
    path.write_text("[population]\nz_l = { normal = [0.1, 5.0] }")
    done = CliRunner().invoke(cli.app, ["population", "--out", str(tmp_path / "out"), "--config", str(path)])
    said = " ".join(done.output.split())
    assert done.exit_code == 2
    assert re.search(r"Seed \d+: z_l is .* \(normal \[0.1, 5\]\), outside 0.01 to 5; narrow", said), said
    assert not (tmp_path / "out").exists()


# --- table and report ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def marks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("marks")


@pytest.fixture(scope="module")
def finished(
    marks: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, bytes], list[dict[str, Any]]]:
    """Files of a run and its rows."""
    folder = tmp_path_factory.mktemp("finished")
    for seed, settings in clusters_in(marks).items():
        row = small_row(seed, settings.model_dump(mode="json"), 64, None)
        content = {"made_with": reproduce.stamp(settings, 64), "cluster": row}
        io.write_json(reproduce.cluster_file(folder, seed), content)
    rows = [io.read_json(reproduce.cluster_file(folder, seed))["cluster"] for seed in SEEDS]
    return files_of(folder), rows


def test_table_profiles_and_report(finished: tuple[Any, list[dict[str, Any]]], tmp_path: Path):
    rows = finished[1]
    _command_population.write(rows, _command_population._made_with(Population(), 64), tmp_path)
    found = parquet.read_table(tmp_path / "population.parquet").to_pydict()
    table = {name: np.asarray(values) for name, values in found.items()}
    assert table["seed"].tolist() == SEEDS
    failed = np.array([text != "" for text in table["failed"]])
    assert failed.tolist() == [seed == 25 for seed in SEEDS]
    assert np.isnan(np.asarray(table["lambda_rec"])[failed]).all()
    assert table["a2_is_sharp_verdict"][failed].tolist() == [-2]
    assert table["excess_right_verdict"][~failed].tolist() == [
        (1 if seed % 2 else -1) if seed % 3 else -3 for seed in SEEDS if seed != 25
    ]
    assert_allclose(table["mass_ratio"][~failed], 0.8)
    margins = table["caustic_margin_arcsec"][~failed]
    assert ((margins < 0.0).sum(), np.isnan(margins).sum()) == (1, 3)  # 22 (25 failed); 20, 23, 26
    assert_allclose(table["lambda_rec"][0], rows[0]["lambda_rec"], rtol=0.0)
    assert np.asarray(table["a2_is_sharp_verdict"])[~failed].tolist() == [
        1 if seed % 2 else -1 for seed in SEEDS if seed != 25
    ]
    profiles = Table.read(tmp_path / "profiles.fits")
    assert profiles["lambda_rec"].shape == (7, 3)
    assert_allclose(profiles["lambda_rec"][0], rows[0]["profiles"]["lambda_rec"], rtol=0.0)
    facts = io.read_json(tmp_path / "population.json")["facts"]
    assert facts["clusters with a crossing of the shape errors"].startswith("4 of 7")  # not 21, 24, 27
    assert facts["mean map: transition found, given no crossing"].startswith("2 of 3")  # 21, 27; not 24
    assert facts["clusters whose main caustic leaves the box of the sources (systems are missed)"].startswith(
        "1 of 7"
    )
    shares = io.read_json(tmp_path / "population.json")["statements"]
    assert shares["excess_right"]["verdicts"] == {"holds here": 1, "not applicable": 3, "undecided": 3}
    assert (shares["excess_right"]["clusters"], shares["excess_right"]["share"]) == (4, 0.25)
    assert shares["a2_is_sharp"]["clusters"] == 7
    text = (tmp_path / "report.html").read_text()
    assert "not applicable" in text and "Seed # gives no multiple images." in text
    assert "Seeds that failed: 25." in text
    drawn = {path.stem for path in (tmp_path / "figures").glob("*.png")}
    assert drawn == {"shares", "transition", "lambda_bias", "success", "profiles"}


def test_shares_of_maps_are_pooled_over_clusters():
    share, weight = np.array([1.0, 0.0, np.nan, 0.5]), np.array([30.0, 10.0, 5.0, 0.0])
    value, error = population.pooled(share, weight)
    assert_allclose(value, 0.75)
    # Of two clusters a bootstrap draws both, one or the other twice: 0.75, 1, 0 with 1/2, 1/4, 1/4.
    assert_allclose(error, math.sqrt(0.5 * 0.125**2 + 0.25 * 0.375**2 + 0.25 * 0.625**2), rtol=0.05)
    assert np.isnan(population.pooled(share[2:], weight[2:])).all()


def test_success_is_told_apart_by_what_there_is_to_find():
    table = {
        "failed": np.array(["", "", "", "no images"]),
        "shape_crossing_kpc_h": np.array([200.0, np.nan, 300.0, np.nan]),
        "transition_share_found": np.array([0.9, 0.3, 0.7, np.nan]),
        "transition_share_near_crossing": np.array([0.6, np.nan, 0.2, np.nan]),
        "transitions_found": np.array([90.0, 30.0, 70.0, np.nan]),
        "transition_interval_holds_crossing": np.array([0.5, np.nan, 0.25, np.nan]),
        "transition_interval_holds_mean": np.array([0.6, 0.4, np.nan, np.nan]),
    }
    found, covered = population.success_rates(table)
    means = {label: value for label, (_, value, _) in (found | covered).items()}
    assert means == pytest.approx(
        {
            "found, given a crossing": 0.8,
            "within 75 kpc/h of it, given a crossing": 0.4,
            "found, given no crossing": 0.3,
            "interval holds the crossing": (45.0 + 17.5) / 160.0,
            "interval holds that of the mean map": (54.0 + 12.0) / 120.0,
        }
    )
    fig = plotting.success(found, covered)
    upper, lower = (ax.get_legend_handles_labels()[1] for ax in fig.axes)
    assert upper == [f"{label} ({n})" for label, n in zip(found, (2, 2, 1), strict=True)]
    assert lower == [f"{label} (2)" for label in covered]


def test_the_bias_is_drawn_about_both_true_values():
    sheet, paper, inner = np.array([0.98, 1.02]), np.array([0.03, -0.01]), np.array([0.02, -0.02])
    fig = plotting.lambda_bias(sheet, paper, np.array([0.01, 0.01]), inner=inner)
    ax = fig.axes[0]
    drawn = {str(line.get_label()): np.asarray(line.get_ydata()) for line in ax.lines}
    assert_allclose(drawn["truth at 100-700"], 100.0 * paper)
    filled = next(np.asarray(one.lines[0].get_ydata()) for one in ax.containers)  # type: ignore[attr-defined]
    assert_allclose(filled, 100.0 * inner)


def test_the_command_writes_the_report_again(
    marks: Path, finished: tuple[dict[str, bytes], Any], tmp_path: Path
):
    (tmp_path / "clusters").mkdir()
    for name, content in finished[0].items():
        (tmp_path / "clusters" / name).write_bytes(content)
    made_with = _command_population._made_with(population_in(marks), 64)
    io.write_json(tmp_path / "made_with.json", made_with)
    done = CliRunner().invoke(cli.app, ["population", "--report", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert io.read_json(tmp_path / "population.json")["laws"] == made_with["laws"]
    assert (tmp_path / "report.html").exists() and "Seeds that failed: 25." in done.output
    io.write_json(tmp_path / "made_with.json", made_with | {"realisations": 128})
    other = CliRunner().invoke(cli.app, ["population", "--report", str(tmp_path)])
    assert other.exit_code == 2 and "made with other settings" in " ".join(other.output.split())
    neither = CliRunner().invoke(cli.app, ["population"])
    assert neither.exit_code == 2 and "give --out DIR" in neither.output
    empty = CliRunner().invoke(cli.app, ["population", "--report", str(tmp_path / "none")])
    assert empty.exit_code == 2 and "holds no finished cluster" in empty.output


def test_a_run_that_is_not_finished_says_so(
    finished: tuple[Any, list[dict[str, Any]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    lost = {"seed": 20, "failed": "MemoryError: no message", "try_again": True}
    monkeypatch.setattr(population, "local", lambda workers: nullcontext())
    monkeypatch.setattr(population, "run", lambda *given, **named: [lost, *finished[1][1:]])
    done = CliRunner().invoke(cli.app, ["population", "--n", "8", "--seed", "20", "--out", str(tmp_path)])
    said = " ".join(done.output.split())
    assert done.exit_code == 1 and "Not finished, perhaps through no fault of theirs: 20;" in said


def test_reasons_are_counted():
    rows = [{"seed": k, "failed": f"ValueError: Seed {k} gives no images."} for k in range(7)]
    rows += [{"seed": 9}, {"seed": 8, "failed": "MemoryError: no message"}]
    assert population.reasons(rows) == [
        ("ValueError: Seed # gives no images.", "7", "0, 1, 2, 3, 4, ..."),
        ("MemoryError: no message", "1", "8"),
    ]


def test_a_packed_population_unpacks_for_the_command(
    marks: Path, finished: tuple[dict[str, bytes], list[dict[str, Any]]], tmp_path: Path
):
    made_with = _command_population._made_with(population_in(marks), 64)
    paths = [tmp_path / f"{name}.json.gz" for name in ("one", "two")]
    for path in paths:
        population.pack(finished[1], made_with, "jaxlens population --n 8", path)
    assert paths[0].read_bytes() == paths[1].read_bytes(), "the same rows, the same bytes"
    content = json.loads(gzip.decompress(paths[0].read_bytes()))
    population.unpack(content, tmp_path / "again")
    assert population.read(tmp_path / "again") == (made_with, finished[1])
    assert files_of(tmp_path / "again" / "clusters") == finished[0]
    with pytest.raises(ValueError, match="says another population"):
        population.unpack(content | {"made_with": made_with | {"realisations": 128}}, tmp_path / "again")


# --- the population that ships -------------------------------------------------------------------


@pytest.fixture(scope="module")
def shipped() -> dict[str, Any]:
    found = population.shipped()
    assert found is not None
    return found


def test_the_shipped_clusters_are_those_of_the_default_laws(shipped: dict[str, Any]):
    said = Population()
    assert shipped["made_with"] == _command_population._made_with(said, 256)
    rows = shipped["clusters"]
    assert [row["seed"] for row in rows] == list(range(1000, 1000 + len(rows)))
    for row in rows:
        if "failed" in row:
            continue
        settings, truth = population.settings_of(row["seed"], said), row["truth"]
        assert truth["z_l"] == settings.cluster.z_l
        assert truth["n0_arcmin2"] == settings.shear.density_arcmin2
        assert truth["m_tele"] == settings.images.m_tele


def test_the_shipped_clusters_report_as_the_command_does(shipped: dict[str, Any], tmp_path: Path):
    population.unpack(shipped, tmp_path)
    made_with, rows = population.read(tmp_path)
    assert (made_with, rows) == (shipped["made_with"], shipped["clusters"])
    table = population.columns(rows)
    found = table["transition_kpc_h"][table["failed"] == ""]
    assert np.nanmax(found) < 700.0 and np.nanmin(found) > 50.0  # the annuli


def test_the_readme_says_what_the_shipped_clusters_say(shipped: dict[str, Any]):
    readme = " ".join((Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8").split())
    rows = shipped["clusters"]
    assert shipped["command"] in readme
    facts = population.facts(population.columns(rows))

    def percent(share: str) -> str:
        hits = re.match(r"(?:\d+ of \d+: )?([\d.]+) \+- ([\d.]+)", share)
        assert hits is not None, share
        value, error = (100.0 * float(number) for number in hits.groups())
        return f"{value:.0f} +- {error:.0f} %"

    crossing, near = (
        next(value for name, value in facts.items() if name.startswith(start))
        for start in ("clusters with a crossing", "mean map: transition within 75 kpc/h of it")
    )
    assert f"cross on {percent(crossing)} of the clusters" in readme
    assert f"within 75 kpc/h in {percent(near)} of the clusters with a crossing" in readme
    tally = reproduce.tally(population.applicable(rows))["lambda_within_1_percent"]
    assert f"of the truth on {percent('{share:.3f} +- {error:.3f}'.format(**tally))}" in readme
