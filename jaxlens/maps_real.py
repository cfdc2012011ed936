"""A lens and the shear of a catalogue as maps of the same pixels and resolution."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as lensing
from jaxlens import weak
from jaxlens._types import Array, Float, Map
from jaxlens.grid import Grid, rebin
from jaxlens.lens import Lens
from jaxlens.workflow_real import Sample

FINE, MARGIN = 3, 3.0
"""Points per side of a pixel at which lenses are evaluated, and how far beyond the map, in standard
deviations of the smoothing."""

ITERATIONS = 5

STAY = 3
"""Annuli in which the ratio of variances must stay above 1: one more than for simulated clusters, because in
these fields an excess of other origin than the strong-lensing map is known. The mass sheet is that of the
inner range here, which is most of such a field."""


class Maps(eqx.Module):
    """A lens for D_LS/D_S = 1 on the pixels of a map.

    Attributes:
        smooth: convergence, smoothed as the map, `(y, x)`.
        kappa: convergence averaged in pixels, `(y, x)`.
        gamma: complex shear, likewise.
    """

    smooth: Float[Array, "*n y x"]
    kappa: Float[Array, "*n y x"]
    gamma: Array


@eqx.filter_jit
def maps_of(lens: Lens, grid: Grid, smoothing: float) -> Maps:
    """`Maps` of a lens: evaluated at 3 x 3 points per pixel, beyond the edge too, smoothed, averaged."""
    edge = int(np.ceil(MARGIN * smoothing / grid.pixel))
    n_y, n_x = grid.shape
    fine = Grid(
        (FINE * (n_y + 2 * edge), FINE * (n_x + 2 * edge)),
        grid.pixel / FINE,
        (grid.centre[0], grid.centre[1]),
    )
    kappa, gamma = lensing.kappa_and_gamma(lens, fine.theta)
    inside = lambda values: rebin(values, fine, FINE)[0][edge : edge + n_y, edge : edge + n_x]
    return Maps(inside(weak.smooth(kappa, fine, smoothing)), inside(kappa), inside(gamma))


@eqx.filter_jit
def smooth_draws(draws: Lens, grid: Grid, smoothing: float) -> Float[Array, "n y x"]:
    """Smoothed convergence of every draw of a lens for D_LS/D_S = 1, `(n, y, x)`."""
    return jax.lax.map(lambda one: maps_of(one, grid, smoothing).smooth, draws)


def reduced(maps: Maps, ratio: float) -> Array:
    """g = gamma/(1 - kappa) of pixel averages, `(y, x)`; 1/g* where |g| > 1, as ellipticities show it."""
    g = ratio * maps.gamma / (1.0 - ratio * maps.kappa)
    return jnp.where(jnp.abs(g) > 1.0, 1.0 / jnp.conj(jnp.where(g == 0.0, 1.0, g)), g)


def ellipticity_variance(sample: Sample) -> Map:
    """Variance of a component of the mean ellipticity of each pixel when every galaxy is turned at random.

    V = f^2 sum w^2 |eps|^2/[2 (sum w)^2], `(y, x)`; f is the factor of `Field`, and pixels without a galaxy
    have 0.
    """
    galaxies, field = sample.setup.galaxies, sample.field
    squares = weak.Galaxies(galaxies.theta, jnp.abs(galaxies.eps) ** 2, galaxies.weight**2, galaxies.dls_ds)
    summed = weak.to_grid(squares, field.grid)
    total = jnp.where(field.shear.weight > 0.0, field.shear.weight, 1.0)
    return jnp.where(
        field.shear.weight > 0.0, 0.5 * field.factor**2 * summed.g.real * summed.weight / total**2, 0.0
    )


class Inversion(eqx.Module):
    """The reconstruction of one sample, set up once for all its maps."""

    weight: Map
    inverse: weak.AkraDense
    grid: Grid = eqx.field(static=True)
    smoothing: float = eqx.field(static=True)

    @classmethod
    def of(cls, sample: Sample) -> "Inversion":
        """That of a sample's mask: scheme A2, as `jaxlens weak`."""
        field = sample.field
        inverse = weak.dense_inverse(field.shear.weight, field.grid, scheme="A2")
        return cls(field.shear.weight, inverse, field.grid, field.smoothing)

    def one(self, g: Array) -> Map:
        """Convergence of one reduced shear map `(y, x)`: as `many`, and differentiable."""
        shear = weak.ShearMap(g, self.weight, jnp.ones(self.grid.shape, int))
        return weak.reconstruct(
            shear, self.grid, scheme="A2", inverse=self.inverse, n_iter=ITERATIONS, smoothing=self.smoothing,
            power_steps=0,
        ).kappa  # fmt: skip

    def many(self, g: Array) -> Float[Array, "n y x"]:
        """Convergence of reduced shear maps `(n, y, x)`."""
        count = jnp.ones(self.grid.shape, int)
        shears = jax.vmap(lambda one: weak.ShearMap(one, self.weight, count))(g)
        made = weak.reconstruct_many(
            shears, self.grid, inverse=self.inverse, scheme="A2", n_iter=ITERATIONS, smoothing=self.smoothing
        )
        return made.kappa
