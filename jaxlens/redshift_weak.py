"""What the errors of photometric redshifts do to a convergence map and to the mass of a halo."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import weak
from jaxlens._types import Array
from jaxlens.workflow_weak import Field, WeakSetup


class RedshiftSpread(NamedTuple):
    """Standard deviations over draws of the galaxies' redshifts; the shapes stay as they are.

    Attributes:
        draws: how many.
        dls_ds: of the D_LS/D_S that the map is for, <b^2>/<b>.
        kappa: of the convergence for the map's own D_LS/D_S, `(y, x)`.
        log10_mass: of log10 of the mass of the fitted halo.
    """

    draws: int
    dls_ds: float
    kappa: np.ndarray
    log10_mass: float


def redshift_spread(
    field: Field, setup: WeakSetup, profile: weak.TangentialProfile, keys: Array, **how: Any
) -> RedshiftSpread:
    """Map and halo for redshifts drawn between the percentiles of the catalogue, see `weak.draw_redshifts`.

    Each draw gives every galaxy a D_LS/D_S b of its own; the moments <b> and <b^2> turn the mean
    ellipticities into the shear of one source plane and enter the fit. The selection is that of the
    catalogue's redshifts.

    Args:
        field: with its catalogue.
        setup: that catalogue.
        profile: its tangential profile.
        keys: one for each draw.
        how: for `weak.reconstruct_many`.
    """
    depths = jax.lax.map(lambda key: weak.depth(setup.redrawn(key)), keys)
    ratios = depths.mean_square / depths.mean
    factors = ratios / depths.mean
    shear = field.shear
    one = lambda factor: weak.ShearMap(shear.g / field.factor * factor, shear.weight, shear.n_gal)
    maps = jax.vmap(one)(factors)
    kappa = weak.reconstruct_many(maps, field.grid, **how).kappa
    same = kappa * (field.header["DLSDS"] / ratios)[:, None, None]
    each = [jax.tree.map(lambda part, i=i: part[i], depths) for i in range(len(keys))]
    masses = [float(jnp.log10(setup.fit_halo(profile, depth).mass)) for depth in each]
    return RedshiftSpread(
        draws=len(keys),
        dls_ds=float(jnp.std(ratios, ddof=1)),
        kappa=np.std(np.asarray(same), axis=0, ddof=1),
        log10_mass=float(np.std(masses, ddof=1)),
    )
