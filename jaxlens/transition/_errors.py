"""Errors of both maps against a truth, and where they are equal: simulations only."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Bool

from jaxlens._types import Array, Float, Int, Map, Scalar
from jaxlens.mass_sheet import regauge
from jaxlens.radial import Annuli, rmse_in
from jaxlens.transition._sheet import sheet_between


class MapErrors(eqx.Module):
    """RMSE(r) of both maps, as stated in the paper.

    Attributes:
        wl: of the weak-lensing map corrected by lambda_P, `(b,)`.
        sl: of the strong-lensing map, `(b,)`.
        comparable: annuli in which they differ by less than half of their mean, `(b,)`.
    """

    wl: Float[Array, " b"]
    sl: Float[Array, " b"]
    comparable: Bool[Array, " b"]


def comparable(wl: Float[Array, " b"], sl: Float[Array, " b"], share: float = 0.5) -> Bool[Array, " b"]:
    """|RMSE_SL - RMSE_WL| < share (RMSE_SL + RMSE_WL)/2: the paper's transition region, `(b,)`."""
    return jnp.abs(sl - wl) < 0.5 * share * (sl + wl)


def map_errors(
    kappa_corr: Map, kappa_sl: Map, kappa_true: Map, rings: Annuli, weight: Map | None = None
) -> MapErrors:
    """RMSE of both maps in annuli; arguments are maps smoothed alike, `(y, x)`.

    The strong-lensing error that is proportional to 1 - kappa is in both: lambda_P takes it over and the
    corrected map inherits it. See `shape_errors`.
    """
    wl, sl = (rmse_in(kappa - kappa_true, rings, weight) for kappa in (kappa_corr, kappa_sl))
    return MapErrors(wl, sl, comparable(wl, sl))


class ShapeErrors(eqx.Module):
    """RMSE(r) of both maps after each was given its best mass sheet.

    Attributes:
        wl, sl: RMSE of the regauged maps, `(b,)`.
        lam_wl, lam_sl: their mass-sheet factors, medians of (kappa - 1)/(kappa_true - 1), `()`.
        comparable: annuli in which the errors differ by less than half of their mean, `(b,)`.
    """

    wl: Float[Array, " b"]
    sl: Float[Array, " b"]
    lam_wl: Scalar
    lam_sl: Scalar
    comparable: Bool[Array, " b"]


def shape_errors(
    kappa_wl: Map, kappa_sl: Map, kappa_true: Map, rings: Annuli, weight: Map | None = None
) -> ShapeErrors:
    """Errors of both maps once their mass sheets are taken out: what a comparison of the two can see.

    An error proportional to 1 - kappa is a mass sheet and invisible in lambda_rec. So kappa - 1 of either
    map is divided by its own median lambda against the truth over all annuli, and then compared with it
    (our choice).

    Args:
        kappa_wl, kappa_sl, kappa_true: maps smoothed alike, `(y, x)`.
        rings: annuli, see `radial.annuli`.
        weight: further pixels to leave out, `(y, x)`.

    Returns:
        Errors; differentiable in the maps.
    """

    def one(kappa: Map) -> tuple[Array, Array]:
        lam = sheet_between(kappa, kappa_true, rings, weight)
        return lam, rmse_in(regauge(kappa, lam) - kappa_true, rings, weight)

    (lam_wl, wl), (lam_sl, sl) = one(kappa_wl), one(kappa_sl)
    return ShapeErrors(wl, sl, lam_wl, lam_sl, comparable(wl, sl))


class Crossings(eqx.Module):
    """Where two profiles are equal; one place for each gap between annuli.

    Attributes:
        radius: of the crossing, linear between the middles of the annuli, `(b - 1,)`; 0 where there is none.
        direction: +1 where the first profile becomes the larger one, -1 where the second does, else 0,
            `(b - 1,)`.
    """

    radius: Float[Array, " c"]
    direction: Int[Array, " c"]


def crossings(r: Float[Array, " b"], first: Float[Array, " b"], second: Float[Array, " b"]) -> Crossings:
    """All crossings of two profiles, e.g. of RMSE_SL and RMSE_WL: +1 is the change from SL to WL.

    Args:
        r: radii, `(b,)`, increasing.
        first, second: the profiles, `(b,)`.
    """
    ahead = first > second
    change = ahead[1:].astype(jnp.int32) - ahead[:-1].astype(jnp.int32)
    gap = first - second
    span = gap[1:] - gap[:-1]
    share = -gap[:-1] / jnp.where(change != 0, span, 1.0)
    radius = r[:-1] + share * (r[1:] - r[:-1])
    return Crossings(jnp.where(change != 0, radius, 0.0), change)
