"""How every benchmark here is timed and reported.

A function is compiled ahead of time (that is the compile time), run once to warm up, then run
repeatedly, each run ended by `block_until_ready`; the median is reported, beside the error against a
reference, because a time without an error means nothing. Memory is what the compiled program asks
for: arguments, results and temporaries; of NumPy code what one run allocates at its peak (`traced`). Rows are
printed as a table and saved as JSON together with the machine, the versions and the commit.

What a user would pick instead is an optional import, see `_peers.py`; a script without it runs and says which
extra is missing. A target is a ratio of two rows of the same run, best time against best time, because other
work on the machine lengthens a run and never shortens it. `table.py` makes the table of all ratios.

    report = Report("deflection", arguments)
    ours = report.measure("value", f, lens, theta, size={"members": 100}, error=against_numpy)
    theirs = report.measure("value, NumPy", g, size={"members": 100}, compiled=False, traced=True)
    report.faster("value", ours, theirs, 10.0)
    report.finish()
"""

import argparse
import datetime
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parent.parent

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_enable_compilation_cache", False)  # whatever the environment says: compile times count


@dataclass(frozen=True)
class Row:
    """One timing.

    Attributes:
        name: what was run.
        size: the numbers that were swept.
        compile_s: tracing and compilation, s, the better of two; None for a function that is not compiled.
        median_ms, best_ms: run time, ms.
        runs: number of timed runs.
        memory_mb: arguments, results and temporaries of the compiled program, MB.
        error: against the reference; None where there is none.
        note: anything else.
    """

    name: str
    size: dict[str, int]
    compile_s: float | None
    median_ms: float
    best_ms: float
    runs: int
    memory_mb: float | None
    error: float | None
    note: str = ""


def parser(description: str) -> argparse.ArgumentParser:
    """The command line that all benchmarks share: `--smoke`, `--full` and `--out`."""
    options = argparse.ArgumentParser(description=description)
    options.add_argument("--full", action="store_true", help="the long sweeps of accuracy and size as well")
    options.add_argument("--smoke", action="store_true", help="small sizes and few runs, for the tests")
    options.add_argument("--out", type=Path, help="JSON file (default: benchmarks/results/NAME.json)")
    return options


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


