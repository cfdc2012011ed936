"""Projected densities of any halo, and their expansion in cored steep ellipsoids. On the host, NumPy.

Radii are in units of r_s, densities in units of rho_s; the shape F is kappa/(2 kappa_s), as for the NFW.
"""

from collections.abc import Callable

import numpy as np

Density = Callable[[np.ndarray], np.ndarray]

FAR = 1e7
"""Where the line of sight ends when nothing is cut."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(200)

_WHOLE, _CUT = 48, 60
# Terms for a profile without an edge, and with one.

_SMOOTHED = 1.4
# An edge is spread over radii from 1/this to this times its own, where the fit has a hundredth of the weight.


def nfw(r: np.ndarray) -> np.ndarray:
    """1/[r (1 + r)^2]."""
    return 1.0 / (r * (1.0 + r) ** 2)


def project(density: Density, x: np.ndarray, r_max: float = FAR) -> np.ndarray:
    """F(x), the integral of the density over the near half of the line of sight inside r_max.

    Gauss-Legendre in asinh(l/x), 1e-12 for an NFW.

    Args:
        density: of the radius, any shape.
        x: projected radii, `(n,)`, > 0.
        r_max: the sphere that holds everything.
    """
    x = np.minimum(np.asarray(x, dtype=float), r_max)[:, None]
    half = 0.5 * np.arcsinh(np.sqrt(r_max**2 - x**2) / x)
    r = x * np.cosh(half * (1.0 + _NODES))
    return half[:, 0] * ((density(r) * r) @ _WEIGHTS)


def expand(density: Density, edge: float | None = None) -> tuple[np.ndarray, np.ndarray, float]:
    """Cores and central values of cored steep ellipsoids whose sum is F.

    F(x) = sum_i F_i [1 + (x/S_i)^2]^(-3/2), by linear least squares with fixed cores (our choice). Without an
    edge the relative error is below 1e-5 for 1e-4 < x < 1e3. An edge at radius `edge` has a vertical tangent,
    which smooth terms cannot follow: inside 0.7 of it the error is below 1e-3, from there to 1.4 times its
    radius the edge is smeared out (by up to a fifth of F at 3/4 of the edge), and beyond less than 1e-3 of
    that number remains.

    Args:
        density: of the radius.
        edge: radius of the sphere outside which there is nothing; None for none.

    Returns:
        S `(k,)`, F_i `(k,)`, and the largest error relative to F (to F(3 edge/4), where F is smaller) outside
        the region of the edge.
    """
    if edge is None:
        x, cores = np.geomspace(1e-4, 1e3, 1500), np.geomspace(3e-5, 3e3, _WHOLE)
        shape = project(density, x)
        least, weight = 0.0, np.ones_like(x)
    else:
        x = edge * np.concatenate(
            [np.geomspace(1e-4 / edge, 0.5, 800), np.linspace(0.5, 2.0, 1200), np.geomspace(2.0, 100.0, 300)]
        )
        inner = np.geomspace(1e-4, 0.3 * edge, _CUT // 2)
        cores = np.append(inner, np.geomspace(0.3 * edge, 10.0 * edge, _CUT // 2 + 1)[1:])
        shape = np.where(x < edge, project(density, x, edge), 0.0)
        least = float(project(density, np.array([0.75 * edge]), edge)[0])
        weight = np.where(np.abs(np.log(x / edge)) < np.log(_SMOOTHED), 0.01, 1.0)
    scale = 1.0 / np.maximum(shape, least)
    terms = (1.0 + (x[:, None] / cores) ** 2) ** -1.5
    values = np.linalg.lstsq(terms * (scale * weight)[:, None], shape * scale * weight, rcond=1e-13)[0]
    error = np.abs(terms @ values - shape) * scale
    return cores, values, float(error[weight == 1.0].max())
