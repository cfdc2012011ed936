"""How every benchmark here is timed and reported.

A function is compiled ahead of time (that is the compile time), run once to warm up, then run
repeatedly, each run ended by `block_until_ready`; the median is reported, beside the error of the last run
against a reference, because a time without an error means nothing, and the cores that were busy. Rows are
printed as a table and saved as JSON together with the machine, the versions and the commit.

What a user would pick instead is an optional import, see `_peers.py`. A run without it says which extra is
missing and fails, unless `--smoke` or `--without-peers` was given; its targets are listed as not measured. A
target is the median of ratios of two functions that take turns, see `_timing.py`. `table.py` makes the table
of all ratios. Smoke runs are too short to judge speed, and have a file of results of their own.

    report = Report("deflection", parser(__doc__).parse_args())
    ours = report.measure("value", f, lens, theta, size={"members": 100}, error=against_reference)
    theirs = report.measure("value, NumPy", g, size={"members": 100}, compiled=False, error=against_reference)
    report.faster("value", ours, theirs, 10.0, error=1e-12)
    report.finish()
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
from _machine import ROOT, machine, peak_mb
from _results import Check, Target, show
from _timing import Row, compile_once, kind_and_mb, ratios, row_of, timed

__all__ = ["ROOT", "Report", "Row", "Target", "parser"]

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_enable_compilation_cache", False)  # whatever the environment says: compile times count

_STARTED = time.perf_counter()


def parser(description: str) -> argparse.ArgumentParser:
    """The command line that all benchmarks share."""
    options = argparse.ArgumentParser(description=description)
    options.add_argument("--full", action="store_true", help="the long sweeps of accuracy and size as well")
    options.add_argument("--smoke", action="store_true", help="small sizes and few runs, for the tests")
    options.add_argument(
        "--without-peers", action="store_true", help="a package that is not installed fails no run"
    )
    options.add_argument(
        "--out", type=Path, help="JSON file (default: benchmarks/results/NAME.json; smoke: NAME.smoke.json)"
    )
    return options


@dataclass
class Report:
    """Rows of one benchmark, and the checks that it makes. Results of an earlier run are removed at once.

    Attributes:
        name: the file name of the results.
        options: parsed command line, see `parser`.
        rows: what was measured.
        targets: ratios and their limits, for the table of ratios.
        checks: claims and whether they held; every target that has a limit is one.
        missing: packages that would be compared with but are not installed.
    """

    name: str
    options: argparse.Namespace
    rows: list[Row] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.path.unlink(missing_ok=True)

    @property
    def smoke(self) -> bool:
        """Whether sizes and runs are to be small."""
        return self.options.smoke

    @property
    def full(self) -> bool:
        """Whether the long sweeps were asked for."""
        return self.options.full and not self.smoke

    @property
    def path(self) -> Path:
        """The file of results."""
        name = f"{self.name}.smoke.json" if self.smoke else f"{self.name}.json"
        return self.options.out or ROOT / "benchmarks" / "results" / name

    def measure(
        self,
        name: str,
        function: Callable[..., Any],
        *arguments: Any,
        size: dict[str, int],
        error: Callable[[Any], float] | None = None,
        compiled: bool = True,
        compilations: int = 1,
        traced: bool = False,
        warm: bool = True,
        seconds: float = 2.0,
        least: int = 3,
        units: int = 1,
        note: str = "",
    ) -> Row:
        """Time `function(*arguments)` and add a row.

        Args:
            name: what is run; of another program, with its name after the last comma.
            function: pure function of arrays; compiled here unless `compiled` is False.
            arguments: what it is called with.
            size: the swept numbers.
            error: takes the result of the last timed run, returns its error.
            compiled: False for NumPy code, or for a function that compiles itself.
            compilations: the compile time is the shortest of so many.
            traced: one more run counts what NumPy and Python allocate: not for the arrays of JAX.
            warm: False for a long function that was warmed up elsewhere.
            seconds: total time of the timed runs (at most 1000 of them).
            least: fewest timed runs.
            units: how many of what is compared one call makes.
            note: free text.
        """
        compile_s = program = None
        if compiled:
            programs = [compile_once(function, arguments) for _ in range(1 if self.smoke else compilations)]
            compile_s, program = min(programs, key=lambda pair: pair[0])
        call = partial(function if program is None else program, *arguments)
        if warm:
            jax.block_until_ready(call())
        memory = kind_and_mb(program, call, traced) if program is not None or traced else None
        times = timed(call, min(seconds, 0.05) if self.smoke else seconds, least)
        row = row_of(
            name,
            size,
            times.seconds,
            compile_s=compile_s,
            cpu_s=times.cpu_s,
            memory=memory or kind_and_mb(None, call, traced=False),
            error=None if error is None else float(error(times.result)),
            note=note,
            units=units,
            call=call,
        )
        self.rows.append(row)
        return row

    def record(
        self,
        name: str,
        seconds: list[float],
        size: dict[str, int],
        *,
        peak_mb: float | None = None,
        cpu_s: float | None = None,
        error: float | None = None,
        note: str = "",
    ) -> Row:
        """Add a row of times that were taken elsewhere, such as those of whole processes."""
        memory = (peak_mb, "process peak")
        row = row_of(name, size, seconds, cpu_s=cpu_s, memory=memory, error=error, note=note)
        self.rows.append(row)
        return row

    def check(self, claim: str, held: bool, *, smoke: bool = True) -> None:
        """Record whether a claim that users may read held in this run.

        Args:
            claim: the claim, with the number found and its limit.
            held: whether it held.
            smoke: False for what a smoke run cannot judge: speed, and means of many draws.
        """
        self.checks.append(Check(claim, bool(held), smoke))

    def target(
        self, claim: str, *values: float, least: float | None = None, most: float | None = None
    ) -> None:
        """Record a number for the table, and as a check whether it is within its limits.

        Args:
            claim: what is compared.
            values: the number, once for each repetition; the median is judged.
            least, most: its limits; without any it is recorded for information.
        """
        one = Target.of(claim, values, least=least, most=most)
        self.targets.append(one)
        if one.limits:
            self.check(str(one), bool(one.held), smoke=False)

    def unmeasured(
        self, claim: str, reason: str, *, least: float | None = None, most: float | None = None
    ) -> None:
        """Keep the place of a target that could not be measured in the table."""
        self.targets.append(Target(claim, None, least=least, most=most, reason=reason))

    def ratio(
        self, claim: str, above: Row, below: Row, *, least: float | None = None, most: float | None = None
    ) -> None:
        """Target: the time of a unit of `above` over that of `below`, both run again in turns."""
        self.target(claim, *ratios(above, below, self.smoke), least=least, most=most)

    def faster(self, what: str, ours: Row, theirs: Row, least: float | None, *, error: float) -> None:
        """Target: `theirs` takes at least `least` times as long as `ours`; both errors are within `error`."""
        self.ratio(f"{what}, times faster than {theirs.program}", theirs, ours, least=least)
        both = {"cores": [ours.cores, theirs.cores], "errors": [ours.error, theirs.error]}
        self.targets[-1] = replace(self.targets[-1], **both)
        self.as_exact(what, ours, theirs, error)

    def as_exact(self, what: str, ours: Row, theirs: Row, error: float) -> None:
        """Check that the errors of both are within `error`.

        Raises:
            ValueError: if one of them is not known: times of unknown accuracy are not compared.
        """
        if ours.error is None or theirs.error is None:
            raise ValueError(f"`{ours.name}` and `{theirs.name}` need an `error` each to be compared.")
        said = f"{what}: error {ours.error:.1e}, of {theirs.program} {theirs.error:.1e} (limit {error:.0e})"
        self.check(said, max(ours.error, theirs.error) <= error)

    def absent(self, package: str, extra: str = "bench") -> None:
        """Say that a package is not installed, and which extra brings it."""
        line = f"{package} is not installed: its rows are missing (extra `{extra}`)"
        if line not in self.missing:
            self.missing.append(line)

    def finish(self) -> int:
        """Print and save everything.

        Returns:
            Exit status: 1 if a check failed that this run can judge, or if a full run lacks a package.
        """
        content = {
            "benchmark": self.name,
            "smoke": self.smoke,
            "full": self.full,
            "machine": machine(),
            "elapsed_s": time.perf_counter() - _STARTED,
            "process_peak_mb": peak_mb(),
            "rows": [row.saved() for row in self.rows],
            "targets": [one.saved() for one in self.targets],
            "checks": [asdict(one) for one in self.checks],
            "missing": self.missing,
        }
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        show(content, self.rows, self.targets, self.checks)
        print(f"saved to {self.path}")
        lacking = bool(self.missing) and not self.smoke and not self.options.without_peers
        failed = [one for one in self.checks if not one.held and (one.smoke or not self.smoke)]
        return 1 if failed or lacking else 0
