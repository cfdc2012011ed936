"""Levenberg-Marquardt by optimistix, with the Jacobian formed once a step."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import optimistix as optx

from jaxlens._types import Array


def value_and_jacobian(rows: Callable[[Array], Array], u: Array) -> tuple[Array, Array]:
    """`rows(u)`, `(m,)`, and its Jacobian `(m, n)` by forward mode, all directions at once."""
    r, pushforward = jax.linearize(rows, u)
    return r, jax.vmap(pushforward, out_axes=1)(jnp.eye(len(u), dtype=r.dtype))


def linearised_program(rows: Callable[[Array], Array]) -> Callable[[Array], tuple[Array, Array]]:
    """`value_and_jacobian` of `rows` as a program: not traced again wherever a solver asks."""
    return jax.jit(partial(value_and_jacobian, rows))


def levenberg_marquardt(
    both: Callable[[Array], tuple[Array, Array]],
    u: Array,
    max_steps: int,
    *,
    rtol: float = 1e-8,
    atol: float = 1e-8,
) -> tuple[Array, Array, Array, Array]:
    """Minimise the sum of squares of residuals from u.

    The solver asks for products with the Jacobian in several places; a derivative rule that forms the
    matrix once makes all of them a matrix product, and the compiled program several times smaller.

    Args:
        both: residuals `(m,)` and their Jacobian `(m, n)` as a function of u `(n,)`; the solver calls it in
            several places, so a program of its own (`linearised_program`).
        u: start.
        max_steps: a run that reaches it is not an error.
        rtol, atol: on u and the residuals between steps.

    Returns:
        Where it ended, the steps taken, and residuals and Jacobian there.
    """

    @jax.custom_jvp
    def dense(u: Array) -> Array:
        return both(u)[0]

    @dense.defjvp
    def _rule(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        r, jacobian = both(primals[0])
        return r, jacobian @ tangents[0]

    solver = optx.LevenbergMarquardt(rtol=rtol, atol=atol)
    solution = optx.least_squares(
        lambda v, _: dense(v), solver, u, options={"jac": "fwd"}, max_steps=max_steps, throw=False
    )
    # The solver's last accepted state holds both already: forming them again would double the program.
    found = solution.state.f_info
    return solution.value, solution.stats["num_steps"], found.residual, found.jac.as_matrix()
