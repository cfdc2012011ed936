"""Opening FITS files so that a broken one is an error that names it."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning


@contextmanager
def hdus_of(path: Path) -> Iterator[list[Any]]:
    """The header and data units of a file, while it is open: values must be copied inside.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no FITS file, or ends before its header says.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"{path} does not exist; check the name and the directory it is given relative to."
        )
    try:
        with warnings.catch_warnings():
            # A file that ends too early is a warning in astropy, and then an array of anything.
            warnings.filterwarnings("error", message=".*truncated", category=AstropyUserWarning)
            # Opened here: astropy leaves the file open when it fails.
            with path.open("rb") as handle, fits.open(handle, memmap=False) as file:
                yield list(file)
    except (OSError, TypeError, AstropyUserWarning) as error:
        raise ValueError(f"{path} is not a whole FITS file ({error}); write or copy it again.") from error
