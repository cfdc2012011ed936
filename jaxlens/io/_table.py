"""Reading of tables, CSV or ECSV, with errors that name file, line, column, value and remedy."""

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from astropy import units as u
from astropy.table.meta import get_header_from_yaml

from jaxlens._text import read_text

UNITS = {
    "arcsec": "arcsec",
    "arcmin": "arcmin",
    "deg": "deg",
    "rad": "rad",
    "kpc": "kpc",
    "mpc": "Mpc",
    "msun": "Msun",
    "km_s": "km/s",
    "kms": "km/s",
    "arcsec2": "arcsec2",
    "days": "day",
}
"""Endings of column names and the units they stand for, as astropy spells them."""

_NO_UNIT = ("", "mag", "mag(AB)", "ABmag", "mag(ST)")
_EMPTY = ("", "nan", "none", "null", "--")


def unit_of(name: str) -> str | None:
    """The unit that the name of a column or key carries, as astropy spells it.

    >>> unit_of("x_arcsec"), unit_of("sigma_v_km_s"), unit_of("z_spec")
    ('arcsec', 'km/s', None)
    """
    for ending in sorted(UNITS, key=len, reverse=True):
        if name.lower().endswith("_" + ending):
            return UNITS[ending]
    return None


@dataclass(frozen=True)
class Rows:
    """The columns of a table that were asked for.

    Attributes:
        path: the file.
        lines: line of every row in the file, `(n,)`, 1-based as an editor counts.
        columns: by name, `(n,)`: float64 for numbers (NaN where a cell is empty), str for text.
        cells: the same cells as they stand in the file.
        meta: the `meta` of an ECSV file.
    """

    path: Path
    lines: np.ndarray
    columns: Mapping[str, np.ndarray]
    cells: Mapping[str, Sequence[str]]
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __len__(self) -> int:
        return len(self.lines)

    def fail(self, row: int, column: str, problem: str) -> NoReturn:
        """Raise the error of one cell: file, line, column, value, then `problem` with its remedy."""
        shown = self.cells[column][row]
        raise ValueError(f"{self.path}, line {self.lines[row]}, column `{column}`: {shown!r} {problem}")

    def require(self, column: str, good: np.ndarray, problem: str) -> None:
        """Raise the error of the first cell for which `good (n,)` is False."""
        bad = np.flatnonzero(~good)
        if bad.size:
            self.fail(int(bad[0]), column, problem)


def read_table(
    path: str | Path,
    required: Sequence[str],
    optional: Sequence[str] = (),
    *,
    text: Iterable[str] = (),
    empty: Iterable[str] = (),
    unique: Iterable[str] = (),
) -> Rows:
    """Columns of a CSV or ECSV file.

    Lines that begin with `#` and blank lines are skipped; the first other line holds the names of the
    columns. A file whose first line is `# %ECSV ...` has units: a column in another unit than its
    name says is converted, one that cannot be is refused.

    Args:
        path: the file.
        required: columns that must be there.
        optional: columns that are read if they are there; others are ignored.
        text: which of them are text (identifiers: `1.1` and `1.10` are two images); the others are numbers.
        empty: in which of them a cell may be empty (or `nan`, `none`, `--`): NaN, or "" in text.
        unique: in which of them no value may appear twice.

    Returns:
        The columns, with the line of each row for later errors.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a column is missing, or a cell is not a finite number or empty or appears twice;
            the message names file, line, column, value and remedy.
    """
    path = Path(path)
    names, rows, lines, header = _cells(path)
    missing = [name for name in required if name not in names]
    if missing:
        raise ValueError(
            f"{path} has no column {', '.join(f'`{name}`' for name in missing)}; "
            f"its first line names {', '.join(f'`{name}`' for name in names)}. "
            "Add the column, or rename the one that holds it (columns are separated by commas)."
        )
    if not rows:
        raise ValueError(f"{path} has the names of columns but no row below them; give at least one.")
    wanted = [name for name in names if name in {*required, *optional}]
    cells = {name: [row[names.index(name)].strip() for row in rows] for name in wanted}
    # Entries like __serialized_columns__ are astropy's own bookkeeping.
    meta = {key: value for key, value in (header.get("meta") or {}).items() if not key.startswith("__")}
    table = Rows(path, np.array(lines), {}, cells, meta)
    text, empty = set(text), set(empty)
    units = {column["name"]: str(column["unit"]) for column in header.get("datatype", []) if "unit" in column}
    columns: dict[str, np.ndarray] = {}
    for name in wanted:
        if name in text:
            columns[name] = _text(table, name, name in empty)
        else:
            columns[name] = _numbers(table, name, name in empty) * _factor(path, name, units.get(name, ""))
    for name in unique:
        if name in columns:
            _distinct(table, name, columns[name])
    return Rows(path, table.lines, columns, cells, meta)


