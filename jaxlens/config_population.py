"""What the configuration of `jaxlens population` may say: laws, and the tables of one cluster.

A number of `[population]` is fixed, or drawn for every cluster by a law: `{ uniform = [low, high] }`,
`{ log_uniform = [low, high] }`, `{ normal = [mean, sigma] }` or `{ log_normal = [median, sigma_ln] }`. All
defaults are our choice: mergers around the one of the paper.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from jaxlens import config_simulate
from jaxlens._config import ConfigError, Strict, explain, load
from jaxlens.config_simulate import Simulate

LIMITS = {
    "total_mass_msun_h": (1e12, 1e17), "mass_ratio": (1e-3, 1e3), "separation_kpc_h": (0.0, 5e3),
    "pa_difference_deg": (-360.0, 360.0), "major_axis_deg": (0.0, 90.0), "z_l": (0.01, 5.0), "n0": (1.0, 1e4),
    "m_tele": (15.0, 40.0),
}  # fmt: skip
"""Numbers that describe a cluster and its observation, ends included."""

OVERRIDDEN = {
    "seed": "the option --seed", "cluster.z_l": "population.z_l",
    "cluster.clumps": "the masses, separation and axes under [population]",
    "cluster.pa_difference_deg": "population.pa_difference_deg",
    "cluster.concentration_scatter": "population.concentration_scatter",
    "images.m_tele": "population.m_tele", "shear.density_arcmin2": "population.n0",
    "strong.members": "population.members",
}  # fmt: skip
"""Keys of `jaxlens simulate` that a population sets for every cluster, and what says them here."""

KINDS = ("uniform", "log_uniform", "normal", "log_normal")
"""Laws by name."""


class Law(Strict):
    """How a number is drawn; exactly one of the four.

    Attributes:
        uniform, log_uniform: (low, high).
        normal: (mean, standard deviation).
        log_normal: (median, standard deviation of the natural logarithm).
    """

    uniform: tuple[float, float] | None = None
    log_uniform: tuple[float, float] | None = None
    normal: tuple[float, float] | None = None
    log_normal: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _one(self) -> "Law":
        given = [name for name in KINDS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"holds {' and '.join(given) or 'no law'}; give one of {', '.join(KINDS)}")
        first, second = self.numbers
        if "uniform" in self.kind and not first < second:
            raise ValueError(f"{self.kind} = [{first:g}, {second:g}]; give low < high")
        if "normal" in self.kind and not second > 0.0:
            raise ValueError(f"{self.kind} has a standard deviation of {second:g}; give a positive one")
        if self.kind.startswith("log") and not first > 0.0:
            raise ValueError(f"{self.kind} begins at {first:g}; give a positive number")
        return self

    @property
    def kind(self) -> str:
        """Which law."""
        return next(name for name in KINDS if getattr(self, name) is not None)

    @property
    def numbers(self) -> tuple[float, float]:
        """Its two numbers."""
        return getattr(self, self.kind)

    @property
    def ends(self) -> tuple[float, ...]:
        """Least and largest number of a law that has them; of the others the middle."""
        if "uniform" in self.kind:
            return self.numbers
        return self.numbers[:1]

    def at(self, uniform: float, gaussian: float) -> float:
        """The number for a uniform deviate in [0, 1) and a standard Gaussian one; it uses one of them."""
        first, second = self.numbers
        if self.kind == "uniform":
            return first + (second - first) * uniform
        if self.kind == "log_uniform":
            return first * (second / first) ** uniform
        return first + second * gaussian if self.kind == "normal" else first * math.exp(second * gaussian)


Number = float | Law


class Laws(Strict):
    """What differs from cluster to cluster.

    Attributes:
        total_mass_msun_h: sum of the two virial masses, Msun/h.
        mass_ratio: of the second clump to the first.
        separation_kpc_h: distance of the clumps on the sky, along theta_1, kpc/h.
        pa_difference_deg: position angle of the second clump minus that of the first.
        concentration_scatter: standard deviation of ln c about the relation.
        major_axis_deg: angle between the major axis of each halo and the line of sight; `isotropic` draws
            directions evenly.
        z_l: redshift of the clusters; 700 kpc/h must lie inside the field, half of which is 704 kpc/h at
            0.275.
        n0: source galaxies per arcmin^2 far from the core.
        m_tele: limiting magnitude of the images far from the core.
        members: members of the strong-lensing model: in the `rectangle` around the images, or in the `field`.
    """

    total_mass_msun_h: Number = Law(log_uniform=(8e14, 1.8e15))
    mass_ratio: Number = Law(uniform=(0.5, 1.0))
    separation_kpc_h: Number = Law(uniform=(30.0, 150.0))
    pa_difference_deg: Number = Law(uniform=(0.0, 90.0))
    concentration_scatter: Annotated[float, Field(ge=0, lt=2)] = 0.25
    major_axis_deg: Literal["isotropic"] | Number = "isotropic"
    z_l: Number = Law(uniform=(0.28, 0.45))
    n0: Number = Law(log_uniform=(150.0, 800.0))
    m_tele: Number = Law(uniform=(28.5, 30.0))
    members: Literal["rectangle", "field"] = "rectangle"


class Population(Strict):
    """A whole configuration.

    Attributes:
        population: laws of what differs.
        simulate: everything else of a cluster, the tables of `jaxlens simulate`.
    """

    population: Laws = Laws()
    simulate: Simulate = Simulate()


def read(path: Path | None) -> Population:
    """The configuration of a file, or the default one.

    Raises:
        ConfigError: if the file is missing, is not TOML, or says something it may not; one line per mistake.
    """
    return Population() if path is None else parse(load(path), str(path))


def parse(table: dict[str, Any], source: str) -> Population:
    """A checked configuration from its table; `source` names it in error messages."""
    rest = {name: value for name, value in table.items() if name != "population"}
    simulate = config_simulate.parse(rest, source)
    try:
        laws = Population.model_validate({"population": table.get("population", {})}).population
    except ValidationError as error:
        raise ConfigError(explain(error, source, Population, {"population": Laws, "": Law})) from error
    for key, instead in OVERRIDDEN.items():
        part, _, name = key.rpartition(".")
        if name in (rest.get(part, {}) if part else rest):
            raise ConfigError(f"{source}: {key} is drawn for every cluster; give {instead} instead.")
    for name, (low, high) in LIMITS.items():
        value = getattr(laws, name)
        ends = value.ends if isinstance(value, Law) else () if value == "isotropic" else (float(value),)
        for end in ends:
            if not low <= end <= high:
                raise ConfigError(
                    f"{source}: population.{name} {'reaches' if len(ends) > 1 else 'is'} {end:g}; "
                    f"give {low:g} to {high:g}."
                )
    return Population(population=laws, simulate=simulate)
