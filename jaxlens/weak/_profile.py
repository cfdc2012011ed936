"""Tangential and cross shear about a centre."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxlens._types import Array, Complex, Float, Int, RandomKey, Real, ScalarLike
from jaxlens.weak._catalogue import Galaxies, resample

Centre = tuple[ScalarLike, ScalarLike]


class TangentialProfile(eqx.Module):
    """Mean shear of galaxies in annuli; a bin without galaxies has zeros and an infinite error.

    Attributes:
        edges: of the b bins, `(b + 1,)`, arcsec.
        r: weighted mean radius of the galaxies, `(b,)`, arcsec; the middle of an empty bin.
        g_t: tangential component, positive around a mass, `(b,)`.
        g_x: cross component, 45 degrees to it, `(b,)`; zero for any lens but for noise and errors.
        sigma_t, sigma_x: errors by the scatter of the shapes, `(b,)`.
        count: galaxies with weight, `(b,)`.
    """

    edges: Float[Array, " e"]
    r: Float[Array, " b"]
    g_t: Float[Array, " b"]
    g_x: Float[Array, " b"]
    sigma_t: Float[Array, " b"]
    sigma_x: Float[Array, " b"]
    count: Int[Array, " b"]


def tangential(
    eps: Complex[Array, "*n"], theta: Float[Array, "*n 2"], centre: Centre = (0.0, 0.0)
) -> Complex[Array, "*n"]:
    """Tangential and cross component about a centre, eps_t + i eps_x = -eps exp(-2 i phi).

    phi is the direction of the galaxy as seen from the centre, from +theta_1 (West) towards +theta_2 (North).

    Args:
        eps: ellipticities or shear, `(...)`.
        theta: their positions, `(..., 2)`, arcsec.
        centre: (theta_1, theta_2), arcsec.
    """
    x, y = theta[..., 0] - centre[0], theta[..., 1] - centre[1]
    # exp(-2 i phi) without an angle: finite value and gradient, 0, at the centre itself.
    r2 = x**2 + y**2
    return -eps * (x - 1j * y) ** 2 / jnp.where(r2 > 0.0, r2, 1.0)


def _profile(galaxies: Galaxies, edges: Array, centres: Array) -> TangentialProfile:
    """The mean over pairs of a galaxy and a centre `(c, 2)`, centre by centre: memory is that of one."""
    n, w = edges.shape[0] - 1, galaxies.weight
    edges = edges.astype(w.dtype)
    inside = w > 0.0

    def pairs(centre: Array) -> tuple[Array, Array, Array]:
        """Bin of each galaxy (n where it is in none), its radius, its tangential and cross component."""
        r = jnp.hypot(galaxies.theta[:, 0] - centre[0], galaxies.theta[:, 1] - centre[1])
        place = jnp.searchsorted(edges, r, side="right") - 1
        place = jnp.where((place >= 0) & (place < n), place, n)
        return place, r, tangential(galaxies.eps, galaxies.theta, (centre[0], centre[1]))

    def total(values: Array, place: Array) -> Array:
        return jax.ops.segment_sum(values, place, num_segments=n + 1)[:-1]

    def sums(centre: Array) -> tuple[Array, ...]:
        place, r, both = pairs(centre)
        return tuple(total(values, place) for values in (w, inside.astype(int), w * r, w * both))

    def squares(mean: Array, centre: Array) -> tuple[Array, ...]:
        place, _, both = pairs(centre)
        off = w * (both - jnp.append(mean, 0.0)[place])
        return total(off.real**2, place), total(off.imag**2, place)

    def over_centres(f: Callable[[Array], tuple[Array, ...]]) -> tuple[Array, ...]:
        return tuple(part.sum(axis=0) for part in jax.lax.map(f, centres))

    weight, count, radius, signal = over_centres(sums)
    safe = jnp.where(weight > 0.0, weight, 1.0)
    mean = signal / safe
    small = count / jnp.maximum(count - 1, 1)

    def error(square: Array) -> Array:
        variance = small * square / safe**2
        known = (count > 1) & (variance > 0.0)
        return jnp.where(known, jnp.sqrt(jnp.where(known, variance, 1.0)), jnp.inf)

    sigma_t, sigma_x = (error(square) for square in over_centres(partial(squares, mean)))
    middle = 0.5 * (edges[:-1] + edges[1:])
    r = jnp.where(weight > 0.0, radius / safe, middle)
    return TangentialProfile(edges, r, mean.real, mean.imag, sigma_t, sigma_x, count)


@jax.jit
def tangential_profile(
    galaxies: Galaxies, edges: Real[Array, " e"], centre: Centre = (0.0, 0.0)
) -> TangentialProfile:
    """Weighted mean of tangential and cross ellipticity in annuli.

    g_t = sum w eps_t/sum w, and its error by the scatter in the bin,
    sigma^2 = sum w^2 (eps_t - g_t)^2/(sum w)^2 n/(n - 1), alike for the cross component; the factor makes
    up for the mean of a bin of n galaxies having been taken from the same galaxies.

    Args:
        galaxies: the galaxies.
        edges: increasing edges of the bins, `(b + 1,)`, arcsec; a bin holds its lower edge.
        centre: (theta_1, theta_2), arcsec.

    Returns:
        The profile. Differentiable in ellipticities and weights.
    """
    real = galaxies.weight.dtype  # not that of the edges, which may be whole numbers
    return _profile(galaxies, edges, jnp.stack([jnp.asarray(part, real) for part in centre])[None])


class BootstrapErrors(eqx.Module):
    """Scatter of a profile over bootstrap samples of the galaxies.

    Attributes:
        sigma_t, sigma_x: standard deviations of tangential and cross component, `(b,)`.
        covariance: of the tangential component between bins, `(b, b)`.
    """

    sigma_t: Float[Array, " b"]
    sigma_x: Float[Array, " b"]
    covariance: Float[Array, "b b"]


@eqx.filter_jit
def bootstrap(
    key: RandomKey,
    galaxies: Galaxies,
    edges: Real[Array, " e"],
    centre: Centre = (0.0, 0.0),
    *,
    n: int = 200,
) -> BootstrapErrors:
    """Errors of `tangential_profile` from `n` bootstrap samples of the galaxies.

    Their own relative error is (2 n)^-1/2, 5 % for 200.

    Args:
        key: random key.
        galaxies, edges, centre: as for `tangential_profile`.
        n: samples, at least 2.
    """

    def one(key: RandomKey) -> tuple[Array, Array]:
        profile = tangential_profile(resample(key, galaxies), edges, centre)
        return profile.g_t, profile.g_x

    g_t, g_x = jax.lax.map(one, jax.random.split(key, n))
    off = g_t - jnp.mean(g_t, axis=0, keepdims=True)
    covariance = jnp.matmul(off.T, off, precision="highest") / (n - 1)
    return BootstrapErrors(jnp.sqrt(jnp.diagonal(covariance)), jnp.std(g_x, axis=0, ddof=1), covariance)


class Significance(eqx.Module):
    """Mean shear in one annulus over its error.

    Attributes:
        tangential, cross: signal to noise; the second should scatter about 0 by 1.
        count: galaxies used.
    """

    tangential: Float[Array, ""]
    cross: Float[Array, ""]
    count: Int[Array, ""]


def significance(galaxies: Galaxies, r_min: ScalarLike, r_max: ScalarLike, centre: Centre) -> Significance:
    """Mean tangential and cross shear between two radii, in units of their error by shape scatter.

    Args:
        galaxies: the galaxies.
        r_min, r_max: radii, arcsec.
        centre: (theta_1, theta_2), arcsec.
    """
    real = galaxies.weight.dtype
    edges = jnp.stack([jnp.asarray(r_min, real), jnp.asarray(r_max, real)])
    one = tangential_profile(galaxies, edges, centre)
    return Significance(one.g_t[0] / one.sigma_t[0], one.g_x[0] / one.sigma_x[0], one.count[0])


@jax.jit
def stack(galaxies: Galaxies, edges: Real[Array, " e"], centres: Real[Array, "c 2"]) -> TangentialProfile:
    """The mean profile about many centres, each pair of a galaxy and a centre counted once.

    A galaxy near several centres enters several times; the errors neglect that.

    Args:
        galaxies: the galaxies.
        edges: edges of the bins, `(b + 1,)`, arcsec.
        centres: positions of the lenses, `(c, 2)`, arcsec.
    """
    return _profile(galaxies, edges, centres)
