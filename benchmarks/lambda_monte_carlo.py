"""Monte Carlo of the mass-sheet factor on a two-clump cluster: time, the peaks with noise, the transition.

    python benchmarks/lambda_monte_carlo.py [--smoke]

48 x 48 pixels, A2 and K2, R = 1e-2, iteration 5; the strong-lensing map is the truth with an error that
grows beyond 150 kpc/h. One realisation after the other (`lax.map`) is compared with a batch (`vmap`): the
driver uses what is faster. What it cannot do without are the random draws (Poisson counts, two Gaussian
numbers a galaxy) and five matrix products for each map: NumPy does these alone, in the same precision, in
the same run. The error is that of the mean lambda_P (A2, 100-700 kpc/h) against the run in double
precision, which is checked against the mean of other random numbers.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402
from _mock import H, Mock, two_clumps  # noqa: E402

from jaxlens import monte_carlo as mc  # noqa: E402
from jaxlens import transition, weak  # noqa: E402
from jaxlens.monte_carlo._draw import draws, reconstructions  # noqa: E402
from jaxlens.monte_carlo._measure import aligned_clean, measure_all  # noqa: E402


def strong_map(mock: Mock, amplitude: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """The truth with a smooth random error beyond 150 kpc/h, and its reduced shear."""
    noise = jnp.asarray(np.random.default_rng(0).normal(size=mock.kappa.shape))
    ripple = np.asarray(weak.smooth(noise, mock.grid, 20.0))
    error = amplitude * ripple / ripple.std() * np.clip((mock.radius - 150.0) / 200.0, 0.0, 1.0)
    gamma = mock.g * (1.0 - mock.kappa) + np.asarray(weak.shear_of(jnp.asarray(error)))
    kappa = mock.kappa + error
    return kappa, gamma / (1.0 - kappa)


def prepare(mock: Mock, dtype: str = "float64", **options: Any) -> mc.Setup:
    """The set-up of the mock with that map."""
    kappa_sl, g_sl = strong_map(mock)
    return mc.prepare(
        jnp.asarray(mock.g),
        jnp.asarray(mock.kappa),
        jnp.asarray(kappa_sl),
        weak.mean_counts(mock.grid, mock.plane),
        jnp.asarray(mock.weight),
        mock.grid,
        position=mock.grid.theta * float(mock.plane.kpc_per_arcsec) * H,
        edges=np.arange(50.0, 701.0, 50.0),
        g_sl=jnp.asarray(g_sl),
        dtype=dtype,
        **options,
    )


def parts(report: Report, setup: mc.Setup) -> None:
    """Where the time of a block goes, and `lax.map` against `vmap` for what is measured."""
    key, clean, fine = jax.random.key(0), aligned_clean(setup), jnp.ones(mc.BLOCK, bool)
    size = {"realisations": mc.BLOCK}
    draw = eqx.filter_jit(lambda s: draws(key, jnp.asarray(0), s, mc.BLOCK)[0])
    report.measure("draw and smooth", draw, setup, size=size, compiled=False)
    g = draw(setup)
    invert = eqx.filter_jit(lambda g, s: {n: made.kappa for n, made in reconstructions(g, s).items()})
    report.measure("A2 and K2", invert, g, setup, size=size, compiled=False)
    kappas = invert(g, setup)
    none = jnp.zeros(mc.BLOCK, jnp.int32)

    def one(given: Any, s: mc.Setup) -> Any:
        maps, good, empty = given
        return measure_all(maps, s, good, empty, clean)

    mapped = eqx.filter_jit(lambda k, s: jax.lax.map(lambda x: one(x, s), (k, fine, none)))
    batched = eqx.filter_jit(lambda k, s: jax.vmap(lambda x: one(x, s))((k, fine, none)))
    slow = report.measure("measure, vmap", batched, kappas, setup, size=size, compiled=False)
    fast = report.measure("measure, lax.map", mapped, kappas, setup, size=size, compiled=False)
    report.ratio("measuring a block of maps, time of lax.map over vmap", fast, slow, most=1.15)


def least_work(setup: mc.Setup, n: int) -> Callable[[], None]:
    """Random draws and matrix products of n realisations by NumPy, in blocks as ours and in its precision."""
    rng = np.random.default_rng(0)
    counts, matrix = np.asarray(setup.counts), np.asarray(setup.inverse.matrix)
    # The columns of pixels without weight are zero: nobody needs them.
    matrix = np.ascontiguousarray(matrix[:, np.any(matrix != 0.0, axis=0)])
    kind = matrix.dtype
    data = rng.standard_normal((mc.BLOCK, matrix.shape[1]), dtype=kind.type)

    def run() -> None:
        for _ in range(0, n, mc.BLOCK):
            for _ in range(mc.BLOCK):
                galaxies = int(rng.poisson(counts).sum())
                rng.standard_normal((2, galaxies), dtype=kind.type)
            for _ in range(setup.n_iter):
                data @ matrix.T

    return run


def peaks(found: mc.LambdaProfiles) -> np.ndarray:
    """lambda_P of every realisation, A2, 100-700 kpc/h."""
    return np.asarray(found.good.a2.peak)[:, 2]


def beside_least_work(report: Report, mock: Mock, n: int) -> None:
    """Both precisions against the work that cannot be avoided."""
    key = jax.random.key(2026)
    double = jax.block_until_ready(prepare(mock, "float64"))
    # Its error is not that of a program: lambda_P has none but the scatter of the random numbers.
    one, other = (peaks(mc.lambda_profiles(k, double, n)) for k in (key, jax.random.key(2027)))
    off = abs(float(one.mean() - other.mean()))
    standard = float(np.hypot(one.std(ddof=1), other.std(ddof=1)) / n**0.5)
    report.check(
        f"mean lambda_P of {n} realisations by two keys: {off:.1e} apart, standard error {standard:.1e} "
        "(limit 4 of them)",
        off < 4.0 * standard,
    )
    for dtype, setup in (("float64", double), ("float32", jax.block_until_ready(prepare(mock, "float32")))):
        size = {"realisations": n, "bits": int(dtype[-2:])}
        error = lambda found: abs(float(peaks(found).mean() - one.mean()))
        ours = report.measure(
            f"lambda(r), {dtype}",
            lambda s: mc.lambda_profiles(key, s, n),
            setup,
            size=size,
            error=error if dtype == "float32" else None,
            compiled=False,
            seconds=0.0,
            least=2,
        )
        theirs = report.measure(
            f"draws and products alone, {dtype}, NumPy",
            least_work(setup, n),
            size=size,
            compiled=False,
            traced=True,
            seconds=0.0,
            least=2,
        )
        claim = f"{n} realisations of lambda(r), {dtype}, time over that of random draws and matrix products"
        report.ratio(claim, ours, theirs, most=3.0)
    worst = next(row.error for row in report.rows if row.error is not None)
    report.check(f"mean lambda_P, float32 against float64: {worst:.0e} (limit 1e-3)", worst < 1e-3)


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    report = Report("lambda_monte_carlo", parser(__doc__ or "").parse_args(arguments))
    mock = two_clumps(n=16 if report.smoke else 48, oversample=2 if report.smoke else 8)
    n = 64 if report.smoke else 1000
    beside_least_work(report, mock, n)
    begin = time.perf_counter()
    setup = jax.block_until_ready(prepare(mock, "float32"))
    print(f"set-up {time.perf_counter() - begin:.1f} s")
    key = jax.random.key(2026)
    begin = time.perf_counter()
    mc.lambda_profiles(key, setup, 1)
    print(f"compilation and the first block {time.perf_counter() - begin:.1f} s")
    kept: list[mc.LambdaProfiles] = []

    def everything(s: mc.Setup) -> Any:
        kept.append(mc.lambda_profiles(key, s, n))
        return kept.pop(0) if len(kept) > 1 else kept[0]

    size = {"realisations": n}
    row = report.measure("all", everything, setup, size=size, compiled=False, seconds=0.0)
    assert row.cpu_ms is not None
    taken, used = 1e-3 * row.median_ms, 1e-3 * row.cpu_ms
    claim = f"{n} realisations in {taken:.1f} s (limit 15), processor time {used:.1f} s"
    report.check(claim, taken < 15.0, smoke=False)
    if not report.smoke:
        parts(report, setup)
    found = kept[0]
    good, (free, _) = found.good, mc.noiseless(setup)
    print(f"bad {found.n_bad}, with an empty pixel {found.n_empty}")
    for name in ("a2", "k2", "rec"):
        noisy, clean = getattr(good, name), getattr(free, name)
        for kind in ("peak", "biweight", "median"):
            values = np.asarray(getattr(noisy, kind))
            print(
                f"{name} {kind:8s} noiseless {np.round(np.asarray(getattr(clean, kind)), 4)}, noisy "
                f"{np.round(values.mean(axis=0), 4)} +- {np.round(values.std(axis=0, ddof=1), 4)}"
            )
    shift = float(np.mean(np.asarray(good.a2.peak)[:, 2]) - float(free.a2.peak[2]))
    ratio = float(free.k2.half_width[2] / free.a2.half_width[2])
    # True of 48 x 48 pixels and a thousand realisations, as is the place of the transition.
    report.check(
        f"noise moves the mean A2 peak by {shift:+.4f} (limit 0.003)", abs(shift) < 0.003, smoke=False
    )
    report.check(f"K2/A2 noiseless width {ratio:.1f} (at least 3)", ratio > 3.0, smoke=False)
    excess = transition.excess_variance(
        key, transition.mean_moments(good.moments), setup.rings, found.sigma_wl2, setup.bias
    )
    shape = transition.shape_errors(setup.clean["A2"], setup.kappa_sl, setup.kappa_true, setup.rings)
    places = transition.crossings(setup.rings.r, shape.sl, jnp.mean(good.shape, axis=0))
    crossing = float(np.asarray(places.radius)[np.argmax(np.asarray(places.direction) == 1)])
    single = jax.lax.map(
        lambda m: (
            transition.excess_variance(key, m, setup.rings, found.sigma_wl2, setup.bias, n=1).transition
        ),
        good.moments,
    )
    radii = np.asarray(single.radius)[np.asarray(single.found)]
    print(
        f"transition: shape errors {crossing:.0f}, excess variance {float(excess.transition.radius):.0f} "
        f"kpc/h; one map {np.round(np.percentile(radii, [16, 50, 84])) if len(radii) else radii}, found in "
        f"{np.asarray(single.found).mean():.2f}"
    )
    near = bool(excess.transition.found) and abs(float(excess.transition.radius) - crossing) < 75.0
    report.check("the mean excess variance is within 75 kpc/h of the shape crossing", near, smoke=False)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
