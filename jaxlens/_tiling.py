"""Tilings of the image plane.

A tiling knows the deflection and its derivatives at fixed positions, for D_LS/D_S = 1, so that one
tiling serves every source and every redshift behind a lens. It consists of patches of quadrilateral
cells: one regular patch covers the window, and a polar patch with geometric radii surrounds every
profile, down to 1e-4 arcsec. Patches overlap on purpose.
"""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as lensing
from jaxlens._types import Array, Bool, Float, Point, Scalar, ScalarLike
from jaxlens.lens import Lens
from jaxlens.profiles import profile_of

CELLS = 16
"""Cells along each side of a patch: radii and directions of a polar one."""

INNER = 1e-4
"""Innermost radius of a polar patch, arcsec. Images closer than this to a centre without a core have
|mu| below 1e-3 for a strength b above 0.1 arcsec, and are not sought."""

UNCORED = 1e-6
"""A core radius below this, arcsec, counts as none."""

_RING = 64
# Directions of the ring that tells which sources lie inside the cut of a centre without a core.


class Path(eqx.Module):
    """Closed polygons whose image in the source plane may turn around a source.

    Attributes:
        theta: corners, the last equal to the first, `(m, d, 2)`, arcsec.
        alpha: deflection there for D_LS/D_S = 1, `(m, d, 2)`, arcsec.
    """

    theta: Float[Array, "m d 2"]
    alpha: Float[Array, "m d 2"]


class Tiling(eqx.Module):
    """The image plane of one lens, ready to be searched for images.

    Patches of 16 x 16 quadrilateral cells, with 17 x 17 corners: the regular ones cover the window,
    then comes a polar one for each profile (radii along the rows).

    Attributes:
        theta: corners of the cells, `(p, 17, 17, 2)`, arcsec.
        alpha: deflection there for D_LS/D_S = 1, `(p, 17, 17, 2)`, arcsec.
        hessian: second derivatives (xx, xy, yy) of psi there, `(p, 17, 17, 3)`.
        use: False for cells that are not to be searched, `(p, 16, 16)`.
        edge: the edge of the window.
        ring: circles of radius `INNER` around the m profiles that may lack a core.
        singular: which of these do lack a core, `(m,)`.
        pixel: side of a cell of a regular patch, `()`, arcsec.
    """

    theta: Float[Array, "p r c 2"]
    alpha: Float[Array, "p r c 2"]
    hessian: Float[Array, "p r c 3"]
    use: Bool[Array, "p rows columns"]
    edge: Path
    ring: Path
    singular: Bool[Array, " m"]
    pixel: Scalar

    @property
    def window(self) -> tuple[Point, Point]:
        """Lower-left and upper-right corner of the window, arcsec."""
        return self.edge.theta[0].min(axis=0), self.edge.theta[0].max(axis=0)


def singular_centres(lens: Lens) -> tuple[Float[Array, "m 2"], Bool[Array, " m"]]:
    """Centres of the profiles that may lack a core, and whether they do.

    A profile lacks a core when its `r_core` is below `UNCORED`, or when it has no such number and is
    registered as singular.
    """
    where, lacks = [jnp.zeros((0, 2))], [jnp.zeros(0, bool)]
    for component in lens.components.values():
        core = getattr(component.params, "r_core", None)
        if core is not None:
            lacks.append(core < UNCORED)
        elif profile_of(component.params).singular:
            lacks.append(jnp.ones(len(component), bool))
        else:
            continue
        where.append(component.centre)
    return jnp.concatenate(where), jnp.concatenate(lacks)


F = TypeVar("F", bound=Callable[..., Any])


def any_rank(function: F) -> F:
    """`function` with NumPy's broadcasting between arrays of different rank, whatever the caller has set.

    The geometry here combines points, cells and profiles; spelling out every axis would bury it.
    """

    @wraps(function)
    def allowed(*args: Any, **kwargs: Any) -> Any:
        with jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return allowed  # pyright: ignore[reportReturnType]


def _circles(centres: Array, radii: Array, n: int) -> Array:
    """Closed circles: `(m, len(radii), n + 1, 2)` positions around `centres (m, 2)`."""
    # The exact repetition of the first point closes the ring bit for bit.
    angle = jnp.append(2.0 * jnp.pi * jnp.arange(n) / n, 0.0)
    unit = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    return centres[:, None, None] + radii[:, None, None] * unit


def _blocks(grid: Array) -> Array:
    """A grid of `(n + 1, n + 1, ...)` corners as patches `(p, 17, 17, ...)` that share their edges."""
    n = (grid.shape[0] - 1) // CELLS
    take = CELLS * jnp.arange(n)[:, None] + jnp.arange(CELLS + 1)
    return grid[take[:, None, :, None], take[None, :, None, :]].reshape(
        n * n, CELLS + 1, CELLS + 1, *grid.shape[2:]
    )