def machine() -> dict[str, Any]:
    """CPU, cores, load, versions, commit and time."""
    packages = ("jaxlens-cluster", "jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy")
    packages += ("lenstronomy", "jaxtronomy", "lenspack")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": _cpu(),
        "cores": cores,
        "load": os.getloadavg()[0],
        "device": jax.devices()[0].platform,
        "python": platform.python_version(),
        "versions": {name: version for name in packages if (version := _version(name))},
        "commit": _commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _compiled(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[float, Any]:
    """Seconds of tracing and compiling without any cache, and the program."""
    jax.clear_caches()
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return time.perf_counter() - start, program


@dataclass(frozen=True)
class Target:
    """A ratio of two measured numbers and what it should be.

    Attributes:
        claim: what is compared.
        ratio: the ratio.
        least, most: its limits; None where there is none.
    """

    claim: str
    ratio: float
    least: float | None = None
    most: float | None = None

    @property
    def held(self) -> bool:
        """Whether the ratio is within its limits."""
        low = self.least is None or self.ratio >= self.least
        return low and (self.most is None or self.ratio <= self.most)

    def __str__(self) -> str:
        limits = [f"at least {self.least:g}"] if self.least is not None else []
        limits += [f"at most {self.most:g}"] if self.most is not None else []
        return f"{self.claim}: {self.ratio:.3g} ({', '.join(limits) or 'no limit'})"


@dataclass
class Report:
    """Rows of one benchmark, and the checks that it makes.

    Attributes:
        name: the file name of the results.
        options: parsed command line, see `parser`.
        rows: what was measured.
        targets: ratios and their limits, for the table of ratios.
        checks: claims and whether they held; every target is one.
        missing: packages that would be compared with but are not installed.
    """

    name: str
    options: argparse.Namespace
    rows: list[Row] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    checks: dict[str, bool] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)

    @property
    def smoke(self) -> bool:
        """Whether sizes and runs are to be small."""
        return self.options.smoke

    @property
    def full(self) -> bool:
        """Whether the long sweeps were asked for."""
        return self.options.full and not self.smoke

    def measure(
        self,
        name: str,
        function: Callable[..., Any],
        *arguments: Any,
        size: dict[str, int],
        error: Callable[[Any], float] | None = None,
        compiled: bool = True,
        traced: bool = False,
        seconds: float = 2.0,
        least: int = 3,
        note: str = "",
    ) -> Row:
        """Time `function(*arguments)` and add a row.

        Args:
            name: what is run.
            function: pure function of arrays; compiled here unless `compiled` is False.
            arguments: what it is called with.
            size: the swept numbers.
            error: takes the result, returns its error.
            compiled: False for NumPy code, or for a function that compiles itself.
            traced: one more run counts what NumPy and Python allocate (blind to the arrays of JAX).
            seconds: total time of the timed runs (at most 1000 of them).
            least: fewest timed runs.
            note: free text.
        """
        compile_s = memory_mb = None
        if compiled:
            compile_s, function = min(
                (_compiled(function, arguments) for _ in range(1 if self.smoke else 2)),
                key=lambda pair: pair[0],
            )
            usage = function.memory_analysis()
            if usage is not None:
                parts = (usage.argument_size_in_bytes, usage.output_size_in_bytes, usage.temp_size_in_bytes)
                memory_mb = sum(parts) / 1e6
        if traced:
            tracemalloc.start()
        result = jax.block_until_ready(function(*arguments))  # the warm-up, and the result that is judged
        if traced:
            memory_mb = tracemalloc.get_traced_memory()[1] / 1e6
            tracemalloc.stop()
        budget, times = 0.05 if self.smoke else seconds, []
        while len(times) < least or (sum(times) < budget and len(times) < 1000):
            start = time.perf_counter()
            jax.block_until_ready(function(*arguments))
            times.append(time.perf_counter() - start)
        row = Row(
            name=name,
            size=size,
            compile_s=compile_s,
            median_ms=1e3 * statistics.median(times),
            best_ms=1e3 * min(times),
            runs=len(times),
            memory_mb=memory_mb,
            error=None if error is None else float(error(result)),
            note=note,
        )
        self.rows.append(row)
        return row

    def record(
        self, name: str, seconds: list[float], size: dict[str, int], memory_mb: float | None, note: str = ""
    ) -> Row:
        """Add a row of times that were taken elsewhere, such as those of whole processes."""
        times = [1e3 * one for one in seconds]
        median = statistics.median(times)
        row = Row(name, size, None, median, min(times), len(times), memory_mb, None, note)
        self.rows.append(row)
        return row

    def check(self, claim: str, held: bool) -> None:
        """Record whether a claim that users may read held in this run."""
        self.checks[claim] = bool(held)

    def target(
        self, claim: str, ratio: float, *, least: float | None = None, most: float | None = None
    ) -> None:
        """Record a ratio for the table, and as a check whether it is within its limits."""
        one = Target(claim, float(ratio), least, most)
        self.targets.append(one)
        self.check(str(one), one.held)

    def faster(self, what: str, ours: Row, theirs: Row, least: float) -> None:
        """Target: the best time of `theirs` is at least `least` times that of `ours`."""
        claim = f"{what}, times faster than {theirs.name.rsplit(', ', 1)[-1]}"
        self.target(claim, theirs.best_ms / ours.best_ms, least=least)

    def absent(self, package: str, extra: str = "bench") -> None:
        """Say that a package is not installed, and which extra brings it."""
        line = f"{package} is not installed: its rows are missing (extra `{extra}`)"
        if line not in self.missing:
            self.missing.append(line)

    def finish(self) -> int:
        """Print and save everything.

        Returns:
            Exit status: 1 if a check failed in a full run; a smoke run is too short to judge speed.
        """
        where = machine()
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
            1e6 if sys.platform == "darwin" else 1e3
        )
        path = self.options.out or ROOT / "benchmarks" / "results" / f"{self.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "benchmark": self.name,
            "smoke": self.smoke,
            "machine": where,
            "process_peak_mb": peak_mb,
            "rows": [asdict(row) for row in self.rows],
            "targets": [{**asdict(one), "held": one.held} for one in self.targets],
            "checks": self.checks,
            "missing": self.missing,
        }
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

        console = Console()
        console.width = max(console.width, 110)
        versions = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
        table = Table(
            title=f"{self.name} (commit {where['commit']})",
            caption=f"{where['cpu']}, {where['cores']} cores, load {where['load']:.1f}; {versions}; "
            f"process peak {peak_mb:.0f} MB",
        )
        for heading in ("", "size", "compile [s]", "median [ms]", "best [ms]", "memory [MB]", "error"):
            table.add_column(heading, justify="left" if heading in ("", "size") else "right")
        for row in self.rows:
            size = ", ".join(f"{key} {value}" for key, value in row.size.items())
            numbers = (
                ("{:.2f}", row.compile_s),
                ("{:.3f}", row.median_ms),
                ("{:.3f}", row.best_ms),
                ("{:.2f}", row.memory_mb),
                ("{:.1e}", row.error),
            )
            table.add_row(row.name, size, *("" if v is None else form.format(v) for form, v in numbers))
        console.print(table)
        for claim, held in self.checks.items():
            console.print(f"{'holds' if held else 'FAILS'}: {claim}")
        for line in self.missing:
            console.print(line)
        console.print(f"saved to {path}")
        return 0 if self.smoke or all(self.checks.values()) else 1
