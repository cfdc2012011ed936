"""Results and figures as one HTML page that needs no other file.

A page is plain data: a title, facts, and sections of paragraphs, tables and figures. Figures go in as the
bytes of their PNG files, so that the page can be mailed, archived or opened without a network.
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import ClassVar, Literal

from jinja2 import Environment, StrictUndefined

_SIGNS = {"holds here": "yes", "does not hold here": "no", "undecided": "open"}

Verdict = Literal["holds here", "does not hold here", "undecided"]


@dataclass(frozen=True)
class Mark:
    """A cell that says whether a statement holds.

    Attributes:
        verdict: what it says.
    """

    verdict: Verdict

    @property
    def sign(self) -> str:
        """Name of the sign in front of it."""
        return _SIGNS[self.verdict]


@dataclass(frozen=True)
class Link:
    """A cell that leads to a figure or section of the same page.

    Attributes:
        text: what is read.
        target: key of the figure or section.
    """

    text: str
    target: str


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        columns: headings.
        rows: cells, one sequence per row, as long as `columns`.
        caption: a line above it.
        numeric: indices of the columns that are set flush right.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str | Mark | Link]]
    caption: str = ""
    numeric: frozenset[int] = frozenset()
    kind: ClassVar[str] = "table"

    def __post_init__(self) -> None:
        for index, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"Row {index} of a table has {len(row)} cells for {len(self.columns)} columns."
                )


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        key: what links name; the stem of its file.
        png: the image, bytes of a PNG file.
        caption: what is seen, one or two sentences; also read aloud in place of the image.
    """

    key: str
    png: bytes
    caption: str
    kind: ClassVar[str] = "figure"

    @classmethod
    def read(cls, path: str | Path, caption: str) -> "Figure":
        """The figure in a PNG file; its key is the stem of the file."""
        return cls(Path(path).stem, Path(path).read_bytes(), caption)

    @property
    def source(self) -> str:
        """The image as a data URL."""
        return f"data:image/png;base64,{b64encode(self.png).decode('ascii')}"


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Attributes:
        key: what links name.
        title: its heading.
        parts: paragraphs (plain text), tables and figures, in the order of the page.
    """

    key: str
    title: str
    parts: Sequence[str | Table | Figure] = ()


@dataclass(frozen=True)
class Page:
    """A whole report.

    Attributes:
        title: heading and title of the page.
        lead: one sentence below it.
        sections: the sections.
        facts: short facts (seed, versions, time) by name.
    """

    title: str
    lead: str
    sections: Sequence[Section]
    facts: Mapping[str, str] = field(default_factory=dict)


def html(page: Page) -> str:
    """The page as HTML. All text is escaped: nothing in a name or a message becomes markup.

    Raises:
        ValueError: if a key occurs twice or a link leads nowhere.
    """
    keys = [section.key for section in page.sections]
    keys += [part.key for section in page.sections for part in section.parts if isinstance(part, Figure)]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise ValueError(f"Keys of a report must differ; twice: {', '.join(twice)}.")
    tables = [part for section in page.sections for part in section.parts if isinstance(part, Table)]
    cells = [cell for table in tables for row in table.rows for cell in row]
    lost = sorted({cell.target for cell in cells if isinstance(cell, Link)} - set(keys))
    if lost:
        raise ValueError(f"Links of a report lead nowhere: {', '.join(lost)}.")
    engine = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = files("jaxlens.report").joinpath("page.html").read_text(encoding="utf-8")
    return engine.from_string(template).render(page=page)


__all__ = ["Figure", "Link", "Mark", "Page", "Section", "Table", "Verdict", "html"]
