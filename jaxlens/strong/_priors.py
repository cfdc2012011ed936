"""Normal priors as residual rows of a fit."""

from collections.abc import Mapping

import equinox as eqx

from jaxlens._types import Array, Scalar
from jaxlens.cosmology import LensPlane, redshift_of_dls_ds
from jaxlens.profiles._profile import as_float


class NormalPrior(eqx.Module):
    """A normal prior on one number, as a residual.

    Attributes:
        name: the free number.
        mean, sigma: of the prior, `()`, in the number's unit.
    """

    name: str = eqx.field(static=True)
    mean: Scalar = eqx.field(converter=as_float)
    sigma: Scalar = eqx.field(converter=as_float)

    def __call__(self, params: Mapping[str, Array]) -> Array:
        """(value - mean)/sigma, `()`."""
        return (params[self.name] - self.mean) / self.sigma


class RedshiftPrior(eqx.Module):
    """A normal prior on the free redshift of a system; the fit itself moves in the distance ratio.

    Attributes:
        system: name of the system.
        plane: the lens plane.
        mean, sigma: of the redshift, `()`.
    """

    system: str = eqx.field(static=True)
    plane: LensPlane
    mean: Scalar = eqx.field(converter=as_float)
    sigma: Scalar = eqx.field(converter=as_float)

    def __call__(self, params: Mapping[str, Array]) -> Array:
        """(z - mean)/sigma, `()`."""
        z = redshift_of_dls_ds(self.plane, params[f"dls_ds.{self.system}"])
        return (z - self.mean) / self.sigma
