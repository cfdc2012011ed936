"""Growth of structure on the host: transfer function, sigma(M), growth, cosmic time, formation redshifts.

Plain NumPy in double precision. Nothing here is differentiable, and nothing here depends on JAX's settings.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import hyp2f1

from jaxlens.cosmology import FlatLCDM
from jaxlens.units import G_MPC_KM2_S2_MSUN

T_CMB = 2.7255
"""Temperature of the background radiation, K; it enters the transfer function alone."""

DELTA_C = 1.686
"""Linear overdensity of collapse."""

PROGENITOR = 0.04
"""Share of its mass that the main progenitor of a halo had at the time behind its concentration."""

GYR_KM_S_MPC = 977.79222168
"""One Mpc/(km/s) in Gyr (Julian years)."""


@dataclass(frozen=True)
class Structure:
    """A flat universe with its initial fluctuations.

    Attributes:
        h: Hubble constant in units of 100 km/s/Mpc.
        omega_m: matter density parameter today.
        sigma8: linear rms of the density in spheres of 8 Mpc/h today.
        n_s: slope of the initial power spectrum.
        omega_b: baryon density parameter today.
    """

    h: float
    omega_m: float
    sigma8: float = 0.8
    n_s: float = 0.96
    omega_b: float = 0.045

    @classmethod
    def of(cls, cosmology: FlatLCDM, *, sigma8: float, n_s: float, omega_b: float) -> "Structure":
        """The numbers of `cosmology` with a power spectrum."""
        return cls(float(cosmology.h), float(cosmology.omega_m), sigma8, n_s, omega_b)


def transfer(k: np.ndarray, s: Structure) -> np.ndarray:
    """Matter transfer function with baryons, Eisenstein & Hu 1998, eqs. 2-24.

    Args:
        k: comoving wavenumber, 1/Mpc (no h).
        s: the universe.

    Returns:
        T(k), 1 on large scales, shape of `k`.
    """
    om, ob = s.omega_m * s.h**2, s.omega_b * s.h**2
    f_b = s.omega_b / s.omega_m
    f_c = 1.0 - f_b
    theta = T_CMB / 2.7
    z_eq, k_eq = 2.5e4 * om / theta**4, 7.46e-2 * om / theta**2
    b1 = 0.313 * om**-0.419 * (1.0 + 0.607 * om**0.674)
    z_d = 1291.0 * om**0.251 / (1.0 + 0.659 * om**0.828) * (1.0 + b1 * ob ** (0.238 * om**0.223))
    r_d, r_eq = (31.5 * ob / theta**4 * 1e3 / z for z in (z_d, z_eq))
    ratio = (math.sqrt(1.0 + r_d) + math.sqrt(r_d + r_eq)) / (1.0 + math.sqrt(r_eq))
    sound = 2.0 / (3.0 * k_eq) * math.sqrt(6.0 / r_eq) * math.log(ratio)
    k_silk = 1.6 * ob**0.52 * om**0.73 * (1.0 + (10.4 * om) ** -0.95)
    q, ks = k / (13.41 * k_eq), k * sound

    def pressureless(alpha: float, beta: float) -> np.ndarray:
        log = np.log(math.e + 1.8 * beta * q)
        return log / (log + (14.2 / alpha + 386.0 / (1.0 + 69.9 * q**1.08)) * q**2)

    a1 = (46.9 * om) ** 0.670 * (1.0 + (32.1 * om) ** -0.532)
    a2 = (12.0 * om) ** 0.424 * (1.0 + (45.0 * om) ** -0.582)
    alpha_c = a1**-f_b * a2 ** -(f_b**3)
    beta_c = 1.0 / (1.0 + 0.944 / (1.0 + (458.0 * om) ** -0.708) * (f_c ** (0.395 * om) ** -0.0266 - 1.0))
    mix = 1.0 / (1.0 + (ks / 5.4) ** 4)
    cold = mix * pressureless(1.0, beta_c) + (1.0 - mix) * pressureless(alpha_c, beta_c)

    y = (1.0 + z_eq) / (1.0 + z_d)
    root = math.sqrt(1.0 + y)
    g = y * (-6.0 * root + (2.0 + 3.0 * y) * math.log((root + 1.0) / (root - 1.0)))
    alpha_b = 2.07 * k_eq * sound * (1.0 + r_d) ** -0.75 * g
    beta_b = 0.5 + f_b + (3.0 - 2.0 * f_b) * math.sqrt((17.2 * om) ** 2 + 1.0)
    shift = (1.0 + (8.41 * om**0.435 / ks) ** 3) ** (-1.0 / 3.0)
    wave = np.sinc(ks * shift / math.pi)
    damped = alpha_b / (1.0 + (beta_b / ks) ** 3) * np.exp(-((k / k_silk) ** 1.4))
    baryons = (pressureless(1.0, 1.0) / (1.0 + (ks / 5.2) ** 2) + damped) * wave
    return f_b * baryons + f_c * cold


@lru_cache(maxsize=16)
def _spectrum(s: Structure) -> tuple[np.ndarray, np.ndarray]:
    """ln k and k^3 P(k)/(2 pi^2), normalised to sigma8 today."""
    log_k = np.linspace(math.log(1e-5), math.log(1e3), 6000)
    k = np.exp(log_k)
    power = k ** (s.n_s + 3.0) * transfer(k, s) ** 2
    return log_k, power * (s.sigma8**2 / _variance(log_k, power, 8.0 / s.h))


def _variance(log_k: np.ndarray, power: np.ndarray, radius: float) -> float:
    """Integral of k^3 P/(2 pi^2) W^2(k R) d ln k with a top hat of `radius` Mpc (comoving)."""
    x = np.exp(log_k) * radius
    # Below 0.02 the quotient loses its digits; 1 - x^2/10 is exact to 1e-9 there.
    safe = np.where(x < 0.02, 1.0, x)
    window = np.where(x < 0.02, 1.0 - x**2 / 10.0, 3.0 * (np.sin(safe) - safe * np.cos(safe)) / safe**3)
    return float(np.trapezoid(power * window**2, log_k))


def sigma(mass: float, s: Structure) -> float:
    """Linear rms of the density today in the top hat that holds `mass` (Msun) on average."""
    mean_density = s.omega_m * 3.0 * (100.0 * s.h) ** 2 / (8.0 * math.pi * G_MPC_KM2_S2_MSUN)
    radius = (3.0 * mass / (4.0 * math.pi * mean_density)) ** (1.0 / 3.0)
    return math.sqrt(_variance(*_spectrum(s), radius))


def growth(z: float, s: Structure) -> float:
    """Linear growth factor D(z), 1 today: a 2F1(1/3, 1; 11/6; -a^3 (1 - Omega_m)/Omega_m)."""

    def unnormalised(a: float) -> float:
        return a * float(hyp2f1(1.0 / 3.0, 1.0, 11.0 / 6.0, -(a**3) * (1.0 - s.omega_m) / s.omega_m))

    return unnormalised(1.0 / (1.0 + z)) / unnormalised(1.0)


def omega_m_at(z: float, s: Structure) -> float:
    """Matter density parameter at `z`."""
    matter = s.omega_m * (1.0 + z) ** 3
    return matter / (matter + 1.0 - s.omega_m)


def age(z: float, s: Structure) -> float:
    """Cosmic time at `z`, Gyr; closed form for a flat universe of matter and Lambda."""
    hubble_time = GYR_KM_S_MPC / (100.0 * s.h)
    dark = 1.0 - s.omega_m
    if dark == 0.0:
        return 2.0 / 3.0 * hubble_time * (1.0 + z) ** -1.5
    return (
        2.0
        / (3.0 * math.sqrt(dark))
        * hubble_time
        * math.asinh(math.sqrt(dark / s.omega_m) * (1.0 + z) ** -1.5)
    )


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    # A third of a second to import, and only simulations need it.
    from scipy.optimize import brentq

    return float(brentq(function, low, high, xtol=1e-12))  # pyright: ignore[reportArgumentType]


def formation_redshift(mass: float, z: float, fraction: float, s: Structure) -> float:
    """Redshift at which the main progenitor of a halo first had `fraction` of its mass.

    delta_c(z_f)/D(z_f) = delta_c(z)/D(z) + w sqrt(sigma^2(f M) - sigma^2(M)), w = sqrt(2 ln(alpha + 1)),
    alpha = 0.815 exp(-2 f^3)/f^0.707 (Giocoli, Tormen & Sheth 2012; quoted from secondary sources, not
    checked against the original), delta_c(z) = 1.686 Omega_m(z)^0.0055.

    Args:
        mass: virial mass at `z`, Msun.
        z: redshift of the halo.
        fraction: f in (0, 1).
        s: the universe.
    """
    target = _barrier(z, s) + _step(mass, fraction, s)
    return _root(lambda at: _barrier(at, s) - target, z, _EARLIEST)


_EARLIEST = 200.0
# Redshifts of formation are sought up to there.


def _barrier(z: float, s: Structure) -> float:
    """delta_c(z)/D(z)."""
    return DELTA_C * omega_m_at(z, s) ** 0.0055 / growth(z, s)


def _step(mass: float, fraction: float, s: Structure) -> float:
    """w sqrt(sigma^2(f M) - sigma^2(M)), proportional to sigma8."""
    alpha = 0.815 * math.exp(-2.0 * fraction**3) / fraction**0.707
    w = math.sqrt(2.0 * math.log1p(alpha))
    return w * math.sqrt(sigma(fraction * mass, s) ** 2 - sigma(mass, s) ** 2)


_LIGHTEST, _HEAVIEST = 1e4, 1e16
# Msun; the characteristic mass is sought between them.


def characteristic_mass(z: float, s: Structure) -> float:
    """M* with sigma(M*, z) = 1.686, Msun."""

    def excess(log_mass: float) -> float:
        return growth(z, s) * sigma(math.exp(log_mass), s) - DELTA_C

    return math.exp(_root(excess, math.log(_LIGHTEST), math.log(_HEAVIEST)))


def sigma8_range(masses: list[float], z: float, s: Structure) -> tuple[float, float]:
    """Between which sigma8 there is an M* (1e4 to 1e16 Msun), and haloes formed after z = 200.

    Args:
        masses: of haloes at `z`, Msun.
        z: their redshift.
        s: the universe; its own sigma8 plays no role.
    """
    unit = replace(s, sigma8=1.0)
    grown = growth(z, unit)
    low, high = (DELTA_C / (grown * sigma(mass, unit)) for mass in (_LIGHTEST, _HEAVIEST))
    room = _barrier(_EARLIEST, unit) - _barrier(z, unit)
    return low, min(high, *(room / _step(mass, PROGENITOR, unit) for mass in masses))
