"""AKRA maps (scheme A2) by NumPy and SciPy: the same mathematics, for `akra.py`."""

import os
import time
from functools import cache

import numpy as np
from _harness import Report, Row
from scipy import fft, linalg
from scipy.sparse.linalg import LinearOperator, cg

from jaxlens import weak

RIDGE = 1e-2
NOTE = "each of five solves reduces its residual to {:g}; the same first guesses, masks and spectrum"


@cache
def workers(padded: tuple[int, int]) -> int:
    """Threads of SciPy's FFT, one or as many as there are cores: what is faster for this size."""
    field = np.ones(padded, complex)

    def seconds(threads: int) -> float:
        began = time.perf_counter()
        for _ in range(20):
            fft.ifft2(fft.fft2(field, workers=threads), workers=threads)
        return time.perf_counter() - began

    return min((1, os.cpu_count() or 1), key=lambda threads: min(seconds(threads) for _ in range(3)))


@cache
def spectrum(n_y: int, n_x: int) -> np.ndarray:
    """D of the padded field."""
    return np.asarray(weak.ShearOperator.of((n_y, n_x)).spectrum())


def scipy_map(g: np.ndarray, weight: np.ndarray, tol: float) -> np.ndarray:
    """The same mathematics with SciPy's FFT and CG: data space, warm starts, residuals reduced by `tol`.

    Args:
        g: smoothed reduced shear, `(y, x)`.
        weight: weights with smoothed edges, as the maps of ours use them, `(y, x)`.
        tol: by how much each of five solves reduces its residual.
    """
    d = spectrum(*g.shape)
    padded = d.shape
    root = np.sqrt(weight)
    crop = (slice(None, g.shape[0]), slice(None, g.shape[1]))
    threads = workers(padded)

    def back(modes: np.ndarray) -> np.ndarray:
        return np.asarray(fft.ifft2(modes, workers=threads))[crop]

    def modes(gamma: np.ndarray) -> np.ndarray:
        half = np.conj(d) * np.asarray(fft.fft2(gamma, s=padded, workers=threads))
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


def alike(report: Report, what: str, ours: Row, theirs: Row) -> None:
    """Check that two errors agree within a factor 3: the same steps were taken."""
    assert ours.error is not None and theirs.error is not None
    report.check(
        f"{what}: errors {ours.error:.1e} and, of the other, {theirs.error:.1e}, alike within a factor 3",
        ours.error < 3.0 * theirs.error < 9.0 * ours.error,
    )
