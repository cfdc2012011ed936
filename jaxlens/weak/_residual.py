"""What an E mode explains of a shear map, and the B mode of what it leaves over."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from jaxlens._types import Array, ComplexMap, Float, Map
from jaxlens.grid import Grid
from jaxlens.weak._akra import AkraCG
from jaxlens.weak._operator import ShearOperator
from jaxlens.weak._schemes import check, weight_of
from jaxlens.weak._settings import SCHEMES, Settings, real, scheme_of, settings
from jaxlens.weak._shear import ShearMap
from jaxlens.weak._smooth import blur


def residual_b_mode(
    shears: ShearMap,
    kappa: Float[Array, "m y x"],
    grid: Grid,
    *,
    scheme: str = "A2",
    ridge: float = 1e-2,
    padding: float = 2.0,
    smoothing: float = 15.0,
    band: str = "disc",
) -> Float[Array, "m y x"]:
    """B mode of the shear that the E mode does not explain, P[-i (gamma - D P gamma)], gamma = g (1 - kappa).

    In a field with an edge some shear can be read as E mode and as B mode alike, so a lens alone shows a B
    mode (0.08 rms for Abell S1063, whose convergence reaches 0.24). Here such shear counts as E mode; what is
    left is noise and systematic errors, to be compared with that of null maps.

    Args:
        shears: shear maps with a leading axis m.
        kappa: their reconstructions, `(m, y, x)`.
        grid: their grid.
        scheme: A1, A2 or A3; Kaiser-Squires is no fit and leaves no residual.
        ridge, padding, smoothing, band: as in `reconstruct`.

    Raises:
        ValueError: for wrong shapes or values, or a K scheme.
    """
    row = scheme_of(scheme)
    if row.invert != "akra":
        raise ValueError(f"scheme {scheme} fits nothing, so there is no residual; use A1, A2 or A3.")
    if shears.g.ndim != 3 or kappa.shape != shears.g.shape:
        raise ValueError(
            f"`shears.g` has shape {shears.g.shape} and `kappa` {kappa.shape}; give both as `(m, y, x)`."
        )
    check(shears, grid)
    said = settings(shears.g.real.dtype, scheme=scheme, ridge=ridge, smoothing=smoothing)
    operator = ShearOperator.of(grid.shape, real("padding", padding), band)
    return _residual(shears, kappa, grid, operator, said)


@eqx.filter_jit
def _residual(
    shears: ShearMap,
    kappa: Array,
    grid: Grid,
    operator: ShearOperator,
    said: Settings,
) -> Array:
    def one(given: tuple[ComplexMap, Map, Map]) -> Map:
        g, weight, kappa = given
        known = weight > 0.0
        smoothed = jnp.where(known, blur(g, grid, said.smoothing, weight), jnp.zeros((), g.dtype))
        w = weight_of(SCHEMES[said.scheme], said.mask, weight, smoothed)
        inverse = AkraCG(operator, w, said.ridge, said.cg_tol, said.cg_steps)
        zero = inverse.start()
        gamma = smoothed * (1.0 - kappa)
        rest = gamma - inverse.shear(inverse.solve(gamma, zero))
        return inverse.field(inverse.solve(-1j * rest, zero))

    return lax.map(one, (shears.g, shears.weight.astype(shears.g.real.dtype), kappa))


def explained_shear(
    shear: ShearMap,
    kappa: Map,
    grid: Grid,
    *,
    scheme: str = "A2",
    ridge: float = 1e-2,
    padding: float = 2.0,
    smoothing: float = 15.0,
    band: str = "disc",
) -> ComplexMap:
    """The reduced shear of a reconstruction, D P gamma/(1 - kappa) with gamma = g (1 - kappa), `(y, x)`.

    g less this is noise, and what the smoothing has removed of the lens.

    Args:
        shear: the shear map.
        kappa: its reconstruction, `(y, x)`.
        grid: its grid.
        scheme, ridge, padding, smoothing, band: as in `reconstruct`.

    Returns:
        Complex reduced shear; 0 where the weight is 0, or where kappa is 1.

    Raises:
        ValueError: for wrong shapes or values.
    """
    scheme_of(scheme)
    if kappa.shape != shear.g.shape:
        raise ValueError(
            f"`kappa` has shape {kappa.shape} but `shear.g` {shear.g.shape}; give its reconstruction."
        )
    check(shear, grid)
    said = settings(shear.g.real.dtype, scheme=scheme, ridge=ridge, smoothing=smoothing)
    operator = ShearOperator.of(grid.shape, real("padding", padding), band)
    return _explained(shear, kappa, grid, operator, said)


@eqx.filter_jit
def _explained(
    shear: ShearMap,
    kappa: Map,
    grid: Grid,
    operator: ShearOperator,
    said: Settings,
) -> ComplexMap:
    row, weight = SCHEMES[said.scheme], shear.weight.astype(shear.g.real.dtype)
    known = weight > 0.0
    smoothed = jnp.where(known, blur(shear.g, grid, said.smoothing, weight), jnp.zeros((), shear.g.dtype))
    gamma = smoothed * (1.0 - kappa)
    w = weight_of(row, said.mask, weight, smoothed)
    if row.invert == "ks":
        made = operator.e_mode(w * gamma)
    else:
        inverse = AkraCG(operator, w, said.ridge, said.cg_tol, said.cg_steps)
        made = inverse.shear(inverse.solve(gamma, inverse.start()))
    used = known & (kappa != 1.0)
    return jnp.where(used, made / jnp.where(used, 1.0 - kappa, 1.0), 0.0)
