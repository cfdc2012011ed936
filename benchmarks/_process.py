"""Whole processes: how long they take and how much memory they have at their peak."""

import os
import subprocess
import sys
import time
from pathlib import Path

from _harness import ROOT


def run(arguments: list[str], cache: Path | None = None) -> tuple[float, float, str]:
    """Seconds from start to end, peak memory in MB, and what was printed.

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
    return seconds, usage.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3), said


def command(line: list[str], cache: Path) -> tuple[float, float, str]:
    """`jaxlens ...` as a process of its own."""
    return run(["-c", "import sys; from jaxlens.cli import main; sys.exit(main())", *line], cache)
