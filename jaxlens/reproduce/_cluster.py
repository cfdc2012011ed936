"""One cluster of the experiment, from a seed to the Monte Carlo of every variant."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import io, monte_carlo, weak
from jaxlens._types import Array, Map, RandomKey
from jaxlens.config_simulate import Simulate
from jaxlens.monte_carlo import LambdaProfiles, Measured, Setup
from jaxlens.reproduce import _strong
from jaxlens.reproduce._strong import SLModel
from jaxlens.simulate import Mock, ShearSettings, mean_counts, mock
from jaxlens.weak import AkraDense

EDGES = tuple(50.0 * k for k in range(1, 15))
"""Edges of the annuli, kpc/h; figures and statements begin at 100."""

FIRST = 1
"""Index of the first annulus of the statements, 100-150 kpc/h: further in, the mask shines through."""

SMOOTHING, MASK = 15.0, 0.7
"""Standard deviation of the smoothing, arcsec, and |g| of the wider mask of the check."""

VARIANTS = ("rectangle", "field", "shear", "perfect", "mask", "no_depletion")
"""Strong-lensing maps (members in the rectangle or the field, with external shear, the truth), then masks and
counts. The first is the paper's, with the members of `strong.members`; all see the same noise."""

_NOISE, _STARTS, BOOTSTRAP = 5, 6, 7
# Stages of a seed after those of `simulate.STAGES`.


def key_of(seed: int, stage: int) -> RandomKey:
    """The key of a stage, as `simulate.stage_keys` derives its own."""
    return jax.random.fold_in(jax.random.key(seed), stage)


def noise_key(seed: int) -> RandomKey:
    """The key of all noise realisations of a cluster."""
    return key_of(seed, _NOISE)


def fit_seed(seed: int) -> int:
    """Seed of the starts of the fits of a cluster."""
    return int(jax.random.randint(key_of(seed, _STARTS), (), 0, 2**31 - 1))


@dataclass(frozen=True)
class Variant:
    """The Monte Carlo of one variant.

    Attributes:
        setup: truth, strong-lensing map and mask.
        clean: numbers of the maps without noise.
        noisy: the realisations.
    """

    setup: Setup
    clean: Measured
    noisy: LambdaProfiles


@dataclass(frozen=True)
class ClusterRun:
    """Everything of one cluster.

    Attributes:
        seed, settings: what it was made from.
        mock: the simulated field.
        models: strong-lensing fits by name.
        variants: Monte Carlo by name, see `VARIANTS`; `rectangle` is always there, its A2 maps are kept.
        n: realisations.
    """

    seed: int
    settings: Simulate
    mock: Mock
    models: dict[str, SLModel]
    variants: dict[str, Variant]
    n: int

    @property
    def base(self) -> Variant:
        """The paper's variant."""
        return self.variants["rectangle"]

    @property
    def a2(self) -> Array:
        """A2 maps of all realisations of `rectangle`, not corrected, `(n, y, x)`."""
        kept = self.base.noisy.maps
        assert kept is not None
        return kept

    @property
    def r(self) -> np.ndarray:
        """Middles of the annuli, kpc/h."""
        return np.asarray(self.base.setup.rings.r)


class Builder:
    """Setups that share what they can: the dense map of a mask is seconds of work."""

    def __init__(self, made: Mock, settings: Simulate, shear: ShearSettings | None = None):
        """`shear` replaces the galaxies of the mock, not its maps."""
        plane = made.cluster.plane
        shear = made.strong.settings.shear if shear is None else shear
        self.bin = made.bins[0]
        self.shear, self.grid = shear, shear.grid
        self.ratio = float(plane.dls_ds(self.bin.z_s))
        self.position = self.grid.theta * float(plane.kpc_per_arcsec) * settings.cosmology.h
        self.counts = mean_counts(shear, plane)[0]
        self.flat = mean_counts(replace(shear, depletion=0.0), plane)[0]
        self.inverses: dict[float, AkraDense] = {}

    def setup(
        self, kappa_sl: Map, g_sl: Array, *, g_max: float | None = None, counts: Map | None = None
    ) -> Setup:
        """The setup of one variant; its noise has room for the galaxies of every variant."""
        limit = self.shear.g_max if g_max is None else g_max
        made = monte_carlo.prepare(
            self.bin.g,
            self.bin.kappa,
            kappa_sl,
            self.counts if counts is None else counts,
            (jnp.abs(self.bin.g) <= limit).astype(float),
            self.grid,
            position=self.position,
            edges=EDGES,
            g_sl=g_sl,
            smoothing=SMOOTHING,
            sigma_eps=self.shear.sigma_eps,
            inverse=self.inverses.get(limit),
        )
        self.inverses[limit] = made.inverse
        return replace(made, capacity=weak.capacity_of(float(self.flat.sum())))


def run(
    seed: int,
    settings: Simulate,
    folder: Path,
    *,
    n: int = 256,
    variants: tuple[str, ...] = VARIANTS,
    blocks: Path | None = None,
    on_step: Callable[[str], object] = lambda _: None,
) -> ClusterRun:
    """Simulate, fit, reconstruct: one cluster from its seed to the Monte Carlo of every variant.

    The same seed and settings give the same numbers on one machine. The fits see catalogues alone.

    Args:
        seed: of everything.
        settings: the configuration of the simulation.
        folder: the strong-lensing problems are written here, one directory each.
        n: noise realisations.
        variants: which of `VARIANTS`, the first included.
        blocks: directory that keeps finished blocks of the Monte Carlo, so that a run can be resumed.
        on_step: called with the name of each step.

    Raises:
        ValueError: if a variant is unknown, or the mock has no multiple images.
    """
    unknown = set(variants) - set(VARIANTS)
    if unknown or VARIANTS[0] not in variants:
        raise ValueError(f"`variants` is {variants}; give {VARIANTS[0]} and more of {VARIANTS}.")
    made = mock(seed, settings.settings, on_step=on_step)
    if not made.strong.catalogue.n_systems:
        raise ValueError(f"Seed {seed} gives no multiple images; take another seed or deeper images.")
    models: dict[str, SLModel] = {}
    for name in ("rectangle", "field"):
        if name in variants:
            on_step(f"fitting the images, members in the {name}")
            members = settings.strong.members if name == VARIANTS[0] else name
            _strong.write_problem(made.strong, settings, members, folder / name)
            models[name] = _strong.fit_model(name, folder / name, fit_seed(seed))
    if "shear" in variants:
        on_step("fitting the images with external shear")
        models["shear"] = _strong.with_shear(models["rectangle"])
    builder, maps = Builder(made, settings), {}
    for name, model in models.items():
        maps[name] = _strong.on_pixels(model.fit.lens, builder.grid, builder.ratio)
    maps["perfect"] = (builder.bin.kappa, builder.bin.g)
    key = noise_key(seed)
    done: dict[str, Variant] = {}
    for name in variants:
        on_step(f"{n} noise realisations: {name.replace('_', ' ')}")
        kappa_sl, g_sl = maps.get(name, maps["rectangle"])
        setup = builder.setup(
            kappa_sl,
            g_sl,
            g_max=MASK if name == "mask" else None,
            counts=builder.flat if name == "no_depletion" else None,
        )
        kept = None if blocks is None else io.BlockFiles(blocks / name, monte_carlo.fingerprint(key, setup))
        noisy = monte_carlo.lambda_profiles(key, setup, n, keep_maps=name == VARIANTS[0], checkpoint=kept)
        done[name] = Variant(setup, monte_carlo.noiseless(setup)[0], noisy)
    return ClusterRun(seed, settings, made, models, done, n)
