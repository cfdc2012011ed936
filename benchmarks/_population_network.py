"""A population over a network: scheduler and workers on hosts of their own, one cut off for 30 s.

    python benchmarks/_population_network.py [--clusters 4] [--realisations 64] [--cut 30] [--pixels 1024]

Needs root and iproute2, so that `make bench` leaves it out: three network namespaces with addresses 10.77.0.1
(scheduler), .2 and .3 (workers) on one bridge, joined to this process, which is a fourth host, .254. The link
of one worker is taken down while both work, and up again. Required: the run ends, the worker comes back to
its work, and every file has the bytes of an undisturbed run with one worker on this machine. Prints what
happened and when.
"""

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from jaxlens import config_population, population

SCHEDULER, WORKERS, HERE = "10.77.0.1", ("10.77.0.2", "10.77.0.3"), "10.77.0.254"
PATIENCE = {"DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "300s"}
"""With Dask's own 30 s a worker that is cut off for as long gives up its work and ends."""
BEGAN = time.perf_counter()


def say(text: str) -> None:
    """A line with the seconds since the start."""
    print(f"{time.perf_counter() - BEGAN:7.1f} s  {text}", flush=True)


def ip(*words: str, check: bool = True) -> None:
    """The command of iproute2."""
    subprocess.run(["ip", *words], check=check, capture_output=not check)


@contextlib.contextmanager
def network(hosts: dict[str, str]) -> Iterator[None]:
    """Namespaces by name with their addresses, on a bridge that this process reaches."""
    bridge = "jl_bridge"
    try:
        ip("link", "add", bridge, "type", "bridge")
        ip("addr", "add", f"{HERE}/24", "dev", bridge)
        ip("link", "set", bridge, "up")
        for name, address in hosts.items():
            ip("netns", "add", name)
            ip("link", "add", f"{name}_o", "type", "veth", "peer", "name", f"{name}_i")
            ip("link", "set", f"{name}_i", "netns", name)
            ip("link", "set", f"{name}_o", "master", bridge, "up")
            ip("-n", name, "addr", "add", f"{address}/24", "dev", f"{name}_i")
            ip("-n", name, "link", "set", f"{name}_i", "up")
            ip("-n", name, "link", "set", "lo", "up")
        yield
    finally:
        for name in hosts:
            ip("netns", "del", name, check=False)
            ip("link", "del", f"{name}_o", check=False)
        ip("link", "del", bridge, check=False)


@contextlib.contextmanager
def on(host: str, log: Path, *words: str) -> Iterator[None]:
    """A process of Dask on a host, ended with this block."""
    environment = os.environ | population.THREADS | PATIENCE
    command = ["ip", "netns", "exec", host, sys.executable, "-m", "dask", *words]
    with (
        log.open("w") as said,
        subprocess.Popen(command, stdout=said, stderr=said, env=environment) as process,
    ):
        try:
            yield
        finally:
            process.terminate()


def files_of(folder: Path) -> dict[str, bytes]:
    """Names and bytes."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def main() -> int:
    """Run twice and compare."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--clusters", type=int, default=4)
    options.add_argument("--realisations", type=int, default=64)
    options.add_argument("--pixels", type=int, default=1024, help="of the map of the truth")
    options.add_argument("--cut", type=float, default=30.0, help="s")
    options.add_argument("--cut-after", type=float, default=60.0, help="s after the start of the run")
    given = options.parse_args()
    if os.geteuid() != 0 or shutil.which("ip") is None:
        print("skipped: network namespaces need root and the command `ip` of iproute2")
        return 0
    said = config_population.Population()
    shear = replace(said.simulate.shear, map_pixels=given.pixels)
    said = said.model_copy(update={"simulate": said.simulate.model_copy(update={"shear": shear})})
    clusters = {seed: population.settings_of(seed, said) for seed in range(1000, 1000 + given.clusters)}
    hosts = {"jl_sched": SCHEDULER, "jl_work1": WORKERS[0], "jl_work2": WORKERS[1]}
    address = f"tcp://{SCHEDULER}:8786"
    with tempfile.TemporaryDirectory() as scratch, network(hosts), contextlib.ExitStack() as stack:
        folder = Path(scratch)
        over, alone = folder / "network", folder / "alone"
        over.mkdir()
        alone.mkdir()
        start = lambda host, *words: stack.enter_context(on(host, folder / f"{host}.log", *words))
        start("jl_sched", "scheduler", "--host", SCHEDULER, "--port", "8786", "--no-dashboard")
        for host, own in zip(("jl_work1", "jl_work2"), WORKERS, strict=True):
            start(host, "worker", address, "--host", own, "--nthreads", "1", "--no-dashboard")
        with population.remote(address) as client:
            client.wait_for_workers(2, timeout=60)
            say(f"two workers: {', '.join(client.scheduler_info()['workers'])}")

            def cut() -> None:
                ip("link", "set", "jl_work2_o", "down")
                say(f"worker {WORKERS[1]} cut off")
                time.sleep(given.cut)
                ip("link", "set", "jl_work2_o", "up")
                say("and back")

            timer = threading.Timer(given.cut_after, cut)
            timer.start()
            told = lambda done, total, row: say(
                f"{done} of {total}: seed {row['seed']} {row.get('failed', 'finished')}"
            )
            population.run(client, clusters, given.realisations, over, on_done=told)
            timer.join()
            left = len(client.scheduler_info()["workers"])
            say(f"run over; workers now: {left}")
        with population.local(1) as client:
            population.run(client, clusters, given.realisations, alone, on_done=told)
        same = files_of(over) == files_of(alone)
        say(f"same bytes as one worker on this machine: {same}")
        for host in hosts:
            print(f"--- {host}\n{(folder / f'{host}.log').read_text()[-2000:]}")
    return 0 if same and left == 2 else 1


if __name__ == "__main__":
    sys.exit(main())
