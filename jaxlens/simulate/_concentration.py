"""Concentration of a halo from its mass and redshift, and its scatter."""

import math
from functools import lru_cache

from jaxlens.simulate._structure import PROGENITOR, Structure, age, formation_redshift


def zhao(mass: float, z: float, s: Structure) -> float:
    """c = 4 [1 + (t(z)/(3.75 t_04))^8.4]^(1/8), Zhao et al. 2009 (quoted from secondary sources).

    t_04 is the cosmic time at which the main progenitor had 4 % of the mass, by `formation_redshift`.

    Args:
        mass: virial mass (Bryan & Norman), Msun.
        z: redshift.
        s: the universe.
    """
    t_04 = age(formation_redshift(mass, z, PROGENITOR, s), s)
    return 4.0 * (1.0 + (age(z, s) / (3.75 * t_04)) ** 8.4) ** 0.125


def neto(mass: float, z: float, s: Structure) -> float:
    """c = 4.67 (M/1e14 Msun/h)^-0.11/(1+z) (Neto et al. 2007, quoted from secondary sources)."""
    return 4.67 * (mass * s.h / 1e14) ** -0.11 / (1.0 + z)


RELATIONS = {"zhao": zhao, "neto": neto}
"""Median concentrations by name."""


@lru_cache(maxsize=1024)
def median(relation: str, mass: float, z: float, s: Structure) -> float:
    """Median concentration of `RELATIONS[relation]`; arguments as for `zhao`."""
    return RELATIONS[relation](mass, z, s)


def mean(relation: str, mass: float, z: float, scatter: float, s: Structure) -> float:
    """Mean of the log-normal about the median with standard deviation `scatter` of ln c."""
    return median(relation, mass, z, s) * math.exp(0.5 * scatter**2)
