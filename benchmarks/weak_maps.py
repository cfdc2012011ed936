"""Speed of weak-lensing maps: one map, a thousand maps, large fields, beside NumPy and SciPy.

    python benchmarks/weak_maps.py [--smoke]

A2, padded to twice the field, R = 1e-2, five iterations. Every time stands beside its error.
"""

import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402
from _mock import Mock, two_clumps  # noqa: E402
from scipy import fft  # noqa: E402
from scipy.sparse.linalg import LinearOperator, cg  # noqa: E402

from jaxlens import weak  # noqa: E402
from jaxlens.grid import Grid  # noqa: E402

RIDGE = 1e-2


def scipy_map(g: np.ndarray, weight: np.ndarray, rtol: float) -> np.ndarray:
    """The same five iterations with SciPy's FFT and CG, warm starts included."""
    n_y, n_x = g.shape
    padded = (2 * n_y, 2 * n_x)
    c, s = weak.ShearOperator.of(g.shape).multipliers()

    def adjoint(gamma: np.ndarray) -> np.ndarray:
        hat = c * fft.rfft2(gamma.real, s=padded) + s * fft.rfft2(gamma.imag, s=padded)
        return fft.irfft2(hat, s=padded)

    def forward(kappa: np.ndarray) -> np.ndarray:
        hat = fft.rfft2(kappa)
        return (fft.irfft2(c * hat, s=padded) + 1j * fft.irfft2(s * hat, s=padded))[:n_y, :n_x]

    size = padded[0] * padded[1]
    normal = LinearOperator(
        (size, size),
        matvec=lambda x: (adjoint(weight * forward(x.reshape(padded))) + RIDGE * x.reshape(padded)).ravel(),  # pyright: ignore
    )
    kappa = np.zeros(padded)
    for _ in range(5):
        b = adjoint(weight * g * (1.0 - kappa[:n_y, :n_x])).ravel()
        kappa = cg(normal, b, x0=kappa.ravel(), rtol=rtol)[0].reshape(padded)
    return kappa[:n_y, :n_x]


def one_map(report: Report, mock: Mock, inverse: weak.AkraDense) -> None:
    """One A2 map by CG against the dense map, and against SciPy."""
    shear, used = mock.shear(), mock.weight > 0
    reference = np.asarray(weak.reconstruct(shear, mock.grid, inverse=inverse, power_steps=0).kappa)
    error = lambda kappa: float(np.abs(np.asarray(kappa) - reference)[used].max())
    size = {"pixels": used.size}
    best = None
    for tol in (1e-2, 1e-3, 1e-4):
        make = lambda shear, tol=tol: weak.reconstruct(shear, mock.grid, cg_tol=tol, power_steps=0).kappa
        row = report.measure(f"A2 by CG, cg_tol {tol:g}, R {RIDGE:g}", make, shear, size=size, error=error)
        best = best or row
    assert best is not None and best.error is not None
    report.check(
        f"one A2 map takes {best.best_ms:.0f} ms (limit 60), error {best.error:.1e} (limit 1e-3)",
        best.best_ms < 60.0 and best.error < 1e-3,
    )
    full = lambda shear: weak.reconstruct(shear, mock.grid).kappa
    report.measure("A2 by CG, defaults", full, shear, size=size, error=error)
    ks = lambda shear: weak.reconstruct(shear, mock.grid, scheme="K2", power_steps=0).kappa
    report.measure("K2", ks, shear, size=size)
    g = np.asarray(weak.smooth(shear.g, mock.grid, 15.0, shear.weight)) * used
    weight = np.asarray(inverse.weight)
    theirs = report.measure(
        "A2 by SciPy CG", lambda: scipy_map(g, weight, 1e-4), size=size, error=error, compiled=False
    )
    report.check("SciPy's map is ours to 1e-3", theirs.error is not None and theirs.error < 1e-3)


