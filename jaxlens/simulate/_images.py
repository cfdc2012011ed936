"""What a telescope sees of the sources: multiple images, their magnitudes, and which are detected."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens_equation
from jaxlens._types import Float, Int, RandomKey
from jaxlens.cosmology import LensPlane
from jaxlens.lens import Component, Lens
from jaxlens.profiles import TSIS
from jaxlens.simulate._sources import Sources, capacity

_BATCH = 256
# Sources solved together, so that one compiled program serves any number of them.


MAX_HALF_WIDTH, MAX_CELLS = 300.0, 1_000_000
"""Largest window, arcsec, and most cells that are searched: forty times those of the default."""


@dataclass(frozen=True)
class ImageSettings:
    """How images are found and which are seen.

    Attributes:
        sigma_pos_arcsec: standard deviation of the error of each coordinate of a position.
        m_tele: limiting magnitude far from the centre.
        m_loss: by how much it is brighter at the centre, under the light of the cluster.
        scale_kpc: radius over which that light fades, kpc (physical, no h).
        min_images: detected images that make a system.
        half_width_arcsec: half the side of the window that is searched for images.
        pixel_arcsec: longest side of the cells that are searched.
    """

    sigma_pos_arcsec: float = 0.15
    m_tele: float = 29.5
    m_loss: float = 1.5
    scale_kpc: float = 100.0
    min_images: int = 2
    half_width_arcsec: float = 75.0
    pixel_arcsec: float = 1.0

    def __post_init__(self) -> None:
        for name in ("scale_kpc", "half_width_arcsec", "pixel_arcsec"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a positive number.")
        if self.half_width_arcsec > MAX_HALF_WIDTH:
            raise ValueError(
                f"`half_width_arcsec` is {self.half_width_arcsec:g}; give at most {MAX_HALF_WIDTH:g}: no "
                "cluster has multiple images farther out."
            )
        cells = (2.0 * self.half_width_arcsec / self.pixel_arcsec) ** 2
        if not cells <= MAX_CELLS:
            raise ValueError(
                f"`pixel_arcsec` is {self.pixel_arcsec:g}: the window has {cells:.2g} cells, more than "
                f"{MAX_CELLS}; give at least {2.0 * self.half_width_arcsec / MAX_CELLS**0.5:g}, or a smaller "
                "`half_width_arcsec`."
            )
        if not self.sigma_pos_arcsec >= 0.0:
            raise ValueError(f"`sigma_pos_arcsec` is {self.sigma_pos_arcsec}; give 0 or a positive number.")
        if self.min_images < 2:
            raise ValueError(f"`min_images` is {self.min_images}; a system needs at least 2.")


class Images(eqx.Module):
    """All images of all sources, system by system in the order of the sources. NumPy arrays.

    Attributes:
        theta: positions, `(i, 2)`, arcsec.
        mu: signed magnifications, `(i,)`.
        mag: apparent magnitudes, `(i,)`.
        limit: limiting magnitudes at their positions, `(i,)`.
        source: index of the source of each, non-decreasing, `(i,)`.
        doubtful: sources whose images do not add up (see `lens_equation.ImageSet.parity_ok`, `overflow`).
    """

    theta: Float[np.ndarray, "i 2"]
    mu: Float[np.ndarray, " i"]
    mag: Float[np.ndarray, " i"]
    limit: Float[np.ndarray, " i"]
    source: Int[np.ndarray, " i"]
    doubtful: Int[np.ndarray, " d"]

    def __len__(self) -> int:
        return len(self.mu)

    def take(self, index: np.ndarray) -> "Images":
        """The images at `index`."""
        theta, mu, mag, limit, source = (
            one[index] for one in (self.theta, self.mu, self.mag, self.limit, self.source)
        )
        return Images(theta, mu, mag, limit, source, self.doubtful)


class Catalogue(eqx.Module):
    """The detected images of the systems, as an observer lists them. NumPy arrays.

    Attributes:
        theta: observed positions, with errors, `(i, 2)`, arcsec.
        truth: the images, `(i,)` of everything; positions without errors.
        system: index of the system of each image, from 0, `(i,)`.
        source: index of the source of each system, `(n,)`.
    """

    theta: Float[np.ndarray, "i 2"]
    truth: Images
    system: Int[np.ndarray, " i"]
    source: Int[np.ndarray, " n"]

    @property
    def n_images(self) -> int:
        """Number of images."""
        return len(self.system)

    @property
    def n_systems(self) -> int:
        """Number of systems."""
        return len(self.source)


def limiting_magnitude(radius_kpc: np.ndarray, settings: ImageSettings) -> np.ndarray:
    """m_lim(r) = m_tele - Delta m exp(-r/r_s), as stated in the paper.

    Args:
        radius_kpc: projected distance from the origin, kpc (physical, no h).
        settings: the three numbers.
    """
    return settings.m_tele - settings.m_loss * np.exp(-np.asarray(radius_kpc) / settings.scale_kpc)


_GROUP, _FAR = 512, 1e4
# Subhaloes are filled up to a multiple of `_GROUP` by ones without mass, `_FAR` arcsec away.


def padded(lens: Lens) -> Lens:
    """The same lens with a round number of subhaloes, so that clusters share compiled programs."""

    def fill(component: Component) -> Component:
        params, spare = component.params, -len(component) % _GROUP
        if not isinstance(params, TSIS) or not spare:
            return component
        more = lambda values, value: jnp.pad(values, (0, spare), constant_values=value)
        return Component(
            TSIS(theta_e=more(params.theta_e, 0.0), r_t=more(params.r_t, 1.0)),
            jnp.pad(component.centre, ((0, spare), (0, 0)), constant_values=_FAR),
            more(component.pa, 0.0),
        )

    return Lens({name: fill(component) for name, component in lens.components.items()})


def all_images(lens: Lens, sources: Sources, plane: LensPlane, settings: ImageSettings) -> Images:
    """All images of all sources, to 1e-8 arcsec in the source plane, with magnitudes m - 2.5 log10 |mu|.

    The image plane is tiled once; sources are worked through in batches.

    Args:
        lens: the lens.
        sources: the sources.
        plane: the lens plane, for r in kpc.
        settings: window, cells and limits.

    Raises:
        TypeError: in single precision.
    """
    n = len(sources)
    spare = (0, -max(n, 1) % _BATCH)
    # Sources at D_LS/D_S = 0 fill the last batch; their images are dropped.
    beta = jnp.asarray(np.pad(sources.beta, (spare, (0, 0))))
    ratio = jnp.asarray(np.pad(sources.dls_ds, spare))
    window, cell = settings.half_width_arcsec, settings.pixel_arcsec
    lens = padded(lens)
    tiling = lens_equation.tile(lens, half_width=window, pixel=cell, margin=5.0)
    parts = []
    for first in range(0, len(beta), _BATCH):
        some = slice(first, first + _BATCH)
        found = lens_equation.solve(lens, beta[some], ratio[some], tiling=tiling)
        parts.append((found.theta, found.mu, found.valid, found.overflow, found.parity_ok))
    theta, mu, valid, overflow, parity = (np.concatenate(part)[:n] for part in zip(*parts, strict=True))
    source, slot = np.nonzero(valid)
    theta, mu = theta[source, slot], mu[source, slot]
    with np.errstate(divide="ignore"):
        mag = sources.mag[source] - 2.5 * np.log10(np.abs(mu))
    radius = np.hypot(*theta.T) * float(plane.kpc_per_arcsec)
    doubtful = np.flatnonzero(overflow | ~parity)
    return Images(theta, mu, mag, limiting_magnitude(radius, settings), source, doubtful)


def observe(key: RandomKey, images: Images, settings: ImageSettings) -> Catalogue:
    """The catalogue of detected images: those brighter than the limit, of sources with enough of them.

    Detection is judged at the true positions, which are then scattered, as stated in the paper.

    Args:
        key: used once.
        images: all images.
        settings: the number that makes a system, and the error of positions.
    """
    seen = np.flatnonzero(images.mag < images.limit)
    n_sources = int(images.source.max()) + 1 if len(images) else 0
    count = np.bincount(images.source[seen], minlength=n_sources)
    chosen = images.take(seen[count[images.source[seen]] >= settings.min_images])
    source, system = np.unique(chosen.source, return_inverse=True)
    room = capacity(float(len(chosen)))
    scatter = np.asarray(jax.random.normal(key, (room, 2)), float)[: len(chosen)]
    return Catalogue(
        theta=chosen.theta + settings.sigma_pos_arcsec * scatter,
        truth=chosen,
        system=system,
        source=source,
    )


def find_images(
    key: RandomKey, lens: Lens, sources: Sources, plane: LensPlane, settings: ImageSettings
) -> tuple[Catalogue, Images]:
    """What is observed of the sources, and all their images: `all_images`, then `observe`."""
    images = all_images(lens, sources, plane, settings)
    return observe(key, images, settings), images
