"""Whole processes: how long they take and how much memory they have at their peak."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from _machine import ROOT, in_mb


class Done(NamedTuple):
    """Seconds from start to end, those of all threads, peak memory in MB, and what was printed."""

    seconds: float
    cpu_s: float
    peak_mb: float
    said: str


def run(arguments: list[str], cache: Path | None = None) -> Done:
    """A process from its start to its end.

    Args:
        arguments: for the interpreter that runs this, e.g. `["-c", "import jaxlens"]`.
        cache: directory of the persistent cache of compiled programs; None for whatever the user has.

    Raises:
        RuntimeError: if the process fails, with what it said.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
    if cache is not None:
        environment["XDG_CACHE_HOME"] = str(cache)
    start = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        said = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{arguments} failed:\n{said}")
    return Done(seconds, usage.ru_utime + usage.ru_stime, in_mb(usage.ru_maxrss), said)


def command(line: list[str], cache: Path) -> Done:
    """`jaxlens ...` as a process of its own."""
    return run(["-c", "import sys; from jaxlens.cli import main; sys.exit(main())", *line], cache)
