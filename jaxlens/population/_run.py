"""A population on a Dask cluster: every cluster is one task, every finished one a file.

Queues, retries of lost work and the network are Dask's. Workers return plain data and need no directory in
common with this process, which alone writes files.
"""

import uuid
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
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


def task(seed: int, settings: dict[str, Any], n: int, cache: str | None) -> dict[str, Any]:
    """What a worker does: one cluster from its seed to its row.

    Args:
        seed: of everything.
        settings: `Simulate` as plain data.
        n: noise realisations.
        cache: directory of compiled programs, shared by the workers of one machine; None for none.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return reproduce.cluster_row(seed, Simulate.model_validate(settings), n)


def local(workers: int) -> AbstractContextManager[Any]:
    """A client of a Dask cluster on this machine: one process per worker, one thread in each.

    Raises:
        ImportError: without the extra `cluster`.
    """
    from dask import config
    from distributed import Client, LocalCluster

    class Here(Client):
        """Closes the cluster it made."""

        def __exit__(self, *given: Any) -> None:
            cluster = self.cluster
            super().__exit__(*given)
            if cluster is not None:
                cluster.close()

    # The environment must be there before the process loads its libraries.
    config.set({"distributed.nanny.pre-spawn-environ": THREADS, "distributed.nanny.environ": THREADS})
    # A worker that compiles on a busy machine is silent for minutes; one that dies closes its connection.
    config.set({"distributed.scheduler.worker-ttl": None})
    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        silence_logs=40,
    )
    return Here(cluster)


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
        The rows in the order of `clusters`.

    Raises:
        ValueError: if a file in the folder belongs to other settings; nothing is computed then.
        ConnectionError: if the scheduler is lost; finished clusters are kept.
        OSError: if a file cannot be written.
    """
    from distributed import as_completed
    from distributed.client import FutureCancelledError
    from distributed.scheduler import KilledWorker

    rows: dict[int, dict[str, Any]] = {}
    waiting: dict[Any, tuple[int, dict[str, Any]]] = {}
    wanted: list[tuple[int, Simulate, dict[str, Any]]] = []
    for seed, settings in clusters.items():
        made_with = reproduce.stamp(settings, n)
        row = reproduce.finished(reproduce.cluster_file(folder, seed), made_with)
        if row is None:
            wanted.append((seed, settings, made_with))
        else:
            rows[seed] = row
            on_done(len(rows), len(clusters), row)
    # Keys of their own: those that an interrupted run cancelled may not have left the scheduler yet.
    this_run = uuid.uuid4().hex[:8]
    for seed, settings, made_with in wanted:
        plain = settings.model_dump(mode="json")
        future = client.submit(work, seed, plain, n, cache, key=f"cluster-{seed}-{this_run}", pure=False)
        waiting[future] = (seed, made_with)
    try:
        for future in as_completed(list(waiting)):
            seed, made_with = waiting.pop(future)
            try:
                row = future.result()
            except KilledWorker as error:
                row = _again(seed, f"its worker died several times ({error})")
            except FutureCancelledError as error:
                raise ConnectionError(
                    f"The Dask scheduler is lost after {len(rows)} of {len(clusters)} clusters; they are "
                    "kept, and the same command goes on with the others."
                ) from error
            except Exception as error:  # the work itself fails in a row: this is its machine, or its packages
                row = _again(seed, f"{type(error).__name__}: {error}")
            if row.get("try_again"):
                rows[seed] = row
                on_done(len(rows), len(clusters), row)
                future.release()
                continue
            path = reproduce.cluster_file(folder, seed)
            try:
                io.write_json(path, {"made_with": made_with, "cluster": row})
            except OSError as error:
                raise OSError(
                    f"{path} cannot be written ({error.strerror or error}); {len(rows)} of {len(clusters)} "
                    "clusters are finished and kept. Make room, and the same command goes on."
                ) from error
            found = reproduce.finished(path, made_with)
            assert found is not None
            rows[seed] = found
            on_done(len(rows), len(clusters), found)
            future.release()
    finally:
        if client.status == "running":
            client.cancel(list(waiting))
    return [rows[seed] for seed in clusters]
