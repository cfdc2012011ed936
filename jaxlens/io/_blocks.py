"""Finished blocks of a long computation on disk, so that it can be killed and resumed."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens.io._files import atomic


class BlockFiles:
    """One NPZ file for each finished block: the `checkpoint` of `monte_carlo.lambda_profiles`.

    Each file appears in one step and carries the fingerprint of its computation: after `kill -9` every block
    on disk is whole, and blocks of another computation are refused.

    Args:
        directory: for the files; made when the first one is written.
        fingerprint: name of the computation, see `monte_carlo.fingerprint`.
    """

    def __init__(self, directory: str | Path, fingerprint: str):
        self.directory = Path(directory)
        self.fingerprint = fingerprint

    def path(self, block: int) -> Path:
        """File of a block."""
        return self.directory / f"block_{block:05d}.npz"

    def load(self, block: int) -> dict[str, np.ndarray] | None:
        """The arrays of a block, or None if there is none yet.

        Raises:
            ValueError: if the file is not one of ours, or belongs to another computation.
        """
        path = self.path(block)
        if not path.exists():
            return None
        try:
            # Opened here: NumPy leaves the file open when it fails.
            with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{path} cannot be read ({error}); delete it, and it is computed again."
            ) from error
        found = str(arrays.pop("fingerprint", ""))
        if found != self.fingerprint:
            raise ValueError(
                f"{path} belongs to another computation (other key, maps, settings or versions): "
                f"{found[:12] or 'no fingerprint'} instead of {self.fingerprint[:12]}. Give another "
                "directory, or delete it."
            )
        return arrays

    def save(self, block: int, arrays: dict[str, np.ndarray]) -> None:
        """Write the arrays of a block, whole or not at all."""
        content: dict[str, Any] = {"fingerprint": np.array(self.fingerprint), **arrays}
        with atomic(self.path(block)) as temporary, temporary.open("wb") as file:
            np.savez(file, **content)
