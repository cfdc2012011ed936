"""AKRA maps (scheme A2): one map, a thousand maps, large fields, beside the same mathematics in SciPy.

    python benchmarks/akra.py [--smoke] [--full] [--out FILE]

Padded to twice the field, R = 1e-2, five iterations, double precision. SciPy solves each map by conjugate
gradients; a thousand maps of ours are matrix products with one dense map. `--full` adds batches by conjugate
gradients and a field of 1024 x 1024.
"""

import sys
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import lineax as lx  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, Row, parser  # noqa: E402
from _mock import Mock, two_clumps  # noqa: E402
from scipy import fft, linalg  # noqa: E402
from scipy.sparse.linalg import LinearOperator, cg  # noqa: E402

from jaxlens import weak  # noqa: E402
from jaxlens.grid import Grid  # noqa: E402

RIDGE = 1e-2
BLOCK = 64  # as `weak.reconstruct_many`
NOTE = "each of five solves reduces its residual to {:g}; the same first guesses, masks and spectrum"


def scipy_map(g: np.ndarray, weight: np.ndarray, tol: float) -> np.ndarray:
    """The same mathematics with SciPy's FFT and CG: data space, warm starts, residuals reduced by `tol`."""
    operator = weak.ShearOperator.of(g.shape)
    d, padded = np.asarray(operator.spectrum()), operator.padded
    root = np.sqrt(weight)
    crop = (slice(None, g.shape[0]), slice(None, g.shape[1]))

    def back(modes: np.ndarray) -> np.ndarray:
        return np.asarray(fft.ifft2(modes))[crop]

    def modes(gamma: np.ndarray) -> np.ndarray:
        half = np.conj(d) * np.asarray(fft.fft2(gamma, s=padded))
        return 0.5 * (half + np.conj(np.roll(half[::-1, ::-1], (1, 1), (0, 1))))

    def normal(flat: np.ndarray) -> np.ndarray:
        y = flat.view(complex).reshape(g.shape)
        return (root * back(d * modes(root * y)) + RIDGE * y).ravel().view(float)

    matrix = LinearOperator((2 * g.size, 2 * g.size), matvec=normal, dtype=float)  # pyright: ignore
    kappa, y = np.zeros(g.shape), np.zeros(2 * g.size)
    for _ in range(5):
        b = (root * g * (1.0 - kappa)).astype(complex).ravel().view(float)
        image = normal(y)
        scale = image @ b / max(image @ image, 1e-300)
        y = scale * y + cg(matrix, b - scale * image, rtol=tol)[0]
        kappa = np.real(back(modes(root * y.view(complex).reshape(g.shape))))
    return kappa


def scipy_dense(weight: np.ndarray) -> np.ndarray:
    """The dense map by NumPy and SciPy's Cholesky factor, `(n_y n_x, 2 d)`."""
    operator = weak.ShearOperator.of(weight.shape)
    c, s = operator.multipliers()
    kernels = [
        np.asarray(fft.irfft2(part, s=operator.padded)).ravel() for part in (c, s, c * c, c * s, s * s)
    ]
    places = np.argwhere(np.ones(weight.shape))
    used = places[weight.ravel() > 0.0]

    def at(to: np.ndarray, of: np.ndarray) -> np.ndarray:
        offset = (to[:, None] - of[None]) % np.array(operator.padded)
        return offset[..., 0] * operator.padded[1] + offset[..., 1]

    here, there = at(used, used), at(places, used)
    root = np.sqrt(np.tile(weight[weight > 0.0], 2))
    cc, cs, ss = (kernel[here] for kernel in kernels[2:])
    gram = root[:, None] * np.block([[cc, cs], [cs, ss]]) * root + RIDGE * np.eye(len(root))
    back = np.concatenate([kernels[0][there], kernels[1][there]], axis=1) * root
    factor = linalg.cho_factor(gram, lower=True, overwrite_a=True, check_finite=False)
    return linalg.cho_solve(factor, back.T, overwrite_b=True, check_finite=False).T * root


def as_exact(report: Report, what: str, ours: Row, theirs: Row) -> None:
    """State both errors: a time is worth as much as the error beside it."""
    assert ours.error is not None and theirs.error is not None
    report.check(
        f"{what}: errors {ours.error:.1e} and, of the other, {theirs.error:.1e}, alike within a factor 3",
        ours.error < 3.0 * theirs.error < 9.0 * ours.error,
    )


