"""From a seed to a cluster with everything that is observed of it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import jax

from jaxlens._types import RandomKey
from jaxlens.cosmology import FlatLCDM
from jaxlens.simulate._cluster import draw_cluster
from jaxlens.simulate._galaxies import GalaxyCatalogue, ShearBin, shear_field
from jaxlens.simulate._images import Catalogue, Images, ImageSettings, find_images, padded
from jaxlens.simulate._limits import check
from jaxlens.simulate._render import render
from jaxlens.simulate._settings import ClusterSettings
from jaxlens.simulate._shear import ShearSettings, TrueField, true_field
from jaxlens.simulate._sources import CausticMargin, Sources, SourceSettings, caustic_margin, draw_sources
from jaxlens.simulate._truth import SimulatedCluster

STAGES = {"cluster": 0, "sources": 1, "image_noise": 2, "counts": 3, "ellipticities": 4}
"""What a seed decides, one key for each: numbers that never change."""

DEFAULT_SEED = 4
"""Seed of the default cluster: the first of 0, 1, 2, ... with 18-26 systems and 54-82 images, chosen before
any weak-lensing map existed. It has 25 and 68. Rejected, with their systems and images: 0 (100, 292), 1 (29,
94), 2 (27, 76), 3 (30, 78)."""


@dataclass(frozen=True)
class Settings:
    """Everything but the seed; the defaults are those of the paper.

    Attributes:
        h, omega_m: the universe.
        cluster: haloes, subhaloes, central galaxies.
        sources: galaxies behind the centre.
        images: which of their images are seen.
        shear: the weak-lensing map.
    """

    h: float = 0.7
    omega_m: float = 0.3
    cluster: ClusterSettings = field(default_factory=ClusterSettings)
    sources: SourceSettings = field(default_factory=SourceSettings)
    images: ImageSettings = field(default_factory=ImageSettings)
    shear: ShearSettings = field(default_factory=ShearSettings)

    def __post_init__(self) -> None:
        z_l = self.cluster.z_l
        if not self.h > 0.0 or not 0.0 < self.omega_m <= 1.0:
            raise ValueError(
                f"`h` is {self.h} and `omega_m` {self.omega_m}; give h > 0 and 0 < omega_m <= 1."
            )
        if self.shear.field_arcmin != self.cluster.field_arcmin:
            raise ValueError(
                f"`shear.field_arcmin` is {self.shear.field_arcmin:g} but `cluster.field_arcmin` is "
                f"{self.cluster.field_arcmin:g}; give one field."
            )
        for k, one in enumerate(self.shear.bins):
            if not one.z_s > z_l:
                raise ValueError(
                    f"`shear.bins[{k}].z_s` is {one.z_s:g}, not behind the lens (`cluster.z_l` {z_l:g}); "
                    "raise it."
                )
        if not self.sources.depth.z_max > z_l:
            raise ValueError(
                f"`sources.depth.z_max` is {self.sources.depth.z_max:g}, not behind the lens (`cluster.z_l` "
                f"{z_l:g}); raise it."
            )

    @property
    def cosmology(self) -> FlatLCDM:
        """The universe."""
        return FlatLCDM(h=self.h, omega_m=self.omega_m)


@dataclass(frozen=True)
class StrongMock:
    """A cluster and the multiple images behind it.

    Attributes:
        seed, settings: what it was made from.
        cluster: the truth.
        sources: all sources.
        images: all their images.
        catalogue: the images that are seen.
        caustic: between the box of the sources and the main caustic, see `caustic_margin`.
    """

    seed: int
    settings: Settings
    cluster: SimulatedCluster
    sources: Sources
    images: Images
    catalogue: Catalogue
    caustic: CausticMargin

    @property
    def caustic_margin(self) -> float:
        """Distance between the box of the sources and the main caustic inside it, arcsec, or NaN."""
        return self.caustic.arcsec


@dataclass(frozen=True)
class Mock:
    """A simulated field: cluster, strong and weak lensing.

    Attributes:
        strong: the cluster with its multiple images.
        field: true convergence and shear for D_LS/D_S = 1.
        bins: true and observed shear maps, one for each source redshift.
        galaxies: the galaxies of all bins.
    """

    strong: StrongMock
    field: TrueField
    bins: tuple[ShearBin, ...]
    galaxies: GalaxyCatalogue

    @property
    def cluster(self) -> SimulatedCluster:
        """The truth."""
        return self.strong.cluster


def stage_keys(seed: int) -> dict[str, RandomKey]:
    """The key of every stage, `fold_in(key(seed), number)` with the numbers of `STAGES`.

    Raises:
        ValueError: if `seed` is no number that a key can be made of.
    """
    if not 0 <= seed < 2**63:
        raise ValueError(f"`seed` is {seed}; give an integer from 0 to 2^63 - 1.")
    root = jax.random.key(seed)
    return {name: jax.random.fold_in(root, number) for name, number in STAGES.items()}


def strong_mock(
    seed: int, settings: Settings | None = None, *, on_step: Callable[[str], object] = lambda _: None
) -> StrongMock:
    """The cluster of a seed and its multiple images, without maps; a few seconds.

    Not differentiable in the seed; `cluster.lens` is a lens like any other. The same seed and settings give
    the same numbers, bit for bit, on one machine.

    Args:
        seed: an integer from 0 to 2^63 - 1.
        settings: default: those of the paper.
        on_step: called with the name of each step.

    Raises:
        TypeError: in single precision.
        ValueError: if the settings describe no cluster.
    """
    settings = Settings() if settings is None else settings
    keys = stage_keys(seed)
    check(settings.cluster, settings.sources, settings.cosmology)
    on_step("drawing the cluster")
    cluster = draw_cluster(keys["cluster"], settings.cluster, settings.cosmology)
    on_step("drawing the sources")
    sources = draw_sources(keys["sources"], settings.sources, cluster.plane)
    on_step("finding the images of all sources")
    catalogue, images = find_images(
        keys["image_noise"], cluster.lens, sources, cluster.plane, settings.images
    )
    margin = caustic_margin(
        padded(cluster.lens), cluster.plane, settings.sources, half_width=settings.images.half_width_arcsec
    )
    return StrongMock(seed, settings, cluster, sources, images, catalogue, margin)


def mock(
    seed: int = DEFAULT_SEED,
    settings: Settings | None = None,
    *,
    on_step: Callable[[str], object] = lambda _: None,
) -> Mock:
    """Everything that `jaxlens simulate` writes, as arrays: `strong_mock`, then maps and galaxies.

    Args:
        seed, settings, on_step: as for `strong_mock`.

    Raises:
        TypeError, ValueError: as `strong_mock`.
    """
    strong = strong_mock(seed, settings, on_step=on_step)
    cluster, said, keys = strong.cluster, strong.settings.shear, stage_keys(seed)
    on_step("rendering the convergence, shear")
    found = true_field(cluster.lens, partial(render, cluster), said)
    on_step("drawing the galaxies")
    bins, galaxies = shear_field(keys["counts"], keys["ellipticities"], found, cluster.plane, said)
    return Mock(strong, found, bins, galaxies)
