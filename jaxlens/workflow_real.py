"""A cluster with multiple images and galaxy shapes in one frame: the input of `jaxlens real`."""

from dataclasses import dataclass, replace

import equinox as eqx
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
        max_g: pixels in which the model of the images has a larger reduced shear are left out, as in the
            paper: near the critical curves shapes do not follow it.
        joint: fit images and map together, too.
        fields: simulated where there is no transition, to say how many galaxies would show one; a share of
            0.68 is known to 0.07 from 40. 0 for none.
    """

    draws: int = 100
    starts: int = 4
    seed: int = 0
    width: float = 50.0
    r_min: float = 50.0
    inner: tuple[float, float] = (100.0, 300.0)
    max_g: float = 0.5
    joint: bool = True
    fields: int = 40

    def __post_init__(self) -> None:
        for name, good, remedy in (
            ("draws", self.draws >= 8, "give at least 8"),
            ("starts", self.starts >= 1, "give at least 1"),
            ("width", self.width > 0.0, "give a positive width in kpc/h"),
            ("seed", self.seed >= 0, "give 0 or a positive number"),
            ("max-g", 0.0 < self.max_g <= 1.0, "give a number between 0 and 1"),
        ):
            if not good:
                raise ValueError(f"--{name} is {getattr(self, name.replace('-', '_'))}; {remedy}.")


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

    def within(self, used: Array) -> "Sample":
        """The same with weight 0 in the pixels of the map where `used (y, x)` is False."""
        shear = self.field.shear
        weight = jnp.where(used, shear.weight, 0.0)
        field = replace(self.field, shear=weak.ShearMap(shear.g, weight, shear.n_gal))
        return replace(self, field=field)


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
    used = weight > 0.0
    has = np.isfinite(table.z) & used
    if not has.any():
        return jnp.full(len(keys), sample.dls_ds), jnp.ones(len(keys))
    columns = tuple(jnp.asarray(part[has]) for part in (table.z, table.z_lo, table.z_hi, weight))
    without = float(weight[used & ~has].sum() / weight.sum())
    n_free = 0 if setup.config.depth.per_galaxy else int((used & ~has).sum())
    mean, square, best = _depths(keys, columns, without, n_free, setup.plane)
    if setup.config.depth.per_galaxy:
        return square / mean, square / mean**2 / sample.field.factor
    return sample.dls_ds * mean / best, jnp.ones(len(keys))


@eqx.filter_jit
def _depths(
    keys: Array, columns: tuple[Array, ...], without: float, n_free: int, plane: LensPlane
) -> tuple[Array, Array, Array]:
    """<b> and <b^2> of every draw `(n,)`, and <b> of the catalogue's redshifts; b = D_LS/D_S."""
    z, low, high, weight = columns
    weigh = lambda values: jnp.sum(weight * values) / jnp.sum(weight)

    def one(key: Array) -> tuple[Array, Array]:
        first, second, third = jax.random.split(key, 3)
        b = plane.dls_ds(weak.draw_redshifts(first, z, low, high))
        mean, square = weigh(b), weigh(b**2)
        if n_free:
            # The galaxies with a redshift are themselves a sample: resampled before one stands for another.
            chosen = jax.random.randint(second, b.shape, 0, len(b))
            taken = chosen[jax.random.randint(third, (n_free,), 0, len(b))]
            mean = (1.0 - without) * mean + without * jnp.mean(b[taken])
        return mean, square

    mean, square = jax.lax.map(one, keys)
    return mean, square, weigh(plane.dls_ds(z))
