"""Smoothing that knows masks, and masks that are smooth."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, ComplexMap, Map
from jaxlens.grid import Grid


def _check(values: Array, weight: Array | None, grid: Grid, width: float) -> None:
    for name, one in (("values", values), ("weight", weight)):
        if one is not None and one.shape != grid.shape:
            raise ValueError(
                f"`{name}` has shape {one.shape} but `grid.shape` is {grid.shape}; give the map's own grid."
            )
    if not 0.0 <= width < np.inf:
        raise ValueError(f"`width` is {width}; give the standard deviation of the Gaussian, arcsec, >= 0.")


def _kernel(n: int, sigma: Array) -> Array:
    """exp(-(i - j)^2/(2 sigma^2)), `(n, n)`."""
    i = jnp.arange(n, dtype=sigma.dtype)
    return jnp.exp(-0.5 * ((i[:, None] - i[None, :]) / sigma) ** 2)


def smooth(values: Map | ComplexMap, grid: Grid, width: float, weight: Map | None = None) -> Map | ComplexMap:
    """Weighted Gaussian mean (v w) * S / (w * S) at every pixel, 0 where w * S is 0.

    The paper's smoothing of the reduced shear, also for convergence maps. The convolution is linear (nothing
    outside the map) and the Gaussian is not cut off, so masked pixels receive the mean of their surroundings.

    Args:
        values: real or complex map, `(y, x)`; its value where the weight is 0 has no influence.
        grid: its grid.
        width: **standard deviation** of the Gaussian, arcsec; 0 leaves the map as it is.
        weight: weights >= 0, `(y, x)`; all 1 if None.

    Returns:
        The smoothed map, `(y, x)`, in the dtype of `values`.
    """
    _check(values, weight, grid, width)
    sigma = None if width == 0.0 else jnp.asarray(width, jnp.finfo(values.dtype).dtype)
    return blur(values, grid, sigma, weight)


def blur(
    values: Map | ComplexMap, grid: Grid, width: Array | None, weight: Map | None = None
) -> Map | ComplexMap:
    """`smooth` with a width that may be traced, unchecked; None for no smoothing."""
    real = jnp.finfo(values.dtype).dtype
    w = jnp.ones(grid.shape, real) if weight is None else weight.astype(real)
    clean = jnp.where(w > 0.0, values, jnp.zeros((), values.dtype))
    if width is None:
        return clean
    left, right = (_kernel(n, (width / grid.pixel).astype(real)) for n in grid.shape)
    convolve = lambda field: left @ field @ right
    total = convolve(w)
    known = total > 0.0
    norm = jnp.where(known, total, 1.0)
    mean = lambda part: jnp.where(known, convolve(part * w) / norm, 0.0)
    if jnp.iscomplexobj(clean):
        return mean(clean.real) + 1j * mean(clean.imag)
    return mean(clean)


def cosine_mask(weight: Map, length: float = 2.0) -> Map:
    """m = (1 - cos(pi min(d, L)/L))/2 with d the distance to the nearest pixel of weight 0, pixels.

    0 in masked pixels, 1 beyond `length`; the edge of the map is no mask. Our choice of a smooth mask. Not
    differentiable.

    Args:
        weight: `(y, x)`, 0 where masked.
        length: L, pixels.
    """
    reach = int(np.ceil(length))
    n_y, n_x = weight.shape
    known = jnp.pad(weight > 0.0, reach, constant_values=True)
    mask = jnp.ones_like(weight)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if (distance := float(np.hypot(dy, dx))) < length:
                there = known[reach + dy : reach + dy + n_y, reach + dx : reach + dx + n_x]
                value = float(0.5 * (1.0 - np.cos(np.pi * distance / length)))
                mask = jnp.where(there, mask, jnp.minimum(mask, value))
    return mask


def sigmoid_mask(g: ComplexMap, limit: float = 0.5, width: float = 0.05) -> Map:
    """m = 1/(1 + exp((|g| - limit)/width)): a mask that is differentiable in the reduced shear, `(y, x)`."""
    size = jnp.sqrt(g.real**2 + g.imag**2 + jnp.finfo(g.dtype).tiny)  # keeps the derivative at g = 0 finite
    return jax.nn.sigmoid((limit - size) / width)
