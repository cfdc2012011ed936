"""A population: laws and draws, and runs that end the same whatever is killed on the way."""

import errno
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from pyarrow import parquet
from typer.testing import CliRunner

from jaxlens import _command_population, cli, config_population, io, plotting, population
from jaxlens._config import ConfigError
from jaxlens.config_population import Law, Laws, Population
from jaxlens.config_simulate import Simulate
from jaxlens.population import _run
from jaxlens.reproduce import CLAIMS, OURS
from jaxlens.simulate._triaxial import rotation

SEEDS = list(range(20, 28))
R = [125.0, 175.0, 225.0]


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
    assert done.exit_code == 2 and "z_l" in done.output
    assert not (tmp_path / "out").exists()


# --- runs ---------------------------------------------------------------------------------------


def small_row(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """A row without the work, a function of seed and settings; in `settings.name` a directory of marks.

    A file `kill_<seed>` there is a process that dies of signal 9 in the middle of this cluster, once.
    """
    del cache
    time.sleep(0.05)
    mark = Path(settings["name"]) / f"kill_{seed}"
    if mark.exists():
        mark.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 25:
        return {"seed": seed, "failed": "Seed 25 gives no multiple images."}
    rng = np.random.default_rng(seed)
    found = {
        name: float(rng.normal(1.0, 0.1))
        for name in ("lambda_true", "lambda_rec", "lambda_sl", "lambda_rec_scatter")
    }
    verdict = "holds here" if seed % 2 else "undecided"
    return {
        "seed": seed,
        "truth": {
            "mass_msun": [c["mass_msun_h"] / 0.7 for c in settings["cluster"]["clumps"]],
            "z_l": settings["cluster"]["z_l"], "concentration": float(rng.uniform(3, 6)),
            "substructure_fraction": 0.15, "n0_arcmin2": 432.0, "mass_ratio": 0.8,
            "caustic_margin_arcsec": [1.0, -2.0, None][seed % 3],
        },
        "strong": {"n_systems": 20, "n_images": 60, "rms_arcsec": 0.15},
        "statements": {
            claim.key: {"value": 1.0, "error": None, "verdict": verdict} for claim in (*CLAIMS, *OURS)
        },
        **found,
        "lambda_true_inner": found["lambda_true"] + 0.01,
        "shape_crossing_kpc_h": 200.0 if seed % 3 else None,
        "transition_kpc_h": 210.0 if seed % 4 else None,
        "transition_lo_kpc_h": 180.0, "transition_hi_kpc_h": 240.0,
        "transition_share_found": 0.5, "transition_interval_holds_mean": 0.6, "transitions_found": n // 2,
        "rmse_crossing_kpc_h": 300.0,
        "profiles": {"r_kpc_h": R, "lambda_rec": rng.normal(1.0, 0.01, 3).tolist()},
        "realisations": n,
    }  # fmt: skip


def clusters_in(folder: Path, seeds: list[int] = SEEDS) -> dict[int, Simulate]:
    base = Population()
    said = base.model_copy(update={"simulate": base.simulate.model_copy(update={"name": str(folder)})})
    return {seed: population.settings_of(seed, said) for seed in seeds}


@pytest.fixture(scope="module")
def marks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("marks")


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Any]:
    with population.local(2) as client:
        yield client


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def undisturbed(
    two_workers: Any, marks: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, bytes], list[dict[str, Any]]]:
    folder = tmp_path_factory.mktemp("undisturbed")
    rows = population.run(two_workers, clusters_in(marks), 64, folder, work=small_row)
    return files_of(folder), rows


def test_one_worker_and_another_order_give_the_same_bytes(
    marks: Path, undisturbed: tuple[dict[str, bytes], list[dict[str, Any]]], tmp_path: Path
):
    with population.local(1) as client:
        env = client.run(lambda: {name: os.environ.get(name) for name in population.THREADS})
        assert list(env.values()) == [population.THREADS]
        population.run(client, clusters_in(marks, SEEDS[::-1]), 64, tmp_path, work=small_row)
    assert files_of(tmp_path) == undisturbed[0]
    assert len(undisturbed[0]) == len(SEEDS)


def test_a_worker_that_is_killed_changes_no_byte(
    two_workers: Any, marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path
):
    (marks / "kill_22").touch()
    (marks / "kill_26").touch()
    population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row)
    assert not list(marks.iterdir()), "both workers died"
    assert files_of(tmp_path) == undisturbed[0]


def test_ctrl_c_keeps_what_is_finished(
    two_workers: Any, marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path
):
    def interrupt(done: int, total: int, row: Any) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row, on_done=interrupt)
    kept = files_of(tmp_path)
    assert len(kept) == 3 and kept.items() <= undisturbed[0].items()
    seen: list[int] = []
    count = lambda done, total, row: seen.append(done)
    population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row, on_done=count)
    assert seen == list(range(1, len(SEEDS) + 1))
    assert files_of(tmp_path) == undisturbed[0]


def test_a_full_disk_ends_with_a_clear_message_and_the_run_goes_on(
    two_workers: Any, marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):  # fmt: skip
    whole, written = io.write_json, [0]

    def full(path: Path, content: Any) -> None:
        written[0] += 1
        if written[0] > 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        whole(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(_run.io, "write_json", full)
        with pytest.raises(OSError, match=r"cannot be written \(No space left on device\); 2 of 8 .*goes on"):
            population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row)
    assert len(files_of(tmp_path)) == 2
    population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row)
    assert files_of(tmp_path) == undisturbed[0]


