"""Results on disk: tables, JSON, region files for DS9. Every writer replaces its file in one step."""

import json
import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Column, Table

from jaxlens.io._files import atomic
from jaxlens.io._sky import Reference, sky
from jaxlens.io._table import unit_of


def write_table(
    path: str | Path,
    columns: Mapping[str, Any],
    *,
    units: Mapping[str, str] | None = None,
    meta: Mapping[str, Any] | None = None,
    descriptions: Mapping[str, str] | None = None,
) -> None:
    """Write columns as ECSV, separated by commas; numbers read back bit for bit.

    Args:
        path: the file; replaced in one step.
        columns: by name, each `(n,)`: numbers (NumPy or JAX), booleans or strings.
        units: units as astropy spells them; without an entry, that of the name's ending (`x_arcsec`).
        meta: further facts for the header; anything JSON could hold, NumPy and JAX scalars included.
        descriptions: what a column is, by name.

    Raises:
        ValueError: if columns differ in length or are not one-dimensional.
    """
    units, descriptions = units or {}, descriptions or {}
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    shapes = {name: array.shape for name, array in arrays.items()}
    if any(len(shape) != 1 for shape in shapes.values()) or len(set(shapes.values())) > 1:
        raise ValueError(f"Columns of a table must be one-dimensional and of one length; given {shapes}.")
    table = Table(meta={key: _plain(value, key) for key, value in (meta or {}).items()})
    for name, array in arrays.items():
        table[name] = Column(array, unit=units.get(name, unit_of(name)), description=descriptions.get(name))
    with atomic(path) as temporary:
        table.write(temporary, format="ascii.ecsv", delimiter=",", overwrite=True)


def write_parquet(path: str | Path, columns: Mapping[str, Any]) -> None:
    """Write columns as Parquet, which pandas, polars, DuckDB, R and astropy read; units in the metadata.

    Args:
        path: the file; replaced in one step.
        columns: by name, each `(n,)`.

    Raises:
        ModuleNotFoundError: without pyarrow, which the extra `cluster` installs.
    """
    table = Table({name: Column(np.asarray(each), unit=unit_of(name)) for name, each in columns.items()})
    with atomic(path) as temporary:
        table.write(temporary, format="parquet", overwrite=True)


def write_array_table(path: str | Path, columns: Mapping[str, Any]) -> None:
    """Write columns of numbers or of arrays, `(n, ...)` each, as the first table of a FITS file.

    Args:
        path: the file; replaced in one step.
        columns: by name.
    """
    table = Table({name: Column(np.asarray(each), unit=unit_of(name)) for name, each in columns.items()})
    with atomic(path) as temporary:
        table.write(temporary, format="fits", overwrite=True)


def read_json(path: str | Path) -> Any:
    """What `write_json` wrote.

    Raises:
        ValueError: if the file is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is not JSON ({error}); delete it, and it is made again.") from error


def write_json(path: str | Path, content: Any) -> None:
    """Write nested dictionaries, sequences and numbers as JSON.

    Keys keep their order. NumPy and JAX scalars and arrays, paths and named tuples are accepted; a
    float that is not finite becomes `null` (JSON has no NaN). Floats read back bit for bit.

    Args:
        path: the file; replaced in one step.
        content: what to write.

    Raises:
        TypeError: if something in it has no JSON form; the message says where.
    """
    text = _format(_plain(content, ""), "") + "\n"
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _plain(value: Any, where: str) -> Any:
    """`value` in the types of JSON; `where` is the path to it for the error."""
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(one, f"{where}.{key}".lstrip(".")) for key, one in value.items()}
    if hasattr(value, "_asdict"):
        return _plain(value._asdict(), where)
    if isinstance(value, list | tuple):
        return [_plain(one, f"{where}[{index}]") for index, one in enumerate(value)]
    if isinstance(value, set | frozenset):
        return _plain(sorted(value), where)
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        array = np.asarray(value)
        if array.dtype.kind in "biufU":
            return _plain(array.tolist(), where)
    raise TypeError(
        f"{where or 'The content'} is a {type(value).__name__}, which JSON cannot hold; give numbers, text, "
        "lists or dictionaries."
    )


def _format(value: Any, indent: str) -> str:
    """JSON with one entry per line, but lists of plain values on a single line."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        lines = [f"{inner}{json.dumps(key)}: {_format(one, inner)}" for key, one in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(one, dict | list) for one in value):
        return "[\n" + ",\n".join(inner + _format(one, inner) for one in value) + f"\n{indent}]"
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


REGION_COLOURS = {"tangential": "red", "radial": "cyan", "caustics": "magenta"}
"""Colours of curves in region files by their name; others are yellow, images are green."""


def write_regions(
    path: str | Path,
    *,
    images: Any = None,
    labels: Iterable[str] = (),
    predicted: Any = None,
    curves: Mapping[str, Iterable[Any]] | None = None,
    reference: Reference | None = None,
) -> None:
    """Write a DS9 region file: images as labelled points, curves as polygons or lines.

    With a reference point positions are RA and Dec (`fk5`). Without one they are offsets theta in arcsec
    in the system `linear`: they lie right on any map written by `write_map` without a reference point.
    A curve whose ends meet is a `polygon`; an open one is a chain of `line`s.

    Args:
        path: the file; replaced in one step.
        images: observed positions, `(i, 2)`, arcsec; circles.
        labels: their names.
        predicted: predicted positions, `(m, 2)`, arcsec; crosses. Rows with NaN are left out.
        curves: polylines `(m, 2)` in arcsec by name, e.g. `tangential`, `radial`, `caustics`.
        reference: (RA, Dec) of the origin, degrees.

    Raises:
        ValueError: if there is not one label for every image.
    """
    observed = np.asarray(images, float).reshape(-1, 2) if images is not None else np.zeros((0, 2))
    names = [str(label) for label in labels]
    if len(names) not in (0, len(observed)):
        raise ValueError(f"{len(names)} labels for {len(observed)} images; give one for each, or none.")

    def place(theta: np.ndarray) -> list[str]:
        if reference is None:
            return [f"{x:.5f},{y:.5f}" for x, y in theta]
        return [f"{ra:.8f},{dec:.8f}" for ra, dec in zip(*sky(theta, reference), strict=True)]

    lines = [
        "# Region file format: DS9 version 4.1",
        'global color=green width=1 font="helvetica 10 normal roman" move=0 include=1',
        "fk5" if reference is not None else "linear",
    ]
    for kind, pieces in (curves or {}).items():
        style = f"color={REGION_COLOURS.get(kind, 'yellow')} tag={{{kind}}}"
        for piece in pieces:
            points = np.asarray(piece, float)
            if len(points) > 3 and np.allclose(points[0], points[-1], rtol=0.0, atol=1e-6):
                lines.append(f"polygon({','.join(place(points[:-1]))}) # {style}")
            else:
                at = place(points)
                lines += [f"line({a},{b}) # line=0 0 {style}" for a, b in pairwise(at)]
    for at, name in zip(place(observed), names or [""] * len(observed), strict=True):
        lines.append(f"point({at}) # point=circle text={{{name}}} tag={{observed}}")
    if predicted is not None:
        found = np.asarray(predicted, float).reshape(-1, 2)
        for at in place(found[np.isfinite(found).all(axis=1)]):
            lines.append(f"point({at}) # point=x color=white tag={{predicted}}")
    with atomic(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
