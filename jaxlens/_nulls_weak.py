"""A map against null maps, and its highest point."""

from typing import NamedTuple

import numpy as np

from jaxlens.grid import Grid


class Mode(NamedTuple):
    """A map against null maps.

    Attributes:
        chi2: mean of (kappa/sigma)^2 over unmasked pixels; 1 is expected of noise.
        significance: (chi2 - 1) over its scatter between null maps, which knows that pixels are correlated.
        exceeded: share of the null maps with a larger chi2.
    """

    chi2: float
    significance: float
    exceeded: float


def against(kappa: np.ndarray, nulls: np.ndarray, used: np.ndarray) -> Mode:
    """A map against null maps; each null map is compared with the noise of the others.

    The noise of n maps has n degrees of freedom, so that chi^2 is too large by n/(n - 2).
    """
    values, squares = kappa[used] ** 2, nulls[:, used] ** 2
    n, total = len(squares), squares.sum(axis=0)
    chi2 = float(np.mean(values / total)) * (n - 2)
    null = np.mean(squares / (total - squares), axis=1) * (n - 3)
    scatter = float(np.std(null, ddof=1))
    return Mode(chi2, (chi2 - 1.0) / scatter, float(np.mean(null > chi2)))


def highest(kappa: np.ndarray, used: np.ndarray, grid: Grid) -> np.ndarray:
    """Position of the highest unmasked pixel, `(2,)`, arcsec, refined by a parabola along each axis."""
    row, column = np.unravel_index(np.argmax(np.where(used, kappa, -np.inf)), kappa.shape)
    place = np.array(grid.theta[row, column])
    for axis, (line, at) in enumerate(((kappa[row], column), (kappa[:, column], row))):
        if 0 < at < len(line) - 1:
            left, middle, right = line[at - 1 : at + 2]
            bend = left - 2.0 * middle + right
            if bend < 0.0:
                place[axis] += grid.pixel * float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))
    return place
