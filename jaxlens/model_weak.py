"""The first guess of the scheme A3: the convergence of a fitted lens on the pixels of a shear map."""

import jax.numpy as jnp
import numpy as np

from jaxlens import io, prediction
from jaxlens import lens as lensing
from jaxlens._types import Map
from jaxlens.workflow_weak import Field

SAME_PLANE = 0.01
"""Largest difference between the redshifts of the model's lens and the field's."""


def first_guess(field: Field, source: str) -> Map:
    """kappa = D_LS/D_S kappa_model at the centres of the pixels, `(y, x)`.

    A model whose reference point differs from the field's is moved by their distance on the sky.

    Args:
        field: the shear map.
        source: a result directory of `jaxlens strong`, or a `model.toml`.

    Raises:
        FileNotFoundError: if there is no model.
        ValueError: if the model lies at another redshift, or outside of the map, or the depth is not known.
    """
    model = prediction.load(source)
    z_l, z_model = field.header.get("ZLENS"), float(model.plane.z_l)
    if z_l is not None and abs(float(z_l) - z_model) > SAME_PLANE:
        raise ValueError(
            f"{model.path}: the lens is at z = {z_model:g}, that of {field.name} at {float(z_l):g}; "
            "give the model of this cluster."
        )
    ratio, z_s = field.header.get("DLSDS"), field.header.get("ZSOURCE")
    if ratio is None:
        if z_s is None or not float(z_s) > z_model:
            raise ValueError(
                f"{field.name}: the shear map does not say how deep its galaxies lie; add DLSDS "
                "(D_LS/D_S), or ZSOURCE, a redshift behind the lens, to its header."
            )
        ratio = float(model.plane.dls_ds(float(z_s)))
    shift = np.zeros(2)
    if model.reference is not None and field.reference is not None:
        ra, dec = (np.array([part]) for part in model.reference)
        shift = io.offsets(ra, dec, field.reference)[0]
    size = 0.5 * field.grid.pixel * max(field.grid.shape)
    if not np.max(np.abs(shift - np.array(field.grid.centre))) < size:
        raise ValueError(
            f"{model.path}: the reference point {model.reference} lies outside of the map of {field.name}; "
            "give the model of this cluster."
        )
    return float(ratio) * lensing.kappa(model.lens, jnp.asarray(np.asarray(field.grid.theta) - shift))
