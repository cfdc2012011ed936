"""Accuracy of weak-lensing maps on a two-clump cluster: all schemes, divergence, shape noise.

    python benchmarks/weak_accuracy.py [--smoke]

The width of the mass-sheet factor (kappa - 1)/(kappa_true - 1) over 100-700 kpc/h says how well a map is the
truth up to one mass sheet; its absolute value is a convention of padding, band and ridge.
"""

import sys
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402
from _mock import Mock, elliptical_potentials, half_width, peak, skewness, two_clumps  # noqa: E402

from jaxlens import weak  # noqa: E402

COMPONENT_SCATTER = {0.0: 0.2400, 0.1: 0.2376, 0.3: 0.2205, 0.5: 0.1855}


def schemes(report: Report, mock: Mock) -> None:
    """Noiseless signature of the five schemes, iterations 1 to 20, R = 1e-3."""
    widths = {}
    smoothings = (0.0,) if report.smoke else (0.0, 15.0)
    for smoothing in smoothings:
        for name in ("K2", "A1", "A2") if report.smoke else weak.SCHEMES:
            kappa0 = jnp.asarray(0.8 * mock.kappa) if name == "A3" else None
            made = weak.reconstruct(
                mock.shear(),
                mock.grid,
                scheme=name,
                n_iter=20,
                ridge=1e-3,
                smoothing=smoothing,
                kappa0=kappa0,
            )
            lam = mock.lam(np.asarray(made.history[4]))
            widths[name, smoothing] = half_width(lam)
            each = " ".join(f"{half_width(mock.lam(np.asarray(k))):.5f}" for k in made.history)
            print(
                f"{name}, smoothing {smoothing:.0f} arcsec, iteration 5: peak {peak(lam):.4f}, median "
                f"{np.median(lam):.4f}, half-width {half_width(lam):.5f}, skewness {skewness(lam):.2f}, "
                f"spectral radius {float(made.spectral_radius):.3f}"
                f", last change {float(made.change[-1]):.1e}\n"
                f"   half-width by iteration: {each}"
            )
            if name == "A1":
                last = float(made.change[-1])
                report.check(
                    f"A1, smoothing {smoothing:.0f}: change {last:.1e} at iteration 20",
                    last < 1e-6,
                )
    # Of coarse pixels and few realisations, as smoke runs have, the limits below are not true.
    claim = f"A2 half-width {widths['A2', 0.0]:.1e}, raw g (limit 5e-4)"
    report.check(claim, widths["A2", 0.0] < 5e-4, smoke=False)
    for smoothing in smoothings:
        ratio = widths["K2", smoothing] / widths["A2", smoothing]
        claim = f"K2 / A2 width {ratio:.1f}, smoothing {smoothing:.0f} (at least 3)"
        report.check(claim, ratio > 3, smoke=False)


def divergence(report: Report, mock: Mock) -> None:
    """Where the plain iteration fails, and says so."""
    options: dict[str, Any] = {"smoothing": 0.0, "scheme": "A1", "n_iter": 20}
    made = weak.reconstruct(
        mock.shear(), mock.grid, band="none", ridge=1e-4, cg_tol=1e-5, cg_steps=2000, **options
    )
    radius = float(made.spectral_radius)
    report.check(
        f"no band, R = 1e-4: spectral radius {radius:.2f}, said to diverge", radius > 1 and not made.converged
    )
    steep = elliptical_potentials()
    options |= {"ridge": 1e-3, "cg_tol": 1e-4, "cg_steps": 1000}
    few: dict[str, Any] = {**options, "n_iter": 2}
    radius = 0.0
    for name, one in (("elliptical convergence", mock), ("elliptical potentials", steep)):
        bare = weak.reconstruct(one.shear(np.ones(one.grid.shape)), one.grid, **few)
        masked = weak.reconstruct(one.shear(), one.grid, **few)
        radius = float(bare.spectral_radius)
        print(
            f"{name}: |g| up to {np.abs(one.g).max():.1f}, spectral radius {radius:.2f} "
            f"without a mask, {float(masked.spectral_radius):.2f} with |g| <= 0.5"
        )
    report.check(
        f"no mask, elliptical potentials: spectral radius {radius:.2f} is 1.3 to 2",
        1.3 < radius < 2.0,
    )
    everything = mock.shear(np.ones(mock.grid.shape))
    options |= {"ridge": 1e-3, "cg_tol": 1e-5}
    made = weak.reconstruct(everything, mock.grid, **options)
    radius = float(made.spectral_radius)
    report.check(f"no mask: spectral radius {radius:.2f}, said to diverge", radius > 1 and not made.converged)
    solved = weak.reconstruct(everything, mock.grid, solver="gmres", power_steps=0, **options)
    width = half_width(mock.lam(np.asarray(solved.kappa)))
    report.check(
        f"no mask, GMRES: half-width {width:.4f} (limit 0.005)", width < 0.005 and bool(solved.converged)
    )


