"""Four real clusters from wide boxes, beside their published models: images, masses, hold-out by systems.

The published halos are read from the tables that ship with each data set and judged by the same code in
the same run. An rms is given by every definition of the source position; it counts only with all images
produced, each observed one by a predicted image of its own. By definitions other than `tensor` and the one
of the quoted rms, as many may be missing as the published model misses. In the hold-out a quarter of the
systems at a time is left out of the fit; the published model had seen all of them.

Typical figures (rms `tensor` in arcsec, fitted and published; all images produced, every start agrees):
SMACS J0723 0.167 and 0.295, Abell 2744 0.429 and 0.591, MACS J1149 0.366 and 0.709. A low rms alone is not a
better model: look at the hold-out. Not reached: by definition `mean` 3 of 152 images of MACS J1149 are not
produced, and M(<200 kpc) of Abell 2744 is 4.2 % above the published model's (limit 3 %).

    python benchmarks/strong_real.py [--cluster NAME] [--smoke]
"""

import sys
import time
from dataclasses import dataclass
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402

from jaxlens import datasets, radial, strong, workflow  # noqa: E402
from jaxlens._types import Array  # noqa: E402

RADII_KPC = (50.0, 100.0, 200.0)
FOLDS = 4
IGNORED = 1e4  # position error that takes an image out of a fit, arcsec, without compiling it anew


@dataclass(frozen=True)
class Target:
    """What the published model is.

    Attributes:
        free: its number of free parameters.
        quoted: the definition of the source position that reproduces its quoted rms.
        rms: that rms and the one by definition `tensor`, arcsec.
    """

    free: int
    quoted: str
    rms: dict[str, float]


TARGETS = {
    "as1063": Target(11, "mu_mean", {"tensor": 0.417, "mu_mean": 0.495}),
    "smacs0723": Target(46, "mean", {"tensor": 0.295, "mean": 0.318}),
    "abell2744": Target(21, "mu_mean", {"tensor": 0.591, "mu_mean": 0.671}),
    "macs1149": Target(54, "mean", {"tensor": 0.705, "mean": 0.737}),
}


def published(name: str, setup: workflow.Setup) -> strong.Prediction:
    """The published lens, and the redshifts of its sources."""
    z = datasets.reference_redshifts(name)
    ratios = setup.plane.dls_ds(jnp.array([z[system] for system in setup.problem.images.systems]))
    return strong.Prediction(datasets.reference_lens(name), ratios)


@eqx.filter_jit
def _chi2_by_system(prediction: strong.Prediction, images: strong.ImageCatalogue, ratio: Array) -> Array:
    one = strong.Prediction(prediction.lens, jnp.full_like(prediction.dls_ds, ratio))
    rows = strong.source_plane_residuals(one, images)
    return jax.ops.segment_sum(jnp.sum(rows**2, axis=1), images.source, images.n_systems)


def best_redshifts(
    prediction: strong.Prediction, problem: strong.Problem, systems: np.ndarray
) -> strong.Prediction:
    """Free distance ratios of the `systems` `(s,)` bool at the smallest source-plane chi^2, lens fixed."""
    images = problem.images
    names = [f"dls_ds.{system}" for system in images.systems]
    free = [k for k, name in enumerate(names) if systems[k] and name in problem.bounds]
    if not free:
        return prediction
    box = problem.bounds[names[free[0]]]
    assert isinstance(box, strong.Box)
    grid = np.asarray(jnp.linspace(box.lo, box.hi, 401))[1:-1]
    table = np.stack([_chi2_by_system(prediction, images, jnp.asarray(ratio)) for ratio in grid])
    ratios = np.array(prediction.dls_ds)
    ratios[free] = grid[np.argmin(table, axis=0)][free]
    return strong.Prediction(prediction.lens, jnp.asarray(ratios))


def rows_of(predicted: dict[str, Any], images: strong.ImageCatalogue) -> str:
    return ", ".join(
        f"{key} {one.rms(images):.4f} ({one.n_produced}/{images.n_images})" for key, one in predicted.items()
    )


def hold_out(name: str, setup: workflow.Setup, theirs: strong.PredictedImages, n_starts: int) -> None:
    """Fit without a quarter of the systems, and predict the images of that quarter.

    A free redshift of a system that was left out is the one at which its own images agree best.
    """
    problem, images = setup.problem, setup.problem.images
    source, observed = np.asarray(images.source), np.asarray(images.theta)
    folds = np.random.default_rng(0).permutation(np.arange(images.n_systems) % FOLDS)
    square: dict[str, list[np.ndarray]] = {"train": [], "held out": [], "published": []}
    missing = dict.fromkeys(square, 0)
    for fold in range(FOLDS):
        out = folds[source] == fold
        sigma = jnp.asarray(np.where(out, IGNORED, np.asarray(images.sigma_pos)))
        part = eqx.tree_at(lambda p: p.images.sigma_pos, problem, sigma)
        fit = strong.fit(part, key=jax.random.key(fold + 1), n_starts=n_starts, start=setup.start)
        prediction = best_redshifts(strong.Prediction(fit.lens, fit.dls_ds), problem, folds == fold)
        ours = strong.predict(prediction, images, definitions=("tensor",))["tensor"]
        said = []
        for key, rows, one in (("train", ~out, ours), ("held out", out, ours), ("published", out, theirs)):
            distance = np.linalg.norm(one.theta - observed, axis=1)[one.produced & rows]
            square[key].append(distance**2)
            missing[key] += int((~one.produced & rows).sum())
            said.append(f"{key} {np.sqrt(np.mean(distance**2)):.3f}")
        print(f"{name} fold {fold + 1} of {FOLDS}, chi2 {float(fit.chi2):.2f}: {', '.join(said)}", flush=True)
    for key, parts in square.items():
        every = np.concatenate(parts)
        print(
            f"{name} hold-out, {key}: rms {np.sqrt(every.mean()):.4f} arcsec, median offset "
            f"{np.sqrt(np.median(every)):.4f}, {missing[key]} images not produced",
            flush=True,
        )


