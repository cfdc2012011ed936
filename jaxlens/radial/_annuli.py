"""Annuli of a fixed grid, worked out once: statistics of thousands of maps then cost little."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxlens._types import Array, Float, Int, Map
from jaxlens.radial._statistics import LEVELS, RadialProfile, quantiles

_GROUP = 64
# The pixels of the fullest annulus are rounded up to a multiple of this.


class Annuli(eqx.Module):
    """Which pixel lies in which annulus and sector.

    Attributes:
        edges: of the b annuli, `(b + 1,)`, in the unit of the positions.
        index: flat indices of the used pixels of each annulus, `(b, m)`, filled up with 0; m is round and the
            same for every mask, so that clusters and masks share compiled programs.
        filled: whether an entry of `index` is a pixel, `(b, m)`.
        cell: annulus times `n_sectors` plus sector of every pixel, `(y, x)`; `b n_sectors` if not used.
        n_sectors: equal sectors of angle, counted from +x towards +y.
    """

    edges: Float[Array, " e"]
    index: Int[Array, "b m"]
    filled: Bool[Array, "b m"]
    cell: Int[Array, "y x"]
    n_sectors: int = eqx.field(static=True)

    @property
    def r(self) -> Float[Array, " b"]:
        """Middle of each annulus, `(b,)`."""
        return 0.5 * (self.edges[:-1] + self.edges[1:])

    @property
    def used(self) -> Bool[Array, "y x"]:
        """Pixels that lie in an annulus, `(y, x)`."""
        return self.cell < len(self.index) * self.n_sectors

    @property
    def count(self) -> Int[Array, " b"]:
        """Pixels of each annulus, `(b,)`."""
        return self.filled.sum(axis=1)


def annuli(
    position: np.ndarray | Array,
    edges: Sequence[float] | np.ndarray | Array,
    *,
    weight: np.ndarray | Array | None = None,
    centre: tuple[float, float] = (0.0, 0.0),
    n_sectors: int = 12,
) -> Annuli:
    """The annuli of a grid; on the host, so arguments are numbers and not traced.

    Args:
        position: of the pixels, `(y, x, 2)`, e.g. `grid.theta` times the kpc/h of an arcsec.
        edges: increasing edges, `(b + 1,)`, same unit; a pixel on an edge lies outside of it.
        weight: pixels of weight 0 are not used, `(y, x)`.
        centre: of the annuli, same unit.
        n_sectors: sectors of angle, see `sector_sums`.

    Raises:
        ValueError: if the edges do not increase from r >= 0, or shapes disagree.
    """
    at, ends = np.asarray(position, float) - np.asarray(centre, float), np.asarray(edges, float)
    if ends.ndim != 1 or len(ends) < 2 or not ends[0] >= 0.0 or not (np.diff(ends) > 0.0).all():
        raise ValueError(f"`edges` is {ends.tolist()}; give at least two increasing radii, none negative.")
    if at.ndim != 3 or (weight is not None and weight.shape != at.shape[:2]):
        shape = None if weight is None else weight.shape
        raise ValueError(f"`position` has shape {at.shape} and `weight` {shape}; give (y, x, 2) and (y, x).")
    radius, phi = np.hypot(at[..., 0], at[..., 1]), np.arctan2(at[..., 1], at[..., 0])
    ring = np.searchsorted(ends, radius, side="right") - 1
    inside = (ring >= 0) & (ring < len(ends) - 1)
    most = _GROUP * -(-max(1, int(np.bincount(ring[inside], minlength=1).max())) // _GROUP)
    if weight is not None:
        inside &= np.asarray(weight) > 0.0
    members = [np.flatnonzero((inside & (ring == i)).ravel()) for i in range(len(ends) - 1)]
    index = np.zeros((len(members), most), np.int32)
    filled = np.zeros((len(members), most), bool)
    for row, one in enumerate(members):
        index[row, : len(one)], filled[row, : len(one)] = one, True
    sector = np.minimum((phi % (2.0 * np.pi)) / (2.0 * np.pi) * n_sectors, n_sectors - 1).astype(np.int32)
    cell = np.where(inside, ring * n_sectors + sector, len(members) * n_sectors).astype(np.int32)
    return Annuli(jnp.asarray(ends), jnp.asarray(index), jnp.asarray(filled), jnp.asarray(cell), n_sectors)


def profile_in(values: Map, rings: Annuli, weight: Map | None = None) -> RadialProfile:
    """Median and central 68 % of a map in annuli: `profile` at a tenth of its cost.

    Args:
        values: the map, `(y, x)`.
        rings: from `annuli`.
        weight: pixels of weight 0 are left out, beyond those that `rings` leaves out, `(y, x)`.

    Returns:
        The profile; differentiable in `values`.
    """
    flat = values.ravel()
    use = rings.filled if weight is None else rings.filled & (weight.ravel()[rings.index] > 0.0)
    levels = jnp.asarray(LEVELS, flat.dtype)
    found = jax.vmap(lambda i, u: quantiles(flat[i], u, levels))(rings.index, use)
    return RadialProfile(rings.r, found[:, 0], found[:, 1], found[:, 2], use.sum(axis=1))


def scatter(profile: RadialProfile) -> Float[Array, " b"]:
    """Half of the 16-84 % range of each annulus, `(b,)`."""
    return 0.5 * (profile.hi - profile.lo)


def sector_sums(
    values: Map, rings: Annuli, weight: Map | None = None
) -> tuple[Float[Array, "b s"], Float[Array, "b s"]]:
    """Sum of a map and number of its pixels in each annulus and sector, `(b, s)` each."""
    b, s = len(rings.index), rings.n_sectors
    use = rings.used if weight is None else rings.used & (weight > 0.0)
    both = jnp.stack([jnp.where(use, values, 0.0).ravel(), use.astype(values.dtype).ravel()], axis=1)
    found = jax.ops.segment_sum(both, rings.cell.ravel(), b * s + 1)[:-1].reshape(b, s, 2)
    return found[..., 0], found[..., 1]


def mean_in(values: Map, rings: Annuli, weight: Map | None = None) -> Float[Array, " b"]:
    """Mean of a map in each annulus, `(b,)`; 0 in empty ones. See `profile_in`."""
    total, count = sector_sums(values, rings, weight)
    return total.sum(axis=1) / jnp.maximum(count.sum(axis=1), 1.0)


def rmse_in(difference: Map, rings: Annuli, weight: Map | None = None) -> Float[Array, " b"]:
    """sqrt(<difference^2>) of each annulus, `(b,)`; 0 in empty ones. See `profile_in`."""
    mean = mean_in(difference**2, rings, weight)
    # The inner where keeps the gradient finite in an empty or perfect annulus.
    return jnp.where(mean > 0.0, jnp.sqrt(jnp.where(mean > 0.0, mean, 1.0)), 0.0)


def to_pixels(values: Float[Array, " b"], rings: Annuli, radius: Map) -> Map:
    """A profile as a map, linear between the middles of the annuli and constant beyond, `(y, x)`."""
    return jnp.interp(radius.ravel(), rings.r, values).reshape(radius.shape)
