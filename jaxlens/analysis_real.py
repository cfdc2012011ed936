"""lambda(r) of a cluster from its images and the shapes behind it, with the error of every ingredient."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import (
    analysis_lambda,
    calibration_real,
    density_real,
    joint_real,
    mass_sheet,
    posterior,
    radial,
    strong,
)
from jaxlens._nulls_weak import null_maps
from jaxlens._types import Array
from jaxlens.budget_real import Budget, aligned_variance, budget_of, statistics
from jaxlens.lens import Lens
from jaxlens.maps_real import STAY, Inversion, maps_of, reduced, smooth_draws
from jaxlens.workflow_lambda import Options as PairOptions
from jaxlens.workflow_lambda import Pair
from jaxlens.workflow_real import Cluster, Options, Sample, depth_draws


@dataclass(frozen=True)
class Outcome:
    """One sample of galaxies against the strong-lensing model.

    Attributes:
        sample: the galaxies, without the pixels near the critical curves.
        found: the comparison of both maps, as of `jaxlens lambda`.
        expected: lambda_rec of a noiseless map of the model itself, `(b,)`: what the mask, the edge and the
            convention of the reconstruction make of lambda = 1.
        expected_inner: the same of the inner range.
        sigma2: variance of the noise in the annuli, see `budget_real.aligned_variance`, `(b,)`.
        budget: errors.
        published: lambda_rec with the published model, `(b,)`, or None.
        published_inner: the same of the inner range, or None.
        density: selected galaxies per square arcminute of known pixels.
        slopes: of the shapes against the model, in the annuli.
        joint: images and map fitted together, or None.
        search: how many galaxies would show a transition; None if there is one, or it was not asked.
    """

    sample: Sample
    found: analysis_lambda.Outcome
    expected: np.ndarray
    expected_inner: float
    sigma2: Array
    budget: Budget
    published: np.ndarray | None
    published_inner: float | None
    density: float
    slopes: calibration_real.Slopes
    joint: joint_real.Joint | None = None
    search: density_real.Search | None = None


@dataclass(frozen=True)
class Analysis:
    """A cluster.

    Attributes:
        cluster: the input.
        options: how it was analysed.
        fit: of the images.
        quality: of the draws of its posterior.
        outcomes: one for each sample.
    """

    cluster: Cluster
    options: Options
    fit: strong.StrongFit
    quality: posterior.Quality
    outcomes: tuple[Outcome, ...]


def fit_images(
    cluster: Cluster, options: Options, on_step: Callable[[str], object] = lambda _: None
) -> tuple[strong.StrongFit, posterior.Draws]:
    """The model of the images with its weak prior, and draws of its posterior."""
    problem = cluster.strong.problem
    first, second = jax.random.split(jax.random.key(options.seed))
    on_step("fitting the images")
    fit = strong.fit(problem, key=first, n_starts=options.starts, start=cluster.strong.start, plane="source")
    on_step("drawing lenses")
    return fit, posterior.draws(problem, fit, second, options.draws)


def compare(
    cluster: Cluster,
    sample: Sample,
    lens: Lens,
    draws: Lens,
    options: Options,
    on_step: Callable[[str], object] = lambda _: None,
    fit: strong.StrongFit | None = None,
) -> Outcome:
    """lambda_rec(r) of one sample against a lens and its draws.

    Every source of error is drawn by itself and together with the others: ellipticities turned at random are
    added to the map, redshifts and the calibration are drawn from their priors, lenses from the posterior.

    Args:
        cluster: the input.
        sample: the galaxies.
        lens: the model of the images.
        draws: of its posterior, with a leading axis.
        options: how.
        on_step: called with what is being done.
        fit: of the images, for the joint fit; without it there is none.

    Raises:
        ValueError: if the maps share too few pixels, see `analysis_lambda.derive`.
    """
    n = options.draws
    # Keys by the name of the sample, which is neither of the two numbers that `fit_images` splits off.
    named = jax.random.fold_in(jax.random.key(options.seed), zlib.crc32(sample.key.encode()))
    keys = jax.random.split(named, 5)
    on_step(f"{sample.title}: maps")
    model = maps_of(lens, sample.field.grid, sample.field.smoothing)
    mean, width = sample.calibration
    ratio = sample.dls_ds
    clean = reduced(model, ratio)
    sample = sample.within(jnp.abs(clean) <= options.max_g)
    field, grid = sample.field, sample.field.grid
    invert = Inversion.of(sample)
    assert field.setup is not None
    turns = jax.random.split(keys[0], (n + 1) // 2)
    nulls = null_maps(turns, field.shear, grid, field.factor, field.setup.galaxies).g[:n]
    observed = jnp.asarray(field.shear.g)
    kappa_wl, own = invert.many(jnp.stack([observed / mean, clean]))
    # Noise enters as g (1 - kappa): it is that of a map of the model, not that of an empty field.
    noisy = invert.many(clean[None] + nulls / mean)
    sigma = jnp.sqrt(jnp.mean((noisy - own[None]) ** 2, axis=0))
    known = np.asarray(field.shear.weight) > 0.0
    pair = Pair(
        name=f"{cluster.name}, {sample.title}",
        kappa_wl=np.where(known, np.asarray(kappa_wl), 0.0),
        kappa_sl=np.asarray(ratio * model.smooth),
        kappa_true=None,
        sigma=np.asarray(sigma),
        weight=known.astype(float),
        grid=grid,
        plane=cluster.plane,
        reference=field.reference,
        smoothing=field.smoothing,
        dls_ds=ratio,
        scale_sl=ratio,
        header={"ZLENS": float(cluster.plane.z_l), "DLSDS": ratio, "SMOOTHAS": field.smoothing, "BUNIT": ""},
    )
    said = PairOptions(
        h=float(cluster.plane.cosmology.h),
        width=options.width,
        r_min=options.r_min,
        r_max=options.r_min + options.width * 40,
        inner=options.inner,
        seed=options.seed,
        sheet="inner",
        stay=STAY,
    )
    end = float(analysis_lambda.rings_of(pair, said).edges[-1])
    # A small field is divided too: at least two annuli lie beyond the inner range.
    said = replace(said, inner=(options.inner[0], min(options.inner[1], end - 2.0 * options.width)))
    radius = analysis_lambda.radius_of(pair, said)
    within = (radius >= said.inner[0]) & (radius < said.inner[1])
    inner = jnp.asarray(np.where(known & within, 1.0, 0.0))
    gauge = mass_sheet.ratio(own, ratio * model.smooth)
    expected_inner = mass_sheet.median(own, ratio * model.smooth, inner)
    bias = mass_sheet.regauge(own, expected_inner) - ratio * model.smooth
    rings = analysis_lambda.rings_of(pair, said)
    sigma2 = aligned_variance(noisy, own, ratio * model.smooth, rings, inner)
    found = analysis_lambda.derive(pair, said, np.asarray(bias), sigma2)
    expected = radial.profile_in(gauge.lam, rings, gauge.weight).median
    on_step(f"{sample.title}: errors")
    ratios, factors = depth_draws(sample, jax.random.split(keys[1], n))
    calibration = jnp.maximum(mean + width * jax.random.normal(keys[2], (n,)), 0.1 * mean)
    smooth = smooth_draws(draws, grid, field.smoothing)
    budget = budget_of(
        keys[3], invert, observed, nulls, (ratio, ratios), factors, (mean, calibration),
        (model.smooth, smooth), rings, inner, sigma2, bias,
    )  # fmt: skip
    published = published_inner = None
    area = known.sum() * (grid.pixel / 60.0) ** 2
    density = float(np.asarray(field.shear.n_gal)[known].sum() / area)
    if cluster.published is not None:
        on_step(f"{sample.title}: the published model")
        other = maps_of(cluster.published, grid, field.smoothing)
        lam, middle = statistics(kappa_wl[None], (ratio * other.smooth)[None], rings, inner)
        published, published_inner = np.asarray(lam[0]), float(middle[0])
    joint = search = None
    if options.joint and fit is not None:
        on_step(f"{sample.title}: images and map together")
        data = joint_real.map_data(sample, invert, model, own, inner, float(expected_inner))
        joint = joint_real.infer(cluster.strong.problem, fit, data, float(expected_inner))
    assert found.excess is not None
    if options.fields and not bool(found.excess.transition.found):
        on_step(f"{sample.title}: simulated fields")
        search = density_real.search(
            keys[4],
            invert,
            draws,
            ratio * model.smooth,
            nulls / mean,
            ratio,
            rings,
            inner,
            sigma2,
            bias,
            density,
        )
    slopes = calibration_real.slopes(sample, clean, rings)
    rest = published, published_inner, density, slopes, joint, search
    return Outcome(sample, found, np.asarray(expected), float(expected_inner), sigma2, budget, *rest)


def analyse(
    cluster: Cluster, options: Options | None = None, on_step: Callable[[str], object] = lambda _: None
) -> Analysis:
    """Fit the images, map the shear of every sample, and compare.

    Args:
        cluster: the input.
        options: how.
        on_step: called with what is being done.

    Raises:
        ValueError: if the maps share too few pixels.
    """
    options = options or Options()
    fit, drawn = fit_images(cluster, options, on_step)
    lens = cluster.strong.problem.predict(fit.u).lens
    outcomes = [compare(cluster, one, lens, drawn.lenses, options, on_step, fit) for one in cluster.samples]
    return Analysis(cluster, options, fit, drawn.quality, tuple(outcomes))
