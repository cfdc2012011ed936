"""Lenses: stacked profiles on the sky, and what they do to light.

A lens knows no source redshift. psi, alpha, kappa and gamma are for D_LS/D_S = 1; functions that
need a source take its distance ratio `dls_ds`. Functions accept any leading shape of positions,
`theta (..., 2)`, are differentiable in all their float arguments, and keep the memory of large maps
bounded by working through tiles of `TILE` positions.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxlens._types import Array, Float, Hessian, Points, ScalarLike, Spin2, Values
from jaxlens.cosmology import LensPlane
from jaxlens.profiles import profile_of
from jaxlens.profiles._profile import as_float

TILE = 1024
"""Positions worked on at a time: the intermediates of one tile stay in a core's cache (measured)."""

_UNROLL = 4
# Up to this many profiles are evaluated side by side; more are scanned one by one, so that neither
# compile time nor memory grows with the number of members.


class Component(eqx.Module):
    """n mass profiles of one kind.

    Numbers of different length are broadcast against each other, so that two haloes with a common
    position angle need it once.

    Attributes:
        params: parameter set of a registered profile, every field `(n,)`.
        centre: positions, `(n, 2)`, arcsec.
        pa: position angles from +theta_1 towards +theta_2, `(n,)`, rad.
    """

    params: Any
    centre: Float[Array, "n 2"]
    pa: Float[Array, " n"]

    def __init__(self, params: Any, centre: Any = (0.0, 0.0), pa: Any = 0.0):
        profile_of(params)
        centre, pa = as_float(centre), as_float(pa)
        if centre.shape[-1:] != (2,):
            raise ValueError(f"`centre` has shape {centre.shape}; its last axis must be (theta_1, theta_2).")
        shapes = [leaf.shape for leaf in jax.tree.leaves(params)] + [centre.shape[:-1], pa.shape, (1,)]
        try:
            shape = jnp.broadcast_shapes(*shapes)
        except ValueError as error:
            raise ValueError(
                f"Fields of lengths {shapes} cannot describe the same number of profiles."
            ) from error
        if len(shape) != 1:
            raise ValueError(f"Fields broadcast to shape {shape}; a component has one axis, its profiles.")
        self.params = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape), params)
        self.centre = jnp.broadcast_to(centre, (*shape, 2))
        self.pa = jnp.broadcast_to(pa, shape)

    def __len__(self) -> int:
        return self.pa.shape[0]


class Lens(eqx.Module):
    """A sum of components by name, e.g. `halo`, `bcg`, `members`.

    Attributes:
        components: the components; names carry no meaning.
    """

    components: dict[str, Component]

    def __init__(self, components: Mapping[str, Component] | None = None, **more: Component):
        self.components = {**(components or {}), **more}
        if not self.components:
            raise ValueError("A lens needs at least one component.")


# --- one component at many positions -----------------------------------------------------------


_SIZES = {"potential": 1, "deflection": 2, "field": 5}


def _in_frame(kind: str, params: Any, x: Array) -> tuple[Array, ...]:
    """One profile at one point of its own frame; the kinds are those of `_SIZES`."""
    record = profile_of(params)
    if kind == "potential":
        return (record.potential(params, x),)
    return getattr(record, kind)(params, x)


def _turn(parts: tuple[Array, ...], c: Array, s: Array) -> tuple[Array, ...]:
    """Potential, deflection or field from the profile's frame to the sky, for position angle (c, s)."""
    if len(parts) == 1:
        return parts
    a_x, a_y, *second = parts
    first = (c * a_x - s * a_y, s * a_x + c * a_y)
    if not second:
        return first
    xx, xy, yy = second
    cc, ss, cs = c * c, s * s, c * s
    return (
        *first,
        cc * xx - 2.0 * cs * xy + ss * yy,
        cs * (xx - yy) + (cc - ss) * xy,
        ss * xx + 2.0 * cs * xy + cc * yy,
    )


def _frame(centre: Array, pa: Array, theta: Array) -> tuple[Array, Array, Array]:
    """Positions `(i, 2)` in a profile's frame, and cosine and sine of its position angle."""
    c, s = jnp.cos(pa), jnp.sin(pa)
    d_x, d_y = theta[:, 0] - centre[0], theta[:, 1] - centre[1]
    return jnp.stack([c * d_x + s * d_y, c * d_y - s * d_x], axis=-1), c, s


