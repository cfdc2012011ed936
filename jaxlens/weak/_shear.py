"""Shear data on a grid."""

import equinox as eqx

from jaxlens._types import Array, ComplexMap, Int, Map


class ShearMap(eqx.Module):
    """Mean ellipticity of the galaxies in each pixel, an estimate of the reduced shear.

    Attributes:
        g: complex reduced shear g_1 + i g_2 in the frame theta_1 = West, theta_2 = North, `(y, x)`;
            finite everywhere, its value where the weight is 0 has no influence.
        weight: weight of each pixel, >= 0, 0 where nothing is known, `(y, x)`; never NaN.
        n_gal: galaxies in each pixel, `(y, x)` int.
    """

    g: ComplexMap
    weight: Map
    n_gal: Int[Array, "y x"]
