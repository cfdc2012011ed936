"""Galaxies behind a cluster, and whether the box they fill holds the caustics."""

from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxlens import critical
from jaxlens._types import Float, RandomKey
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Lens
from jaxlens.simulate import luminosity_function
from jaxlens.simulate.luminosity_function import Depth


class Sources(eqx.Module):
    """Point sources. NumPy arrays in double precision.

    Attributes:
        beta: positions without the lens, `(s, 2)`, arcsec.
        z: redshifts, `(s,)`.
        dls_ds: their D_LS/D_S, `(s,)`.
        mag_uv: absolute magnitudes, `(s,)`.
        mag: apparent magnitudes without the lens, `(s,)`.
    """

    beta: Float[np.ndarray, "s 2"]
    z: Float[np.ndarray, " s"]
    dls_ds: Float[np.ndarray, " s"]
    mag_uv: Float[np.ndarray, " s"]
    mag: Float[np.ndarray, " s"]

    def __len__(self) -> int:
        return len(self.z)


@dataclass(frozen=True)
class SourceSettings:
    """Which sources are drawn.

    Attributes:
        box_arcsec: side of the square about the origin that they fill uniformly.
        depth: limits in magnitude and redshift, and how the luminosity functions are read.
    """

    box_arcsec: float = 30.0
    depth: Depth = field(default_factory=Depth)

    def __post_init__(self) -> None:
        if not self.box_arcsec > 0.0:
            raise ValueError(f"`box_arcsec` is {self.box_arcsec}; give a positive side in arcsec.")


def expected_sources(settings: SourceSettings, plane: LensPlane) -> luminosity_function.Counts:
    """Counts per arcsec^2 of the sources behind `plane`, see `luminosity_function.counts`."""
    return luminosity_function.counts(float(plane.z_l), plane.cosmology, settings.depth)


def capacity(mean: float) -> int:
    """A round number of draws that a Poisson number with this mean exceeds less than once in 1e12 times.

    Round, so that clusters with somewhat different means share compiled programs.
    """
    return 512 * -(-int(mean + 8.0 * mean**0.5 + 16.0) // 512)


def draw_sources(key: RandomKey, settings: SourceSettings, plane: LensPlane) -> Sources:
    """A Poisson number of sources, uniform in the box, z and M_UV by inverse cumulative distributions.

    N_exp = Omega int dV/(dOmega dz) [int Phi(M, z) dM] dz over z_l < z < z_max, as stated in the paper
    (its smallest redshift is our choice: nothing in front of the lens is lensed).

    Args:
        key: used once.
        settings: which sources.
        plane: the lens plane.

    Returns:
        The sources, in the order in which they were drawn. Not differentiable.
    """
    found = expected_sources(settings, plane)
    mean = found.expected(settings.box_arcsec**2)
    key_n, key_u = jax.random.split(key)
    room = capacity(mean)
    n = min(int(jax.random.poisson(key_n, mean)), room)
    u = np.asarray(jax.random.uniform(key_u, (4, room)), float)[:, :n]
    z = luminosity_function.redshifts(u[0], found)
    mag_uv = luminosity_function.magnitudes(u[1], z, plane.cosmology, settings.depth)
    return Sources(
        beta=settings.box_arcsec * (u[2:].T - 0.5),
        z=z,
        dls_ds=ratios(plane, z),
        mag_uv=mag_uv,
        mag=luminosity_function.apparent(mag_uv, z, plane.cosmology, settings.depth),
    )


def ratios(plane: LensPlane, z: np.ndarray) -> np.ndarray:
    """D_LS/D_S = 1 - D_C(z_l)/D_C(z) at `z (n,)` behind the lens, `(n,)`."""
    distance = luminosity_function.comoving_distance(np.append(z, float(plane.z_l)), plane.cosmology)
    return 1.0 - distance[-1] / distance[:-1]


class CausticMargin(NamedTuple):
    """How far the main caustic stays inside the box of the sources.

    Attributes:
        arcsec: negative by as much as the caustic leaves the box; NaN where no critical curve closes in the
            window, and where the window cuts the main one.
        cut: whether the window cuts it.
    """

    arcsec: float
    cut: bool


def caustic_margin(
    lens: Lens, plane: LensPlane, settings: SourceSettings, *, half_width: float
) -> CausticMargin:
    """Distance between the box of the sources and the main caustic inside it.

    The main caustic is that of the largest tangential critical curve, for the most distant sources. A curve
    that the window cuts has no area: where one is longer than the largest closed curve, it may be the main
    one.

    Args:
        lens: the lens.
        plane: its plane.
        settings: the box, and the largest redshift.
        half_width: half the side of the window in which critical curves are sought, arcsec.
    """
    # The points of a curve lie on it to rounding; pixels only decide how many there are.
    grid = Grid.square(2.0 * half_width, 1.0)
    found = critical.curves(lens, grid, float(plane.dls_ds(settings.depth.z_max)))
    curves = [one for one in found.items if one.kind == "tangential"]
    main = max((one for one in curves if one.closed), key=lambda one: one.area, default=None)
    cut = max((one.length for one in curves if not one.closed), default=0.0)
    if main is None or cut > main.length:
        return CausticMargin(float("nan"), cut > 0.0)
    return CausticMargin(0.5 * settings.box_arcsec - float(np.abs(main.beta).max()), False)