def _one(kind: str, params: Any, centre: Array, pa: Array, theta: Array) -> tuple[Array, ...]:
    """One profile at positions `(i, 2)` of the sky: a tuple of `(i,)`."""
    x, c, s = _frame(centre, pa, theta)
    return _turn(jax.vmap(partial(_in_frame, kind, params))(x), c, s)


def _sum_plain(kind: str, component: Component, theta: Array) -> tuple[Array, ...]:
    each = (component.params, component.centre, component.pa)
    if len(component) <= _UNROLL:
        every = jax.vmap(lambda one: _one(kind, one[0], one[1], one[2], theta))
        parts = every(each)
        return tuple(part.sum(axis=0) for part in parts)

    def add(total: tuple[Array, ...], one: Any) -> tuple[tuple[Array, ...], None]:
        return tuple(
            t + p for t, p in zip(total, _one(kind, one[0], one[1], one[2], theta), strict=True)
        ), None

    zero = jnp.zeros(theta.shape[:1], theta.dtype)
    return jax.lax.scan(add, (zero,) * _SIZES[kind], each)[0]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sum(kind: str, component: Component, theta: Array) -> tuple[Array, ...]:
    """Sum over a component's profiles at positions `(i, 2)`: a tuple of `(i,)`."""
    return _sum_plain(kind, component, theta)


def _partials(
    kind: str,
    fields: tuple[str, ...],
    moves: bool,
    turns: bool,
    params: Any,
    centre: Array,
    pa: Array,
    theta: Array,
) -> Array:
    """Derivatives of one profile's contribution, `(directions, size, i)`.

    The directions are the parameters `fields`, then (if `moves`) the two coordinates of the centre,
    then (if `turns`) the position angle. Centre and angle act through the coordinates of the frame.
    """
    strength = profile_of(params).strength
    x, c, s = _frame(centre, pa, theta)
    at = jax.vmap(partial(_in_frame, kind), in_axes=(None, 0))
    found: dict[str, tuple[Array, ...]] = {}
    bent = [name for name in fields if name != strength]
    if strength in fields:
        # psi is proportional to the strength: its derivative is the profile of unit strength.
        found[strength] = _turn(
            at(eqx.tree_at(lambda p: getattr(p, strength), params, jnp.ones_like(pa)), x), c, s
        )

    def displaced(shifts: Array) -> tuple[Array, ...]:
        values = [getattr(params, name) + shift for name, shift in zip(bent, shifts[2:], strict=True)]
        there = eqx.tree_at(lambda p: [getattr(p, name) for name in bent], params, values) if bent else params
        return at(there, x + shifts[None, :2])

    directions = jnp.eye(2 + len(bent), dtype=theta.dtype)[0 if moves or turns else 2 :]
    slopes, in_sky = (), ()
    if len(directions):
        rest = jnp.zeros(2 + len(bent), theta.dtype)
        slopes = jax.vmap(lambda v: jax.jvp(displaced, (rest,), (v,))[1])(directions)
        in_sky = _turn(slopes, c, s)
        for index, name in enumerate(bent, start=len(directions) - len(bent)):
            found[name] = tuple(part[index] for part in in_sky)
    columns = [jnp.stack(found[name]) for name in fields]
    if moves:
        along_x, along_y = (jnp.stack([part[k] for part in in_sky]) for k in (0, 1))
        columns += [-c * along_x + s * along_y, -s * along_x - c * along_y]
    if turns:
        inner = [part[0] * x[:, 1] - part[1] * x[:, 0] for part in slopes]
        unturned, step = at(params, x), jnp.ones_like(pa)
        twist = jax.jvp(lambda u: _turn(unturned, jnp.cos(u), jnp.sin(u)), (pa,), (step,))[1]
        columns.append(jnp.stack(twist) + jnp.stack(_turn(tuple(inner), c, s)))
    return jnp.stack(columns)


