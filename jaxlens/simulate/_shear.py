"""The shear of a simulated cluster on the pixels of a weak-lensing map."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as lensing
from jaxlens import weak
from jaxlens._types import Array, Complex, Float, Map
from jaxlens.grid import Grid, rebin, resample
from jaxlens.lens import Lens
from jaxlens.simulate._images import padded
from jaxlens.simulate._render import MAX_PIXELS

Renderer = Callable[[Grid], Any]
"""From a grid to the convergence for D_LS/D_S = 1 on its pixels, `(y, x)`."""

SHEAR_MODES = ("extended", "analytic", "padded", "periodic")

COARSE = 256
"""Pixels of the field in Fourier transforms; more do not change shear averaged over the pixels of a map."""

MAX_GALAXIES = 5_000_000
"""Expected galaxies; each takes about 200 bytes, and as many in the catalogue."""

WIDE, PADDING = 6, 1.5
"""Side of the map behind `extended` shear in fields, and of its padded square in such maps. The ellipticity
of haloes without an edge does not end: mass beyond twice the field shears the field by 2.5e-3, beyond four
times it by 8e-4, beyond six times by 4e-4 (two haloes of the paper's masses with e = 0.28; about twice as
much for the default cluster)."""

_INSIDE = 8
# Points per side of a pixel over which analytic shear is averaged.


@dataclass(frozen=True)
class Bin:
    """Galaxies at one redshift.

    Attributes:
        z_s: redshift.
        share: of all galaxies.
    """

    z_s: float = 2.0
    share: float = 1.0


@dataclass(frozen=True)
class ShearSettings:
    """The weak-lensing map and the galaxies behind it.

    Attributes:
        field_arcmin: side of the field.
        pixels: of the shear map, along a side.
        map_pixels: of the map of the convergence, along a side.
        mode: how shear follows from the convergence, one of `SHEAR_MODES`, see `true_field`.
        average_g: average the reduced shear over a pixel, instead of dividing averages.
        g_max: pixels where the noiseless |g| exceeds it are masked.
        density_arcmin2, depletion, scale_kpc: n(R) = n_0 (1 - d exp(-R/R_s)), see `weak.mean_counts`.
        sigma_eps: standard deviation of each component of the intrinsic ellipticity.
        bins: redshifts of the galaxies.
    """

    field_arcmin: float = 8.0
    pixels: int = 48
    map_pixels: int = 4096
    mode: str = "extended"
    average_g: bool = False
    g_max: float = 0.5
    density_arcmin2: float = 432.0
    depletion: float = 0.3
    scale_kpc: float = 300.0
    sigma_eps: float = 0.24
    bins: tuple[Bin, ...] = field(default_factory=lambda: (Bin(),))

    def __post_init__(self) -> None:
        for name in ("field_arcmin", "g_max", "density_arcmin2", "scale_kpc"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a positive number.")
        if not 2 <= self.pixels <= COARSE:
            raise ValueError(
                f"`pixels` is {self.pixels}; give 2 to {COARSE}: shear is made on {COARSE} pixels a side."
            )
        galaxies = self.density_arcmin2 * self.field_arcmin**2
        if not galaxies <= MAX_GALAXIES:
            raise ValueError(
                f"`density_arcmin2` is {self.density_arcmin2:g}: {galaxies:.3g} galaxies are expected, more "
                f"than {MAX_GALAXIES}; give at most {MAX_GALAXIES / self.field_arcmin**2:g}, or a smaller "
                "`field_arcmin`."
            )
        if not 0.0 <= self.depletion < 1.0:
            raise ValueError(f"`depletion` is {self.depletion}; give a fraction in [0, 1).")
        if not 0.0 <= self.sigma_eps < 1.0:
            raise ValueError(f"`sigma_eps` is {self.sigma_eps}; give a scatter in [0, 1).")
        if self.mode not in SHEAR_MODES:
            raise ValueError(f"`mode` is {self.mode!r}; choose one of {SHEAR_MODES}.")
        for k, one in enumerate(self.bins):
            if not one.share > 0.0:
                raise ValueError(f"`bins[{k}].share` is {one.share}; give a positive share.")
        if not self.bins or abs(sum(one.share for one in self.bins) - 1.0) > 1e-6:
            raise ValueError(f"The shares of `bins` {self.bins} must add up to 1; correct them.")
        if self.map_pixels < COARSE:
            raise ValueError(f"`map_pixels` is {self.map_pixels}; give at least {COARSE}.")
        if self.map_pixels**2 > MAX_PIXELS:
            raise ValueError(
                f"`map_pixels` is {self.map_pixels}; {8e-9 * self.map_pixels**2:.0f} GB a map are too much "
                f"for memory; give at most {int(MAX_PIXELS**0.5)}."
            )

    @property
    def field_arcsec(self) -> float:
        """Side of the field, arcsec."""
        return 60.0 * self.field_arcmin

    @property
    def map_grid(self) -> Grid:
        """Pixels of the map of the convergence."""
        return Grid((self.map_pixels, self.map_pixels), self.field_arcsec / self.map_pixels)

    @property
    def grid(self) -> Grid:
        """Pixels of the shear map."""
        return Grid((self.pixels, self.pixels), self.field_arcsec / self.pixels)


class TrueField(eqx.Module):
    """Convergence and shear for D_LS/D_S = 1, on the pixels in which `reduced_shear` averages them.

    Attributes:
        fine: convergence on the fine map, `(Y, X)`.
        kappa: convergence, averaged in the pixels of the shear map, `(y, x)`.
        gamma: complex shear, likewise.
        kappa_points, gamma_points: the same on the pixels, `(v, u)`, from which `gamma` was averaged.
    """

    fine: Float[Array, "Y X"]
    kappa: Float[Array, "y x"]
    gamma: Complex[Array, "y x"]
    kappa_points: Float[Array, "v u"]
    gamma_points: Complex[Array, "v u"]


def _periodic(kappa: Array) -> Array:
    """gamma_k = D(k) kappa_k on the pixels as they lie, `(y, x)`.

    By one complex transform, so that |D| = 1 for every k but 0, also at the Nyquist frequency, where the
    parts of the shear are not those of a real map (our choice): kappa_k = conj(D) gamma_k inverts it exactly.
    """
    k_y, k_x = (np.fft.fftfreq(n) for n in kappa.shape)
    d = (k_x + 1j * k_y[:, None]) ** 2
    size = np.abs(d)
    return jnp.asarray(np.fft.ifft2(d / np.where(size > 0.0, size, 1.0) * np.fft.fft2(np.asarray(kappa))))


def _from_map(kappa: Array, padding: float) -> Array:
    """gamma = D kappa as `weak.shear_of`, but by NumPy's transform.

    That of XLA shares its lines among threads as they come: the last bits differ from run to run.
    """
    operator = weak.ShearOperator.of(kappa.shape, padding, "none")
    modes = np.fft.rfft2(np.asarray(kappa), s=operator.padded)
    n_y, n_x = operator.shape
    one, two = (np.fft.irfft2(part * modes, s=operator.padded)[:n_y, :n_x] for part in operator.multipliers())
    return jnp.asarray(one + 1j * two)


@partial(jax.jit, static_argnames="points")
def _at_points(lens: Lens, points: Grid) -> tuple[Array, Array]:
    return lensing.kappa_and_gamma(lens, points.theta)


def true_field(lens: Lens, render: Renderer, settings: ShearSettings) -> TrueField:
    """Convergence and shear of a lens for D_LS/D_S = 1, averaged in pixels.

    The modes of the shear (gamma_k = D(k) kappa_k, D = (k_1^2 - k_2^2 + 2 i k_1 k_2)/k^2):

    - `extended`: from a map `WIDE` times as wide as the field, padded with zeros: what lies outside the
      field counts, as in the sky (our choice).
    - `analytic`: the shear of the lens itself, at 8 x 8 points in each pixel.
    - `padded`: from the map of the field alone, padded to twice its width.
    - `periodic`: from `kappa` on the pixels of the shear map, without padding: the plainest reading of the
      paper. An unpadded inversion returns `kappa` without its mean, to rounding (`weak.kaiser_squires` those
      of its modes that lie in its band).

    Args:
        lens: the lens; used by `analytic`.
        render: its convergence on any grid for D_LS/D_S = 1, `functools.partial(simulate.render, lens)`.
        settings: field, pixels and mode.
    """
    fine_grid, grid = settings.map_grid, settings.grid
    fine = jnp.asarray(render(fine_grid))
    kappa, _ = resample(fine, fine_grid, grid.shape)
    if settings.mode == "analytic":
        points = Grid((_INSIDE * grid.shape[0], _INSIDE * grid.shape[1]), grid.pixel / _INSIDE)
        kappa_points, gamma_points = _at_points(padded(lens), points)
        gamma, _ = rebin(gamma_points, points, _INSIDE)
        return TrueField(fine, kappa, gamma, kappa_points, gamma_points)
    if settings.mode == "periodic":
        gamma = _periodic(kappa)
        return TrueField(fine, kappa, gamma, kappa, gamma)
    coarse, coarse_grid = resample(fine, fine_grid, (COARSE, COARSE))
    if settings.mode == "extended":
        # The middle is averaged from the fine map, so that cusps keep their mass.
        wide = jnp.asarray(render(Grid((WIDE * COARSE, WIDE * COARSE), coarse_grid.pixel)))
        edge = (WIDE - 1) * COARSE // 2
        wide = wide.at[edge:-edge, edge:-edge].set(coarse)
        gamma_points = _from_map(wide, PADDING)[edge:-edge, edge:-edge]
    else:
        gamma_points = _from_map(coarse, 2.0)
    one, two = (
        resample(part, coarse_grid, grid.shape)[0]
        for part in (jnp.real(gamma_points), jnp.imag(gamma_points))
    )
    gamma = jax.lax.complex(one, two)
    return TrueField(fine, kappa, gamma, coarse, gamma_points)


def reduced_shear(found: TrueField, ratio: float, settings: ShearSettings) -> tuple[Map, Array]:
    """Convergence and reduced shear for a source with D_LS/D_S = `ratio` on the pixels of the map.

    g = gamma/(1 - kappa) of the averages over a pixel, as stated in the paper, or the average of g.
    """
    kappa, gamma = ratio * found.kappa, ratio * found.gamma
    if not settings.average_g:
        return kappa, gamma / (1.0 - kappa)
    g = ratio * found.gamma_points / (1.0 - ratio * found.kappa_points)
    points = Grid((g.shape[0], g.shape[1]), settings.field_arcsec / g.shape[0])
    return kappa, resample(g, points, settings.grid.shape)[0]
