"""Adiabatic contraction of a halo by the galaxy at its centre. On the host, NumPy."""

import numpy as np

from jaxlens.simulate._expansion import Density, nfw
from jaxlens.simulate._subhaloes import nfw_mass


def initial_radius(r: np.ndarray, concentration: float, fraction: float, r_g: float) -> np.ndarray:
    """Where the dark matter now inside r came from: r [M_b(r) + (1-f) M_i(r_i)] = r_i M_i(r_i).

    Blumenthal et al. 1986; M_b is a Hernquist galaxy, M_i the NFW before. Radii in units of r_s.

    Args:
        r: radii now, `(n,)`.
        concentration: r_vir/r_s.
        fraction: f, the mass of the galaxy over the virial mass.
        r_g: scale radius of the galaxy.
    """
    galaxy = fraction * nfw_mass(concentration) * r**2 / (r + r_g) ** 2
    # The dark matter moves inwards only where the galaxy weighs more than what it replaced.
    low, high = np.log(r) - 5.0, np.log(r) + 25.0
    for _ in range(70):
        middle = 0.5 * (low + high)
        start = np.exp(middle)
        mass = nfw_mass(start)
        short = r * (galaxy + (1.0 - fraction) * mass) > start * mass
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.exp(0.5 * (low + high))


def contracted(concentration: float, fraction: float, r_g: float) -> Density:
    """Density of the contracted dark matter over (1 - f) rho_s; arguments as for `initial_radius`.

    Interpolated between 4000 radii from 1e-7 to 1e8 r_s.
    """
    r = np.geomspace(1e-7, 1e8, 4000)
    start = initial_radius(r, concentration, fraction, r_g)
    mass, slope = nfw_mass(start), start**2 * nfw(start)
    scale = fraction * nfw_mass(concentration)
    galaxy, steeper = scale * r**2 / (r + r_g) ** 2, scale * 2.0 * r * r_g / (r + r_g) ** 3
    # From the derivative of the condition: d r_i/dr.
    up = galaxy + r * steeper + (1.0 - fraction) * mass
    down = mass + start * slope - r * (1.0 - fraction) * slope
    # Imports scipy.optimize, a third of a second that only contracted haloes need.
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(np.log(r), np.log(slope * up / down / r**2))
    return lambda at: np.exp(spline(np.log(at)))
