"""AKRA maps (scheme A2): one map, a thousand maps, large fields, beside the same mathematics in SciPy.

    python benchmarks/akra.py [--smoke] [--full] [--out FILE]

Padded to twice the field, R = 1e-2, five iterations, double precision. SciPy solves each map by conjugate
gradients; a thousand maps of ours are matrix products with one dense map. `--full` adds batches by conjugate
gradients and a field of 1024 x 1024.
"""

import sys
import time
from functools import partial
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import lineax as lx  # noqa: E402
import numpy as np  # noqa: E402
from _akra_fields import batches, fields  # noqa: E402
from _akra_plain import NOTE, RIDGE, alike, scipy_dense, scipy_map  # noqa: E402
from _harness import Report, Row, parser  # noqa: E402
from _mock import Mock, two_clumps  # noqa: E402

from jaxlens import weak  # noqa: E402
from jaxlens.weak._batch import BLOCK  # noqa: E402

CG_ERROR = 0.02
"""Largest error of a map in units of the tolerance of its solves."""
EXACT_ERROR = 1e-6
"""Largest error of maps by the dense map: the reference is solved to 1e-8."""
EXACT_TOL = 5e-5
"""Tolerance with which SciPy reaches that error."""
PRODUCT_ERROR = 1e-10
"""Largest difference of two products with the same matrix."""


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
    what = f"one A2 map, R = {RIDGE:g}, cg_tol 0.1"
    report.check(f"{what}, takes {best.median_ms:.1f} ms (limit 60)", best.median_ms < 60.0, smoke=False)
    # In coarse pixels, as a smoke run has, the same tolerance means another error.
    report.check(f"{what}: error {best.error:.1e} (limit 1e-3)", best.error < 1e-3, smoke=False)
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
        what = f"one AKRA map by CG, tolerance {tol:g}"
        report.faster(what, rows[tol], theirs, 1.0, error=CG_ERROR * tol)
        alike(report, what, rows[tol], theirs)
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
    alike(report, "own CG and lineax", own, other)
    report.ratio("one solve by own CG, time over lineax", own, other, most=1.1)


def realisations(mock: Mock, maps: int) -> weak.ShearMap:
    """Noise realisations of the mock's shear."""
    counts = weak.mean_counts(mock.grid, mock.plane)
    capacity, g, weight = weak.capacity_of(float(counts.sum())), jnp.asarray(mock.g), jnp.asarray(mock.weight)
    draw = jax.jit(lambda key: weak.shape_noise(key, g, counts, capacity=capacity, weight=weight))
    return jax.lax.map(draw, jax.random.split(jax.random.key(1), maps))


