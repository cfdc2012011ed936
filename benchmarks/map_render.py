"""Convergence map of a simulated cluster with about a thousand subhaloes, beside a plain NumPy sum.

    python benchmarks/map_render.py [--smoke] [--full] [--out FILE]

The map of 8 x 8 arcmin: closed forms of haloes and galaxies at every pixel, subhaloes (truncated isothermal
spheres) as stamps of their own size, means over the pixel where the convergence is infinite. NumPy adds the
same closed forms of all profiles to the whole map, one after the other, as one would write it down; no
package on the index has these subhaloes. The error is relative to the convergence of the lens at 300 pixels
away from all centres, good to 4e-5 itself where haloes are tabulated sums. Maps of 128 to 4096 pixels a side;
the sum in NumPy up to 512 (with `--full` 1024).
"""

import sys
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


def plain_sum(cluster: SimulatedCluster, grid: Grid) -> np.ndarray:
    """Every profile at every pixel."""
    x, y = np.asarray(grid.x)[None, :], np.asarray(grid.y)[:, None]
    total = np.zeros(grid.shape)
    for component in cluster.lens.components.values():
        e = np.asarray(getattr(component.params, "e", np.zeros(len(component))))
        for k in range(len(component)):
            (x0, y0), pa, q = np.asarray(component.centre[k]), float(component.pa[k]), 1.0 - float(e[k])
            along = np.cos(pa) * (x - x0) + np.sin(pa) * (y - y0)
            across = np.cos(pa) * (y - y0) - np.sin(pa) * (x - x0)
            total += closed_form(component.params, k, np.sqrt(q * along**2 + across**2 / q))
    return total


def error_of(cluster: SimulatedCluster, grid: Grid) -> Any:
    """Largest relative error at up to 300 pixels away from all centres."""
    rng = np.random.default_rng(1)
    i, j = rng.integers(0, grid.shape[0], (2, 300))
    x, y = np.asarray(grid.x)[j], np.asarray(grid.y)[i]
    centres = np.concatenate([np.asarray(c.centre) for c in cluster.lens.components.values()])
    gaps = np.max(np.abs(centres[:, :, None] - np.stack([x, y])), axis=1)
    away = (gaps > 5.0 * grid.pixel).all(axis=0)
    exact = np.asarray(lensing.kappa(cluster.lens, jnp.asarray(np.stack([x, y], axis=-1)[away])))
    return lambda kappa: float(np.max(np.abs(kappa[i, j][away] / exact - 1.0))) if away.any() else 0.0


def main(arguments: list[str] | None = None) -> int:
    """Sweep the pixels."""
    report = Report("map_render", parser(__doc__ or "").parse_args(arguments))
    few = ClusterSettings(m_min_msun_h=1e12) if report.smoke else None
    cluster = draw_cluster(jax.random.key(0), few)
    profiles = len(lensing.centres(cluster.lens))
    sides = (128, 256) if report.smoke else (128, 512, 1024, 2048, 4096)
    plain = 256 if report.smoke else 1024 if report.full else 512
    times = []
    for side in sides:
        grid = Grid((side, side), SIDE_ARCSEC / side)
        same = {
            "size": {"side": side, "profiles": profiles},
            "error": error_of(cluster, grid),
            "compiled": False,
            "seconds": 0.5,
        }
        ours = report.measure("map", lambda grid=grid: render(cluster, grid), traced=True, **same)
        times.append(ours.best_ms)
        if side <= plain:
            theirs = report.measure(
                "map, NumPy", lambda grid=grid: plain_sum(cluster, grid), traced=True, least=1, **same
            )
        if side == plain:
            what = f"convergence map of {profiles} profiles, {side} x {side}"
            report.faster(what, ours, theirs, 1.0)
    slope = np.polyfit(np.log(np.array(sides[-2:]) ** 2.0), np.log(times[-2:]), 1)[0]
    report.check(f"time grows as pixels^{slope:.2f} (limit 1.2)", slope < 1.2)
    worst = max(row.error for row in report.rows if row.error is not None)
    report.check(f"maps against the lens: {worst:.1e} (limit 4e-5)", worst < 4e-5)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
