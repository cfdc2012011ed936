"""Runs of a population that end the same whatever is killed on the way."""

import errno
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

import pytest
from population_support import (
    SEEDS,
    broken_row,
    clusters_in,
    files_of,
    other_versions,
    same_versions,
    small_row,
)

from jaxlens import io, population
from jaxlens.population import _run


@pytest.fixture(scope="module")
def marks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("marks")


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Any]:
    with population.local(2) as client:
        yield client


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
        said = {**population.THREADS, "XLA_FLAGS": env[next(iter(env))]["XLA_FLAGS"]}
        assert list(env.values()) == [said] and said["XLA_FLAGS"].endswith(population.THREADS["XLA_FLAGS"])
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
from population_support import clusters_in, files_of, small_row

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


def test_workers_with_other_versions_are_refused(
    two_workers: Any, marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path
):
    with pytest.raises(ValueError, match=r"A worker has jax 0.0.1 \(here .*constraints.txt"):
        population.run(two_workers, clusters_in(marks), 64, tmp_path, work=other_versions)
    assert not files_of(tmp_path)
    population.run(two_workers, clusters_in(marks), 64, tmp_path, work=same_versions)
    assert files_of(tmp_path) == undisturbed[0]


def test_a_window_of_tasks_is_held_by_the_scheduler(
    two_workers: Any, marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):  # fmt: skip
    monkeypatch.setattr(_run, "WINDOW", 2)
    held: list[int] = []
    count = lambda done, total, row: held.append(len(two_workers.futures))
    population.run(two_workers, clusters_in(marks), 64, tmp_path, work=small_row, on_done=count)
    assert max(held) <= 2
    assert files_of(tmp_path) == undisturbed[0]


def test_workers_here_leave_environment_and_configuration_as_they_were(monkeypatch: pytest.MonkeyPatch):
    from dask import config

    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("NPROC", raising=False)
    said = dict(os.environ), config.get("distributed.scheduler.worker-ttl"), config.get("distributed.nanny")
    with population.local(1) as client:
        client.submit(int, 0).result()
    assert said == (
        dict(os.environ),
        config.get("distributed.scheduler.worker-ttl"),
        config.get("distributed.nanny"),
    )


COMMAND = """
import sys
from functools import partial

sys.path.insert(0, {tests!r})
from population_support import small_row

from jaxlens import cli, population

if __name__ == "__main__":  # workers are spawned, and import this file
    population.run = partial(population.run, work=small_row)
    cli.app(sys.argv[1:])
"""


def test_a_signal_ends_the_command_and_the_same_command_goes_on(
    marks: Path, undisturbed: tuple[dict[str, bytes], Any], tmp_path: Path
):
    program, said, out = tmp_path / "program.py", tmp_path / "population.toml", tmp_path / "out"
    # A shell that starts the tests in the background has them ignore this signal.
    hear = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    program.write_text(hear + COMMAND.format(tests=str(Path(__file__).parent)))
    said.write_text(f'name = "{marks}"\n')
    command = [sys.executable, str(program), "population", "--n", "8", "--seed", "20", "--workers", "1"]
    command += ["--realisations", "64", "--out", str(out), "--config", str(said), "--no-cache"]
    slow, one = marks / "slow", out / "clusters" / "cluster_20.json"
    slow.touch()
    try:
        with subprocess.Popen(
            command,
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as running:
            until = time.monotonic() + 200.0
            while not one.exists() and time.monotonic() < until and running.poll() is None:
                time.sleep(0.05)
            os.killpg(running.pid, signal.SIGINT)
            _, error = running.communicate(timeout=60)
    finally:
        slow.unlink()
    assert running.returncode == 130, error
    assert "Interrupted; finished clusters are kept" in " ".join(error.split())
    kept = files_of(out / "clusters")
    assert 1 <= len(kept) < len(SEEDS) and kept.items() <= undisturbed[0].items()
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert files_of(out / "clusters") == undisturbed[0]


def test_no_scheduler_at_the_address():
    with pytest.raises(OSError, match=r"--scheduler tcp://127.0.0.1:1: no Dask scheduler answers"):
        population.remote("tcp://127.0.0.1:1", timeout=0.5)
