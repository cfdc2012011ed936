"""All images of a point source, and the derivatives of their positions.

beta = theta - (D_LS/D_S) alpha(theta) is solved in three steps: a tiling of the image plane, made once
per lens, proposes starts; Newton's method with capped steps that must lower the residual polishes
them; copies are removed. Positions and magnifications are differentiable with respect to the lens,
the source position and the distance ratio by the implicit function theorem, in forward and in
reverse mode and to any order.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxlens import lens as lensing
from jaxlens._newton import Search, begin, polish, solve_2x2
from jaxlens._starts import starts
from jaxlens._tiling import INNER, Tiling, any_rank, tile
from jaxlens._types import Array, Bool, Float, Int, Mask, Points, ScalarLike, Values
from jaxlens.lens import Lens
from jaxlens.profiles._profile import as_float

__all__ = ["ImageSet", "Tiling", "attach", "images_from", "solve", "tile"]

_MERGE = 1e-6
# Two solutions of the same parity closer than this, arcsec, are one. Two images of a fold pair have
# opposite parity and are never merged; images of equal parity this close need a source within about
# 1e-13 arcsec of a cusp.

_BETWEEN, _PAIRED, _NEIGHBOUR = 12, 32, 3.0
# Second starts of a source: between at most so many pairs, among so many images, that are closer than
# so many base pixels.

_PASSES = 3
# The first search, and two more for sources whose images do not add up to the degree of the map.

_BATCH = 256
# Sources whose starts are in memory at the same time.


class ImageSet(eqx.Module):
    """The images of one source, padded to `k`, earliest arrival first; or of many, with leading axes.

    Attributes:
        theta: positions, `(k, 2)`, arcsec; 0 where not valid.
        mu: signed magnifications, `(k,)`; 0 where not valid.
        valid: which entries are images, `(k,)`.
        overflow: more starts or images than fit: the set is incomplete, `()`.
        parity_ok: whether the images inside the window, counted with the sign of their parity, add up
            to what the map of the window's edge demands (degree theory), `()`. False proves that an
            image is missing or that the source lies within rounding of a caustic; a missing pair of
            opposite parity goes unnoticed.
        hidden: images swallowed by centres without a core, `()`. For a window that holds all images
            of a lens, the number of valid images plus `hidden` is odd.
    """

    theta: Float[Array, "*s k 2"]
    mu: Float[Array, "*s k"]
    valid: Bool[Array, "*s k"]
    overflow: Bool[Array, "*s"]
    parity_ok: Bool[Array, "*s"]
    hidden: Int[Array, "*s"]


def _need_double(*arrays: Array) -> None:
    if any(a.dtype != jnp.float64 for a in arrays):
        found = sorted({str(a.dtype) for a in arrays})
        raise TypeError(
            f"The lens equation needs float64 but was given {', '.join(found)}: single precision cannot tell "
            "the two images of a fold apart. "
            'Put `jax.config.update("jax_enable_x64", True)` before the first computation.'
        )


# --- derivatives --------------------------------------------------------------------------------


def attach(
    lens: Lens, theta: Points, beta: Points, dls_ds: ScalarLike | Values, valid: Mask | bool = True
) -> Points:
    """`theta` unchanged, with the derivatives of an image position.

    At an image, A d(theta) = d(beta) + d[(D_LS/D_S) alpha] with A = d beta/d theta (implicit function
    theorem). Forward and reverse mode, any order; the given `theta` itself is taken as constant.

    Args:
        lens: the lens.
        theta: image positions, `(..., 2)`, arcsec.
        beta: their source positions, `(..., 2)`, arcsec.
        dls_ds: distance ratio, scalar or `(...)`.
        valid: where False, all derivatives are zero, `(...)`.

    Returns:
        Positions, `(..., 2)`, arcsec.
    """
    theta = jax.lax.stop_gradient(jnp.asarray(theta))
    shape = theta.shape[:-1]
    valid = jnp.broadcast_to(jnp.asarray(valid), shape)
    beta = jnp.broadcast_to(beta, theta.shape)
    ratio = jnp.broadcast_to(jnp.asarray(dls_ds, theta.dtype), shape)

    def residual(x: Array) -> Array:
        return lensing.ray_trace(lens, x, ratio) - beta

    def tangent_solve(linear: Callable[[Array], Array], y: Array) -> Array:
        columns = [linear(jnp.broadcast_to(e, y.shape)) for e in jnp.eye(2, dtype=y.dtype)]
        a = jnp.stack(columns, axis=-1)
        a = jnp.where(valid[..., None, None], a, jnp.broadcast_to(jnp.eye(2, dtype=y.dtype), a.shape))
        return solve_2x2(a, jnp.where(valid[..., None], y, 0.0))[0]

    return jax.lax.custom_root(residual, theta, lambda _, x: x, tangent_solve)


# --- public solvers -----------------------------------------------------------------------------


@any_rank
@jax.jit
def images_from(
    lens: Lens, theta: Points, beta: Points, dls_ds: ScalarLike | Values, *, max_step: ScalarLike = 0.5
) -> tuple[Points, Mask]:
    """The image of a source that Newton's method reaches from a given position.

    Steps are capped and shortened until they lower the residual. Differentiable with respect to
    `lens`, `beta` and `dls_ds` where converged; not with respect to `theta`.

    Args:
        lens: the lens.
        theta: starting positions, e.g. observed images, `(..., 2)`, arcsec.
        beta: the source of each, `(..., 2)` or `(2,)`, arcsec.
        dls_ds: distance ratio, scalar or `(...)`.
        max_step: longest step, arcsec.

    Returns:
        Positions `(..., 2)`, arcsec, and whether each is an image `(...)`; where it is not, the
        position of the smallest residual met.

    Raises:
        TypeError: in single precision.
    """
    theta, beta = as_float(theta), as_float(beta)
    _need_double(theta, beta, *jax.tree.leaves(lens))
    shape = theta.shape[:-1]
    beta = jnp.broadcast_to(beta, theta.shape)
    ratio = jnp.broadcast_to(jnp.asarray(dls_ds, theta.dtype), shape)
    fixed, start, b, w = jax.lax.stop_gradient(
        (lens, theta.reshape(-1, 2), beta.reshape(-1, 2), ratio.reshape(-1))
    )
    search = begin(start, jnp.ones(len(start), bool))
    search = polish(fixed, search, b, w, jnp.asarray(max_step, theta.dtype))
    found, converged = search.theta.reshape(theta.shape), search.done.reshape(shape)
    return attach(lens, found, beta, ratio, converged), converged


def _distinct(t: Tiling, theta: Array, det: Array, done: Array) -> Array:
    """Which of the solutions `(n,)` of one source are its images: each once, inside the window."""
    low, high = t.window
    good = done & jnp.all((theta >= low) & (theta <= high), axis=-1)
    if len(t.singular):
        centre = 0.5 * (t.ring.theta[:, 0] + t.ring.theta[:, t.ring.theta.shape[1] // 2])
        inside = jnp.sum((theta[:, None] - centre) ** 2, axis=-1) < INNER**2
        good &= ~jnp.any(inside & t.singular, axis=-1)
    close = jnp.sum((theta[:, None] - theta) ** 2, axis=-1) < _MERGE**2
    copy = close & ((det > 0.0)[:, None] == (det > 0.0)) & good
    return good & ~jnp.any(jnp.tril(copy, -1), axis=-1)


def _midway(t: Tiling, theta: Array, det: Array, good: Array) -> tuple[Array, Array]:
    """Points between neighbouring images of equal parity, `(_BETWEEN, 2)`, and which are real.

    Near a cusp three images lie almost on a line. The basin of the one in the middle can be too narrow
    for any start of the tiling, but for the cubic map of a cusp it always holds the point midway.
    """
    which = jnp.nonzero(good, size=_PAIRED, fill_value=0)[0]
    real = jnp.arange(_PAIRED) < good.sum()
    position, positive = theta[which], det[which] > 0.0
    near = jnp.sum((position[:, None] - position) ** 2, axis=-1) < (_NEIGHBOUR * t.pixel) ** 2
    pair = jnp.tril(near & (positive[:, None] == positive) & real & real[:, None], -1)
    i, j = jnp.nonzero(pair, size=_BETWEEN, fill_value=0)
    return 0.5 * (position[i] + position[j]), jnp.arange(_BETWEEN) < pair.sum()


def _find(lens: Lens, t: Tiling, beta: Array, dls_ds: Array, k: int, size: int) -> tuple[Array, ...]:
    """Positions, validity, overflow, parity and hidden images of `(s,)` sources, without derivatives."""
    position, real, overflow, index, hidden = jax.lax.map(
        lambda x: starts(t, x[0], x[1], size), (beta, dls_ds)
    )
    s, n = real.shape[0], real.shape[1] + _BETWEEN
    position = jnp.pad(position, ((0, 0), (0, _BETWEEN), (0, 0))).reshape(-1, 2)
    real = jnp.pad(real, ((0, 0), (0, _BETWEEN))).reshape(-1)
    each_beta, each_ratio = jnp.repeat(beta, n, axis=0), jnp.repeat(dls_ds, n)
    images = lambda q: (q.theta.reshape(s, n, 2), q.det.reshape(s, n), q.done.reshape(s, n))
    signs = lambda det, good: jnp.sum(jnp.where(good, jnp.where(det > 0.0, 1, -1), 0), axis=1)

    def one_pass(number: Array, carry: tuple[Search, Array, Array]) -> tuple[Search, Array, Array]:
        search, origin, _ = carry
        search = polish(lens, search, each_beta, each_ratio, t.pixel)

        def judge(x: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            good = _distinct(t, *x)
            return good, *_midway(t, *x[:2], good)

        good, between, more = jax.lax.map(judge, images(search))
        # Where the parities do not add up, searches that failed try again: first from beyond the critical
        # curve at which they stopped, then from halfway to it.
        wrong = signs(search.det.reshape(s, n), good) != index
        again = jnp.repeat(wrong, n) & real & ~search.done
        start = jnp.where(number == 0, 2.0 * search.theta - origin, 0.5 * (search.theta + origin))
        slot = jnp.arange(s * n).reshape(s, n)[:, -_BETWEEN:].reshape(-1)
        start = start.at[slot].set(between.reshape(-1, 2))
        again = again.at[slot].set((more & (number == 0)).reshape(-1))
        fresh = begin(start, again)
        search = jax.tree.map(
            lambda new, old: jnp.where(again.reshape(-1, *[1] * (new.ndim - 1)), new, old), fresh, search
        )
        return search, jnp.where(again[:, None], start, origin), good

    first = (begin(position, real), position, jnp.zeros((s, n), bool))
    search, _, good = jax.lax.fori_loop(0, _PASSES, one_pass, first)

    theta, det, _ = images(search)
    which = jax.vmap(lambda g: jnp.nonzero(g, size=k, fill_value=0)[0])(good)
    valid = jnp.arange(k) < good.sum(axis=1)[:, None]
    # A corner of the window is as good as any regular point where there is no image.
    theta = jnp.where(valid[..., None], jnp.take_along_axis(theta, which[..., None], axis=1), t.window[0])
    delay = 0.5 * jnp.sum((theta - beta[:, None]) ** 2, axis=-1) - dls_ds[:, None] * lensing.psi(lens, theta)
    order = jnp.argsort(jnp.where(valid, delay, jnp.inf), axis=1)
    theta, valid = (
        jnp.take_along_axis(theta, order[..., None], axis=1),
        jnp.take_along_axis(valid, order, axis=1),
    )
    return theta, valid, overflow | (good.sum(axis=1) > k), signs(det, good) == index, hidden


@any_rank
@partial(jax.jit, static_argnames=("k", "n_starts"))
def solve(
    lens: Lens,
    beta: Points,
    dls_ds: ScalarLike | Values,
    *,
    tiling: Tiling,
    k: int = 24,
    n_starts: int = 128,
) -> ImageSet:
    """All images of point sources inside a window.

    Sources are worked through in batches of 256 in bounded memory. Positions and magnifications are
    differentiable with respect to `lens`, `beta` and `dls_ds`; the number of images is not.

    Args:
        lens: the lens.
        beta: source positions, `(2,)` or `(..., 2)`, arcsec.
        dls_ds: their distance ratios, scalar or `(...)`.
        tiling: the window, from `tile(lens, ...)` with the same lens.
        k: length of the returned arrays.
        n_starts: capacity of the lists of starts of one source.

    Returns:
        The images of each source, ordered by arrival time; positions to 1e-10 arcsec.

    Raises:
        TypeError: in single precision.
    """
    beta = as_float(beta)
    _need_double(beta, tiling.theta, *jax.tree.leaves(lens))
    shape = beta.shape[:-1]
    ratio = jnp.broadcast_to(jnp.asarray(dls_ds, beta.dtype), shape)
    fixed, t, b, w = jax.lax.stop_gradient((lens, tiling, beta.reshape(-1, 2), ratio.reshape(-1)))
    s = b.shape[0]
    batch = min(s, _BATCH)
    groups = lambda a: jnp.pad(a, [(0, -s % batch)] + [(0, 0)] * (a.ndim - 1), mode="edge").reshape(
        -1, batch, *a.shape[1:]
    )
    found = jax.lax.map(lambda x: _find(fixed, t, x[0], x[1], k, n_starts), (groups(b), groups(w)))
    theta, valid, overflow, parity_ok, hidden = (
        a.reshape(-1, *a.shape[2:])[:s].reshape(*shape, *a.shape[2:]) for a in found
    )

    each = jnp.broadcast_to(ratio[..., None], valid.shape)
    theta = attach(lens, theta, jnp.broadcast_to(beta[..., None, :], theta.shape), each, valid)
    mu = lensing.mu(lens, theta, each)
    return ImageSet(
        theta=jnp.where(valid[..., None], theta, 0.0),
        mu=jnp.where(valid, mu, 0.0),
        valid=valid,
        overflow=overflow,
        parity_ok=parity_ok,
        hidden=hidden,
    )
