"""From glafic's words to a model, its boxes and its images."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp

from jaxlens._types import Array
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.glafic._forms import ELLIPSE, GALAXIES, KINDS, PERT, radians
from jaxlens.glafic._scan import Priors, Raw, Said, galaxies, observations, priors, scan
from jaxlens.lens import Lens
from jaxlens.strong import (
    Angle,
    Bounds,
    Box,
    ClusterModel,
    ImageCatalogue,
    Ingredient,
    MemberSet,
    NormalPrior,
    Problem,
    RedshiftPrior,
)
from jaxlens.units import nearest_angle

Z_MAX = 10.0
"""Largest free redshift where the prior file has no range for it."""

_WIDTH = 5.0
# A number with a normal prior and no range gets a box of so many standard deviations on either side.


_IMAGE_PLANE = (
    "the input does not set chi2_splane, so that glafic would form the chi2 in the image plane; here it is "
    "formed in the source plane: ask for the image plane after it (`both`), or set chi2_splane to 1"
)


@dataclass(frozen=True)
class GlaficInput:
    """A glafic input file, read.

    Attributes:
        problem: the fit; boxes from `range`, normal priors from `gauss`, no weak prior.
        start: the numbers of the file, for the first start.
        plane: the lens plane.
        notes: where the file means something else in glafic.
    """

    problem: Problem
    start: dict[str, Array]
    plane: LensPlane
    notes: tuple[str, ...] = ()


def read(path: str | Path) -> GlaficInput:
    """Read a glafic input file and the files it names (relative to it).

    Redshifts that `setopt` frees have the box of their `range`, else z_l + 0.1 to 10, and the normal prior
    of the observation file's redshift error.

    Raises:
        ValueError: naming file, line and command, if something is not understood.
        FileNotFoundError: if a file is missing.
    """
    raw = scan(Path(path))
    if "readobs_point" not in raw.files:
        raise ValueError(f"{path} has no `readobs_point`: there are no images to fit.")
    reader = _Reader(raw)
    images, errors = observations(raw.files["readobs_point"], float(reader.plane.z_l))
    images = reader.redshifts(images, errors)
    if not reader.bounds:
        raise ValueError(f"{path} frees no number; set flags to 1 between start_setopt and end_setopt.")
    ratios = jnp.where(jnp.isnan(images.z_s), 0.0, reader.plane.dls_ds(jnp.nan_to_num(images.z_s)))
    model = ClusterModel(reader.plane, tuple(reader.ingredients), reader.members, ratios, images.systems)
    problem = Problem(model, reader.bounds, images, tuple(reader.normal))
    return GlaficInput(problem, reader.start, reader.plane, () if raw.source_plane else (_IMAGE_PLANE,))


def read_lens(path: str | Path) -> tuple[Lens, LensPlane]:
    """The lens of a glafic input file at the numbers it gives, and its plane.

    Raises:
        ValueError: naming file, line and command, if something is not understood.
        FileNotFoundError: if a file is missing.
    """
    reader = _Reader(scan(Path(path)), free=False)
    model = ClusterModel(reader.plane, tuple(reader.ingredients), reader.members, jnp.zeros(0))
    return model.lens(reader.start), reader.plane


class _Reader:
    """Collects components, boxes, priors and starts."""

    def __init__(self, raw: Raw, *, free: bool = True):
        self.raw, self.path = raw, raw.path
        self.priors = priors(raw.files.get("parprior") if free else None)
        self.free = free and bool(raw.flags)
        self.plane = _plane(raw)
        self.bounds: Bounds = {}
        self.normal: list[NormalPrior | RedshiftPrior] = []
        self.start: dict[str, Array] = {}
        self.ingredients: list[Ingredient] = []
        self.members: MemberSet | None = None
        for index, (line, kind, values) in enumerate(raw.lenses, start=1):
            self._lens(index, line, kind, values)
        _check_used(self.priors, len(raw.lenses), len(raw.points))

    def _lens(self, index: int, line: int, kind: str, values: list[float]) -> None:
        name = f"lens{index}"
        if values[0] != float(self.plane.z_l):
            raise ValueError(
                f"{self.path}, line {line}: lens {index} is at z = {values[0]:g}, the first one at "
                f"{float(self.plane.z_l):g}; one lens plane is read."
            )
        if kind == "gals":
            self._galaxies(index, values)
        elif kind == "pert":
            if any(self._flag(index, place) for place in (2, 3, 4)):
                raise ValueError(
                    f"{self.path}: the fiducial redshift or the centre of lens {index} (pert) is free, which "
                    "does nothing or only shifts the sources; set its flags to 0."
                )
            for part, form, names in zip((name, f"{name}_sheet"), ("shear", "sheet"), PERT, strict=True):
                fixed = self._numbers(index, part, values, names, _straight)
                self.ingredients.append(Ingredient(part, f"glafic_{form}", fixed))
        elif kind in KINDS:
            form, own = KINDS[kind]
            shared = {3: ELLIPSE[3], 4: ELLIPSE[4]} if kind == "point" else ELLIPSE
            fixed = self._numbers(index, name, values, {**shared, **own}, radians)
            if form == "glafic_anfw":
                form = self._overdensity(form, fixed)
            self.ingredients.append(Ingredient(name, form, fixed))
        else:
            known = ", ".join([*KINDS, "pert", "gals"])
            raise ValueError(
                f"{self.path}, line {line}: lens {index} is `{kind}`; read are {known}. "
                "Remove it, or replace it by one of these."
            )

    def _overdensity(self, form: str, fixed: dict[str, Array]) -> str:
        flag = self.raw.settings.get("flag_hodensity", 0.0)
        if flag == 0.0:
            return form
        if flag != 2.0:
            raise ValueError(
                f"{self.path}: flag_hodensity is {flag:g}; read are 0 (virial) and 2 (relative to critical)."
            )
        fixed["overdensity"] = jnp.asarray(self.raw.settings.get("hodensity", 200.0))
        return f"{form}_critical"

    def _galaxies(self, index: int, values: list[float]) -> None:
        if self.members is not None:
            raise ValueError(f"{self.path}: lens {index} is a second `gals`; one is read.")
        if "galfile" not in self.raw.files:
            raise ValueError(f"{self.path}: lens {index} is `gals`, but there is no `galfile`; add it.")
        if self._flag(index, 8):
            raise ValueError(
                f"{self.path}: the exponent (parameter 8) of lens {index} is free; set its flag to 0."
            )
        rows = galaxies(self.raw.files["galfile"])
        self.members = MemberSet(
            theta=jnp.asarray(rows[:, :2]),
            luminosity=jnp.asarray(rows[:, 2]),
            e=jnp.asarray(rows[:, 3]),
            pa=jnp.deg2rad(jnp.asarray(rows[:, 4]) + 90.0),
            fixed=self._numbers(index, "members", values, GALAXIES, radians),
            exponents=(0.25, values[7], 0.5),
        )

    def _flag(self, index: int, place: int) -> bool:
        return self.free and bool(self.raw.flags[index - 1][1][place - 1])

    def _numbers(
        self,
        index: int,
        name: str,
        values: list[float],
        names: dict[int, str],
        turn: Callable[[float], float],
    ) -> dict[str, Array]:
        """The fixed numbers of one component; the free ones get a box and a start."""
        fixed: dict[str, Array] = {}
        for place, number in names.items():
            full, value = f"{name}.{number}", values[place - 1]
            if (
                number.endswith(("_km_s", "_msun_h", "concentration", "_core_arcsec", "r_s_arcsec"))
                and value < 0
            ):
                raise ValueError(
                    f"{self.path}, line {self.raw.lenses[index - 1][0]}: parameter {place} of lens {index} "
                    f"({number}) is {value:g}; it cannot be negative."
                )
            if self._flag(index, place):
                self._free(("lens", index, place), full, value, turn if number == "pa" else None)
            else:
                fixed[number] = jnp.asarray(turn(value) if number == "pa" else value)
        return fixed

    def _free(
        self, key: tuple[str, int, int], full: str, value: float, turn: Callable[[float], float] | None
    ) -> None:
        """Box, prior and start of one free number; `turn` converts an angle and is None for all others.

        An angle and its prior stand for the same ellipse after half a turn: they are moved into its range.
        """
        said, normal = self.priors.ranges.get(key), self.priors.normal.get(key)
        if said is None and normal is None:
            raise ValueError(
                f"{self.path}: parameter {key[2]} of {key[0]} {key[1]} is free, but the prior file has no "
                "`range` for it. Add one, or set its flag to 0."
            )
        if said is None:
            assert normal is not None
            said = _around(normal, positive=turn is None and key[2] not in (3, 4))
        lo, hi, unit, move = said.first, said.second, 1.0, float
        if turn is not None:
            middle = value if hi - lo >= 180.0 else 0.5 * (lo + hi)
            lo, hi, unit = turn(lo), turn(hi), math.radians(1.0)
            move = lambda angle: turn(nearest_angle(angle, middle))
        periodic = turn is not None and said.second - said.first >= 180.0
        self.bounds[full] = Angle() if periodic else Box(lo, hi)
        self.start[full] = jnp.asarray(move(value))
        if normal is not None:
            self.normal.append(NormalPrior(full, move(normal.first), unit * normal.second))

    def redshifts(self, images: ImageCatalogue, errors: list[float]) -> ImageCatalogue:
        """The images with NaN for the redshifts that are free; these get box, prior and start."""
        flags = [flags for _, flags in self.raw.flags[len(self.raw.lenses) :]]
        points = self.raw.points
        if points and len(points) != images.n_systems:
            raise ValueError(
                f"{self.path} has {len(points)} points, but {self.raw.files['readobs_point']} has "
                f"{images.n_systems} systems; give one `point` for each."
            )
        z_s, z_l = images.z_s, float(self.plane.z_l)
        for index, system in enumerate(images.systems):
            if not (flags and flags[index][0]):
                continue
            name, key, z = f"dls_ds.{system}", ("point", index + 1, 1), points[index][1][0]
            said = self.priors.ranges.get(key, Said(0, z_l + 0.1, Z_MAX))
            if not (z_l < said.first and said.first <= z <= said.second):
                raise ValueError(
                    f"{self.path}, line {points[index][0]}: the redshift {z:g} of point {index + 1} is not "
                    f"between {max(said.first, z_l):g} and {said.second:g}, its limits behind the lens "
                    f"(z = {z_l:g}); correct it, or its `range point`."
                )
            lo, hi, at = (self.plane.dls_ds(v) for v in (said.first, said.second, z))
            self.bounds[name] = Box(lo, hi, weak=False)
            self.start[name] = at
            normal = self.priors.normal.get(key)
            if normal is not None:
                self.normal.append(RedshiftPrior(system, self.plane, normal.first, normal.second))
            if errors[index] > 0.0:
                self.normal.append(RedshiftPrior(system, self.plane, images.z_s[index], errors[index]))
            z_s = z_s.at[index].set(jnp.nan)
        return ImageCatalogue(
            images.theta, images.source, z_s, images.sigma_pos, images.systems, images.image_ids
        )


def _straight(degrees: float) -> float:
    """The angle of `pert`, which glafic counts from +x."""
    return radians(degrees - 90.0)


def _around(normal: Said, *, positive: bool) -> Said:
    low = normal.first - _WIDTH * normal.second
    if positive and normal.first > 0.0:
        low = max(low, 1e-3 * normal.first)
    return Said(normal.line, low, normal.first + _WIDTH * normal.second)


def _plane(raw: Raw) -> LensPlane:
    said = raw.settings
    omega = said.get("omega", 0.3)
    if abs(omega + said.get("lambda", 1.0 - omega) - 1.0) > 1e-9 or said.get("weos", -1.0) != -1.0:
        raise ValueError(
            f"{raw.path}: omega = {omega:g}, lambda = {said.get('lambda', 0.7):g}, "
            f"weos = {said.get('weos', -1.0):g} is not a flat universe with a cosmological constant; "
            "set lambda = 1 - omega and weos = -1."
        )
    h, z_l = said.get("hubble", 0.7), raw.lenses[0][2][0]
    if not (0.0 < omega <= 1.0 and h > 0.0):
        raise ValueError(f"{raw.path}: omega = {omega:g}, hubble = {h:g}; both must be positive, omega <= 1.")
    if not z_l > 0.0:
        raise ValueError(
            f"{raw.path}, line {raw.lenses[0][0]}: the lens redshift is {z_l:g}; give a positive one."
        )
    return LensPlane(FlatLCDM(h=h, omega_m=omega), z_l)


def _check_used(found: Priors, n_lenses: int, n_points: int) -> None:
    """Every prior must speak of something that there is."""
    for key, said in {**found.ranges, **found.normal}.items():
        count, places = (n_lenses, 8) if key[0] == "lens" else (n_points, 3)
        if not (1 <= key[1] <= count and 1 <= key[2] <= places):
            raise ValueError(
                f"{found.path}, line {said.line}: there is no parameter {key[2]} of {key[0]} {key[1]}; "
                f"there are {count} of them with {places} parameters each."
            )
