"""Pixel positions, padding, cropping and rebinning of square maps."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxlens.grid import Grid, crop, pad, rebin

GRID = Grid(shape=(4, 6), pixel=2.5, centre=(10.0, -3.0))


def ramp(grid: Grid) -> jnp.ndarray:
    """A map that no transposition or flip leaves as it is."""
    return grid.theta[..., 0] + 100.0 * grid.theta[..., 1]


def test_rows_are_theta_2_and_columns_theta_1():
    theta = np.asarray(GRID.theta)
    assert theta.shape == (4, 6, 2)
    # Positions by hand: centre -+ 2.5 pixels of 2.5 arcsec along the row, -+ 1.5 along the column.
    assert_allclose(theta[0, 0], [10.0 - 6.25, -3.0 - 3.75])
    assert_allclose(theta[0, -1], [10.0 + 6.25, -3.0 - 3.75])
    assert_allclose(theta[-1, 0], [10.0 - 6.25, -3.0 + 3.75])


def test_axes_radius_and_extent():
    theta = np.asarray(GRID.theta)
    assert_allclose(GRID.x, theta[0, :, 0])
    assert_allclose(GRID.y, theta[:, 0, 1])
    assert_allclose(GRID.radius, np.hypot(theta[..., 0], theta[..., 1]), rtol=1e-15)
    assert GRID.extent == (2.5, 17.5, -8.0, 2.0)


@pytest.mark.parametrize(("side", "pixel", "n"), [(30.0, 10.0, 3), (31.0, 10.0, 4), (480.0, 10.0, 48)])
def test_square_covers_its_side(side: float, pixel: float, n: int):
    grid = Grid.square(side, pixel, centre=(1.0, 2.0))
    assert grid.shape == (n, n)
    assert grid.pixel == pixel
    assert grid.centre == (1.0, 2.0)


def test_pad_keeps_pixels_where_they_are():
    values, grid = pad(ramp(GRID), GRID, 3)
    assert values.shape == grid.shape == (12, 18)
    inside = values != 0.0
    assert inside.sum() == 24
    assert_allclose(values[inside], ramp(grid)[inside], rtol=1e-12)


def test_crop_undoes_pad():
    values = ramp(GRID)
    padded, wide = pad(values, GRID, 2)
    back, grid = crop(padded, wide, GRID.shape)
    assert_array_equal(back, values)
    assert grid == GRID


def test_rebin_averages_blocks_and_keeps_positions():
    values, grid = rebin(ramp(GRID), GRID, 2)
    assert grid.shape == (2, 3)
    assert grid.pixel == 5.0
    # The mean of a linear map over a block is its value at the centre of the block.
    assert_allclose(values, ramp(grid), rtol=1e-13)


def test_leading_axes_pass_through():
    stack = jnp.stack([ramp(GRID), 2.0 * ramp(GRID)])
    for transform in (
        lambda v: pad(v, GRID, 2),
        lambda v: rebin(v, GRID, 2),
        lambda v: crop(v, GRID, (2, 2)),
    ):
        both, single = transform(stack)[0], transform(ramp(GRID))[0]
        assert_allclose(both[0], single)
        assert_allclose(both[1], 2.0 * single)


def test_misuse_is_refused_with_a_remedy():
    with pytest.raises(ValueError, match="two positive integers"):
        Grid(shape=(0, 4), pixel=1.0)
    with pytest.raises(ValueError, match="positive size in arcsec"):
        Grid(shape=(4, 4), pixel=0.0)
    with pytest.raises(ValueError, match="map's own grid"):
        pad(jnp.zeros((3, 3)), GRID, 2)
    with pytest.raises(ValueError, match="odd factor"):
        pad(jnp.zeros((3, 3)), Grid((3, 3), 1.0), 2)
    with pytest.raises(ValueError, match="must be even"):
        crop(ramp(GRID), GRID, (3, 6))
    with pytest.raises(ValueError, match="must divide both sides"):
        rebin(ramp(GRID), GRID, 4)
