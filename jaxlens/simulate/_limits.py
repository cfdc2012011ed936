"""Settings that describe no cluster, or more of one than memory holds: refused before any work."""

import math

from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.simulate import luminosity_function
from jaxlens.simulate._cluster import position
from jaxlens.simulate._settings import ClusterSettings
from jaxlens.simulate._sources import SourceSettings, expected_sources
from jaxlens.simulate._structure import sigma8_range
from jaxlens.simulate._truth import Place

MAX_SOURCES = 20_000
"""Expected sources; their magnitudes are drawn from 1500 nodes each, in 1.5 GB."""


def check(cluster: ClusterSettings, sources: SourceSettings, cosmology: FlatLCDM) -> None:
    """Refuse what only shows when several settings meet; each alone is checked where it is put together.

    Args:
        cluster: haloes and what is in them.
        sources: galaxies behind the centre.
        cosmology: the universe.

    Raises:
        ValueError: naming key, value and remedy.
    """
    lowest = luminosity_function.Z_RANGE[0]
    if not cluster.z_l >= lowest:
        raise ValueError(
            f"`cluster.z_l` is {cluster.z_l:g}; the luminosity functions of the sources begin at z = "
            f"{lowest:g}: raise it."
        )
    omega_m = float(cosmology.omega_m)
    if not cluster.omega_b < omega_m:
        raise ValueError(
            f"`cluster.omega_b` is {cluster.omega_b:g}, all of the matter or more (`omega_m` {omega_m:g}); "
            "lower it."
        )
    plane = LensPlane.at(cluster.z_l, cosmology)
    place = Place.of(plane, cluster)
    masses = [clump.mass_msun_h / place.h for clump in cluster.clumps]
    low, high = sigma8_range(masses, place.z, place.structure)
    if not low < cluster.sigma8 < high:
        raise ValueError(
            f"`cluster.sigma8` is {cluster.sigma8:g}, with which haloes of these masses have no history at "
            f"z = {place.z:g}; give a number between {low:.2g} and {high:.2g}."
        )
    for i in range(len(cluster.clumps)):
        position(i, cluster, place)
    box = sources.box_arcsec
    expected = expected_sources(sources, plane).expected(box**2)
    if not expected <= MAX_SOURCES:
        side = box * math.sqrt(MAX_SOURCES / expected)
        raise ValueError(
            f"`sources.box_arcsec` is {box:g}: {expected:.3g} sources are expected to `sources.depth.m_cut` "
            f"{sources.depth.m_cut:g}, more than {MAX_SOURCES}; give at most {math.floor(side)} arcsec, or a "
            "brighter `m_cut`."
        )
