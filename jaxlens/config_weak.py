"""What a `weak.toml` may say: which galaxies, how they become a map, and how deep they lie."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError, model_validator

from jaxlens._config import ConfigError, Cosmology, Strict, explain, load

Positive = Annotated[float, Field(gt=0)]


class Shear(Strict):
    """The catalogue of galaxy shapes, and what its numbers mean; see `io.read_shear`.

    Attributes:
        file: path, relative to the TOML file; CSV, ECSV or FITS.
        axis: where e_1 > 0 points: `west` (e_2 from West towards North), `east`, or `north` (position angles
            from North through East).
        x_axis: where `x_arcsec` grows, `west` or `east`.
        meridian: `plane`, or `local` for ellipticities that refer to each galaxy's own meridian.
        responsivity: ellipticities are divided by it.
        sigma_eps: intrinsic scatter per component; with the column `sigma`, weights
            1/(sigma_eps^2 + sigma^2), instead of a column `weight`.
        columns: names of the file's columns by ours, where they differ.
    """

    file: str = "shear.csv"
    axis: Literal["west", "east", "north"] = "west"
    x_axis: Literal["west", "east"] = "west"
    meridian: Literal["plane", "local"] = "plane"
    responsivity: Positive = 1.0
    sigma_eps: Positive | None = None
    columns: dict[str, str] = Field(default_factory=dict)


class Select(Strict):
    """Which galaxies are used.

    Attributes:
        use: only those whose column `use` is 1, where there is one.
        members: keep galaxies whose column `member` is 1.
        z_margin: galaxies with z_phot < z_l + z_margin are left out; none: redshifts do not select.
        require_z: leave out galaxies without a redshift.
        max_g: galaxies with |g| at or above are left out.
    """

    use: bool = True
    members: bool = False
    z_margin: float | None = 0.15
    require_z: bool = False
    max_g: Positive = 1.2


class Depth(Strict):
    """How far the sources lie behind the lens.

    Attributes:
        z_s: redshift of galaxies without one of their own.
        dls_ds: or their D_LS/D_S.
        per_galaxy: galaxies with a redshift have a D_LS/D_S of their own; else all are alike.
    """

    z_s: Positive | None = None
    dls_ds: Annotated[float, Field(gt=0, lt=1)] | None = None
    per_galaxy: bool = False

    @model_validator(mode="after")
    def _one(self) -> "Depth":
        if (self.z_s is None) == (self.dls_ds is None):
            raise ValueError("give exactly one of z_s and dls_ds")
        return self


class Map(Strict):
    """The map.

    Attributes:
        pixel_arcsec: side of a pixel.
        sigma_arcsec: standard deviation of the Gaussian that smooths the shear.
        side_arcsec: side of the square map about the reference point; else the galaxies' extent.
    """

    pixel_arcsec: Positive = 15.0
    sigma_arcsec: Positive = 30.0
    side_arcsec: Positive | None = None


class Profile(Strict):
    """The tangential profile and the halo fitted to it.

    Attributes:
        edges_arcsec: edges of the bins.
        x_arcsec, y_arcsec: centre.
        overdensity: that M and c refer to: 200 for M_200c, or a name such as `bryan_norman`.
        log_c, log_c_sigma: normal prior on log10 c; none: c is free; sigma = 0: fixed.
        calibration, calibration_sigma: prior on the factor between measured and true shear, measured = factor
            times true; sigma = 0: fixed. It enters the halo's mass, not the maps.
    """

    edges_arcsec: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=2)] = (
        30.0,
        50.0,
        75.0,
        100.0,
        140.0,
    )
    x_arcsec: float = 0.0
    y_arcsec: float = 0.0
    overdensity: Positive | Literal["bryan_norman", "nakamura_suto"] = 200.0
    log_c: float | None = None
    log_c_sigma: Annotated[float, Field(ge=0)] | None = None
    calibration: Positive = 1.0
    calibration_sigma: Annotated[float, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> "Profile":
        if any(not a < b for a, b in zip(self.edges_arcsec, self.edges_arcsec[1:], strict=False)):
            raise ValueError(f"edges_arcsec = {list(self.edges_arcsec)} do not increase; sort them")
        if (self.log_c is None) != (self.log_c_sigma is None):
            raise ValueError(
                "a prior on c needs both log_c and log_c_sigma; add the other, or leave out both"
            )
        return self


class Weak(Strict):
    """A whole `weak.toml`.

    Attributes:
        name: of the field, for titles.
        z_l: redshift of the lens.
        ra_deg, dec_deg: reference point, origin of x and y; optional when the catalogue gives x and y.
    """

    name: str
    z_l: Positive
    ra_deg: float | None = None
    dec_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    cosmology: Cosmology = Cosmology()
    shear: Shear = Shear()
    select: Select = Select()
    depth: Depth
    map: Map = Map()
    profile: Profile = Profile()

    @model_validator(mode="after")
    def _consistent(self) -> "Weak":
        if (self.ra_deg is None) != (self.dec_deg is None):
            raise ValueError("give both ra_deg and dec_deg, or neither")
        if self.depth.z_s is not None and not self.depth.z_s > self.z_l:
            raise ValueError(
                f"depth.z_s = {self.depth.z_s} is not behind the lens, z_l = {self.z_l}; correct one"
            )
        return self

    @property
    def reference(self) -> tuple[float, float] | None:
        """(RA, Dec) of the origin in degrees, or None."""
        return None if self.ra_deg is None or self.dec_deg is None else (self.ra_deg, self.dec_deg)


_TABLES: dict[str, type[BaseModel]] = {
    "cosmology": Cosmology,
    "shear": Shear,
    "select": Select,
    "depth": Depth,
    "map": Map,
    "profile": Profile,
}


def read(path: Path) -> Weak:
    """Read a `weak.toml`.

    Raises:
        ConfigError: if the file is missing, is not TOML, or says something it may not.
    """
    return parse(load(path), str(path))


def parse(table: dict[str, Any], source: str) -> Weak:
    """A checked configuration from its table; `source` names it in error messages."""
    try:
        return Weak.model_validate(table)
    except ValidationError as error:
        raise ConfigError(explain(error, source, Weak, _TABLES)) from error
