"""What a `strong.toml` may say: pydantic models, units in the names of the keys.

A number is either fixed, `r_s_arcsec = 6.0`, or free in a box, `r_s_arcsec = { min = 0.5, max = 40.0 }`,
with optional keys `start`, `log` (uniform in the logarithm) and a prior inside the box: normal with `mean`,
`sigma`, log-normal with `median`, `sigma_ln`, otherwise uniform.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from jaxlens._config import ConfigError, Cosmology, Strict, explain, load
from jaxlens._free import Free, FreeShape, Number


class Images(Strict):
    """The catalogue of multiple images.

    Attributes:
        file: path, relative to the TOML file.
        sigma_arcsec: position error of images whose row has none.
        z_min, z_max: limits of free redshifts; `z_min` is 0.1 behind the lens if absent.
        exclude: systems to leave out.
    """

    file: str = "images.csv"
    sigma_arcsec: Annotated[float, Field(gt=0)] | None = None
    z_min: float | None = None
    z_max: float = 10.0
    exclude: tuple[str, ...] = ()


class Redshift(Strict):
    """What is known of the redshift of a system without a measured one.

    Attributes:
        system: its name in the catalogue of images.
        min, max: its own limits, instead of `z_min` and `z_max` of all.
        mean, sigma: a normal prior on the redshift inside the limits, as of a photometric one.
        start: the first start.
    """

    system: str
    min: float | None = None
    max: float | None = None
    mean: float | None = None
    sigma: Annotated[float, Field(gt=0)] | None = None
    start: float | None = None

    @model_validator(mode="after")
    def _pairs(self) -> "Redshift":
        if (self.mean is None) != (self.sigma is None):
            raise ValueError("a normal prior needs both mean and sigma; add the other, or leave out both")
        if self.min is not None and self.max is not None and not self.min < self.max:
            raise ValueError(f"min = {self.min} is not below max = {self.max}; exchange them")
        return self


class Members(Strict):
    """Cluster members on luminosity scaling relations.

    Attributes:
        file: path, relative to the TOML file.
        convention: `dpie` (b = 4 pi (sigma/c)^2) or `dpie_lenstool`.
        mag_ref: magnitude of the reference galaxy; needed when the file has magnitudes.
        shape: `light`: mass as elliptical as the light; `round`.
        within_images_arcsec: keep only members in the rectangle around all images, this much larger.
    """

    file: str = "members.csv"
    convention: Literal["dpie", "dpie_lenstool"] = "dpie"
    mag_ref: float | None = None
    shape: Literal["light", "round"] = "light"
    sigma_ref_km_s: Number
    r_cut_ref_arcsec: Number | None = None
    r_cut_ref_kpc: Number | None = None
    r_core_ref_arcsec: Number | None = None
    r_core_ref_kpc: Number | None = None
    sigma_exponent: float = 0.25
    cut_exponent: float = 0.5
    core_exponent: float = 0.5
    within_images_arcsec: float | None = None

    @model_validator(mode="after")
    def _one_unit(self) -> "Members":
        if (self.r_cut_ref_arcsec is None) == (self.r_cut_ref_kpc is None):
            raise ValueError("give exactly one of r_cut_ref_arcsec and r_cut_ref_kpc")
        if self.r_core_ref_arcsec is not None and self.r_core_ref_kpc is not None:
            raise ValueError("give at most one of r_core_ref_arcsec and r_core_ref_kpc")
        return self


class Group(Members):
    """Galaxies on scaling relations of their own; `name`, unique and without dots, prefixes its numbers."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]


class Component(BaseModel):
    """A halo, galaxy, shear or sheet; beside these keys it holds the numbers of its profile.

    Attributes:
        name, profile: unique name, no dots; kind of component, see `jaxlens.strong.FORMS`.
        shape: ellipticity (or shear) and angle free together.
        pa_deg: position angle from West through North, or `"free"`.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    profile: str
    shape: FreeShape | None = None
    pa_deg: float | Literal["free"] | None = None

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers as they stand in the file: floats, or tables to be read as `Free`."""
        return dict(self.__pydantic_extra__ or {})


