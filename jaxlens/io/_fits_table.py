"""The first table of a FITS file as the cells of a text table, so that one reader checks both."""

from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from jaxlens.io._fits import hdus_of

ENDINGS = (".fits", ".fit", ".fits.gz", ".fit.gz")
"""Endings of file names, in lower case, that are read as FITS."""


def fits_cells(path: Path) -> tuple[list[str], list[list[str]], list[int], dict[str, Any]]:
    """Names of columns, rows of cells, the number of each row from 1, and the units.

    A number's cell is its shortest text that reads back bit for bit. The last item has the form of an
    ECSV header: `datatype`, a list of `name` and `unit`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no FITS file, is truncated, or holds no table.
    """
    with hdus_of(path) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)]
        if not tables:
            raise ValueError(f"{path} holds no table; give a FITS file with a table extension.")
        columns: Any = tables[0].columns
        units = [{"name": one.name, "unit": one.unit} for one in columns if one.unit]
        found = [(one.name, np.array(tables[0].data[one.name])) for one in columns]
    flat = [(name, values) for name, values in found if values.ndim == 1]
    if not flat:
        raise ValueError(f"{path}: the first table has no column of single numbers; give one value a row.")
    cells = [[str(cell).strip() for cell in values.tolist()] for _, values in flat]
    rows = [list(row) for row in zip(*cells, strict=True)]
    return [name for name, _ in flat], rows, list(range(1, len(rows) + 1)), {"datatype": units}
