"""Lenstool's catalogues: member galaxies and multiple images."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlens._text import lines_of_words, numbers, read_text

Reference = tuple[float, float]
"""(RA, Dec) of the origin, degrees."""


def degrees_of(path: Path, line: int, words: list[str], *, sexagesimal: bool) -> Reference:
    """RA and Dec from two words, in degrees or as hh:mm:ss dd:mm:ss."""
    if len(words) < 2:
        raise ValueError(f"{path}, line {line}: a reference point needs RA and Dec; add them.")
    if sexagesimal:
        parts = [numbers(path, line, word.lstrip("+-").split(":"), "h:m:s", least=3) for word in words[:2]]
        ra, dec = (a + b / 60.0 + c / 3600.0 for a, b, c in (part[:3] for part in parts))
        return 15.0 * ra, -dec if words[1].startswith("-") else dec
    ra, dec = numbers(path, line, words[:2], "RA and Dec in degrees", least=2)
    if abs(dec) > 90.0:
        raise ValueError(f"{path}, line {line}: {words[1]} is not a declination; give degrees, at most 90.")
    return ra, dec


def offset(ra: float, dec: float, reference: Reference) -> tuple[float, float]:
    """x = -(RA - RA0) cos(Dec0), y = Dec - Dec0, arcsec: the frame of published models."""
    turn = (ra - reference[0] + 180.0) % 360.0 - 180.0
    return -turn * math.cos(math.radians(reference[1])) * 3600.0, (dec - reference[1]) * 3600.0


def _place(
    path: Path, reference: Reference | None, absolute: bool
) -> Callable[[float, float], tuple[float, float]]:
    """What turns the first two numbers of a row into x and y: the header `#REFERENCE` decides."""
    for n, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or not words[0].startswith("#REFERENCE"):
            continue
        kind = words[1] if len(words) > 1 else ""
        if kind == "0":
            absolute = True
        elif kind in ("1", "3") and reference is not None:
            shift = offset(*degrees_of(path, n, words[2:], sexagesimal=kind == "1"), reference)
            return lambda x, y: (x + shift[0], y + shift[1])
        elif kind in ("1", "3"):
            absolute = False
        else:
            raise ValueError(
                f"{path}, line {n}: #REFERENCE {kind} is not read; use 0 (degrees) or 3 (arcsec)."
            )
        break
    else:
        if not absolute:
            _refuse_degrees(path, reference)
    if not absolute:
        return lambda x, y: (x, y)
    if reference is None:
        raise ValueError(
            f"{path} has RA and Dec, but the parameter file no reference point; add `reference` to runmode."
        )
    return lambda x, y: offset(x, y, reference)


def _refuse_degrees(path: Path, reference: Reference | None) -> None:
    """Refuse rows that nothing declares as RA and Dec, but that all lie within a degree of the reference.

    Positions in arcsec do so only if all are within an arcsecond of one place; not looked at without a
    reference, or where it is the origin of both.
    """
    if reference is None or reference == (0.0, 0.0):
        return
    try:
        rows = np.array([words[1:3] for _, words in lines_of_words(path)], float).reshape(-1, 2)
    except ValueError:
        return  # a row that cannot be read is complained of by its line
    turn = (rows[:, 0] - reference[0] + 180.0) % 360.0 - 180.0
    if len(rows) and max(np.abs(turn).max(), np.abs(rows[:, 1] - reference[1]).max()) < 1.0:
        raise ValueError(
            f"{path} does not say whether its positions are degrees or arcsec, and they look like RA and "
            f"Dec: all lie within 1 of the reference ({reference[0]:g}, {reference[1]:g}). Begin it with "
            "`#REFERENCE 0` for degrees, or `#REFERENCE 3` with RA and Dec of the origin for arcsec."
        )


class Galaxies(NamedTuple):
    """Member galaxies.

    Attributes:
        theta: positions, `(n, 2)`, arcsec.
        ellipticity: (a^2 - b^2)/(a^2 + b^2), `(n,)`.
        pa: position angle from +x, `(n,)`, rad.
        mag: magnitudes, `(n,)`.
    """

    theta: np.ndarray
    ellipticity: np.ndarray
    pa: np.ndarray
    mag: np.ndarray


def galaxies(path: Path, reference: Reference | None, *, absolute: bool) -> Galaxies:
    """Rows `id x y a b theta mag [lum]` of a `potfile` catalogue (formats 1 and 3)."""
    place = _place(path, reference, absolute)
    theta, shape, pa, mag = [], [], [], []
    for n, words in lines_of_words(path):
        what = "id, position, a, b, theta and magnitude of a galaxy"
        if len(words) < 7:
            raise ValueError(f"{path}, line {n}: {len(words)} columns where 7 are needed: {what}. Add them.")
        x, y, a, b, angle, m = numbers(path, n, words[1:7], what)
        if not 0.0 < b <= a:
            raise ValueError(f"{path}, line {n}: axes a = {a:g}, b = {b:g}; they must be positive, b <= a.")
        theta.append(place(x, y))
        shape.append((a**2 - b**2) / (a**2 + b**2))
        pa.append(math.radians(angle))
        mag.append(m)
    if not theta:
        raise ValueError(f"{path} has no galaxy; give at least one row, or remove the potfile.")
    return Galaxies(*(np.array(column) for column in (theta, shape, pa, mag)))


class Images(NamedTuple):
    """Multiple images, sorted by system.

    Attributes:
        theta: positions, `(i, 2)`, arcsec.
        source: index of each image's system, `(i,)`.
        z_s: redshift of every system; 0 where it is not known.
        systems: names of the systems.
        image_ids: names of the images.
        line: line of the first image of each system.
    """

    theta: np.ndarray
    source: np.ndarray
    z_s: list[float]
    systems: tuple[str, ...]
    image_ids: tuple[str, ...]
    line: list[int]


def system_of(image: str) -> str:
    """The system of an image by its name: `1` of `1.2` and of `1b`, `C1` of `C1a`, `4.1` of `4.1c`."""
    lettered = re.fullmatch(r"(.*\d)[A-Za-z]+", image)
    if lettered:
        return lettered[1]
    return image.rpartition(".")[0] or image


def images(path: Path, reference: Reference | None, *, absolute: bool) -> Images:
    """Rows `id x y a b theta z [mag]` of a `multfile`."""
    place = _place(path, reference, absolute)
    rows: dict[str, list[tuple[int, str, tuple[float, float], float]]] = {}
    for n, words in lines_of_words(path):
        what = "id, position, a, b, theta and redshift of an image"
        if len(words) < 7:
            raise ValueError(f"{path}, line {n}: {len(words)} columns where 7 are needed: {what}. Add them.")
        x, y, _, _, _, z = numbers(path, n, words[1:7], what)
        mine = rows.setdefault(system_of(words[0]), [])
        at = place(x, y)
        for m, name, other, z_other in mine:
            if name == words[0] or at == other:
                same = "name" if name == words[0] else "position"
                raise ValueError(f"{path}, line {n}: image {words[0]} has the {same} of line {m}; drop one.")
            if z != z_other:
                raise ValueError(
                    f"{path}, line {n}: the redshift {z:g} of image {words[0]} disagrees with {z_other:g} on "
                    f"line {m} of the same system; give one redshift, or rename the image."
                )
        mine.append((n, words[0], at, z))
    if not rows:
        raise ValueError(f"{path} has no image; give at least two rows of one system.")
    for system, mine in rows.items():
        if len(mine) == 1:
            raise ValueError(
                f"{path}, line {mine[0][0]}: image {mine[0][1]} is alone in its system {system}, which "
                "constrains nothing; add its counter-images, or drop the row."
            )
    every = [one for mine in rows.values() for one in mine]
    return Images(
        theta=np.array([one[2] for one in every]),
        source=np.repeat(np.arange(len(rows)), [len(mine) for mine in rows.values()]),
        z_s=[mine[0][3] for mine in rows.values()],
        systems=tuple(rows),
        image_ids=tuple(one[1] for one in every),
        line=[mine[0][0] for mine in rows.values()],
    )
