"""Simulated clusters: the figures of the default, draws over many seeds, time of a mock, and its fit.

The paper's cluster has 22 systems with 68 images, fitted with an rms of 0.186 arcsec and chi2_nu = 0.95.

    python benchmarks/simulate.py [--smoke]
"""

import dataclasses
import resource
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402

from jaxlens import (  # noqa: E402
    config_simulate,
    results,
    results_simulate,
    simulate,
    strong,
    workflow,
)
from jaxlens import lens as lensing  # noqa: E402
from jaxlens.grid import Grid  # noqa: E402

SMALL = simulate.ClusterSettings(m_min_msun_h=1e12)
REFERENCE = {"sources": 662.095, "galaxies": 26720.62}
SYSTEMS, IMAGES = (18, 26), (54, 82)
"""The band by which the default seed was chosen."""


def settings_of(report: Report) -> simulate.Settings:
    """The default, or one of few subhaloes and coarse maps."""
    if not report.smoke:
        return simulate.Settings()
    return simulate.Settings(cluster=SMALL, shear=simulate.ShearSettings(map_pixels=512, mode="padded"))


def counts(report: Report, plane: simulate.SimulatedCluster) -> None:
    """Expected numbers, and the number of sources over draws."""
    settings, lens_plane = simulate.SourceSettings(), plane.plane
    expected = simulate.expected_sources(settings, lens_plane).expected(settings.box_arcsec**2)
    off = expected / REFERENCE["sources"] - 1.0
    report.check(f"expected sources {expected:.3f}, off by {off:.1e} (limit 3e-3)", abs(off) < 3e-3)
    mean = float(simulate.mean_counts(simulate.ShearSettings(), lens_plane).sum())
    report.check(f"expected galaxies {mean:.2f} (26720.62)", abs(mean - REFERENCE["galaxies"]) < 0.01)
    limit = simulate.limiting_magnitude(np.array([0.0, 50.0, 100.0, 200.0]), simulate.ImageSettings())
    good = np.abs(limit - [28.0, 28.590, 28.948, 29.297]).max() < 6e-4
    report.check(f"m_lim at 0, 50, 100, 200 kpc: {np.round(limit, 3).tolist()}", bool(good))
    n = 5 if report.smoke else 200
    drawn = [len(simulate.draw_sources(jax.random.key(seed), settings, lens_plane)) for seed in range(n)]
    pull = (np.mean(drawn) - expected) / (expected / n) ** 0.5
    spread = np.var(drawn) / expected
    print(f"sources over {n} seeds: mean {np.mean(drawn):.1f}, variance/mean {spread:.2f}")
    report.check(
        f"mean number of sources {pull:+.1f} standard errors from expectation (limit 4)", abs(pull) < 4
    )


def mock(report: Report, settings: simulate.Settings) -> simulate.Mock:
    """The default cluster: time, every image, the bands of the default seed, the shear."""
    seed = simulate.DEFAULT_SEED
    start = time.perf_counter()
    simulate.strong_mock(seed, settings)
    first = time.perf_counter() - start
    row = report.measure(
        "strong-lensing mock",
        lambda: simulate.strong_mock(seed, settings),
        size={"seed": seed},
        compiled=False,
        seconds=0.0,
        note=f"first call {first:.1f} s",
    )
    after = row.median_ms / 1e3
    report.check(
        f"strong-lensing mock {after:.1f} s after compilation (limit 20 s); first call {first:.1f} s",
        after < 20.0,
        smoke=False,
    )
    start = time.perf_counter()
    made = simulate.mock(seed, settings)
    print(f"whole mock, {settings.shear.map_pixels} pixels: {time.perf_counter() - start:.1f} s")
    found, sources, lens = made.strong, made.strong.sources, made.cluster.lens
    ratio = jnp.asarray(sources.dls_ds[found.images.source])
    back = np.asarray(lensing.ray_trace(lens, jnp.asarray(found.images.theta), ratio))
    off = float(np.abs(back - sources.beta[found.images.source]).max())
    report.check(f"{len(found.images)} images solve the lens equation to {off:.0e} arcsec", off < 1e-6)
    report.check(
        f"{len(found.images.doubtful)} sources whose images do not add up", not len(found.images.doubtful)
    )
    truth = found.catalogue.truth
    report.check(
        "every image of the catalogue is brighter than its limit", bool(np.all(truth.mag < truth.limit))
    )
    systems, images = found.catalogue.n_systems, found.catalogue.n_images
    print(f"{systems} systems, {images} images; caustic margin {found.caustic_margin:.2f} arcsec")
    report.check(
        f"default seed {seed}: {systems} systems (18-26), {images} images (54-82)",
        in_band(found.catalogue),
        smoke=False,
    )
    kappa = float(made.cluster.plane.dls_ds(2.0)) * float(made.field.fine.mean())
    text = f"mean kappa of the field, z_s = 2: {kappa:.4f} (1 - 1/1.146 = 0.1274 in the paper)"
    if report.smoke:  # another cluster
        print(text)
    else:
        report.check(f"{text}, between 0.11 and 0.15", 0.11 < kappa < 0.15)
    return made


