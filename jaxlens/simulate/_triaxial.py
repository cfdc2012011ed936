"""Triaxial haloes: axis ratios, orientations, and their exact projection on the sky.

The observer's frame has x = theta_1, y = theta_2 and z along the line of sight. A halo's own axes are
ordered a <= b <= c along its x, y and z, scaled to abc = 1 (our choice), so that an ellipsoid of radius
R^2 = x^2/a^2 + y^2/b^2 + z^2/c^2 holds the mass of the sphere of that radius.
"""

import math
from dataclasses import dataclass

import jax
import numpy as np

from jaxlens._types import RandomKey
from jaxlens.simulate._structure import Structure, characteristic_mass, omega_m_at

R_AC, R_AC_SCATTER = 0.54, 0.113
"""Mean and standard deviation of the scaled axis ratio (Jing & Suto 2002)."""

LEAST_A_C = 0.1
"""Axis ratios a/c below this are not drawn (our choice)."""


@dataclass(frozen=True)
class Projection:
    """The ellipses on which the convergence of an ellipsoid is constant.

    Attributes:
        f: component zz of the quadratic form of the ellipsoid; the convergence carries 1/sqrt(f).
        q: axis ratio of the ellipses, minor over major.
        pa: position angle of the major axis, from +theta_1 towards +theta_2, in [0, pi).
    """

    f: float
    q: float
    pa: float


def axis_scale(mass: float, z: float, s: Structure) -> float:
    """(M/M*)^(0.07 Omega_m(z)^0.7), by which Jing & Suto scale a/c; `mass` in Msun."""
    return (mass / characteristic_mass(z, s)) ** (0.07 * omega_m_at(z, s) ** 0.7)


def draw_axis_ratios(key: RandomKey, scale: float) -> tuple[float, float]:
    """Axis ratios (a/c, b/c), a <= b <= c, of Jing & Suto 2002.

    (a/c) `scale` is Gaussian with mean 0.54 and standard deviation 0.113, truncated to 0.1 < a/c < 1;
    a/b follows 3/[2 (1 - r)] {1 - [(2 a/b - 1 - r)/(1 - r)]^2} above r = max(a/c, 0.5).

    Args:
        key: used once.
        scale: from `axis_scale`.
    """
    first, second = jax.random.split(key)
    low, high = ((x * scale - R_AC) / R_AC_SCATTER for x in (LEAST_A_C, 1.0))
    a_c = (R_AC + R_AC_SCATTER * float(jax.random.truncated_normal(first, low, high))) / scale
    # The distribution function of t in [-1, 1] is (3 t - t^3 + 2)/4, whose inverse is 2 sin(arcsin(.)/3).
    t = 2.0 * math.sin(math.asin(2.0 * float(jax.random.uniform(second)) - 1.0) / 3.0)
    least = max(a_c, 0.5)
    a_b = 0.5 * (t * (1.0 - least) + 1.0 + least)
    return a_c, min(a_c / a_b, 1.0)


def axes(axis_ratios: tuple[float, float]) -> np.ndarray:
    """Semi-axes (a, b, c) with abc = 1 for the ratios (a/c, b/c)."""
    a_c, b_c = axis_ratios
    return np.array([a_c, b_c, 1.0]) / np.cbrt(a_c * b_c)


def draw_orientation(key: RandomKey) -> tuple[float, float, float, float]:
    """A unit quaternion (w, x, y, z), uniform over the rotations."""
    four = np.asarray(jax.random.normal(key, (4,)), dtype=float)
    w, x, y, z = four / np.linalg.norm(four)
    return float(w), float(x), float(y), float(z)


def rotation(orientation: tuple[float, float, float, float]) -> np.ndarray:
    """Matrix from the halo's axes to the observer's frame, `(3, 3)`; the quaternion may have any length."""
    w, x, y, z = np.asarray(orientation, dtype=float) / np.linalg.norm(orientation)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quadratic_form(semi_axes: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Q of the ellipsoids x^T Q x = const in the observer's frame, `(3, 3)`."""
    return turn @ np.diag(1.0 / semi_axes**2) @ turn.T


def project(q: np.ndarray) -> tuple[float, np.ndarray]:
    """f = Q_zz and S = Q_perp - v v^T/Q_zz, v = (Q_xz, Q_yz), with zeta^2 = x^T S x on the sky.

    The integral of rho(x^T Q x) along z is that of the round profile at zeta, divided by sqrt(f)
    (Oguri, Lee & Suto 2003, in matrix form). det Q = f det S.
    """
    f, v = q[2, 2], q[:2, 2]
    return float(f), q[:2, :2] - np.outer(v, v) / f


def projection(semi_axes: np.ndarray, turn: np.ndarray) -> Projection:
    """The ellipses on the sky of an ellipsoid turned by `turn (3, 3)`."""
    f, s = project(quadratic_form(semi_axes, turn))
    values, vectors = np.linalg.eigh(s)
    major = vectors[:, 0]  # the smallest eigenvalue belongs to the longest axis
    angle = math.atan2(major[1], major[0]) % math.pi
    return Projection(f, math.sqrt(values[0] / values[1]), angle)


def turn_on_sky(turn: np.ndarray, angle: float) -> np.ndarray:
    """`turn` followed by a rotation by `angle` about the line of sight, which adds to the position angle."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ turn


def flattened(kappa_s: float, r_s: float, shape: Projection) -> tuple[float, float]:
    """kappa_s and r_s of the elliptical profile in xi^2 = q x^2 + y^2/q, from those of the sphere.

    kappa = kappa_s F(zeta/r_s)/sqrt(f) and zeta^2 = xi^2/sqrt(f), since det S = 1/f for abc = 1.
    """
    return kappa_s / math.sqrt(shape.f), r_s * shape.f**0.25
