"""Monte Carlo over shape noise: lambda over both probes, thousands of times with two compiled programs."""

from jaxlens.monte_carlo._draw import draw, noise_maps
from jaxlens.monte_carlo._measure import Measured, aligned_clean, measure, noiseless
from jaxlens.monte_carlo._run import Checkpoint, LambdaProfiles, fingerprint, lambda_profiles
from jaxlens.monte_carlo._setup import BLOCK, METHODS, RANGES, Setup, prepare

__all__ = [
    "BLOCK",
    "METHODS",
    "RANGES",
    "Checkpoint",
    "LambdaProfiles",
    "Measured",
    "Setup",
    "aligned_clean",
    "draw",
    "fingerprint",
    "lambda_profiles",
    "measure",
    "noise_maps",
    "noiseless",
    "prepare",
]
