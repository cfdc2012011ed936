"""Radial statistics: annuli of maps, projected masses and Einstein radii of lenses."""

from jaxlens.radial._annuli import (
    Annuli,
    annuli,
    mean_in,
    profile_in,
    rmse_in,
    scatter,
    sector_sums,
    to_pixels,
)
from jaxlens.radial._mass import N_ANGLES, einstein_radius, mass_within, mean_kappa
from jaxlens.radial._statistics import RadialProfile, profile, quantiles, rmse

__all__ = [
    "N_ANGLES",
    "Annuli",
    "RadialProfile",
    "annuli",
    "einstein_radius",
    "mass_within",
    "mean_in",
    "mean_kappa",
    "profile",
    "profile_in",
    "quantiles",
    "rmse",
    "rmse_in",
    "scatter",
    "sector_sums",
    "to_pixels",
]
