"""A weak-lensing reconstruction with its noise, null tests, peak, profile and aperture mass."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import weak
from jaxlens._types import Array
from jaxlens.grid import Grid
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
    """

    scheme: str = "A2"
    iterations: int = 5
    ridge: float = 1e-2
    padding: float = 2.0
    draws: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        row = weak.SCHEMES.get(self.scheme)
        if row is None or row.start == "model":
            known = ", ".join(name for name, row in weak.SCHEMES.items() if row.start != "model")
            raise ValueError(
                f"--scheme is {self.scheme!r}; give one of {known}"
                + ("." if row is None else " (A3 needs a model and has the fixed point of A2).")
            )
        for name, good, remedy in (
            ("iterations", self.iterations >= 1, "give at least 1"),
            ("ridge", self.ridge > 0.0, "give a positive number, 1e-2 for noisy data"),
            ("padding", 1.0 <= self.padding <= 16.0, "give 1 to 16"),
            ("draws", self.draws >= 8, "give --bootstrap at least 8"),
        ):
            if not good:
                raise ValueError(f"--{name} is {getattr(self, name)}; {remedy}.")


class Mode(NamedTuple):
    """A map against null maps.

    Attributes:
        chi2: mean of (kappa/sigma)^2 over unmasked pixels; 1 is expected of noise.
        significance: (chi2 - 1) over its scatter between null maps, which knows that pixels are correlated.
        exceeded: share of the null maps with a larger chi2.
    """

    chi2: float
    significance: float
    exceeded: float


@dataclass(frozen=True)
class Profile:
    """What only a catalogue has.

    Attributes:
        profile: tangential and cross shear.
        errors: from bootstrap samples.
        fit: NFW halo.
        model: its shear at the bins and the error of it, `(b,)` each.
        significance: of the mean shear from the first to the last edge.
        aperture: aperture mass.
        radius: of the apertures, arcsec.
    """

    profile: weak.TangentialProfile
    errors: weak.BootstrapErrors
    fit: weak.HaloFit
    model: tuple[Array, Array]
    significance: weak.Significance
    aperture: weak.ApertureMap
    radius: float


@dataclass(frozen=True)
class Outcome:
    """A reconstruction with everything derived from it.

    Attributes:
        field: shear map and catalogue.
        options: how it was reconstructed.
        made: the reconstruction.
        sigma: noise of the convergence by null maps, `(y, x)`.
        peak: position of the highest unmasked pixel, refined by a parabola, `(2,)`, arcsec.
        peak_error: half the width that holds 68 % of the bootstrap samples, `(2,)`, arcsec, or None.
        e, b: E and B mode against null maps.
        b_beyond_e: B mode of the shear that the E mode does not explain; None for K schemes.
        profile: what only a catalogue has, or None.
        seconds: it took.
    """

    field: Field
    options: Options
    made: weak.Reconstruction
    sigma: np.ndarray
    peak: np.ndarray
    peak_error: np.ndarray | None
    e: Mode
    b: Mode
    b_beyond_e: Mode | None
    profile: Profile | None
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
    field: Field, options: Options | None = None, *, on_step: Callable[[str], None] = lambda _: None
) -> Outcome:
    """Reconstruct a field, its noise and its null tests; from a catalogue also profile and aperture mass.

    Null maps are reconstructions of galaxies (of pixels, if there is no catalogue) turned at random, and of
    the same turned by 45 degrees more: their noise is of equal size and independent in each pixel.

    Args:
        field: from `workflow_weak.field`.
        options: how.
        on_step: told the name of each step as it begins.

    Raises:
        Diverged: if the convergence exceeds `MAX_KAPPA` somewhere.
        ValueError: as `weak.reconstruct`.
    """
    begin, options = time.perf_counter(), options or Options()
    shear, grid = field.shear, field.grid
    used = np.asarray(shear.weight) > 0.0
    same = {"scheme": options.scheme, "ridge": options.ridge, "padding": options.padding}
    steps = {"n_iter": options.iterations, "smoothing": field.smoothing}
    on_step("reconstruction")
    made = weak.reconstruct(shear, grid, **same, **steps)
    largest = float(np.max(np.abs(np.asarray(made.kappa))))
    if not largest < MAX_KAPPA:
        raise Diverged(
            f"The iteration diverges (spectral radius {float(made.spectral_radius):.2f}): |kappa| is "
            f"{largest:.1e} after {options.iterations} iterations; smooth more, or mask large shear."
        )
    nulls_key, bootstrap_key, profile_key = jax.random.split(jax.random.key(options.seed), 3)
    akra = weak.SCHEMES[options.scheme].invert == "akra"
    on_step("null maps")
    nulls = _nulls(field, jax.random.split(nulls_key, options.draws))
    if akra and used.size <= DENSE:
        inverse = weak.dense_inverse(shear.weight, grid, **same)
        null = weak.reconstruct_many(nulls, grid, inverse=inverse, scheme=options.scheme, **steps).kappa
    else:
        null = weak.reconstruct_many(nulls, grid, **same, **steps).kappa
    beyond = None
    if akra:
        on_step("null tests")
        rest = lambda maps, kappa: np.asarray(
            weak.residual_b_mode(maps, kappa, grid, smoothing=field.smoothing, **same)
        )
        one = jax.tree.map(lambda part: part[None], shear)
        beyond = _against(rest(one, made.kappa[None])[0], rest(nulls, null), used)
    error = None
    if field.setup is not None:
        on_step("bootstrap")
        maps = _samples(field, field.setup, jax.random.split(bootstrap_key, options.draws))
        # Each sample has gaps of its own, so there is no common dense inverse.
        kappas = np.asarray(weak.reconstruct_many(maps, grid, **same, **steps).kappa)
        low, high = np.percentile([highest(kappa, used, grid) for kappa in kappas], (15.87, 84.13), axis=0)
        error = 0.5 * (high - low)
    null_maps = np.asarray(null)
    profile = None
    if field.setup is not None:
        on_step("profile and aperture mass")
        profile = _profile(field.setup, profile_key)
    return Outcome(
        field=field,
        options=options,
        made=made,
        sigma=np.sqrt(np.mean(null_maps**2, axis=0)),
        peak=highest(np.asarray(made.kappa), used, grid),
        peak_error=error,
        e=_against(np.asarray(made.kappa), null_maps, used),
        b=_against(np.asarray(made.kappa_b), null_maps, used),
        b_beyond_e=beyond,
        profile=profile,
        seconds=time.perf_counter() - begin,
    )


