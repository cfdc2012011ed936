"""Free numbers: the boxes they live in and the unbounded coordinates in which the fit moves.

An optimiser that knows no bounds sees u; every u is a physical number inside its box. A weak normal
prior on u (0.55 u as a residual) is close to a uniform prior in the box, whose own measure in u has
a spread of 1.8. For the two components of a `Disc` the same rows are a penalty that grows with e.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, RandomKey, Scalar
from jaxlens.profiles._profile import as_float

_EDGE = 1e-3
# Starts are clipped this far (as a fraction of the box) inside: on the edge u would be infinite.

LOGIT_AT_BOUND = 4.6
"""|u| beyond which a number is said to be at its bound: within 1 % of the box of its edge."""


class Box(eqx.Module):
    """A number between two limits, uniform prior; u is the logit of its place in the box.

    Attributes:
        lo, hi: limits, `()`.
        log: work (and be uniform) in the logarithm.
        weak: whether the weak prior of a fit applies; not for redshifts.
    """

    lo: Scalar = eqx.field(converter=as_float)
    hi: Scalar = eqx.field(converter=as_float)
    log: bool = eqx.field(static=True, default=False)
    weak: bool = eqx.field(static=True, default=True)

    size = 1

    def _ends(self) -> tuple[Array, Array]:
        return (jnp.log(self.lo), jnp.log(self.hi)) if self.log else (self.lo, self.hi)

    def physical(self, u: Array) -> Array:
        lo, hi = self._ends()
        value = lo + (hi - lo) * jax.nn.sigmoid(u[0])
        return jnp.exp(value) if self.log else value

    def unbounded(self, value: Array) -> Array:
        lo, hi = self._ends()
        place = ((jnp.log(value) if self.log else value) - lo) / (hi - lo)
        return jax.scipy.special.logit(jnp.clip(place, _EDGE, 1.0 - _EDGE))[None]

    def sample(self, key: RandomKey) -> Array:
        lo, hi = self._ends()
        value = jax.random.uniform(key, (), lo.dtype, lo, hi)
        return jnp.exp(value) if self.log else value

    def log_prior(self, u: Array) -> Array:
        """Logarithm of the density of u for a uniform prior in the box (normalised)."""
        return jax.nn.log_sigmoid(u[0]) + jax.nn.log_sigmoid(-u[0])

    def at_bound(self, u: Array) -> Array:
        return jnp.abs(u[0]) > LOGIT_AT_BOUND


class Disc(eqx.Module):
    """Two components e (cos 2 pa, sin 2 pa) of an ellipticity or shear with e < `limit`.

    e = limit |u|/sqrt(1 + |u|^2): nothing is special about e = 0 or about any angle. The prior is
    uniform in e and in the angle.

    Attributes:
        limit: largest e, `()`.
        weak: whether the weak prior of a fit applies.
    """

    limit: Scalar = eqx.field(converter=as_float)
    weak: bool = eqx.field(static=True, default=True)

    size = 2

    def physical(self, u: Array) -> Array:
        return self.limit * u / jnp.sqrt(1.0 + u @ u)

    def unbounded(self, value: Array) -> Array:
        e2 = (value @ value) / self.limit**2
        shrink = jnp.minimum(1.0, (1.0 - _EDGE) / jnp.sqrt(jnp.maximum(e2, 1e-30)))
        place = value / self.limit * shrink
        return place / jnp.sqrt(1.0 - place @ place)

    def sample(self, key: RandomKey) -> Array:
        e, turn = jax.random.uniform(key, (2,), self.limit.dtype)
        return self.limit * e * jnp.stack([jnp.cos(2.0 * jnp.pi * turn), jnp.sin(2.0 * jnp.pi * turn)])

    def log_prior(self, u: Array) -> Array:
        """Log density of u for e uniform in [0, limit] and a uniform angle: 1/[2 pi |u| (1+u^2)^(3/2)]."""
        r2 = jnp.maximum(u @ u, 1e-12)  # integrable peak at e = 0, kept finite
        return -jnp.log(2.0 * jnp.pi) - 0.5 * jnp.log(r2) - 1.5 * jnp.log1p(r2)

    def at_bound(self, u: Array) -> Array:
        return u @ u / (1.0 + u @ u) > 0.99**2


class Angle(eqx.Module):
    """A position angle in rad, periodic in pi and unbounded; for components whose e cannot vanish."""

    weak: bool = eqx.field(static=True, default=False)

    size = 1

    def physical(self, u: Array) -> Array:
        return u[0]

    def unbounded(self, value: Array) -> Array:
        return as_float(value)[None]

    def sample(self, key: RandomKey) -> Array:
        return jax.random.uniform(key, (), jnp.result_type(float), -0.5 * jnp.pi, 0.5 * jnp.pi)

    def log_prior(self, u: Array) -> Array:
        """Uniform on the circle, -ln(pi) for every u; a chain should report pa modulo pi."""
        return -jnp.log(jnp.pi) + 0.0 * u[0]

    def at_bound(self, u: Array) -> Array:
        return jnp.zeros((), bool)


Bound = Box | Disc | Angle
Bounds = dict[str, Bound]
Params = dict[str, Array]


def total_size(bounds: Mapping[str, Bound]) -> int:
    """Number of free numbers."""
    return sum(bound.size for bound in bounds.values())


def split(bounds: Mapping[str, Bound], u: Array) -> dict[str, Array]:
    """The pieces of u `(n,)` that belong to each name.

    Names are taken in alphabetical order: JAX sorts the keys of a dictionary that passes through a
    transformation, so no other order is the same inside and outside a compiled function.
    """
    parts, start = {}, 0
    for name in sorted(bounds):
        parts[name] = u[start : start + bounds[name].size]
        start += bounds[name].size
    return parts


def physical(bounds: Mapping[str, Bound], u: Array) -> Params:
    """Physical numbers by name from the unbounded vector u `(n,)`; arrays `()`, or `(2,)` for a `Disc`."""
    return {name: bounds[name].physical(part) for name, part in split(bounds, u).items()}


def unbounded(bounds: Mapping[str, Bound], params: Mapping[str, Any]) -> Array:
    """The vector u `(n,)` of physical numbers, clipped just inside their boxes.

    Raises:
        ValueError: if a name is missing or unknown.
    """
    missing, unknown = set(bounds) - set(params), set(params) - set(bounds)
    if missing or unknown:
        raise ValueError(
            "The start must give exactly the free parameters. "
            f"Missing: {sorted(missing)}; unknown: {sorted(unknown)}."
        )
    return jnp.concatenate([bounds[name].unbounded(as_float(params[name])) for name in sorted(bounds)])


def sample(key: RandomKey, bounds: Mapping[str, Bound]) -> Params:
    """One draw from the prior (uniform in every box), by name."""
    keys = jax.random.split(key, len(bounds))
    return {name: bounds[name].sample(k) for k, name in zip(keys, sorted(bounds), strict=True)}


def weak_rows(bounds: Mapping[str, Bound], u: Array, weight: Array | float) -> Array:
    """Residual rows weight x u of the weak prior, `(n,)`; zero where it does not apply."""
    parts = split(bounds, u)
    return jnp.concatenate([weight * part * float(bounds[name].weak) for name, part in parts.items()])


def edge(bounds: Mapping[str, Bound], u: Array) -> Array:
    """Which entries of u belong to a number within 1 % of an edge of its box, `(n,)` bool."""
    return _edge(dict(bounds), u)


@jax.jit
def _edge(bounds: Bounds, u: Array) -> Array:
    parts = split(bounds, u)
    return jnp.concatenate(
        [jnp.broadcast_to(bounds[name].at_bound(part), part.shape) for name, part in parts.items()]
    )


def at_bound(bounds: Mapping[str, Bound], u: Array) -> list[str]:
    """Names of the numbers within 1 % of an edge of their box."""
    names = [name for name in sorted(bounds) for _ in range(bounds[name].size)]
    flags = np.asarray(edge(bounds, u))
    return list(dict.fromkeys(name for name, flag in zip(names, flags, strict=True) if flag))
