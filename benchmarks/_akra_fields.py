"""AKRA maps by CG, for `akra.py`: large fields, and batches of maps."""

import jax
import jax.numpy as jnp
import numpy as np
from _akra_plain import NOTE, alike, scipy_map
from _harness import Report

from jaxlens import weak
from jaxlens.grid import Grid

FIELD_ERROR = 1e-3
"""Largest error of a large field, solved to 1e-2: its largest scales converge last."""


def batches(report: Report) -> None:
    """Maps by CG one after the other, the default, or all at once."""
    for n, count in ((48, 16), (96, 8), (192, 4)):
        shear, grid = field(n)
        parts = jax.random.normal(jax.random.key(0), (2, count, n, n))
        spread = jax.tree.map(lambda a, m=count: jnp.broadcast_to(a, (m, *a.shape)), shear)
        noisy = weak.ShearMap(shear.g + 0.07 * (parts[0] + 1j * parts[1]), spread.weight, spread.n_gal)
        one = lambda shear, grid=grid: weak.reconstruct(shear, grid, power_steps=0).kappa
        size = {"pixels": n * n, "maps": count}
        by_map = report.measure("A2 by CG, lax.map", lambda d, f=one: jax.lax.map(f, d), noisy, size=size)
        by_vmap = report.measure("A2 by CG, vmap", jax.vmap(one), noisy, size=size)
        ratio = by_vmap.median_ms / by_map.median_ms
        memory = (by_vmap.memory_mb or 0.0) / (by_map.memory_mb or 1.0)
        report.check(
            f"{n} x {n}: lax.map, the default, takes {by_map.median_ms / count:.1f} ms a map, vmap "
            f"{ratio:.2f} times as long with {memory:.1f} times the memory "
            "(at least 0.85: less is not worth the memory)",
            ratio > 0.85,
        )


def field(n: int) -> tuple[weak.ShearMap, Grid]:
    """Shear about a centre that is masked, n x n pixels of 10 arcsec."""
    grid = Grid((n, n), 10.0)
    r, theta = np.asarray(grid.radius), np.asarray(grid.theta)
    z = (theta[..., 0] + 1j * theta[..., 1]) / np.maximum(r, 1.0)
    g = jnp.asarray(-0.4 * z**2 * np.exp(-r / (2.5 * n)))
    return weak.ShearMap(g, jnp.asarray((r > 30.0).astype(float)), jnp.ones(g.shape, int)), grid


def fields(report: Report) -> None:
    """Large fields by CG: time and memory against pixels."""
    memory, seconds, pixels = [], [], []
    sizes = (32, 64) if report.smoke else (64, 256, 1024) if report.full else (64, 256, 512)
    n = sizes[1]
    row = None
    for side in sizes:
        shear, grid = field(side)
        make = lambda shear, grid=grid: weak.reconstruct(shear, grid, power_steps=0, cg_tol=1e-2).kappa
        good = weak.reconstruct(shear, grid, power_steps=0, cg_tol=1e-7, cg_steps=4000).kappa
        inside = np.asarray(shear.weight) > 0.0
        error = lambda kappa, good=good, inside=inside: float(np.abs(np.asarray(kappa - good))[inside].max())
        found = report.measure(
            "field by CG",
            make,
            shear,
            size={"pixels": side * side},
            error=error,
            seconds=0.1,
            note=NOTE.format(1e-2),
        )
        memory.append(found.memory_mb)
        seconds.append(found.median_ms)
        pixels.append(side * side)
        row = found if side == n else row
    assert row is not None
    if all(m is not None for m in memory):
        slope = float(np.polyfit(np.log(pixels), np.log(np.array(memory, float)), 1)[0])
        report.check(f"memory grows as pixels^{slope:.2f} (limit 1.1)", slope < 1.1, smoke=False)
    print(f"time grows as pixels^{float(np.polyfit(np.log(pixels), np.log(seconds), 1)[0]):.2f}")
    shear, grid = field(n)
    weight = np.asarray(shear.weight)
    smoothed = np.asarray(weak.smooth(shear.g, grid, 15.0, shear.weight)) * weight
    w = weight * np.asarray(weak.cosine_mask(shear.weight)) ** 2
    good = np.asarray(weak.reconstruct(shear, grid, power_steps=0, cg_tol=1e-7, cg_steps=4000).kappa)
    theirs = report.measure(
        "field by CG, SciPy",
        lambda: scipy_map(smoothed, w, 1e-2),
        size={"pixels": n * n},
        error=lambda kappa: float(np.abs(kappa - good)[weight > 0.0].max()),
        compiled=False,
        seconds=0.1,
        note=NOTE.format(1e-2),
    )
    what = f"AKRA by CG, field of {n} x {n}"
    report.faster(what, row, theirs, 1.0, error=FIELD_ERROR)
    alike(report, what, row, theirs)