def _around(grid: Array) -> Array:
    """The edge of a grid `(n + 1, n + 1, ...)` as a closed path, counter-clockwise."""
    return jnp.concatenate([grid[0], grid[1:, -1], grid[-1, -2::-1], grid[-2::-1, 0]])[None]


@any_rank
def tile(
    lens: Lens,
    *,
    centre: tuple[float, float] = (0.0, 0.0),
    half_width: float,
    pixel: float = 1.0,
    margin: float | None = None,
) -> Tiling:
    """Tile a square window of the image plane.

    Args:
        lens: the lens.
        centre: middle of the window, arcsec.
        half_width: half the side of the window, arcsec. It should hold all images that are wanted, and
            every profile strong enough to make images of its own.
        pixel: longest allowed side of the regular cells, arcsec; the window is divided into a multiple
            of 16 of them.
        margin: profiles whose centre lies more than this outside the window, arcsec, get no patch of their
            own; those that follow are still tiled up to a multiple of 128, so that lenses with different
            numbers of members share compiled programs. Not under `jit`. None: every profile has one.

    Returns:
        The tiling. Derivatives do not pass through it.

    Raises:
        ValueError: if the window or the pixel is not positive.
    """
    if not (half_width > 0 and pixel > 0):
        raise ValueError(
            f"`half_width` is {half_width} and `pixel` {pixel}; give positive lengths in arcsec."
        )
    n = CELLS * -int(-2.0 * half_width / pixel // CELLS)
    middle = jnp.asarray(centre, float)
    centres, (bare, singular) = _all_centres(lens)
    if margin is not None:
        keep = lambda points: _nearest(points, middle, half_width + margin)
        centres, bare, singular = centres[keep(centres)], bare[keep(bare)], singular[keep(bare)]
    return _tile(lens, centres, bare, singular, middle, half_width, n)


@jax.jit
def _all_centres(lens: Lens) -> tuple[Array, tuple[Array, Array]]:
    """Those of all profiles, and `singular_centres`."""
    return lensing.centres(lens), singular_centres(lens)


_GROUP = 128


def _nearest(points: Array, middle: Array, reach: float) -> np.ndarray:
    """Indices of the points inside a square, and of the next ones up to a multiple of `_GROUP`."""
    distance = np.max(np.abs(np.asarray(points) - np.asarray(middle)), axis=1, initial=0.0)
    count = _GROUP * max(1, -(-int(np.sum(distance <= reach)) // _GROUP))
    return np.sort(np.argsort(distance, kind="stable")[:count])


@partial(jax.jit, static_argnums=6)
def _tile(
    lens: Lens,
    centres: Array,
    bare: Array,
    singular: Array,
    middle: Array,
    half_width: ScalarLike,
    n: int,
) -> Tiling:
    lens, centres, bare = jax.lax.stop_gradient((lens, centres, bare))
    step = 2.0 * half_width / n
    side = half_width * jnp.linspace(-1.0, 1.0, n + 1)
    square = jnp.stack(jnp.meshgrid(side + middle[0], side + middle[1]), axis=-1)
    radii = jnp.append(0.0, jnp.geomspace(INNER, jnp.maximum(2.0 * step, 10.0 * INNER), CELLS))
    polar = _circles(centres, radii, CELLS)
    ring = _circles(bare, jnp.full(1, INNER), _RING)[:, 0]

    # One evaluation of the lens for all three, which is one compilation.
    flat = jnp.concatenate([x.reshape(-1, 2) for x in (square, polar, ring)])
    values = jnp.concatenate(
        [a.reshape(len(flat), -1) for a in lensing.alpha_and_hessian(lens, flat)], axis=1
    )
    of_square, of_polar, of_ring = (
        f.reshape(*x.shape[:-1], 6)
        for f, x in zip(
            jnp.split(values, [square.size // 2, (square.size + polar.size) // 2]),
            (square, polar, ring),
            strict=True,
        )
    )
    corners = jnp.concatenate([_blocks(of_square), of_polar])
    # The disc inside the innermost ring of a centre without a core maps onto the whole inside of its
    # cut, and the image there has no magnification.
    hidden = jnp.any(jnp.all(centres[:, None] == bare, axis=-1) & singular, axis=1)
    use = jnp.ones((len(corners), CELLS, CELLS), bool)
    return Tiling(
        theta=jnp.concatenate([_blocks(square), polar]),
        alpha=corners[..., :2],
        hessian=corners[..., jnp.array([2, 3, 5])],
        use=use.at[-len(centres) :, 0].set(~hidden[:, None]),
        edge=Path(_around(square), _around(of_square[..., :2])),
        ring=Path(ring, of_ring[..., :2]),
        singular=singular,
        pixel=jnp.asarray(step),
    )
