"""The sections of a parameter file, and the numbers in their lines; no physics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from jaxlens._text import lines_of_words, numbers

ALIASES = {
    "potential": "potentiel",
    "cosmology": "cosmologie",
    "grid": "grille",
    "profile": "profil",
    "ellipticity": "ellipticite",
    "omegam": "omega",
    "omegax": "lambda",
    "h0": "H0",
}
"""Second spellings of the words that are read."""

_SECTIONS = {"runmode", "image", "potentiel", "limit", "potfile", "cosmologie"}
_IGNORED = {"grille", "source", "cline", "grande", "champ", "field", "observ", "frame"}
# Sections about maps, grids and pictures.


@dataclass
class Section:
    """One section.

    Attributes:
        path: the file.
        kind: what it is, e.g. `potentiel`.
        name: the word behind that, e.g. `O1`; may be empty.
        line: where it begins.
        rows: its lines, as line number, key and words.
    """

    path: Path
    kind: str
    name: str
    line: int
    rows: list[tuple[int, str, list[str]]] = field(default_factory=list)

    @property
    def title(self) -> str:
        """The section as an error names it."""
        return f"{self.path}, line {self.line}, {self.kind} {self.name}".rstrip()

    def get(self, key: str) -> tuple[int, list[str]] | None:
        """Line and words of a key; None if it is not there. The last one counts."""
        found = [(line, words) for line, one, words in self.rows if one == key]
        return found[-1] if found else None

    def number(self, key: str, default: float | None = None) -> float:
        """The first number behind a key."""
        said = self.get(key)
        if said is None:
            if default is None:
                raise ValueError(f"{self.title}: {key} is missing; add it.")
            return default
        return numbers(self.path, said[0], said[1][:1], f"{key} of {self.kind} {self.name}".rstrip())[0]

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise the error of one line: file, line, section, key and words, then `problem` with its remedy."""
        said = self.get(key)
        line, words = said if said is not None else (self.line, [])
        where = f"{self.path}, line {line}, {self.kind} {self.name}".rstrip()
        raise ValueError(f"{where}: {key} {' '.join(words)}".rstrip() + f" {problem}")

    def known(self, keys: Sequence[str] | Mapping[str, str]) -> list[str]:
        """Complaints about keys that are not among `keys`."""
        name = f"{self.kind} {self.name}".rstrip()
        return [f"{key} of {name} (line {line})" for line, key, _ in self.rows if key not in keys]


def sections(path: Path) -> list[Section]:
    """The sections of a parameter file that a strong-lensing model needs.

    Raises:
        ValueError: if a section is not known or does not end; all unknown ones in one message.
    """
    found: list[Section] = []
    unknown: list[str] = []
    inside: Section | None = None
    for n, words in lines_of_words(path):
        head = ALIASES.get(words[0].lower(), ALIASES.get(words[0], words[0]))
        if (
            inside is not None
            and head in _SECTIONS | {"fini"}
            and not (head in {"image", "source"} and inside.kind == "runmode")
        ):
            raise ValueError(f"{inside.title} does not end before line {n}; add `end` above it.")
        if head == "fini":
            break
        if inside is None:
            inside = Section(path, head, words[1] if len(words) > 1 else "", n)
            if head not in _SECTIONS | _IGNORED:
                unknown.append(f"{head} (line {n})")
        elif head == "end":
            found.append(inside)
            inside = None
        else:
            inside.rows.append((n, head, words[1:]))
    if inside is not None:
        raise ValueError(f"{inside.title} does not end; add `end` below its last line.")
    if unknown:
        raise ValueError(
            f"{path} has sections that are not read: {', '.join(unknown)}. "
            "Remove them, or the parts they set up."
        )
    return [one for one in found if one.kind in _SECTIONS]


@dataclass(frozen=True)
class Limit:
    """What a `limit`-like line says of a number.

    Attributes:
        kind: 0 fixed, 1 uniform between `first` and `second`, 3 normal with that mean and deviation.
    """

    kind: int
    first: float
    second: float


def limit(section: Section, key: str, line: int, words: list[str]) -> Limit:
    """Parse `int float1 [float2 [float3]]`."""
    name = f"{section.kind} {section.name}".rstrip()
    values = numbers(section.path, line, words, f"kind and two numbers for {key} of {name}", least=2)
    kind = int(values[0])
    if kind == 0:
        return Limit(0, values[1], 0.0)
    where = f"{section.path}, line {line}, {name}: {key} {' '.join(words)}"
    if kind not in (1, 3):
        raise ValueError(f"{where} is of kind {words[0]}; read are 0 (fixed), 1 (uniform) and 3 (normal).")
    if len(values) < 3:
        raise ValueError(f"{where} has one number; kind {kind} needs two.")
    if kind == 1 and not values[1] < values[2]:
        raise ValueError(f"{where}: the lower limit is not below the upper one; correct the limits.")
    if kind == 3 and not values[2] > 0.0:
        raise ValueError(f"{where}: the standard deviation is not positive; correct it.")
    return Limit(kind, values[1], values[2])
