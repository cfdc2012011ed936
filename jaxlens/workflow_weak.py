"""From a `weak.toml`, or a shear map, to galaxies and a grid: the input of the weak-lensing command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlens import config_weak, datasets, io, weak
from jaxlens._config import ConfigError
from jaxlens._types import Array, RandomKey
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.grid import Grid


@dataclass(frozen=True)
class WeakSetup:
    """Everything a `weak.toml` says, ready to be mapped.

    Attributes:
        config: the configuration.
        source: file it was read from.
        table: the whole catalogue.
        galaxies: the same with weight 0 for those that are not selected.
        counts: galaxies left after each step of the selection, in its order; `all`, then e.g. `use`.
        plane: the lens plane.
        grid: pixels of the map.
    """

    config: config_weak.Weak
    source: Path
    table: io.ShearTable
    galaxies: weak.Galaxies
    counts: dict[str, int]
    plane: LensPlane
    grid: Grid

    @property
    def shear(self) -> weak.ShearMap:
        """The shear map of the selected galaxies."""
        return weak.to_grid(self.galaxies, self.grid)

    @property
    def depth(self) -> weak.Depth:
        """Moments of their D_LS/D_S."""
        return weak.depth(self.galaxies)

    @property
    def smoothing_pixels(self) -> float:
        """Standard deviation of the smoothing Gaussian in pixels."""
        return self.config.map.sigma_arcsec / self.config.map.pixel_arcsec

    @property
    def edges(self) -> Array:
        """Edges of the bins of the tangential profile, `(b + 1,)`, arcsec."""
        return jnp.asarray(self.config.profile.edges_arcsec)

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the tangential profile, arcsec."""
        return self.config.profile.x_arcsec, self.config.profile.y_arcsec

    @property
    def has_photometric_redshifts(self) -> bool:
        """Whether galaxies have a D_LS/D_S of their own, from a redshift with an error."""
        known = np.isfinite(self.table.z) & (np.isfinite(self.table.z_lo) | np.isfinite(self.table.z_hi))
        return self.config.depth.per_galaxy and bool(np.any(known & (np.asarray(self.galaxies.weight) > 0.0)))

    def redrawn(self, key: RandomKey) -> weak.Galaxies:
        """The galaxies with D_LS/D_S of one draw of their redshifts."""
        table, old = self.table, self.galaxies
        drawn = self.plane.dls_ds(weak.draw_redshifts(key, table.z, table.z_lo, table.z_hi))
        ratio = jnp.where(jnp.isfinite(jnp.asarray(table.z)), drawn, old.dls_ds)
        return weak.Galaxies(old.theta, old.eps, old.weight, ratio)

    def fit_halo(self, profile: weak.TangentialProfile, depth: weak.Depth | None = None) -> weak.HaloFit:
        """The NFW halo of a profile with the priors of the configuration; `depth` replaces the galaxies'."""
        said = self.config.profile
        prior = None
        if said.log_c is not None and said.log_c_sigma is not None:
            prior = weak.Prior(said.log_c, said.log_c_sigma)
        return weak.fit_halo(
            profile,
            self.plane,
            depth or self.depth,
            definition=said.overdensity,
            concentration=prior,
            calibration=weak.Prior(said.calibration, said.calibration_sigma),
        )


def load(source: str) -> WeakSetup:
    """Read what `source` names: a data set, a directory holding `weak.toml`, or such a file.

    Raises:
        ConfigError: naming file, key and remedy; also when no galaxy is left.
        ValueError: naming file, row and column of the catalogue.
    """
    path = datasets.configuration(source, "weak")
    return assemble(config_weak.read(path), path)


