"""What a benchmark ran on: processor, threads, versions and commit."""

import datetime
import os
import platform
import resource
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

ROOT = Path(__file__).parent.parent

PACKAGES = (
    *("jaxlens-cluster", "jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy", "scipy", "numba"),
    *("lenstronomy", "jaxtronomy", "lenspack"),
)
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "XLA_FLAGS")
"""Environment variables that say how many cores a library may use."""


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _commit() -> str:
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else "unknown"


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_mb(maxrss: int) -> float:
    """`ru_maxrss` of the operating system, MB."""
    return maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def peak_mb() -> float:
    """Most memory that this process had so far, MB."""
    return in_mb(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def machine() -> dict[str, Any]:
    """CPU, cores, load, threads, versions, commit and time."""
    return {
        "cpu": _cpu(),
        "cores": cores(),
        "load": os.getloadavg()[0],
        "device": jax.devices()[0].platform,
        "python": platform.python_version(),
        "threads": {name: os.environ.get(name) for name in THREADS},
        "versions": {name: version for name in PACKAGES if (version := _version(name))},
        "commit": _commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
