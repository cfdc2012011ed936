"""Two convergence maps of one cluster brought to one source redshift, grid and resolution."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from jaxlens import io, weak
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.grid import Grid, onto
from jaxlens.transition import STAY


@dataclass(frozen=True)
class Options:
    """How to compare; a number that is None comes from the header of the map.

    Attributes:
        z_lens: redshift of the lens (`ZLENS`).
        z_wl, z_sl, z_truth: source redshift of each map (`ZSOURCE`).
        dls_ds_wl, dls_ds_sl, dls_ds_truth: D_LS/D_S of each map (`DLSDS`); goes before the redshift.
        smoothing_wl, smoothing_sl, smoothing_truth: standard deviation of the Gaussian by which each map was
            smoothed, arcsec (`SMOOTHAS`); 0 if it was not.
        h, omega_m: flat cosmology.
        x, y: centre of the annuli in the frame of the weak-lensing map, arcsec.
        width, r_min, r_max: annuli, kpc/h.
        inner: range whose lambda corrects the map, kpc/h.
        sheet: annuli that say what the mass sheet is when a transition is looked for, "all" or "inner".
        stay: annuli in which the ratio of variances must stay above 1, see `transition.excess_variance`.
        lam, lam_error: external mass-sheet factor and its error; both or neither.
        bootstrap: samples of block and sector bootstrap.
        seed: of both.
    """

    z_lens: float | None = None
    z_wl: float | None = None
    z_sl: float | None = None
    z_truth: float | None = None
    dls_ds_wl: float | None = None
    dls_ds_sl: float | None = None
    dls_ds_truth: float | None = None
    smoothing_wl: float | None = None
    smoothing_sl: float | None = None
    smoothing_truth: float | None = None
    h: float = 0.7
    omega_m: float = 0.3
    x: float = 0.0
    y: float = 0.0
    width: float = 50.0
    r_min: float = 50.0
    r_max: float = 700.0
    inner: tuple[float, float] = (100.0, 300.0)
    sheet: Literal["all", "inner"] = "all"
    stay: int = STAY
    lam: float | None = None
    lam_error: float | None = None
    bootstrap: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        for name, good, remedy in (
            ("h", self.h > 0.0, "give a positive number, 0.7"),
            ("width", self.width > 0.0, "give a positive width in kpc/h"),
            ("r-max", self.r_max > self.r_min >= 0.0, "give 0 <= --r-min < --r-max in kpc/h"),
            ("bootstrap", self.bootstrap >= 20, "give at least 20"),
            ("inner", 0.0 <= self.inner[0] < self.inner[1], "give two increasing radii in kpc/h"),
        ):
            if not good:
                raise ValueError(f"--{name} is {getattr(self, name.replace('-', '_'))}; {remedy}.")
        if (self.lam is None) != (self.lam_error is None):
            raise ValueError("--lambda and --lambda-error belong together; give both or neither.")
        if self.lam is not None and self.lam_error is not None and not (self.lam > 0.0 < self.lam_error):
            raise ValueError(f"--lambda is {self.lam} +- {self.lam_error}; give positive numbers.")


@dataclass(frozen=True)
class Pair:
    """Both maps for the sources of the weak-lensing map, on its grid and at its resolution.

    Attributes:
        name: for titles.
        kappa_wl, kappa_sl: `(y, x)`.
        kappa_true: `(y, x)`, or None.
        sigma: standard deviation of the noise of kappa_wl, `(y, x)`, or None.
        weight: 0 where one of them is not known, `(y, x)`.
        grid: pixels of the weak-lensing map.
        plane: the lens plane.
        reference: (RA, Dec) of theta = 0, degrees, or None.
        smoothing: of all maps, arcsec.
        dls_ds: D_LS/D_S of all maps.
        scale_sl: by which kappa_sl was multiplied for that.
        header: ZLENS, ZSOURCE, DLSDS, SMOOTHAS of results.
    """

    name: str
    kappa_wl: np.ndarray
    kappa_sl: np.ndarray
    kappa_true: np.ndarray | None
    sigma: np.ndarray | None
    weight: np.ndarray
    grid: Grid
    plane: LensPlane
    reference: io.Reference | None
    smoothing: float
    dls_ds: float
    scale_sl: float
    header: dict[str, Any]


def load(
    wl: str | Path,
    sl: str | Path,
    options: Options,
    *,
    truth: str | Path | None = None,
    mask: str | Path | None = None,
    sigma: str | Path | None = None,
    snr: str | Path | None = None,
) -> Pair:
    """Read maps and bring them to one source redshift, grid and resolution.

    kappa is proportional to D_LS/D_S, grids are matched by area-weighted means (axes must be parallel), and
    resolution by smoothing the strong-lensing map by what the weak-lensing map was smoothed more.

    Args:
        wl, sl: convergence maps (FITS). Pixels of `wl` that are not finite are masked.
        options: numbers that headers lack, or that go before them.
        truth: true convergence (simulations).
        mask: pixels of value 0 are not used, on the grid of `wl`.
        sigma: noise of `wl`, on its grid.
        snr: signal to noise instead, as `jaxlens weak` writes it; 0 in masked pixels.

    Raises:
        ValueError, FileNotFoundError: naming file and remedy.
    """
    if sigma is not None and snr is not None:
        raise ValueError(f"--sigma {sigma} and --snr {snr} say the same; give one of them.")
    base = io.read_map(wl)
    z_lens = _number(options.z_lens, base.header, "ZLENS", wl, "--z-lens")
    if not z_lens > 0.0:
        raise ValueError(f"{wl}: the lens is at redshift {z_lens}; give a positive one with --z-lens.")
    plane = LensPlane.at(z_lens, FlatLCDM(h=options.h, omega_m=options.omega_m))
    smoothing = _number(options.smoothing_wl, base.header, "SMOOTHAS", wl, "--smoothing-wl")
    ratio = _ratio(options.dls_ds_wl, options.z_wl, base.header, plane, wl, "wl")
    known = np.isfinite(base.values)
    for name, path in (("mask", mask), ("snr", snr), ("sigma", sigma)):
        if path is not None:
            _same_grid(name, path, wl, base)
    noise = None
    if snr is not None:
        values = io.read_map(snr).values
        known &= np.isfinite(values) & (values != 0.0)
        noise = np.abs(np.where(known, base.values, 0.0) / np.where(known, values, 1.0))
    if sigma is not None:
        noise = io.read_map(sigma).values
        known &= np.isfinite(noise) & (noise > 0.0)
        noise = np.where(known, noise, 0.0)
    if mask is not None:
        values = io.read_map(mask).values
        known &= np.isfinite(values) & (values > 0.0)

    def matched(path: str | Path, kind: str) -> tuple[np.ndarray, np.ndarray, float]:
        file = io.read_map(path)
        if not np.isfinite(file.values).all():
            row, column = np.argwhere(~np.isfinite(file.values))[0]
            raise ValueError(
                f"{path} is {file.values[row, column]} at row {row}, column {column}; give a map that is "
                "finite everywhere, smoothing would spread it."
            )
        if "ZLENS" in file.header and options.z_lens is None:
            other = float(file.header["ZLENS"])
            if abs(other - z_lens) > 1e-3:
                raise ValueError(
                    f"{path} has ZLENS = {other}, {wl} {z_lens}; give maps of one lens, or --z-lens."
                )
        said = getattr(options, f"smoothing_{kind}")
        own = (
            0.0
            if said is None and "SMOOTHAS" not in file.header
            else _number(said, file.header, "SMOOTHAS", path, f"--smoothing-{kind}")
        )
        if own > smoothing * (1.0 + 1e-6):
            raise ValueError(
                f"{path} is smoothed by {own:g} arcsec, {wl} by {smoothing:g}; give a finer map, or smooth "
                "the weak-lensing map as much."
            )
        its = _ratio(
            getattr(options, f"dls_ds_{kind}"), getattr(options, f"z_{kind}"), file.header, plane, path, kind
        )
        rest = float(np.sqrt(max(smoothing**2 - own**2, 0.0)))
        fine = weak.smooth(jnp.asarray(file.values), file.grid, rest)
        shift = _shift(file.reference, base.reference, path, wl)
        values, covered = onto(fine * (ratio / its), file.grid, base.grid, shift)
        return np.asarray(values), np.asarray(covered) > 1.0 - 1e-6, ratio / its

    kappa_sl, covered, scale = matched(sl, "sl")
    known &= covered
    kappa_true = None
    if truth is not None:
        kappa_true, covered, _ = matched(truth, "truth")
        known &= covered
    if not known.any():
        raise ValueError(
            f"{wl} and {sl} share no pixel that is known in both; check their centres and masks."
        )
    z_source = base.header.get("ZSOURCE") if options.z_wl is None else options.z_wl
    header = {"ZLENS": z_lens, "ZSOURCE": z_source, "DLSDS": ratio, "SMOOTHAS": smoothing, "BUNIT": ""}
    return Pair(
        Path(wl).stem, np.where(known, base.values, 0.0), kappa_sl, kappa_true, noise, known.astype(float),
        base.grid, plane, base.reference, smoothing, ratio, scale, header,
    )  # fmt: skip


def _number(said: float | None, header: dict[str, Any], key: str, path: str | Path, option: str) -> float:
    if said is not None:
        return float(said)
    value = header.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        found = "has no key" if value is None else f"has {key} = {value!r} instead of a number for"
        raise ValueError(f"{path} {found} {key}; add it to the header, or give {option}.")
    return float(value)


def _ratio(
    dls_ds: float | None,
    z: float | None,
    header: dict[str, Any],
    plane: LensPlane,
    path: str | Path,
    kind: str,
) -> float:
    """D_LS/D_S of a map: the option, the redshift given, the header's ratio, the header's redshift."""
    value = dls_ds
    if value is None and z is not None:
        value = float(plane.dls_ds(z))
    if value is None and header.get("DLSDS") is not None:
        value = _number(None, header, "DLSDS", path, f"--dls-ds-{kind}")
    if value is None:
        value = float(plane.dls_ds(_number(None, header, "ZSOURCE", path, f"--z-{kind} or --dls-ds-{kind}")))
    if not 0.0 < value <= 1.0:
        raise ValueError(
            f"{path}: D_LS/D_S is {value:g}; sources lie behind the lens: give --z-{kind} above its "
            f"redshift, or --dls-ds-{kind} between 0 and 1."
        )
    return value


def _same_grid(name: str, path: str | Path, wl: str | Path, base: io.MapFile) -> None:
    found = io.read_map(path).grid
    if found != base.grid:
        raise ValueError(f"--{name} {path} has the grid {found}, {wl} {base.grid}; give it on the same grid.")


def _shift(
    own: io.Reference | None, base: io.Reference | None, path: str | Path, wl: str | Path
) -> tuple[float, float]:
    if (own is None) != (base is None):
        has, lacks = (wl, path) if own is None else (path, wl)
        raise ValueError(
            f"{has} has RA and Dec, {lacks} has not; write both maps with a reference point, or none."
        )
    if own is None or base is None:
        return 0.0, 0.0
    x, y = io.offsets(np.array([own[0]]), np.array([own[1]]), base)[0]
    if not np.hypot(x, y) < 3600.0:
        raise ValueError(
            f"The origins of {path} and {wl} are more than a degree apart; give maps of one field."
        )
    turn = float(io.north(np.array([own[0]]), base)[0])
    if abs(turn) > 2e-3:
        raise ValueError(
            f"North of {path} is turned by {np.rad2deg(turn):.2f} degrees against {wl} (their reference "
            "points are far apart); project both about one point."
        )
    return float(x), float(y)
