"""Stellar masses and luminosities from halo masses."""

import math
from dataclasses import dataclass

import numpy as np

from jaxlens.simulate._structure import Structure, age, omega_m_at


@dataclass(frozen=True)
class Occupation:
    """M_star = 2 k/[(M/M_0)^-alpha + (M/M_0)^-beta].

    Attributes:
        mass_msun_h: M_0, Msun/h.
        alpha, beta: slopes above and below M_0.
        log_k: log10 of k.
        k_has_h: whether k is in Msun/h; in Msun otherwise.
        scatter_dex: standard deviation of log10 M_star.
    """

    mass_msun_h: float
    alpha: float
    beta: float
    log_k: float
    k_has_h: bool
    scatter_dex: float


_WANG_2006 = Occupation(3.16e11, 0.39, 1.96, 10.35, True, 0.148)

OCCUPATIONS = {
    "wang2006_moka": (_WANG_2006, _WANG_2006),
    "wang2013": (
        Occupation(3.43e11, 0.34, 2.56, 10.23, False, 0.169),
        Occupation(5.23e11, 0.298, 1.99, 10.30, False, 0.192),
    ),
}
"""Constants for centrals and satellites by name.

`wang2006_moka`: Wang et al. 2006, quoted from secondary sources, not checked against the original; that k is
in Msun/h is our choice. `wang2013`: Wang, De Lucia & Weinmann 2013.
"""


def stellar_mass(mass_msun_h: np.ndarray | float, relation: Occupation, h: float) -> np.ndarray:
    """Median stellar mass, Msun, of haloes of `mass_msun_h` (at infall), Msun/h; shape of the mass."""
    x = np.asarray(mass_msun_h, dtype=float) / relation.mass_msun_h
    k = 10.0**relation.log_k / (h if relation.k_has_h else 1.0)
    return np.asarray(2.0 * k / (x**-relation.alpha + x**-relation.beta))


def mass_loss_factor(z: float, z_infall: float, s: Structure) -> float:
    """Mass at infall over mass at `z`: exp[(t(z) - t(z_infall))/tau(z)].

    tau(z) = 2 Gyr [Delta_vir(z)/Delta_vir(0)]^-1/2 [H(z)/H_0]^-1 (Giocoli, Tormen & van den Bosch 2008,
    quoted from secondary sources, not checked against the original), Delta_vir of Bryan & Norman.
    """

    def overdensity(at: float) -> float:
        x = omega_m_at(at, s) - 1.0
        return 18.0 * math.pi**2 + 82.0 * x - 39.0 * x**2

    expansion = math.sqrt(s.omega_m * (1.0 + z) ** 3 + 1.0 - s.omega_m)
    tau = 2.0 / math.sqrt(overdensity(z) / overdensity(0.0)) / expansion
    return math.exp((age(z, s) - age(z_infall, s)) / tau)
