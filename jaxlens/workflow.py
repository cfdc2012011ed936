"""From a `strong.toml` to a problem, and from a fit to files: the strong-lensing command as functions.

Units, files and failures live here; the fit itself is `jaxlens.strong`.
"""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxlens import config, datasets, glafic, io, lenstool
from jaxlens._reader import Reader
from jaxlens._types import Array
from jaxlens.config import ConfigError
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.strong import (
    FORMS,
    ClusterModel,
    ImageCatalogue,
    Problem,
    free_redshifts,
    physical,
)


@dataclass(frozen=True)
class Setup:
    """Everything a configuration says, ready to fit.

    Attributes:
        config: the configuration, or None when read from another program's input.
        name: of the cluster.
        source: file it was read from.
        problem: model, boxes, images, priors.
        plane: the lens plane.
        start: numbers of the first start, or None for the middle of every box.
        reference: (RA, Dec) of the origin in degrees, or None.
        notes: what a reader of the input must know: where it is understood otherwise than written.
    """

    config: config.Strong | None
    name: str
    source: Path
    problem: Problem
    plane: LensPlane
    start: dict[str, Array] | None
    reference: tuple[float, float] | None
    notes: tuple[str, ...] = ()

    @property
    def model(self) -> ClusterModel:
        """The model of the problem."""
        assert isinstance(self.problem.build, ClusterModel)
        return self.problem.build


def find(source: str) -> Path:
    """The configuration file that `source` names: a data set, a directory with `strong.toml`, or a file.

    A further model of a data set is `<data set>/<model>`, such as `as1063/strong_nfw`.

    Raises:
        ConfigError: if it is none of these; the message lists the data sets.
    """
    return datasets.configuration(source, "strong")


def load(source: str) -> Setup:
    """Read the problem that `source` names; see `find`.

    A file ending in `.input` is read as glafic input, one ending in `.par` as a Lenstool parameter file.

    Raises:
        ConfigError: naming file, key and remedy.
        ValueError: naming file, row and column of a catalogue.
    """
    path = find(source)
    if path.suffix == ".input":
        read = glafic.read(path)
        return Setup(None, path.stem, path, read.problem, read.plane, read.start, None, read.notes)
    if path.suffix == ".par":
        model = lenstool.read(path)
        return Setup(None, path.stem, path, model.problem, model.plane, model.start, model.reference)
    return assemble(config.read(path), path)


def assemble(settings: config.Strong, path: Path) -> Setup:
    """The problem of a configuration whose catalogues lie beside `path`."""
    plane = LensPlane.at(settings.z_l, FlatLCDM(h=settings.cosmology.h, omega_m=settings.cosmology.omega_m))
    folder = path.parent
    images = ImageCatalogue(
        *io.read_images(
            folder / settings.images.file,
            reference=settings.reference,
            default_sigma=settings.images.sigma_arcsec,
            exclude=settings.images.exclude,
            z_l=settings.z_l,
        )
    )
    reader = Reader(str(path), plane)
    ingredients = tuple(reader.ingredient(one) for one in settings.component)
    if settings.images.z_min is not None and settings.images.z_min <= settings.z_l:
        raise ConfigError(
            f"{path}: images.z_min = {settings.images.z_min} is not behind the lens (z_l = {settings.z_l}); "
            "raise it, or leave it out."
        )
    around = np.asarray(images.theta)
    taken = [one.name for one in settings.group if one.name in FORMS]
    if taken:
        raise ConfigError(f"{path}: a group may not be called {taken[0]!r}, which is a profile; rename it.")
    members = None if settings.members is None else reader.members(settings.members, settings, folder, around)
    groups = tuple(reader.members(one, settings, folder, around, one.name) for one in settings.group)
    ratios = jnp.where(jnp.isnan(images.z_s), 0.0, plane.dls_ds(jnp.nan_to_num(images.z_s)))
    reader.bounds.update(free_redshifts(images, plane, settings.images.z_max, settings.images.z_min))
    for known in settings.redshift:
        reader.redshift(known, settings.images, images.systems)
    if not reader.bounds:
        raise ConfigError(f"{path}: no number is free; give at least one a table {{ min = ..., max = ... }}.")
    if not ingredients and members is None and not groups:
        raise ConfigError(f"{path}: the model is empty; add a [[component]] or [members].")
    model = ClusterModel(plane, ingredients, members, ratios, images.systems, groups)
    problem = Problem(model, reader.bounds, images, tuple(reader.priors), settings.fit.weak_prior)
    start = None
    if reader.start:
        middle = physical(reader.bounds, jnp.zeros(sum(bound.size for bound in reader.bounds.values())))
        start = {**middle, **reader.start}
    return Setup(settings, settings.name, path, problem, plane, start, settings.reference)
