"""One cluster of a population: its settings, from its seed alone."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from jaxlens import reproduce
from jaxlens.config_population import LIMITS, Law, Laws, Population
from jaxlens.config_simulate import Simulate
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.simulate import Clump

_STREAMS = {
    "total_mass_msun_h": 0, "mass_ratio": 1, "separation_kpc_h": 2, "pa_difference_deg": 3, "z_l": 4, "n0": 5,
    "m_tele": 6,
}  # fmt: skip
_ORIENTATION = 1000
# Every number has deviates of its own, so that fixing one leaves the others as they were; a new one gets a
# new stream. Clumps follow the stream of orientations.


def numbers_of(seed: int, laws: Laws) -> dict[str, float]:
    """The drawn or fixed numbers of a cluster.

    Args:
        seed: of the cluster; the same seed gives the same numbers in any population of these laws.
        laws: what is drawn.

    Raises:
        ValueError: if a number describes no cluster, e.g. a negative redshift of a wide normal law.
    """
    found = {}
    for name, stream in _STREAMS.items():
        law = getattr(laws, name)
        rng = np.random.default_rng([seed, stream])
        uniform, gaussian = rng.random(), rng.standard_normal()
        found[name] = law.at(uniform, gaussian) if isinstance(law, Law) else float(law)
        _possible(seed, name, found[name], law)
    return found


def _possible(seed: int, name: str, value: float, law: Any) -> None:
    """Refuse a number that describes no cluster: the tail of a wide normal law."""
    low, high = LIMITS[name]
    if not low <= value <= high:
        raise ValueError(
            f"Seed {seed}: {name} is {value:.4g} ({_said(law)}), outside {low:g} to {high:g}; "
            f"narrow population.{name}."
        )


def turned(angle: float, azimuth: float, roll: float) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) that takes the major axis c to an angle from the line of sight, all rad.

    R_z(azimuth) R_y(angle) R_z(roll): the axis c, first along the line of sight, leans over by `angle`
    towards `azimuth`; `roll` turns the other two axes around it.
    """
    half, plus, minus = 0.5 * angle, 0.5 * (azimuth + roll), 0.5 * (azimuth - roll)
    return (
        math.cos(half) * math.cos(plus),
        -math.sin(half) * math.sin(minus),
        math.sin(half) * math.cos(minus),
        math.cos(half) * math.sin(plus),
    )


def _orientation(seed: int, clump: int, laws: Laws) -> tuple[float, float, float, float] | None:
    """Of a clump, or None for what the simulation draws."""
    if laws.major_axis_deg == "isotropic":
        return None
    rng = np.random.default_rng([seed, _ORIENTATION + clump])
    uniform, gaussian = rng.random(), rng.standard_normal()
    law = laws.major_axis_deg
    angle = law.at(uniform, gaussian) if isinstance(law, Law) else float(law)
    _possible(seed, "major_axis_deg", angle, law)
    azimuth, roll = 2.0 * math.pi * rng.random(2)
    return turned(math.radians(angle), float(azimuth), float(roll))


def _said(value: Any) -> str:
    """A law, or a fixed number, in words."""
    return f"{value.kind} [{value.numbers[0]:g}, {value.numbers[1]:g}]" if isinstance(value, Law) else "fixed"


def _inside(seed: int, z_l: float, said: Population) -> None:
    """Refuse a cluster whose outermost annuli leave the field: their means would be those of corners."""
    cosmology, field = said.simulate.cosmology, said.simulate.shear.field_arcmin
    kpc_h = float(LensPlane.at(z_l, FlatLCDM(h=cosmology.h, omega_m=cosmology.omega_m)).kpc_per_arcsec)
    half = 30.0 * field * kpc_h * cosmology.h
    if half < reproduce.EDGES[-1]:
        raise ValueError(
            f"Seed {seed}: z_l is {z_l:.4g} ({_said(said.population.z_l)}), where half of the field of "
            f"{field:g} arcmin is {half:.0f} kpc/h, less than the {reproduce.EDGES[-1]:g} kpc/h of the "
            "outermost annulus; raise population.z_l or shear.field_arcmin."
        )


def settings_of(seed: int, said: Population) -> Simulate:
    """The configuration of one cluster.

    Raises:
        ValueError: if what was drawn describes no cluster, or one so near that its annuli leave the field.
    """
    laws, base, drawn = said.population, said.simulate, numbers_of(seed, said.population)
    first = drawn["total_mass_msun_h"] / (1.0 + drawn["mass_ratio"])
    masses, half = (first, drawn["total_mass_msun_h"] - first), 0.5 * drawn["separation_kpc_h"]
    clumps = tuple(
        Clump(mass, x_kpc_h=side * half, orientation=_orientation(seed, index, laws))
        for index, (mass, side) in enumerate(zip(masses, (-1.0, 1.0), strict=True))
    )
    settings = Simulate.model_validate(
        base.model_copy(
            update={
                "seed": seed,
                "cluster": replace(
                    base.cluster,
                    z_l=drawn["z_l"],
                    clumps=clumps,
                    pa_difference_deg=drawn["pa_difference_deg"],
                    concentration_scatter=laws.concentration_scatter,
                ),
                "images": replace(base.images, m_tele=drawn["m_tele"]),
                "shear": replace(base.shear, density_arcmin2=drawn["n0"]),
                "strong": base.strong.model_copy(update={"members": laws.members}),
            }
        )
    )
    _inside(seed, drawn["z_l"], said)
    return settings
