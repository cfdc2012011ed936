"""n mass profiles of one kind, stacked, and their sum at many positions.

The sum has a derivative rule of its own: the partial derivatives of each profile, computed once for all
directions of a Jacobian.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxlens._types import Array, Float
from jaxlens.profiles import Profile, profile_of
from jaxlens.profiles._profile import as_float

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


_SIZES = {"potential": 1, "deflection": 2, "field": 5}


def _in_frame(kind: str, params: Any, x: Array) -> tuple[Array, ...]:
    """One profile at one point of its own frame; the kinds are those of `_SIZES`."""
    return _traced_once(kind, profile_of(params), params, x)


@partial(jax.jit, static_argnums=(0, 1))
def _traced_once(kind: str, record: Profile, params: Any, x: Array) -> tuple[Array, ...]:
    """A program of its own, so that a profile is traced once for all programs that hold it."""
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
def sum_of(kind: str, component: Component, theta: Array) -> tuple[Array, ...]:
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
) -> tuple[tuple[Array, ...], Array]:
    """One profile's contribution, a tuple of `(i,)`, and its derivatives, `(directions, size, i)`.

    The directions are the parameters `fields`, then (if `moves`) the two coordinates of the centre,
    then (if `turns`) the position angle. Centre and angle act through the coordinates of the frame.
    """
    strength = profile_of(params).strength
    x, c, s = _frame(centre, pa, theta)
    at = jax.vmap(partial(_in_frame, kind), in_axes=(None, 0))
    # psi is proportional to the strength: all is worked out for unit strength, where the value is itself the
    # derivative with respect to the strength.
    amount, unit = jnp.ones_like(pa), params
    if strength is not None:
        amount = getattr(params, strength)
        unit = eqx.tree_at(lambda p: getattr(p, strength), params, jnp.ones_like(pa))
    bent = [name for name in fields if name != strength]

    def displaced(shifts: Array) -> tuple[Array, ...]:
        values = [getattr(unit, name) + shift for name, shift in zip(bent, shifts[2:], strict=True)]
        there = eqx.tree_at(lambda p: [getattr(p, name) for name in bent], unit, values) if bent else unit
        return at(there, x + shifts[None, :2])

    directions = jnp.eye(2 + len(bent), dtype=theta.dtype)[0 if moves or turns else 2 :]
    slopes, in_sky = (), ()
    if len(directions):
        rest = jnp.zeros(2 + len(bent), theta.dtype)
        along = jax.vmap(lambda v: jax.jvp(displaced, (rest,), (v,)), out_axes=(None, 0))
        value, slopes = along(directions)
        slopes = tuple(amount * part for part in slopes)
        in_sky = _turn(slopes, c, s)
    else:
        value = at(unit, x)
    turned = _turn(value, c, s)
    found = {strength: turned}
    for index, name in enumerate(bent, start=len(directions) - len(bent)):
        found[name] = tuple(part[index] for part in in_sky)
    columns = [jnp.stack(found[name]) for name in fields]
    if moves:
        along_x, along_y = (jnp.stack([part[k] for part in in_sky]) for k in (0, 1))
        columns += [-c * along_x + s * along_y, -s * along_x - c * along_y]
    if turns:
        inner = [part[0] * x[:, 1] - part[1] * x[:, 0] for part in slopes]
        unturned, step = tuple(amount * part for part in value), jnp.ones_like(pa)
        twist = jax.jvp(lambda u: _turn(unturned, jnp.cos(u), jnp.sin(u)), (pa,), (step,))[1]
        columns.append(jnp.stack(twist) + jnp.stack(_turn(tuple(inner), c, s)))
    return tuple(amount * part for part in turned), jnp.stack(columns)


@partial(sum_of.defjvp, symbolic_zeros=True)
def _sum_jvp(kind: str, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    """Tangent of `sum_of` from the partial derivatives of each profile.

    The partials do not depend on the direction, so a Jacobian over many free numbers computes them
    once and contracts them with all directions in one matrix product; numbers that do not depend on
    any free one (their tangent is a symbolic zero) are never differentiated. Members that share two
    free numbers therefore cost two derivatives, however many parameters the whole model has.
    """
    component, theta = primals
    moved, d_theta = tangents

    def varies(tangent: Any) -> bool:
        return not isinstance(tangent, SymbolicZero)

    fields = tuple(
        name for name in component.params.__dataclass_fields__ if varies(getattr(moved.params, name))
    )
    moves, turns = varies(moved.centre) or varies(d_theta), varies(moved.pa)
    if not (fields or moves or turns):
        value = sum_of(kind, component, theta)
        return value, tuple(jnp.zeros_like(v) for v in value)
    each, partials = jax.vmap(partial(_partials, kind, fields, moves, turns), in_axes=(0, 0, 0, None))(
        component.params, component.centre, component.pa, theta
    )  # (n, i) of each part, and (n, directions, size, i)
    value = tuple(part.sum(axis=0) for part in each)
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
