"""Aperture mass: the tangential shear around every point, weighted by a compensated filter."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, Float, Int, Map, Points, ScalarLike, Values
from jaxlens.grid import Grid
from jaxlens.weak._catalogue import Galaxies
from jaxlens.weak._profile import tangential

BATCH = 64
"""Points of the map worked on at a time; memory is BATCH times the number of galaxies."""


class ApertureMap(eqx.Module):
    """Aperture mass at points of the sky; where an aperture holds no galaxy all but `count` are 0.

    Attributes:
        signal: M_ap from the tangential shear, `(...)`.
        cross: the same from the cross shear, `(...)`; zero for a lens but for noise.
        noise: error of either by the scatter of the shapes, `(...)`.
        count: galaxies in the aperture, `(...)`.
    """

    signal: Float[Array, "*p"]
    cross: Float[Array, "*p"]
    noise: Float[Array, "*p"]
    count: Int[Array, "*p"]

    @property
    def snr(self) -> Array:
        """Signal over noise, `(...)`; 0 where nothing is known."""
        return self.signal / jnp.where(self.noise > 0.0, self.noise, jnp.inf)


def schneider(x: Values) -> Values:
    """The polynomial filter pi theta^2 Q = 6 x^2 (1 - x^2) for x = r/theta < 1, else 0.

    Schneider et al. 1998, MNRAS 296, 873, for l = 1. It belongs to the convergence filter
    pi theta^2 U = 9 (1 - x^2)(1/3 - x^2).
    """
    return jnp.where(x < 1.0, 6.0 * x**2 * (1.0 - x**2), 0.0)


def schirmer(x: Values) -> Values:
    """A filter that follows the shear of an NFW halo, for x = r/theta < 1, else 0.

    Q = tanh(x/x_c)/(x/x_c)/(1 + exp(6 - 150 x) + exp(-47 + 50 x)) with x_c = 0.15 (Schirmer et al. 2007,
    quoted from secondary sources, not checked against the original). It is not normalised: only ratios,
    such as signal to noise, have a meaning.
    """
    t = x / 0.15
    small = t < 1e-4
    shape = jnp.where(small, 1.0, jnp.tanh(t) / jnp.where(small, 1.0, t))
    q = shape / (1.0 + jnp.exp(6.0 - 150.0 * x) + jnp.exp(-47.0 + 50.0 * x))
    return jnp.where(x < 1.0, q, 0.0)


FILTERS: dict[str, Callable[[Values], Values]] = {"schneider": schneider, "schirmer": schirmer}


def aperture_mass(
    galaxies: Galaxies, points: Points, radius: ScalarLike, *, filter: str = "schneider"
) -> ApertureMap:
    """Aperture mass at given points, by direct sums over the galaxies.

    M_ap = pi theta^2 sum w Q eps_t/sum w over the galaxies in the aperture, an unbiased estimate of
    int Q g_t d^2theta for galaxies spread evenly, and its noise pi theta^2 (sum w^2 Q^2 |eps|^2/2)^1/2/sum w
    (Schneider 1996; Bartelmann & Schneider 2001, sect. 5.3). Nothing is gridded: positions enter exactly, and
    gaps in the data change weights, not positions. Where an aperture reaches beyond the data the estimate is
    biased, see `coverage`.

    Args:
        galaxies: the galaxies.
        points: centres of apertures, `(..., 2)`, arcsec.
        radius: theta, arcsec.
        filter: a key of `FILTERS`.

    Returns:
        The map, `(...)`. Differentiable in ellipticities and weights.

    Raises:
        ValueError: if there is no such filter.
    """
    if filter not in FILTERS:
        raise ValueError(f"`filter` is {filter!r}; choose one of {', '.join(sorted(FILTERS))}.")
    return _aperture_mass(galaxies, points, jnp.asarray(radius, points.dtype), filter)


def coverage(weight: Map, grid: Grid, radius: ScalarLike, *, filter: str = "schneider") -> Map:
    """Share of the filter of an aperture about each pixel that falls on pixels with data, `(y, x)`, 0 to 1.

    Where it is below 1 the aperture mass is biased: the mean of Q g_t over the galaxies that there are stands
    for that over the whole aperture, which differs where the tangential shear is not the same in all
    directions.

    Args:
        weight: 0 where there are no data, `(y, x)`; nothing is known outside the map.
        grid: its grid.
        radius: theta, arcsec.
        filter: a key of `FILTERS`.
    """
    theta = float(np.asarray(radius))
    reach = int(np.ceil(theta / grid.pixel))
    step = np.arange(-reach, reach + 1) * grid.pixel / theta
    kernel = FILTERS[filter](jnp.asarray(np.hypot(step[:, None], step[None, :])))
    known = (weight > 0.0).astype(kernel.dtype)
    full = jax.scipy.signal.convolve(known, kernel, mode="full", method="fft")
    n_y, n_x = weight.shape
    inside = full[reach : reach + n_y, reach : reach + n_x]
    return jnp.clip(inside / jnp.sum(kernel), 0.0, 1.0)


@eqx.filter_jit
def _aperture_mass(galaxies: Galaxies, points: Points, radius: ScalarLike, filter: str) -> ApertureMap:
    w = galaxies.weight
    half_square = 0.5 * jnp.abs(galaxies.eps) ** 2

    def one(point: Array) -> tuple[Array, Array, Array, Array]:
        x = jnp.hypot(galaxies.theta[:, 0] - point[0], galaxies.theta[:, 1] - point[1]) / radius
        inside = (x < 1.0) & (w > 0.0)
        q = FILTERS[filter](x)
        total = jnp.sum(jnp.where(inside, w, 0.0))
        per_total = jnp.where(total > 0.0, 1.0 / jnp.where(total > 0.0, total, 1.0), 0.0)
        both = jnp.sum(w * q * tangential(galaxies.eps, galaxies.theta, (point[0], point[1]))) * per_total
        variance = jnp.sum((w * q) ** 2 * half_square)
        seen = variance > 0.0
        noise = jnp.where(seen, jnp.sqrt(jnp.where(seen, variance, 1.0)), 0.0) * per_total
        return both.real, both.imag, noise, jnp.sum(inside)

    shape = points.shape[:-1]
    found = jax.lax.map(one, points.reshape(-1, 2), batch_size=BATCH)
    signal, cross, noise, count = (part.reshape(shape) for part in found)
    return ApertureMap(signal, cross, noise, count)


def aperture_map(
    galaxies: Galaxies, grid: Grid, radius: ScalarLike, *, filter: str = "schneider"
) -> ApertureMap:
    """`aperture_mass` at every pixel of a grid, `(y, x)`."""
    return aperture_mass(galaxies, grid.theta, radius, filter=filter)
