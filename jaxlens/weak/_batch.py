"""Many shear maps of one field, as a Monte Carlo over shape noise needs them."""

from typing import Any

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
from jaxlens.weak._schemes import SCHEMES, _reconstruct, check, scheme_of
from jaxlens.weak._shear import ShearMap
from jaxlens.weak._smooth import smooth

BLOCK = 64
"""Maps that share one matrix product: its rounding depends on its size, so the size is always this."""


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
    **options: Any,
) -> ReconstructionBatch:
    """`reconstruct` for many maps; the same bytes for any division into calls.

    With `inverse` (AKRA schemes) the iterations are matrix products over blocks of 64 maps, the last one
    filled up. Without it every map is reconstructed by itself with its own mask, which is also the second
    pass for realisations with `mask_differs`.

    Args:
        shears: a shear map whose arrays have a leading axis m, as `vmap` of `shape_noise` returns.
        grid: the grid of one map.
        inverse: from `dense_inverse`; its ridge, padding, band and mask hold.
        scheme, n_iter, smoothing, tol: as in `reconstruct`.
        options: without `inverse`: `ridge`, `padding`, `band`, `mask`, `cg_tol`, `cg_steps` of `reconstruct`.
    """
    row = scheme_of(scheme)
    if shears.g.ndim != 3:
        raise ValueError(f"`shears.g` has shape {shears.g.shape}; give `(m, y, x)`, or call `reconstruct`.")
    if row.start == "model":
        raise ValueError(
            f"scheme {scheme} starts from a model; use A2, which has the same fixed point, or `reconstruct`."
        )
    check(shears, grid)
    if inverse is None:
        return _one_by_one(shears, grid, scheme, n_iter, smoothing, tol, tuple(sorted(options.items())))
    if row.invert != "akra" or options:
        raise ValueError(
            f"scheme {scheme} with {sorted(options)} does not go with `inverse`, which has its own ridge, "
            "padding, band and mask; give them to `dense_inverse`."
        )
    if inverse.weight.shape != grid.shape:
        raise ValueError(f"`inverse` was made for {inverse.weight.shape}, but `grid.shape` is {grid.shape}.")
    count = len(shears.g)
    parts = []
    for start in range(0, count, BLOCK):
        part = ShearMapBlock(shears.g[start : start + BLOCK], shears.weight[start : start + BLOCK])
        size = len(part.g)
        fill = lambda a, n=BLOCK - size: jnp.pad(a, [(0, n), (0, 0), (0, 0)])
        done = _block(jax.tree.map(fill, part), inverse, grid, n_iter, smoothing, tol)
        parts.append(jax.tree.map(lambda a, n=size: a[:n], done))
    return jax.tree.map(lambda *a: jnp.concatenate(a), *parts)


class ShearMapBlock(eqx.Module):
    """Reduced shear and weights of one block."""

    g: Array
    weight: Array


@eqx.filter_jit
def _block(
    block: ShearMapBlock, inverse: AkraDense, grid: Grid, n_iter: int, smoothing: float, tol: float
) -> ReconstructionBatch:
    weight = block.weight.astype(block.g.real.dtype)
    g = jax.vmap(lambda one, w: smooth(one, grid, smoothing, w))(block.g, weight)
    used = inverse.weight > 0.0

    def step(kappa: Array, _: None) -> tuple[Array, Array]:
        new = inverse.many(g * (1.0 - kappa))
        return new, rms(new - kappa, used[None])

    kappa, change = lax.scan(step, jnp.zeros_like(weight), length=n_iter)
    change = change.T
    radius = last_ratio(change)
    converged = (change[:, -1] < tol) & jnp.all(jnp.isfinite(kappa), axis=(1, 2)) & ~(radius >= 1.0)
    differs = jnp.any((weight > 0.0) != used[None], axis=(1, 2))
    return ReconstructionBatch(kappa, change, radius, converged, differs)


@eqx.filter_jit
def _one_by_one(
    shears: ShearMap,
    grid: Grid,
    scheme: str,
    n_iter: int,
    smoothing: float,
    tol: float,
    options: tuple[tuple[str, Any], ...],
) -> ReconstructionBatch:
    given = {"ridge": 1e-2, "padding": 2.0, "cg_tol": 1e-4, "cg_steps": 400, "band": "disc", "mask": None}
    if unknown := {name for name, _ in options} - set(given):
        raise ValueError(
            f"{sorted(unknown)} are no options of `reconstruct_many`; give some of {list(given)}."
        )
    given |= dict(options)
    operator = ShearOperator.of(grid.shape, given["padding"], given["band"])
    settings = (
        n_iter,
        "picard",
        0,
        smoothing,
        given["ridge"],
        given["padding"],
        tol,
        given["cg_tol"],
        given["cg_steps"],
    )

    def one(shear: ShearMap) -> tuple[Array, ...]:
        mask = given["mask"] or SCHEMES[scheme].mask
        made = _reconstruct(shear, None, None, grid, operator, scheme, mask, settings)
        return made.kappa, made.change, made.spectral_radius, made.converged

    kappa, change, radius, converged = lax.map(one, shears)  # measured faster than vmap on a CPU
    return ReconstructionBatch(kappa, change, radius, converged, jnp.zeros(len(kappa), bool))
