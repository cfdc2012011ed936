"""Deflection and Hessian as plain NumPy sums: the references of `deflection.py`.

The Hessian is the derivative of the deflection along an imaginary step, exact to rounding: the closed forms
are analytic functions of the position.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxlens.profiles import _cse as cse

Member = dict[str, np.ndarray]
STEP = 1e-30


def members_of(n: int, seed: int = 0) -> Member:
    """Numbers of `n` member galaxies: b, r_core, r_cut, e, x, y, pa."""
    rng = np.random.default_rng(seed)
    luminosity = 10.0 ** rng.uniform(-1.6, 0.0, n)
    return {
        "b": 1.2 * luminosity**0.5,
        "r_core": np.full(n, 0.05),
        "r_cut": 12.0 * luminosity**0.5,
        "e": rng.uniform(0.05, 0.5, n),
        "x": rng.uniform(-60.0, 60.0, n),
        "y": rng.uniform(-60.0, 60.0, n),
        "pa": rng.uniform(-np.pi, np.pi, n),
    }


def of_members(m: Member, theta: np.ndarray) -> np.ndarray:
    """Sum of the closed forms (Keeton 2001) over members, in a NumPy loop, `(i, 2)`."""
    total = np.zeros_like(theta)
    for b, core, cut, e, x0, y0, pa in zip(*m.values(), strict=True):
        c, s, q = np.cos(pa), np.sin(pa), 1.0 - e
        d = theta - [x0, y0]
        x, y = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
        f, strength = np.sqrt(1.0 - q**2), b * np.sqrt(q)
        a_x, a_y = np.zeros_like(x), np.zeros_like(x)
        for radius, sign in ((core, 1.0), (cut, -1.0)):
            t = radius / np.sqrt(q)
            p = np.sqrt(q**2 * (t**2 + x**2) + y**2)
            u, v = x / (p + t), y / (p + q**2 * t)
            # A circle, f = 0, is the limit of both.
            a_x += sign * strength * (np.arctan(f * u) / f if f > 0.0 else u)
            a_y += sign * strength * (np.arctanh(f * v) / f if f > 0.0 else v)
        total += np.stack([c * a_x - s * a_y, s * a_x + c * a_y], axis=1)
    return total


def of_halo(kappa_s: float, r_s: float, e: float, centre: Any, pa: float, theta: np.ndarray) -> np.ndarray:
    """Deflection of an elliptical NFW halo by the 44 terms of Oguri (2021), eq. 19, `(i, 2)`."""
    c, s, q = np.cos(pa), np.sin(pa), 1.0 - e
    t = r_s / np.sqrt(q)
    d = (theta - np.asarray(centre)) / t
    x, y = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
    a_x, a_y = np.zeros_like(x), np.zeros_like(x)
    for core, amplitude in zip(*cse.table("nfw"), strict=True):
        p = np.sqrt(q**2 * (core**2 + x**2) + y**2)
        weight = amplitude * q / (core * p * ((p + core) ** 2 + (1.0 - q**2) * x**2))
        a_x += weight * x * (p + q**2 * core)
        a_y += weight * y * (p + core)
    return 4.0 * kappa_s * t * np.stack([c * a_x - s * a_y, s * a_x + c * a_y], axis=1)


def columns_of(deflection: Callable[[np.ndarray], np.ndarray], theta: np.ndarray) -> np.ndarray:
    """Deflection and Hessian at `theta (i, 2)` as rows (x, y, xx, xy, yy), `(5, i)`."""
    alpha = deflection(theta)
    along_x, along_y = (deflection(theta + 1j * STEP * unit).imag / STEP for unit in np.eye(2))
    return np.stack([*alpha.T, *along_x.T, along_y[:, 1]])


def columns(alpha: Any, hessian: Any) -> np.ndarray:
    """Our deflection `(..., 2)` and Hessian `(..., 2, 2)` as rows (x, y, xx, xy, yy)."""
    a, h = np.asarray(alpha), np.asarray(hessian)
    return np.stack(
        [part.ravel() for part in (a[..., 0], a[..., 1], h[..., 0, 0], h[..., 0, 1], h[..., 1, 1])]
    )


def error_of(found: np.ndarray, expected: np.ndarray) -> float:
    """The larger of two errors: of deflections, and of Hessians, each relative to its largest value."""
    parts = (slice(0, 2), slice(2, 5))
    return max(float(np.abs(found[k] - expected[k]).max() / np.abs(expected[k]).max()) for k in parts)
