"""What a benchmark claims, and how its results are printed."""

import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from _timing import Row
from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Check:
    """A claim, whether it held, and whether a smoke run can judge it."""

    claim: str
    held: bool
    smoke: bool


@dataclass(frozen=True)
class Target:
    """A measured number, mostly a ratio of two times, and what it should be.

    Attributes:
        claim: what is compared.
        ratio: the median; None if it could not be measured.
        lowest, highest: smallest and largest of all repetitions.
        runs: number of repetitions.
        least, most: its limits; None where there is none.
        reason: why it was not measured.
        cores, errors: of ours and of the other program; None where there is no such pair.
    """

    claim: str
    ratio: float | None
    lowest: float | None = None
    highest: float | None = None
    runs: int = 0
    least: float | None = None
    most: float | None = None
    reason: str = ""
    cores: Sequence[float | None] | None = None
    errors: Sequence[float | None] | None = None

    @classmethod
    def of(
        cls, claim: str, values: Sequence[float], *, least: float | None = None, most: float | None = None
    ) -> "Target":
        """The target of all repetitions."""
        middle = float(statistics.median(values))
        return cls(claim, middle, float(min(values)), float(max(values)), len(values), least, most)

    @property
    def held(self) -> bool | None:
        """Whether the median is within its limits; None if it could not be measured."""
        if self.ratio is None:
            return None
        low = self.least is None or self.ratio >= self.least
        return low and (self.most is None or self.ratio <= self.most)

    @property
    def limits(self) -> str:
        """The limits in short, e.g. `>= 10`."""
        both = ((">=", self.least), ("<=", self.most))
        return ", ".join(f"{sign} {limit:g}" for sign, limit in both if limit is not None)

    @property
    def measured(self) -> str:
        """The number with its range and repetitions, or why there is none."""
        if self.ratio is None:
            return f"not measured ({self.reason})"
        if self.runs < 2:
            return f"{self.ratio:.3g}"
        return f"{self.ratio:.3g} ({self.lowest:.3g} to {self.highest:.3g}, {self.runs} runs)"

    def saved(self) -> dict[str, Any]:
        """What is written to the file of results."""
        return {**asdict(self), "held": self.held}

    @classmethod
    def read(cls, saved: dict[str, Any]) -> "Target":
        """The target from a file of results."""
        return cls(**{key: value for key, value in saved.items() if key != "held"})

    def __str__(self) -> str:
        return f"{self.claim}: {self.measured} ({self.limits or 'for information'})"


COLUMNS = (
    ("compile [s]", "{:.2f}", "compile_s"),
    ("median [ms]", "{:.3f}", "median_ms"),
    ("best [ms]", "{:.3f}", "best_ms"),
    ("runs", "{:d}", "runs"),
    ("cores", "{:.1f}", "cores"),
    ("memory [MB]", "{:.2f}", "memory_mb"),
    ("of", "{}", "memory_kind"),
    ("error", "{:.1e}", "error"),
)


def table_of(rows: Sequence[Row], **options: Any) -> Table:
    """All rows; `options` are those of `rich.table.Table`."""
    table = Table(**options)
    for heading in ("", "size", *(heading for heading, _, _ in COLUMNS)):
        table.add_column(heading, justify="left" if heading in ("", "size", "of") else "right")
    for row in rows:
        size = ", ".join(f"{key} {value}" for key, value in row.size.items())
        values = [(form, getattr(row, name)) for _, form, name in COLUMNS]
        table.add_row(row.name, size, *("" if v is None else form.format(v) for form, v in values))
    return table


def show(
    content: dict[str, Any], rows: Sequence[Row], targets: Sequence[Target], checks: Sequence[Check]
) -> None:
    """Print rows, notes, targets without a limit, checks and what is missing."""
    where = content["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    console = Console()
    console.width = max(console.width, 140)
    caption = (
        f"{where['cpu']}, {where['cores']} cores, load {where['load']:.1f}; {versions}; "
        f"process peak {content['process_peak_mb']:.0f} MB; {content['elapsed_s']:.0f} s in all"
    )
    title = f"{content['benchmark']} (commit {where['commit']})"
    console.print(table_of(rows, title=title, caption=caption))
    # One note often serves several rows.
    for note in dict.fromkeys(row.note for row in rows if row.note):
        names = ", ".join(dict.fromkeys(row.name for row in rows if row.note == note))
        console.print(f"note on {names}: {note}", markup=False)
    for one in targets:
        if one.ratio is None or not one.limits:
            console.print(f"{one}", markup=False)
    for check in checks:
        judged = "" if check.smoke or not content["smoke"] else " (not judged in a smoke run)"
        console.print(f"{'holds' if check.held else 'FAILS'}: {check.claim}{judged}", markup=False)
    for line in content["missing"]:
        console.print(line, markup=False)
