"""Weak lensing of the shipped fields: position of the peak, E against B mode, stacked groups of COSMOS.

    python benchmarks/weak_real.py [--smoke] [--out FILE]

The peak must lie within 20 arcsec or two of its bootstrap errors of the brightest galaxy, the origin.
"""

import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402

from jaxlens import analysis_weak, datasets, io, weak, workflow_weak  # noqa: E402


def cluster(report: Report, name: str) -> None:
    """What `jaxlens weak` finds."""
    draws = 8 if report.smoke else 32
    field = workflow_weak.field(name)
    found = analysis_weak.derive(field, analysis_weak.Options(draws=draws))
    assert found.peak_error is not None and found.b_beyond_e is not None and found.profile is not None
    off, error = float(np.hypot(*found.peak.theta)), float(np.hypot(*found.peak_error))
    signal = found.profile.significance
    modes = {"E": found.e, "B": found.b, "B beyond E": found.b_beyond_e}
    print(f"{field.name}, {2 * draws} null maps:")
    print(
        f"  peak {off:.1f} arcsec from the brightest galaxy, bootstrap error {error:.1f}, "
        f"S/N {found.snr.max():.1f}"
    )
    for label, mode in modes.items():
        print(f"  {label} mode: chi2 per pixel {mode.chi2:.2f}, {mode.significance:.1f} sigma")
    print(f"  shear: tangential {signal.tangential:.1f} sigma, cross {signal.cross:.1f} sigma")
    report.check(
        f"{field.name}: peak within 20 arcsec or 2 sigma of the BCG ({off:.1f} +- {error:.1f})",
        off < max(20.0, 2.0 * error),
        smoke=False,
    )
    report.check(
        f"{field.name}: E mode {modes['E'].significance:.1f} sigma, above B beyond E by far "
        f"({modes['B beyond E'].significance:.1f} sigma)",
        modes["E"].significance > 3.0 + modes["B beyond E"].significance,
        smoke=False,
    )
    made = lambda shear: weak.reconstruct(shear, field.grid, smoothing=field.smoothing, power_steps=0).kappa
    report.measure(field.name, made, field.shear, size={"pixels": field.shear.weight.size})


def cosmos(report: Report) -> None:
    """Tangential shear about all X-ray groups of the field, and about random points."""
    setup = workflow_weak.load("cosmos")
    groups = io.read_places(
        datasets.path("cosmos") / "xray_groups.csv", setup.config.reference, name="xray_id"
    )
    edges = setup.edges
    whole = edges[jnp.array([0, -1])]
    profile = weak.stack(setup.galaxies, edges, jnp.asarray(groups.theta))
    for i in range(len(edges) - 1):
        print(
            f"  r = {profile.r[i]:5.1f} arcsec: g_t = {profile.g_t[i]:+.4f} +- {profile.sigma_t[i]:.4f}, "
            f"g_x = {profile.g_x[i]:+.4f} +- {profile.sigma_x[i]:.4f}"
        )
    total = weak.stack(setup.galaxies, whole, jnp.asarray(groups.theta))
    low, high = np.percentile(np.asarray(setup.galaxies.theta), [10.0, 90.0], axis=0)
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(low, high, (20 if report.smoke else 100, len(groups.theta), 2)))
    null = np.array([float(weak.stack(setup.galaxies, whole, one).g_t[0]) for one in points])
    tangential = float(total.g_t[0] / total.sigma_t[0])
    cross = float(total.g_x[0] / total.sigma_x[0])
    empirical = float((total.g_t[0] - null.mean()) / null.std(ddof=1))
    print(
        f"COSMOS, {len(groups.theta)} groups, {edges[0]:.0f} to {edges[-1]:.0f} arcsec: "
        f"g_t = {total.g_t[0]:.4f}, {tangential:.1f} sigma by shapes, {empirical:.1f} sigma against "
        f"{len(null)} sets of random points; cross {cross:.1f} sigma"
    )
    report.check(
        f"COSMOS: stacked shear {tangential:.1f} sigma, cross {cross:.1f}",
        tangential > 2.0 and abs(cross) < 3.0,
    )
    stacked = lambda galaxies: weak.stack(galaxies, edges, jnp.asarray(groups.theta)).g_t
    report.measure("stack", stacked, setup.galaxies, size={"groups": len(groups.theta)})


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    report = Report("weak_real", parser(__doc__ or "").parse_args(arguments))
    for name in ("as1063",) if report.smoke else ("as1063", "abell2744"):
        cluster(report, name)
    cosmos(report)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
