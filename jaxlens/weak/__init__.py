"""Weak lensing: the convergence from noisy, masked reduced shear."""

from jaxlens.weak._shear import ShearMap

__all__ = ["ShearMap"]
