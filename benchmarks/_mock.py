"""The two-clump cluster on which the weak-lensing figures are measured, and its mass-sheet factors.

Two elliptical NFW haloes at z = 0.3, sources at z = 2, 48 x 48 pixels of 10 arcsec; analytic convergence and
shear averaged in each pixel.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import gaussian_kde

from jaxlens import lens as lens_module
from jaxlens._types import Array
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


def _nfw_potential(r: Array) -> Array:
    """psi/(kappa_s r_s^2) of an NFW halo at r/r_s, 2 (ln^2(r/2) - arccosh^2(1/r))."""
    inside = r < 1.0
    near = jnp.where(inside, jnp.arccosh(1.0 / jnp.where(inside, r, 0.5)), 0.0)
    far = jnp.where(inside, 0.0, jnp.arccos(1.0 / jnp.where(inside, 2.0, r)))
    return 2.0 * (jnp.log(0.5 * r) ** 2 - near**2 + far**2)


def elliptical_potentials(
    n: int = 48, oversample: int = 8, limit: float = 0.5, core_kpc: float = 5.0
) -> Mock:
    """A heavier variant: NFW potentials on ellipses, M_200c and c = 4, softened by 5 kpc, centred on pixels.

    The centres of the haloes fall on those of pixels, so that the convergence reaches 1.7 and the reduced
    shear 5 (the same haloes half a pixel away: 1.5 and 78, for one pixel then lies at kappa = 1). kappa and
    gamma are second derivatives of the potential.
    """
    plane = LensPlane.at(z_l=0.3)
    centre = (-240.0 / n, -240.0 / n)
    grid = Grid((n, n), 480.0 / n, centre)
    halo = nfw.from_mass(jnp.array([6.75e14, 5.25e14]) / H, jnp.array([4.0, 4.0]), plane, definition=200.0)
    half = 30.0 / H / float(plane.kpc_per_arcsec)
    core = 5.0 / float(plane.kpc_per_arcsec)
    pa = jnp.deg2rad(jnp.array([17.0, 42.0]))

    def psi(x: Array) -> Array:
        total = jnp.zeros(())
        for i, (at, e) in enumerate(((-half, 0.15), (half, 0.12))):
            d = x - jnp.array([at, 0.0])
            along = d[0] * jnp.cos(pa[i]) + d[1] * jnp.sin(pa[i])
            across = -d[0] * jnp.sin(pa[i]) + d[1] * jnp.cos(pa[i])
            r = jnp.sqrt((1.0 - e) * along**2 + (1.0 + e) * across**2 + core**2) / halo.r_s[i]
            total += halo.kappa_s[i] * halo.r_s[i] ** 2 * _nfw_potential(r)
        return total

    fine = Grid((oversample * n, oversample * n), grid.pixel / oversample, centre)
    flat = fine.theta.reshape(-1, 2)
    ratio = plane.dls_ds(Z_S)
    second = ratio * jax.jit(jax.vmap(jax.hessian(psi)))(flat).reshape(*fine.shape, 2, 2)
    kappa = 0.5 * (second[..., 0, 0] + second[..., 1, 1])
    gamma = 0.5 * (second[..., 0, 0] - second[..., 1, 1]) + 1j * second[..., 0, 1]
    kappa, gamma = (np.asarray(rebin(one, fine, oversample)[0]) for one in (kappa, gamma))
    g = gamma / (1.0 - kappa)
    radius = np.asarray(grid.radius) * float(plane.kpc_per_arcsec) * H
    return Mock(grid, plane, kappa, g, (np.abs(g) <= limit).astype(float), radius)


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
