"""Weak lensing: the convergence from noisy, masked reduced shear."""

from jaxlens.mass_sheet import regauge
from jaxlens.weak._akra import AkraCG, AkraDense, KaiserSquires
from jaxlens.weak._aperture import FILTERS, ApertureMap, aperture_map, aperture_mass, coverage
from jaxlens.weak._batch import ReconstructionBatch, reconstruct_many
from jaxlens.weak._catalogue import (
    Depth,
    Galaxies,
    background,
    depth,
    draw_redshifts,
    resample,
    rotate,
    scramble,
    select,
    shape_scatter,
    shape_weight,
    to_grid,
    to_ratio,
    to_single_plane,
)
from jaxlens.weak._halo import HaloFit, Prior, fit_halo, fitted_shear, halo_shear
from jaxlens.weak._iterate import Reconstruction
from jaxlens.weak._noise import (
    NoisyShear,
    capacity_of,
    mean_counts,
    observed_ellipticity,
    shape_noise,
)
from jaxlens.weak._operator import ShearOperator, kaiser_squires, shear_of
from jaxlens.weak._peak import Peak, peak
from jaxlens.weak._profile import (
    BootstrapErrors,
    Significance,
    TangentialProfile,
    bootstrap,
    significance,
    stack,
    tangential,
    tangential_profile,
)
from jaxlens.weak._residual import explained_shear, residual_b_mode
from jaxlens.weak._schemes import dense_inverse, reconstruct
from jaxlens.weak._settings import SCHEMES, Scheme
from jaxlens.weak._shear import ShearMap
from jaxlens.weak._smooth import cosine_mask, sigmoid_mask, smooth

__all__ = [
    "FILTERS",
    "SCHEMES",
    "AkraCG",
    "AkraDense",
    "ApertureMap",
    "BootstrapErrors",
    "Depth",
    "Galaxies",
    "HaloFit",
    "KaiserSquires",
    "NoisyShear",
    "Peak",
    "Prior",
    "Reconstruction",
    "ReconstructionBatch",
    "Scheme",
    "ShearMap",
    "ShearOperator",
    "Significance",
    "TangentialProfile",
    "aperture_map",
    "aperture_mass",
    "background",
    "bootstrap",
    "capacity_of",
    "cosine_mask",
    "coverage",
    "dense_inverse",
    "depth",
    "draw_redshifts",
    "explained_shear",
    "fit_halo",
    "fitted_shear",
    "halo_shear",
    "kaiser_squires",
    "mean_counts",
    "observed_ellipticity",
    "peak",
    "reconstruct",
    "reconstruct_many",
    "regauge",
    "resample",
    "residual_b_mode",
    "rotate",
    "scramble",
    "select",
    "shape_noise",
    "shape_scatter",
    "shape_weight",
    "shear_of",
    "sigmoid_mask",
    "significance",
    "smooth",
    "stack",
    "tangential",
    "tangential_profile",
    "to_grid",
    "to_ratio",
    "to_single_plane",
]
