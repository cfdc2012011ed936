"""From a `strong.toml` to a problem, and from a fit to files: the strong-lensing command as functions.

Units, files and failures live here; the fit itself is `jaxlens.strong`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlens import config, datasets, glafic, io, lenstool
from jaxlens._types import Array
from jaxlens.config import ConfigError, Free
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.strong import (
    FORMS,
    Angle,
    Bounds,
    Box,
    ClusterModel,
    Disc,
    ImageCatalogue,
    Ingredient,
    LogNormalPrior,
    MemberSet,
    NormalPrior,
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
    reader = _Reader(str(path), plane)
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


class _Reader:
    """Collects boxes, priors and starts while the components are read."""

    def __init__(self, source: str, plane: LensPlane):
        self.source, self.plane = source, plane
        self.kpc_per_arcsec = float(plane.kpc_per_arcsec)
        self.h = float(plane.cosmology.h)
        self.bounds: Bounds = {}
        self.priors: list[NormalPrior | LogNormalPrior] = []
        self.start: dict[str, Array] = {}

    def _standard(self, key: str) -> tuple[str, float]:
        """The name in the package's unit, and the factor to it: kpc to arcsec, Msun/h to Msun."""
        if key.endswith("_kpc"):
            return key.removesuffix("_kpc") + "_arcsec", 1.0 / self.kpc_per_arcsec
        if key.endswith("_msun_h"):
            return key.removesuffix("_h"), 1.0 / self.h
        return key, 1.0

    def number(self, owner: str, key: str, value: Any, fixed: dict[str, Array]) -> None:
        """Put one number among the fixed ones, or make it free."""
        parsed = (
            value if isinstance(value, Free) else config.free_number(value, f"{owner}.{key}", self.source)
        )
        name, factor = self._standard(key)
        if not isinstance(parsed, Free):
            fixed[name] = jnp.asarray(factor * parsed)
            return
        full = f"{owner}.{name}"
        self.bounds[full] = Box(factor * parsed.min, factor * parsed.max, log=parsed.log)
        if parsed.start is not None:
            self.start[full] = jnp.asarray(factor * parsed.start)
        if parsed.mean is not None and parsed.sigma is not None:
            self.priors.append(
                NormalPrior(full, jnp.asarray(factor * parsed.mean), jnp.asarray(factor * parsed.sigma))
            )
        if parsed.median is not None and parsed.sigma_ln is not None:
            self.priors.append(LogNormalPrior(full, factor * parsed.median, parsed.sigma_ln))

    def ingredient(self, one: config.Component) -> Ingredient:
        where = f"{self.source}: component {one.name}"
        if one.profile not in FORMS:
            raise ConfigError(
                f"{where}: profile is {one.profile!r}; choose one of {', '.join(sorted(FORMS))}."
            )
        form = FORMS[one.profile]
        allowed = [*form.numbers, *(["x_arcsec", "y_arcsec"] if form.centred else [])]
        if form.shape:
            allowed.append(form.shape)
        fixed: dict[str, Array] = {}
        said: dict[str, str] = {}
        for key, value in one.numbers.items():
            first = said.setdefault(self._standard(key)[0], key)
            if first != key:
                raise ConfigError(f"{where}: {key} and {first} are the same number; leave out one of them.")
            if self._standard(key)[0] not in allowed:
                raise ConfigError(
                    f"{where}: {key} is not a number of the profile {one.profile}; "
                    f"it takes {', '.join(allowed)} (lengths also in _kpc, masses also in _msun_h)."
                )
            self.number(one.name, key, value, fixed)
        self._orientation(one, form.shape, fixed, where)
        given = {*fixed, *(key.partition(".")[2] for key in self.bounds if key.startswith(f"{one.name}."))}
        missing = [name for name in form.numbers if name not in given]
        if missing:
            raise ConfigError(f"{where}: {', '.join(missing)} missing; give each a number or a box.")
        return Ingredient(one.name, one.profile, fixed)

    def _orientation(
        self, one: config.Component, shape: str | None, fixed: dict[str, Array], where: str
    ) -> None:
        has_shape = shape is not None and (shape in fixed or f"{one.name}.{shape}" in self.bounds)
        if one.shape is not None:
            if shape is None or has_shape or one.pa_deg is not None:
                raise ConfigError(
                    f"{where}: shape = {{ max = ... }} frees the elongation and the angle together; "
                    f"leave out {shape or 'it (this profile is round)'} and pa_deg."
                )
            self.bounds[f"{one.name}.shape"] = Disc(one.shape.max)
            if one.shape.start is not None:
                e, angle = one.shape.start[0], 2.0 * np.deg2rad(one.shape.start[1])
                self.start[f"{one.name}.shape"] = jnp.array([e * np.cos(angle), e * np.sin(angle)])
        elif one.pa_deg == "free":
            if shape is None or (f"{one.name}.{shape}" not in self.bounds and shape not in fixed):
                raise ConfigError(
                    f"{where}: pa_deg is free but the component has no elongation; "
                    f"{f'give {shape}' if shape else 'leave out pa_deg, the profile is round'}."
                )
            self.bounds[f"{one.name}.pa"] = Angle()
        elif one.pa_deg is not None:
            fixed["pa"] = jnp.asarray(np.deg2rad(one.pa_deg))
        elif has_shape:
            raise ConfigError(f'{where}: {shape} is given without pa_deg; give the angle, or "free".')

    def members(
        self,
        said: config.Members,
        settings: config.Strong,
        folder: Path,
        images: np.ndarray,
        name: str = "members",
    ) -> MemberSet:
        table = io.read_members(folder / said.file, reference=settings.reference, mag_ref=said.mag_ref)
        keep = ~np.asarray(table.bcg)
        if said.within_images_arcsec is not None:
            margin = said.within_images_arcsec
            inside = (table.theta >= images.min(axis=0) - margin) & (
                table.theta <= images.max(axis=0) + margin
            )
            keep &= inside.all(axis=1)
        if not keep.any():
            raise ConfigError(f"{folder / said.file}: no member is left inside the rectangle of the images.")
        fixed: dict[str, Array] = {}
        numbers = (
            "sigma_ref_km_s",
            "r_cut_ref_arcsec",
            "r_cut_ref_kpc",
            "r_core_ref_arcsec",
            "r_core_ref_kpc",
        )
        for key in numbers:
            value = getattr(said, key)
            if value is not None:
                self.number(name, key, value, fixed)
        q = 1.0 - np.asarray(table.e)[keep] if said.shape == "light" else np.ones(int(keep.sum()))
        e = (1.0 - q**2) / (1.0 + q**2) if said.convention == "dpie_lenstool" else 1.0 - q
        return MemberSet(
            theta=jnp.asarray(np.asarray(table.theta)[keep]),
            luminosity=jnp.asarray(np.asarray(table.luminosity)[keep]),
            e=jnp.asarray(e),
            pa=jnp.asarray(np.asarray(table.pa)[keep]),
            fixed=fixed,
            exponents=(said.sigma_exponent, said.cut_exponent, said.core_exponent),
            convention=said.convention,
            name=name,
        )
