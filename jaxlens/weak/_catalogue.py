"""Galaxies with shapes, and the shear map of their mean ellipticity.

The mean of eps over unlensed orientations is the reduced shear g where |g| < 1 (Schneider & Seitz 1995),
so a catalogue enters as plain numbers: a position, a complex ellipticity, a weight and D_LS/D_S per galaxy. A
galaxy that is not used has weight 0; arrays keep their length, so every function here survives `jit`, `vmap`
and, in ellipticities and weights, `grad`.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxlens._types import Array, ArrayLike, Bool, Complex, Float, RandomKey, Scalar, ScalarLike
from jaxlens.grid import Grid
from jaxlens.weak._shear import ShearMap


class Galaxies(eqx.Module):
    """Background galaxies.

    Attributes:
        theta: positions, theta_1 = West, theta_2 = North, `(n, 2)`, arcsec.
        eps: observed ellipticity (1 - q)/(1 + q) exp(2 i phi), phi from +theta_1 towards +theta_2, `(n,)`;
            finite everywhere, without influence where the weight is 0.
        weight: >= 0, 0 where a galaxy is not used, `(n,)`.
        dls_ds: D_LS/D_S, 0 in front of the lens, `(n,)`.
    """

    theta: Float[Array, "n 2"]
    eps: Complex[Array, " n"]
    weight: Float[Array, " n"]
    dls_ds: Float[Array, " n"]

    def __init__(self, theta: Any, eps: Any, weight: Any = 1.0, dls_ds: Any = 1.0) -> None:
        real = jnp.result_type(float)
        self.theta = jnp.asarray(theta, real)
        n = self.theta.shape[:-1]
        self.weight = jnp.broadcast_to(jnp.asarray(weight, real), n)
        self.dls_ds = jnp.broadcast_to(jnp.asarray(dls_ds, real), n)
        # 0 times a NaN is a NaN, so an unmeasured shape of weight 0 is replaced, not only ignored.
        self.eps = jnp.where(self.weight > 0.0, jnp.asarray(eps, jnp.result_type(complex)), 0.0)

    def __len__(self) -> int:
        return self.weight.shape[0]


class Depth(eqx.Module):
    """How far behind the lens the galaxies lie, as weighted moments of b = D_LS/D_S.

    Attributes:
        mean: <b>, `()`: the effective D_LS/D_S.
        mean_square: <b^2>, `()`.
    """

    mean: Scalar
    mean_square: Scalar

    @property
    def factor(self) -> Scalar:
        """f = <b^2>/<b>^2 >= 1, `()`."""
        return self.mean_square / self.mean**2


# --- which galaxies, and how much each counts ---------------------------------------------------


def background(
    eps: Complex[ArrayLike, " n"],
    z: Float[ArrayLike, " n"] | None = None,
    *,
    member: Bool[ArrayLike, " n"] | None = None,
    z_min: ScalarLike = 0.0,
    max_eps: ScalarLike = jnp.inf,
    require_z: bool = False,
) -> Bool[Array, " n"]:
    """Which galaxies lie behind the lens, as far as one knows.

    Used are galaxies with a finite |eps| < `max_eps` that are no members and are not known to lie at
    z < `z_min`.

    Args:
        eps: ellipticities, `(n,)`, NaN where unmeasured.
        z: redshifts, `(n,)`, NaN where unknown.
        member: whether a member of the cluster, `(n,)`.
        z_min: smallest redshift of a source, z_l plus a margin for the errors of photometric redshifts.
        max_eps: largest |eps|.
        require_z: leave out galaxies of unknown redshift.
    """
    size = jnp.abs(jnp.asarray(eps))
    use = jnp.isfinite(size) & (size < max_eps)
    if z is not None:
        known = jnp.isfinite(jnp.asarray(z))
        use &= jnp.where(known, jnp.asarray(z) >= z_min, not require_z)
    elif require_z:
        use &= False
    if member is not None:
        use &= ~jnp.asarray(member, bool)
    return use


def select(galaxies: Galaxies, use: Bool[ArrayLike, " n"]) -> Galaxies:
    """The same galaxies with weight 0 where `use (n,)` is False."""
    weight = jnp.where(jnp.asarray(use), galaxies.weight, 0.0)
    return Galaxies(galaxies.theta, galaxies.eps, weight, galaxies.dls_ds)


def shape_weight(sigma_m: Float[ArrayLike, " n"], sigma_eps: ScalarLike) -> Float[Array, " n"]:
    """Inverse variance of a galaxy's shear estimate, w = 1/(sigma_eps^2 + sigma_m^2), `(n,)`.

    Args:
        sigma_m: error of the measurement of each component of eps, `(n,)`.
        sigma_eps: scatter of intrinsic ellipticities per component.
    """
    return 1.0 / (jnp.asarray(sigma_eps) ** 2 + jnp.asarray(sigma_m) ** 2)


# --- depth ---------------------------------------------------------------------------------------


def draw_redshifts(
    key: RandomKey,
    z: Float[ArrayLike, " n"],
    lo: Float[ArrayLike, " n"],
    hi: Float[ArrayLike, " n"],
) -> Float[Array, " n"]:
    """One draw of photometric redshifts, two half-normals that meet at `z` (our choice), never below 0.

    Below and above `z` are equally likely; `lo` and `hi` are then the 16th and 84th percentiles.

    Args:
        key: random key.
        z: most likely redshifts, `(n,)`; NaN stays NaN.
        lo, hi: 16th and 84th percentiles, `(n,)`; where they are NaN the redshift stays as it is.

    Returns:
        Redshifts, `(n,)`. Give them to `LensPlane.dls_ds`.
    """
    z, lo, hi = (jnp.asarray(one) for one in (z, lo, hi))
    t = jax.random.normal(key, z.shape, z.dtype)
    width = jnp.where(t < 0.0, z - lo, hi - z)
    width = jnp.where(jnp.isfinite(width), jnp.maximum(width, 0.0), 0.0)
    return jnp.maximum(z + t * width, 0.0)  # maximum keeps NaN


def depth(galaxies: Galaxies) -> Depth:
    """Weighted first and second moment of D_LS/D_S over the galaxies with weight."""
    total = jnp.sum(galaxies.weight)
    first = jnp.sum(galaxies.weight * galaxies.dls_ds) / total
    return Depth(first, jnp.sum(galaxies.weight * galaxies.dls_ds**2) / total)


def to_single_plane(shear: ShearMap, depth: Depth) -> ShearMap:
    """A shear map of galaxies at many redshifts as that of a single source plane.

    Averaged over b, to first order in kappa, <g> = <b> gamma_1/(1 - f <b> kappa_1), f = <b^2>/<b>^2, with
    gamma_1 and kappa_1 for D_LS/D_S = 1 (Seitz & Schneider 1997). f <g> therefore is exactly the reduced
    shear of the lens at D_LS/D_S = f <b> = <b^2>/<b>: reconstruct it, and divide the convergence by f to
    have it for the ratio <b>.
    """
    return ShearMap(shear.g * depth.factor, shear.weight, shear.n_gal)


def to_ratio(galaxies: Galaxies, dls_ds: ScalarLike) -> Galaxies:
    """Every galaxy scaled to one D_LS/D_S: eps_i b/b_i with weight w_i (b_i/b)^2.

    Right to first order in kappa (reduced shear is not proportional to b); inverse-variance weights stay
    such. Galaxies with b_i = 0 get weight 0.

    Args:
        galaxies: the galaxies.
        dls_ds: the ratio b to scale to.
    """
    ratio = galaxies.dls_ds / dls_ds
    behind = ratio > 0.0
    eps = galaxies.eps / jnp.where(behind, ratio, 1.0)
    weight = jnp.where(behind, galaxies.weight * ratio**2, 0.0)
    return Galaxies(galaxies.theta, eps, weight, jnp.asarray(dls_ds))


# --- null tests and resampling -------------------------------------------------------------------


def rotate(galaxies: Galaxies, angle: ArrayLike = jnp.pi / 4.0) -> Galaxies:
    """Every ellipse turned by `angle`, rad, `()` or `(n,)`; by 45 degrees, the E mode becomes the B mode."""
    eps = galaxies.eps * jnp.exp(2j * jnp.asarray(angle))
    return Galaxies(galaxies.theta, eps, galaxies.weight, galaxies.dls_ds)


def scramble(key: RandomKey, galaxies: Galaxies) -> Galaxies:
    """Every ellipse turned by a random angle: the same noise without the lens, for null maps."""
    return rotate(galaxies, jax.random.uniform(key, (len(galaxies),), minval=0.0, maxval=jnp.pi))


def resample(key: RandomKey, galaxies: Galaxies) -> Galaxies:
    """A bootstrap sample: n draws of n galaxies with replacement, as multiples of their weight."""
    n = len(galaxies)
    drawn = jnp.bincount(jax.random.randint(key, (n,), 0, n), length=n)
    return Galaxies(galaxies.theta, galaxies.eps, galaxies.weight * drawn, galaxies.dls_ds)


# --- the map -------------------------------------------------------------------------------------


def to_grid(galaxies: Galaxies, grid: Grid) -> ShearMap:
    """Mean ellipticity of the galaxies in each pixel, g = sum w eps/sum w, with weight sum w.

    With inverse-variance weights sum w is the inverse variance of a component of g. Lower and left edges
    belong to a pixel; galaxies outside of the grid are left out. Pixels without a galaxy have g = 0 and
    weight 0.

    Args:
        galaxies: the galaxies.
        grid: pixels.

    Returns:
        The shear map. Differentiable in ellipticities and weights, not in positions.
    """
    left, _, bottom, _ = grid.extent
    return _to_grid(galaxies, jnp.asarray([left, bottom, grid.pixel], galaxies.theta.dtype), grid.shape)


@partial(jax.jit, static_argnums=2)
def _to_grid(galaxies: Galaxies, edge: Array, shape: tuple[int, int]) -> ShearMap:
    """`to_grid`; `edge` holds left, bottom and pixel."""
    n_y, n_x = shape
    column = jnp.floor((galaxies.theta[:, 0] - edge[0]) / edge[2])
    row = jnp.floor((galaxies.theta[:, 1] - edge[1]) / edge[2])
    inside = (column >= 0) & (column < n_x) & (row >= 0) & (row < n_y)
    pixel = jnp.where(inside, row * n_x + column, n_y * n_x).astype(int)

    def total(values: Array) -> Array:
        summed = jax.ops.segment_sum(values, pixel, num_segments=n_y * n_x + 1)
        return summed[:-1].reshape(n_y, n_x)

    weight = total(galaxies.weight)
    g = total(galaxies.weight * galaxies.eps) / jnp.where(weight > 0.0, weight, 1.0)
    return ShearMap(g, weight, total((galaxies.weight > 0.0).astype(int)))


def shape_scatter(galaxies: Galaxies) -> Scalar:
    """Scatter of the ellipticities per component, (sum w |eps|^2/(2 sum w))^1/2, shear included, `()`."""
    square = jnp.abs(galaxies.eps) ** 2
    return jnp.sqrt(0.5 * jnp.sum(galaxies.weight * square) / jnp.sum(galaxies.weight))