def gaussian(parts: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether the mean of 12 galaxies, one pixel, is nearly a Gaussian of the width 0.24/sqrt(12)."""
    scatter = np.sqrt(0.5 * sum(part.var() for part in parts)) / 0.24
    shape = [abs(skewness(part)) / 12**0.5 for part in parts]
    shape += [abs(float(np.mean((part - part.mean()) ** 4) / part.var() ** 2) - 3.0) / 12 for part in parts]
    return max(shape) < 0.1 and abs(scatter - 1.0) < 0.05


def moments(report: Report) -> None:
    """Moments of one galaxy's ellipticity under the exact transformation, by a large sample."""
    n = 200_000 if report.smoke else 4_000_000
    eps = 0.24 * jax.random.normal(jax.random.key(0), (2, n))
    eps = eps[0] + 1j * eps[1]
    for g in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5):
        seen = weak.observed_ellipticity(eps, jnp.full(n, g + 0j))
        parts = np.asarray(seen.real), np.asarray(seen.imag)
        scatter = np.sqrt(0.5 * sum(part.var() for part in parts))
        kurtosis = [float(np.mean((p - p.mean()) ** 4) / p.var() ** 2 - 3) for p in parts]
        offset = abs(complex(jnp.mean(seen)) - g)
        print(
            f"|g| = {g}: scatter per component {scatter:.4f} (along g {parts[0].std():.4f}), "
            f"<e> - g = {offset:.1e}, "
            f"skewness along g {skewness(parts[0]):.3f}, excess kurtosis {kurtosis[0]:.3f}, {kurtosis[1]:.3f}"
            f"; {'Gaussian' if gaussian(parts) else 'not Gaussian'}"
        )
        report.check(
            f"|g| = {g}: a pixel of 12 galaxies is {'' if g <= 0.2 else 'not '}Gaussian, to 5 % in width and "
            "0.1 in skewness and kurtosis",
            gaussian(parts) == (g <= 0.2),
        )
        report.check(f"|g| = {g}: <e> - g = {offset:.1e}, 4 standard errors", offset < 4 * 0.34 / np.sqrt(n))
        if g in COMPONENT_SCATTER:
            expected = COMPONENT_SCATTER[g]
            report.check(
                f"|g| = {g}: scatter {scatter:.4f} is {expected} to 1 %", abs(scatter / expected - 1) < 0.01
            )


def noisy(report: Report, mock: Mock) -> None:
    """Shape noise: A2 keeps its peak, K2 becomes asymmetric; R = 1e-2 with and without noise."""
    seeds = 3 if report.smoke else 20
    counts = weak.mean_counts(mock.grid, mock.plane)
    capacity, g, weight = weak.capacity_of(float(counts.sum())), jnp.asarray(mock.g), jnp.asarray(mock.weight)
    draw = jax.jit(lambda key: weak.shape_noise(key, g, counts, capacity=capacity, weight=weight))
    drawn = jax.lax.map(draw, jax.random.split(jax.random.key(1), seeds))
    report.check("no realisation overflows", not bool(jnp.any(drawn.overflow)))
    report.measure("one noise realisation", draw, jax.random.key(3), size={"pixels": g.size})
    skews = {}
    for name in ("A2", "K2"):
        clean = peak(mock.lam(np.asarray(weak.reconstruct(mock.shear(), mock.grid, scheme=name).kappa)))
        lams = [mock.lam(np.asarray(k)) for k in weak.reconstruct_many(drawn, mock.grid, scheme=name).kappa]
        peaks = np.array([peak(lam) for lam in lams])
        skews[name] = np.array([skewness(lam) for lam in lams])
        scatter = peaks.std(ddof=1)
        offset, error = peaks.mean() - clean, scatter / np.sqrt(seeds)
        print(
            f"{name}: peak {clean:.4f} without noise, offset {offset:+.4f} +- {error:.4f}, "
            f"scatter {scatter:.4f}, half-width {np.mean([half_width(lam) for lam in lams]):.4f}, "
            f"skewness {skews[name].mean():+.2f} +- {skews[name].std(ddof=1):.2f}"
        )
        if name == "A2":
            report.check(
                f"A2: noise moves the peak by {offset:+.4f} (scatter {scatter:.4f})",
                abs(offset) < scatter,
                smoke=False,
            )
    difference = skews["A2"] - skews["K2"]
    error = difference.std(ddof=1) / np.sqrt(seeds)
    report.check(
        f"K2 is more skewed than A2 by {difference.mean():.2f} +- {error:.2f} (at least 0.4, 3 sigma)",
        difference.mean() > 0.4 and difference.mean() > 3 * error,
        smoke=False,
    )


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    report = Report("weak_accuracy", parser(__doc__ or "").parse_args(arguments))
    mock = two_clumps(n=24 if report.smoke else 48, oversample=2 if report.smoke else 8)
    schemes(report, mock)
    if not report.smoke:
        divergence(report, mock)
    moments(report)
    noisy(report, mock)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
