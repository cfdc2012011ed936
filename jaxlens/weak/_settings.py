"""What a reconstruction can be asked for: the five schemes, and numbers that are checked once."""

import operator as _operator
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxlens._types import Array

MASKS = ("binary", "cosine", "sigmoid")
SOLVERS = ("picard", "gmres")


class Scheme(NamedTuple):
    """One row of `SCHEMES`.

    Attributes:
        invert: linear inversion, `"ks"` or `"akra"`.
        mask: `"binary"` (weight > 0), `"cosine"` (falls to 0 within two pixels of a masked one) or
            `"sigmoid"` (falls with |g| at 0.5).
        start: first convergence, `"zero"` or `"model"` (the caller's).
    """

    invert: str
    mask: str
    start: str


SCHEMES: dict[str, Scheme] = {
    "K1": Scheme("ks", "binary", "zero"),
    "K2": Scheme("ks", "cosine", "zero"),
    "A1": Scheme("akra", "binary", "zero"),
    "A2": Scheme("akra", "cosine", "zero"),
    "A3": Scheme("akra", "cosine", "model"),
}
"""The names of Shi et al. (2026) in our reading, of which only the abstract was open to us.

It names two modifications of the plain iteration: smooth masks where the shear is strong, and a model-derived
first guess. K and A share the digits 1 and 2, so "2" is taken as the first modification and A3 as the second
added to it. The paper uses A2 and K2 with a binary mask; binary and smooth masks agree within 0.003 in the
mass-sheet factor, and the first guess does not move the fixed point.
"""


def scheme_of(name: str) -> Scheme:
    """The row of a name."""
    if name not in SCHEMES:
        raise ValueError(f"`scheme` is {name!r}; give one of {', '.join(SCHEMES)}.")
    return SCHEMES[name]


def real(name: str, value: Any) -> float:
    """A setting as a Python float, whatever scalar it came as.

    Raises:
        TypeError: for a traced value, or what is no number.
    """
    if isinstance(value, Tracer):
        raise TypeError(
            f"`{name}` is traced by jit, grad or vmap; settings are plain numbers: make it static."
        )
    try:
        return float(value)
    except (TypeError, ValueError):
        raise TypeError(f"`{name}` is {value!r}; give a number.") from None


def whole(name: str, value: Any, least: int, remedy: str) -> int:
    """A setting as a Python int, at least `least`."""
    if isinstance(value, Tracer):
        raise TypeError(f"`{name}` is traced by jit, grad or vmap; it sets a length: make it static.")
    try:
        number = _operator.index(value)
    except TypeError:
        raise TypeError(f"`{name}` is {value!r}; give a whole number.") from None
    if number < least:
        raise ValueError(f"`{name}` is {number}; {remedy}.")
    return number


class Settings(eqx.Module):
    """Settings of one reconstruction, checked; a change of one that is an array compiles nothing anew.

    Attributes:
        scheme, mask, solver: names.
        n_iter, power_steps, cg_steps: lengths.
        b_mode: whether the B mode is wanted.
        ridge, tol, cg_tol: `()`.
        smoothing: standard deviation, arcsec, `()`; None for none.
    """

    scheme: str = eqx.field(static=True)
    mask: str = eqx.field(static=True)
    solver: str = eqx.field(static=True)
    n_iter: int = eqx.field(static=True)
    power_steps: int = eqx.field(static=True)
    cg_steps: int = eqx.field(static=True)
    b_mode: bool = eqx.field(static=True)
    ridge: Array
    tol: Array
    cg_tol: Array
    smoothing: Array | None


def settings(
    dtype: Any,
    *,
    scheme: str = "A2",
    mask: str | None = None,
    solver: str = "picard",
    n_iter: Any = 5,
    power_steps: Any = 0,
    cg_steps: Any = 400,
    b_mode: bool = True,
    ridge: Any = 1e-2,
    tol: Any = 1e-3,
    cg_tol: Any = 1e-4,
    smoothing: Any = 15.0,
) -> Settings:
    """Checked settings; numbers become arrays of the real type `dtype`.

    Raises:
        ValueError: for a name or number that no reconstruction can use.
        TypeError: for traced values and what is no number.
    """
    row = scheme_of(scheme)
    kind = mask or row.mask
    if kind not in MASKS:
        raise ValueError(f"`mask` is {kind!r}; give one of {MASKS}.")
    if solver not in SOLVERS:
        raise ValueError(f"`solver` is {solver!r}; give one of {SOLVERS}.")
    numbers = {
        "ridge": real("ridge", ridge),
        "tol": real("tol", tol),
        "cg_tol": real("cg_tol", cg_tol),
        "smoothing": real("smoothing", smoothing),
    }
    for name, good, remedy in (
        (
            "ridge",
            row.invert == "ks" or 0.0 < numbers["ridge"] < np.inf,
            "a positive number, 1e-2 for noisy data",
        ),
        ("tol", numbers["tol"] > 0.0, "the largest last change of a converged map, > 0"),
        ("cg_tol", 0.0 < numbers["cg_tol"] < 1.0, "the factor that reduces the residual, between 0 and 1"),
        ("smoothing", 0.0 <= numbers["smoothing"] < np.inf, "the standard deviation of the Gaussian, >= 0"),
    ):
        if not good:
            raise ValueError(f"`{name}` is {numbers[name]}; give {remedy}.")
    width = numbers["smoothing"]
    return Settings(
        scheme=scheme,
        mask=kind,
        solver=solver,
        n_iter=whole("n_iter", n_iter, 1, "give at least one iteration"),
        power_steps=whole("power_steps", power_steps, 0, "give 0 or more steps"),
        cg_steps=whole("cg_steps", cg_steps, 1, "give at least one step"),
        b_mode=b_mode,
        ridge=jnp.asarray(numbers["ridge"], dtype),
        tol=jnp.asarray(numbers["tol"], dtype),
        cg_tol=jnp.asarray(numbers["cg_tol"], dtype),
        smoothing=None if width == 0.0 else jnp.asarray(width, dtype),
    )
