"""The ultraviolet luminosity function of galaxies from z = 0.05 to 9, and how many a field holds.

Below z = 2: Cucciati et al. 2012 (A&A 539, A31, arXiv:1109.1005, Table 1; FUV at 150 nm, VVDS). From z = 2:
Bouwens et al. 2021 (AJ 162, 47, arXiv:2102.07775; about 160 nm). Both are Schechter functions of observed
(not dust-corrected) AB magnitudes, phi* per comoving Mpc^3 for h = 0.7, Omega_m = 0.3.

The numbers were transcribed from secondary sources and not checked against the originals; the row at
z = 3.0 is quoted there as 2.9 as well (0.5 % of the counts), and M* at z = 8.9 is that of the paper's own
evolution. Its formulae for the evolution of the three numbers, another reading of the same table, are not
built: they hold 709 galaxies where the table holds 662. Everything here runs on the host, in NumPy, in double
precision; nothing is differentiable.
"""

from dataclasses import dataclass
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array
from jaxlens.cosmology import FlatLCDM
from jaxlens.units import ARCSEC, C_KM_S

# z_low, z_high, z_middle, M*, phi* [Mpc^-3], alpha.
CUCCIATI_2012 = np.array(
    [
        [0.05, 0.2, 0.125, -18.12, 7.00e-3, -1.05],
        [0.2, 0.4, 0.3, -18.30, 6.91e-3, -1.17],
        [0.4, 0.6, 0.5, -18.40, 6.60e-3, -1.07],
        [0.6, 0.8, 0.7, -18.30, 9.53e-3, -0.90],
        [0.8, 1.0, 0.9, -18.70, 9.01e-3, -0.85],
        [1.0, 1.2, 1.1, -19.00, 7.43e-3, -0.91],
        [1.2, 1.7, 1.45, -19.60, 4.10e-3, -1.09],
        [1.7, 2.5, 2.1, -20.40, 3.37e-3, -1.30],
    ]
)
# z, M*, phi* [Mpc^-3], alpha.
BOUWENS_2021 = np.array(
    [
        [2.1, -20.28, 4.0e-3, -1.52],
        [3.0, -20.87, 2.1e-3, -1.61],
        [3.8, -20.93, 1.69e-3, -1.69],
        [4.9, -21.10, 0.79e-3, -1.74],
        [5.9, -20.93, 0.51e-3, -1.93],
        [6.8, -21.15, 0.19e-3, -2.06],
        [7.9, -20.93, 0.09e-3, -2.23],
        [8.9, -21.15, 0.021e-3, -2.33],
    ]
)

JOINT = 2.0
"""Redshift at which the second table takes over, as stated in the paper; the density jumps there."""

Z_RANGE = (float(CUCCIATI_2012[0, 0]), 9.0)
"""Redshifts that the tables serve."""

FAINTEST = 40.0
"""Faintest limit in apparent magnitude that is accepted; the tables end long before."""

LOW_Z = ("step", "linear")
HIGH_Z = ("linear", "nearest")

_PIECE, _MAGNITUDES = 48, 1500
# Nodes between two edges of the tables, and of the magnitudes: the counts are good to 1e-4 (measured
# against three times as many).


@dataclass(frozen=True)
class Depth:
    """Which galaxies are drawn, and how the tables are read.

    Attributes:
        m_cut: faintest apparent magnitude without a lens.
        m_bright: brightest absolute magnitude.
        z_max: largest redshift.
        k_term: m = M + DM(z) - 2.5 log10(1+z), that of a flat spectrum f_nu; False leaves the last term out.
        low_z: below z = 2 the bin that holds z (`step`) or linear in z between the middles (`linear`), our
            choice.
        high_z: from z = 2 linear in z of (M*, log10 phi*, alpha), or the nearest row (`nearest`), our choice.
    """

    m_cut: float = 32.0
    m_bright: float = -25.0
    z_max: float = 9.0
    k_term: bool = True
    low_z: str = "step"
    high_z: str = "linear"

    def __post_init__(self) -> None:
        if self.low_z not in LOW_Z:
            raise ValueError(f"`low_z` is {self.low_z!r}; choose one of {LOW_Z}.")
        if self.high_z not in HIGH_Z:
            raise ValueError(f"`high_z` is {self.high_z!r}; choose one of {HIGH_Z}.")
        if not 0.0 < self.m_cut <= FAINTEST:
            raise ValueError(
                f"`m_cut` is {self.m_cut}; give an apparent magnitude between 0 and {FAINTEST:g}."
            )
        if not Z_RANGE[0] < self.z_max <= Z_RANGE[1]:
            raise ValueError(
                f"`z_max` is {self.z_max}; the luminosity functions serve z up to {Z_RANGE[1]:g}."
            )