FULL = """
import subprocess, sys
from pathlib import Path

sys.path.insert(0, {tests!r})
from test_population import clusters_in, files_of, small_row

from jaxlens import population



def main():
    disk, clusters = Path(sys.argv[1]), clusters_in(Path({marks!r}))
    with population.local(1) as client:
        try:
            population.run(client, clusters, 64, disk, work=small_row)
        except OSError as error:
            print("said:", error)
        print("kept:", len(list(disk.iterdir())), all(path.suffix == ".json" for path in disk.iterdir()))
        subprocess.run(["mount", "-o", "remount,size=1m", str(disk)], check=True)
        population.run(client, clusters, 64, disk, work=small_row)
    for name, content in files_of(disk).items():
        Path(sys.argv[2], name).write_bytes(content)


if __name__ == "__main__":  # workers are spawned, and import this file
    main()
"""


def test_a_real_disk_that_is_full_loses_nothing(
    marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path
):
    """On a tmpfs of five pages, in a mount namespace of its own."""
    disk, copy, program = tmp_path / "disk", tmp_path / "copy", tmp_path / "program.py"
    disk.mkdir()
    copy.mkdir()
    program.write_text(FULL.format(tests=str(Path(__file__).parent), marks=str(marks)))
    mounted = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-ec"]
    mount = f"mount -t tmpfs -o size=20k none {disk}"
    if shutil.which("unshare") is None or subprocess.run([*mounted, mount], capture_output=True).returncode:
        pytest.skip("no mount namespaces on this machine")
    run = f"{mount}; exec {sys.executable} {program} {disk} {copy}"
    done = subprocess.run([*mounted, run], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    said = re.search(r"cannot be written \(No space left on device\); (\d) of 8 .*goes on", done.stdout)
    assert said is not None and 1 <= int(said[1]) < len(SEEDS), done.stdout
    assert f"kept: {said[1]} True" in done.stdout, "no half-written file"
    assert files_of(copy) == undisturbed[0]


def test_a_lost_scheduler_is_said_and_the_run_goes_on_with_another(
    two_workers: Any, marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path
):
    with population.local(1) as client:

        def lose(done: int, total: int, row: Any) -> None:
            if done == 2:
                client.cluster.close()

        with pytest.raises(ConnectionError, match=r"lost after \d of 8 clusters"):
            population.run(client, clusters_in(marks), 64, tmp_path, work=small_row, on_done=lose)
    assert 2 <= len(files_of(tmp_path)) < len(SEEDS)
    population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row)
    assert files_of(tmp_path) == undisturbed[0]


def test_files_of_other_settings_are_refused(two_workers: Any, marks: Path, tmp_path: Path):
    population.run(two_workers, clusters_in(marks, SEEDS[:1]), 64, tmp_path, work=small_row)
    with pytest.raises(ValueError, match=r"cluster_20.json was made with other settings"):
        population.run(two_workers, clusters_in(marks, SEEDS[:1]), 128, tmp_path, work=small_row)


def broken_row(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """Seed 20 is out of memory, seed 21 on a machine without a package; others are whole."""
    if seed == 20:
        return {"seed": seed, "failed": "MemoryError: no message", "try_again": True}
    if seed == 21:
        raise ModuleNotFoundError("No module named 'optimistix'")
    return small_row(seed, settings, n, cache)


def test_what_a_machine_lacks_is_tried_again(
    two_workers: Any, marks: Path, undisturbed: tuple[dict[str, bytes], list[dict[str, Any]]], tmp_path: Path
):
    rows = population.run(two_workers, clusters_in(marks), 64, tmp_path, work=broken_row)
    assert [row["failed"] for row in rows[:2]] == [
        "MemoryError: no message",
        "ModuleNotFoundError: No module named 'optimistix'",
    ]
    kept = files_of(tmp_path)
    assert set(undisturbed[0]) - set(kept) == {"cluster_20.json", "cluster_21.json"}
    assert "cluster_25.json" in kept, "a failure that would come again is kept"
    again = population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row)
    assert files_of(tmp_path) == undisturbed[0] and again == undisturbed[1]


def test_no_scheduler_at_the_address():
    with pytest.raises(OSError, match=r"--scheduler tcp://127.0.0.1:1: no Dask scheduler answers"):
        population.remote("tcp://127.0.0.1:1", timeout=0.5)


# --- table and report ---------------------------------------------------------------------------


def test_table_profiles_and_report(undisturbed: tuple[Any, list[dict[str, Any]]], tmp_path: Path):
    rows = undisturbed[1]
    _command_population.write(rows, Population(), 64, tmp_path)
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
    assert "not applicable" in text
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
    upper, lower = ([text.get_text() for text in ax.get_legend().get_texts()] for ax in fig.axes)
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


def test_the_command_writes_the_report_again(undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path):
    (tmp_path / "clusters").mkdir()
    for name, content in undisturbed[0].items():
        (tmp_path / "clusters" / name).write_bytes(content)
    io.write_json(tmp_path / "laws.json", {"z_l": 0.31})
    done = CliRunner().invoke(cli.app, ["population", "--report", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert io.read_json(tmp_path / "population.json")["laws"]["z_l"] == 0.31
    assert (tmp_path / "report.html").exists() and "Seeds that failed: 25." in done.output
    empty = CliRunner().invoke(cli.app, ["population", "--report", "--out", str(tmp_path / "none")])
    assert empty.exit_code == 2 and "holds no finished cluster" in empty.output
