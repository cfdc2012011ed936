"""A population on a Dask cluster: every cluster is one task, every finished one a file.

Queues, retries of lost work and the network are Dask's. Workers return plain data and need no directory in
common with this process, which alone writes files.
"""

import os
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any

from jaxlens import io, reproduce
from jaxlens.config_simulate import Simulate

THREADS = {
    "NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}
"""Environment of a worker: one thread each, so that they do not fight and sums are done in one order."""

Task = Callable[[int, dict[str, Any], int, str | None], dict[str, Any]]


PACKAGES = ("jaxlens-cluster", "jax", "jaxlib", "numpy", "optimistix")
"""Packages whose versions decide the numbers; workers must have those of this process."""

WINDOW = 1000
"""Tasks that the scheduler holds at a time: enough for hundreds of workers, little memory for any number."""


def versions() -> dict[str, str]:
    """Of `PACKAGES`, here."""
    return {name: metadata.version(name) for name in PACKAGES}


def cores() -> int:
    """Cores that this process may use: fewer than the machine has in a container or a job of a queue."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


def task(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """What a worker does: one cluster from its seed to its row, and the `versions` with which.

    Args:
        seed: of everything.
        settings: `Simulate` as plain data.
        n: noise realisations.
        cache: directory of compiled programs, in which every worker has one of its own (JAX does not lock
            them: a program half-written by one that is killed would stay so for all); None for what the
            machine of the worker says, e.g. by `JAX_COMPILATION_CACHE_DIR`.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", str(Path(cache) / _own_name()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    row = reproduce.cluster_row(seed, Simulate.model_validate(settings), n)
    return row | {"versions": versions()}


def _own_name() -> str:
    """Of the worker that runs this, the same in the next run."""
    from distributed import get_worker

    try:
        return f"worker_{get_worker().name}"
    except ValueError:  # in no worker
        return "alone"


@contextmanager
def local(workers: int) -> Iterator[Any]:
    """A client of a Dask cluster on this machine: one process per worker, one thread in each.

    Raises:
        ImportError: without the extra `cluster`.
    """
    from dask import config
    from distributed import Client, LocalCluster

    # A worker that compiles on a busy machine is silent for minutes; one that dies closes its connection.
    said = {"distributed.scheduler.worker-ttl": None}
    before = {name: os.environ.get(name) for name in THREADS}
    try:
        # Workers inherit it before they load their libraries; Dask's own settings would keep what is said
        # here already, and two threads round otherwise than one.
        os.environ |= THREADS | {"XLA_FLAGS": f"{before['XLA_FLAGS'] or ''} {THREADS['XLA_FLAGS']}".strip()}
        with config.set(said):
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                silence_logs=40,
            )
        with cluster, Client(cluster) as client:
            yield client
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def remote(address: str, *, timeout: float = 30.0) -> AbstractContextManager[Any]:
    """A client of a running scheduler.

    Raises:
        OSError: if there is none at the address.
        ImportError: without the extra `cluster`.
    """
    from distributed import Client

    try:
        return Client(address, timeout=timeout)
    except (OSError, ValueError) as error:
        raise OSError(
            f"--scheduler {address}: no Dask scheduler answers there ({error}); start one, or leave the "
            "option out for a cluster on this machine."
        ) from error


def _again(seed: int, reason: str) -> dict[str, Any]:
    """The row of a cluster that failed, perhaps through no fault of its own."""
    return {"seed": seed, "failed": reason, "try_again": True}


