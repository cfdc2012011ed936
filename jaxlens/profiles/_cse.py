"""Sums of cored steep ellipsoids (CSE): closed forms for any convergence kappa(zeta).

Oguri 2021 (PASP 133, 074504): kappa(zeta) = sum_i A_i / [2 (S_i^2 + zeta^2)^(3/2)], with
zeta^2 = (q x^2 + y^2/q)/r_s^2. In units of t = r_s/sqrt(q) each term has, with
P^2 = q^2 (S^2 + X^2) + Y^2 and D = (P + S)^2 + (1 - q^2) X^2 = X^2 + Y^2 + 2 P S + (1 + q^2) S^2,

    psi = A q/(2S) ln D - (A q/S) ln[(1+q) S],
    alpha_X = A q X (P + q^2 S)/(S P D),   alpha_Y = A q Y (P + S)/(S P D).

There is no branch at q = 1 and nothing is singular at the centre.
"""

from functools import cache, partial
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, Point, Scalar


@cache
def table(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Core radii S_i and amplitudes A_i of Oguri 2021, Tables 1 (`"nfw"`) and 2 (`"hernquist"`)."""
    text = resources.files("jaxlens.profiles").joinpath("oguri2021_cse.csv").read_text(encoding="utf-8")
    rows = [line.split(",") for line in text.splitlines()[1:]]
    values = np.array([[float(r[2]), float(r[3])] for r in rows if r[0] == name])
    values = values[np.argsort(values[:, 0])]
    return values[:, 0], values[:, 1]


def _core(s: Array, q: Array, x: Array, y: Array) -> tuple[Array, Array]:
    p = jnp.sqrt(q**2 * (s**2 + x**2) + y**2)
    return p, x**2 + y**2 + 2.0 * p * s + (1.0 + q**2) * s**2


def _zeroth(s: Array, q: Array, x: Array, y: Array) -> Array:
    """psi of each term in units of t^2 A q/S, `(1, terms)`; zero at the centre."""
    _, d = _core(s, q, x, y)
    return 0.5 * jnp.log(d / ((1.0 + q) * s) ** 2)[None]


def _first(s: Array, q: Array, x: Array, y: Array) -> Array:
    """Gradient of psi of each term in units of t A q/S, `(2, terms)`."""
    p, d = _core(s, q, x, y)
    g = 1.0 / (p * d)
    return jnp.stack([x * (p + q**2 * s) * g, y * (p + s) * g])


def _field(s: Array, q: Array, x: Array, y: Array) -> Array:
    """Gradient, and second derivatives (xx, xy, yy) in units of A q/S, `(5, terms)`."""
    p, d = _core(s, q, x, y)
    inv_p, inv_d = 1.0 / p, 1.0 / d
    g_x = x * (p + q**2 * s) * inv_p * inv_d
    g_y = y * (p + s) * inv_p * inv_d
    k = s * q**2 * inv_p**3
    xx = (1.0 + k * (q**2 * s**2 + y**2)) * inv_d - 2.0 * g_x**2
    xy = -k * x * y * inv_d - 2.0 * g_x * g_y
    yy = (1.0 + k * (s**2 + x**2)) * inv_d - 2.0 * g_y**2
    return jnp.stack([g_x, g_y, xx, xy, yy])


_TERMS = {"potential": _zeroth, "deflection": _first, "field": _field}


def _sum_terms(kind: str, name: str, q: Array, x: Array, y: Array) -> Array:
    radii, amplitudes = table(name)
    terms = _TERMS[kind](jnp.asarray(radii, q.dtype), q, x, y)
    # A matrix product over the terms, not a fused reduction: 2 to 3 times faster on CPU (measured).
    return q * (terms @ jnp.asarray(amplitudes / radii, q.dtype))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _sum(kind: str, name: str, q: Array, x: Array, y: Array) -> Array:
    """The tabulated sum in units of t = r_s/sqrt(q), with a derivative that differentiates it thrice.

    A Jacobian asks for many directions (r_s, e, centre, position angle), which all reach the terms
    through q, x and y alone: three partials serve all of them.
    """
    return _sum_terms(kind, name, q, x, y)


@_sum.defjvp
def _sum_jvp(
    kind: str, name: str, primals: tuple[Array, ...], tangents: tuple[Array, ...]
) -> tuple[Array, Array]:
    along = partial(jax.jvp, partial(_sum_terms, kind, name), primals)
    partials = jax.vmap(lambda *direction: along(direction)[1])(*jnp.eye(3, dtype=primals[0].dtype))
    return _sum(kind, name, *primals), jnp.stack(tangents) @ partials


def _scaled(r_s: Scalar, e: Scalar, point: Point) -> tuple[Array, Array, Array, Array]:
    q = 1.0 - e
    t = r_s / jnp.sqrt(q)
    return t, q, point[0] / t, point[1] / t


def potential(name: str, r_s: Scalar, e: Scalar, point: Point) -> Scalar:
    """psi of the tabulated convergence at one point, arcsec^2; zero at the centre.

    Args:
        name: `"nfw"` or `"hernquist"`.
        r_s: scale radius, arcsec.
        e: ellipticity 1 - b/a of the convergence, in [0, 1).
        point: position in the profile's frame, `(2,)`, arcsec.
    """
    t, *args = _scaled(r_s, e, point)
    return t**2 * _sum("potential", name, *args)[0]


def deflection(name: str, r_s: Scalar, e: Scalar, point: Point) -> tuple[Scalar, Scalar]:
    """Gradient of `potential`, arcsec."""
    t, *args = _scaled(r_s, e, point)
    alpha = t * _sum("deflection", name, *args)
    return alpha[0], alpha[1]


def field(name: str, r_s: Scalar, e: Scalar, point: Point) -> tuple[Scalar, ...]:
    """Gradient [arcsec] and second derivatives (xx, xy, yy) of `potential`."""
    t, *args = _scaled(r_s, e, point)
    a_x, a_y, xx, xy, yy = _sum("field", name, *args)
    return t * a_x, t * a_y, xx, xy, yy
