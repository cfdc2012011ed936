"""The reconstruction of one map."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from jaxlens._types import Array, Map
from jaxlens.grid import Grid
from jaxlens.weak._akra import AkraCG, AkraDense, Inversion, KaiserSquires, dense
from jaxlens.weak._iterate import Reconstruction, gmres, last_ratio, picard, rms, spectral_radius
from jaxlens.weak._operator import ShearOperator
from jaxlens.weak._settings import SCHEMES, Scheme, Settings, real, scheme_of, settings
from jaxlens.weak._shear import ShearMap
from jaxlens.weak._smooth import blur, cosine_mask, sigmoid_mask

MAX_SHEAR = 1e3


def check(shear: ShearMap, grid: Grid) -> None:
    """Refuse data that no reconstruction can use; values are seen only outside `jit`, `vmap` and `grad`."""
    for name, values in (("g", shear.g), ("weight", shear.weight)):
        if values.shape[-2:] != grid.shape:
            raise ValueError(
                f"`grid.shape` is {grid.shape} but `shear.{name}` is {values.shape}. "
                "Build the shear map on the same grid, or call `grid.rebin` first."
            )
    if isinstance(shear.g, Tracer) or isinstance(shear.weight, Tracer):
        return
    g, weight = np.asarray(shear.g), np.asarray(shear.weight)

    def refuse(bad: np.ndarray, name: str, values: np.ndarray, remedy: str) -> None:
        if bad.any():
            *_, row, column = np.argwhere(bad)[0]
            value = values[bad][0]
            raise ValueError(f"`shear.{name}` is {value} at row {row}, column {column}; {remedy}")

    refuse(~(weight >= 0.0) | np.isinf(weight), "weight", weight, "weights are finite and not negative.")
    used = weight > 0.0
    refuse(used & ~np.isfinite(g), "g", g, "give such a pixel weight 0.")
    refuse(
        used & ~(np.abs(np.where(np.isfinite(g), g, 0.0)) <= MAX_SHEAR),
        "g",
        g,
        f"|g| above {MAX_SHEAR:g} is no reduced shear: give the pixel weight 0.",
    )
    if not used.any(axis=(-2, -1)).all():
        raise ValueError("`shear.weight` is 0 in every pixel; at least one pixel must be unmasked.")


def mask_of(kind: str, weight: Map, g: Array) -> Map:
    """The multiplicative mask m of a kind; 0 where the weight is 0."""
    known = (weight > 0.0).astype(weight.dtype)
    if kind == "binary":
        return known
    return known * (cosine_mask(weight) if kind == "cosine" else sigmoid_mask(g).astype(weight.dtype))


def weight_of(scheme: Scheme, kind: str, weight: Map, g: Array) -> Map:
    """m for Kaiser-Squires; for AKRA w m^2, with w scaled to mean 1, so that the ridge has a meaning."""
    mask = mask_of(kind, weight, g)
    if scheme.invert == "ks":
        return mask
    known = weight > 0.0
    clean = jnp.where(known, weight, 0.0)
    return clean * (jnp.maximum(jnp.sum(known), 1) / jnp.maximum(jnp.sum(clean), 1e-30)) * mask**2


def reconstruct(
    shear: ShearMap,
    grid: Grid,
    *,
    scheme: str = "A2",
    n_iter: int = 5,
    ridge: float = 1e-2,
    padding: float = 2.0,
    smoothing: float = 15.0,
    band: str = "disc",
    mask: str | None = None,
    kappa0: Map | None = None,
    solver: str = "picard",
    inverse: AkraDense | None = None,
    tol: float = 1e-3,
    cg_tol: float = 1e-4,
    cg_steps: int = 400,
    power_steps: int = 20,
) -> Reconstruction:
    """Convergence from reduced shear: kappa <- P[g (1 - kappa)], P one of the inversions of `SCHEMES`.

    The reduced shear is smoothed with its weights first; unmasked pixels then enter the inversion. The result
    has the dtype of `shear.g`; single precision is enough. Differentiable in `shear.g` and, but for the set
    of masked pixels, in `shear.weight`: each linear solve, and with `solver="gmres"` the fixed point, by its
    implicit derivative. Derivatives have the relative accuracy `cg_tol`.

    Args:
        shear: reduced shear, weights and counts, `(y, x)`.
        grid: its grid; any shape.
        scheme: a key of `SCHEMES`.
        n_iter: iterations of `solver="picard"`; `"gmres"` takes at least 60 Krylov vectors.
        ridge: R relative to the mean of w over unmasked pixels, before the factor m^2 of a smooth mask
            (0.7 in the mean for the shipped clusters); 1e-2 suits noisy data, 1e-3 noiseless.
            Unused for K schemes.
        padding: padded over field size, >= 1; 1 makes the field periodic, which is an error of 0.03 in kappa.
        smoothing: standard deviation of the Gaussian, arcsec; 0 for none.
        band: modes that exist, `"disc"` or `"none"`, see `ShearOperator`.
        mask: `"binary"`, `"cosine"` or `"sigmoid"`; None takes the scheme's.
        kappa0: first convergence, `(y, x)`; A3 needs it, e.g. `dls_ds * lens.kappa(model, grid.theta)`.
        solver: `"picard"`, or `"gmres"` for the fixed point where the plain iteration diverges.
        inverse: a map from `dense_inverse` with the same settings, instead of conjugate gradients.
        tol: largest last change of a converged result.
        cg_tol: factor by which each linear solve reduces its residual, between 0 and 1.
        cg_steps: most steps of one linear solve; one that needs more is not `converged`.
        power_steps: steps of the power iteration for the spectral radius, good to a few per cent; 0 takes the
            ratio of the last two changes instead, which is free and too low while several modes still decay.

    Returns:
        `Reconstruction`; one that did not converge says so.

    Raises:
        ValueError: for wrong shapes, names or values (weights, NaN, |g| > 1000, nothing unmasked), or an
            `inverse` made for other settings.
        TypeError: for settings that are traced, or no numbers.
    """
    row = scheme_of(scheme)
    said = settings(
        shear.g.real.dtype, scheme=scheme, mask=mask, solver=solver, n_iter=n_iter, power_steps=power_steps,
        cg_steps=cg_steps, ridge=ridge, tol=tol, cg_tol=cg_tol, smoothing=smoothing,
    )  # fmt: skip
    if row.start == "model" and kappa0 is None:
        raise ValueError(f"scheme {scheme} starts from a model; give `kappa0`, a map of shape {grid.shape}.")
    if kappa0 is not None and kappa0.shape != grid.shape:
        raise ValueError(f"`kappa0` has shape {kappa0.shape} but `grid.shape` is {grid.shape}.")
    check(shear, grid)
    operator = ShearOperator.of(grid.shape, real("padding", padding), band)
    if inverse is not None:
        _fits(inverse, operator, said, real("ridge", ridge), shear.weight)
    parts = _reconstruct(shear, kappa0, inverse, grid, operator, said)
    return Reconstruction(
        *parts, scheme=scheme, ridge=real("ridge", ridge), padding=real("padding", padding), band=band
    )


def _fits(inverse: AkraDense, operator: ShearOperator, said: Settings, ridge: float, weight: Map) -> None:
    """Refuse a dense map made for something else, as far as values are known before the program runs."""
    again = "call `dense_inverse` with the same settings."
    if inverse.operator != operator or SCHEMES[said.scheme].invert != "akra":
        raise ValueError(
            f"`inverse` was made for {inverse.operator}, but {operator} and scheme {said.scheme} are asked "
            f"for; {again}"
        )
    if inverse.mask != said.mask:
        raise ValueError(f"`inverse` has a {inverse.mask} mask, but {said.mask} is asked for; {again}")
    if not isinstance(inverse.ridge, Tracer) and not np.isclose(inverse.ridge, ridge, rtol=1e-6, atol=0.0):
        raise ValueError(f"`inverse` has the ridge {inverse.ridge:g}, but `ridge` is {ridge:g}; {again}")
    if isinstance(inverse.weight, Tracer) or isinstance(weight, Tracer):
        return
    differ = (np.asarray(inverse.weight) > 0.0) != (np.asarray(weight) > 0.0)
    if differ.any():
        row, column = np.argwhere(differ)[0]
        raise ValueError(
            f"`inverse` has another mask than `shear.weight` in {differ.sum()} pixels, the first at row "
            f"{row}, column {column}; make it from these weights."
        )


def roughly(inverse: Inversion, ridge: Array) -> Inversion:
    """The same inversion for a spectral radius to a few per cent: 1/(2 sqrt R) times the residual at most."""
    if not isinstance(inverse, AkraCG):
        return inverse
    tol = jnp.maximum(inverse.tol, 0.1 * jnp.sqrt(ridge))
    return AkraCG(inverse.operator, inverse.weight, inverse.ridge, tol, inverse.max_steps)


def _reconstruct(
    shear: ShearMap,
    kappa0: Map | None,
    inverse: Inversion | None,
    grid: Grid,
    operator: ShearOperator,
    said: Settings,
) -> tuple[Array, ...]:
    """The array fields of `Reconstruction`, in its order."""
    g, used, w = _prepare(shear, grid, said)
    same_mask = jnp.asarray(True) if inverse is None else jnp.all((inverse.weight > 0.0) == used)
    if inverse is None and SCHEMES[said.scheme].invert == "ks":
        inverse = KaiserSquires(operator, w)
    elif inverse is None:
        inverse = AkraCG(operator, w, said.ridge, said.cg_tol, said.cg_steps)
    first = jnp.zeros_like(w) if kappa0 is None else kappa0.astype(w.dtype)
    # Without what is done already: all schemes with the same inversion are one program.
    rest = replace(said, scheme="", mask="", smoothing=None)
    return _iterate(inverse, g, used, first, same_mask, rest)


@eqx.filter_jit
def _prepare(shear: ShearMap, grid: Grid, said: Settings) -> tuple[Array, Array, Array]:
    """Smoothed reduced shear, 0 in masked pixels, unmasked pixels, and the weights of the inversion."""
    weight = shear.weight.astype(shear.g.real.dtype)
    used = weight > 0.0
    g = jnp.where(used, blur(shear.g, grid, said.smoothing, weight), jnp.zeros((), shear.g.dtype))
    return g, used, weight_of(SCHEMES[said.scheme], said.mask, weight, g)


@eqx.filter_jit
def _iterate(
    inverse: Inversion, g: Array, used: Array, first: Map, same_mask: Array, said: Settings
) -> tuple[Array, ...]:
    if said.solver == "picard":
        state, history = picard(inverse, g, first, said.n_iter)
        kappa = history[-1]
        change = rms(jnp.diff(history, axis=0, prepend=first[None]), used)
        solved = history[-2] if said.n_iter > 1 else first
    else:
        kappa = gmres(
            inverse, g, tol=jnp.maximum(1e-2 * said.tol, said.cg_tol), max_steps=max(said.n_iter, 60)
        )
        state = inverse.solve(g * (1.0 - kappa), inverse.start())
        history = kappa[None]
        change = rms(inverse.field(state) - kappa, used)[None]
        solved = kappa
    residual = [inverse.residual(g * (1.0 - solved), state)]
    b_mode = jnp.zeros_like(kappa)
    if said.b_mode:
        turned = -1j * g * (1.0 - kappa)
        state = inverse.solve(turned, inverse.start())
        b_mode = inverse.field(state)
        residual.append(inverse.residual(turned, state))
    else:
        residual.append(jnp.zeros_like(residual[0]))
    if said.power_steps:
        radius = spectral_radius(roughly(inverse, said.ridge), g, said.power_steps)
    else:
        radius = last_ratio(change)
    converged = (change[-1] < said.tol) & jnp.all(jnp.isfinite(kappa)) & same_mask
    # Twice the tolerance, and a hundred roundings: the residual is computed anew.
    worst = jnp.max(jnp.stack(residual))
    converged &= worst <= jnp.maximum(2.0 * said.cg_tol, 100.0 * float(jnp.finfo(kappa.dtype).eps))
    if said.solver == "picard":
        converged &= ~(radius >= 1.0)
    return kappa, b_mode, history, lax.stop_gradient(change), radius, jnp.stack(residual), converged


def dense_inverse(
    weight: Map,
    grid: Grid,
    *,
    scheme: str = "A2",
    ridge: float = 1e-2,
    padding: float = 2.0,
    band: str = "disc",
    mask: str | None = None,
) -> AkraDense:
    """The AKRA inversion of a fixed mask as one matrix, for `reconstruct_many` and `reconstruct`.

    Pays from about 85 maps on; 48 x 48 pixels take seconds to set up.

    Args:
        weight: weights, `(y, x)`, >= 0.
        grid: its grid, at most 6400 pixels.
        scheme, ridge, padding, band, mask: as in `reconstruct`; the sigmoid mask depends on the data and is
            refused.
    """
    row = scheme_of(scheme)
    kind = mask or row.mask
    if row.invert != "akra" or kind == "sigmoid":
        raise ValueError(f"scheme {scheme} with the mask {kind!r} has no fixed dense map; use A1, A2 or A3.")
    said = settings(weight.dtype, scheme=scheme, mask=mask, ridge=ridge)
    check(ShearMap(jnp.zeros(weight.shape, complex), weight, jnp.zeros(weight.shape, int)), grid)
    w = weight_of(row, kind, weight, jnp.zeros_like(weight))
    return dense(ShearOperator.of(grid.shape, real("padding", padding), band), w, said.ridge, kind)