def assemble(settings: config_weak.Weak, path: Path) -> WeakSetup:
    """The galaxies of a configuration whose catalogue lies beside `path`."""
    plane = LensPlane.at(settings.z_l, FlatLCDM(h=settings.cosmology.h, omega_m=settings.cosmology.omega_m))
    said = settings.shear
    table = io.read_shear(
        path.parent / said.file,
        settings.reference,
        axis=said.axis,
        x_axis=said.x_axis,
        meridian=said.meridian,
        responsivity=said.responsivity,
        rename=said.columns,
    )
    _one_weight(settings, table, path)
    use, counts = _selected(settings, table, path)
    weight = np.asarray(table.weight)
    if said.sigma_eps is not None and np.isfinite(table.sigma).all():
        weight = np.asarray(weak.shape_weight(table.sigma, said.sigma_eps))
    everything = weak.Galaxies(
        table.theta, table.eps, np.where(use, weight, 0.0), _ratios(settings, table, plane)
    )
    if not np.any(np.asarray(everything.weight) > 0.0):
        raise ConfigError(f"{path}: every selected galaxy of {said.file} has weight 0; correct the weights.")
    if not np.any((np.asarray(everything.weight) > 0.0) & (np.asarray(everything.dls_ds) > 0.0)):
        raise ConfigError(
            f"{path}: every selected galaxy of {said.file} lies in front of the lens (z_phot <= z_l = "
            f"{settings.z_l:g}); correct the redshifts, or set `per_galaxy` under [depth] to false."
        )
    return WeakSetup(settings, path, table, everything, counts, plane, _grid(settings, table.theta[use]))


def _one_weight(settings: config_weak.Weak, table: io.ShearTable, path: Path) -> None:
    """Refuse a catalogue that gives two weights, or errors of which no weight can be made."""
    said, name = settings.shear, settings.shear.file
    weight, sigma = "weight" in table.rows, "sigma" in table.rows
    if said.sigma_eps is not None and weight:
        raise ConfigError(
            f"{path}: [shear] sigma_eps = {said.sigma_eps:g} makes weights of the column sigma, but {name} "
            "has a column weight, which says it already; drop one of the two."
        )
    if said.sigma_eps is not None and not sigma:
        raise ConfigError(
            f"{path}: [shear] sigma_eps = {said.sigma_eps:g} needs a column sigma, which {name} lacks; add "
            "it, or remove sigma_eps."
        )
    if sigma and not weight and said.sigma_eps is None:
        raise ConfigError(
            f"{path}: {name} has a column sigma, which gives no weight without the intrinsic scatter; set "
            "sigma_eps under [shear], e.g. 0.26, or drop the column."
        )


def _selected(
    settings: config_weak.Weak, table: io.ShearTable, path: Path
) -> tuple[np.ndarray, dict[str, int]]:
    said = settings.select
    behind = np.asarray(
        weak.background(
            np.zeros(len(table.z), complex),
            table.z,
            z_min=0.0 if said.z_margin is None else settings.z_l + said.z_margin,
            require_z=said.require_z,
        )
    )
    steps = {
        "use": table.use | (not said.use),
        "not a member": ~table.member | said.members,
        "not in front": behind,
        "measured, |g| below the limit": np.asarray(weak.background(table.eps, max_eps=said.max_g)),
    }
    use = np.ones(len(table.z), bool)
    counts = {"all": len(use)}
    for name, good in steps.items():
        use = use & good
        counts[name] = int(use.sum())
    if not use.any():
        left = ", ".join(f"{name}: {count}" for name, count in counts.items())
        raise ConfigError(
            f"{path}: [select] leaves no galaxy of {settings.shear.file} ({left}); widen the limits."
        )
    return use, counts


def _ratios(settings: config_weak.Weak, table: io.ShearTable, plane: LensPlane) -> np.ndarray:
    said = settings.depth
    one = float(plane.dls_ds(said.z_s)) if said.z_s is not None else said.dls_ds
    assert one is not None
    ratios = np.full(len(table.z), one)
    if said.per_galaxy:
        known = np.isfinite(table.z)
        ratios[known] = np.asarray(plane.dls_ds(jnp.asarray(table.z[known])))
    return ratios