def in_band(catalogue: simulate.Catalogue) -> bool:
    """Whether a seed could be the default."""
    return SYSTEMS[0] <= catalogue.n_systems <= SYSTEMS[1] and IMAGES[0] <= catalogue.n_images <= IMAGES[1]


def rule(report: Report, settings: simulate.Settings) -> None:
    """The default seed is the first in the band: those before it are out."""
    if report.smoke:
        return
    found = {seed: simulate.strong_mock(seed, settings).catalogue for seed in range(simulate.DEFAULT_SEED)}
    counts = ", ".join(f"{seed} ({one.n_systems}, {one.n_images})" for seed, one in found.items())
    report.check(
        f"seeds before the default one, with systems and images: {counts}; none in the band",
        not any(in_band(one) for one in found.values()),
    )


def default_map(report: Report, settings: simulate.Settings) -> None:
    """Draw and map of the default cluster after compilation, and the most memory of the process so far."""
    key, grid = simulate.stage_keys(simulate.DEFAULT_SEED)["cluster"], settings.shear.map_grid
    draw = lambda: simulate.render(simulate.draw_cluster(key, settings.cluster), grid)
    draw()
    row = report.measure("draw and map", draw, size={"side": grid.shape[0]}, compiled=False, seconds=0.0)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    report.check(
        f"default cluster drawn and mapped on {grid.shape[0]} x {grid.shape[1]} in "
        f"{row.median_ms / 1e3:.1f} s (limit 15 s)",
        row.median_ms < 15e3,
        smoke=False,
    )
    report.check(f"memory of the process {peak:.2f} GB (limit 3 GB)", peak < 3.0)


def shear(report: Report, made: simulate.Mock) -> None:
    """The modes of the shear against that of the lens itself.

    The criterion is the median over the unmasked pixels of a ring; how many are worse is printed beside it.
    """
    settings = made.strong.settings.shear
    ratio, radius = float(made.cluster.plane.dls_ds(2.0)), np.asarray(settings.grid.radius)
    gamma = {}
    for mode in simulate.SHEAR_MODES:
        said = dataclasses.replace(settings, mode=mode)
        draw = partial(simulate.render, made.cluster)
        gamma[mode] = np.asarray(simulate.true_field(made.cluster.lens, draw, said).gamma)
    used = np.abs(np.asarray(made.bins[0].g)) <= settings.g_max
    clear = used & ~beside_subhaloes(made, settings.grid)
    for mode in ("extended", "padded", "periodic"):
        off = ratio * np.abs(gamma[mode] - gamma["analytic"])
        rings = [off[used & (radius >= a) & (radius < b)] for a, b in ((96, 160), (160, 240), (240, 340))]
        median = [float(np.median(ring)) for ring in rings]
        rms = [float(np.sqrt(np.mean(ring**2))) for ring in rings]
        print(
            f"{mode}: median {np.round(median, 5).tolist()}, rms {np.round(rms, 5).tolist()} in three rings"
        )
        if mode == "extended":
            claim = f"extended shear: median error {max(median):.1e} (limit 1e-3)"
            report.check(claim, max(median) < 1e-3, smoke=False)
            for where, pixels in (("unmasked pixels", used), ("of them clear of subhaloes", clear)):
                print(
                    f"  {pixels.sum()} {where}: {np.mean(off[pixels] > 1e-3):.1%} off by more than 1e-3, "
                    f"95th percentile {np.percentile(off[pixels], 95):.1e}"
                )