def run(
    client: Any,
    clusters: Mapping[int, Simulate],
    n: int,
    folder: Path,
    *,
    cache: str | None = None,
    work: Task = task,
    on_done: Callable[[int, int, Mapping[str, Any]], object] = lambda done, total, row: None,
) -> list[dict[str, Any]]:
    """All clusters, those that are there not computed again; one file each, whole or not at all.

    A cluster's row depends on its seed, the configuration, and the versions and processor of the worker, not
    on the number of workers or on the order. A cluster that fails is a row with its reason; it has a file
    only if it would fail again, see `reproduce.cluster_row`.

    Args:
        client: of Dask.
        clusters: settings by seed, one for each cluster; see `settings_of`.
        n: noise realisations of each.
        folder: for the files `cluster_<seed>.json`.
        cache: see `task`.
        work: what is done for a seed, `task`.
        on_done: told clusters done and wanted, and the row of the last one.

    Returns:
        The rows in the order of `clusters`, as they read back from their files.

    Raises:
        ValueError: if a file in the folder belongs to other settings (nothing is computed then), or a worker
            has other versions.
        ConnectionError: if the scheduler is lost; finished clusters are kept.
        OSError: if a file cannot be written.
    """
    from distributed import as_completed
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError
    from distributed.scheduler import KilledWorker

    total, done = len(clusters), 0
    without_file: dict[int, dict[str, Any]] = {}
    wanted: list[int] = []
    for seed, settings in clusters.items():
        row = reproduce.finished(reproduce.cluster_file(folder, seed), reproduce.stamp(settings, n))
        if row is None:
            wanted.append(seed)
        else:
            done += 1
            on_done(done, total, row)
    # Keys of their own: those that an interrupted run cancelled may not have left the scheduler yet.
    this_run, here = uuid.uuid4().hex[:8], versions()
    waiting: dict[Any, int] = {}

    def lost() -> ConnectionError:
        return ConnectionError(
            f"The Dask scheduler is lost after {done} of {total} clusters; they are kept, and the same "
            "command goes on with the others."
        )

    def submit(seed: int) -> Any:
        if client.status in ("closing", "closed"):
            raise lost()
        plain, key = clusters[seed].model_dump(mode="json"), f"cluster-{seed}-{this_run}"
        future = client.submit(work, seed, plain, n, cache, key=key, pure=False)
        waiting[future] = seed
        return future

    left = iter(wanted)
    try:
        finishing = as_completed([submit(seed) for seed in islice(left, WINDOW)])
        for future in finishing:
            seed = waiting.pop(future)
            try:
                row = future.result()
            except KilledWorker as error:
                row = _again(seed, f"its worker died several times ({error})")
            except (FutureCancelledError, CommClosedError) as error:
                raise lost() from error
            except Exception as error:  # the work itself fails in a row: this is its machine, or its packages
                row = _again(seed, f"{type(error).__name__}: {error}")
            _same_versions(row.pop("versions", here), here)
            if row.get("try_again"):
                without_file[seed] = row
            else:
                _write(
                    folder,
                    seed,
                    reproduce.stamp(clusters[seed], n),
                    row,
                    f"{done - len(without_file)} of {total}",
                )
            done += 1
            on_done(done, total, row)
            future.release()
            for following in islice(left, 1):
                finishing.add(submit(following))
    finally:
        if client.status == "running":
            client.cancel(list(waiting))
    return [
        without_file.get(seed) or io.read_json(reproduce.cluster_file(folder, seed))["cluster"]
        for seed in clusters
    ]


def _same_versions(there: Mapping[str, str], here: Mapping[str, str]) -> None:
    other = [f"{name} {there.get(name)} (here {one})" for name, one in here.items() if there.get(name) != one]
    if other:
        raise ValueError(
            f"A worker has {', '.join(other)}: its clusters would not be those of this machine. Install the "
            "same versions everywhere, e.g. with `pip install -c constraints.txt`; finished clusters "
            "are kept."
        )


def _write(folder: Path, seed: int, made_with: Mapping[str, Any], row: Mapping[str, Any], kept: str) -> None:
    """The file of a cluster; `kept` says how many are there."""
    path = reproduce.cluster_file(folder, seed)
    try:
        io.write_json(path, {"made_with": made_with, "cluster": row})
    except OSError as error:
        raise OSError(
            f"{path} cannot be written ({error.strerror or error}); {kept} clusters are finished and kept. "
            "Make room, and the same command goes on."
        ) from error
