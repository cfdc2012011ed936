"""Constant convergence: the degenerate mode of every weak-lensing map."""

import equinox as eqx

from jaxlens._types import Array, Float, Point, Scalar
from jaxlens.profiles._profile import as_float, register


class Sheet(eqx.Module):
    """A uniform mass sheet about the component's centre.

    Attributes:
        kappa: convergence for D_LS/D_S = 1, shape `(*n)`, dimensionless.
    """

    kappa: Float[Array, "*n"] = eqx.field(converter=as_float)


def potential(p: Sheet, x: Point) -> Scalar:
    """psi = kappa |x|^2/2, arcsec^2."""
    return 0.5 * p.kappa * (x @ x)


def kappa(p: Sheet, x: Point) -> Scalar:
    """The same everywhere."""
    return p.kappa + 0.0 * x[0]


register(Sheet, potential=potential, kappa=kappa, strength="kappa", example=lambda: Sheet(kappa=0.3))
