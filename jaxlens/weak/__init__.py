"""Weak lensing: the convergence from noisy, masked reduced shear."""

from jaxlens.weak._akra import AkraCG, AkraDense, KaiserSquires
from jaxlens.weak._batch import ReconstructionBatch, reconstruct_many
from jaxlens.weak._iterate import Reconstruction, regauge
from jaxlens.weak._noise import (
    NoisyShear,
    capacity_of,
    mean_counts,
    observed_ellipticity,
    rotate,
    shape_noise,
)
from jaxlens.weak._operator import ShearOperator, kaiser_squires, shear_of
from jaxlens.weak._schemes import SCHEMES, Scheme, dense_inverse, reconstruct
from jaxlens.weak._shear import ShearMap
from jaxlens.weak._smooth import cosine_mask, sigmoid_mask, smooth

__all__ = [
    "SCHEMES",
    "AkraCG",
    "AkraDense",
    "KaiserSquires",
    "NoisyShear",
    "Reconstruction",
    "ReconstructionBatch",
    "Scheme",
    "ShearMap",
    "ShearOperator",
    "capacity_of",
    "cosine_mask",
    "dense_inverse",
    "kaiser_squires",
    "mean_counts",
    "observed_ellipticity",
    "reconstruct",
    "reconstruct_many",
    "regauge",
    "rotate",
    "shape_noise",
    "shear_of",
    "sigmoid_mask",
    "smooth",
]
