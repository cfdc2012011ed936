"""The two-clump cluster on which the weak-lensing figures are measured, and its mass-sheet factors.

Two elliptical NFW haloes at z = 0.3, sources at z = 2, 48 x 48 pixels of 10 arcsec; analytic convergence and
shear averaged in each pixel.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.stats import gaussian_kde

from jaxlens import lens as lens_module
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid, rebin
from jaxlens.lens import Component, Lens
from jaxlens.profiles import nfw
from jaxlens.weak import ShearMap

H = 0.7
Z_S = 2.0


class Mock(NamedTuple):
    """Truth and noiseless data: maps are `(y, x)`."""

    grid: Grid
    plane: LensPlane
    kappa: np.ndarray
    g: np.ndarray
    weight: np.ndarray
    radius: np.ndarray  # kpc/h

    def shear(self, weight: np.ndarray | None = None) -> ShearMap:
        """The noiseless shear map."""
        used = jnp.asarray(self.weight if weight is None else weight)
        return ShearMap(jnp.asarray(self.g), used, jnp.ones(used.shape, int))

    def annulus(self) -> np.ndarray:
        """Unmasked pixels with 100 <= r < 700 kpc/h."""
        return (self.weight > 0) & (self.radius >= 100.0) & (self.radius < 700.0)

    def lam(self, kappa: np.ndarray) -> np.ndarray:
        """(kappa - 1)/(kappa_true - 1) in the annulus."""
        use = self.annulus()
        return (np.asarray(kappa)[use] - 1.0) / (self.kappa[use] - 1.0)


def two_clumps(n: int = 48, oversample: int = 8, limit: float = 0.5) -> Mock:
    """The mock on `n` x `n` pixels over 8 arcmin; pixels with |g| > `limit` have weight 0."""
    plane = LensPlane.at(z_l=0.3)
    grid = Grid((n, n), 480.0 / n)
    masses = jnp.array([6.75e14, 5.25e14]) / H
    halo = nfw.from_mass(masses, jnp.array([4.14, 4.18]), plane, e=0.3)
    half = 30.0 / H / float(plane.kpc_per_arcsec)
    centre = jnp.array([[-half, 0.0], [half, 0.0]])
    lens = Lens(halo=Component(halo, centre, jnp.deg2rad(jnp.array([17.0, 42.0]))))
    fine = Grid((oversample * n, oversample * n), grid.pixel / oversample)
    kappa, gamma = lens_module.kappa_and_gamma(lens, fine.theta)
    ratio = plane.dls_ds(Z_S)
    kappa, gamma = (np.asarray(rebin(ratio * one, fine, oversample)[0]) for one in (kappa, gamma))
    g = gamma / (1.0 - kappa)
    weight = (np.abs(g) <= limit).astype(float)
    radius = np.asarray(grid.radius) * float(plane.kpc_per_arcsec) * H
    return Mock(grid, plane, kappa, g, weight, radius)


def half_width(values: np.ndarray) -> float:
    """Half of the 16-84 % range."""
    low, high = np.percentile(values, [16.0, 84.0])
    return 0.5 * float(high - low)


def peak(values: np.ndarray) -> float:
    """Peak of the Gaussian kernel density (Scott) of the values between their 1 and 99 percentiles."""
    low, high = np.percentile(values, [1.0, 99.0])
    density = gaussian_kde(values[(values >= low) & (values <= high)])
    fine = np.linspace(low, high, 2001)
    return float(fine[np.argmax(density(fine))])


def skewness(values: np.ndarray) -> float:
    """Third standardised moment."""
    centred = values - values.mean()
    return float(np.mean(centred**3) / np.mean(centred**2) ** 1.5)
