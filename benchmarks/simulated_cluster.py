"""Simulated clusters: statistics of many draws, and the time of drawing, mapping and deflecting.

    python benchmarks/simulated_cluster.py [--smoke]

200 draws of the default settings (400 haloes). Every statistical check allows four standard errors of the
stated distribution: a false alarm in 16,000.

Typical: a map of 4096 x 4096 takes 2.3 s of processor time and 1.5 GB; a draw 13 ms; the deflection at 1000
points 35 ms with 1024 subhaloes, 104 ms with 3072 (best on a busy machine), compiled in 5 s for any number.
"""

import math
import resource
import sys
import time
from dataclasses import replace

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402
from scipy.stats import kstest  # noqa: E402

from jaxlens import Grid, Lens, lens  # noqa: E402
from jaxlens.lens import Component  # noqa: E402
from jaxlens.profiles import TSIS  # noqa: E402
from jaxlens.simulate import MERGER, ClusterSettings, SimulatedCluster, draw_cluster, render  # noqa: E402
from jaxlens.simulate import _subhaloes as subhaloes  # noqa: E402

FIRST = {"median": 4.140650, "scatter": 0.25, "count": 797.55, "fraction": 0.1504, "fraction_std": 0.0482}
"""The heavier halo, 6.75e14 Msun/h: median concentration, mean number and mass fraction of its subhaloes."""


def statistics(report: Report, made: list[SimulatedCluster]) -> None:
    """Number, masses and radii of subhaloes; concentrations and shapes."""
    n = len(made)
    first = [m.clumps[0] for m in made]
    variance = FIRST["scatter"] ** 2
    counts = np.array([c.subhalo_count for c in first])
    # E[cbar/c] = exp(s^2) and E[(cbar/c)^2] = exp(3 s^2) for a log-normal c.
    mean = FIRST["count"] * math.exp(variance)
    spread = math.sqrt(mean + FIRST["count"] ** 2 * (math.exp(3 * variance) - math.exp(2 * variance)))
    near(report, f"subhaloes of 6.75e14 Msun/h with scatter of c, {n} draws", counts.mean(), mean, spread, n)
    log_c = np.log([c.concentration for c in first]) - math.log(FIRST["median"])
    near(report, "mean ln c minus its median", log_c.mean(), 0.0, FIRST["scatter"], n)
    near(report, "scatter of ln c", log_c.std(), FIRST["scatter"], FIRST["scatter"] / math.sqrt(2.0), n)
    near(report, "mean a/c", float(np.mean([c.axis_ratios[0] for c in first])), 0.416, 0.087, n)
    q = np.array([c.q for c in first])
    near(report, "median projected axis ratio", float(np.median(q)), 0.563, 1.25 * 0.152, n)

    mass = np.concatenate([m.subhaloes["mass_msun"] for m in made]) * 0.7
    light = np.log(mass[mass < 1e12] / 1e10)
    slopes = np.linspace(-1.0, -0.8, 2001)
    likelihood = np.log(slopes / np.expm1(slopes * math.log(100.0))) + slopes * light.mean()
    slope = slopes[np.argmax(likelihood)]
    claim = f"slope of the subhalo mass function {slope:.4f} (-0.90 +- 0.02)"
    report.check(claim, abs(slope + 0.9) < 0.02, smoke=False)
    if report.smoke:
        return
    # Radii in the frame of the ellipsoid, through the distribution function of each halo's own concentration.
    places = []
    for m in made:
        for i, clump in enumerate(m.clumps):
            mine = m.subhaloes["clump"] == i
            scale = float(m.plane.kpc_per_arcsec)
            x = (m.subhaloes["x_arcsec"][mine] - clump.x_arcsec) * scale
            y = (m.subhaloes["y_arcsec"][mine] - clump.y_arcsec) * scale
            at = np.stack([x, y, m.subhaloes["z_kpc"][mine]], axis=1) @ np.array(clump.turn)
            a_c, b_c = clump.axis_ratios
            at /= np.array([a_c, b_c, 1.0]) / np.cbrt(a_c * b_c)
            radius = np.linalg.norm(at, axis=1) / (1e3 * clump.r_vir_mpc)
            places.append(subhaloes.fraction_within(radius, clump.concentration))
    chance = float(kstest(np.concatenate(places), "uniform").pvalue)
    report.check(f"radii of all subhaloes: Kolmogorov-Smirnov probability {chance:.3f}", chance > 1e-4)


def near(report: Report, what: str, found: float, expected: float, spread: float, n: int) -> None:
    """Check a mean of n numbers with standard deviation `spread`."""
    error = spread / math.sqrt(n)
    claim = f"{what}: {found:.4g}, expected {expected:.4g} +- {error:.2g}"
    report.check(claim, abs(found - expected) < 4.0 * error, smoke=False)


def fixed_concentration(report: Report, n: int) -> None:
    """Number and mass fraction with c at its mean, where cbar/c = 1."""
    c = FIRST["median"] * math.exp(0.5 * FIRST["scatter"] ** 2)
    settings = ClusterSettings(clumps=(replace(MERGER[0], concentration=c),))
    clumps = [draw_cluster(jax.random.key(s), settings).clumps[0] for s in range(n)]
    counts = np.array([clump.subhalo_count for clump in clumps])
    near(report, "subhaloes with c at its mean", counts.mean(), FIRST["count"], math.sqrt(FIRST["count"]), n)
    fractions = np.array([clump.subhalo_mass_msun / clump.mass_msun for clump in clumps])
    near(report, "mass in subhaloes", fractions.mean(), FIRST["fraction"], FIRST["fraction_std"], n)
    if not report.smoke:
        # 3.2 standard errors of 200 draws: one false alarm in 700.
        off = fractions.mean() - FIRST["fraction"]
        report.check(f"mass in subhaloes {fractions.mean():.4f} (0.150 +- 0.011)", abs(off) < 0.011)


