"""Simulated twins of a real field: the same images, galaxies, noise and mask, with a known lens."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as lensing
from jaxlens import lens_equation, mass_sheet, radial, transition, weak
from jaxlens._nulls_weak import null_maps
from jaxlens._types import Array, RandomKey
from jaxlens.analysis_real import Outcome
from jaxlens.density_real import clumps
from jaxlens.lens import Lens
from jaxlens.maps_real import STAY, Inversion, maps_of, reduced
from jaxlens.workflow_real import Cluster, depth_draws

MERGED = 0.3
"""Images of a system closer than this are one, arcsec."""


@dataclass(frozen=True)
class Truth:
    """What a twin is made of.

    Attributes:
        lens: the lens.
        calibration: m of each sample, by key.
        dls_ds: D_LS/D_S of the map of each sample, by key.
        images_kept: share of the images for which the lens has one.
    """

    lens: Lens
    calibration: dict[str, float]
    dls_ds: dict[str, float]
    images_kept: float


@dataclass(frozen=True)
class Judgement:
    """A twin's result beside its truth.

    Attributes:
        lam: lambda_rec of the inner range.
        interval: its 68 % interval.
        lam_true: lambda of the inner range without noise, against the true convergence.
        radius: transition that was found; NaN without one.
        radius_interval: its 68 % interval; NaN without one.
        share: share of the draws with a transition.
        radius_true: where the true error variances of both maps are equal; NaN if nowhere.
    """

    lam: float
    interval: tuple[float, float]
    lam_true: float
    radius: float
    radius_interval: tuple[float, float]
    share: float
    radius_true: float

    @property
    def lam_inside(self) -> bool:
        """Whether the true lambda lies inside the interval."""
        return self.interval[0] <= self.lam_true <= self.interval[1]

    @property
    def radius_inside(self) -> bool | None:
        """Whether the true transition lies inside the interval; None where the truth has none."""
        if np.isnan(self.radius_true):
            return None
        return self.radius_interval[0] <= self.radius_true <= self.radius_interval[1]


def _images(problem: eqx.Module, u: Array, lens: Lens, key: RandomKey) -> tuple[Array, float]:
    """Noisy images of a lens for the observed systems, `(i, 2)`, and the share that exists.

    The source of a system lies where its observed images go on average. An image that the lens does not
    have, or that another of its system has taken, stays where it was observed.
    """
    images = problem.images  # pyright: ignore[reportAttributeAccessIssue]
    ratio = problem.predict(u).dls_ds[images.source]  # pyright: ignore[reportAttributeAccessIssue]
    back = lensing.ray_trace(lens, images.theta, ratio)
    n = images.n_systems
    count = jax.ops.segment_sum(jnp.ones(len(ratio)), images.source, n)
    beta = jax.ops.segment_sum(back, images.source, n) / count[:, None]
    found, good = lens_equation.images_from(lens, images.theta, beta[images.source], ratio)
    apart = jnp.linalg.norm(found[:, None] - found[None], axis=-1)
    same = (images.source[:, None] == images.source[None]) & ~jnp.eye(len(ratio), dtype=bool)
    good &= ~jnp.any(same & (apart < MERGED), axis=1)
    theta = jnp.where(good[:, None], found, images.theta)
    noise = images.sigma_pos[:, None] * jax.random.normal(key, theta.shape)
    return theta + noise, float(jnp.mean(good))


def twin(
    cluster: Cluster, u: Array, lens: Lens, key: RandomKey, *, substructure: bool = True
) -> tuple[Cluster, Truth]:
    """A cluster that looks like the real one and whose lens is known.

    Args:
        cluster: the real one.
        u: its fit, for the redshifts of systems without one.
        lens: the true lens of the twin before subhaloes are added, for example the published model.
        key: of everything random; of another seed than the analysis of the twin.
        substructure: add subhaloes that the model lacks; without them the strong-lensing map is as good as
            its model, the null test of a transition.
    """
    keys = jax.random.split(key, 3 + 3 * len(cluster.samples))
    if substructure:
        lens = Lens({**lens.components, "clumps": clumps(keys[0])})
    problem = cluster.strong.problem
    theta, kept = _images(problem, u, lens, keys[1])
    problem = eqx.tree_at(lambda p: p.images.theta, problem, theta)
    samples, m, ratios = [], {}, {}
    for k, one in enumerate(cluster.samples):
        a, b, c = keys[3 + 3 * k : 6 + 3 * k]
        mean, width = one.calibration
        m[one.key] = float(jnp.maximum(mean + width * jax.random.normal(a), 0.1 * mean))
        ratio, factor = (float(part[0]) for part in depth_draws(one, b[None]))
        ratios[one.key] = ratio
        field = one.field
        true = reduced(maps_of(lens, field.grid, field.smoothing), ratio)
        assert field.setup is not None
        noise = null_maps(c[None], field.shear, field.grid, field.factor, field.setup.galaxies).g[0]
        shear = weak.ShearMap(m[one.key] / factor * true + noise, field.shear.weight, field.shear.n_gal)
        samples.append(replace(one, field=replace(field, shear=shear)))
    strong = replace(cluster.strong, problem=problem)
    made = replace(cluster, strong=strong, samples=tuple(samples), published=None)
    return made, Truth(lens, m, ratios, kept)


def judge(found: Outcome, truth: Truth) -> Judgement:
    """The result of a twin beside its truth.

    The true transition is where the excess-variance ratio q of the true errors rises through 1: shape errors,
    that is, both maps have their best mass sheet, against the noise and method error of weak lensing.
    """
    sample, pair, rings = found.sample, found.found.pair, found.found.rings
    excess = found.found.excess
    assert excess is not None
    grid, smoothing, ratio = pair.grid, pair.smoothing, truth.dls_ds[sample.key]
    maps = maps_of(truth.lens, grid, smoothing)
    true = ratio * maps.smooth
    clean = Inversion.of(sample).many(reduced(maps, ratio)[None])[0]
    radius = found.found.radius
    low, high = found.found.options.inner
    inner = jnp.asarray(np.where((radius >= low) & (radius < high), pair.weight, 0.0))

    middle = lambda values: mass_sheet.median(values, true, inner)
    lam_true = middle(clean)
    sl = jnp.asarray(pair.kappa_sl) * (ratio / pair.dls_ds)
    error = radial.mean_in((mass_sheet.regauge(sl, middle(sl)) - true) ** 2, rings)
    bias = radial.mean_in((mass_sheet.regauge(clean, lam_true) - true) ** 2, rings)
    noise = found.sigma2 / lam_true**2
    real = transition.first_rise(rings.r, transition.smooth_profile(error / (noise + bias)), STAY)
    made = excess.transition
    interval = found.budget.interval or (np.nan, np.nan)
    return Judgement(
        lam=float(found.found.inner.median),
        interval=found.budget.inner_interval(),
        lam_true=float(lam_true),
        radius=float(made.radius) if bool(made.found) else np.nan,
        radius_interval=interval,
        share=found.budget.share,
        radius_true=float(real.radius) if bool(real.found) else np.nan,
    )
