"""The places in a tiling where a source may have an image, and how many images there must be.

Two triangles per cell are mapped to the source plane; a triangle that contains the source starts a
search for an image. Two images that lie within one cell sit on either side of a critical curve, where
no triangle need contain the source: cells that a critical curve may cross start a search at each of
their corners instead. How often the mapped edge of the window turns around the source, and the mapped
rings around centres without a core, tell what the parities of all images must add up to.
"""

import jax.numpy as jnp

from jaxlens._tiling import Tiling
from jaxlens._types import Array, Bool, Int, Point, Scalar


def cross(a: Array, b: Array) -> Array:
    """a_1 b_2 - a_2 b_1 of vectors `(..., 2)`."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


_BLOCK = 64


def compact(mask: Array, size: int) -> tuple[Int[Array, " size"], Bool[Array, " size"], Bool[Array, ""]]:
    """Flat indices of the first `size` entries that are set, which of them are real, and overflow.

    Works in two stages, on blocks that hold at least one entry and then inside them: the sums over
    the whole mask that a single stage needs are several times slower.
    """
    count = mask.sum()
    blocks = jnp.pad(mask.reshape(-1), (0, -mask.size % _BLOCK)).reshape(-1, _BLOCK)
    occupied = blocks.any(axis=1)
    row = jnp.nonzero(occupied, size=size, fill_value=0)[0]
    inside = blocks[row] & (jnp.arange(size) < occupied.sum())[:, None]
    slot = jnp.nonzero(inside.reshape(-1), size=size, fill_value=0)[0]
    return row[slot // _BLOCK] * _BLOCK + slot % _BLOCK, jnp.arange(size) < count, count > size


def _bounds(v: Array) -> tuple[Array, Array]:
    """Smallest and largest value at the corners of each cell."""
    corners = v[:, :-1, :-1], v[:, :-1, 1:], v[:, 1:, 1:], v[:, 1:, :-1]
    low, high = corners[0], corners[0]
    for corner in corners[1:]:
        low, high = jnp.minimum(low, corner), jnp.maximum(high, corner)
    return low, high


_SLACK = 1e-2
# Triangles count as this much larger (in barycentric units) than they are: a source on an edge, or in
# the rounding error between two patches, belongs to both neighbours rather than to none.

_WIDEN = 0.25
# A critical curve may cross a cell when det A, extrapolated beyond its range at the corners by this
# factor, passes through zero.

_GROW = 0.1
# A cell may hold a pair of images when the source is inside the box around its mapped corners,
# widened on each side by this fraction of its longer side.


def _in_triangles(theta: Array, u: Array, use: Array, size: int) -> tuple[Array, Array, Array]:
    """Starts from the triangles that contain the source, which is the origin of `u (p, r, c, 2)`."""
    along, up, diagonal = (
        cross(u[:, :, :-1], u[:, :, 1:]),
        cross(u[:, :-1], u[:, 1:]),
        cross(u[:, :-1, :-1], u[:, 1:, 1:]),
    )

    def contains(a: Array, b: Array, c: Array) -> Array:
        slack = _SLACK * jnp.abs(a + b + c)
        return (jnp.minimum(jnp.minimum(a, b), c) >= -slack) | (jnp.maximum(jnp.maximum(a, b), c) <= slack)

    lower = contains(along[:, :-1], up[:, :, 1:], -diagonal)
    upper = contains(diagonal, -along[:, 1:], -up[:, :, :-1])
    inside = jnp.stack([lower & use, upper & use], axis=-1)
    index, real, overflow = compact(inside, size)
    patch, row, column, which = jnp.unravel_index(index, inside.shape)

    # Corners of the triangle: (0, 0), (0, 1), (1, 1) below the diagonal, (0, 0), (1, 1), (1, 0) above.
    i = jnp.array([[0, 0, 1], [0, 1, 1]]).T[:, which]
    j = jnp.array([[0, 1, 1], [0, 1, 0]]).T[:, which]
    t, v = theta[patch, row + i, column + j], u[patch, row + i, column + j]
    weight = cross(jnp.roll(v, -1, axis=0), jnp.roll(v, -2, axis=0))
    total = weight.sum(axis=0)
    flat = total == 0.0
    weight = jnp.clip(jnp.where(flat, 1.0 / 3.0, weight / jnp.where(flat, 1.0, total)), 0.0, 1.0)
    # In the disc inside the first ring the centre itself: there a small core may be far from linear.
    disc = jnp.all(t[0] == theta[patch, row, column + 1], axis=-1)
    weight = jnp.where(disc, jnp.array([1.0, 0.0, 0.0])[:, None], weight / weight.sum(axis=0))
    return jnp.sum(weight[..., None] * t, axis=0), real, overflow


def _at_folds(
    theta: Array, u: Array, hessian: Array, use: Array, dls_ds: Scalar, size: int
) -> tuple[Array, Array, Array]:
    """Starts at the corners of cells that a critical curve may cross near the source."""
    xx, xy, yy = (dls_ds * hessian[..., i] for i in range(3))
    low, high = _bounds((1.0 - xx) * (1.0 - yy) - xy**2)
    margin = _WIDEN * (high - low)
    left, right = _bounds(u)
    grown = _GROW * jnp.max(right - left, axis=-1, keepdims=True)
    near = jnp.all((left <= grown) & (right >= -grown), axis=-1)
    cell = (low <= margin) & (high >= -margin) & near & use
    wide = jnp.pad(cell, ((0, 0), (1, 1), (1, 1)))
    corner = wide[:, :-1, :-1] | wide[:, :-1, 1:] | wide[:, 1:, 1:] | wide[:, 1:, :-1]
    index, real, overflow = compact(corner, size)
    return theta.reshape(-1, 2)[index], real, overflow


def winding(u: Array) -> Array:
    """How often closed polygons `u (..., d, 2)` (last point = first) turn around the origin, `(...)` int."""
    a, b = u[..., :-1, :], u[..., 1:, :]
    turn = cross(a, b)
    upward = (a[..., 1] <= 0.0) & (b[..., 1] > 0.0) & (turn > 0.0)
    downward = (a[..., 1] > 0.0) & (b[..., 1] <= 0.0) & (turn < 0.0)
    return jnp.sum(upward.astype(int) - downward.astype(int), axis=-1)


def winding_smooth(u: Array) -> Array:
    """How often smooth closed curves turn around the origin, given by corners `u (..., d, 2)`, `(...)` int.

    As `winding`, but the origin may lie between a chord and its arc: there the cubic through the four
    nearest corners decides. A chord of a circle of 64 corners is wrong by 1e-3 of the radius, the cubic
    by 2e-6.
    """
    a, b = u[..., :-1, :], u[..., 1:, :]
    before, after = jnp.roll(a, 1, axis=-2), jnp.roll(b, -1, axis=-2)
    chord = b - a
    length2 = jnp.sum(chord**2, axis=-1)
    safe = jnp.where(length2 > 0.0, length2, 1.0)
    bend_a, bend_b = before - 2.0 * a + b, a - 2.0 * b + after

    def bulge(t: Array) -> Array:
        """The arc minus its chord."""
        return (-t * (1.0 - t) / 6.0)[..., None] * (
            (2.0 - t)[..., None] * bend_a + (1.0 + t)[..., None] * bend_b
        )

    t = -jnp.sum(a * chord, axis=-1) / safe
    # The foot of the origin on the chord, then on the arc, whose points also move along the chord.
    t -= jnp.sum(bulge(jnp.clip(t, 0.0, 1.0)) * chord, axis=-1) / safe
    height, arc = cross(a, chord), cross(chord, bulge(t))  # both to the left, times the chord's length
    beside = (t >= 0.0) & (t < 1.0) & (length2 > 0.0)
    lost = beside & (height > 0.0) & (height < arc)
    gained = beside & (arc < height) & (height < 0.0)
    return winding(u) + jnp.sum(gained.astype(int) - lost.astype(int), axis=-1)


_NEAR_CUT = 0.15
# A source closer to the edge of a cut than this fraction of its size may have an image so close to the
# centre that the chords of the polar patch pass it by.


def _at_cuts(t: Tiling, u: Array, size: int) -> tuple[Array, Array, Array]:
    """Starts next to centres without a core, in the direction in which an image may emerge.

    `u (m, 65, 2)` is the mapped ring seen from the source.
    """
    distance = jnp.sqrt(jnp.sum(u**2, axis=-1))
    extent = jnp.max(jnp.sqrt(jnp.sum((u - u.mean(axis=1, keepdims=True)) ** 2, axis=-1)), axis=1)
    near = t.singular & (distance.min(axis=1) < _NEAR_CUT * extent)
    index, real, overflow = compact(near, size)
    return t.ring.theta[index, jnp.argmin(distance[index], axis=1)], real, overflow


def starts(t: Tiling, beta: Point, dls_ds: Scalar, size: int) -> tuple[Array, ...]:
    """Where to start looking for the images of one source.

    Args:
        t: the tiling.
        beta: source position, `(2,)`, arcsec.
        dls_ds: its distance ratio.
        size: capacity of the list of starts at folds; the other lists, and that of the patches that
            can contribute at all, are shorter.

    Returns:
        Positions `(n, 2)`; which are real `(n,)`; whether a list was too short `()`; how many images
        more of positive than of negative parity the window must hold `()` int; how many images are
        hidden in centres without a core `()` int.
    """
    u = t.theta - dls_ds * t.alpha - beta
    low, high = u.min(axis=(1, 2)), u.max(axis=(1, 2))
    grown = _GROW * jnp.max(high - low, axis=-1, keepdims=True)
    index, real, crowded = compact(jnp.all((low <= grown) & (high >= -grown), axis=-1), size // 2)
    theta, u, hessian, use = (a[index] for a in (t.theta, u, t.hessian, t.use))
    use &= real[:, None, None]
    found = [_in_triangles(theta, u, use, size // 2), _at_folds(theta, u, hessian, use, dls_ds, size)]
    balance = winding(t.edge.theta[0] - dls_ds * t.edge.alpha[0] - beta)
    hidden = jnp.zeros((), int)
    if len(t.singular):
        u = t.ring.theta - dls_ds * t.ring.alpha - beta
        found.append(_at_cuts(t, u, size // 4))
        hidden = jnp.sum(jnp.where(t.singular, winding_smooth(u), 0))
    position, real, overflow = zip(*found, strict=True)
    flags = jnp.stack([crowded, *overflow])
    return jnp.concatenate(position), jnp.concatenate(real), jnp.any(flags), balance - hidden, hidden
