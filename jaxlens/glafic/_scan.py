"""The words of glafic's files: commands, galaxies, observed images, priors; no physics."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlens._text import lines_of_words, numbers
from jaxlens.strong import ImageCatalogue

_NUMBERS = {"omega", "lambda", "weos", "hubble", "flag_hodensity", "hodensity"}
_FILES = {"galfile", "readobs_point", "parprior"}
_ONLY = {
    "chi2_splane": ("1", "source plane"),
    "chi2_usemag": ("0", "no magnitudes"),
    "hvary": ("0", "a fixed Hubble constant"),
}
_IGNORED = {
    "end_startup", "start_command", "prefix", "xmin", "xmax", "ymin", "ymax", "pix_ext", "pix_poi", "maxlev",
    "chi2_restart", "chi2_checknimg", "ran_seed", "optimize", "quit", "writelens", "findimg", "calcimage",
}  # fmt: skip


@dataclass
class Raw:
    """An input file, taken apart. Lines are kept for errors."""

    path: Path
    settings: dict[str, float] = field(default_factory=dict)
    lenses: list[tuple[int, str, list[float]]] = field(default_factory=list)
    points: list[tuple[int, list[float]]] = field(default_factory=list)
    flags: list[tuple[int, list[int]]] = field(default_factory=list)
    files: dict[str, Path] = field(default_factory=dict)
    announced: tuple[int, list[float]] | None = None
    source_plane: bool = False


def scan(path: Path) -> Raw:
    """Read the commands of an input file."""
    raw = Raw(path)
    unknown: list[str] = []
    in_options = False
    for n, words in lines_of_words(path):
        if words[0] in {"start_setopt", "end_setopt"}:
            in_options = words[0] == "start_setopt"
        elif in_options:
            raw.flags.append((n, [_flag(path, n, word) for word in words]))
        elif not _command(raw, n, words):
            unknown.append(f"{' '.join(words[: 2 if words[0] == 'extend' else 1])} (line {n})")
    if unknown:
        raise ValueError(
            f"{path} has commands that are not read: {', '.join(unknown)}. "
            "Remove them, or the parts they set up."
        )
    _check_counts(raw)
    return raw


def _flag(path: Path, n: int, word: str) -> int:
    if word not in ("0", "1"):
        raise ValueError(f"{path}, line {n}: the flag {word!r} of setopt is neither 0 (fixed) nor 1 (free).")
    return int(word)


def _command(raw: Raw, n: int, words: list[str]) -> bool:
    """Take in one command; False if it is not known."""
    head, path = words[0], raw.path
    if head in _IGNORED:
        return True
    if head not in {"startup", "lens", "point"} | _NUMBERS | _FILES | set(_ONLY):
        return False
    if len(words) < 2:
        raise ValueError(f"{path}, line {n}: {head} stands alone; give its value, or remove the line.")
    if head == "startup":
        raw.announced = n, numbers(path, n, words[1:], "numbers of lenses, extended sources, points", least=3)
    elif head == "lens":
        what = f"the 8 parameters of the lens {words[1]}"
        values = numbers(path, n, words[2:], what, least=8)
        if len(values) > 8:
            raise ValueError(f"{path}, line {n}: {len(values)} numbers, but {what}; remove the others.")
        raw.lenses.append((n, words[1], values))
    elif head == "point":
        raw.points.append((n, numbers(path, n, words[1:], "redshift, x and y of a point source", least=3)))
    elif head in _NUMBERS:
        raw.settings[head] = numbers(path, n, words[1:2], head)[0]
    elif head in _FILES:
        raw.files[head] = path.parent / words[1]
    elif words[1] != _ONLY[head][0]:
        only, meaning = _ONLY[head]
        raise ValueError(f"{path}, line {n}: {head} is {words[1]}; only {only} ({meaning}) is read.")
    elif head == "chi2_splane":
        raw.source_plane = True
    return True


def _check_counts(raw: Raw) -> None:
    path, n_lens, n_point = raw.path, len(raw.lenses), len(raw.points)
    if not raw.lenses:
        raise ValueError(f"{path} has no `lens`; add the mass model between startup and end_startup.")
    if raw.announced is not None:
        n, (lenses, extended, points) = raw.announced[0], raw.announced[1][:3]
        if extended:
            raise ValueError(f"{path}, line {n}: startup has {extended:g} extended sources; only 0 is read.")
        if (lenses, points) != (n_lens, n_point):
            raise ValueError(
                f"{path}, line {n}: startup announces {lenses:g} lenses and {points:g} points, the file has "
                f"{n_lens} and {n_point}; correct the numbers, or add the missing lines."
            )
    if raw.flags:
        sizes = [8] * n_lens + [3] * n_point
        if len(raw.flags) not in (n_lens, n_lens + n_point):
            raise ValueError(
                f"{path}, line {raw.flags[0][0]}: setopt has {len(raw.flags)} lines for {n_lens} lenses and "
                f"{n_point} points; give one for each."
            )
        for (n, flags), size in zip(raw.flags, sizes, strict=False):
            if len(flags) != size:
                raise ValueError(f"{path}, line {n}: {len(flags)} flags of setopt where {size} are needed.")


def read_observations(path: Path) -> ImageCatalogue:
    """Read a `readobs_point` file: systems of images with redshift and position error.

    Raises:
        ValueError: naming file, line, value and remedy.
    """
    return observations(path)[0]


def observations(path: Path, z_l: float = 0.0) -> tuple[ImageCatalogue, list[float]]:
    """The images of a `readobs_point` file, and the errors of the redshifts of their systems."""
    lines = lines_of_words(path)
    if not lines:
        raise ValueError(f"{path} is empty; give one line for each system and below it one for each image.")
    theta: list[tuple[float, float]] = []
    source, sigma, z_s, names, ids, z_error = [], [], [], [], [], []
    at = 0
    while at < len(lines):
        n, words = lines[at]
        head = numbers(path, n, words, "system, number of images, redshift, its error", least=3)
        count, name = _count(path, n, words), words[0]
        rows = lines[at + 1 : at + 1 + count]
        if name in names:
            raise ValueError(
                f"{path}, line {n}: system {name} is there twice; give each a number of its own."
            )
        if len(rows) < count:
            raise ValueError(
                f"{path}, line {n}: system {name} announces {count} images, the file has {len(rows)}."
            )
        if not head[2] > z_l:
            raise ValueError(
                f"{path}, line {n}: the redshift {words[2]} of system {name} is not behind the lens "
                f"(z = {z_l:g}); correct it, or leave the system out."
            )
        first = len(theta)
        for k, (m, row) in enumerate(rows, start=1):
            values = numbers(path, m, row, f"x, y, flux and position error of an image of {name}", least=4)
            if not values[3] > 0.0:
                raise ValueError(
                    f"{path}, line {m}: the position error {row[3]} of image {name}.{k} is not positive; "
                    "give it in arcsec."
                )
            if any(values[4:]):
                raise ValueError(
                    f"{path}, line {m}: image {name}.{k} has a flux error, a time delay or a parity "
                    f"({' '.join(row[4:])}), which are not fitted; set them to 0 to fit the positions alone."
                )
            if (values[0], values[1]) in theta[first:]:
                raise ValueError(
                    f"{path}, line {m}: image {name}.{k} is at the position of another image of the same "
                    "system; drop one."
                )
            theta.append((values[0], values[1]))
            sigma.append(values[3])
            source.append(len(z_s))
            ids.append(f"{name}.{k}")
        z_s.append(head[2])
        z_error.append(_error(path, n, head))
        names.append(name)
        at += 1 + count
    catalogue = ImageCatalogue(
        np.array(theta), np.array(source), np.array(z_s), np.array(sigma), tuple(names), tuple(ids)
    )
    return catalogue, z_error


def _count(path: Path, n: int, words: list[str]) -> int:
    if not words[1].isdigit():
        raise ValueError(f"{path}, line {n}: {words[1]!r} is not a number of images; give a whole number.")
    if int(words[1]) < 2:
        raise ValueError(
            f"{path}, line {n}: system {words[0]} has {words[1]} image, which constrains nothing; "
            "leave the system out, or add its counter-images."
        )
    return int(words[1])


def _error(path: Path, n: int, head: list[float]) -> float:
    error = head[3] if len(head) > 3 else 0.0
    if error < 0.0:
        raise ValueError(f"{path}, line {n}: the redshift error {error:g} is negative; give 0 for none.")
    return error


class Said(NamedTuple):
    """One line of a prior file: `range` (lowest, largest value) or `gauss` (mean, standard deviation)."""

    line: int
    first: float
    second: float


@dataclass
class Priors:
    """A prior file: by `("lens" or "point", number, parameter)`."""

    path: Path
    ranges: dict[tuple[str, int, int], Said] = field(default_factory=dict)
    normal: dict[tuple[str, int, int], Said] = field(default_factory=dict)


def priors(path: Path | None) -> Priors:
    """Read a `parprior` file; nothing from None."""
    found = Priors(path or Path())
    for n, words in lines_of_words(path) if path is not None else []:
        _prior(found, n, words)
    return found


def _prior(found: Priors, n: int, words: list[str]) -> None:
    path = found.path
    kind, of = (*words[:2], "", "")[:2]
    if kind not in ("range", "gauss") or of not in ("lens", "point"):
        raise ValueError(
            f"{path}, line {n}: {f'{kind} {of}'.strip()!r} is not read; only `range` and `gauss` of `lens` "
            "and `point` are. Remove the line."
        )
    values = numbers(path, n, words[2:6], "lens or point, parameter, 2 values", least=4)
    key = (of, int(values[0]), int(values[1]))
    said = Said(n, values[2], values[3])
    if kind == "range" and not said.first < said.second:
        raise ValueError(
            f"{path}, line {n}: the lower limit {said.first:g} is not below the upper one {said.second:g}; "
            "correct the limits."
        )
    if kind == "gauss" and not said.second > 0.0:
        raise ValueError(
            f"{path}, line {n}: the standard deviation {said.second:g} is not positive; correct it."
        )
    kept = found.ranges if kind == "range" else found.normal
    if key in kept:
        raise ValueError(
            f"{path}, line {n}: parameter {key[2]} of {of} {key[1]} has a `{kind}` on line {kept[key].line} "
            "already; keep one."
        )
    kept[key] = said


def galaxies(path: Path) -> np.ndarray:
    """Rows x, y, L/L_*, e, pa of a `galfile`, `(n, 5)`, rounded to single precision.

    The program holds galaxies in single precision; rounding first makes the comparison exact.
    """
    rows = []
    for n, words in lines_of_words(path):
        row = numbers(path, n, words, "x, y, luminosity and optionally e, pa of a galaxy", least=3)
        if not row[2] > 0.0:
            raise ValueError(f"{path}, line {n}: the luminosity {words[2]} is not positive; correct it.")
        row = [*row, 0.0, 0.0][:5] if len(row) < 5 else row[:5]
        if not 0.0 <= row[3] < 1.0:
            raise ValueError(f"{path}, line {n}: {row[3]:g} is not an ellipticity; give 1 - b/a, below 1.")
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} has no galaxy; give at least one row, or remove the lens `gals`.")
    return np.array(rows, dtype=np.float32).astype(float)