def cluster(name: str, report: Report) -> None:
    """One cluster against its published model."""
    setup = workflow.load(name)
    assert setup.config is not None
    problem, images, said, target = setup.problem, setup.problem.images, setup.config.fit, TARGETS[name]
    n_free = strong.total_size(problem.bounds)
    print(
        f"\n{name}: {images.n_images} images, {images.n_systems} systems, {n_free} free numbers "
        f"(published {target.free}), weak prior {said.weak_prior}",
        flush=True,
    )
    if report.smoke:
        size = {"images": images.n_images, "free": n_free}
        u = jnp.zeros(n_free)
        report.measure(f"{name} chi2", lambda v: jnp.sum(strong.residuals(v, problem) ** 2), u, size=size)
        return
    began = time.perf_counter()
    reference = published(name, setup)

    def tell(start: strong.Start) -> None:
        print(
            f"{name} start {start.number}: chi2 {start.chi2:.4f} (data {start.chi2_data:.3f}), {start.steps} "
            f"steps, {start.seconds:.1f} s{'' if start.converged else ', not converged'}; "
            f"at a bound: {', '.join(start.at_bound) or 'nothing'}",
            flush=True,
        )

    fit = strong.fit(
        problem,
        key=jax.random.key(0),
        n_starts=said.starts,
        start=setup.start,
        plane=said.plane,
        definition=said.definition,
        on_start=tell,
    )
    seconds = time.perf_counter() - began
    fitted = strong.Prediction(fit.lens, fit.dls_ds)
    ours, theirs = strong.predict(fitted, images), strong.predict(reference, images)
    print(f"{name}: chi2 {float(fit.chi2):.3f} + priors {float(fit.chi2_prior):.3f}, {seconds:.0f} s")
    print(f"{name} fitted:    rms in arcsec (images produced): {rows_of(ours, images)}")
    print(f"{name} published: rms in arcsec (images produced): {rows_of(theirs, images)}")
    for key in strong.DEFINITIONS:
        limit = target.rms.get(key, theirs[key].rms(images))
        found = ours[key].rms(images)
        report.check(
            f"{name}: rms ({key}) {found:.4f}, published {limit:.3f}",
            found <= limit,
        )
        gone = [images.image_ids[k] for k in np.flatnonzero(~ours[key].produced)]
        allowed = 0 if key in target.rms else images.n_images - theirs[key].n_produced
        report.check(
            f"{name}: distinct images ({key}) without: {', '.join(gone) or 'none'} (allowed {allowed})",
            len(gone) <= allowed,
        )
    bound = fit.at_bound
    report.check(f"{name}: at a bound, at most one number: {', '.join(bound) or 'nothing'}", len(bound) <= 1)
    n = len(fit.starts)
    report.check(f"{name}: {fit.agreeing} of {n} starts agree (all but one)", fit.agreeing >= n - 1)
    radii = jnp.array(RADII_KPC) / setup.plane.kpc_per_arcsec
    ratio = radial.mass_within(fitted.lens, setup.plane, radii) / radial.mass_within(
        reference.lens, setup.plane, radii
    )
    masses = ", ".join(f"{float(one):.4f}" for one in ratio)
    report.check(
        f"{name}: M(<50, 100, 200 kpc) fitted/published {masses} (within 3 %)",
        bool(jnp.all(jnp.abs(ratio - 1.0) < 0.03)),
    )
    for key, value in strong.reported(setup.model, fit.params).items():
        print(f"{name}   {key} = {float(value):.4g}")
    if report.options.hold_out:
        hold_out(name, setup, theirs["tensor"], report.options.hold_out)


def main(arguments: list[str] | None = None) -> int:
    """Run everything, or one cluster."""
    options = parser(__doc__ or "")
    options.add_argument("--cluster", choices=sorted(TARGETS), help="this one alone")
    options.add_argument(
        "--hold-out", type=int, default=2, help="starts of every fit of the hold-out; 0 for none"
    )
    report = Report("strong_real", options.parse_args(arguments))
    only_one = report.options.cluster
    for name in [only_one] if only_one else list(TARGETS)[: 1 if report.smoke else None]:
        cluster(name, report)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
