"""Newton's method for the lens equation: capped steps that must lower the residual, many searches at once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlens import lens as lensing
from jaxlens._types import Array
from jaxlens.lens import Lens

STEP_TOLERANCE = 1e-10
"""Newton stops when its next step is shorter than this, arcsec."""

RESIDUAL_TOLERANCE = 1e-8
"""A position whose source-plane residual exceeds this, arcsec, is never returned."""

_ROUNDING = 1e-12
# When no shorter step lowers the residual any more, a residual below this (arcsec) is the rounding
# error of the deflection, and the position as good as it can be.

_DECREASE = 0.1
# A step must lower the residual by this fraction of what a linear map would give.

_SHORTEST = 2.0**-10
# A search whose step would have to be shortened by more than this has no image to find.

_ITERATIONS, _ROUNDS = 8, 8
# After each round of iterations the searches that are still running are gathered again, so that a
# few slow ones do not hold up the rest.

_CHUNK = 256
# Searches polished together: fewer cost more per search, more do not cost less (measured).


class Search(NamedTuple):
    """Searches under way; every array `(n, ...)`."""

    theta: Array  # best position so far
    norm: Array  # its residual
    det: Array  # its det A
    step: Array  # Newton step from there, capped
    scale: Array  # fraction of the step to try next
    live: Array
    done: Array  # converged


def solve_2x2(a: Array, r: Array) -> tuple[Array, Array]:
    """a^-1 r and det a of matrices `(..., 2, 2)` and vectors `(..., 2)`; large but finite when det a = 0."""
    det = a[..., 0, 0] * a[..., 1, 1] - a[..., 0, 1] * a[..., 1, 0]
    safe = jnp.where(det == 0.0, 1e-300, det)[..., None]
    first = a[..., 1, 1] * r[..., 0] - a[..., 0, 1] * r[..., 1]
    second = a[..., 0, 0] * r[..., 1] - a[..., 1, 0] * r[..., 0]
    return jnp.stack([first, second], axis=-1) / safe, det


def _iterate(lens: Lens, s: Search, beta: Array, dls_ds: Array, cap: Array) -> Search:
    """Try one step of every live search."""
    trial = s.theta + s.scale[:, None] * s.step
    traced, a = lensing.source_and_jacobian(lens, trial, dls_ds)
    residual = beta - traced
    norm = jnp.hypot(residual[:, 0], residual[:, 1])
    better = s.live & (norm <= (1.0 - _DECREASE * s.scale) * s.norm)
    step, det = solve_2x2(a, residual)
    length = jnp.hypot(step[:, 0], step[:, 1])
    # NaN from a point where the map itself is not finite compares as False and shortens the step.
    step = jnp.where(length[:, None] > cap, step * (cap / jnp.maximum(length, cap))[:, None], step)
    scale = jnp.where(better, 1.0, 0.5 * s.scale)
    stuck = s.live & (scale < _SHORTEST)
    kept = jnp.where(better, norm, s.norm)
    done = (better & (length < STEP_TOLERANCE)) | (stuck & (kept < _ROUNDING))
    return Search(
        theta=jnp.where(better[:, None], trial, s.theta),
        norm=kept,
        det=jnp.where(better, det, s.det),
        step=jnp.where(better[:, None], step, s.step),
        scale=scale,
        live=s.live & ~done & ~stuck,
        done=s.done | done,
    )


def begin(theta: Array, live: Array) -> Search:
    """Searches that start at `theta (n, 2)`, those of them that are `live (n,)`."""
    n = theta.shape[0]
    flags = jnp.zeros(n, bool)
    return Search(theta, jnp.full(n, jnp.inf), jnp.ones(n), jnp.zeros((n, 2)), jnp.ones(n), live, flags)


def polish(lens: Lens, search: Search, beta: Array, dls_ds: Array, cap: Array) -> Search:
    """Run all live searches to their end, each for its own `beta (n, 2)` and `dls_ds (n,)`.

    Dead ones cost nothing.
    """
    n = beta.shape[0]
    chunk = min(n, _CHUNK)

    def run_chunk(index: Array, search: Search) -> Search:
        take = lambda a: a.at[index].get(mode="fill", fill_value=0)
        some, b, w = jax.tree.map(take, (search, beta, dls_ds))
        going = lambda c: c[1].live.any() & (c[0] < _ITERATIONS)
        some = jax.lax.while_loop(going, lambda c: (c[0] + 1, _iterate(lens, c[1], b, w, cap)), (0, some))[1]
        return jax.tree.map(lambda a, v: a.at[index].set(v, mode="drop"), search, some)

    def run_round(carry: tuple[Array, Search]) -> tuple[Array, Search]:
        number, search = carry
        # Index n stands for "no search": reads there give a dead one, writes are dropped.
        order = jnp.pad(jnp.nonzero(search.live, size=n, fill_value=n)[0], (0, -n % chunk), constant_values=n)
        chunks = -(-search.live.sum() // chunk)
        part = lambda i: jax.lax.dynamic_slice_in_dim(order, i * chunk, chunk)
        return number + 1, jax.lax.fori_loop(0, chunks, lambda i, s: run_chunk(part(i), s), search)

    running = lambda carry: carry[1].live.any() & (carry[0] < _ROUNDS)
    search = jax.lax.while_loop(running, run_round, (jnp.zeros((), int), search))[1]
    return search._replace(live=jnp.zeros(n, bool), done=search.done & (search.norm < RESIDUAL_TOLERANCE))