def one_map(report: Report, mock: Mock, inverse: weak.AkraDense) -> None:
    """One A2 map by CG against the dense map, and against SciPy."""
    shear, used = mock.shear(), mock.weight > 0
    reference = np.asarray(weak.reconstruct(shear, mock.grid, inverse=inverse, power_steps=0).kappa)
    error = lambda kappa: float(np.abs(np.asarray(kappa) - reference)[used].max())
    size = {"pixels": used.size}
    rows = {}
    for tol in (1e-1,) if report.smoke else (1e-1, 1e-2, 1e-4):
        make = lambda shear, tol=tol: weak.reconstruct(shear, mock.grid, cg_tol=tol, power_steps=0).kappa
        rows[tol] = report.measure(
            f"A2 by CG, cg_tol {tol:g}", make, shear, size=size, error=error, note=NOTE.format(tol)
        )
    best = rows[1e-1]
    assert best.error is not None
    report.check(
        f"one A2 map, R = {RIDGE:g}, cg_tol 0.1, takes {best.best_ms:.1f} ms (limit 60), error "
        f"{best.error:.1e} (limit 1e-3)",
        best.best_ms < 60.0 and best.error < 1e-3,
    )
    g = np.asarray(weak.smooth(shear.g, mock.grid, 15.0, shear.weight)) * used
    weight = np.asarray(inverse.weight)
    for tol in (1e-1,) if report.smoke else (1e-1, 1e-4):
        theirs = report.measure(
            f"A2 by CG, tol {tol:g}, SciPy",
            lambda tol=tol: scipy_map(g, weight, tol),
            size=size,
            error=error,
            compiled=False,
            note=NOTE.format(tol),
        )
        report.faster(f"one AKRA map by CG, tolerance {tol:g}", rows[tol], theirs, 1.0)
        as_exact(report, f"one A2 map, tolerance {tol:g}", rows[tol], theirs)
    if report.smoke:
        return
    full = lambda shear: weak.reconstruct(shear, mock.grid)
    report.measure("A2, defaults, B mode and spectral radius", full, shear, size=size)
    ks = lambda shear: weak.reconstruct(shear, mock.grid, scheme="K2", power_steps=0).kappa
    report.measure("K2", ks, shear, size=size)


def solvers(report: Report, mock: Mock, inverse: weak.AkraDense) -> None:
    """Our conjugate gradients against lineax's, on one linear system and to the same error."""
    ours = weak.AkraCG(inverse.operator, inverse.weight, inverse.ridge, tol=1e-6)
    gamma = jnp.asarray(mock.g * mock.weight)
    exact = inverse.solve(gamma, inverse.start())
    error = lambda kappa: float(jnp.abs(kappa - exact).max())
    root = ours.root

    def normal(y: jax.Array) -> jax.Array:
        image = root * ours.operator.e_mode(root * (y[0] + 1j * y[1]))
        return jnp.stack([image.real, image.imag]) + ours.ridge * y

    def by_lineax(gamma: jax.Array, tol: float | jax.Array) -> jax.Array:
        b = jnp.stack([root * gamma.real, root * gamma.imag])
        linear = lx.FunctionLinearOperator(normal, jax.eval_shape(lambda: b), lx.positive_semidefinite_tag)
        solver: Any = lx.CG
        solver = solver(rtol=tol, atol=tol, stabilise_every=None)
        return ours.field(lx.linear_solve(linear, b, solver, throw=False).value)

    size = {"pixels": gamma.size}
    own = report.measure(
        "one solve, own CG", lambda g: ours.field(ours.solve(g, ours.start())), gamma, size=size, error=error
    )
    assert own.error is not None
    # Its tolerance means another norm: the loosest that gives our error or less.
    attempt = jax.jit(by_lineax)
    tols = 1e-6 * 2.0 ** np.arange(8.0, -4.0, -1.0)
    tol = next(one for one in tols if error(attempt(gamma, one)) <= own.error)
    other = report.measure(
        f"one solve, lineax CG, tol {tol:.1e}", lambda g: by_lineax(g, tol), gamma, size=size, error=error
    )
    as_exact(report, "own CG and lineax", own, other)
    report.check(
        f"own CG takes {own.best_ms:.1f} ms, lineax {other.best_ms:.1f} ms",
        own.best_ms < 1.1 * other.best_ms,
    )


