"""Prior laws of single free numbers: residual rows of a fit, and densities for a sampler.

A number in a `Box` has the uniform law (in its logarithm with `log=True`); the laws here replace it, cut off
at the edges of the box. Each says in which variable t it is normal: x, ln x or the redshift. Its row is
(t - centre)/width, whose square is -2 ln p up to a constant **as a density of t**; `log_measure` is
ln |dt/dx|, with which `strong.log_posterior` makes a density of x of it.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from jaxlens._types import Array, Scalar
from jaxlens.cosmology import LensPlane, redshift_of_dls_ds
from jaxlens.profiles._profile import as_float
from jaxlens.strong._bounds import Bounds, Box, Disc


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

    def log_measure(self, params: Mapping[str, Array]) -> Array:
        """0: the law is normal in the number itself."""
        return jnp.zeros_like(params[self.name])


class LogNormalPrior(eqx.Module):
    """A log-normal prior on one positive number: ln x is normal about ln(median).

    The optimum of a fit is that of the density of ln x, whose peak is the median; as a density of x it
    peaks at median exp(-sigma_ln^2).

    Attributes:
        name: the free number; its box must begin above 0.
        median: of the prior, `()`, in the number's unit, positive.
        sigma_ln: standard deviation of ln x, `()`; 0.23 is 0.1 dex.
    """

    name: str = eqx.field(static=True)
    median: Scalar = eqx.field(converter=as_float)
    sigma_ln: Scalar = eqx.field(converter=as_float)

    def __call__(self, params: Mapping[str, Array]) -> Array:
        """(ln x - ln median)/sigma_ln, `()`."""
        return jnp.log(params[self.name] / self.median) / self.sigma_ln

    def log_measure(self, params: Mapping[str, Array]) -> Array:
        """ln |d ln x/dx| = -ln x, `()`."""
        return -jnp.log(params[self.name])


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

    @property
    def name(self) -> str:
        """The free number: the distance ratio of the system."""
        return f"dls_ds.{self.system}"

    def __call__(self, params: Mapping[str, Array]) -> Array:
        """(z - mean)/sigma, `()`."""
        return (redshift_of_dls_ds(self.plane, params[self.name]) - self.mean) / self.sigma

    def log_measure(self, params: Mapping[str, Array]) -> Array:
        """ln |dz/d(D_LS/D_S)|, `()`."""
        z = redshift_of_dls_ds(self.plane, params[self.name])
        return -jnp.log(jax.grad(self.plane.dls_ds)(z))  # of the inverse: its second derivative is right, too


Law = NormalPrior | LogNormalPrior | RedshiftPrior


def normal_laws(priors: tuple[Callable[..., Any], ...]) -> dict[str, tuple[float, float]]:
    """Mean and sigma of the normal law of every number that has one, by the number's name; of redshifts in z.

    Several laws on one number are one, up to a constant: their weights 1/sigma^2 add up, and its mean is the
    weighted one.

    Raises:
        ValueError: if a distance ratio has a normal law in itself, which is none in the redshift.
    """
    sums: dict[str, tuple[float, float]] = {}
    for one in priors:
        if not isinstance(one, NormalPrior | RedshiftPrior):
            continue
        if isinstance(one, NormalPrior) and one.name.startswith("dls_ds."):
            raise ValueError(
                f"The normal prior on the distance ratio `{one.name}` has no counterpart; "
                "give a RedshiftPrior."
            )
        weight = 1.0 / float(one.sigma) ** 2
        total, first = sums.get(one.name, (0.0, 0.0))
        sums[one.name] = (total + weight, first + weight * float(one.mean))
    return {name: (first / total, total**-0.5) for name, (total, first) in sums.items()}


def refuse_impossible(priors: tuple[Callable[..., Any], ...], bounds: Bounds) -> None:
    """Raise `ValueError` for a law on a number that is not free, or that its box does not allow.

    Numbers that are traced are not looked at.
    """
    for prior in priors:
        if not isinstance(prior, Law):
            continue
        if prior.name not in bounds:
            raise ValueError(
                f"A {type(prior).__name__} is set on `{prior.name}`, which is not free; free are "
                f"{', '.join(sorted(bounds))}. Free it, or leave out the prior."
            )
        width = prior.sigma_ln if isinstance(prior, LogNormalPrior) else prior.sigma
        if _known(width) and not (float(width) > 0.0 and jnp.isfinite(width)):
            raise ValueError(
                f"The prior on `{prior.name}` has the width {float(width):g}; give a positive one."
            )
        if isinstance(prior, LogNormalPrior):
            _refuse_log_normal(prior, bounds)


def _refuse_log_normal(prior: LogNormalPrior, bounds: Bounds) -> None:
    box = bounds[prior.name]
    if not isinstance(box, Box):
        instead = "its elongation and angle apart" if isinstance(box, Disc) else "a number in a Box"
        raise ValueError(
            f"A LogNormalPrior is set on `{prior.name}`, a {type(box).__name__}; free {instead}."
        )
    if _known(box.lo) and not float(box.lo) > 0.0:
        raise ValueError(
            f"The log-normal prior on `{prior.name}` needs a box above 0; it begins at {float(box.lo):g}: "
            "raise the lower limit, or use a NormalPrior."
        )
    if _known(prior.median) and not float(prior.median) > 0.0:
        raise ValueError(
            f"The log-normal prior on `{prior.name}` has the median {float(prior.median):g}; "
            "give a positive one."
        )


def _known(value: Array) -> bool:
    return not isinstance(value, Tracer)


def log_measure(priors: tuple[Callable[..., Any], ...], bounds: Bounds, params: Mapping[str, Array]) -> Array:
    """What turns uniform boxes times the squares of the rows into the laws' densities, `()`.

    Sum over the numbers in a `Box` that have a law: ln |dt/dx| of the law minus ln |ds/dx| of the box, in
    which s (x or ln x) is uniform. Where a number has several laws, that of the first counts.
    """
    total, done = jnp.zeros(()), set()
    for prior in priors:
        if not isinstance(prior, Law) or prior.name in done:
            continue
        done.add(prior.name)
        box = bounds[prior.name]
        total = total + prior.log_measure(params)
        if isinstance(box, Box) and box.log:
            total = total + jnp.log(params[prior.name])
    return total
