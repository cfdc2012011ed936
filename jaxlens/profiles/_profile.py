"""What a mass profile is: a pytree of numbers and the pure functions registered for its type.

Every function is written for one profile at one point of the profile's own frame: centre at the
origin, major axis along x, strength for D_LS/D_S = 1. Scaling to a source redshift, rotation,
translation and sums over many profiles are the business of `jaxlens.lens`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxlens._types import Array, Point, Scalar

P = TypeVar("P")

Potential = Callable[[Any, Point], Scalar]
Deflection = Callable[[Any, Point], tuple[Scalar, Scalar]]
Field = Callable[[Any, Point], tuple[Scalar, ...]]


def as_float(x: Any) -> Array:
    """`x` as a floating-point array of the current default precision or its own."""
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


@dataclass(frozen=True)
class Profile:
    """The functions of one mass profile.

    Attributes:
        name: lower-case name, as configuration files spell it.
        params: the `eqx.Module` type that holds the numbers.
        potential: `(params, x (2,)) -> psi`, arcsec^2.
        deflection: `(params, x) -> (alpha_x, alpha_y)`, arcsec.
        field: `(params, x) -> (alpha_x, alpha_y, psi_xx, psi_xy, psi_yy)`.
        kappa: closed form of the convergence for the tests, or None.
        strength: name of the field to which psi is proportional, or None.
        singular: True when the value at the centre is infinite or undefined.
        example: a function that makes a valid single parameter set.
    """

    name: str
    params: type
    potential: Potential
    deflection: Deflection
    field: Field
    kappa: Potential | None
    strength: str | None
    singular: bool
    example: Callable[[], Any]


PROFILES: dict[type, Profile] = {}


def _deflection_from(potential: Potential) -> Deflection:
    def deflection(p: Any, x: Point) -> tuple[Scalar, Scalar]:
        gradient = jax.grad(potential, argnums=1)(p, x)
        return gradient[0], gradient[1]

    return deflection


def _field_from(deflection: Deflection) -> Field:
    def field(p: Any, x: Point) -> tuple[Scalar, ...]:
        def along(direction: Array) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
            return jax.jvp(lambda y: deflection(p, y), (x,), (direction,))

        basis = jnp.eye(2, dtype=x.dtype)
        alpha, (xx, xy) = along(basis[0])
        _, (_, yy) = along(basis[1])
        return *alpha, xx, xy, yy

    return field


def register(
    params: type[P],
    *,
    potential: Callable[[P, Point], Scalar],
    example: Callable[[], P],
    deflection: Callable[[P, Point], tuple[Scalar, Scalar]] | None = None,
    field: Callable[[P, Point], tuple[Scalar, ...]] | None = None,
    kappa: Callable[[P, Point], Scalar] | None = None,
    strength: str | None = None,
    singular: bool = False,
) -> Profile:
    """Make a mass profile known to the package.

    Args:
        params: frozen `eqx.Module` type whose fields are all floating-point arrays of shape `(*n)`.
        potential: psi for D_LS/D_S = 1 at one point of the profile's frame, arcsec^2.
        example: function that returns a valid parameter set (called only by tests and docs, so that
            nothing is computed at import).
        deflection: closed form of grad psi; by automatic differentiation if absent.
        field: closed form of (alpha_x, alpha_y, psi_xx, psi_xy, psi_yy); by automatic differentiation
            of the deflection if absent.
        kappa: closed form of the convergence, used by the tests only.
        strength: field to which psi is proportional; derivatives with respect to it are then free.
        singular: True exempts the profile from the test of values at its centre.

    Returns:
        The record now in `PROFILES[params]`.

    Raises:
        ValueError: if the type is registered already, or `strength` is not one of its fields.
    """
    if params in PROFILES:
        raise ValueError(f"{params.__name__} is registered already; give your profile a type of its own.")
    names = list(getattr(params, "__dataclass_fields__", {}))
    if strength is not None and strength not in names:
        raise ValueError(f"`strength` is {strength!r}, but {params.__name__} has the fields {names}.")
    if deflection is None:
        deflection = _deflection_from(potential)
    if field is None:
        field = _field_from(deflection)
    record = Profile(
        name=params.__name__.lower(),
        params=params,
        potential=potential,
        deflection=deflection,
        field=field,
        kappa=kappa,
        strength=strength,
        singular=singular,
        example=example,
    )
    PROFILES[params] = record
    return record


def profile_of(params: Any) -> Profile:
    """The record for a parameter set.

    Raises:
        TypeError: if the type was never registered.
    """
    record = PROFILES.get(type(params))
    if record is None:
        known = sorted(entry.name for entry in PROFILES.values())
        raise TypeError(
            f"{type(params).__name__} is not a registered mass profile (known: {', '.join(known)}). "
            "Call `jaxlens.profiles.register` in the file that defines it."
        )
    return record