def _cells(path: Path) -> tuple[list[str], list[list[str]], list[int], dict[str, Any]]:
    """Names of columns, rows of cells, the line of each row, and the header of an ECSV file."""
    content = read_text(path).split("\n")
    header = _ecsv_header(path, content)
    kept = [
        (number, line) for number, line in enumerate(content, 1) if line.strip() and not line.startswith("#")
    ]
    if not kept:
        raise ValueError(f"{path} is empty; its first line must name the columns, separated by commas.")
    delimiter = header.get("delimiter", " ") if header else ","
    reader = csv.reader((line for _, line in kept), delimiter=delimiter, skipinitialspace=True)
    names: list[str] = []
    rows, lines = [], []
    for cells in reader:
        number = kept[reader.line_num - 1][0]
        if not names:
            names = [name.strip() for name in cells]
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(
                    f"{path}, line {number}: column `{twice[0]}` is named twice; rename or drop one."
                )
        elif len(cells) != len(names):
            raise ValueError(
                f"{path}, line {number}: {len(cells)} cells where line {kept[0][0]} names {len(names)} "
                f"columns: {kept[reader.line_num - 1][1]!r}. Add or remove commas (an empty cell is nothing "
                "between two)."
            )
        else:
            rows.append(cells)
            lines.append(number)
    return names, rows, lines, header


def _ecsv_header(path: Path, content: list[str]) -> dict[str, Any]:
    if not content or not re.match(r"#\s*%ECSV", content[0]):
        return {}
    comments = []
    for line in content[1:]:
        if not line.startswith("#"):
            break
        comments.append(line[1:].removeprefix(" "))
    try:
        return get_header_from_yaml(comments)
    except Exception as error:
        raise ValueError(
            f"{path}: the ECSV header cannot be read ({error}); write the file with astropy."
        ) from error


def _factor(path: Path, name: str, given: str) -> float:
    """What to multiply a column by so that it is in the unit its name says."""
    own = unit_of(name)
    if given in _NO_UNIT:
        return 1.0
    if own is None:
        raise ValueError(
            f"{path}, column `{name}`: the header gives it the unit {given!r}, but a column of this name has "
            "none. Remove the unit, or rename the column."
        )
    try:
        factor: Any = u.Quantity(1.0, given).to_value(own)
    except (ValueError, TypeError, u.UnitConversionError) as error:
        raise ValueError(
            f"{path}, column `{name}`: the header gives it the unit {given!r}, which is not convertible to "
            f"the {own} of its name. Correct the header or the name."
        ) from error
    return float(factor)


def _is_empty(cell: str) -> bool:
    return cell.lower() in _EMPTY


def _text(table: Rows, name: str, may_be_empty: bool) -> np.ndarray:
    cells = table.cells[name]
    for row, cell in enumerate(cells):
        if cell == "" and not may_be_empty:
            table.fail(row, name, "is empty; every row needs a name of its own here.")
    return np.array(cells, dtype=str)


def _numbers(table: Rows, name: str, may_be_empty: bool) -> np.ndarray:
    def number(row: int, cell: str) -> float:
        if _is_empty(cell):
            if may_be_empty:
                return np.nan
            table.fail(row, name, "is not a value; give a number, or drop the row.")
        try:
            value = float(cell)
        except ValueError:
            table.fail(row, name, f"is not a number; give {_example(name)}.")
        if not np.isfinite(value):
            table.fail(row, name, "is not finite; give a number, or drop the row.")
        return value

    return np.array([number(row, cell) for row, cell in enumerate(table.cells[name])], dtype=float)


def _example(name: str) -> str:
    own = unit_of(name)
    return f"a plain number in {own}, such as 1.5" if own else "a plain number, such as 1.5"


def _distinct(table: Rows, name: str, values: np.ndarray) -> None:
    seen: dict[Any, int] = {}
    for row, value in enumerate(values.tolist()):
        if value in seen:
            first = table.lines[seen[value]]
            table.fail(row, name, f"is already on line {first}; every row needs a name of its own here.")
        seen[value] = row


def flags(table: Rows, name: str) -> np.ndarray:
    """A column of text as booleans: 1/0, true/false, yes/no; empty is False, anything else an error."""
    words: dict[str, bool] = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}

    def flag(row: int, cell: str) -> bool:
        if _is_empty(cell):
            return False
        if cell.lower() not in words:
            table.fail(row, name, "is neither yes nor no; give 1 or 0.")
        return words[cell.lower()]

    return np.array([flag(row, cell) for row, cell in enumerate(table.cells[name])], dtype=bool)