@partial(_sum.defjvp, symbolic_zeros=True)
def _sum_jvp(kind: str, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    """Tangent of `_sum` from the partial derivatives of each profile.

    The partials do not depend on the direction, so a Jacobian over many free numbers computes them
    once and contracts them with all directions in one matrix product; numbers that do not depend on
    any free one (their tangent is a symbolic zero) are never differentiated. Members that share two
    free numbers therefore cost two derivatives, however many parameters the whole model has.
    """
    component, theta = primals
    moved, d_theta = tangents

    def varies(tangent: Any) -> bool:
        return not isinstance(tangent, SymbolicZero)

    value = _sum(kind, component, theta)
    fields = tuple(
        name for name in component.params.__dataclass_fields__ if varies(getattr(moved.params, name))
    )
    moves, turns = varies(moved.centre) or varies(d_theta), varies(moved.pa)
    if not (fields or moves or turns):
        return value, tuple(jnp.zeros_like(v) for v in value)
    partials = jax.vmap(partial(_partials, kind, fields, moves, turns), in_axes=(0, 0, 0, None))(
        component.params, component.centre, component.pa, theta
    )  # (n, directions, size, i)
    still = jnp.zeros_like(component.pa)
    weights = [getattr(moved.params, name) for name in fields]
    if moves:
        weights += [moved.centre[:, k] if varies(moved.centre) else still for k in (0, 1)]
    if turns:
        weights.append(moved.pa)
    tangent = jnp.tensordot(jnp.stack(weights, axis=1), partials, axes=2)  # (size, i)
    if varies(d_theta):
        along = partials[:, len(fields) : len(fields) + 2].sum(axis=0)
        tangent = tangent - d_theta[None, :, 0] * along[0] - d_theta[None, :, 1] * along[1]
    return value, tuple(tangent)


def _evaluate(kind: str, lens: Lens, theta: Array) -> tuple[Array, ...]:
    """Sum over components at `theta (..., 2)`: a tuple of `(...)`, tile by tile."""
    theta = as_float(theta)
    if theta.shape[-1:] != (2,):
        raise ValueError(f"`theta` has shape {theta.shape}; its last axis must be (theta_1, theta_2).")
    # One type for all: a scan over members cannot change that of its sum on the way.
    theta = theta.astype(jnp.result_type(theta, *jax.tree.leaves(lens)))
    shape, flat = theta.shape[:-1], theta.reshape(-1, 2)

    def tile(points: Array) -> tuple[Array, ...]:
        sums = [_sum(kind, component, points) for component in lens.components.values()]
        return tuple(jax.tree.reduce(jnp.add, list(parts)) for parts in zip(*sums, strict=True))

    count = flat.shape[0]
    if count <= TILE:
        parts = tile(flat)
    else:
        padded = jnp.pad(flat, ((0, -count % TILE), (0, 0)), mode="edge")
        # Reverse mode evaluates a tile again instead of keeping the partial derivatives of all of them.
        parts = jax.lax.map(jax.checkpoint(tile), padded.reshape(-1, TILE, 2))
        parts = tuple(part.reshape(-1)[:count] for part in parts)
    return tuple(part.reshape(shape) for part in parts)


# --- the lens ----------------------------------------------------------------------------------


def psi(lens: Lens, theta: Points) -> Values:
    """Lens potential for D_LS/D_S = 1.

    Args:
        lens: the lens.
        theta: positions, `(..., 2)`, arcsec.

    Returns:
        psi, `(...)`, arcsec^2.
    """
    return _evaluate("potential", lens, theta)[0]


def alpha(lens: Lens, theta: Points) -> Points:
    """Deflection grad psi for D_LS/D_S = 1, `(..., 2)`, arcsec, at `theta (..., 2)`, arcsec."""
    return jnp.stack(_evaluate("deflection", lens, theta), axis=-1)


def alpha_and_hessian(lens: Lens, theta: Points) -> tuple[Points, Hessian]:
    """Deflection `(..., 2)` [arcsec] and Hessian of psi `(..., 2, 2)`, both for D_LS/D_S = 1.

    Cheaper than the two apart. `theta` is `(..., 2)`, arcsec.
    """
    a_x, a_y, xx, xy, yy = _evaluate("field", lens, theta)
    hessian = jnp.stack([jnp.stack([xx, xy], axis=-1), jnp.stack([xy, yy], axis=-1)], axis=-2)
    return jnp.stack([a_x, a_y], axis=-1), hessian


def kappa_and_gamma(lens: Lens, theta: Points) -> tuple[Values, Spin2]:
    """Convergence and complex shear for D_LS/D_S = 1, each `(...)`, at `theta (..., 2)`, arcsec."""
    _, _, xx, xy, yy = _evaluate("field", lens, theta)
    return 0.5 * (xx + yy), 0.5 * (xx - yy) + 1j * xy


def kappa(lens: Lens, theta: Points) -> Values:
    """Convergence (psi_11 + psi_22)/2 for D_LS/D_S = 1, `(...)`, at `theta (..., 2)`, arcsec."""
    return kappa_and_gamma(lens, theta)[0]


def gamma(lens: Lens, theta: Points) -> Spin2:
    """Complex shear (psi_11 - psi_22)/2 + i psi_12 for D_LS/D_S = 1, `(...)`, at `theta (..., 2)`, arcsec."""
    return kappa_and_gamma(lens, theta)[1]


def _per_point(dls_ds: ScalarLike | Array, extra: int) -> Array:
    ratio = as_float(dls_ds)
    return ratio.reshape(ratio.shape + (1,) * extra) if ratio.ndim else ratio


def ray_trace(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Points:
    """Source positions beta = theta - (D_LS/D_S) alpha(theta).

    Args:
        lens: the lens.
        theta: image positions, `(..., 2)`, arcsec.
        dls_ds: distance ratio of the source, scalar or `(...)`.

    Returns:
        beta, `(..., 2)`, arcsec.
    """
    return as_float(theta) - _per_point(dls_ds, 1) * alpha(lens, theta)


def source_and_jacobian(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> tuple[Points, Hessian]:
    """beta `(..., 2)` [arcsec] and A = d beta/d theta `(..., 2, 2)` in one evaluation; see `ray_trace`."""
    deflection, hessian = alpha_and_hessian(lens, theta)
    beta = as_float(theta) - _per_point(dls_ds, 1) * deflection
    identity = jnp.broadcast_to(jnp.eye(2, dtype=hessian.dtype), hessian.shape)
    return beta, identity - _per_point(dls_ds, 2) * hessian


def jacobian(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Hessian:
    """A = d beta/d theta, `(..., 2, 2)`; arguments as for `ray_trace`."""
    return source_and_jacobian(lens, theta, dls_ds)[1]


def mu(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Values:
    """Signed magnification 1/det A = 1/[(1-kappa)^2 - |gamma|^2], `(...)`; arguments as for `ray_trace`."""
    k, g = kappa_and_gamma(lens, theta)
    ratio = as_float(dls_ds)
    return 1.0 / ((1.0 - ratio * k) ** 2 - ratio**2 * (g.real**2 + g.imag**2))


def reduced_shear(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Spin2:
    """Complex reduced shear g = gamma/(1 - kappa), `(...)`; arguments as for `ray_trace`."""
    k, g = kappa_and_gamma(lens, theta)
    ratio = as_float(dls_ds)
    return ratio * g / (1.0 - ratio * k)


def fermat_potential(lens: Lens, theta: Points, dls_ds: ScalarLike | Values) -> Values:
    """|theta - beta|^2/2 - (D_LS/D_S) psi at the image positions `theta`, `(...)`, arcsec^2.

    beta is the source of each position itself; arguments as for `ray_trace`.
    """
    ratio = as_float(dls_ds)
    deflection = _per_point(ratio, 1) * alpha(lens, theta)
    return 0.5 * jnp.sum(deflection**2, axis=-1) - ratio * psi(lens, theta)


def time_delay(lens: Lens, theta: Points, plane: LensPlane, z_s: ScalarLike | Values) -> Values:
    """Arrival time of images relative to an unlensed ray, (1+z_l)/c D_L D_S/D_LS times the Fermat potential.

    Only differences between images of one source are observable: the zero point of psi is free.

    Args:
        lens: the lens.
        theta: image positions, `(..., 2)`, arcsec.
        plane: the lens plane.
        z_s: source redshift, scalar or `(...)`.

    Returns:
        Time, `(...)`, days.
    """
    return plane.time_delay_scale(z_s) * fermat_potential(lens, theta, plane.dls_ds(z_s))


def centres(lens: Lens) -> Array:
    """Positions of all profiles of all components, `(n, 2)`, arcsec."""
    return jnp.concatenate([component.centre for component in lens.components.values()])
