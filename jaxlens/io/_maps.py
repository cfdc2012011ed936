"""Maps on disk: FITS images with a world coordinate system."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits

from jaxlens.grid import Grid
from jaxlens.io._files import atomic
from jaxlens.io._fits import hdus_of
from jaxlens.io._sky import Reference

_GEOMETRY = ("PIXEL", "CENTRE1", "CENTRE2")
_OWN = {"WCSAXES", *_GEOMETRY}
_OWN |= {
    f"{key}{axis}" for key in ("CTYPE", "CUNIT", "CRPIX", "CRVAL", "CDELT", "CNAME") for axis in (1, 2, 3)
}
_OWN |= {"RADESYS", "EQUINOX"}
_STRUCTURE = {
    "SIMPLE",
    "BITPIX",
    "NAXIS",
    "NAXIS1",
    "NAXIS2",
    "NAXIS3",
    "EXTEND",
    "XTENSION",
    "PCOUNT",
    "GCOUNT",
}


class MapFile(NamedTuple):
    """A map read from a FITS file.

    Attributes:
        values: the map, `(y, x)`, `[row = theta_2, column = theta_1]`, float64.
        grid: its grid.
        header: all keys but those that say how the array is stored and where it lies.
        reference: (RA, Dec) of theta = 0 in degrees, or None.
    """

    values: np.ndarray
    grid: Grid
    header: dict[str, Any]
    reference: Reference | None


def write_map(
    path: str | Path,
    values: Any,
    grid: Grid,
    *,
    header: Mapping[str, Any] | None = None,
    reference: Reference | None = None,
    dtype: str = "float64",
) -> None:
    """Write a map as the primary image of a FITS file.

    Columns increase towards West and rows towards North. With a reference point the coordinates are
    RA and Dec (gnomonic, CDELT1 < 0); without one they are the offsets theta_1, theta_2 in arcsec
    (linear). `PIXEL`, `CENTRE1` and `CENTRE2` hold the grid itself, in arcsec.

    Args:
        path: the file; replaced in one step.
        values: the map, `(y, x)`, or a stack of maps, `(n, y, x)`, whose third axis counts from 1 (`CTYPE3`
            is `LAYER`); NaN and infinity are kept.
        grid: its grid.
        header: further keys of at most 8 characters, e.g. `BUNIT`, `ZLENS`, `ZSOURCE`, `DLSDS`; a value, or
            a pair (value, comment). NumPy and JAX scalars are accepted; None leaves the value undefined.
        reference: (RA, Dec) of theta = 0, degrees.
        dtype: `"float64"` or `"float32"`.

    Raises:
        ValueError: if shapes disagree, or a header key is one that describes the array itself, is too long,
            or has a value that FITS cannot hold.
    """
    array = np.asarray(values)
    if array.ndim not in (2, 3) or array.shape[-2:] != grid.shape:
        raise ValueError(
            f"`values` has shape {array.shape} but `grid.shape` is {grid.shape}; give the map's own grid."
        )
    if dtype not in ("float64", "float32"):
        raise ValueError(f"`dtype` is {dtype!r}; use 'float64' or 'float32'.")
    hdu = fits.PrimaryHDU(array.astype(dtype))
    hdu.header.extend(_wcs(grid, reference))
    if array.ndim == 3:
        hdu.header.update({"WCSAXES": 3, "CTYPE3": "LAYER", "CRPIX3": 1.0, "CRVAL3": 1.0, "CDELT3": 1.0})
    for key, value in (header or {}).items():
        hdu.header[_key(key)] = _card_value(key, value)
    with atomic(path) as temporary:
        hdu.writeto(temporary)


def _wcs(grid: Grid, reference: Reference | None) -> list[tuple[str, Any, str]]:
    n_y, n_x = grid.shape
    crpix = [0.5 * (n + 1) - c / grid.pixel for n, c in zip((n_x, n_y), grid.centre, strict=True)]
    if reference is None:
        kinds, unit, at, step = ("THETA1", "THETA2"), "arcsec", (0.0, 0.0), (grid.pixel, grid.pixel)
    else:
        kinds, unit, at = ("RA---TAN", "DEC--TAN"), "deg", reference
        step = (-grid.pixel / 3600.0, grid.pixel / 3600.0)
    cards: list[tuple[str, Any, str]] = [("WCSAXES", 2, "")]
    for axis in (0, 1):
        towards = ("West", "North")[axis] if reference is None else ("RA", "Dec")[axis]
        cards += [
            (f"CTYPE{axis + 1}", kinds[axis], ""),
            (f"CUNIT{axis + 1}", unit, ""),
            (f"CRPIX{axis + 1}", crpix[axis], f"pixel of theta_{axis + 1} = 0"),
            (f"CRVAL{axis + 1}", at[axis], towards),
            (
                f"CDELT{axis + 1}",
                step[axis],
                "columns increase to the West" if axis == 0 else "rows increase to the North",
            ),
        ]
    if reference is not None:
        cards += [("RADESYS", "FK5", ""), ("EQUINOX", 2000.0, "")]
    return [
        *cards,
        ("PIXEL", grid.pixel, "[arcsec] side of a pixel"),
        ("CENTRE1", grid.centre[0], "[arcsec] theta_1 (West) of the map's centre"),
        ("CENTRE2", grid.centre[1], "[arcsec] theta_2 (North) of the map's centre"),
    ]


def _key(key: str) -> str:
    upper = key.upper()
    if upper in _OWN | _STRUCTURE:
        raise ValueError(
            f"Header key {key!r} describes the array or its coordinates; it follows from `grid`."
        )
    if not 1 <= len(key) <= 8 or not all(c.isascii() and (c.isalnum() or c in "-_") for c in key):
        raise ValueError(f"Header key {key!r} is not one of FITS; use at most 8 letters, digits, - and _.")
    return upper


def _card_value(key: str, value: Any) -> Any:
    comment = ""
    if isinstance(value, tuple) and len(value) == 2:
        value, comment = value
    if hasattr(value, "item"):
        value = np.asarray(value).item()
    if isinstance(value, float) and not np.isfinite(value):
        raise ValueError(
            f"Header key {key!r} has the value {value}; FITS headers hold finite numbers, text or None."
        )
    if value is not None and not isinstance(value, bool | int | float | str):
        raise ValueError(f"Header key {key!r} holds a {type(value).__name__}; give a number, text or None.")
    return (value, comment)


def read_map(path: str | Path) -> MapFile:
    """Read the first two-dimensional image of a FITS file.

    The grid comes from the keys of `write_map` if they are there, else from the coordinate system: square
    pixels, North up, columns increasing to the West; theta = 0 is the reference point.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds no image, or the coordinates are not of that kind.
    """
    path = Path(path)
    (_, header, values), *_ = _images(path)
    return MapFile(values, _grid(path, header, values.shape), _kept(header), _reference(header))


def _images(path: Path) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    """Name, header and values of every two-dimensional image of a file; at least one."""
    with hdus_of(path) as hdus:
        images = [
            (str(hdu.name), _plain_values(hdu.header), np.array(hdu.data, dtype=np.float64))
            for hdu in hdus
            if hdu.is_image and hdu.data is not None and hdu.data.ndim == 2
        ]
    if not images:
        raise ValueError(f"{path} holds no two-dimensional image; give a FITS map.")
    return images


def _kept(header: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in header.items() if key not in _OWN | _STRUCTURE | {"EXTNAME"}}


class CubeFile(NamedTuple):
    """Maps of one grid, read from one file.

    Attributes:
        layers: by name, each `(y, x)`, float64.
        grid: their grid.
        header: all keys of the first but those that say how the array is stored and where it lies.
        reference: (RA, Dec) of theta = 0 in degrees, or None.
    """

    layers: dict[str, np.ndarray]
    grid: Grid
    header: dict[str, Any]
    reference: Reference | None


def write_cube(
    path: str | Path,
    layers: Mapping[str, Any],
    grid: Grid,
    *,
    header: Mapping[str, Any] | None = None,
    reference: Reference | None = None,
) -> None:
    """Write maps of one grid as named image extensions of a FITS file, each as `write_map` would.

    Args:
        path: the file; replaced in one step.
        layers: maps by name (capitals), each `(y, x)`; integers stay integers.
        grid: their grid.
        header: further keys of every extension, see `write_map`.
        reference: (RA, Dec) of theta = 0, degrees.

    Raises:
        ValueError: as for `write_map`.
    """
    hdus: list[Any] = [fits.PrimaryHDU()]
    for name, values in layers.items():
        array = np.asarray(values)
        if array.shape != grid.shape:
            raise ValueError(
                f"`{name}` has shape {array.shape} but `grid.shape` is {grid.shape}; give the map's own grid."
            )
        hdu = fits.ImageHDU(array.astype("int32" if array.dtype.kind in "iu" else "float64"), name=name)
        hdu.header.extend(_wcs(grid, reference))
        for key, value in (header or {}).items():
            hdu.header[_key(key)] = _card_value(key, value)
        hdus.append(hdu)
    with atomic(path) as temporary:
        fits.HDUList(hdus).writeto(temporary)


def read_cube(path: str | Path, required: Sequence[str], optional: Sequence[str] = ()) -> CubeFile:
    """Read named images of one FITS file, all on the grid of the first; see `read_map`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if an image is missing, shapes differ, or the coordinates cannot be used.
    """
    path = Path(path)
    found = {name: (header, values) for name, header, values in _images(path)}
    missing = [name for name in required if name not in found]
    if missing:
        raise ValueError(
            f"{path} has no image {', '.join(missing)}; it has {', '.join(found)}. Name the extensions "
            f"(EXTNAME) {', '.join(required)}."
        )
    layers = {name: found[name][1] for name in (*required, *optional) if name in found}
    header, first = found[required[0]]
    for name, values in layers.items():
        if values.shape != first.shape:
            raise ValueError(
                f"{path}: image {name} has shape {values.shape} but {required[0]} {first.shape}; they must "
                "lie on one grid."
            )
    return CubeFile(layers, _grid(path, header, first.shape), _kept(header), _reference(header))


def _plain_values(header: fits.Header) -> dict[str, Any]:
    """The keys with a value, as plain Python; comments and history are left out."""
    values: dict[str, Any] = {key: header[key] for key in header if key not in ("COMMENT", "HISTORY", "")}
    return {key: None if isinstance(value, fits.card.Undefined) else value for key, value in values.items()}


def _reference(header: dict[str, Any]) -> Reference | None:
    if str(header.get("CTYPE1", "")).startswith("RA---TAN"):
        return float(header["CRVAL1"]), float(header["CRVAL2"])
    return None


def _grid(path: Path, header: dict[str, Any], shape: tuple[int, ...]) -> Grid:
    if all(key in header for key in _GEOMETRY):
        pixel, *centre = (float(header[key]) for key in _GEOMETRY)
        return Grid((shape[0], shape[1]), pixel, (centre[0], centre[1]))
    where = f"{path} has no keys {', '.join(_GEOMETRY)}, and its"
    if not str(header.get("CTYPE1", "")).startswith("RA---TAN"):
        raise ValueError(f"{where} CTYPE1 is {header.get('CTYPE1')!r}; a gnomonic map (RA---TAN) is needed.")
    turned = [
        key for key in ("PC1_2", "PC2_1", "CD1_2", "CD2_1", "CROTA2") if abs(header.get(key, 0.0)) > 1e-12
    ]
    if turned:
        raise ValueError(
            f"{where} axes are turned ({turned[0]} = {header[turned[0]]}); rotate it to North up first."
        )
    step = [
        float(header.get(f"CD{i}_{i}", header.get(f"CDELT{i}", 0.0) * header.get(f"PC{i}_{i}", 1.0)))
        for i in (1, 2)
    ]
    if not (step[0] < 0.0 < step[1]) or abs(step[0] + step[1]) > 1e-6 * step[1]:
        raise ValueError(
            f"{where} pixels are {step} deg; square ones with columns increasing to the West are needed."
        )
    pixel = 3600.0 * step[1]
    centre = [pixel * (0.5 * (n + 1) - float(header[f"CRPIX{i}"])) for i, n in ((1, shape[1]), (2, shape[0]))]
    return Grid((shape[0], shape[1]), pixel, (centre[0], centre[1]))
