"""Critical curves and caustics as polylines. Host side: nothing here is differentiable.

The inverse magnification factors into the eigenvalues 1 - kappa - |gamma| (zero on tangential critical
curves) and 1 - kappa + |gamma| (radial ones). Each is contoured on a grid; every point of a contour lies on
an edge between two pixel centres, where the eigenvalue changes sign, and is found there by bisection.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as _lens
from jaxlens._types import Array
from jaxlens.grid import Grid
from jaxlens.lens import Lens

KINDS = ("tangential", "radial")

_HALVINGS = 40
"""Halvings of an edge of the grid: the points lie on the curve to 1e-12 of a pixel."""


class Curve(NamedTuple):
    """One critical curve with its caustic. NumPy arrays.

    Attributes:
        kind: `tangential` or `radial`.
        theta: points of the critical curve, `(m, 2)`, arcsec; the first is repeated at the end if closed.
        beta: their images in the source plane, `(m, 2)`, arcsec: the caustic.
        closed: False where the window cuts the curve.
    """

    kind: str
    theta: np.ndarray
    beta: np.ndarray
    closed: bool

    @property
    def area(self) -> float:
        """Area inside a closed critical curve, arcsec^2; 0 for an open one."""
        if not self.closed:
            return 0.0
        x, y = self.theta[:-1].T
        return 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))

    @property
    def length(self) -> float:
        """Length of the critical curve, arcsec."""
        return float(np.hypot(*np.diff(self.theta, axis=0).T).sum())


class Curves(NamedTuple):
    """All critical curves of a lens in a window, for one source redshift.

    Attributes:
        dls_ds: distance ratio of the sources.
        items: the curves, largest first.
    """

    dls_ds: float
    items: tuple[Curve, ...]

    @property
    def tangential(self) -> list[np.ndarray]:
        """Polylines `(m, 2)` of the tangential critical curves, arcsec."""
        return [one.theta for one in self.items if one.kind == "tangential"]

    @property
    def radial(self) -> list[np.ndarray]:
        """Polylines `(m, 2)` of the radial critical curves, arcsec."""
        return [one.theta for one in self.items if one.kind == "radial"]

    @property
    def caustics(self) -> list[np.ndarray]:
        """Polylines `(m, 2)` of all caustics, arcsec."""
        return [one.beta for one in self.items]


_field = jax.jit(_lens.alpha_and_hessian)
# With the deflection, which is not needed here: maps of the same grid are made by this very program.


def _on_grid(lens: Lens, grid: Grid, dls_ds: float) -> tuple[np.ndarray, np.ndarray]:
    """1 - kappa -+ |gamma| on the nodes of a grid: tangential, radial."""
    hessian = np.asarray(_field(lens, grid.theta)[1])
    kappa = 0.5 * (hessian[..., 0, 0] + hessian[..., 1, 1])
    size = np.hypot(0.5 * (hessian[..., 0, 0] - hessian[..., 1, 1]), hessian[..., 0, 1])
    return 1.0 - dls_ds * (kappa + size), 1.0 - dls_ds * (kappa - size)


def _eigenvalues(lens: Lens, theta: Array, dls_ds: Array) -> Array:
    """1 - kappa -+ |gamma| at `theta (..., 2)`: `(2, ...)`, tangential first."""
    kappa, gamma = _lens.kappa_and_gamma(lens, theta)
    size = jnp.abs(gamma)
    return jnp.stack([1.0 - dls_ds * (kappa + size), 1.0 - dls_ds * (kappa - size)])


@jax.jit
def _bisect(lens: Lens, low: Array, high: Array, which: Array, dls_ds: Array) -> tuple[Array, Array]:
    """Zero of eigenvalue `which` between `low` and `high` `(m, 2)`, and its source position."""

    def value(theta: Array) -> Array:
        return jnp.take_along_axis(_eigenvalues(lens, theta, dls_ds), which[None], axis=0)[0]

    sign = jnp.sign(value(low))

    def halve(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        low, high = ends
        middle = 0.5 * (low + high)
        same = (jnp.sign(value(middle)) == sign)[:, None]
        return (jnp.where(same, middle, low), jnp.where(same, high, middle)), None

    low, high = jax.lax.scan(halve, (low, high), None, length=_HALVINGS)[0]
    theta = 0.5 * (low + high)
    return theta, _lens.ray_trace(lens, theta, dls_ds)


def _edges(points: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The two pixel centres between which each contour point lies, `(m, 2)` each."""
    nodes = [np.asarray(grid.x), np.asarray(grid.y)]
    place = np.stack([(points[:, k] - nodes[k][0]) / grid.pixel for k in (0, 1)], axis=1)
    nearest = np.round(place)
    # One coordinate is that of a node; the other is between two.
    along = np.argmax(np.abs(place - nearest), axis=1)
    rows = np.arange(len(points))
    low = nearest.astype(int)
    low[rows, along] = np.floor(place[rows, along]).astype(int)
    high = low.copy()
    high[rows, along] += 1
    return tuple(
        np.stack([nodes[k][np.clip(index[:, k], 0, len(nodes[k]) - 1)] for k in (0, 1)], axis=1)
        for index in (low, high)
    )  # pyright: ignore[reportReturnType]