def _grid(settings: config_weak.Weak, theta: np.ndarray) -> Grid:
    """A square about the reference point, or the smallest with an even number of pixels around the galaxies.

    An even number can be padded to twice the size with equal margins.
    """
    pixel = settings.map.pixel_arcsec
    if settings.map.side_arcsec is not None:
        return Grid.square(settings.map.side_arcsec, pixel)
    low, high = theta.min(axis=0), theta.max(axis=0)
    # Galaxies on the upper edge would be outside: half a pixel more.
    n = int(np.ceil((np.max(high - low) + 0.5 * pixel) / pixel))
    middle = 0.5 * (low + high)
    return Grid((n + n % 2, n + n % 2), pixel, (float(middle[0]), float(middle[1])))


FITS = (".fits", ".fit", ".fits.gz")
"""Endings of a shear map."""


@dataclass(frozen=True)
class Field:
    """A shear map as that of a single source plane, with its galaxies where there is a catalogue.

    Attributes:
        name: for titles.
        shear: the map.
        grid: its pixels.
        smoothing: standard deviation of the Gaussian, arcsec.
        reference: (RA, Dec) of theta = 0 in degrees, or None.
        header: lens and sources of the convergence as FITS keys; without a value where they are not known.
        counts: galaxies left after each step of the selection.
        setup: the catalogue; None when the input is a map.
        factor: by which the mean ellipticities were multiplied, see `weak.to_single_plane`.
        axis: the direction from which the shear of the input counts, see `io.to_frame`.
    """

    name: str
    shear: weak.ShearMap
    grid: Grid
    smoothing: float
    reference: io.Reference | None
    header: dict[str, Any]
    counts: dict[str, int]
    setup: WeakSetup | None = None
    factor: float = 1.0
    axis: str = "west"

    @property
    def kpc_per_arcsec(self) -> float | None:
        """Scale in the lens plane, where its redshift and the cosmology are known."""
        return None if self.setup is None else float(self.setup.plane.kpc_per_arcsec)


def field(source: str, axis: str | None = None) -> Field:
    """The field that `source` names: what `load` takes, or a shear map (FITS, see `io.read_shear_map`).

    A map is to be smoothed as its key `SMOOTHBY` says, else by two pixels (our choice, as the data sets).

    Args:
        source: data set, directory or file.
        axis: from which direction the shear of a map counts, see `io.to_frame`; `west` if None. A catalogue
            has it in its `weak.toml`.

    Raises:
        ConfigError, ValueError, FileNotFoundError: as `load` and `io.read_shear_map`.
    """
    path = Path(source)
    if path.name.endswith(FITS):
        found = io.read_shear_map(path, axis=axis or "west")
        known = {key: found.header.get(key) for key in ("ZLENS", "ZSOURCE", "DLSDS")}
        smoothing = float(found.header.get("SMOOTHBY") or 2.0 * found.grid.pixel)
        shear = weak.ShearMap(*(jnp.asarray(part) for part in found[:3]))
        counts = {"in the map": int(found.n_gal.sum())}
        frame = axis or "west"
        return Field(path.stem, shear, found.grid, smoothing, found.reference, known, counts, axis=frame)
    if axis is not None:
        raise ValueError(f"--axis is {axis!r}, but {source} is a catalogue; set `axis` in its weak.toml.")
    return field_of(load(source))


def field_of(setup: WeakSetup) -> Field:
    """The map of a catalogue as that of a single source plane."""
    depth, said = setup.depth, setup.config.depth
    factor = float(depth.factor) if said.per_galaxy else 1.0
    effective = said.per_galaxy or said.z_s is None
    header = {
        "ZLENS": setup.config.z_l,
        "ZSOURCE": (-1.0, "none: an effective D_LS/D_S") if effective else said.z_s,
        "DLSDS": float(depth.mean) * factor,
    }
    shear = setup.shear
    scaled = weak.ShearMap(shear.g * factor, shear.weight, shear.n_gal)
    return Field(
        name=setup.config.name,
        shear=scaled,
        grid=setup.grid,
        smoothing=setup.config.map.sigma_arcsec,
        reference=setup.config.reference,
        header=header,
        counts=setup.counts,
        setup=setup,
        factor=factor,
        axis=setup.config.shear.axis,
    )
