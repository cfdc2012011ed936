"""How many galaxies would show a transition: simulated fields with the geometry and noise of a real one."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import radial
from jaxlens._types import Array, Map, RandomKey
from jaxlens.budget_real import excess_of
from jaxlens.lens import Component, Lens
from jaxlens.maps_real import Inversion, maps_of, reduced
from jaxlens.profiles import TSIS

CLUMPS, RANGE, STRENGTH, EXTENT = 6, (50.0, 150.0), (3.0, 12.0), (15.0, 40.0)
"""Subhaloes of a simulated field that no model knows: their number, distance from the centre, Einstein radius
of the whole mass and truncation radius, arcsec, each uniform in its range (our choice: 2e12 to 3e13 Msun)."""

FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""By which the density of galaxies is multiplied: shape noise falls as its root."""

ENOUGH = 0.68
"""Share of the fields that must show a transition."""


class Search(NamedTuple):
    """Result of `search`.

    Attributes:
        density: galaxies per square arcminute of the real field.
        factors: multiples of it, `(f,)`.
        found: share of the fields with a transition at each, `(f,)`.
        inside: share of those whose strong-lensing map is the worse one from the first annulus on, `(f,)`:
            there the transition lies further in than the annuli.
        fields: their number.
    """

    density: float
    factors: np.ndarray
    found: np.ndarray
    inside: np.ndarray
    fields: int

    @property
    def needed(self) -> float | None:
        """First density at which more than 68 % of the fields have a transition; None if none."""
        enough = np.flatnonzero(self.found > ENOUGH)
        return float(self.density * self.factors[enough[0]]) if len(enough) else None


def clumps(key: RandomKey) -> Component:
    """Subhaloes that no model of the images knows."""
    a, b, c, d = jax.random.split(key, 4)
    between = lambda key, ends: jax.random.uniform(key, (CLUMPS,), minval=ends[0], maxval=ends[1])
    radius = between(a, RANGE)
    angle = between(b, (0.0, 2.0 * np.pi))
    centre = radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    return Component(TSIS(theta_e=between(c, STRENGTH), r_t=between(d, EXTENT)), centre, jnp.zeros(CLUMPS))


@eqx.filter_jit
def _shears(keys: Array, draws: Lens, invert: Inversion, ratio: float) -> Array:
    """Reduced shear of draws of a lens with subhaloes, `(n, y, x)`."""

    def one(x: tuple[Array, Lens]) -> Array:
        key, drawn = x
        lens = Lens({**drawn.components, "clumps": clumps(key)})
        return reduced(maps_of(lens, invert.grid, invert.smoothing), ratio)

    return jax.lax.map(one, (keys, draws))


@eqx.filter_jit
def _crossings(
    wl: Array, sl: Map, rings: radial.Annuli, inner: Map, sigma2: Array, bias: Map
) -> tuple[Array, Array]:
    """Whether each map has a transition, and whether q is above 1 in the first annuli already, `(n,)`."""

    def one(kappa: Array) -> tuple[Array, Array]:
        made = excess_of(kappa, sl, rings, inner, sigma2, bias)
        return made.transition.found, jnp.all(made.q[:3] > 1.0)

    return jax.lax.map(one, wl)


def search(
    key: RandomKey,
    invert: Inversion,
    draws: Lens,
    sl: Map,
    noise: Array,
    ratio: float,
    rings: radial.Annuli,
    inner: Map,
    sigma2: Array,
    bias: Map,
    density: float,
    fields: int = 40,
    factors: tuple[float, ...] = FACTORS,
) -> Search:
    """How often fields with 1, 2, 4, 8, 16 times the galaxies have a transition by excess variance.

    The true lens of a field is a draw of the posterior with subhaloes that the strong-lensing map lacks;
    the map is that of the best model, not fitted again (a fit would take in a part of them). Calibration
    and depth are known, so that the shares are upper limits.

    Args:
        key: of the subhaloes.
        invert: the reconstruction.
        draws: of the posterior, with a leading axis.
        sl: smoothed convergence of the best model at D_LS/D_S = `ratio`, `(y, x)`.
        noise: calibrated shape noise of the real field, `(n, y, x)`.
        ratio: D_LS/D_S.
        rings: annuli.
        inner: 1 in the pixels whose lambda corrects the map, `(y, x)`.
        sigma2: variance of the noise of the real field, from `budget_real.aligned_variance`, `(b,)`.
        bias: error of the method, `(y, x)`.
        density: galaxies per square arcminute.
        fields: simulated ones, at most as many as there are draws and maps of noise.
        factors: multiples of the density.
    """
    n = min(len(noise), len(jax.tree.leaves(draws)[0]), fields)
    some = jax.tree.map(lambda leaf: leaf[:n], draws)
    clean = _shears(jax.random.split(key, n), some, invert, ratio)
    found, inside = [], []
    for factor in factors:
        wl = invert.many(clean + noise[:n] / np.sqrt(factor))
        has, early = _crossings(wl, sl, rings, inner, sigma2 / factor, bias)
        found.append(float(jnp.mean(has)))
        inside.append(float(jnp.mean(early)))
    return Search(density, np.asarray(factors), np.asarray(found), np.asarray(inside), n)
