"""Convergence maps of simulated clusters: smooth parts by pixel, subhaloes as stamps of their own size."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, Float
from jaxlens.grid import Grid
from jaxlens.lens import Component, Lens
from jaxlens.profiles import TSIS, profile_of
from jaxlens.simulate._truth import SimulatedCluster

MAX_PIXELS = 2**28
"""Largest map, pixels: 2 GB in double precision, of which two are in memory at a time."""

_ROWS = 32
# Rows of the map worked on together (measured).

_BESIDE = 4
# Up to this many profiles are evaluated side by side, more one after the other.

_BLOCK = 2**15
# Pixels of a stamp in memory together, so that they stay in a core's cache.

_SMOOTH_CORE, _SMOOTH_FINE = 4, 16
# Pixels this close to a centre of a smooth profile, in rows and columns, are means over 16 x 16 points.

_STAMP_CORE, _STAMP_FINE = 4, 5
# The same about the centre of a stamp, where the mean of the singular part is known in closed form.

_DISC = 1.0 / math.sqrt(math.pi)
# A point this close to a centre, in units of the spacing of points, takes the value at half that distance:
# the mean of 1/R over the disc that has the area of one point.


def render(cluster: SimulatedCluster | Lens, grid: Grid) -> Float[np.ndarray, "y x"]:
    """Convergence of a cluster on a map, for D_LS/D_S = 1.

    The closed forms of the profiles at pixel centres, and means over the pixel next to the centres of haloes,
    galaxies and subhaloes, where the convergence is infinite. Haloes and galaxies agree with
    `jaxlens.lens.kappa` to the accuracy of its expansions, 4e-5; subhaloes to rounding.

    Args:
        cluster: a simulated cluster, or any lens whose profiles have a closed form of the convergence.
        grid: the map.

    Returns:
        kappa, `(y, x)`, on the host. Not differentiable.

    Raises:
        ValueError: if the map is too large for memory.
        TypeError: if a profile has no closed form, or in single precision.
    """
    lens = cluster.lens if isinstance(cluster, SimulatedCluster) else cluster
    if math.prod(grid.shape) > MAX_PIXELS:
        raise ValueError(
            f"`grid` has {grid.shape[0]} x {grid.shape[1]} pixels, more than {MAX_PIXELS}, and would need "
            f"{16e-9 * math.prod(grid.shape):.0f} GB; use larger pixels or render parts of the field."
        )
    if jnp.result_type(float) != jnp.float64:
        raise TypeError(
            "Maps of a simulated cluster need float64: the closed form of an NFW halo loses its digits near "
            'r_s. Put `jax.config.update("jax_enable_x64", True)` before the first computation.'
        )
    smooth, stamps = [], []
    for component in lens.components.values():
        if profile_of(component.params).kappa is None:
            raise TypeError(
                f"`cluster` has a {profile_of(component.params).name} profile, whose convergence has no "
                "closed form; use `jaxlens.lens.kappa` at the pixels."
            )
        (stamps if isinstance(component.params, TSIS) else smooth).append(component)
    kappa = _render_smooth(smooth, grid) if smooth else np.zeros(grid.shape)
    for component in stamps:
        _add_stamps(kappa, component, grid)
    return kappa


# --- haloes and galaxies ------------------------------------------------------------------------


def _kappa_at(components: list[Component], x: Array, y: Array, disc: Array) -> Array:
    """Sum of closed forms at points of equal shape; a point within `disc` of a centre moves to half that."""
    total = jnp.zeros_like(x)
    for component in components:
        total = total + _kappa_of(component, x, y, disc)
    return total


def _kappa_of(component: Component, x: Array, y: Array, disc: Array) -> Array:
    closed_form = profile_of(component.params).kappa
    assert closed_form is not None

    def one(each: tuple[Any, Array, Array]) -> Array:
        params, centre, pa = each
        c, s = jnp.cos(pa), jnp.sin(pa)
        d_x, d_y = x - centre[0], y - centre[1]
        u, v = c * d_x + s * d_y, c * d_y - s * d_x
        inside = u**2 + v**2 < disc**2
        u, v = jnp.where(inside, 0.5 * disc, u), jnp.where(inside, 0.0, v)
        return jax.vmap(lambda a, b: closed_form(params, jnp.stack([a, b])))(u.ravel(), v.ravel())

    every = (component.params, component.centre, component.pa)
    if len(component) <= _BESIDE:
        return jax.vmap(one)(every).sum(axis=0).reshape(x.shape)
    zero = jnp.zeros(x.size, x.dtype)
    return jax.lax.scan(lambda total, each: (total + one(each), None), zero, every)[0].reshape(x.shape)


@jax.jit
def _rows(components: list[Component], x: Array, y: Array, disc: Array) -> Array:
    def row(y_0: Array) -> Array:
        return _kappa_at(components, x, jnp.full_like(x, y_0), disc)

    return jax.lax.map(row, y, batch_size=_ROWS)


@jax.jit
def _cores(components: list[Component], x: Array, y: Array, disc: Array) -> Array:
    """Means over the last two axes of blocks of points `(m, k, fine)` along each direction: `(m, k, k)`."""

    def core(at: tuple[Array, Array]) -> Array:
        fine_x, fine_y = (v.reshape(-1) for v in at)
        p, q = jnp.meshgrid(fine_x, fine_y)
        k, fine = at[0].shape
        return _kappa_at(components, p, q, disc).reshape(k, fine, k, fine).mean(axis=(1, 3))

    return jax.lax.map(core, (x, y))


def _render_smooth(components: list[Component], grid: Grid) -> np.ndarray:
    p = grid.pixel
    kappa = np.array(_rows(components, grid.x, grid.y, jnp.asarray(_DISC * p)))
    centres = np.unique(np.concatenate([np.asarray(c.centre) for c in components]), axis=0)
    rows, columns = _nearest(centres, grid)
    offsets = np.arange(-_SMOOTH_CORE, _SMOOTH_CORE + 1)
    near = (rows > -_SMOOTH_CORE) & (rows < grid.shape[0] + _SMOOTH_CORE)
    near &= (columns > -_SMOOTH_CORE) & (columns < grid.shape[1] + _SMOOTH_CORE)
    if not near.any():
        return kappa
    rows, columns = (v[near][:, None] + offsets for v in (rows, columns))  # (m, k)
    fine = (np.arange(_SMOOTH_FINE) + 0.5) / _SMOOTH_FINE - 0.5
    first_x, first_y = _first(grid)
    x, y = (f + p * (i[..., None] + fine) for f, i in ((first_x, columns), (first_y, rows)))
    blocks = np.asarray(
        _cores(components, jnp.asarray(x), jnp.asarray(y), jnp.asarray(_DISC * p / _SMOOTH_FINE))
    )
    for block, i, j in zip(blocks, rows, columns, strict=True):
        in_y, in_x = (i >= 0) & (i < grid.shape[0]), (j >= 0) & (j < grid.shape[1])
        kappa[np.ix_(i[in_y], j[in_x])] = block[np.ix_(in_y, in_x)]
    return kappa


def _first(grid: Grid) -> tuple[float, float]:
    """Centre of the lower-left pixel, arcsec."""
    return (
        grid.centre[0] - 0.5 * grid.pixel * (grid.shape[1] - 1),
        grid.centre[1] - 0.5 * grid.pixel * (grid.shape[0] - 1),
    )


def _nearest(centres: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixels nearest to `centres (m, 2)`; they may lie outside the map."""
    column, row = (centres - np.array(_first(grid))).T / grid.pixel
    return np.rint(row).astype(int), np.rint(column).astype(int)


