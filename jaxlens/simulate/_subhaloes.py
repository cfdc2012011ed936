"""Subhaloes of one halo: how many, how heavy, where, and how far they reach.

Lengths in Mpc/h and masses in Msun/h, as the published relations have them; G has no h in these units.
"""

import math

import jax
import numpy as np

from jaxlens._types import RandomKey
from jaxlens.units import G_MPC_KM2_S2_MSUN

ABUNDANCE, SLOPE, CUTOFF = 9.33e-4, 0.9, 12.2715
"""dN/d ln m = A M (1+z)^1/2 (cbar/c) m^-0.9 exp[-12.2715 (m/M)^3] (Giocoli et al. 2010; A for Msun/h)."""

GAO_A = 0.244
"""N(<x)/N = (1 + a c) x^2.75/(1 + a c x^2) (Gao et al. 2004, x = r/R_vir: our choice of the radius)."""

_NODES = 4000
_BLOCK = 1024
# Draws come in multiples of this, so that the same few programs serve every number of subhaloes.


def nfw_mass(x: np.ndarray | float) -> np.ndarray:
    """m(x) = ln(1+x) - x/(1+x), the mass of an NFW in units of 4 pi rho_s r_s^3."""
    x = np.asarray(x, dtype=float)
    # The difference loses its digits for small x: x^2/2 - 2 x^3/3 + 3 x^4/4.
    return np.where(x < 1e-3, x**2 * (0.5 - x * (2.0 / 3.0 - 0.75 * x)), np.log1p(x) - x / (1.0 + x))


def mass_function(mass: float, z: float, excess: float, low: float, high: float) -> tuple[np.ndarray, ...]:
    """The mean number of subhaloes.

    Args:
        mass: virial mass of the host, Msun/h.
        z: its redshift.
        excess: cbar/c, the mean concentration at this mass over that of the host.
        low, high: smallest and largest mass of a subhalo, Msun/h.

    Returns:
        ln m `(k,)` and the mean number lighter than that and heavier than `low`, `(k,)`.
    """
    log_m = np.linspace(math.log(low), math.log(high), _NODES)
    m = np.exp(log_m)
    density = ABUNDANCE * mass * math.sqrt(1.0 + z) * excess * m**-SLOPE * np.exp(-CUTOFF * (m / mass) ** 3)
    steps = 0.5 * (density[1:] + density[:-1]) * np.diff(log_m)
    return log_m, np.concatenate([[0.0], np.cumsum(steps)])


def fraction_within(x: np.ndarray | float, concentration: float) -> np.ndarray:
    """Fraction of the subhaloes with r < x R_vir, 0 <= x <= 1."""
    x = np.asarray(x, dtype=float)
    ac = GAO_A * concentration
    return np.asarray((1.0 + ac) * x**2.75 / (1.0 + ac * x**2))


def uniform(key: RandomKey, count: int) -> np.ndarray:
    """`count` numbers in [0, 1)."""
    return np.asarray(jax.random.uniform(key, (_capacity(count),)))[:count]


def normal(key: RandomKey, count: int, width: int) -> np.ndarray:
    """`(count, width)` numbers of the unit normal."""
    return np.asarray(jax.random.normal(key, (_capacity(count), width)))[:count]


def _capacity(count: int) -> int:
    return _BLOCK * max(1, -(-count // _BLOCK))


def draw_masses(
    count_key: RandomKey, mass_key: RandomKey, log_m: np.ndarray, below: np.ndarray
) -> np.ndarray:
    """Masses of a Poisson number of subhaloes, Msun/h, by inversion of `mass_function`."""
    count = int(jax.random.poisson(count_key, float(below[-1])))
    return np.exp(np.interp(uniform(mass_key, count) * below[-1], below, log_m))


def draw_positions(
    radius_key: RandomKey, direction_key: RandomKey, count: int, concentration: float, to_sky: np.ndarray
) -> np.ndarray:
    """Positions in units of R_vir, `(count, 3)`, in the observer's frame.

    The radius in the ellipsoid follows `fraction_within`, its direction is isotropic there, and
    `to_sky (3, 3)` = R diag(a, b, c) takes both to the sky: satellites follow the shape of the halo (our
    choice).
    """
    x = np.linspace(0.0, 1.0, 8 * _NODES) ** (1.0 / 2.75)  # equal steps of the innermost numbers
    radius = np.interp(uniform(radius_key, count), fraction_within(x, concentration), x)
    direction = normal(direction_key, count, 3)
    return (radius / np.linalg.norm(direction, axis=1))[:, None] * direction @ to_sky.T


def truncation_radius(
    m: np.ndarray, r: np.ndarray, mass: float, concentration: float, r_vir: float
) -> np.ndarray:
    """R_t = r {m/[(2 - d ln M/d ln r) M(<r)]}^1/3 in a spherical NFW host (Tormen, Diaferio & Syer 1998).

    Args:
        m: masses of the subhaloes, `(n,)`, Msun/h.
        r: their distances from the centre, `(n,)`, Mpc/h.
        mass, concentration, r_vir: of the host, Msun/h and Mpc/h.

    Returns:
        Truncation radii, `(n,)`, Mpc/h.
    """
    x = r * concentration / r_vir
    within = mass * nfw_mass(x) / nfw_mass(concentration)
    slope = x**2 / ((1.0 + x) ** 2 * nfw_mass(x))
    return r * np.cbrt(m / ((2.0 - slope) * within))


def velocity_dispersion(m: np.ndarray, r_t: np.ndarray) -> np.ndarray:
    """sigma_v = sqrt(G m/(2 R_t)) of the isothermal sphere of mass m cut at R_t, km/s."""
    return np.sqrt(0.5 * G_MPC_KM2_S2_MSUN * m / r_t)