def curves(lens: Lens, grid: Grid, dls_ds: float, *, min_points: int = 8) -> Curves:
    """Critical curves and caustics of a lens in the window of a grid.

    Args:
        lens: the lens.
        grid: window and resolution; curves smaller than a few pixels are missed.
        dls_ds: distance ratio of the sources.
        min_points: contours of fewer points are dropped: they are noise of the grid.

    Returns:
        The curves, largest first; their points lie on them to rounding. A curve that leaves the window
        is not closed.

    Raises:
        ValueError: if `dls_ds` is not between 0 and 1.
    """
    if not 0.0 < dls_ds <= 1.0:
        raise ValueError(f"`dls_ds` is {dls_ds}; give D_LS/D_S of a source behind the lens, in (0, 1].")
    ratio = jnp.asarray(float(dls_ds))
    import contourpy  # only when curves are drawn

    lines: list[tuple[int, np.ndarray]] = []
    for which, values in enumerate(_on_grid(lens, grid, float(dls_ds))):
        found = contourpy.contour_generator(np.asarray(grid.x), np.asarray(grid.y), values).lines(0.0)
        lines += [(which, np.asarray(line)) for line in found if len(line) >= min_points]
    if not lines:
        return Curves(float(dls_ds), ())
    points = np.concatenate([line for _, line in lines])
    kinds = np.concatenate([np.full(len(line), which) for which, line in lines])
    low, high = _edges(points, grid)
    # A multiple of 1024 points: a handful of compiled programs serves all lenses.
    spare = -len(points) % 1024
    low, high = (jnp.asarray(np.pad(part, ((0, spare), (0, 0)), mode="edge")) for part in (low, high))
    theta, beta = _bisect(lens, low, high, jnp.asarray(np.pad(kinds, (0, spare), mode="edge")), ratio)
    ends = np.cumsum([len(line) for _, line in lines])[:-1]
    pieces = (np.split(np.asarray(part)[: len(points)], ends) for part in (theta, beta))
    items = [
        Curve(KINDS[which], on, source, bool(np.array_equal(line[0], line[-1])))
        for (which, line), on, source in zip(lines, *pieces, strict=True)
    ]
    items.sort(key=lambda one: (-one.area, -len(one.theta)))
    return Curves(float(dls_ds), tuple(items))


def einstein_radius(found: Curves) -> float:
    """Effective Einstein radius sqrt(A/pi), A the area inside the largest tangential critical curve, arcsec.

    NaN when the window holds no closed one.
    """
    areas = [one.area for one in found.items if one.kind == "tangential" and one.closed]
    return float(np.sqrt(max(areas) / np.pi)) if areas else float("nan")