def schechter(z: np.ndarray, depth: Depth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M*, phi* [Mpc^-3] and alpha at redshifts `z (n,)`, each `(n,)`."""
    z = np.asarray(z, float)
    low = CUCCIATI_2012
    if depth.low_z == "step":
        row = np.clip(np.searchsorted(low[:, 0], z, side="right") - 1, 0, len(low) - 1)
        m_low, log_phi_low, alpha_low = low[row, 3], np.log10(low[row, 4]), low[row, 5]
    else:
        # The middle of the last bin lies above z = 2; beyond the first and last middle the ends count.
        m_low, log_phi_low, alpha_low = (
            np.interp(z, low[:, 2], v) for v in (low[:, 3], np.log10(low[:, 4]), low[:, 5])
        )
    high = BOUWENS_2021
    columns = high[:, 1], np.log10(high[:, 2]), high[:, 3]
    if depth.high_z == "linear":
        m_high, log_phi_high, alpha_high = (np.interp(z, high[:, 0], v) for v in columns)
    else:
        row = np.argmin(np.abs(z[:, None] - high[:, 0]), axis=1)
        m_high, log_phi_high, alpha_high = (v[row] for v in columns)
    early = z >= JOINT
    pick = lambda a, b: np.where(early, b, a)
    return pick(m_low, m_high), 10.0 ** pick(log_phi_low, log_phi_high), pick(alpha_low, alpha_high)


def density(magnitude: np.ndarray, z: np.ndarray, depth: Depth) -> np.ndarray:
    """Phi(M, z) = 0.4 ln 10 phi* x^(alpha+1) exp(-x), x = 10^(-0.4 (M - M*)), per Mpc^3 and magnitude.

    Args:
        magnitude: absolute magnitudes, `(n, m)`.
        z: redshifts, `(n,)`.
        depth: how the tables are read.
    """
    m_star, phi, alpha = (v[:, None] for v in schechter(z, depth))
    x = 10.0 ** (-0.4 * (magnitude - m_star))
    return 0.4 * np.log(10.0) * phi * x ** (alpha + 1.0) * np.exp(-x)


@jax.jit
def _distance(cosmology: FlatLCDM, z: Array) -> Array:
    return cosmology.comoving_distance(z)


def comoving_distance(z: np.ndarray, cosmology: FlatLCDM) -> np.ndarray:
    """Line-of-sight comoving distance on the host, Mpc, `(n,)`; few compiled programs for all lengths."""
    room = np.pad(np.asarray(z, float), (0, -len(z) % 1024))
    return np.asarray(_distance(cosmology, jnp.asarray(room)), float)[: len(z)]


def distance_modulus(z: np.ndarray, cosmology: FlatLCDM) -> np.ndarray:
    """DM(z) = 5 log10(D_L/10 pc), mag, `(n,)`."""
    luminosity = comoving_distance(z, cosmology) * (1.0 + np.asarray(z))
    return 5.0 * np.log10(luminosity) + 25.0


def apparent(magnitude: np.ndarray, z: np.ndarray, cosmology: FlatLCDM, depth: Depth) -> np.ndarray:
    """Apparent magnitude without a lens, m = M + DM(z) - 2.5 log10(1+z), `(n,)`."""
    term = 2.5 * np.log10(1.0 + np.asarray(z)) if depth.k_term else 0.0
    return magnitude + distance_modulus(z, cosmology) - term


def faintest(z: np.ndarray, cosmology: FlatLCDM, depth: Depth) -> np.ndarray:
    """Absolute magnitude that has `depth.m_cut` without a lens, `(n,)`; never brighter than `m_bright`."""
    return np.maximum(depth.m_cut - apparent(np.zeros_like(z), z, cosmology, depth), depth.m_bright)


def _magnitudes(z: np.ndarray, cosmology: FlatLCDM, depth: Depth) -> np.ndarray:
    """Nodes from the bright to the faint end, `(n, m)`."""
    end = faintest(z, cosmology, depth)[:, None]
    return depth.m_bright + (end - depth.m_bright) * np.linspace(0.0, 1.0, _MAGNITUDES)


def _cumulative(values: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Integral from the first node by the trapezium rule, along the last axis."""
    steps = 0.5 * (values[..., 1:] + values[..., :-1]) * np.diff(nodes, axis=-1)
    return np.concatenate([np.zeros((*steps.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)


@dataclass(frozen=True)
class Counts:
    """Expected galaxies behind a lens, as a function of redshift.

    Attributes:
        z: redshifts, `(n,)`; an edge of the tables appears twice, with its two values.
        per_z: galaxies per arcsec^2 and unit redshift, `(n,)`.
        cumulative: per arcsec^2 up to there, `(n,)`.
    """

    z: np.ndarray
    per_z: np.ndarray
    cumulative: np.ndarray

    def expected(self, area: float, z_low: float = 0.0, z_high: float = np.inf) -> float:
        """Expected number in `area` arcsec^2 between two redshifts."""
        at = lambda z: np.interp(z, self.z, self.cumulative)
        return float(area * (at(z_high) - at(z_low)))


def counts(z_min: float, cosmology: FlatLCDM, depth: Depth) -> Counts:
    """dN/dz per arcsec^2, dV/(dOmega dz) times the integral of Phi from the bright end to the limit.

    Args:
        z_min: smallest redshift, e.g. that of the lens.
        cosmology: the universe.
        depth: which galaxies.

    Raises:
        ValueError: if the tables do not serve the redshifts.
    """
    if not Z_RANGE[0] <= z_min < depth.z_max:
        raise ValueError(
            f"`z_min` is {z_min}; galaxies are drawn between {Z_RANGE[0]} and z_max = {depth.z_max:g}."
        )
    edges = {*CUCCIATI_2012[:, 0], *BOUWENS_2021[:, 0], JOINT}
    if depth.low_z == "linear":
        edges |= {*CUCCIATI_2012[:, 2]}
    if depth.high_z == "nearest":
        edges |= {*(0.5 * (BOUWENS_2021[1:, 0] + BOUWENS_2021[:-1, 0]))}
    knots = [z_min, *sorted(z for z in edges if z_min < z < depth.z_max), depth.z_max]
    # Just inside its ends, so that each piece sees its own bin.
    pieces = [np.linspace(a * (1.0 + 1e-12), b * (1.0 - 1e-12), _PIECE) for a, b in pairwise(knots)]
    z = np.concatenate(pieces)
    magnitudes = _magnitudes(z, cosmology, depth)
    galaxies = _cumulative(density(magnitudes, z, depth), magnitudes)[:, -1]  # Mpc^-3
    distance = comoving_distance(z, cosmology)
    hubble = 100.0 * float(cosmology.h) * np.sqrt(float(cosmology.omega_m) * ((1.0 + z) ** 3 - 1.0) + 1.0)
    per_z = galaxies * C_KM_S / hubble * distance**2 * ARCSEC**2
    return Counts(z, per_z, _cumulative(per_z, z))


def redshifts(u: np.ndarray, found: Counts) -> np.ndarray:
    """Redshifts by the inverse of the cumulative counts, for uniform numbers `u (n,)`."""
    return np.interp(u * found.cumulative[-1], found.cumulative, found.z)


def magnitudes(u: np.ndarray, z: np.ndarray, cosmology: FlatLCDM, depth: Depth) -> np.ndarray:
    """Absolute magnitudes at redshifts `z (n,)` by inverting the cumulative Phi, for uniform `u (n,)`."""
    nodes = _magnitudes(z, cosmology, depth)
    whole = _cumulative(density(nodes, z, depth), nodes)
    return np.array(
        [np.interp(one * each[-1], each, at) for one, each, at in zip(u, whole, nodes, strict=True)]
    )