def thousand(report: Report, mock: Mock, inverse: weak.AkraDense) -> None:
    """Maps of noise realisations through the dense map in blocks of 64, beside loops of SciPy and NumPy."""
    counts = weak.mean_counts(mock.grid, mock.plane)
    capacity, g, weight = weak.capacity_of(float(counts.sum())), jnp.asarray(mock.g), jnp.asarray(mock.weight)
    draw = jax.jit(lambda key: weak.shape_noise(key, g, counts, capacity=capacity, weight=weight))
    maps = 100 if report.smoke else 1000
    drawn = jax.lax.map(draw, jax.random.split(jax.random.key(1), maps))
    size = {"pixels": g.size, "maps": maps}
    made = weak.reconstruct_many(drawn, mock.grid, inverse=inverse)
    one = jax.tree.map(lambda a: a[0], drawn)
    single = weak.reconstruct(one, mock.grid, inverse=inverse, power_steps=0).kappa
    row = report.measure(
        "maps by the dense map",
        lambda: weak.reconstruct_many(drawn, mock.grid, inverse=inverse).kappa,
        size=size,
        error=lambda kappa: float(jnp.abs(kappa[0] - single).max()),
        compiled=False,
        seconds=0.1,
    )
    print(f"{int(made.mask_differs.sum())} of {maps} realisations have an empty pixel")
    report.check(f"{maps} maps take {row.best_ms / 1e3:.2f} s (limit 5)", row.best_ms < 5e3)
    smooth = jax.jit(jax.vmap(lambda g, w: jnp.where(w > 0.0, weak.smooth(g, mock.grid, 15.0, w), 0.0j)))
    smoothed = np.asarray(smooth(drawn.g, drawn.weight))
    matrix, used = np.asarray(inverse.matrix), np.asarray(inverse.used)
    reference = np.asarray(made.kappa).reshape(maps, -1)
    full = np.asarray(~made.mask_differs)  # without an empty pixel, which `products` fills by smoothing

    few = 4 if report.smoke else 20
    scaled, inside = np.asarray(inverse.weight), mock.weight.ravel() > 0.0
    loop = report.measure(
        "maps, SciPy loop",
        lambda: np.stack([scipy_map(one, scaled, 1e-1) for one in smoothed[:few]]),
        size={"pixels": g.size, "maps": few},
        error=lambda kappa: float(
            np.abs(kappa.reshape(few, -1) - reference[:few])[full[:few]][:, inside].max()
        ),
        compiled=False,
        traced=True,
        seconds=0.1,
        least=2,
        note=NOTE.format(1e-1),
    )
    ratio = (loop.best_ms / few) / (row.best_ms / maps)
    report.target(f"{maps} AKRA maps, smoothing included, times faster than a SciPy loop", ratio, least=10.0)

    def products() -> np.ndarray:
        """In blocks of 64 too: the rounding of a product depends on its size."""
        found = np.zeros((maps, g.size))
        for start in range(0, maps, BLOCK):
            part = slice(start, start + BLOCK)
            flat = np.asarray(smooth(drawn.g[part], drawn.weight[part])).reshape(-1, g.size)
            kappa = np.zeros(flat.shape)
            for _ in range(5):
                gamma = (flat * (1.0 - kappa))[:, used]
                kappa = np.concatenate([gamma.real, gamma.imag], axis=1) @ matrix.T
            found[part] = kappa
        return found

    theirs = report.measure(
        "maps by the dense map, NumPy and our smoothing",
        products,
        size=size,
        error=lambda kappa: float(np.abs(kappa - reference)[full].max()),
        compiled=False,
        traced=True,
        seconds=0.1,
    )
    report.faster(f"{maps} AKRA maps, smoothing included", row, theirs, 1.0)


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
        ratio = by_vmap.best_ms / by_map.best_ms
        memory = (by_vmap.memory_mb or 0.0) / (by_map.memory_mb or 1.0)
        report.check(
            f"{n} x {n}: lax.map, the default, takes {by_map.best_ms / count:.1f} ms a map, vmap "
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
        seconds.append(found.best_ms)
        pixels.append(side * side)
        row = found if side == n else row
    assert row is not None
    if all(m is not None for m in memory):
        slope = float(np.polyfit(np.log(pixels), np.log(np.array(memory, float)), 1)[0])
        report.check(f"memory grows as pixels^{slope:.2f} (limit 1.1)", slope < 1.1)
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
    report.faster(f"AKRA by CG, field of {n} x {n}", row, theirs, 1.0)
    as_exact(report, f"a field of {n} x {n}", row, theirs)


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    report = Report("akra", parser(__doc__ or "").parse_args(arguments))
    mock = two_clumps(n=16 if report.smoke else 48, oversample=2)
    weight = jnp.asarray(mock.weight)
    began = time.perf_counter()
    inverse = weak.dense_inverse(weight, mock.grid, ridge=RIDGE)
    jax.block_until_ready(inverse.matrix)
    setup = time.perf_counter() - began
    report.check(f"set-up of the dense map takes {setup:.1f} s with compilation (limit 12)", setup < 12.0)
    size = {"pixels": weight.size}
    again = lambda: weak.dense_inverse(weight, mock.grid, ridge=RIDGE).matrix
    ours = report.measure("dense set-up", again, size=size, compiled=False, seconds=0.1)
    scaled = np.asarray(inverse.weight)
    data = np.tile(scaled.ravel()[np.asarray(inverse.used)] > 0.0, 2)  # ours has columns of zeros beside
    theirs = report.measure(
        "dense set-up, SciPy",
        lambda: scipy_dense(scaled),
        size=size,
        error=lambda matrix: float(np.abs(matrix - np.asarray(inverse.matrix)[:, data]).max()),
        compiled=False,
        seconds=0.1,
    )
    report.faster("set-up of the dense map", ours, theirs, 0.7)  # the same LAPACK
    one_map(report, mock, inverse)
    solvers(report, mock, inverse)
    thousand(report, mock, inverse)
    if report.full:
        batches(report)
    fields(report)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
