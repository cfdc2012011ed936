"""Times of one function, and ratios of the times of two that take turns.

Other work on the machine comes and goes within minutes: two functions are compared by short blocks of
calls, one after the other, first the one first and then the other. Each pair of blocks is one ratio.
"""

import math
import statistics
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

import jax
from _machine import peak_mb

LONG_MS = 10e3
"""Calls that take longer are compared twice, others `PAIRS` times."""
PAIRS = 5
BLOCK_S = 0.2
"""A block of a pair takes this long at least, or is one call."""


@dataclass(frozen=True)
class Row:
    """One timing.

    Attributes:
        name: what was run.
        size: the numbers that were swept.
        compile_s: tracing and compilation, s; None for a function that is not compiled.
        median_ms, best_ms: run time, ms.
        runs: number of timed runs.
        cpu_ms: processor time of one run, all threads together, ms; None where it is unknown.
        memory_mb: memory, MB.
        memory_kind: "XLA buffers" (arguments, results and temporaries of the compiled program), "NumPy peak"
            (what one run allocates) or "process peak" (of the process until then: an upper limit).
        error: against the reference; None where there is none.
        note: anything else.
        units: how many of what is compared (sources, maps) one call makes.
        call: the timed function with its arguments; None for times that were taken elsewhere. Not saved.
    """

    name: str
    size: dict[str, int]
    compile_s: float | None
    median_ms: float
    best_ms: float
    runs: int
    cpu_ms: float | None
    memory_mb: float | None
    memory_kind: str | None
    error: float | None
    note: str = ""
    units: int = 1
    call: Callable[[], Any] | None = field(default=None, repr=False, compare=False)

    @property
    def cores(self) -> float | None:
        """Cores that were busy on average."""
        return None if self.cpu_ms is None else self.cpu_ms / self.median_ms

    @property
    def program(self) -> str:
        """Whose function it is: what the name says after its last comma."""
        return self.name.rsplit(", ", 1)[-1]

    def saved(self) -> dict[str, Any]:
        """What is written to the file of results."""
        return {one.name: getattr(self, one.name) for one in fields(self) if one.name != "call"}


@dataclass(frozen=True)
class Times:
    """Seconds of all timed runs, mean processor time of one, and the last result."""

    seconds: list[float]
    cpu_s: float
    result: Any


def compile_once(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[float, Any]:
    """Seconds of tracing and compiling without any cache, and the program."""
    jax.clear_caches()
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return time.perf_counter() - start, program


def buffers_mb(program: Any) -> float | None:
    """Arguments, results and temporaries of a compiled program, MB; None where the backend does not say."""
    usage = program.memory_analysis()
    if usage is None:
        return None
    parts = (usage.argument_size_in_bytes, usage.output_size_in_bytes, usage.temp_size_in_bytes)
    return sum(parts) / 1e6


def allocated_mb(call: Callable[[], Any]) -> float:
    """What one call allocates at its peak through NumPy and Python, MB (blind to the arrays of JAX)."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def timed(call: Callable[[], Any], seconds: float, least: int) -> Times:
    """Repeated runs for `seconds` in total, `least` of them at least and 1000 at most."""
    times: list[float] = []
    result = None
    used = time.process_time()
    while len(times) < least or (sum(times) < seconds and len(times) < 1000):
        start = time.perf_counter()
        result = jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return Times(times, (time.process_time() - used) / len(times), result)


def row_of(
    name: str,
    size: dict[str, int],
    times: list[float],
    *,
    compile_s: float | None = None,
    cpu_s: float | None = None,
    memory: tuple[float | None, str] = (None, ""),
    error: float | None = None,
    note: str = "",
    units: int = 1,
    call: Callable[[], Any] | None = None,
) -> Row:
    """A row of the seconds of all runs; `memory` in MB, and its kind."""
    return Row(
        name=name,
        size=size,
        compile_s=compile_s,
        median_ms=1e3 * statistics.median(times),
        best_ms=1e3 * min(times),
        runs=len(times),
        cpu_ms=None if cpu_s is None else 1e3 * cpu_s,
        memory_mb=memory[0],
        memory_kind=None if memory[0] is None else memory[1],
        error=error,
        note=note,
        units=units,
        call=call,
    )


def kind_and_mb(program: Any | None, call: Callable[[], Any], traced: bool) -> tuple[float | None, str]:
    """Memory of a row and its kind: of the compiled program if there is one, see `Row`."""
    if program is not None:
        return buffers_mb(program), "XLA buffers"
    if traced:
        return allocated_mb(call), "NumPy peak"
    return peak_mb(), "process peak"


def _block(row: Row, seconds: float) -> float:
    """Seconds that one unit takes in a block of calls."""
    assert row.call is not None
    calls = max(1, math.ceil(1e3 * seconds / row.median_ms))
    start = time.perf_counter()
    for _ in range(calls):
        jax.block_until_ready(row.call())
    return (time.perf_counter() - start) / (calls * row.units)


def ratios(above: Row, below: Row, smoke: bool = False) -> list[float]:
    """Time of a unit of `above` over that of `below`, one number for each pair of blocks.

    Args:
        above, below: measured rows, with their functions.
        smoke: two pairs of short blocks.

    Raises:
        ValueError: if the times of a row were taken elsewhere.
    """
    if above.call is None or below.call is None:
        raise ValueError(f"`{above.name}` or `{below.name}` was recorded: its function cannot be run again.")
    slowest = max(above.median_ms, below.median_ms)
    for row in (above, below):
        if row.median_ms <= LONG_MS:
            jax.block_until_ready(row.call())  # whatever was compiled since may have emptied its caches
    block = BLOCK_S / 10 if smoke else BLOCK_S
    found = []
    for k in range(2 if smoke or slowest > LONG_MS else PAIRS):
        turn = (above, below) if k % 2 == 0 else (below, above)
        first, second = (_block(row, block) for row in turn)
        found.append(first / second if k % 2 == 0 else second / first)
    return found
