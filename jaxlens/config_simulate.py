"""What the configuration of `jaxlens simulate` may say: the settings of `jaxlens.simulate`, table by table.

Everything has a default, the paper's cluster; an empty file is a configuration. `config.toml` in a result
says all of it, with the seed, and makes the same files again.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError, model_validator

from jaxlens._config import ConfigError, Cosmology, Strict, dumps, explain, load
from jaxlens.simulate import (
    DEFAULT_SEED,
    Bin,
    Clump,
    ClusterSettings,
    ImageSettings,
    Settings,
    ShearSettings,
    SourceSettings,
)
from jaxlens.simulate.luminosity_function import Depth

MAP_REDSHIFT = 2.0
"""Source redshift of `kappa_true.fits`, as stated in the paper."""


class StrongModel(Strict):
    """The model that `strong.toml` fits to the images.

    Attributes:
        members: member galaxies of the model: in the `rectangle` around the images, or in the whole `field`.
        padding_arcsec: by how much the rectangle is larger on each side.
        starts: of the fit.
    """

    members: Literal["rectangle", "field"] = "rectangle"
    padding_arcsec: Annotated[float, Field(ge=0)] = 10.0
    starts: Annotated[int, Field(ge=1)] = 8


class WeakModel(Strict):
    """How `weak.toml` maps the galaxies.

    Attributes:
        sigma_pixels: standard deviation of the smoothing Gaussian in pixels of the shear map.
    """

    sigma_pixels: Annotated[float, Field(gt=0)] = 1.5


class Simulate(Strict):
    """A whole configuration.

    Attributes:
        name: of the cluster, for titles.
        seed: of everything that is drawn; `--seed` on the command line wins.
        cosmology: the universe.
        cluster, sources, images, shear: see the classes of these names in `jaxlens.simulate`.
        strong, weak: the configurations for `jaxlens strong` and `jaxlens weak` that are written.
    """

    name: str = "Simulated cluster"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = DEFAULT_SEED
    cosmology: Cosmology = Cosmology()
    cluster: ClusterSettings = ClusterSettings()
    sources: SourceSettings = SourceSettings()
    images: ImageSettings = ImageSettings()
    shear: ShearSettings = ShearSettings()
    strong: StrongModel = StrongModel()
    weak: WeakModel = WeakModel()

    @model_validator(mode="after")
    def _consistent(self) -> "Simulate":
        _ = self.settings
        if not self.cluster.z_l < MAP_REDSHIFT:
            raise ValueError(
                f"`cluster.z_l` is {self.cluster.z_l:g}, but `kappa_true.fits` is for sources at z = "
                f"{MAP_REDSHIFT:g}; lower it."
            )
        return self

    @property
    def settings(self) -> Settings:
        """The settings of `simulate.mock`."""
        return Settings(
            h=self.cosmology.h,
            omega_m=self.cosmology.omega_m,
            cluster=self.cluster,
            sources=self.sources,
            images=self.images,
            shear=self.shear,
        )


_TABLES: dict[str, type[Any]] = {
    "cosmology": Cosmology,
    "cluster": ClusterSettings,
    "clumps": Clump,
    "sources": SourceSettings,
    "depth": Depth,
    "images": ImageSettings,
    "shear": ShearSettings,
    "bins": Bin,
    "strong": StrongModel,
    "weak": WeakModel,
}


def read(path: Path) -> Simulate:
    """Read a configuration.

    Raises:
        ConfigError: if the file is missing, is not TOML, or says something it may not; one line per mistake.
    """
    return parse(load(path), str(path))


def parse(table: dict[str, Any], source: str) -> Simulate:
    """A checked configuration from its table; `source` names it in error messages."""
    try:
        return Simulate.model_validate(table)
    except ValidationError as error:
        raise ConfigError(explain(error, source, Simulate, _TABLES)) from error


def text(config: Simulate) -> str:
    """The whole configuration as TOML, every number that has a value; `parse` reads it back equal."""

    def plain(value: Any) -> Any:
        if isinstance(value, BaseModel):
            return {name: plain(getattr(value, name)) for name in type(value).model_fields}
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return {one.name: plain(getattr(value, one.name)) for one in dataclasses.fields(value)}
        if isinstance(value, list | tuple):
            return [plain(one) for one in value]
        return value

    return dumps(plain(config))
