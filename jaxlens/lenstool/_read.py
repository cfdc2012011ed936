"""From the sections of a parameter file to a model, its boxes and its images."""

import math
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp

from jaxlens._types import Array
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.lens import Lens
from jaxlens.lenstool import _catalogues
from jaxlens.lenstool._collect import Collected
from jaxlens.lenstool._forms import LENGTHS, PROFILES, ROUND
from jaxlens.lenstool._observed import images, members
from jaxlens.lenstool._par import Limit, Section, limit, sections
from jaxlens.strong import ClusterModel, Ingredient, MemberSet, Problem

_NO_MASS = ("mag", "lum", "z_lens", "profil", "ellipticite", "angle_pos", "alpha", "kappa")
# Keys of a potential that are allowed beside its numbers.

_POTFILE = (
    *("filein", "zlens", "type", "mag0", "corekpc", "core", "sigma", "cutkpc", "cut"),
    *("slope", "vdslope", "vdscatter", "rcutscatter"),
)
_IMAGE = ("multfile", "forme", "mult_wcs", "sigposArcsec", "z_m_limit", "newton")


@dataclass(frozen=True)
class LenstoolModel:
    """A parameter file, read.

    Attributes:
        problem: the fit; boxes from `limit`, `potfile` and `z_m_limit`, normal priors, no weak prior.
        start: the numbers of the file (the mean or middle of its limits where there are none).
        plane: the lens plane.
        reference: (RA, Dec) of the origin in degrees, or None.
    """

    problem: Problem
    start: dict[str, Array]
    plane: LensPlane
    reference: tuple[float, float] | None


def read(path: str | Path) -> LenstoolModel:
    """Read a parameter file and the catalogues it names (relative to it).

    Raises:
        ValueError: naming file, line, section, key and remedy; all unknown keys in one message.
        FileNotFoundError: if a file is missing.
    """
    reader = _Reader(Path(path))
    observed, into = images(reader.into, reader.last("image")), reader.into
    if not into.bounds:
        raise ValueError(f"{path} frees no number; add a `limit` section with a key of kind 1 or 3.")
    ratios = jnp.where(jnp.isnan(observed.z_s), 0.0, into.plane.dls_ds(jnp.nan_to_num(observed.z_s)))
    model = ClusterModel(into.plane, tuple(reader.ingredients), reader.members, ratios, observed.systems)
    problem = Problem(model, into.bounds, observed, tuple(into.priors))
    return LenstoolModel(problem, into.start, into.plane, into.reference)


def read_lens(path: str | Path) -> tuple[Lens, LensPlane]:
    """The lens of a parameter file at the numbers it gives, and its plane; limits and images are not read.

    Raises:
        ValueError: naming file, line, section, key and remedy; all unknown keys in one message.
        FileNotFoundError: if a file is missing.
    """
    reader = _Reader(Path(path), free=False)
    model = ClusterModel(reader.into.plane, tuple(reader.ingredients), reader.members, jnp.zeros(0))
    return model.lens({}), reader.into.plane


