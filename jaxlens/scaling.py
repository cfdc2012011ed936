"""Cluster members on luminosity scaling relations."""

import jax.numpy as jnp

from jaxlens._types import Array, Float, Points, ScalarLike
from jaxlens.lens import Component
from jaxlens.profiles import dpie
from jaxlens.profiles._profile import as_float

CONVENTIONS = ("dpie", "dpie_lenstool")


def members(
    theta: Points,
    luminosity: Float[Array, " n"],
    *,
    sigma_ref: ScalarLike,
    r_cut_ref: ScalarLike,
    r_core_ref: ScalarLike = 0.0,
    e: Float[Array, " n"] | ScalarLike = 0.0,
    pa: Float[Array, " n"] | ScalarLike = 0.0,
    sigma_exponent: float = 0.25,
    cut_exponent: float = 0.5,
    core_exponent: float = 0.5,
    convention: str = "dpie",
) -> Component:
    """Members as dPIEs with sigma = sigma_ref L^alpha, r_cut = r_cut_ref L^beta, r_core = r_core_ref L^delta.

    The exponents 1/4 and 1/2 keep a constant mass-to-light ratio with the Faber-Jackson relation
    (Brainerd, Blandford & Smail 1996).

    Args:
        theta: positions, `(n, 2)`, arcsec.
        luminosity: L/L_ref, `(n,)`.
        sigma_ref: velocity dispersion of the reference galaxy, km/s.
        r_cut_ref, r_core_ref: its radii, arcsec.
        e: ellipticity 1 - b/a of the mass, `(n,)`; with `convention="dpie_lenstool"` it is
            (a^2-b^2)/(a^2+b^2).
        pa: position angles from +theta_1 towards +theta_2, `(n,)`, rad.
        sigma_exponent, cut_exponent, core_exponent: alpha, beta, delta.
        convention: `"dpie"` for b = 4 pi (sigma/c)^2, `"dpie_lenstool"` for Lenstool's numbers.

    Returns:
        One component of n profiles.

    Raises:
        ValueError: if the convention is unknown.
    """
    if convention not in CONVENTIONS:
        raise ValueError(f"`convention` is {convention!r}; choose one of {CONVENTIONS}.")
    light = as_float(luminosity)
    sigma = sigma_ref * light**sigma_exponent
    core = r_core_ref * light**core_exponent
    cut = r_cut_ref * light**cut_exponent
    if convention == "dpie_lenstool":
        params = dpie.from_lenstool(sigma, core, cut, ellipticity=jnp.asarray(e))
    else:
        params = dpie.from_sigma_v(sigma, core, cut, e=jnp.asarray(e))
    return Component(params, theta, pa)
