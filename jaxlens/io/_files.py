"""Writing files so that nobody ever reads half of one."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def _beside(path: Path) -> Path:
    """An unused hidden name in the same directory with the same suffix (writers choose formats by suffix)."""
    return path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to; on leaving, it takes the name `path` in one step.

    After an error or an interrupt the temporary file is gone and whatever was at `path` is as it was.
    Missing directories are made.

    Raises:
        IsADirectoryError: if `path` is a directory.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a directory; give the name of a file in it.")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _beside(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def writable(directory: str | Path) -> None:
    """Make sure that results can be written to `directory` before the work that makes them begins.

    Raises:
        NotADirectoryError: if it, or a part of its path, is a file.
        PermissionError: if nothing may be written there.
    """
    directory = Path(directory).absolute()
    nearest = next(place for place in (directory, *directory.parents) if place.exists())
    if not nearest.is_dir():
        raise NotADirectoryError(f"{nearest} is a file; give the name of a directory for the results.")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise PermissionError(f"{nearest} may not be written to; give another directory for the results.")


class Staging:
    """Where the files of one result are written before any of them appears.

    Attributes:
        path: the temporary directory.
        written: names of the files that were moved to their place, relative; empty until then.
        untouched: names of the files that were there before and are not part of this result.
    """

    def __init__(self, path: Path):
        self.path = path
        self.written: tuple[str, ...] = ()
        self.untouched: tuple[str, ...] = ()

    def __truediv__(self, name: str) -> Path:
        return self.path / name


def _files(directory: Path) -> set[str]:
    return {item.relative_to(directory).as_posix() for item in directory.rglob("*") if item.is_file()}


@contextmanager
def staging(directory: str | Path) -> Iterator[Staging]:
    """A directory to write a whole result to; on leaving, its files move to `directory`.

    Each file replaces the one of its name in one step. Files of other names stay where they are and are
    listed in `untouched`, so that a command can say that they belong to something else. After an
    error or an interrupt while they are made nothing has moved, and the temporary directory is gone.

    Example:
        `with staging("results/a") as stage: write_json(stage / "summary.json", summary)`

    Raises:
        NotADirectoryError: if `directory` is a file.
    """
    directory = Path(directory)
    if directory.exists() and not directory.is_dir():
        raise NotADirectoryError(f"{directory} is a file; give the name of a directory for the results.")
    made = [parent for parent in (directory, *directory.parents) if not parent.exists()]
    directory.mkdir(parents=True, exist_ok=True)
    stage = Staging(_beside(directory / "staging"))
    stage.path.mkdir()
    done = False
    try:
        yield stage
        new = sorted(_files(stage.path))
        hidden = f"{stage.path.name}/"
        stage.untouched = tuple(sorted(f for f in _files(directory) - set(new) if not f.startswith(hidden)))
        for name in new:
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(stage.path / name, directory / name)
        stage.written = tuple(new)
        done = True
    finally:
        shutil.rmtree(stage.path, ignore_errors=True)
        if not done:
            for parent in made:
                if parent.is_dir() and not any(parent.iterdir()):
                    parent.rmdir()
