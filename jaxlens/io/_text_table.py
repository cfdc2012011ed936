"""The cells of a text table, CSV or ECSV."""

import csv
import re
from pathlib import Path
from typing import Any

from astropy.table.meta import get_header_from_yaml

from jaxlens._text import read_text


def text_cells(path: Path) -> tuple[list[str], list[list[str]], list[int], dict[str, Any]]:
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