class _Reader:
    """Collects components, boxes, priors and starts."""

    def __init__(self, path: Path, *, free: bool = True):
        self.path, self.free = path, free
        self.sections = sections(path)
        self.ingredients: list[Ingredient] = []
        self.members: MemberSet | None = None
        potentials, potfiles = self._all("potentiel"), self._all("potfile")
        if not potentials and not potfiles:
            raise ValueError(f"{path} has no mass: add a `potentiel` or a `potfile` section.")
        self._check_words(potentials, potfiles)
        self.into = Collected(path, self._plane([*potentials, *potfiles]), self._reference())
        limits = self._limits(potentials)
        for number, one in enumerate(potentials, start=1):
            self._potential(one, _safe(one.name or str(number)), limits.get(one.name))
        for one in potfiles:
            self.members = members(self.into, one, free=free)

    def _all(self, kind: str) -> list[Section]:
        return [one for one in self.sections if one.kind == kind]

    def last(self, kind: str) -> Section | None:
        """The last section of a kind; None if there is none."""
        return next(iter(reversed(self._all(kind))), None)

    def _check_words(self, potentials: list[Section], potfiles: list[Section]) -> None:
        """All keys that are not read, in one message."""
        complaints = []
        for one in potentials:
            profil = one.number("profil")
            if profil not in PROFILES:
                complaints.append(f"profil {profil:g} of {one.kind} {one.name} (line {one.line})")
                continue
            names = PROFILES[int(profil)][1]
            lengths = [f"{key}_kpc" for key in names if key in LENGTHS]
            # A shear has no centre and no radii, but published files give them.
            spare = (
                ("x_centre", "y_centre", "core_radius", "v_disp", "core_radius_kpc") if profil == 14 else ()
            )
            complaints += one.known([*names, *lengths, *_NO_MASS, *spare])
        for one in potfiles:
            complaints += one.known(_POTFILE)
        complaints += [f"a second potfile (line {one.line})" for one in potfiles[1:]]
        for one in self._all("image") if self.free else []:
            complaints += one.known(_IMAGE)
        if complaints:
            raise ValueError(
                f"{self.path} has parts that are not read: {', '.join(complaints)}. Remove them, or what "
                f"they set up. Profiles that are read: {', '.join(map(str, PROFILES))}."
            )

    def _reference(self) -> tuple[float, float] | None:
        for one in self._all("runmode"):
            said = one.get("reference")
            if said is not None and said[1] and said[1][0] != "0":
                if said[1][0] not in ("1", "3"):
                    one.fail("reference", "is neither of kind 1 (hh:mm:ss) nor 3 (degrees); correct it.")
                return _catalogues.degrees_of(self.path, said[0], said[1][1:], sexagesimal=said[1][0] == "1")
        return None

    def _plane(self, masses: list[Section]) -> LensPlane:
        keys = {"potentiel": "z_lens", "potfile": "zlens"}
        z_l = masses[0].number(keys[masses[0].kind])
        for one in masses:
            z = one.number(keys[one.kind], z_l)
            if z != z_l or not z > 0.0:
                one.fail(keys[one.kind], f"is not the lens plane, z = {z_l:g} > 0; one lens plane is read.")
        one = self.last("cosmologie")
        if one is None:
            raise ValueError(f"{self.path} has no section `cosmologie`; add it, with H0, omega and lambda.")
        h, omega = one.number("H0") / 100.0, one.number("omega")
        if abs(omega + one.number("lambda", 1.0 - omega) - 1.0) > 1e-6 or one.number("wX", -1.0) != -1.0:
            one.fail("lambda", "and omega do not add up to 1 with wX -1; only such a universe is read.")
        if not (h > 0.0 and 0.0 < omega <= 1.0):
            one.fail("omega", f"or H0 = {100.0 * h:g} is not possible; both must be positive, omega <= 1.")
        return LensPlane(FlatLCDM(h=h, omega_m=omega), z_l)

    def _limits(self, potentials: list[Section]) -> dict[str, Section]:
        names = [one.name for one in potentials]
        twice = [one for k, one in enumerate(potentials) if one.name and one.name in names[:k]]
        found: dict[str, Section] = {}
        for one in self._all("limit") if self.free else []:
            if one.name not in names:
                raise ValueError(
                    f"{one.title} belongs to no potential; there are {', '.join(names) or 'none'}. "
                    "Correct its name, or remove it."
                )
            if one.name in found or one.name in [double.name for double in twice]:
                raise ValueError(f"{one.title}: the name {one.name} is used twice; give each its own.")
            found[one.name] = one
        return found

    # --- potentials ---------------------------------------------------------------------------------

    def _potential(self, one: Section, name: str, limits: Section | None) -> None:
        name = _unique(name, [other.name for other in self.ingredients])
        profil = int(one.number("profil"))
        form, names = PROFILES[profil]
        if profil in ROUND and one.number("ellipticite", 0.0) != 0.0:
            one.fail("ellipticite", f"is an ellipticity of the potential in profil {profil}; only 0 is read.")
        if profil == 14 and one.number("kappa", 0.0) != 0.0:
            one.fail("kappa", "of an external shear is not read; set it to 0.")
        if profil == 12 and one.number("alpha", 1.0) not in (0.0, 1.0):
            one.fail("alpha", "is the slope of a generalised NFW; only 1 is read.")
        said = {} if limits is None else self._said(limits, names)
        fixed: dict[str, Array] = {}
        for key, number in names.items():
            value = self._value(one, key, 0.0 if key in ("ellipticite", "angle_pos") else None)
            if number not in ("x_arcsec", "y_arcsec", "pa") and value < 0.0:
                one.fail(key, "is negative; correct it.")
            if key == "ellipticite" and not value < 1.0:
                one.fail(key, "is not an ellipticity (a^2 - b^2)/(a^2 + b^2); give less than 1.")
            if key in said and said[key].kind:
                self.into.free(f"{name}.{number}", said[key], value, turn=number == "pa")
            else:
                fixed[number] = jnp.asarray(math.radians(value) if number == "pa" else value)
        both = "r_cut_arcsec" in fixed and "r_core_arcsec" in fixed
        if both and not float(fixed["r_core_arcsec"]) < float(fixed["r_cut_arcsec"]):
            one.fail("cut_radius", "is not larger than core_radius; a dPIE needs core < cut.")
        self.ingredients.append(Ingredient(name, form, fixed))

    def _value(self, one: Section, key: str, default: float | None) -> float:
        if key in LENGTHS and one.get(f"{key}_kpc") is not None:
            return one.number(f"{key}_kpc") / self.into.kpc_per_arcsec
        return one.number(key, default)

    def _said(self, limits: Section, names: dict[str, str]) -> dict[str, Limit]:
        """Limits by key, lengths in arcsec."""
        found: dict[str, Limit] = {}
        for line, key, words in limits.rows:
            base = key.removesuffix("_kpc")
            if base not in names or (base != key and base not in LENGTHS):
                limits.fail(key, f"is not a number of this potential; it has {', '.join(names)}.")
            one = limit(limits, key, line, words)
            factor = 1.0 / self.into.kpc_per_arcsec if base != key else 1.0
            found[base] = Limit(one.kind, factor * one.first, factor * one.second)
        return found


def _safe(name: str) -> str:
    """A component's name: no dots, and not one of those with a meaning."""
    name = name.replace(".", "-")
    return f"potential-{name}" if name in ("members", "dls_ds", "z") or name.isdigit() else name


def _unique(name: str, taken: list[str]) -> str:
    number = 2
    first = name
    while name in taken:
        name, number = f"{first}-{number}", number + 1
    return name
