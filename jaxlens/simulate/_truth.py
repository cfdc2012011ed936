"""What a simulated cluster is: what was drawn, and the lens it makes."""

from dataclasses import dataclass

import numpy as np

from jaxlens.cosmology import LensPlane, overdensity
from jaxlens.lens import Lens
from jaxlens.simulate._settings import ClusterSettings
from jaxlens.simulate._structure import Structure
from jaxlens.units import ARCSEC


@dataclass(frozen=True)
class ClumpTruth:
    """What one halo of a simulated cluster came out as.

    Attributes:
        x_arcsec, y_arcsec: position.
        mass_msun: virial mass, Msun; `r_vir_mpc` its radius, Mpc.
        concentration: r_vir/r_s, and `mean_concentration` that of haloes of this mass.
        axis_ratios: (a/c, b/c).
        orientation: quaternion as drawn or given, before the turn to `pa_rad`.
        turn: matrix from the axes a, b, c to (theta_1, theta_2, line of sight), after it, by rows.
        f, q, pa_rad: its projection, see `_triaxial.Projection`.
        r_s_mpc, rho_s_msun_mpc3: the NFW of the whole halo: scale radius, and density from its whole mass.
        smooth_mass_msun: virial mass without subhaloes and central galaxy; what the smooth NFW holds.
        subhalo_mass_msun: sum of the masses of the subhaloes, and `subhalo_count` their number.
        bcg_mass_msun, bcg_r_s_arcsec: stellar mass and Hernquist scale radius of the central galaxy.
    """

    x_arcsec: float
    y_arcsec: float
    mass_msun: float
    r_vir_mpc: float
    concentration: float
    mean_concentration: float
    axis_ratios: tuple[float, float]
    orientation: tuple[float, float, float, float]
    turn: tuple[tuple[float, ...], ...]
    f: float
    q: float
    pa_rad: float
    r_s_mpc: float
    rho_s_msun_mpc3: float
    smooth_mass_msun: float
    subhalo_mass_msun: float
    subhalo_count: int
    bcg_mass_msun: float
    bcg_r_s_arcsec: float


@dataclass(frozen=True)
class SimulatedCluster:
    """A cluster whose mass is known.

    Attributes:
        lens: components `halo`, `bcg`, `subhaloes` (those that exist), for D_LS/D_S = 1.
        subhaloes: columns `x_arcsec, y_arcsec, z_kpc, mass_msun, sigma_v_kms, r_t_kpc, stellar_mass_msun,
            luminosity_b` (solar units) and `clump` (index), each `(n,)`, all clumps together.
        clumps: what was drawn for each halo.
        plane: the lens plane.
        settings: what it was made from.
    """

    lens: Lens
    subhaloes: dict[str, np.ndarray]
    clumps: tuple[ClumpTruth, ...]
    plane: LensPlane
    settings: ClusterSettings


@dataclass(frozen=True)
class Place:
    """Lens plane and universe as Python numbers: z, h, Mpc per arcsec, Sigma_cr_inf, virial density."""

    z: float
    h: float
    mpc_per_arcsec: float
    sigma_cr: float
    virial_density: float
    structure: Structure

    @classmethod
    def of(cls, plane: LensPlane, settings: ClusterSettings) -> "Place":
        universe = plane.cosmology
        density = overdensity("bryan_norman", universe, plane.z_l) * universe.critical_density(plane.z_l)
        return cls(
            z=float(plane.z_l),
            h=float(universe.h),
            mpc_per_arcsec=float(plane.d_l) * ARCSEC,
            sigma_cr=float(plane.sigma_cr_inf),
            virial_density=float(density),
            structure=Structure.of(
                universe, sigma8=settings.sigma8, n_s=settings.n_s, omega_b=settings.omega_b
            ),
        )
