"""A cluster with multiple images and galaxy shapes in one frame: the input of `jaxlens real`."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import datasets, weak, workflow, workflow_weak
from jaxlens._config import ConfigError
from jaxlens._types import Array
from jaxlens.cosmology import LensPlane
from jaxlens.lens import Lens

CALIBRATION: dict[str, tuple[float, float]] = {"as1063": (0.5, 0.1), "abell2744": (0.65, 0.1)}
"""Prior of the multiplicative calibration of the full samples of the shipped shapes: response of the shapes
and dilution by galaxies in front together, as their README says."""

PHOTO_Z = (1.0, 0.2)
"""The same of galaxies with a photometric redshift of their own, which are not diluted (our choice)."""


@dataclass(frozen=True)
class Options:
    """How to analyse; shared by both clusters.

    Attributes:
        draws: of each source of error.
        starts: of the strong-lensing fit.
        seed: of everything random.
        width: of the annuli, kpc/h.
        r_min: inner edge of the first, kpc/h; they reach to the edge of the field.
        inner: range whose lambda corrects the map, kpc/h.
    """

    draws: int = 100
    starts: int = 4
    seed: int = 0
    width: float = 50.0
    r_min: float = 50.0
    inner: tuple[float, float] = (100.0, 300.0)

    def __post_init__(self) -> None:
        for name, good, remedy in (
            ("draws", self.draws >= 8, "give at least 8"),
            ("starts", self.starts >= 1, "give at least 1"),
            ("width", self.width > 0.0, "give a positive width in kpc/h"),
            ("seed", self.seed >= 0, "give 0 or a positive number"),
        ):
            if not good:
                raise ValueError(f"--{name} is {getattr(self, name)}; {remedy}.")


@dataclass(frozen=True)
class Sample:
    """Galaxies whose shapes make one map.

    Attributes:
        key: for names of files, `full` or `photo_z`.
        title: for people.
        field: their map before calibration.
        calibration: prior (mean, standard deviation) of m: measured ellipticities are m times the shear.
    """

    key: str
    title: str
    field: workflow_weak.Field
    calibration: tuple[float, float]

    @property
    def setup(self) -> workflow_weak.WeakSetup:
        """Their catalogue."""
        assert self.field.setup is not None
        return self.field.setup

    @property
    def dls_ds(self) -> float:
        """D_LS/D_S of the map."""
        return float(self.field.header["DLSDS"])


@dataclass(frozen=True)
class Cluster:
    """Both probes of one cluster.

    Attributes:
        name: for titles.
        strong: the strong-lensing problem.
        samples: galaxies, first all of the background, then those with photometric redshifts.
        published: published strong-lensing model in the same frame, or None.
    """

    name: str
    strong: workflow.Setup
    samples: tuple[Sample, ...]
    published: Lens | None

    @property
    def plane(self) -> LensPlane:
        """The lens plane."""
        return self.strong.plane


def load(source: str) -> Cluster:
    """Read a data set, or a directory, that holds `strong.toml` and `weak.toml`.

    Raises:
        ConfigError: if one of them is missing, or they disagree about the lens or the frame.
    """
    strong, full = workflow.load(source), workflow_weak.load(source)
    said = full.config
    frames = strong.reference, said.reference
    if None in frames or not np.allclose(*(np.asarray(one, float) for one in frames), rtol=0.0, atol=1e-7):
        raise ConfigError(
            f"{source}: strong.toml has the origin (RA, Dec) = {strong.reference}, weak.toml "
            f"{said.reference}; give both in one frame."
        )
    if abs(float(strong.plane.z_l) - said.z_l) > 1e-4:
        raise ConfigError(
            f"{source}: z_l is {float(strong.plane.z_l):g} in strong.toml and {said.z_l:g} in weak.toml; "
            "give one lens."
        )
    prior = CALIBRATION.get(source, (said.profile.calibration, said.profile.calibration_sigma))
    samples = [Sample("full", "all background galaxies", workflow_weak.field_of(full), prior)]
    if np.isfinite(full.table.z[np.asarray(full.galaxies.weight) > 0.0]).sum() >= 20:
        chosen = said.model_copy(
            update={
                "select": said.select.model_copy(update={"require_z": True}),
                "depth": said.depth.model_copy(update={"per_galaxy": True}),
            }
        )
        some = workflow_weak.assemble(chosen, full.source)
        samples.append(
            Sample("photo_z", "galaxies with photometric redshifts", workflow_weak.field_of(some), PHOTO_Z)
        )
    known = source in datasets.names()
    return Cluster(strong.name, strong, tuple(samples), datasets.reference_lens(source) if known else None)


def depth_draws(sample: Sample, keys: Array) -> tuple[Array, Array]:
    """D_LS/D_S of the map, and the factor on its ellipticities, for draws of the redshifts, `(n,)` each.

    Redshifts are drawn between the percentiles of the catalogue. A galaxy without one takes that of a random
    galaxy of the sample that has one (our choice), so the depth of a sample with one source plane for all
    changes by the ratio of that mixture to what the catalogue's redshifts give.
    """
    setup = sample.setup
    table, weight = setup.table, np.asarray(setup.galaxies.weight)
    has = np.isfinite(table.z) & (weight > 0.0)
    without = float(weight[(weight > 0.0) & ~has].sum() / weight.sum())
    per_galaxy = setup.config.depth.per_galaxy
    known = jnp.asarray(np.flatnonzero(has))
    if not len(known):
        return jnp.full(len(keys), sample.dls_ds), jnp.ones(len(keys))
    mass = jnp.asarray(weight[has])
    n_free = max(int(((weight > 0.0) & ~has).sum()), 1)
    best = jnp.asarray(setup.plane.dls_ds(jnp.asarray(table.z[has])))

    def one(key: Array) -> tuple[Array, Array]:
        first, second = jax.random.split(key)
        z = weak.draw_redshifts(first, table.z[has], table.z_lo[has], table.z_hi[has])
        b = setup.plane.dls_ds(z)
        mean, square = (jnp.sum(mass * part) / jnp.sum(mass) for part in (b, b**2))
        if per_galaxy:
            return mean, square
        chosen = jax.random.randint(second, (n_free,), 0, len(known))
        return (1.0 - without) * mean + without * jnp.mean(b[chosen]), square

    mean, square = jax.lax.map(one, keys)
    if per_galaxy:
        return square / mean, square / mean**2 / sample.field.factor
    return sample.dls_ds * mean / (jnp.sum(mass * best) / jnp.sum(mass)), jnp.ones(len(keys))
