"""Many shear maps of one field, as a Monte Carlo over shape noise needs them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool

from jaxlens._types import Array, Float
from jaxlens.grid import Grid
from jaxlens.weak._akra import AkraDense
from jaxlens.weak._iterate import last_ratio, rms
from jaxlens.weak._operator import ShearOperator
from jaxlens.weak._schemes import _reconstruct, check
from jaxlens.weak._settings import Settings, real, scheme_of, settings
from jaxlens.weak._shear import ShearMap
from jaxlens.weak._smooth import blur

BLOCK = 128
"""Maps that share one matrix product, unless `block` says otherwise."""


class ReconstructionBatch(eqx.Module):
    """Convergence maps of `m` realisations.

    Attributes:
        kappa: `(m, y, x)`.
        change: root mean square of the change in unmasked pixels at each iteration, `(m, t)`.
        spectral_radius: ratio of the last two changes, `(m,)`; a low estimate, see `reconstruct`.
        converged: `(m,)`.
        mask_differs: the realisation's masked pixels are not those of the inversion, `(m,)`, for example
            because a pixel has no galaxy. Such a pixel then enters with its smoothed value.
    """

    kappa: Float[Array, "m y x"]
    change: Float[Array, "m t"]
    spectral_radius: Float[Array, " m"]
    converged: Bool[Array, " m"]
    mask_differs: Bool[Array, " m"]


def reconstruct_many(
    shears: ShearMap,
    grid: Grid,
    *,
    inverse: AkraDense | None = None,
    scheme: str = "A2",
    n_iter: int = 5,
    smoothing: float = 15.0,
    tol: float = 1e-3,
    ridge: float | None = None,
    padding: float | None = None,
    band: str | None = None,
    mask: str | None = None,
    cg_tol: float | None = None,
    cg_steps: int | None = None,
    block: int = BLOCK,
) -> ReconstructionBatch:
    """`reconstruct` for many maps; with one `block`, the same bytes for any division into calls.

    With `inverse` (AKRA schemes) the iterations are matrix products over blocks of maps, the last one
    filled up. Without it every map is reconstructed by itself with its own mask, which is also the second
    pass for realisations with `mask_differs`.

    Args:
        shears: a shear map whose arrays have a leading axis m, as `vmap` of `shape_noise` returns.
        grid: the grid of one map.
        inverse: from `dense_inverse`; its ridge, padding, band and mask hold.
        scheme, n_iter, smoothing, tol: as in `reconstruct`.
        ridge, padding, band, mask, cg_tol, cg_steps: without `inverse`, as in `reconstruct`; None takes
            its value.
        block: maps that share one matrix product; without `inverse` there is none. Its rounding depends on
            its size, so a map has the same bytes only with the same size; fewer than 64 cost more per map.

    Raises:
        ValueError, TypeError: as `reconstruct`; if `block` is below 1.
    """
    row = scheme_of(scheme)
    options = {"ridge": ridge, "mask": mask, "cg_tol": cg_tol, "cg_steps": cg_steps}
    given = {name: value for name, value in options.items() if value is not None}
    many = {"n_iter": n_iter, "smoothing": smoothing, "tol": tol, "b_mode": False}
    said = settings(shears.g.real.dtype, scheme=scheme, **many, **given)
    if shears.g.ndim != 3:
        raise ValueError(f"`shears.g` has shape {shears.g.shape}; give `(m, y, x)`, or call `reconstruct`.")
    if row.start == "model":
        raise ValueError(
            f"scheme {scheme} starts from a model; use A2, which has the same fixed point, or `reconstruct`."
        )
    check(shears, grid)
    if block < 1:
        raise ValueError(f"`block` is {block}; give at least one map.")
    if inverse is None:
        operator = ShearOperator.of(
            grid.shape, 2.0 if padding is None else real("padding", padding), band or "disc"
        )
        return _one_by_one(shears, grid, operator, said)
    given |= {name: value for name, value in (("padding", padding), ("band", band)) if value is not None}
    if row.invert != "akra" or given:
        raise ValueError(
            f"scheme {scheme} with {sorted(given)} does not go with `inverse`, which has its own ridge, "
            "padding, band and mask; give them to `dense_inverse`."
        )
    if inverse.weight.shape != grid.shape:
        raise ValueError(f"`inverse` was made for {inverse.weight.shape}, but `grid.shape` is {grid.shape}.")
    count = len(shears.g)
    parts = []
    for start in range(0, count, block):
        part = ShearMapBlock(shears.g[start : start + block], shears.weight[start : start + block])
        size = len(part.g)
        fill = lambda a, n=block - size: jnp.pad(a, [(0, n), (0, 0), (0, 0)])
        done = _block(jax.tree.map(fill, part), inverse, grid, said)
        parts.append(jax.tree.map(lambda a, n=size: a[:n], done))
    return jax.tree.map(lambda *a: jnp.concatenate(a), *parts)


class ShearMapBlock(eqx.Module):
    """Reduced shear and weights of one block."""

    g: Array
    weight: Array


@eqx.filter_jit
def _block(block: ShearMapBlock, inverse: AkraDense, grid: Grid, said: Settings) -> ReconstructionBatch:
    weight = block.weight.astype(block.g.real.dtype)
    g = jax.vmap(lambda one, w: blur(one, grid, said.smoothing, w))(block.g, weight)
    used = inverse.weight > 0.0

    def step(kappa: Array, _: None) -> tuple[Array, Array]:
        new = inverse.many(g * (1.0 - kappa))
        return new, rms(new - kappa, used[None])

    kappa, change = lax.scan(step, jnp.zeros_like(weight), length=said.n_iter)
    change = change.T
    radius = last_ratio(change)
    converged = (change[:, -1] < said.tol) & jnp.all(jnp.isfinite(kappa), axis=(1, 2)) & ~(radius >= 1.0)
    differs = jnp.any((weight > 0.0) != used[None], axis=(1, 2))
    return ReconstructionBatch(kappa, change, radius, converged, differs)


@eqx.filter_jit
def _one_by_one(shears: ShearMap, grid: Grid, operator: ShearOperator, said: Settings) -> ReconstructionBatch:
    def one(shear: ShearMap) -> tuple[Array, ...]:
        kappa, _, _, change, radius, _, converged = _reconstruct(shear, None, None, grid, operator, said)
        return kappa, change, radius, converged

    kappa, change, radius, converged = lax.map(one, shears)  # measured faster than vmap on a CPU
    return ReconstructionBatch(kappa, change, radius, converged, jnp.zeros(len(kappa), bool))
