"""Catalogues of galaxy shapes, positions of lenses, and shear maps."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxlens.grid import Grid
from jaxlens.io._catalogues import PLACE, positions
from jaxlens.io._maps import read_cube, write_cube
from jaxlens.io._sky import Reference, north
from jaxlens.io._table import Rows, flags, read_table

MAX_SIZE = 1e3
"""An ellipticity beyond this is a mistake (a wrong column, percent), not a noisy galaxy."""

_SHAPES = (("g1", "g2"), ("e1", "e2"))


class ShearTable(NamedTuple):
    """Galaxies with shapes, in the order of the file. Plain NumPy.

    Attributes:
        theta: positions, theta_1 = West, theta_2 = North, `(n, 2)`, arcsec.
        eps: complex ellipticity in that frame, `(n,)`; NaN where unmeasured.
        weight: `(n,)`; 1 where the file has neither `weight` nor `sigma`.
        sigma: error of a component, `(n,)`; NaN where the file has none.
        z, z_lo, z_hi: redshift with 16th and 84th percentile, `(n,)`; NaN where unknown.
        member: whether a member of the cluster, `(n,)` bool.
        use: whether the file itself recommends the galaxy, `(n,)` bool; all, without such a column.
        rows: the table read, for errors about single galaxies.
    """

    theta: np.ndarray
    eps: np.ndarray
    weight: np.ndarray
    sigma: np.ndarray
    z: np.ndarray
    z_lo: np.ndarray
    z_hi: np.ndarray
    member: np.ndarray
    use: np.ndarray
    rows: Rows


def to_frame(eps: np.ndarray, axis: str) -> np.ndarray:
    """Ellipticities in the frame theta_1 = West, theta_2 = North.

    Args:
        eps: e_1 + i e_2, `(n,)`.
        axis: what e_1 > 0 means. `west`: elongated along West, e_2 > 0 from West towards North (this frame).
            `east`: from East towards North, e_2 changes sign. `north`: |e| exp(2 i PA), PA from
            North through East, both change sign.

    Raises:
        ValueError: if there is no such axis.
    """
    if axis not in ("west", "east", "north"):
        raise ValueError(f"`axis` is {axis!r}; choose one of west, east, north.")
    return {"west": eps, "east": np.conj(eps), "north": -eps}[axis]


def read_shear(
    path: str | Path,
    reference: Reference | None = None,
    *,
    axis: str = "west",
    x_axis: str = "west",
    meridian: str = "plane",
    responsivity: float = 1.0,
    rename: Mapping[str, str] | None = None,
) -> ShearTable:
    """A catalogue of galaxy shapes: CSV, ECSV, or the first table of a FITS file.

    Columns: a position `x_arcsec, y_arcsec` or `ra_deg, dec_deg` (x and y win; RA and Dec alone are projected
    gnomonically about the reference point), a shape `g1, g2` or `e1, e2`, and optionally `weight` or
    `sigma`, `z_phot`, `z68_lo`, `z68_hi`, `member` and `use` (1 or 0). A shape may be missing where
    `use` is 0.

    Args:
        path: the file.
        reference: (RA, Dec) of the origin, degrees.
        axis: from which direction the ellipticities count, see `to_frame`.
        x_axis: where `x_arcsec` grows: `west` (the package's frame) or `east`.
        meridian: `plane`: ellipticities refer to the axes of one image, North up at the reference point;
            `local`: each to the meridian of its galaxy, as in survey catalogues. The difference matters
            near a pole; `local` needs RA.
        responsivity: ellipticities are divided by it to give reduced shear.
        rename: for columns that the file calls otherwise, its name by ours, e.g. `{"g1": "e1_corr"}`.

    Raises:
        ValueError: if a cell cannot be used; the message names file, row, column, value and remedy.
    """
    more = ("weight", "sigma", "z_phot", "z68_lo", "z68_hi")
    text = ("member", "use")
    shapes = tuple(name for pair in _SHAPES for name in pair)
    rows = read_table(
        path,
        (),
        (*PLACE, *shapes, *more, *text),
        text=text,
        empty=(*PLACE, *shapes, "z_phot", "z68_lo", "z68_hi", *text),
        rename=rename,
    )
    if x_axis not in ("west", "east"):
        raise ValueError(f"`x_axis` is {x_axis!r}; choose west or east.")
    if not responsivity > 0.0:
        raise ValueError(f"`responsivity` is {responsivity}; give a positive number.")
    if x_axis == "east" and "x_arcsec" in rows:
        rows = rows.replaced("x_arcsec", -rows["x_arcsec"])
    use = flags(rows, "use") if "use" in rows else np.ones(len(rows), bool)
    eps = to_frame(_shape(rows, use), axis) / responsivity
    if meridian == "local":
        eps = eps * np.exp(2j * _turn(rows, reference))
    elif meridian != "plane":
        raise ValueError(f"`meridian` is {meridian!r}; choose plane or local.")
    nothing = np.full(len(rows), np.nan)
    z, lo, hi = (rows.columns.get(name, nothing) for name in ("z_phot", "z68_lo", "z68_hi"))
    if "z_phot" in rows:
        rows.require("z_phot", ~(z < 0.0), "is not a redshift; leave the cell empty where it is not known.")
    return ShearTable(
        theta=positions(rows, reference, said_in="weak.toml"),
        eps=eps,
        weight=_weight(rows),
        sigma=rows.columns.get("sigma", nothing) / responsivity,
        z=z,
        z_lo=lo,
        z_hi=hi,
        member=flags(rows, "member") if "member" in rows else np.zeros(len(rows), bool),
        use=use,
        rows=rows,
    )


def _shape(rows: Rows, use: np.ndarray) -> np.ndarray:
    """The complex ellipticity as the file has it, `(n,)`."""
    pairs = [pair for pair in _SHAPES if pair[0] in rows or pair[1] in rows]
    if not pairs:
        raise ValueError(
            f"{rows.path} has no shapes; give columns `g1` and `g2` (or `e1` and `e2`), or say what they are "
            "called (`columns` under [shear] in weak.toml)."
        )
    if len(pairs) > 1:
        raise ValueError(
            f"{rows.path} has both `g1, g2` and `e1, e2`; drop one pair, or rename it, so that it is clear "
            "which is the shear."
        )
    (pair,) = pairs
    for name, other in (pair, pair[::-1]):
        if name not in rows:
            raise ValueError(f"{rows.path} has a column `{other}` but no `{name}`; add it.")
        bad = use & ~np.isfinite(rows[name])
        rows.require(name, ~bad, "is no shape; give a number, or set `use` to 0 in this row.")
        remedy = f"is no ellipticity (more than {MAX_SIZE:g}); correct the column, or drop the row."
        rows.require(name, ~(np.abs(rows[name]) > MAX_SIZE), remedy)
    return rows[pair[0]] + 1j * rows[pair[1]]


def _turn(rows: Rows, reference: Reference | None) -> np.ndarray:
    """Angle of local North on the tangent plane, `(n,)`, rad."""
    if reference is None or "ra_deg" not in rows:
        raise ValueError(
            f"{rows.path}: ellipticities that refer to local meridians (`meridian` = local) need a column "
            "`ra_deg` and a reference point; add them, or use plane."
        )
    rows.require("ra_deg", np.isfinite(rows["ra_deg"]), "is missing; meridian = local needs it in every row.")
    return north(rows["ra_deg"], reference)


def _weight(rows: Rows) -> np.ndarray:
    if "sigma" in rows:
        good = rows["sigma"] > 0.0 if "weight" not in rows else rows["sigma"] >= 0.0
        rows.require("sigma", good, "is not an error; give a positive number.")
    if "weight" in rows:
        rows.require("weight", rows["weight"] >= 0.0, "is not a weight; give 0 or a positive number.")
        return rows["weight"]
    return np.ones(len(rows))


class Places(NamedTuple):
    """Named positions on the sky.

    Attributes:
        theta: `(n, 2)`, arcsec.
        ids: names.
        z: redshifts, `(n,)`; NaN where unknown.
    """

    theta: np.ndarray
    ids: tuple[str, ...]
    z: np.ndarray


def read_places(path: str | Path, reference: Reference | None = None, *, name: str = "id") -> Places:
    """Positions of lenses, such as X-ray groups: a column `name`, a position, optionally `z`.

    Raises:
        ValueError: if a cell cannot be used; the message names file, row, column, value and remedy.
    """
    rows = read_table(path, (name,), (*PLACE, "z"), text=(name,), empty=(*PLACE, "z"), unique=(name,))
    z = rows.columns.get("z", np.full(len(rows), np.nan))
    return Places(positions(rows, reference, said_in="weak.toml"), tuple(rows[name].tolist()), z)


class ShearFile(NamedTuple):
    """A shear map read from a FITS file; the first three are the fields of `weak.ShearMap` in its order.

    Attributes:
        g: complex reduced shear, `(y, x)`; 0 where the weight is 0.
        weight: `(y, x)`.
        n_gal: galaxies in each pixel, `(y, x)` int; 1 where the weight is positive if the file does not say.
        grid: pixels.
        header: keys of the file that do not describe its arrays.
        reference: (RA, Dec) of theta = 0 in degrees, or None.
    """

    g: np.ndarray
    weight: np.ndarray
    n_gal: np.ndarray
    grid: Grid
    header: dict[str, Any]
    reference: Reference | None


def write_shear_map(
    path: str | Path,
    g: Any,
    weight: Any,
    n_gal: Any,
    grid: Grid,
    *,
    header: Mapping[str, Any] | None = None,
    reference: Reference | None = None,
) -> None:
    """Write a shear map as FITS: images `G1`, `G2`, `WEIGHT`, `N_GAL` with the coordinates of `write_map`.

    Args:
        path: the file; replaced in one step.
        g: complex reduced shear, frame theta_1 = West, `(y, x)`.
        weight: `(y, x)`.
        n_gal: `(y, x)`.
        grid: pixels.
        header: further keys, as for `write_map`.
        reference: (RA, Dec) of theta = 0, degrees.
    """
    layers = {"G1": np.real(g), "G2": np.imag(g), "WEIGHT": weight, "N_GAL": n_gal}
    write_cube(path, layers, grid, header=header, reference=reference)


def read_shear_map(path: str | Path, *, axis: str = "west") -> ShearFile:
    """Read a shear map from a FITS file with images named `G1` and `G2`, and optionally `WEIGHT`, `N_GAL`.

    A pixel whose shear or weight is not finite gets weight 0; without `WEIGHT` all others have 1.

    Args:
        path: the file.
        axis: from which direction the shear counts, see `to_frame`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if images are missing, differ in shape, lie in another frame, hold |g| > 1e3 or a negative
            weight, or no pixel is left.
    """
    cube = read_cube(path, ("G1", "G2"), ("WEIGHT", "N_GAL"))
    g = to_frame(cube.layers["G1"] + 1j * cube.layers["G2"], axis)
    weight = cube.layers.get("WEIGHT", np.ones(g.shape))
    known = np.isfinite(g) & np.isfinite(weight)
    for name, bad, remedy in (
        ("G1, G2", known & (np.abs(g) > MAX_SIZE), f"|g| is more than {MAX_SIZE:g}; set such pixels to NaN"),
        ("WEIGHT", known & (weight < 0.0), "is negative; give 0 or a positive number"),
    ):
        if bad.any():
            row, column = (int(at[0]) for at in np.nonzero(bad))
            value = g[row, column] if name != "WEIGHT" else weight[row, column]
            raise ValueError(f"{path}, image {name}, pixel [{row}, {column}]: {value:g} {remedy}.")
    weight = np.where(known, weight, 0.0)
    if not weight.any():
        raise ValueError(f"{path}: no pixel has both a finite shear and a positive weight; nothing to map.")
    count = np.nan_to_num(cube.layers.get("N_GAL", (weight > 0.0).astype(float))).astype(int)
    return ShearFile(np.where(known, g, 0.0), weight, count, cube.grid, cube.header, cube.reference)