def thousand(report: Report, mock: Mock, inverse: weak.AkraDense) -> None:
    """Maps of noise realisations through the dense map in blocks, beside loops of SciPy and NumPy."""
    maps, few = (100, 4) if report.smoke else (1000, 20)
    drawn, weight = realisations(mock, maps), jnp.asarray(mock.weight)
    made = weak.reconstruct_many(drawn, mock.grid, inverse=inverse)
    # Without an empty pixel, which the others fill by smoothing.
    full = np.asarray(~made.mask_differs)
    print(f"{maps - int(full.sum())} of {maps} realisations have an empty pixel")
    smooth = jax.jit(jax.vmap(lambda g, w: jnp.where(w > 0.0, weak.smooth(g, mock.grid, 15.0, w), 0.0j)))
    some = np.flatnonzero(full)[:few]
    smoothed = np.asarray(smooth(drawn.g[some], drawn.weight[some]))
    scaled, inside = np.asarray(inverse.weight), mock.weight > 0.0
    exact = np.stack([scipy_map(one, scaled, 1e-8) for one in smoothed])
    error = lambda kappa: float(np.abs(np.asarray(kappa) - exact)[:, inside].max())
    pixels = {"pixels": weight.size}
    same = {
        "size": {**pixels, "maps": maps},
        "units": maps,
        "compiled": False,
        "seconds": 0.1,
        "error": lambda kappa: error(np.asarray(kappa)[some]),
    }

    def with_set_up(drawn: weak.ShearMap = drawn) -> jax.Array:
        dense = weak.dense_inverse(weight.astype(drawn.g.real.dtype), mock.grid, ridge=RIDGE)
        return weak.reconstruct_many(drawn, mock.grid, inverse=dense).kappa

    apply = lambda: weak.reconstruct_many(drawn, mock.grid, inverse=inverse).kappa
    whole = report.measure("set-up and maps by the dense map", with_set_up, **same)
    ours = report.measure("maps by the dense map", apply, **same)
    single = weak.ShearMap(drawn.g.astype(np.complex64), drawn.weight.astype(np.float32), drawn.n_gal)
    report.measure("set-up and maps, single precision", partial(with_set_up, single), **same)
    taken = ours.median_ms / 1e3
    report.check(f"{maps} maps take {taken:.2f} s (limit 5)", taken < 5.0, smoke=False)

    def by_scipy(tol: float) -> Row:
        return report.measure(
            f"maps, tol {tol:g}, SciPy",
            lambda: np.stack([scipy_map(one, scaled, tol) for one in smoothed]),
            size={**pixels, "maps": len(some)},
            units=len(some),
            error=error,
            compiled=False,
            traced=True,
            seconds=0.1,
            note=f"{NOTE.format(tol)}; smoothed before",
        )

    what = f"{maps} AKRA maps, compiled before"
    # The dense map knows one accuracy; SciPy is asked for the same, and for what noise needs.
    for tol, limit in ((EXACT_TOL, EXACT_ERROR), (1e-1, CG_ERROR * 1e-1)):
        loop = by_scipy(tol)
        to = f"{what}, to {limit:.0e}"
        report.faster(f"{to}, set-up of the mask included", whole, loop, 10.0, error=limit)
        report.faster(f"{to}, mask set up before", ours, loop, None, error=limit)
    matrix, used = np.asarray(inverse.matrix), np.asarray(inverse.used)

    def products() -> np.ndarray:
        """In the same blocks: the rounding of a product depends on its size."""
        found = np.zeros((maps, *weight.shape))
        for start in range(0, maps, BLOCK):
            part = slice(start, start + BLOCK)
            flat = np.asarray(smooth(drawn.g[part], drawn.weight[part])).reshape(-1, weight.size)
            kappa = np.zeros(flat.shape)
            for _ in range(5):
                gamma = (flat * (1.0 - kappa))[:, used]
                kappa = np.concatenate([gamma.real, gamma.imag], axis=1) @ matrix.T
            found[part] = kappa.reshape(-1, *weight.shape)
        return found

    theirs = report.measure("maps by the dense map, NumPy and our smoothing", products, **same)
    what = f"{maps} AKRA maps, smoothing included, mask set up before"
    report.faster(what, ours, theirs, 1.0, error=EXACT_ERROR)
    difference = np.abs(products() - np.asarray(made.kappa))[full].max()
    report.check(f"{what}: largest difference {difference:.1e} (limit 1e-10)", difference < PRODUCT_ERROR)


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    report = Report("akra", parser(__doc__ or "").parse_args(arguments))
    mock = two_clumps(n=16 if report.smoke else 48, oversample=2)
    weight = jnp.asarray(mock.weight)
    began = time.perf_counter()
    inverse = weak.dense_inverse(weight, mock.grid, ridge=RIDGE)
    jax.block_until_ready(inverse.matrix)
    setup = time.perf_counter() - began
    claim = f"set-up of the dense map takes {setup:.1f} s with compilation (limit 12)"
    report.check(claim, setup < 12.0, smoke=False)
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
    assert theirs.error is not None
    claim = f"set-up of the dense map: difference from SciPy's {theirs.error:.1e} (limit 1e-10)"
    report.check(claim, theirs.error < PRODUCT_ERROR)
    # The same LAPACK does most of the work.
    report.ratio("set-up of the dense map, time over NumPy and SciPy", ours, theirs, most=1.4)
    one_map(report, mock, inverse)
    solvers(report, mock, inverse)
    thousand(report, mock, inverse)
    if report.full:
        batches(report)
    fields(report)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
