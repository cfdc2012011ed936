"""The mass-sheet transformation, and lambda from two maps of one cluster."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxlens._types import Array, Bool, Float, Map, Points, ScalarLike, Values

FLOOR = 1e-2
"""A pixel whose reference is closer to kappa = 1 than this has weight 0 (our choice).

(kappa - 1)/(kappa_ref - 1) is singular there: an error of 0.01 in kappa_ref would change it by its own size.
"""


def transform(kappa: Values, lam: float | Array) -> Values:
    """lambda kappa + 1 - lambda: another convergence with the same reduced shear, shape of `kappa`."""
    return 1.0 + lam * (kappa - 1.0)


def regauge(kappa: Values, lam: float | Array) -> Values:
    """Undo a mass-sheet factor: 1 + (kappa - 1)/lambda, shape of `kappa`.

    Reduced shear fixes kappa up to kappa -> 1 + lambda (kappa - 1). Which lambda a reconstruction returns is
    a convention of its padding, band, ridge and mask: calibrate it by a noiseless run with the same settings.
    """
    return 1.0 + (kappa - 1.0) / lam


def transform_potential(psi: Values, theta: Points, lam: float | Array) -> Values:
    """lambda psi + (1 - lambda) |theta|^2/2, the potential of `transform`.

    Args:
        psi: lens potential for the source in question, `(...)`, arcsec^2.
        theta: positions, `(..., 2)`, arcsec.
        lam: mass-sheet factor.
    """
    return lam * psi + (1.0 - lam) * 0.5 * jnp.sum(theta**2, axis=-1)


class Factor(eqx.Module):
    """A map of lambda.

    Attributes:
        lam: lambda, `(y, x)`; 1 where the weight is 0.
        weight: weight of each pixel, `(y, x)`; 0 where it was 0 or the reference is within `FLOOR` of 1.
    """

    lam: Float[Array, "*y x"]
    weight: Float[Array, "*y x"]


def ratio(
    kappa: Float[Array, "*y x"],
    reference: Float[Array, "*y x"],
    weight: Float[Array, "*y x"] | Bool[Array, "*y x"] | None = None,
    *,
    floor: float = FLOOR,
) -> Factor:
    """lambda = (kappa - 1)/(kappa_ref - 1) in each pixel, as stated in the paper.

    With the true convergence as the reference this is the lambda_map of a simulation, with that of a
    strong-lensing model lambda_rec, which needs no truth. Both maps must be for one source redshift, on one
    grid and smoothed alike (the full field, core included, without mask weights).

    Args:
        kappa: weak-lensing convergence, `(y, x)`.
        reference: kappa_ref, `(y, x)`.
        weight: pixels of weight 0 have no influence, `(y, x)`; all 1 if None.
        floor: smallest |kappa_ref - 1| of a pixel with weight.

    Returns:
        The map and its weights; differentiable in both convergences.
    """
    base = jnp.ones_like(reference) if weight is None else jnp.asarray(weight, reference.dtype)
    use = (base > 0.0) & (jnp.abs(reference - 1.0) >= floor)
    under = jnp.where(use, reference - 1.0, 1.0)
    return Factor(jnp.where(use, jnp.where(use, kappa - 1.0, 1.0) / under, 1.0), jnp.where(use, base, 0.0))


class Decomposition(eqx.Module):
    """lambda_rec = lambda_map * sl_factor on pixels that all three can use.

    Attributes:
        lam_rec: (kappa_wl - 1)/(kappa_sl - 1), `(y, x)`.
        lam_map: (kappa_wl - 1)/(kappa_true - 1), `(y, x)`.
        sl_factor: (kappa_true - 1)/(kappa_sl - 1), `(y, x)`; 1 for a perfect strong-lensing map.
        weight: 0 where one of the ratios is singular, `(y, x)`.
    """

    lam_rec: Map
    lam_map: Map
    sl_factor: Map
    weight: Map


def decompose(
    kappa_wl: Map, kappa_sl: Map, kappa_true: Map, weight: Map | None = None, *, floor: float = FLOOR
) -> Decomposition:
    """lambda_rec and its two factors, as stated in the paper; arguments as for `ratio`.

    The first factor scatters by shape noise, the second by errors of the strong-lensing map.
    """
    rec = ratio(kappa_wl, kappa_sl, weight, floor=floor)
    true = ratio(kappa_wl, kappa_true, rec.weight, floor=floor)
    sl = ratio(kappa_true, kappa_sl, true.weight, floor=floor)
    keep = lambda lam: jnp.where(sl.weight > 0.0, lam, 1.0)
    return Decomposition(keep(rec.lam), true.lam, sl.lam, sl.weight)


def from_redshift_pair(kappa_1: Values, kappa_2: Values, ratio_kappa: ScalarLike) -> Values:
    """lambda = 1 + (kappa_1 - R kappa_2)/(R - 1) from maps for two source redshifts.

    True convergences differ by the known R = kappa_1/kappa_2 = Sigma_cr(z_2)/Sigma_cr(z_1), their mass-sheet
    transforms do not: what is left gives the lambda that both share. It is 1 identically for the two
    convergences of one single-plane model; a measurement needs reconstructions from two bins of redshift.

    Args:
        kappa_1, kappa_2: convergence for sources at z_1 and z_2, `(...)`.
        ratio_kappa: R, not 1: `plane.dls_ds(z_1)/plane.dls_ds(z_2)`.

    Raises:
        ValueError: if R is 1 (seen only outside `jit`).
    """
    if not isinstance(ratio_kappa, Tracer) and not abs(float(np.asarray(ratio_kappa)) - 1.0) > 1e-9:
        raise ValueError(
            f"`ratio_kappa` is {float(np.asarray(ratio_kappa))}; two source redshifts with the same "
            "D_LS/D_S cannot tell a mass sheet: take bins further apart."
        )
    return 1.0 + (kappa_1 - ratio_kappa * kappa_2) / (ratio_kappa - 1.0)