class Fit(Strict):
    """How to fit.

    Attributes:
        weak_prior: weight of the weak prior rows on every boxed number but redshifts; 0 for none.
        starts: number of starts.
        plane: where the chi^2 is formed: `source`, `image`, or `both` (the source-plane optimum, then
            moved to the image-plane optimum nearby).
        definition: source position of the image-plane stage: `tensor`, `mean` or `mu_mean`.
    """

    weak_prior: Annotated[float, Field(ge=0)] = 0.55
    starts: Annotated[int, Field(ge=1)] = 8
    plane: Literal["source", "image", "both"] = "source"
    definition: Literal["tensor", "mean", "mu_mean"] = "tensor"


class Errors(Strict):
    """What is known of the errors, and what is asked about them.

    Attributes:
        sigma_pos: position errors of the images: `fixed`, `rescaled` after the fit so that chi2_nu = 1, or
            `free`: a factor on all of them is fitted.
        draws: number of convergence maps drawn from the posterior that are written; 0 for none.
        leave_one_out: fit again without each system, and predict it.
        outlier: offset of an image so predicted, in units of its position error, above which it is flagged.
    """

    sigma_pos: Literal["fixed", "rescaled", "free"] = "fixed"
    draws: Annotated[int, Field(ge=0, le=10000)] = 0
    leave_one_out: bool = False
    outlier: Annotated[float, Field(gt=0)] = 3.0


class Strong(Strict):
    """A whole `strong.toml`.

    Attributes:
        name, z_l: of the cluster, for titles; redshift of the lens.
        ra_deg, dec_deg: reference point, origin of x and y; optional when all catalogues give x and y.
    """

    name: str
    z_l: Annotated[float, Field(gt=0)]
    ra_deg: float | None = None
    dec_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    cosmology: Cosmology = Cosmology()
    images: Images = Images()
    redshift: tuple[Redshift, ...] = ()
    members: Members | None = None
    group: tuple[Group, ...] = ()
    component: tuple[Component, ...] = ()
    fit: Fit = Fit()
    errors: Errors = Errors()

    @model_validator(mode="after")
    def _names(self) -> "Strong":
        names = [one.name for one in (*self.component, *self.group)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"component names must be unique; used twice: {', '.join(twice)}; rename one")
        systems = [one.system for one in self.redshift]
        if twice := sorted({name for name in systems if systems.count(name) > 1}):
            raise ValueError(f"there are two [[redshift]] of system {', '.join(twice)}; leave out one")
        reserved = sorted({"members", "dls_ds", "z", "errors"} & set(names))
        if reserved:
            raise ValueError(f"component names {', '.join(reserved)} are reserved; choose others")
        if (self.ra_deg is None) != (self.dec_deg is None):
            raise ValueError("give both ra_deg and dec_deg, or neither")
        return self

    @property
    def reference(self) -> tuple[float, float] | None:
        """(RA, Dec) of the origin in degrees, or None."""
        return None if self.ra_deg is None or self.dec_deg is None else (self.ra_deg, self.dec_deg)


def read(path: Path) -> Strong:
    """Read a `strong.toml`.

    Raises:
        ConfigError: if the file is missing, is not TOML, or says something it may not.
    """
    return parse(load(path), str(path))


def parse(table: dict[str, Any], source: str) -> Strong:
    """A checked configuration from its table; `source` names it in error messages."""
    try:
        return Strong.model_validate(table)
    except ValidationError as error:
        raise ConfigError(explain(error, source, Strong, _TABLES)) from error


def free_number(value: Any, where: str, source: str) -> float | Free:
    """A component's number: fixed, or a `Free`."""
    if isinstance(value, bool) or not isinstance(value, int | float | dict):
        raise ConfigError(
            f"{source}: {where} is {value!r}; give a number or a table {{ min = ..., max = ... }}."
        )
    if not isinstance(value, dict):
        if not math.isfinite(value):
            raise ConfigError(f"{source}: {where} is {value}; give a finite number.")
        return float(value)
    try:
        return Free.model_validate(value)
    except ValidationError as error:
        raise ConfigError(explain(error, f"{source}: {where}", Free, _TABLES)) from error


_TABLES: dict[str, type[BaseModel]] = {
    "": Free,
    "cosmology": Cosmology,
    "images": Images,
    "redshift": Redshift,
    "members": Members,
    "group": Group,
    "fit": Fit,
    "errors": Errors,
    "shape": FreeShape,
}
