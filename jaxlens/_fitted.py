"""A fitted lens as its files say it, and positions on its sky."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxlens import io
from jaxlens.cosmology import LensPlane
from jaxlens.io import Reference
from jaxlens.lens import Lens
from jaxlens.posterior import MODEL, POSTERIOR, read_posterior, read_quality


@dataclass(frozen=True)
class Model:
    """What a `model.toml`, or the result directory that holds it, says.

    Attributes:
        path: the file.
        lens, plane: of the file.
        reference: (RA, Dec) of the origin in degrees, or None.
        draws: the draws beside it, or None.
        warning: what a user of these draws must know, or None.
    """

    path: Path
    lens: Lens
    plane: LensPlane
    reference: Reference | None
    draws: Lens | None
    warning: str | None = None


def load(source: str | Path) -> Model:
    """Read a `model.toml`, or a result directory with its posterior.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming file, key, value and remedy.
    """
    path = Path(source)
    if path.is_dir():
        path = path / MODEL
        if not path.exists():
            raise FileNotFoundError(
                f"{source} holds no {MODEL}; give a result directory of `jaxlens strong`, or a {MODEL}."
            )
    lens, plane = io.read_lens(path)
    posterior = path.with_name(POSTERIOR)
    reference = io.read_lens_reference(path)
    if path.name != MODEL or not posterior.exists():
        return Model(path, lens, plane, reference, None)
    draws, quality = read_posterior(posterior, lens), read_quality(posterior)
    return Model(path, lens, plane, reference, draws, quality.warning if quality else None)


def position(
    model: Model, *, x: float | None, y: float | None, ra: float | None, dec: float | None
) -> np.ndarray:
    """The position `(2,)` in arcsec from x and y, or from RA and Dec in degrees.

    Raises:
        ValueError: unless exactly one pair is given, or if RA and Dec cannot be used.
    """
    if (x is None) != (y is None) or (ra is None) != (dec is None) or (x is None) == (ra is None):
        raise ValueError("Give the position once: --x and --y in arcsec, or --ra and --dec in degrees.")
    if x is not None and y is not None:
        return np.array([x, y])
    assert ra is not None and dec is not None
    if model.reference is None:
        raise ValueError(
            f"{model.path} has no reference point (keys ra_deg, dec_deg), about which RA and Dec would be "
            "projected; give --x and --y in arcsec."
        )
    theta = io.offsets(np.array([ra]), np.array([dec]), model.reference)[0]
    if not np.hypot(*theta) < 3600.0:
        raise ValueError(
            f"--ra {ra} --dec {dec} is more than a degree from the reference point {model.reference}; "
            "are they in degrees?"
        )
    return theta
