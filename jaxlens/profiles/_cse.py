"""Sums of cored steep ellipsoids (CSE): closed forms for any convergence kappa(zeta).

Oguri 2021 (PASP 133, 074504): kappa(zeta) = sum_i A_i / [2 (S_i^2 + zeta^2)^(3/2)], with
zeta^2 = (q x^2 + y^2/q)/r_s^2. In units of t = r_s/sqrt(q) each term has, with
P^2 = q^2 (S^2 + X^2) + Y^2 and D = (P + S)^2 + (1 - q^2) X^2 = X^2 + Y^2 + 2 P S + (1 + q^2) S^2,

    psi = A q/(2S) ln D - (A q/S) ln[(1+q) S],
    alpha_X = A q X (P + q^2 S)/(S P D),   alpha_Y = A q Y (P + S)/(S P D).

There is no branch at q = 1 and nothing is singular at the centre. X and Y leave the sums: with r = S/P and
v = 1/D, all first and second derivatives follow from seven sums over the terms (weights A/S),

    (S_0, S_1) = sum v (1, r),   (T_0, T_1, T_2) = sum v^2 (1, r, r^2),   (U_1, U_3) = sum v r/P^2 (1, S^2),

alpha_X/q = X (S_0 + q^2 S_1), alpha_Y/q = Y (S_0 + S_1), and psi_XX and the others as in `_field`: one square
root and two divisions a term.
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


_UNROLL = 2
# Terms added in one step of the loop over them: as fast as 4 to a tenth, compiled as soon as 1 (measured).


@jax.custom_jvp
def _root(u: Array) -> tuple[Array, Array]:
    """sqrt(u) and 1/sqrt(u), with derivatives that divide no further."""
    p = jnp.sqrt(u)
    return p, 1.0 / p


@_root.defjvp
def _root_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    p, inverse = _root(*primals)
    slope = 0.5 * inverse * tangents[0]
    return (p, inverse), (slope, -(inverse**2) * slope)


@jax.custom_jvp
def _inverse(d: Array) -> Array:
    """1/d, with a derivative that does not divide again."""
    return 1.0 / d


@_inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    v = _inverse(*primals)
    return v, -(v**2) * tangents[0]


def _core(s: Array, q: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """1/P, r = S/P and v = 1/D of one term."""
    p, inverse = _root(q**2 * (s**2 + x**2) + y**2)
    return inverse, s * inverse, _inverse(x**2 + y**2 + 2.0 * p * s + (1.0 + q**2) * s**2)


def _zeroth_term(s: Array, q: Array, x: Array, y: Array) -> tuple[Array, ...]:
    """psi of one term in units of t^2 A q/S; zero at the centre."""
    p = jnp.sqrt(q**2 * (s**2 + x**2) + y**2)
    d = x**2 + y**2 + 2.0 * p * s + (1.0 + q**2) * s**2
    return (0.5 * jnp.log(d / ((1.0 + q) * s) ** 2),)


def _first_term(s: Array, q: Array, x: Array, y: Array) -> tuple[Array, ...]:
    """What one term adds to S_0 and S_1."""
    _, r, v = _core(s, q, x, y)
    return v, v * r


def _field_term(s: Array, q: Array, x: Array, y: Array) -> tuple[Array, ...]:
    """What one term adds to S_0, S_1, T_0, T_1, T_2, U_1 and U_3."""
    inverse, r, v = _core(s, q, x, y)
    vr, v2 = v * r, v**2
    u = vr * inverse**2
    return v, vr, v2, v2 * r, vr**2, u, u * s**2


def _zeroth(q: Array, x: Array, y: Array, psi: Array) -> Array:
    """psi in units of t^2 A/S, `(1,)`."""
    del x, y
    return jnp.stack([q * psi])


def _first(q: Array, x: Array, y: Array, s_0: Array, s_1: Array) -> Array:
    """Gradient of psi in units of t A/S, `(2,)`."""
    return q * jnp.stack([x * (s_0 + q**2 * s_1), y * (s_0 + s_1)])


def _field(q: Array, x: Array, y: Array, *sums: Array) -> Array:
    """Gradient, and second derivatives (xx, xy, yy) in units of A/S, `(5,)`."""
    s_0, s_1, t_0, t_1, t_2, u_1, u_3 = sums
    q2 = q**2
    xx = s_0 + q2 * (y**2 * u_1 + q2 * u_3) - 2.0 * x**2 * (t_0 + q2 * (2.0 * t_1 + q2 * t_2))
    xy = -x * y * (q2 * u_1 + 2.0 * (t_0 + (1.0 + q2) * t_1 + q2 * t_2))
    yy = s_0 + q2 * (x**2 * u_1 + u_3) - 2.0 * y**2 * (t_0 + 2.0 * t_1 + t_2)
    return q * jnp.stack([x * (s_0 + q2 * s_1), y * (s_0 + s_1), xx, xy, yy])


_TERMS = {
    "potential": (_zeroth_term, _zeroth, 1),
    "deflection": (_first_term, _first, 2),
    "field": (_field_term, _field, 7),
}


def _sum_terms(kind: str, name: str, q: Array, x: Array, y: Array) -> Array:
    radii, amplitudes = table(name)
    term, assemble, count = _TERMS[kind]
    dtype = jnp.result_type(q, x, y)

    def add(total: tuple[Array, ...], each: tuple[Array, Array]) -> tuple[tuple[Array, ...], None]:
        s, weight = each
        return tuple(t + weight * one for t, one in zip(total, term(s, q, x, y), strict=True)), None

    # Term by term at all positions of a tile: the sums stay in cache, and the loop takes 0.7 of the time
    # of a product of a matrix of all terms with their weights (measured on a CPU).
    terms = jnp.asarray(radii, dtype), jnp.asarray(amplitudes / radii, dtype)
    sums = jax.lax.scan(add, (jnp.zeros((), dtype),) * count, terms, unroll=_UNROLL)[0]
    return assemble(q, x, y, *sums)


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