def thousand(report: Report, mock: Mock, inverse: weak.AkraDense, setup: float) -> None:
    """Noise realisations through the dense map in blocks of 64; lax.map against vmap for CG."""
    counts = weak.mean_counts(mock.grid, mock.plane)
    capacity, g, weight = weak.capacity_of(float(counts.sum())), jnp.asarray(mock.g), jnp.asarray(mock.weight)
    draw = jax.jit(lambda key: weak.shape_noise(key, g, counts, capacity=capacity, weight=weight))
    report.measure("one noise realisation", draw, jax.random.key(0), size={"pixels": g.size})
    maps = 100 if report.smoke else 1000
    drawn = jax.lax.map(draw, jax.random.split(jax.random.key(1), maps))
    size = {"pixels": g.size, "maps": maps}
    made = weak.reconstruct_many(drawn, mock.grid, inverse=inverse)
    one = jax.tree.map(lambda a: a[0], drawn)
    single = weak.reconstruct(one, mock.grid, inverse=inverse, power_steps=0).kappa
    row = report.measure(
        "A2 dense, blocks of 64",
        lambda: weak.reconstruct_many(drawn, mock.grid, inverse=inverse).kappa,
        size=size,
        error=lambda kappa: float(jnp.abs(kappa[0] - single).max()),
        compiled=False,
        seconds=0.1,
    )
    print(f"{int(made.mask_differs.sum())} of {maps} realisations have an empty pixel")
    report.check(f"{maps} maps take {row.best_ms / 1e3:.2f} s (limit 5)", row.best_ms < 5e3)
    report.check(f"set-up of the dense map takes {setup:.1f} s with compilation (limit 12)", setup < 12.0)
    few = jax.tree.map(lambda a: a[:8], drawn)
    batched = lambda one: weak.reconstruct(one, mock.grid, power_steps=0, cg_tol=1e-3).kappa
    by_map = report.measure(
        "A2 by CG, lax.map", lambda d: jax.lax.map(batched, d), few, size=size | {"maps": 8}
    )
    by_vmap = report.measure("A2 by CG, vmap", jax.vmap(batched), few, size=size | {"maps": 8})
    ratio = by_vmap.best_ms / by_map.best_ms
    report.check(f"lax.map, the default, is {ratio:.2f} times as fast as vmap", ratio > 1.0)


def fields(report: Report) -> None:
    """Large fields by CG: time and memory against pixels."""
    memory, seconds, pixels = [], [], []
    for n in (32, 64) if report.smoke else (64, 256, 1024):
        grid = Grid((n, n), 480.0 / 48)
        r = np.asarray(grid.radius)[..., None]
        theta = np.asarray(grid.theta)
        z = (theta[..., 0] + 1j * theta[..., 1]) / np.maximum(r[..., 0], 1.0)
        g = jnp.asarray(-0.4 * z**2 * np.exp(-r[..., 0] / (2.5 * n)))
        shear = weak.ShearMap(g, jnp.asarray((r[..., 0] > 30.0).astype(float)), jnp.ones(g.shape, int))
        make = lambda shear, grid=grid: weak.reconstruct(shear, grid, power_steps=0, cg_tol=1e-2).kappa
        row = report.measure("field by CG", make, shear, size={"pixels": n * n}, seconds=0.1)
        memory.append(row.memory_mb)
        seconds.append(row.best_ms)
        pixels.append(n * n)
    if all(m is not None for m in memory):
        slope = float(np.polyfit(np.log(pixels), np.log(np.array(memory, float)), 1)[0])
        report.check(f"memory grows as pixels^{slope:.2f} (limit 1.1)", slope < 1.1)
    print(f"time grows as pixels^{float(np.polyfit(np.log(pixels), np.log(seconds), 1)[0]):.2f}")


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    report = Report("weak_maps", parser(__doc__ or "").parse_args(arguments))
    mock = two_clumps(n=16 if report.smoke else 48, oversample=2)
    began = time.perf_counter()
    inverse = weak.dense_inverse(jnp.asarray(mock.weight), mock.grid, ridge=RIDGE)
    jax.block_until_ready(inverse.matrix)
    setup = time.perf_counter() - began
    one_map(report, mock, inverse)
    thousand(report, mock, inverse, setup)
    fields(report)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
