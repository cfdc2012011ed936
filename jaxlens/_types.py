"""Array type aliases. Shapes only; no logic.

`*batch` is any leading shape; the last axis of a point has size 2, (theta_1, theta_2).
"""

from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Complex, Float, Int, Key, Real

Scalar = Float[Array, ""]
ScalarLike = Real[ArrayLike, ""]
Point = Float[Array, "2"]
Points = Float[Array, "*batch 2"]
Values = Float[Array, "*batch"]
Spin2 = Complex[Array, "*batch"]
Hessian = Float[Array, "*batch 2 2"]
Map = Float[Array, "y x"]
ComplexMap = Complex[Array, "y x"]
Mask = Bool[Array, "*batch"]
Index = Int[Array, "*batch"]
RandomKey = Key[Array, ""]

__all__ = [
    "Array",
    "ArrayLike",
    "Bool",
    "Complex",
    "ComplexMap",
    "Float",
    "Hessian",
    "Index",
    "Int",
    "Map",
    "Mask",
    "Point",
    "Points",
    "RandomKey",
    "Real",
    "Scalar",
    "ScalarLike",
    "Spin2",
    "Values",
]
