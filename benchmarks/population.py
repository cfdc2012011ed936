"""A population on Dask beside a plain loop, the scheduler's own cost, and what larger populations need.

    python benchmarks/population.py [--smoke] [--clusters 6] [--empty 10000]

Plain loop: as many processes as workers, each with half of the seeds and the same threads. Both sides keep
compiled programs, each in fresh directories, one for a process, and first do one cluster in each process
that is not timed. The scheduler's cost is measured with empty tasks that return a row of real size. The last
table scales what was measured to 1e3, 1e5 and 1e7 clusters; nothing of that size was run.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

from _harness import Report, parser  # noqa: E402
from jax.experimental.compilation_cache import compilation_cache  # noqa: E402

from jaxlens import config_population, population, simulate  # noqa: E402
from jaxlens.config_simulate import Simulate  # noqa: E402

SMALL = simulate.ClusterSettings(m_min_msun_h=1e12)


def empty(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """No work; a row as large as a real one: its file has 12 kB."""
    del settings, n, cache
    profile = [1.0 / (seed + j + 3.0) for j in range(40)]
    return {"seed": seed, "profiles": {f"profile_{k}": profile for k in range(10)}}


def caching(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """`population.task` with the cache on: this file turns it off where it is imported, workers included."""
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()  # JAX asks only once whether there is one, and drawing settings compiles
    return population.task(seed, settings, n, cache)


def configurations(report: Report, count: int) -> tuple[dict[int, Simulate], int]:
    """Clusters by seed, and realisations."""
    said = config_population.Population()
    if report.smoke:
        shear = replace(said.simulate.shear, map_pixels=512)
        said = said.model_copy(
            update={"simulate": said.simulate.model_copy(update={"shear": shear, "cluster": SMALL})}
        )
    seeds = range(1000, 1000 + count)
    return {seed: population.settings_of(seed, said) for seed in seeds}, 64 if report.smoke else 256


def plain(seeds: list[int], clusters: dict[int, Simulate], n: int, cache: str) -> float:
    """Seconds of a loop over all but the first of the seeds, run in this process."""
    caching(seeds[0], clusters[seeds[0]].model_dump(mode="json"), n, cache)
    began = time.perf_counter()
    for seed in seeds[1:]:
        caching(seed, clusters[seed].model_dump(mode="json"), n, cache)
    return time.perf_counter() - began


def loops(report: Report, count: int, workers: int, cache: str) -> float:
    """Seconds per cluster and core of `workers` plain loops side by side, each in its own process."""
    command = [sys.executable, __file__, "--clusters", str(count)]
    command += ["--smoke"] if report.smoke else []
    environment = os.environ | population.THREADS
    running = [
        subprocess.Popen(
            [*command, "--loop", f"{cache}/{part}", "--part", str(part), "--of", str(workers)],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        for part in range(workers)
    ]
    seconds = [float(each.communicate()[0].split()[-1]) for each in running]
    return sum(seconds) / (count - workers)


def tasks(clusters: dict[int, Simulate], n: int, workers: int, cache: str) -> tuple[float, float]:
    """Seconds per cluster and core of the same clusters on Dask, and bytes of a cluster's file."""
    seeds = list(clusters)
    with tempfile.TemporaryDirectory() as folder, population.local(workers) as client:
        first = {seed: clusters[seed] for seed in seeds[:workers]}
        population.run(client, first, n, Path(folder), cache=cache, work=caching)
        began = time.perf_counter()
        population.run(client, clusters, n, Path(folder), cache=cache, work=caching)
        seconds = time.perf_counter() - began
        sizes = [path.stat().st_size for path in Path(folder).iterdir()]
    return workers * seconds / (len(seeds) - workers), sum(sizes) / len(sizes)


def overhead(count: int, workers: int) -> tuple[float, float]:
    """Seconds per empty task with its file, and of the same without workers: settings and files alone."""
    said = config_population.Population()
    clusters = {seed: population.settings_of(seed, said) for seed in range(count)}
    with tempfile.TemporaryDirectory() as folder, population.local(workers) as client:
        client.submit(int, 0).result()
        began = time.perf_counter()
        population.run(client, clusters, 64, Path(folder), work=empty)
        first = time.perf_counter() - began
        began = time.perf_counter()
        population.run(client, clusters, 64, Path(folder), work=empty)
        return first / count, (time.perf_counter() - began) / count


FIRST = """What would break first: at 1e5 clusters the last step, which reads all rows into the memory of the
command for table and report; at 1e7 the directory of one file per cluster (listing and reading it at each
start), and the one process that writes them. Run populations of 1e5 in directories of their own then."""


def scaled(core_s: float, file_kb: float, task_ms: float, read_ms: float, memory_gb: float) -> str:
    """The table for larger populations."""
    lines = ["clusters   core-hours   files [GB]   client alone [h]   resume [h]   client memory [GB]"]
    for n in (1e3, 1e5, 1e7):
        lines.append(
            f"{n:8.0e}   {n * core_s / 3600.0:10.4g}   {n * file_kb / 1e6:10.3g}   "
            f"{n * task_ms / 3.6e6:16.3g}   {n * read_ms / 3.6e6:10.3g}   {n * memory_gb:18.3g}"
        )
    return "\n".join(lines)


def main() -> int:
    """Measure."""
    options = parser(__doc__ or "")
    options.add_argument("--clusters", type=int, default=6)
    options.add_argument("--empty", type=int, default=10_000)
    options.add_argument("--loop", help="for the processes of the plain loop: directory of compiled programs")
    options.add_argument("--part", type=int, default=0)
    options.add_argument("--of", type=int, default=1)
    given = options.parse_args()
    report = Report("population", given)
    clusters, n = configurations(report, given.clusters)
    if given.loop:
        print(plain(list(clusters)[given.part :: given.of], clusters, n, given.loop))
        return 0
    workers = os.cpu_count() or 1
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    task_s, read_s = overhead(200 if report.smoke else given.empty, workers)
    grown_gb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e6
    print(
        f"empty task with its file: {1e3 * task_s:.2f} ms; "
        f"one that is finished, read again: {1e3 * read_s:.2f} ms"
    )
    with tempfile.TemporaryDirectory() as for_loops, tempfile.TemporaryDirectory() as for_tasks:
        loop_s = loops(report, given.clusters, workers, for_loops)
        dask_s, size = tasks(clusters, n, workers, for_tasks)
        held = [sum(1 for one in Path(folder).rglob("*-cache")) for folder in (for_loops, for_tasks)]
    print(f"compiled programs kept: plain loops {held[0]}, Dask {held[1]}")
    report.check("both sides keep compiled programs", min(held) > 0)
    peak_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
    print(
        f"core seconds per cluster: Dask {dask_s:.1f}, plain loops {loop_s:.1f}, ratio {dask_s / loop_s:.3f}"
    )
    print(f"peak memory of a worker or loop {peak_gb:.2f} GB, file of a cluster {size / 1e3:.1f} kB")
    count = 200 if report.smoke else given.empty
    print(scaled(dask_s, size / 1e3, 1e3 * task_s, 1e3 * read_s, grown_gb / count))
    print(FIRST)
    report.check(
        f"Dask over plain loops {dask_s / loop_s:.3f} (limit 1.15)", dask_s <= 1.15 * loop_s, smoke=False
    )
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
