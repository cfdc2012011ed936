"""Convergence map of a simulated cluster with about a thousand subhaloes, beside a plain NumPy sum.

    python benchmarks/map_render.py [--smoke] [--full] [--out FILE]

The map of 8 x 8 arcmin: closed forms of haloes and galaxies at every pixel, subhaloes (truncated
isothermal spheres) as stamps of their own size, means over the pixel where the convergence is infinite.
NumPy evaluates the same closed forms one profile after the other, without those means: each subhalo where
it is not zero ("stamps"), and, as one would write it down first, on the whole map; none of the packages
that are compared with has these subhaloes. The error is relative to the convergence of the lens at 300
pixels beyond those means, good to 4e-5 itself where haloes are tabulated sums. Maps of 128 to 4096 pixels
a side; the sums in NumPy up to 512 (with `--full` 1024).
"""

import sys
from dataclasses import replace
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402

from jaxlens import lens as lensing  # noqa: E402
from jaxlens.grid import Grid  # noqa: E402
from jaxlens.profiles import NFW, TSIS, Hernquist  # noqa: E402
from jaxlens.simulate import ClusterSettings, SimulatedCluster, draw_cluster, render  # noqa: E402

SIDE_ARCSEC = 480.0
TABULATED = 4e-5
"""Largest error of a tabulated sum."""
AWAY = 4.5
"""Pixels from a centre, in rows or columns, up to which `render` takes means over the pixel."""


def _angle(u: np.ndarray) -> np.ndarray:
    """arccosh(1/u)/sqrt(1 - u^2), by its other branch beyond 1."""
    inside = u < 1.0
    low, high = np.where(inside, u, 0.5), np.where(inside, 2.0, u)
    return np.where(
        inside,
        np.arccosh(1.0 / low) / np.sqrt(1.0 - low**2),
        np.arccos(1.0 / high) / np.sqrt(high**2 - 1.0),
    )


def closed_form(params: Any, k: int, xi: np.ndarray) -> np.ndarray:
    """Convergence of the k-th profile at elliptical radii, arcsec."""
    if isinstance(params, TSIS):
        r_t = float(params.r_t[k])
        u = xi / r_t
        inside = np.where(u < 1.0, u, 0.5)
        return np.where(
            u < 1.0, 0.5 * (float(params.theta_e[k]) / r_t) ** 2 * np.arccos(inside) / inside, 0.0
        )
    u = xi / float(params.r_s[k])
    if isinstance(params, NFW):
        return 2.0 * float(params.kappa_s[k]) * (1.0 - _angle(u)) / (u**2 - 1.0)
    assert isinstance(params, Hernquist)
    return float(params.kappa_s[k]) * ((2.0 + u**2) * _angle(u) - 3.0) / (u**2 - 1.0) ** 2


def window(at: np.ndarray, centre: float, half: float) -> slice:
    """The places of the ascending coordinates `at` within `half` of a centre."""
    return slice(*np.searchsorted(at, (centre - half, centre + half)))


def plain_sum(cluster: SimulatedCluster, grid: Grid, stamps: bool) -> np.ndarray:
    """Every profile, one after the other: at every pixel, or subhaloes within their radius alone."""
    x, y = np.asarray(grid.x), np.asarray(grid.y)
    total = np.zeros(grid.shape)
    for component in cluster.lens.components.values():
        e = np.asarray(getattr(component.params, "e", np.zeros(len(component))))
        centres, angles = np.asarray(component.centre), np.asarray(component.pa)
        for k in range(len(component)):
            (x0, y0), pa, q = centres[k], float(angles[k]), 1.0 - float(e[k])
            rows = columns = slice(None)
            if stamps and isinstance(component.params, TSIS):
                r_t = float(component.params.r_t[k])
                rows, columns = window(y, y0, r_t), window(x, x0, r_t)
            d_x, d_y = x[columns][None, :] - x0, y[rows][:, None] - y0
            along = np.cos(pa) * d_x + np.sin(pa) * d_y
            across = np.cos(pa) * d_y - np.sin(pa) * d_x
            xi = np.sqrt(q * along**2 + across**2 / q)
            total[rows, columns] += closed_form(component.params, k, xi)
    return total


def as_arrays(cluster: SimulatedCluster) -> SimulatedCluster:
    """The cluster with NumPy arrays: reading a number of a JAX array costs more than a stamp."""
    return replace(cluster, lens=jax.tree.map(np.asarray, cluster.lens))


def error_of(cluster: SimulatedCluster, grid: Grid) -> Any:
    """Largest relative error at up to 300 pixels away from all centres.

    Raises:
        ValueError: if fewer than 30 of many random pixels are.
    """
    rng = np.random.default_rng(1)
    i, j = rng.integers(0, grid.shape[0], (2, 10_000))
    x, y = np.asarray(grid.x)[j], np.asarray(grid.y)[i]
    centres = np.concatenate([np.asarray(c.centre) for c in cluster.lens.components.values()])
    away = np.ones(len(i), bool)
    for centre in centres:
        away &= np.maximum(np.abs(x - centre[0]), np.abs(y - centre[1])) > AWAY * grid.pixel
    places = np.flatnonzero(away)[:300]
    if len(places) < 30:
        raise ValueError(f"{len(places)} of {len(i)} pixels are away from all centres; 30 are needed.")
    i, j = i[places], j[places]
    exact = np.asarray(lensing.kappa(cluster.lens, jnp.asarray(np.stack([x, y], axis=-1)[places])))
    return lambda kappa: float(np.max(np.abs(kappa[i, j] / exact - 1.0)))


def main(arguments: list[str] | None = None) -> int:
    """Sweep the pixels."""
    report = Report("map_render", parser(__doc__ or "").parse_args(arguments))
    few = ClusterSettings(m_min_msun_h=1e12) if report.smoke else None
    cluster = draw_cluster(jax.random.key(0), few)
    plain, profiles = as_arrays(cluster), len(lensing.centres(cluster.lens))
    sides = (128, 256) if report.smoke else (128, 512, 1024, 2048, 4096)
    last = 256 if report.smoke else 1024 if report.full else 512
    times = []
    for side in sides:
        grid = Grid((side, side), SIDE_ARCSEC / side)
        same = {
            "size": {"side": side, "profiles": profiles},
            "error": error_of(cluster, grid),
            "compiled": False,
            "seconds": 0.5,
        }
        ours = report.measure("map", lambda grid=grid: render(cluster, grid), **same)
        times.append(ours.median_ms)
        if side > last:
            continue
        same |= {"traced": True, "least": 1}
        whole, stamps = (
            report.measure(f"map, {name}", lambda grid=grid, s=s: plain_sum(plain, grid, s), **same)
            for name, s in (("NumPy with whole maps", False), ("NumPy with stamps", True))
        )
        what = f"convergence map of {profiles} profiles, {side} x {side}"
        report.as_exact(what, ours, whole, TABULATED)
        report.faster(what, ours, stamps, 1.0 if side == last else None, error=TABULATED)
    slope = np.polyfit(np.log(np.array(sides[-2:]) ** 2.0), np.log(times[-2:]), 1)[0]
    report.check(f"time grows as pixels^{slope:.2f} (limit 1.2)", slope < 1.2, smoke=False)
    worst = max(row.error for row in report.rows if row.error is not None)
    report.check(f"maps against the lens: {worst:.1e} (limit {TABULATED:.0e})", worst < TABULATED)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
