"""A weak-lensing reconstruction with its noise, null tests, peak, profile and aperture mass."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import weak
from jaxlens._nulls_weak import Mode, against, null_maps, samples
from jaxlens._types import Array, Map
from jaxlens.redshift_weak import RedshiftSpread, redshift_spread
from jaxlens.workflow_weak import Field, WeakSetup

DENSE = 48 * 48
"""Up to this many pixels of the grid the null maps share one dense inverse; its set-up then takes seconds."""

APERTURE = 3.0
"""Radius of the apertures in standard deviations of the smoothing (our choice)."""

MAX_KAPPA = 1e6
"""A convergence above it is no map, but an iteration that diverges."""

PROFILE_DRAWS = 200
"""Bootstrap samples of the tangential profile; they cost little."""


class Diverged(ArithmeticError):
    """The iteration has left every sensible range: there is no map."""


@dataclass(frozen=True)
class Options:
    """How to reconstruct; the first four as in `weak.reconstruct`.

    Attributes:
        draws: pairs of null maps, and bootstrap samples of the galaxies.
        seed: of both.
        smoothing: standard deviation of the Gaussian, arcsec; None takes the field's.
        model: what A3 starts from, see `model_weak.first_guess`.
        axis: from which direction the shear of a map counts, see `io.to_frame`; None is `west`.
    """

    scheme: str = "A2"
    iterations: int = 5
    ridge: float = 1e-2
    padding: float = 2.0
    draws: int = 32
    seed: int = 0
    smoothing: float | None = None
    model: str | None = None
    axis: str | None = None

    def __post_init__(self) -> None:
        row = weak.SCHEMES.get(self.scheme)
        if row is None:
            raise ValueError(f"--scheme is {self.scheme!r}; give one of {', '.join(weak.SCHEMES)}.")
        if (row.start == "model") != (self.model is not None):
            raise ValueError(
                f"--scheme is {self.scheme} and --model is {self.model!r}; A3 needs a model to start from (a "
                "result directory of `jaxlens strong`, or a model.toml), the other schemes take none."
            )
        for name, good, remedy in (
            ("axis", self.axis in (None, "west", "east", "north"), "give west, east or north"),
            ("iterations", self.iterations >= 1, "give at least 1"),
            ("ridge", self.ridge > 0.0, "give a positive number, 1e-2 for noisy data"),
            ("padding", 1.0 <= self.padding <= 16.0, "give 1 to 16"),
            (
                "smoothing",
                self.smoothing is None or 0.0 < self.smoothing < np.inf,
                "give the standard deviation of the Gaussian in arcsec, a positive number",
            ),
            ("draws", self.draws >= 8, "give --bootstrap at least 8"),
        ):
            if not good:
                raise ValueError(f"--{name} is {getattr(self, name)}; {remedy}.")


@dataclass(frozen=True)
class Profile:
    """What only a catalogue has.

    Attributes:
        profile: tangential and cross shear.
        errors: from bootstrap samples.
        fit: NFW halo.
        model: its shear at the bins and the error of it, `(b,)` each.
        curve: radii from the first to the last edge, the shear there and its error, `(60,)` each.
        significance: of the mean shear from the first to the last edge.
        aperture: aperture mass.
        radius: of the apertures, arcsec.
        coverage: share of each aperture that has data, `(y, x)`.
    """

    profile: weak.TangentialProfile
    errors: weak.BootstrapErrors
    fit: weak.HaloFit
    model: tuple[Array, Array]
    curve: tuple[Array, Array, Array]
    significance: weak.Significance
    aperture: weak.ApertureMap
    radius: float
    coverage: Array


@dataclass(frozen=True)
class Outcome:
    """A reconstruction with everything derived from it.

    Attributes:
        field: shear map and catalogue.
        options: how it was reconstructed.
        made: the reconstruction.
        sigma: noise of the convergence by null maps, `(y, x)`.
        peak: the highest unmasked pixel of the convergence.
        peak_error: half the width that holds 68 % of the bootstrap samples, beside masked pixels at least the
            standard deviation of a pixel, `(2,)`, arcsec, or None.
        e, b: E and B mode against null maps.
        kappa_b_rest: B mode of the shear that the E mode does not explain, `(y, x)`; None for K schemes.
        b_beyond_e: that B mode against null maps, or None.
        profile: what only a catalogue has, or None.
        redshifts: errors by photometric redshifts, where galaxies have such of their own, or None.
        seconds: it took.
    """

    field: Field
    options: Options
    made: weak.Reconstruction
    sigma: np.ndarray
    peak: weak.Peak
    peak_error: np.ndarray | None
    e: Mode
    b: Mode
    kappa_b_rest: np.ndarray | None
    b_beyond_e: Mode | None
    profile: Profile | None
    redshifts: RedshiftSpread | None
    seconds: float

    @property
    def used(self) -> np.ndarray:
        """Unmasked pixels, `(y, x)`."""
        return np.asarray(self.field.shear.weight) > 0.0

    @property
    def snr(self) -> np.ndarray:
        """Convergence over its noise, `(y, x)`; 0 in masked pixels."""
        return np.where(self.used, np.asarray(self.made.kappa) / self.sigma, 0.0)


def derive(
    field: Field,
    options: Options | None = None,
    *,
    kappa0: Map | None = None,
    on_step: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Reconstruct a field, its noise and its null tests; from a catalogue also profile and aperture mass.

    Null maps are reconstructions of galaxies turned at random, and of the same turned by 45 degrees more:
    their noise is of equal size and independent in each pixel. Without a catalogue pixels are turned, less
    the shear that the reconstruction explains, for the lens in a mean of galaxies is no noise. Noise has
    no model to start from, and bootstrap samples need none: with A3 both are mapped by A2, which has the same
    fixed point.

    Args:
        field: from `workflow_weak.field`.
        options: how.
        kappa0: first convergence of A3, `(y, x)`, from `model_weak.first_guess`.
        on_step: told the name of each step as it begins.

    Raises:
        Diverged: if the convergence exceeds `MAX_KAPPA` somewhere.
        ValueError: as `weak.reconstruct`.
    """
    begin, options = time.perf_counter(), options or Options()
    shear, grid = field.shear, field.grid
    used = np.asarray(shear.weight) > 0.0
    scheme = "A2" if options.scheme == "A3" else options.scheme
    same = {"scheme": scheme, "ridge": options.ridge, "padding": options.padding}
    steps = {"n_iter": options.iterations, "smoothing": field.smoothing}
    on_step("reconstruction")
    made = weak.reconstruct(shear, grid, **(same | {"scheme": options.scheme}), **steps, kappa0=kappa0)
    largest = float(np.max(np.abs(np.asarray(made.kappa))))
    if not largest < MAX_KAPPA:
        raise Diverged(
            f"The iteration diverges (spectral radius {float(made.spectral_radius):.2f}): |kappa| is "
            f"{largest:.1e} after {options.iterations} iterations; smooth more, or mask large shear."
        )
    key = jax.random.key(options.seed)
    nulls_key, bootstrap_key, profile_key = jax.random.split(key, 3)
    redshift_key = jax.random.fold_in(key, 3)
    akra = weak.SCHEMES[options.scheme].invert == "akra"
    on_step("null maps")
    keys = jax.random.split(nulls_key, options.draws)
    if field.setup is not None:
        nulls = null_maps(keys, shear, grid, field.factor, field.setup.galaxies)
    else:
        explained = weak.explained_shear(shear, made.kappa, grid, smoothing=field.smoothing, **same)
        noise = weak.ShearMap(shear.g - explained, shear.weight, shear.n_gal)
        nulls = null_maps(keys, noise, grid, field.factor)
    if akra and used.size <= DENSE:
        inverse = weak.dense_inverse(shear.weight, grid, **same)
        null = weak.reconstruct_many(nulls, grid, inverse=inverse, scheme=scheme, **steps).kappa
    else:
        null = weak.reconstruct_many(nulls, grid, **same, **steps).kappa
    beyond = left_over = None
    if akra:
        on_step("null tests")
        # The map and its null maps in one call: one program.
        together = jax.tree.map(lambda one, many: jnp.concatenate([one[None], many]), shear, nulls)
        kappas = jnp.concatenate([made.kappa[None], null])
        rests = weak.residual_b_mode(together, kappas, grid, smoothing=field.smoothing, **same)
        left_over, *others = np.asarray(rests)
        beyond = against(left_over, np.stack(others), used)
    top, error = weak.peak(made.kappa, grid, shear.weight > 0.0), None
    if field.setup is not None:
        on_step("bootstrap")
        maps = samples(
            jax.random.split(bootstrap_key, options.draws), field.setup.galaxies, grid, field.factor
        )
        # Each sample has gaps of its own, so there is no common dense inverse.
        kappas = weak.reconstruct_many(maps, grid, **same, **steps).kappa
        places = jax.vmap(lambda kappa: weak.peak(kappa, grid, shear.weight > 0.0).theta)(kappas)
        low, high = np.percentile(np.asarray(places), (15.87, 84.13), axis=0)
        error = 0.5 * (high - low)
        # Beside a masked pixel that is higher a position is that of a pixel.
        coarse = np.asarray(top.theta == grid.theta[tuple(top.pixel)])
        error = np.where(coarse, np.maximum(error, grid.pixel / np.sqrt(12.0)), error)
    null = np.asarray(null)
    profile = redshifts = None
    if field.setup is not None:
        on_step("profile and aperture mass")
        profile = _profile(field, field.setup, profile_key)
        if field.setup.has_photometric_redshifts:
            on_step("photometric redshifts")
            keys = jax.random.split(redshift_key, options.draws)
            redshifts = redshift_spread(field, field.setup, profile.profile, keys, **same, **steps)
    return Outcome(
        field=field,
        options=options,
        made=made,
        sigma=np.sqrt(np.mean(null**2, axis=0)),
        peak=top,
        peak_error=error,
        e=against(np.asarray(made.kappa), null, used),
        b=against(np.asarray(made.kappa_b), null, used),
        kappa_b_rest=left_over,
        b_beyond_e=beyond,
        profile=profile,
        redshifts=redshifts,
        seconds=time.perf_counter() - begin,
    )


def _profile(field: Field, setup: WeakSetup, key: Array) -> Profile:
    galaxies, edges, centre = setup.galaxies, setup.edges, setup.centre
    profile = weak.tangential_profile(galaxies, edges, centre)
    fit = setup.fit_halo(profile)
    radius = APERTURE * field.smoothing
    low = max(float(edges[0]), 0.1 * float(edges[1]))
    r = jnp.asarray(np.geomspace(low, float(edges[-1]), 60))
    definition = setup.config.profile.overdensity
    # Bins and curve in one call: one program.
    both = jnp.concatenate([profile.r, r])
    shear, error = weak.fitted_shear(fit, both, setup.plane, setup.depth, definition=definition)
    bins = len(profile.r)
    return Profile(
        profile=profile,
        errors=weak.bootstrap(key, galaxies, edges, centre, n=PROFILE_DRAWS),
        fit=fit,
        model=(shear[:bins], error[:bins]),
        curve=(r, shear[bins:], error[bins:]),
        significance=weak.significance(galaxies, edges[0], edges[-1], centre),
        aperture=weak.aperture_map(galaxies, setup.grid, radius),
        radius=radius,
        coverage=weak.coverage(field.shear.weight, setup.grid, radius),
    )
