"""The linear inversions: Kaiser-Squires, and the masked least-squares one by CG or by a dense map.

AKRA: kappa = argmin over the modes of the band of sum_x w |D kappa - gamma|^2 + R |kappa|^2, that is
H kappa = D^T w gamma with H = D^T w D + R. Padding and masked pixels have weight 0: their shear is
unknown, not zero. The spectrum of H lies in [R, max w + R].

An inversion has three methods: `start` makes its state from a map, `solve` the next state from a shear (the
old state is only a first guess), and `field` the map from a state. All are linear.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxlens._types import Array, ComplexMap, Float, Map
from jaxlens.weak._operator import ShearOperator

DENSE_LIMIT = 80 * 80
"""Most pixels of a dense map: its set-up takes memory as pixels^2 and time as pixels^3."""


def conjugate_gradients(matvec: Callable[[Array], Array], b: Array, tol: float, max_steps: int) -> Array:
    """Solve A x = b for a symmetric positive A, from 0, until |b - A x| <= tol |b|.

    The derivative is that of the exact solution: one more solve, by the same method.
    """

    def solve(multiply: Callable[[Array], Array], rhs: Array) -> Array:
        goal = tol**2 * jnp.sum(rhs**2)

        def going(carry: tuple[Array, ...]) -> Array:
            *_, rho, step = carry
            return (rho > goal) & (step < max_steps)

        def body(carry: tuple[Array, ...]) -> tuple[Array, ...]:
            x, r, p, rho, step = carry
            q = multiply(p)
            length = rho / jnp.sum(p * q)
            r = r - length * q
            new = jnp.sum(r**2)
            return x + length * p, r, r + (new / rho) * p, new, step + 1

        start = (jnp.zeros_like(rhs), rhs, rhs, jnp.sum(rhs**2), jnp.zeros((), jnp.int32))
        return lax.while_loop(going, body, start)[0]

    return lax.custom_linear_solve(matvec, b, solve, symmetric=True)


class KaiserSquires(eqx.Module):
    """kappa = D^T(m gamma) with a multiplicative mask m; the state is the map.

    Attributes:
        operator: D.
        weight: m, `(y, x)`.
    """

    operator: ShearOperator
    weight: Map

    def start(self, kappa: Map) -> Array:
        """The map itself."""
        return kappa

    def field(self, state: Array) -> Map:
        """The map itself."""
        return state

    def solve(self, gamma: ComplexMap, state: Array) -> Array:
        """The map of a shear."""
        del state
        return self.operator.values(self.operator.adjoint(self.weight * gamma))


class AkraCG(eqx.Module):
    """Masked least squares by conjugate gradients on the modes: memory linear in pixels, 4 FFTs per step.

    Attributes:
        operator: D.
        weight: w >= 0, `(y, x)`.
        ridge: R > 0.
        tol: factor by which each solve, also one of a derivative, reduces its residual.
        max_steps: most steps of one solve.
    """

    operator: ShearOperator
    weight: Map
    ridge: Array
    tol: float = eqx.field(static=True, default=1e-4)
    max_steps: int = eqx.field(static=True, default=400)

    def start(self, kappa: Map) -> Array:
        """Modes of a map."""
        return self.operator.modes(kappa)

    def field(self, state: Array) -> Map:
        """The map of modes."""
        return self.operator.values(state)

    def solve(self, gamma: ComplexMap, state: Array) -> Array:
        """Modes of argmin, from the first guess `state`."""
        op = self.operator
        normal = lambda x: op.adjoint(self.weight * op.shear(x)) + self.ridge * x
        guess = lax.stop_gradient(state)
        rest = op.adjoint(self.weight * gamma) - normal(guess)
        return guess + conjugate_gradients(normal, rest, self.tol, self.max_steps)


class AkraDense(eqx.Module):
    """The same map as one matrix, for a fixed mask: it serves all iterations and all noise realisations.

    P = C (S D D^T S + R)^-1 S with S = sqrt(w), C = D^T S on the field: the least-squares solution written in
    the space of the data, so that one Cholesky factor of size 2 n_y n_x does.

    Attributes:
        matrix: P, `(n_y n_x, 2 n_y n_x)`: from (gamma_1, gamma_2) to kappa.
        weight: w, `(y, x)`.
        operator: D.
        ridge: R.
    """

    matrix: Float[Array, "p q"]
    weight: Map
    operator: ShearOperator
    ridge: Array

    def start(self, kappa: Map) -> Array:
        """The map itself."""
        return kappa

    def field(self, state: Array) -> Map:
        """The map itself."""
        return state

    def solve(self, gamma: ComplexMap, state: Array) -> Array:
        """The map of a shear."""
        del state
        return self.many(gamma[None])[0]

    def many(self, gamma: Array) -> Array:
        """Maps of several shears at once, `(m, y, x)` complex to `(m, y, x)`."""
        known = jnp.where(self.weight > 0.0, gamma, jnp.zeros((), gamma.dtype))
        flat = known.reshape(len(gamma), -1)
        data = jnp.concatenate([flat.real, flat.imag], axis=1)
        return (data @ self.matrix.T).reshape(len(gamma), *self.weight.shape)


def dense(operator: ShearOperator, weight: Map, ridge: float | Array) -> AkraDense:
    """Set up `AkraDense`; seconds and about 600 MB for 48 x 48 pixels in double precision.

    Raises:
        ValueError: for more than 6400 pixels; `AkraCG` serves those.
    """
    if weight.size > DENSE_LIMIT:
        raise ValueError(
            f"`weight` has {weight.size} pixels; a dense map is limited to {DENSE_LIMIT}. Use conjugate "
            "gradients (`reconstruct` without `inverse`), or rebin."
        )
    c, s = operator.multipliers()
    products = np.stack([c, s, c * c, c * s, s * s])
    kernels = jnp.asarray(np.fft.irfft2(products, s=operator.padded), weight.dtype)
    matrix = _dense_matrix(operator, kernels, weight, jnp.asarray(ridge, weight.dtype))
    return AkraDense(matrix, weight, operator, jnp.asarray(ridge, weight.dtype))


@eqx.filter_jit
def _dense_matrix(operator: ShearOperator, kernels: Array, weight: Map, ridge: Array) -> Array:
    (n_y, n_x), (p_y, p_x) = operator.shape, operator.padded
    size = n_y * n_x
    offset = lambda n, p: (np.arange(n)[:, None] - np.arange(n)[None, :]) % p

    def toeplitz(kernel: Array) -> Array:
        """The matrix of a convolution on the torus between pixels of the field."""
        blocks = kernel[offset(n_y, p_y)][:, :, offset(n_x, p_x)]  # (y, y', x, x')
        return blocks.transpose(0, 2, 1, 3).reshape(size, size)

    root = jnp.sqrt(jnp.concatenate([weight.ravel()] * 2))
    c, s, cc, cs, ss = (toeplitz(kernel) for kernel in kernels)
    gram = jnp.block([[cc, cs], [cs, ss]])
    gram = root[:, None] * gram * root[None, :] + ridge * jnp.eye(2 * size, dtype=weight.dtype)
    back = jnp.concatenate([c, s], axis=1) * root[None, :]
    factor = jax.scipy.linalg.cho_factor(gram, lower=True, overwrite_a=True)
    return jax.scipy.linalg.cho_solve(factor, back.T).T * root[None, :]


Inversion = KaiserSquires | AkraCG | AkraDense