def mean_kappa(made: SimulatedCluster, capacity: int) -> float:
    """Mean convergence at z_s = 2 over 8' x 8', from the flux of the deflection through the edge."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    at = (np.linspace(-240.0, 232.0, 60)[:, None] + 4.0 * (1.0 + nodes)).ravel()
    side = np.full_like(at, 240.0)
    edges = [np.stack(s, axis=-1) for s in ((side, at), (-side, at), (at, side), (at, -side))]
    alpha = np.asarray(_alpha(padded(made.lens, capacity), jnp.asarray(np.concatenate(edges)))).reshape(
        4, -1, 2
    )
    out = alpha[0, :, 0] - alpha[1, :, 0] + alpha[2, :, 1] - alpha[3, :, 1]
    return float(made.plane.dls_ds(2.0)) * float(np.sum(np.tile(weights, 60) * out)) * 4.0 / (2.0 * 480.0**2)


_alpha = jax.jit(lens.alpha)


def padded(of: Lens, capacity: int) -> Lens:
    """The lens with massless subhaloes up to `capacity`, so that one program serves all draws."""
    component = of.components["subhaloes"]
    spare = capacity - len(component)
    params = TSIS(
        theta_e=jnp.pad(component.params.theta_e, (0, spare)),
        r_t=jnp.pad(component.params.r_t, (0, spare), constant_values=1.0),
    )
    centre = jnp.pad(component.centre, ((0, spare), (0, 0)), constant_values=1e4)
    return Lens({**of.components, "subhaloes": Component(params, centre=centre)})


def maps(report: Report, made: SimulatedCluster) -> None:
    """The map of the default cluster: time, memory, and agreement with the lens."""
    side = 256 if report.smoke else 4096
    grid = Grid((side, side), 480.0 / side)
    render(made, grid)  # compiles
    start, used = time.perf_counter(), time.process_time()
    kappa = render(made, grid)
    wall, used = time.perf_counter() - start, time.process_time() - used
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6

    rng = np.random.default_rng(1)
    i, j = rng.integers(0, side, (2, 300))
    x, y = np.asarray(grid.x)[j], np.asarray(grid.y)[i]
    centres = np.concatenate([np.asarray(c.centre) for c in made.lens.components.values()])
    gaps = np.max(np.abs(centres[:, :, None] - np.stack([x, y])), axis=1)
    away = (gaps > 5.0 * grid.pixel).all(axis=0)
    exact = np.asarray(lens.kappa(made.lens, jnp.asarray(np.stack([x, y], axis=-1)[away])))
    error = float(np.max(np.abs(kappa[i, j][away] / exact - 1.0)))
    report.measure(
        "map",
        lambda: render(made, grid),
        size={"side": side},
        error=lambda _: error,
        compiled=False,
        seconds=0.1,
    )
    report.check(f"map against the lens: {error:.1e} (4e-5)", error < 4e-5)
    # Processor time of all threads: a bound on the time of an idle machine, whatever else runs on this one.
    claim = f"map takes {used:.1f} s of processor time (15 s), {wall:.1f} s by the clock"
    report.check(claim, used < 15.0, smoke=False)
    report.check(f"memory of the process {peak:.2f} GB (3 GB)", peak < 3.0)


def main(arguments: list[str] | None = None) -> int:
    report = Report("simulated_cluster", parser(__doc__ or "").parse_args(arguments))
    n = 4 if report.smoke else 200
    made = [draw_cluster(jax.random.key(s)) for s in range(n)]
    maps(report, made[0])
    report.measure(
        "draw", lambda: draw_cluster(jax.random.key(1)), size={"draws": 1}, compiled=False, seconds=0.5
    )
    statistics(report, made)
    fixed_concentration(report, n)

    sampled = made[: n if report.smoke else 60]
    capacity = max(len(m.subhaloes["mass_msun"]) for m in sampled)
    kappas = np.array([mean_kappa(m, capacity) for m in sampled])
    span = f"{kappas.mean():.4f}, from {kappas.min():.3f} to {kappas.max():.3f} in {len(sampled)} draws"
    claim = f"mean kappa(z_s = 2) over 8' x 8': {span} (0.11 to 0.15)"
    report.check(claim, 0.11 < kappas.mean() < 0.15, smoke=False)

    theta = jax.random.uniform(jax.random.key(3), (1000, 2), minval=-60.0, maxval=60.0)
    for count in (64,) if report.smoke else (128, 1024, 3072):
        few = Lens(
            {
                **made[0].lens.components,
                "subhaloes": jax.tree.map(
                    lambda leaf, count=count: jnp.resize(leaf, (count, *leaf.shape[1:])),
                    made[0].lens.components["subhaloes"],
                ),
            }
        )
        report.measure("deflection", lens.alpha, few, theta, size={"points": 1000, "subhaloes": count})
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