def beside_subhaloes(made: simulate.Mock, grid: Grid) -> np.ndarray:
    """Pixels within 15 arcsec of a subhalo with an Einstein radius above 0.1 arcsec for z_s = 2, `(y, x)`.

    The shear theta_E/(2 R) of a singular sphere is infinite at its centre: where that is 0.6 arcsec from one
    of the 8 x 8 points of a pixel, this point alone contributes 1e-3 to the mean, so the analytic shear is
    itself in error there.
    """
    subhaloes = made.cluster.lens.components["subhaloes"]
    # theta_E of the truncated sphere near its centre, pi theta_e^2/(2 r_t): its kappa is half that over R.
    inner = 0.5 * np.pi * np.asarray(subhaloes.params.theta_e) ** 2 / np.asarray(subhaloes.params.r_t)
    centre = np.asarray(subhaloes.centre)[float(made.cluster.plane.dls_ds(2.0)) * inner > 0.1]
    near = np.zeros(grid.shape, bool)
    for at in centre:
        near |= np.hypot(*np.moveaxis(np.asarray(grid.theta) - at, -1, 0)) < 15.0
    return near


def files(report: Report, made: simulate.Mock) -> None:
    """The same seed twice, another seed, and the fit of what was written."""
    said = config_simulate.Simulate(
        seed=made.strong.seed,
        cluster=made.strong.settings.cluster,
        shear=made.strong.settings.shear,
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        results_simulate.write(made, said, folder / "a")
        again = simulate.mock(said.seed, said.settings)
        results_simulate.write(again, said, folder / "b")
        data = [path for path in (folder / "a").iterdir() if path.suffix not in (".pdf", ".png")]
        same = all(path.read_bytes() == (folder / "b" / path.name).read_bytes() for path in data)
        report.check(f"{len(data)} data files have the same bytes twice", same)
        other = simulate.strong_mock(said.seed + 1, said.settings)
        report.check("another seed is another mock", differs(made.strong, other))
        fit_of(report, folder / "a")


def differs(one: simulate.StrongMock, other: simulate.StrongMock) -> bool:
    """Whether no halo, subhalo, source or image of two mocks is the same."""
    pairs = (
        (np.array([c.concentration for c in m.cluster.clumps]) for m in (one, other)),
        (m.cluster.subhaloes["x_arcsec"] for m in (one, other)),
        (m.sources.z for m in (one, other)),
        (m.sources.beta.ravel() for m in (one, other)),
        (m.catalogue.theta.ravel() for m in (one, other)),
    )
    return not any(np.intersect1d(a, b).size for a, b in pairs)


def fit_of(report: Report, folder: Path) -> None:
    """The model of the paper on the images that were written, beside its figures."""
    setup = workflow.load(str(folder))
    images = setup.problem.images
    n_free = strong.total_size(setup.problem.bounds)
    fit = strong.fit(setup.problem, key=jax.random.key(0), n_starts=1 if report.smoke else 8)
    outcome = results.derive(setup, fit)
    rms = outcome.main.rms(images)
    chi2 = (rms / 0.15) ** 2 * outcome.main.n_produced
    nu = chi2 / (2 * images.n_images - n_free)
    print(
        f"fit: chi2 {float(fit.chi2):.2f} (source plane), rms {rms:.3f} arcsec (paper: 0.186), "
        f"chi2_nu {nu:.2f} (paper: 0.95), {outcome.main.n_produced} of {images.n_images} images produced, "
        f"{fit.agreeing} of {len(fit.starts)} starts agree, at a bound: {list(fit.at_bound) or 'nothing'}"
    )
    report.check(f"the model has {n_free} free numbers (26)", n_free == 26)


def main() -> int:
    """Run everything."""
    report = Report("simulate", parser(__doc__ or "").parse_args())
    settings = settings_of(report)
    default_map(report, settings)
    made = mock(report, settings)
    rule(report, settings)
    counts(report, made.cluster)
    shear(report, made)
    files(report, made)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
