"""The paper's criterion: where the scatter of lambda_rec stops falling and begins to rise."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool

from jaxlens._types import Array, Float, Int, Scalar


class ScatterMinimum(eqx.Module):
    """The first minimum of a scatter profile.

    Attributes:
        found: the scatter falls and then rises, `()`; if it does not, the numbers mean nothing.
        index: annulus of the minimum, `()`.
        radius: its middle, `()`.
        lo, hi: middles of the last annulus in which the scatter still falls and of the first in which it
            rises, `()`.
    """

    found: Bool[Array, ""]
    index: Int[Array, ""]
    radius: Scalar
    lo: Scalar
    hi: Scalar


def scatter_minimum(r: Float[Array, " b"], scatter: Float[Array, " b"]) -> ScatterMinimum:
    """First annulus into which the scatter falls and after which it rises.

    The *first*: far out the scatter falls again, because kappa does.

    Args:
        r: middles of the annuli, `(b,)`, increasing.
        scatter: half of the 16-84 % range of lambda_rec, `(b,)`, at least three.
    """
    if len(r) < 3:
        raise ValueError(f"`scatter` has {len(r)} annuli; a minimum needs at least three.")
    turns = (scatter[1:-1] < scatter[:-2]) & (scatter[2:] > scatter[1:-1])
    found = jnp.any(turns)
    index = jnp.where(found, jnp.argmax(turns) + 1, 0)
    radius = jnp.where(found, r[index], 0.0)
    return ScatterMinimum(found, index, radius, radius, jnp.where(found, r[index + 1], 0.0))


class ScatterCriterion(eqx.Module):
    """The paper's criterion on the mean scatter, beside what chance makes of it.

    Attributes:
        minimum: of the mean scatter.
        agreement: share of the single realisations whose minimum is within one annulus of it, `()`.
        shares: share of the realisations with their minimum in each annulus, `(b,)`; the rest have none.
        null_minimum: the same for a perfect strong-lensing map, whose scatter has a minimum as well.
        null_agreement: share of *its* realisations within one annulus of `minimum`, `()`.
        null_shares: `(b,)`.
    """

    minimum: ScatterMinimum
    agreement: Scalar
    shares: Float[Array, " b"]
    null_minimum: ScatterMinimum
    null_agreement: Scalar
    null_shares: Float[Array, " b"]


def scatter_criterion(
    r: Float[Array, " b"], scatter: Float[Array, "n b"], null: Float[Array, "m b"]
) -> ScatterCriterion:
    """The scatter criterion over noise realisations, with its null distribution.

    On one realisation it carries no information: the scatter of an annulus is uncertain by 15 to 25 %, and a
    perfect strong-lensing map gives the same interval. Read `agreement` against `null_agreement`, and trust
    `excess_variance`.

    Args:
        r: middles of the annuli, `(b,)`.
        scatter: of lambda_rec in each realisation, `(n, b)`.
        null: the same with a perfect strong-lensing map, that is of lambda_map, `(m, b)`.
    """
    minimum, null_minimum = scatter_minimum(r, scatter.mean(axis=0)), scatter_minimum(r, null.mean(axis=0))

    def judge(many: Array) -> tuple[Array, Array]:
        each = jax.vmap(lambda one: scatter_minimum(r, one))(many)
        hits = each.found[:, None] & (each.index[:, None] == jnp.arange(len(r))[None, :])
        near = each.found & (jnp.abs(each.index - minimum.index) <= 1) & minimum.found
        return jnp.mean(near.astype(r.dtype)), jnp.mean(hits.astype(r.dtype), axis=0)

    agreement, shares = judge(scatter)
    null_agreement, null_shares = judge(null)
    return ScatterCriterion(minimum, agreement, shares, null_minimum, null_agreement, null_shares)
