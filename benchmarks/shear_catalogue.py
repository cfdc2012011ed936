"""Maps, profiles, aperture mass and bootstrap of a shear catalogue, against the number of galaxies.

    python benchmarks/shear_catalogue.py [--smoke] [--out FILE]

Galaxies are spread evenly over 10 x 10 arcmin; the map has 48 x 48 pixels. References are plain NumPy sums.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Report, parser

from jaxlens import weak
from jaxlens.grid import Grid

GRID = Grid.square(600.0, 12.5)
EDGES = np.geomspace(20.0, 280.0, 9)
RADIUS = 100.0


def catalogue(n: int, seed: int = 0) -> weak.Galaxies:
    """`n` galaxies with noise and weights."""
    rng = np.random.default_rng(seed)
    eps = rng.normal(scale=0.3, size=n) + 1j * rng.normal(scale=0.3, size=n)
    return weak.Galaxies(rng.uniform(-300.0, 300.0, (n, 2)), eps, rng.uniform(0.5, 2.0, n))


def plain(galaxies: weak.Galaxies) -> tuple[np.ndarray, np.ndarray, float]:
    """Map of g, tangential profile and aperture mass at the origin, by NumPy."""
    x, y = np.asarray(galaxies.theta).T
    w, eps = np.asarray(galaxies.weight), np.asarray(galaxies.eps)
    r, phi = np.hypot(x, y), np.arctan2(y, x)
    e_t = -np.real(eps * np.exp(-2j * phi))
    n, ends = GRID.shape[0], np.linspace(-300.0, 300.0, GRID.shape[0] + 1)
    flat = np.searchsorted(ends, y, side="right") - 1, np.searchsorted(ends, x, side="right") - 1
    total, signal = np.zeros((n, n)), np.zeros((n, n), complex)
    np.add.at(total, flat, w)
    np.add.at(signal, flat, w * eps)
    ring = np.histogram(r, EDGES, weights=w)[0]
    profile = np.histogram(r, EDGES, weights=w * e_t)[0] / ring
    u = r[r < RADIUS] / RADIUS
    q = 6.0 * u**2 * (1.0 - u**2)
    aperture = np.sum((w * e_t)[r < RADIUS] * q) / np.sum(w[r < RADIUS])
    return signal / np.where(total > 0.0, total, 1.0), profile, float(aperture)


def main(arguments: list[str] | None = None) -> int:
    """Run the sweep."""
    report = Report("shear_catalogue", parser(__doc__ or "").parse_args(arguments))
    edges, origin = jnp.asarray(EDGES), jnp.zeros((1, 2))
    to_grid = jax.jit(lambda galaxies: weak.to_grid(galaxies, GRID))
    at_origin = jax.jit(lambda galaxies: weak.aperture_mass(galaxies, origin, RADIUS))
    everywhere = jax.jit(lambda galaxies: weak.aperture_map(galaxies, GRID, RADIUS))
    errors = jax.jit(lambda key, galaxies: weak.bootstrap(key, galaxies, edges, n=50))
    worst = 0.0
    for n in (2000,) if report.smoke else (2000, 10000, 50000):
        galaxies, size = catalogue(n), {"galaxies": n}
        g, profile, aperture = plain(galaxies)
        rows = [
            report.measure(
                "map", to_grid, galaxies, size=size, error=lambda s, g=g: float(np.abs(s.g - g).max())
            ),
            report.measure(
                "profile",
                weak.tangential_profile,
                galaxies,
                edges,
                size=size,
                error=lambda p, profile=profile: float(np.abs(p.g_t - profile).max()),
            ),
            report.measure(
                "one aperture",
                at_origin,
                galaxies,
                size=size,
                error=lambda m, aperture=aperture: abs(float(m.signal[0]) - aperture),
            ),
        ]
        worst = max([worst, *(row.error for row in rows if row.error is not None)])
        report.measure("aperture map", everywhere, galaxies, size=size)
        report.measure("bootstrap, 50 samples", errors, jax.random.key(0), galaxies, size=size)
    report.check(
        f"map, profile and aperture mass equal plain sums to {worst:.0e} (limit 1e-12)", worst < 1e-12
    )
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
