"""Whether one calibration serves all radii: the slope of the shapes against the model of the images."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array
from jaxlens.maps_real import ellipticity_variance
from jaxlens.radial import Annuli, sector_sums
from jaxlens.workflow_real import Sample


class Slopes(NamedTuple):
    """Slope of the measured ellipticities against the reduced shear of a model.

    Attributes:
        value, error: in annuli, `(b,)`; error from ellipticities turned at random.
        mean, mean_error: of all annuli.
        chi2: of the annuli about their mean, b - 1 degrees of freedom.
    """

    value: np.ndarray
    error: np.ndarray
    mean: float
    mean_error: float
    chi2: float


def slopes(sample: Sample, g: Array, rings: Annuli) -> Slopes:
    """sum W Re(eps g*) over sum W |g|^2 of the pixels of annuli, W their weight in the map.

    Reduced shear has no mass sheet, so this needs no lambda. But it takes the model for the truth: a slope
    that changes with radius is the calibration of the shapes, their dilution by galaxies in front, or the
    model.

    Args:
        sample: the galaxies; pixels of weight 0 are left out.
        g: reduced shear of the model, `(y, x)`.
        rings: annuli.
    """
    weight = sample.field.shear.weight
    total = lambda values: np.asarray(sector_sums(weight * values, rings)[0].sum(axis=1))
    product, square = total(jnp.real(sample.field.shear.g * jnp.conj(g))), total(jnp.abs(g) ** 2)
    noise = total(weight * ellipticity_variance(sample) * jnp.abs(g) ** 2)
    value, error = product / square, noise**0.5 / square
    mean, mean_error = product.sum() / square.sum(), noise.sum() ** 0.5 / square.sum()
    chi2 = float(np.sum(((value - mean) / error) ** 2))
    return Slopes(value, error, float(mean), float(mean_error), chi2)
