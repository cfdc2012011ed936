"""Catalogues of multiple images and of cluster members."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlens.io._sky import Reference, offsets
from jaxlens.io._table import Rows, flags, read_table


class ImageTable(NamedTuple):
    """Multiple images, sorted by system. Plain NumPy; the fields of `strong.ImageCatalogue` in its order.

    Attributes:
        theta: positions, `(i, 2)`, arcsec.
        source: index of each image's system, `(i,)`, non-decreasing from 0.
        z_s: redshift of every system, `(s,)`; NaN where it is free.
        sigma_pos: position error per axis, `(i,)`, arcsec.
        systems: names of the systems, in the order of the file.
        image_ids: names of the images.
    """

    theta: np.ndarray
    source: np.ndarray
    z_s: np.ndarray
    sigma_pos: np.ndarray
    systems: tuple[str, ...]
    image_ids: tuple[str, ...]


class MemberTable(NamedTuple):
    """Cluster members. Plain NumPy.

    Attributes:
        theta: positions, `(n, 2)`, arcsec.
        luminosity: L/L_ref, `(n,)`.
        e: ellipticity 1 - b/a of the light, `(n,)`.
        pa: position angle from +theta_1 (West) towards +theta_2 (North), `(n,)`, rad.
        bcg: whether a brightest cluster galaxy, `(n,)` bool.
        ids: names of the galaxies.
        mag: magnitudes, `(n,)`; NaN where the file has none.
    """

    theta: np.ndarray
    luminosity: np.ndarray
    e: np.ndarray
    pa: np.ndarray
    bcg: np.ndarray
    ids: tuple[str, ...]
    mag: np.ndarray


PLACE = ("x_arcsec", "y_arcsec", "ra_deg", "dec_deg")


def positions(rows: Rows, reference: Reference | None, *, said_in: str = "strong.toml") -> np.ndarray:
    """theta `(n, 2)`: x and y where both are given, else RA and Dec projected about the reference point."""
    nothing = np.full(len(rows), np.nan)
    x, y, ra, dec = (rows.columns.get(name, nothing) for name in PLACE)
    for one, two, first, second in ((x, y, *PLACE[:2]), (ra, dec, *PLACE[2:])):
        lonely = np.flatnonzero(np.isfinite(one) != np.isfinite(two))
        if lonely.size:
            row = int(lonely[0])
            there, gone = (first, second) if np.isfinite(one[row]) else (second, first)
            rows.fail(row, there, f"stands alone; give `{gone}` as well, or neither.")
    theta = np.stack([x, y], axis=1)
    project = ~np.isfinite(x)
    nowhere = np.flatnonzero(project & ~np.isfinite(ra))
    if nowhere.size:
        raise ValueError(
            f"{rows.where(int(nowhere[0]))}: no position; "
            "give `x_arcsec` and `y_arcsec`, or `ra_deg` and `dec_deg`."
        )
    if not project.any():
        return theta
    if reference is None:
        raise ValueError(
            f"{rows.where(int(np.flatnonzero(project)[0]))}: RA and Dec but no x and y, and no "
            "reference point to project them about. Give the reference point (`ra_deg` and `dec_deg` in "
            f"{said_in}), or columns `x_arcsec` and `y_arcsec`."
        )
    rows.require("dec_deg", ~(np.abs(dec) > 90.0), "is not a declination; give degrees between -90 and 90.")
    theta[project] = offsets(ra[project], dec[project], reference)
    far = project & ~(np.hypot(theta[:, 0], theta[:, 1]) < 3600.0)
    if far.any():
        rows.fail(
            int(np.flatnonzero(far)[0]),
            "ra_deg",
            f"is more than a degree from the reference point {reference}; are RA and Dec in degrees?",
        )
    return theta


def read_images(
    path: str | Path,
    reference: Reference | None = None,
    default_sigma: float | None = None,
    *,
    exclude: Sequence[str] = (),
    z_l: float | None = None,
) -> ImageTable:
    """A catalogue of multiple images.

    Columns `system, image_id`, a position `x_arcsec, y_arcsec` or `ra_deg, dec_deg`, and optionally
    `sigma_arcsec` (position error per axis) and `z_spec` (empty: the redshift of the system is free).
    Where x and y are given they win; RA and Dec alone are projected gnomonically about the
    reference point, x towards West. An image without a redshift shares that of its system.

    Args:
        path: CSV or ECSV file.
        reference: (RA, Dec) of the origin, degrees.
        default_sigma: position error of images without one, arcsec.
        exclude: names of systems to leave out.
        z_l: redshift of the lens; sources must lie behind it.

    Returns:
        The images, sorted by system in the order in which systems first appear.

    Raises:
        ValueError: if a cell cannot be used, redshifts within a system disagree, or a system has a
            single image; the message names file, line, column, value and remedy.
    """
    rows = read_table(
        path,
        ("system", "image_id"),
        (*PLACE, "sigma_arcsec", "z_spec"),
        text=("system", "image_id"),
        empty=(*PLACE, "sigma_arcsec", "z_spec"),
        unique=("image_id",),
    )
    theta = positions(rows, reference)
    nothing = np.full(len(rows), np.nan)
    sigma = rows.columns.get("sigma_arcsec", nothing)
    without = np.flatnonzero(~np.isfinite(sigma))
    if without.size and default_sigma is None:
        row = int(without[0])
        raise ValueError(
            f"{rows.path}, line {rows.lines[row]}: image {str(rows['image_id'][row])!r} has no position "
            "error; fill the column `sigma_arcsec`, or set `sigma_arcsec` under [images] in strong.toml."
        )
    if "sigma_arcsec" in rows:
        rows.require("sigma_arcsec", ~(sigma <= 0.0), "is not an error; give a positive number in arcsec.")
    sigma = np.where(np.isfinite(sigma), sigma, np.nan if default_sigma is None else default_sigma)
    z = rows.columns.get("z_spec", nothing)
    if "z_spec" in rows:
        rows.require("z_spec", ~(z <= 0.0), "is not a redshift; leave the cell empty where it is not known.")
        if z_l is not None:
            rows.require(
                "z_spec",
                ~(z <= z_l),
                f"is not behind the lens (z = {z_l}); correct it, or exclude the system.",
            )
    systems = _systems(rows, exclude)
    members = [np.flatnonzero(rows["system"] == name) for name in systems]
    z_s = np.array(
        [_one_redshift(rows, name, index, z) for name, index in zip(systems, members, strict=True)]
    )
    for name, index in zip(systems, members, strict=True):
        _check_system(rows, name, index, theta)
    order = np.concatenate(members)
    return ImageTable(
        theta=theta[order],
        source=np.repeat(np.arange(len(systems)), [len(index) for index in members]),
        z_s=z_s,
        sigma_pos=sigma[order],
        systems=tuple(systems),
        image_ids=tuple(rows["image_id"][order].tolist()),
    )


def _systems(rows: Rows, exclude: Sequence[str]) -> list[str]:
    found = list(dict.fromkeys(rows["system"].tolist()))
    unknown = [name for name in exclude if name not in found]
    if unknown:
        raise ValueError(
            f"{rows.path} has no system {unknown[0]!r} to exclude; it has {', '.join(found)}. Correct "
            "`exclude`."
        )
    kept = [name for name in found if name not in exclude]
    if not kept:
        raise ValueError(f"{rows.path}: `exclude` leaves no system; keep at least one of {', '.join(found)}.")
    return kept


def _one_redshift(rows: Rows, name: str, index: np.ndarray, z: np.ndarray) -> float:
    known = index[np.isfinite(z[index])]
    if not known.size:
        return np.nan
    differ = known[np.abs(z[known] - z[known[0]]) > 1e-6]
    if differ.size:
        rows.fail(
            int(differ[0]),
            "z_spec",
            f"disagrees with {z[known[0]]:g} on line {rows.lines[known[0]]}, but both are images of system "
            f"{name!r}; give one redshift, or split the system.",
        )
    return float(z[known[0]])


def _check_system(rows: Rows, name: str, index: np.ndarray, theta: np.ndarray) -> None:
    if len(index) == 1:
        rows.fail(
            int(index[0]),
            "system",
            "has this single image, which constrains nothing; drop the row, add its counter-images, or "
            "exclude the system (`exclude` under [images] in strong.toml).",
        )
    for place, row in enumerate(index):
        same = [other for other in index[:place] if np.array_equal(theta[other], theta[row])]
        if same:
            rows.fail(
                int(row),
                "image_id",
                f"is at the position of the image on line {rows.lines[same[0]]} of the same system "
                f"{name!r}; drop one.",
            )


def read_members(
    path: str | Path, *, reference: Reference | None = None, mag_ref: float | None = None
) -> MemberTable:
    """A catalogue of cluster members.

    Columns `member_id`, a position `x_arcsec, y_arcsec` or `ra_deg, dec_deg` (as in `read_images`),
    `luminosity` (L/L_ref) or `mag`, and optionally `e` (1 - b/a) or `a_arcsec, b_arcsec`, `theta_deg` (angle
    from West through North) and `bcg` (1 or 0). Where both are given, `luminosity` wins over `mag`, and
    `e` over the axes. From magnitudes, L/L_ref = 10^(-0.4 (mag - mag_ref)).

    Args:
        path: CSV or ECSV file.
        reference: (RA, Dec) of the origin, degrees.
        mag_ref: magnitude of the reference galaxy; needed when the file has no `luminosity`.

    Returns:
        The members in the order of the file.

    Raises:
        ValueError: if a cell cannot be used; the message names file, line, column, value and remedy.
    """
    shape = ("e", "a_arcsec", "b_arcsec", "theta_deg")
    rows = read_table(
        path,
        ("member_id",),
        (*PLACE, "luminosity", "mag", *shape, "bcg"),
        text=("member_id", "bcg"),
        empty=(*PLACE, "bcg"),
        unique=("member_id",),
    )
    e = _ellipticity(rows)
    if "theta_deg" not in rows and np.any(e > 0.0):
        raise ValueError(
            f"{rows.path} gives its galaxies shapes but no column `theta_deg`; add it (degrees from West "
            "through North)."
        )
    return MemberTable(
        theta=positions(rows, reference),
        luminosity=_luminosity(rows, mag_ref),
        e=e,
        pa=np.deg2rad(rows["theta_deg"]) if "theta_deg" in rows else np.zeros(len(rows)),
        bcg=flags(rows, "bcg") if "bcg" in rows else np.zeros(len(rows), bool),
        ids=tuple(rows["member_id"].tolist()),
        mag=rows.columns.get("mag", np.full(len(rows), np.nan)),
    )


def _luminosity(rows: Rows, mag_ref: float | None) -> np.ndarray:
    if "luminosity" in rows:
        rows.require("luminosity", rows["luminosity"] > 0.0, "is not a luminosity; give L/L_ref > 0.")
        return rows["luminosity"]
    if "mag" not in rows:
        raise ValueError(
            f"{rows.path} has neither a column `luminosity` (L/L_ref) nor `mag`; add one of them."
        )
    if mag_ref is None:
        raise ValueError(
            f"{rows.path} has magnitudes, so the magnitude of the reference galaxy is needed: set `mag_ref` "
            "under [members] in strong.toml, or give a column `luminosity` (L/L_ref)."
        )
    return 10.0 ** (-0.4 * (rows["mag"] - mag_ref))


def _ellipticity(rows: Rows) -> np.ndarray:
    if "e" in rows:
        good = (rows["e"] >= 0.0) & (rows["e"] < 1.0)
        rows.require("e", good, "is not an ellipticity; give 1 - b/a, at least 0 and below 1.")
        return rows["e"]
    given = [name for name in ("a_arcsec", "b_arcsec") if name in rows]
    if not given:
        return np.zeros(len(rows))
    if len(given) == 1:
        raise ValueError(
            f"{rows.path} has a column `{given[0]}` alone; an ellipse needs `a_arcsec` and `b_arcsec`."
        )
    a, b = rows["a_arcsec"], rows["b_arcsec"]
    rows.require("b_arcsec", b > 0.0, "is not an axis; give a positive number in arcsec.")
    rows.require("a_arcsec", a >= b, "is smaller than `b_arcsec`; exchange them and turn `theta_deg` by 90.")
    return 1.0 - b / a
