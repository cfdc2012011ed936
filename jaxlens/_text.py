"""Text files of other programs and our own: read whole, with errors that say what is wrong with the file."""

import math
from collections.abc import Sequence
from pathlib import Path

MAX_BYTES = 50_000_000
"""Largest text file that is read: a hundred times the largest catalogue of cluster images or members."""

Line = tuple[int, list[str]]
"""Number of a line as an editor counts, and its words."""


def read_text(path: str | Path) -> str:
    """The content of a UTF-8 file, without byte order mark and carriage returns.

    Raises:
        FileNotFoundError: if there is no such file.
        IsADirectoryError: if it is a directory.
        ValueError: if it is larger than `MAX_BYTES`, or not UTF-8; the message says where.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(
            f"{path} does not exist; check the name and the directory it is given relative to."
        )
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a directory; give the name of a file in it.")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(
            f"{path} has {size / 1e6:.0f} MB; a text file of at most {MAX_BYTES / 1e6:.0f} MB is read. "
            "Is it the right file? If so, keep only the rows that the model uses."
        )
    content = path.read_bytes()
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ValueError(
            f"{path} is not a text file in UTF-8: byte {content[error.start]:#04x} on line {line} cannot be "
            "read. Save it as plain text in UTF-8."
        ) from error


def lines_of_words(path: str | Path) -> list[Line]:
    """The lines of a text file that hold something, split at white space; `#` begins a comment."""
    split = [(n, line.split("#")[0].split()) for n, line in enumerate(read_text(path).splitlines(), start=1)]
    return [(n, words) for n, words in split if words]


def numbers(path: str | Path, line: int, words: Sequence[str], what: str, *, least: int = 1) -> list[float]:
    """Words as finite floats.

    Args:
        path, line: where they stand, for the error.
        words: the words.
        what: what they are, for the error, e.g. `system redshift`.
        least: smallest count.

    Raises:
        ValueError: naming file, line, word and remedy.
    """
    if len(words) < least:
        raise ValueError(
            f"{path}, line {line}: {len(words)} numbers ({' '.join(words)!r}) where {least} are needed: "
            f"{what}. Add the missing ones."
        )
    values = []
    for word in words:
        try:
            value = float(word)
        except ValueError as error:
            raise ValueError(
                f"{path}, line {line}: {word!r} is not a number; here should be numbers only: {what}."
            ) from error
        if not math.isfinite(value):
            raise ValueError(f"{path}, line {line}: {word!r} is not finite; give a number: {what}.")
        values.append(value)
    return values