# --- subhaloes ----------------------------------------------------------------------------------


def _sphere(r2: np.ndarray, r_t: float | np.ndarray) -> np.ndarray:
    """arccos(u)/u of the truncated isothermal sphere at squared radii, 0 outside it; overwrites `r2`."""
    u = np.sqrt(r2, out=r2)
    u /= r_t
    np.clip(u, 1e-6, 1.0, out=u)
    value = np.arccos(u)
    value /= u
    return value


def _inverse_radius(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Integral of 1/R over the rectangles between edges `x (s, m + 1)` and `y (s, n + 1)`, `(s, n, m)`."""
    x, y = x[:, None, :], y[:, :, None]
    # 0 asinh(./0) is 0.
    corner = x * np.arcsinh(y / np.maximum(np.abs(x), 1e-30)) + y * np.arcsinh(
        x / np.maximum(np.abs(y), 1e-30)
    )
    return np.diff(np.diff(corner, axis=1), axis=2)


def _sphere_means(x: np.ndarray, y: np.ndarray, p: float, r_t: np.ndarray) -> np.ndarray:
    """Means of arccos(u)/u over pixels of side p at `x (s, m)`, `y (s, n)` from s centres: `(s, n, m)`.

    arccos(u)/u = (pi/2)/u - arcsin(u)/u: the first in closed form, the second from a few points per pixel.
    """
    fine = p * ((np.arange(_STAMP_FINE) + 0.5) / _STAMP_FINE - 0.5)
    size = r_t[:, None, None]
    x2, y2 = (((v[..., None] + fine) / size) ** 2 for v in (x, y))
    u = y2[:, :, None, :, None] + x2[:, None, :, None, :]
    np.sqrt(np.maximum(u, 1e-24, out=u), out=u)
    regular = np.arcsin(np.minimum(u, 1.0))
    regular /= u
    edges = (np.append(v - 0.5 * p, v[:, -1:] + 0.5 * p, axis=1) for v in (x, y))
    return 0.5 * math.pi * size * _inverse_radius(*edges) / p**2 - regular.mean(axis=(3, 4))


_TOGETHER = 32
# Cores of stamps in memory together, so that their points stay in a core's cache.


def _add_cores(
    kappa: np.ndarray, centre: np.ndarray, r_t: np.ndarray, amplitude: np.ndarray, grid: Grid
) -> None:
    """Add what means over the pixels about the centres of spheres exceed the values at pixel centres by."""
    p, first = grid.pixel, _first(grid)
    offsets = np.arange(-_STAMP_CORE, _STAMP_CORE + 1)
    nearest = _nearest(centre, grid)
    near = np.ones(len(centre), bool)
    for place, length in zip(nearest, grid.shape, strict=True):
        near &= (place >= -_STAMP_CORE) & (place < length + _STAMP_CORE)
    centre, r_t, amplitude = centre[near], r_t[near], amplitude[near]
    rows, columns = (place[near][:, None] + offsets for place in nearest)
    x, y = (f + p * i - c[:, None] for f, i, c in zip(first, (columns, rows), centre.T, strict=True))
    for start in range(0, len(r_t), _TOGETHER):
        some = slice(start, start + _TOGETHER)
        more = _sphere_means(x[some], y[some], p, r_t[some])
        more -= _sphere((y[some] ** 2)[:, :, None] + (x[some] ** 2)[:, None, :], r_t[some, None, None])
        more *= amplitude[some, None, None]
        i, j = np.broadcast_arrays(rows[some][:, :, None], columns[some][:, None, :])
        inside = (i >= 0) & (i < grid.shape[0]) & (j >= 0) & (j < grid.shape[1])
        np.add.at(kappa, (i[inside], j[inside]), more[inside])


def _add_stamps(kappa: np.ndarray, component: Component, grid: Grid) -> None:
    """Add truncated isothermal spheres to a map, each where it is not zero."""
    p = grid.pixel
    first = np.array(_first(grid))
    size = np.array(grid.shape[::-1])
    centre = np.asarray(component.centre)
    r_t, theta_e = np.asarray(component.params.r_t), np.asarray(component.params.theta_e)
    amplitude = 0.5 * (theta_e / r_t) ** 2
    _add_cores(kappa, centre, r_t, amplitude, grid)
    # Pixels whose centre is inside the sphere.
    low = np.ceil((centre - r_t[:, None] - first) / p).astype(int)
    high = np.floor((centre + r_t[:, None] - first) / p).astype(int) + 1
    low, high = np.maximum(low, 0), np.minimum(high, size)
    for k in np.flatnonzero((high > low).all(axis=1)):
        x, y = (
            f + p * np.arange(a, b) - c for f, a, b, c in zip(first, low[k], high[k], centre[k], strict=True)
        )
        there = kappa[low[k, 1] : high[k, 1], low[k, 0] : high[k, 0]]
        x2, y2 = x**2, (y**2)[:, None]
        step = max(1, _BLOCK // len(x))
        for start in range(0, len(y), step):
            block = _sphere(y2[start : start + step] + x2, r_t[k])
            block *= amplitude[k]
            there[start : start + step] += block
