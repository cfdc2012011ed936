"""Square flat-sky maps: pixel positions, padding, cropping, area-weighted rebinning.

Maps are `[row = theta_2, column = theta_1]`, origin lower-left, values at pixel centres.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array


class Grid(eqx.Module):
    """A regular grid of square pixels.

    Attributes:
        shape: `(n_y, n_x)` pixels.
        pixel: side of a pixel, arcsec.
        centre: (theta_1, theta_2) of the centre of the map, arcsec.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    pixel: float = eqx.field(static=True)
    centre: tuple[float, float] = eqx.field(static=True, default=(0.0, 0.0))

    def __check_init__(self) -> None:
        if len(self.shape) != 2 or min(self.shape) < 1:
            raise ValueError(f"`shape` is {self.shape}; give two positive integers (rows, columns).")
        if not self.pixel > 0:
            raise ValueError(f"`pixel` is {self.pixel}; give a positive size in arcsec.")

    @classmethod
    def square(cls, side: float, pixel: float, centre: tuple[float, float] = (0.0, 0.0)) -> "Grid":
        """A grid that covers at least `side` x `side` arcsec with pixels of `pixel` arcsec."""
        n = -int(-side // pixel)
        return cls((n, n), pixel, centre)

    @property
    def x(self) -> Array:
        """theta_1 of the columns, `(n_x,)`, arcsec."""
        n = self.shape[1]
        return self.centre[0] + self.pixel * (jnp.arange(n) - 0.5 * (n - 1))

    @property
    def y(self) -> Array:
        """theta_2 of the rows, `(n_y,)`, arcsec."""
        n = self.shape[0]
        return self.centre[1] + self.pixel * (jnp.arange(n) - 0.5 * (n - 1))

    @property
    def theta(self) -> Array:
        """Pixel centres, `(n_y, n_x, 2)`, arcsec."""
        return jnp.stack(jnp.meshgrid(self.x, self.y), axis=-1)

    @property
    def radius(self) -> Array:
        """Distance of each pixel from the origin of the frame, `(n_y, n_x)`, arcsec."""
        return jnp.hypot(*jnp.meshgrid(self.x, self.y))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Outer edges (left, right, bottom, top), arcsec, as `matplotlib.imshow` takes them."""
        half_y, half_x = (0.5 * self.pixel * n for n in self.shape)
        return (
            self.centre[0] - half_x,
            self.centre[0] + half_x,
            self.centre[1] - half_y,
            self.centre[1] + half_y,
        )


def _check(values: Array, grid: Grid) -> None:
    if values.shape[-2:] != grid.shape:
        raise ValueError(
            f"`values` has shape {values.shape} but `grid.shape` is {grid.shape}; give the map's own grid."
        )


def pad(values: Array, grid: Grid, factor: int) -> tuple[Array, Grid]:
    """Surround a map with zeros so that each side is `factor` times as long.

    Args:
        values: map, `(..., n_y, n_x)`.
        grid: its grid.
        factor: 1 leaves the map as it is.

    Returns:
        The padded map and its grid (same pixel, same centre when the added margin is even).

    Raises:
        ValueError: if shapes disagree or the margin cannot be shared equally.
    """
    _check(values, grid)
    margins = [(factor - 1) * n for n in grid.shape]
    if factor < 1 or any(m % 2 for m in margins):
        raise ValueError(
            f"`factor` is {factor} for a map of {grid.shape}; give an odd factor, or a map of even size."
        )
    widths = [(0, 0)] * (values.ndim - 2) + [(m // 2, m // 2) for m in margins]
    shape = (factor * grid.shape[0], factor * grid.shape[1])
    return jnp.pad(values, widths), Grid(shape, grid.pixel, grid.centre)


def crop(values: Array, grid: Grid, shape: tuple[int, int]) -> tuple[Array, Grid]:
    """The central part of a map: the inverse of `pad`.

    Args:
        values: map, `(..., n_y, n_x)`.
        grid: its grid.
        shape: rows and columns to keep; each must differ from the grid's by an even number.

    Raises:
        ValueError: if `shape` is larger than the map or cannot be centred on pixels.
    """
    _check(values, grid)
    margins = [n - m for n, m in zip(grid.shape, shape, strict=True)]
    if any(m < 0 or m % 2 for m in margins):
        raise ValueError(
            f"`shape` is {shape} for a map of {grid.shape}; the difference must be even and not negative."
        )
    (top, left) = (m // 2 for m in margins)
    return values[..., top : top + shape[0], left : left + shape[1]], Grid(shape, grid.pixel, grid.centre)


def rebin(values: Array, grid: Grid, factor: int) -> tuple[Array, Grid]:
    """Average blocks of `factor` x `factor` pixels: an exact area weighting.

    Raises:
        ValueError: if `factor` does not divide both sides of the map.
    """
    _check(values, grid)
    n_y, n_x = grid.shape
    if factor < 1 or n_y % factor or n_x % factor:
        raise ValueError(f"`factor` is {factor} for a map of {grid.shape}; it must divide both sides.")
    blocks = values.reshape(*values.shape[:-2], n_y // factor, factor, n_x // factor, factor)
    return blocks.mean(axis=(-3, -1)), Grid((n_y // factor, n_x // factor), grid.pixel * factor, grid.centre)


def resample(values: Array, grid: Grid, shape: tuple[int, int]) -> tuple[Array, Grid]:
    """A map on other pixels over the same field, exactly weighted by overlapping area.

    Every pixel counts as uniform; the sum of map times pixel area is kept. Unlike `rebin`, `shape` need
    not divide the map: 4096 to 48 pixels is no whole number.

    Args:
        values: map, `(..., n_y, n_x)`.
        grid: its grid.
        shape: rows and columns of the result; pixels must come out square.

    Raises:
        ValueError: if shapes disagree, or pixels would not be square.
    """
    _check(values, grid)
    if min(shape) < 1 or shape[0] * grid.shape[1] != shape[1] * grid.shape[0]:
        raise ValueError(
            f"`shape` is {shape} for a map of {grid.shape}; give a shape of the same proportions."
        )
    target = Grid(shape, grid.pixel * grid.shape[0] / shape[0], grid.centre)
    return onto(values, grid, target)[0], target


def _shares(source: Array, target: Array, width: float, size: float) -> np.ndarray:
    """Share of each pixel of `target` (side `size`) that each one of `source` (side `width`) covers."""
    x, y = np.asarray(source, float)[None, :], np.asarray(target, float)[:, None]
    high = np.minimum(x + 0.5 * width, y + 0.5 * size)
    low = np.maximum(x - 0.5 * width, y - 0.5 * size)
    return np.clip(high - low, 0.0, None) / size


def onto(
    values: Array, grid: Grid, target: Grid, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array]:
    """Area-weighted mean of a map in the pixels of another grid with parallel axes.

    Args:
        values: map, `(..., n_y, n_x)`.
        grid: its grid.
        target: the other grid; any pixel size and centre.
        shift: position of the origin of `grid`'s frame in that of `target`, arcsec.

    Returns:
        The mean over the covered part of each pixel of `target` (0 where nothing is), and the share of the
        pixel that is covered. Differentiable in `values`.
    """
    _check(values, grid)
    rows = _shares(grid.y + shift[1], target.y, grid.pixel, target.pixel)
    columns = _shares(grid.x + shift[0], target.x, grid.pixel, target.pixel)
    covered = rows.sum(axis=1)[:, None] * columns.sum(axis=1)[None, :]
    weigh = lambda left, right: jnp.matmul(left, right, precision="highest")
    total = weigh(weigh(jnp.asarray(rows, values.dtype), values), jnp.asarray(columns.T, values.dtype))
    mean = jnp.where(covered > 0.0, total / np.where(covered > 0.0, covered, 1.0), 0.0)
    return mean, jnp.asarray(covered, values.dtype)