def _nulls(field: Field, keys: Array) -> weak.ShearMap:
    """Shear maps of randomly turned galaxies, with a leading axis, each followed by its twin."""
    setup, shear = field.setup, field.shear

    def pair(key: Array) -> weak.ShearMap:
        if setup is not None:
            one = weak.to_grid(weak.scramble(key, setup.galaxies), field.grid)
            g = one.g * field.factor
        else:
            g = shear.g * jnp.exp(1j * jax.random.uniform(key, shear.g.shape, maxval=2.0 * jnp.pi))
        return jax.vmap(lambda g: weak.ShearMap(g, shear.weight, shear.n_gal))(jnp.stack([g, 1j * g]))

    pairs = jax.lax.map(pair, keys)
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), pairs)


def _samples(field: Field, setup: WeakSetup, keys: Array) -> weak.ShearMap:
    """Shear maps of bootstrap samples of the galaxies, with a leading axis."""

    def one(key: Array) -> weak.ShearMap:
        made = weak.to_grid(weak.resample(key, setup.galaxies), field.grid)
        return weak.ShearMap(made.g * field.factor, made.weight, made.n_gal)

    return jax.lax.map(one, keys)


def _against(kappa: np.ndarray, nulls: np.ndarray, used: np.ndarray) -> Mode:
    """A map against null maps; each null map is compared with the noise of the others.

    The noise of n maps has n degrees of freedom, so that chi^2 is too large by n/(n - 2).
    """
    values, squares = kappa[used] ** 2, nulls[:, used] ** 2
    n, total = len(squares), squares.sum(axis=0)
    chi2 = float(np.mean(values / total)) * (n - 2)
    null = np.mean(squares / (total - squares), axis=1) * (n - 3)
    scatter = float(np.std(null, ddof=1))
    return Mode(chi2, (chi2 - 1.0) / scatter, float(np.mean(null > chi2)))


def highest(kappa: np.ndarray, used: np.ndarray, grid: Grid) -> np.ndarray:
    """Position of the highest unmasked pixel, `(2,)`, arcsec, refined by a parabola along each axis."""
    row, column = np.unravel_index(np.argmax(np.where(used, kappa, -np.inf)), kappa.shape)
    place = np.array(grid.theta[row, column])
    for axis, (line, at) in enumerate(((kappa[row], column), (kappa[:, column], row))):
        if 0 < at < len(line) - 1:
            left, middle, right = line[at - 1 : at + 2]
            bend = left - 2.0 * middle + right
            if bend < 0.0:
                place[axis] += grid.pixel * float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
    return place


def _profile(setup: WeakSetup, key: Array) -> Profile:
    galaxies, edges, centre = setup.galaxies, setup.edges, setup.centre
    profile = weak.tangential_profile(galaxies, edges, centre)
    fit = setup.fit_halo(profile)
    radius = APERTURE * setup.config.map.sigma_arcsec
    return Profile(
        profile=profile,
        errors=weak.bootstrap(key, galaxies, edges, centre, n=PROFILE_DRAWS),
        fit=fit,
        model=shear_of_fit(setup, fit, profile.r),
        significance=weak.significance(galaxies, edges[0], edges[-1], centre),
        aperture=weak.aperture_map(galaxies, setup.grid, radius),
        radius=radius,
    )


def shear_of_fit(setup: WeakSetup, fit: weak.HaloFit, r: Array) -> tuple[Array, Array]:
    """Shear of the fitted halo and its error at radii `(b,)`, arcsec."""
    definition = setup.config.profile.overdensity
    return weak.fitted_shear(fit, r, setup.plane, setup.depth, definition=definition)
