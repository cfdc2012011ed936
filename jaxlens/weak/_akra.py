"""The linear inversions: Kaiser-Squires, and the masked least-squares one by CG or by a dense map.

AKRA: kappa = argmin over the modes of the band of sum_x w |D kappa - gamma|^2 + R |kappa|^2, that is
H kappa = D^T w gamma with H = D^T w D + R. Padding and masked pixels have weight 0: their shear is
unknown, not zero. The spectrum of H lies in [R, max w + R].

An inversion has three methods: `start` makes a first state, `solve` the next state from a shear (the old
state is only a first guess), and `field` the map from a state. All are linear.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from jaxlens._types import Array, ComplexMap, Float, Int, Map
from jaxlens.weak._operator import ShearOperator

DENSE_LIMIT = 80 * 80
"""Most pixels of a dense map: its set-up takes memory as pixels^2 and time as pixels^3."""


def conjugate_gradients(
    matvec: Callable[[Array], Array], b: Array, tol: float | Array, max_steps: int
) -> Array:
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

    def start(self) -> Array:
        """Nothing is known."""
        return jnp.zeros_like(self.weight)

    def field(self, state: Array) -> Map:
        """The map itself."""
        return state

    def solve(self, gamma: ComplexMap, state: Array) -> Array:
        """The map of a shear."""
        del state
        return self.operator.values(self.operator.adjoint(self.weight * gamma))

    def residual(self, gamma: ComplexMap, state: Array) -> Array:
        """0: nothing is solved."""
        del gamma, state
        return jnp.zeros((), self.weight.dtype)


class AkraCG(eqx.Module):
    """Masked least squares by conjugate gradients: memory linear in pixels, 2 complex FFTs per step.

    The solution is kappa = D^T S y with (S D D^T S + R) y = S gamma and S = sqrt(w): the same map as from
    the normal equations, but the unknowns y live on the pixels of the field, four times fewer than modes, and
    the error of kappa is at most 1/(2 sqrt R) times the residual, where the normal equations have 1/R.

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
    tol: float | Array = 1e-4
    max_steps: int = eqx.field(static=True, default=400)

    @property
    def root(self) -> Map:
        """S, with a finite derivative where it is 0."""
        known = self.weight > 0.0
        return jnp.where(known, jnp.sqrt(jnp.where(known, self.weight, 1.0)), 0.0)

    def start(self) -> Array:
        """y = 0: real and imaginary part, `(2, y, x)`."""
        return jnp.zeros((2, *self.weight.shape), self.weight.dtype)

    def field(self, state: Array) -> Map:
        """The map kappa = D^T S y."""
        return self.operator.values(self.operator.adjoint(self.root * lax.complex(state[0], state[1])))

    def shear(self, state: Array) -> ComplexMap:
        """D kappa."""
        return self.operator.e_mode(self.root * lax.complex(state[0], state[1]))

    def solve(self, gamma: ComplexMap, state: Array) -> Array:
        """y of a shear, from the best multiple of the first guess `state`."""
        normal, b = self._system(gamma)
        guess = lax.stop_gradient(state)
        image = normal(guess)
        square = jnp.sum(image**2)
        scale = lax.stop_gradient(jnp.sum(image * b) / jnp.where(square > 0.0, square, 1.0))
        rest = conjugate_gradients(normal, b - scale * image, self.tol, self.max_steps)
        return scale * guess + rest

    def _system(self, gamma: ComplexMap) -> tuple[Callable[[Array], Array], Array]:
        """S D D^T S + R, and S gamma."""
        root = self.root

        def normal(y: Array) -> Array:
            image = root * self.operator.e_mode(root * lax.complex(y[0], y[1]))
            return jnp.stack([image.real, image.imag]) + self.ridge * y

        return normal, jnp.stack([root * gamma.real, root * gamma.imag])

    def residual(self, gamma: ComplexMap, state: Array) -> Array:
        """|b - A y|/|b| of a state, computed anew; not differentiable."""
        gamma, state, inverse = lax.stop_gradient((gamma, state, self))
        normal, b = inverse._system(gamma)
        size = jnp.sqrt(jnp.sum(b**2))
        return jnp.sqrt(jnp.sum((b - normal(state)) ** 2)) / jnp.where(size > 0.0, size, 1.0)


class AkraDense(eqx.Module):
    """The same map as one matrix, for a fixed mask: it serves all iterations and all noise realisations.

    P = C (S D D^T S + R)^-1 S with S = sqrt(w), C = D^T S on the field: the least-squares solution written in
    the space of the d data, the pixels of positive weight and up to 1/8 of the others, so that one Cholesky
    factor of size 2 d does.

    Attributes:
        matrix: P, `(n_y n_x, 2 d)`: from (gamma_1, gamma_2) of the data to kappa.
        used: pixels of the data, places in the flattened map, `(d,)`; some may have weight 0, see `dense`.
        weight: w, `(y, x)`.
        operator: D.
        ridge: R.
        mask: the mask that `weight` has.
    """

    matrix: Float[Array, "p q"]
    used: Int[Array, " d"]
    weight: Map
    operator: ShearOperator
    ridge: Array
    mask: str = eqx.field(static=True, default="cosine")

    def start(self) -> Array:
        """Nothing is known."""
        return jnp.zeros_like(self.weight)

    def field(self, state: Array) -> Map:
        """The map itself."""
        return state

    def residual(self, gamma: ComplexMap, state: Array) -> Array:
        """0: the factor is exact."""
        del gamma, state
        return jnp.zeros((), self.weight.dtype)

    def solve(self, gamma: ComplexMap, state: Array) -> Array:
        """The map of a shear."""
        del state
        return self.many(gamma[None])[0]

    def many(self, gamma: Array) -> Array:
        """Maps of several shears at once, `(m, y, x)` complex to `(m, y, x)`."""
        # Places stay places when all arrays of a module are cast to another precision.
        places = self.used.astype(jnp.int32)
        known = self.weight.ravel()[places] > 0.0
        flat = jnp.where(known, gamma.reshape(len(gamma), -1)[:, places], 0.0)
        data = jnp.concatenate([flat.real, flat.imag], axis=1)
        return (data @ self.matrix.T).reshape(len(gamma), *self.weight.shape)


def dense(operator: ShearOperator, weight: Map, ridge: float | Array, mask: str) -> AkraDense:
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
    ridge = jnp.asarray(ridge, weight.dtype)
    used = jnp.asarray(np.arange(weight.size) if isinstance(weight, Tracer) else _taking_part(weight))
    return AkraDense(
        _dense_matrix(operator, kernels, weight, used, ridge), used, weight, operator, ridge, mask
    )


def _taking_part(weight: Map) -> np.ndarray:
    """Places of the pixels with weight, and of as many others as make their number a multiple of 1/8 of all.

    The others get columns of zeros; masks that differ little then share compiled programs.
    """
    known = np.asarray(weight).ravel() > 0.0
    step = -(-known.size // 8)
    count = min(known.size, max(1, -(-int(known.sum()) // step)) * step)
    return np.sort(np.argsort(~known, kind="stable")[:count])


@eqx.filter_jit
def _dense_matrix(operator: ShearOperator, kernels: Array, weight: Map, used: Array, ridge: Array) -> Array:
    (_, n_x), (p_y, p_x) = operator.shape, operator.padded
    field = jnp.arange(weight.size)

    def places(to: Array, of: Array) -> Array:
        """Where in a kernel the offsets from pixels `of` to pixels `to` stand, both flattened."""
        rows = (to[:, None] // n_x - of[None, :] // n_x) % p_y
        return rows * p_x + (to[:, None] % n_x - of[None, :] % n_x) % p_x

    c, s, cc, cs, ss = kernels.reshape(len(kernels), -1)
    known = weight.ravel()[used]
    # The inner where keeps the derivative finite where the weight is 0.
    root = jnp.where(known > 0.0, jnp.sqrt(jnp.where(known > 0.0, known, 1.0)), 0.0)
    root = jnp.concatenate([root, root])
    at = places(used, used)
    gram = jnp.block([[cc[at], cs[at]], [cs[at], ss[at]]])
    gram = root[:, None] * gram * root[None, :] + ridge * jnp.eye(len(root), dtype=weight.dtype)
    at = places(field, used)
    back = jnp.concatenate([c[at], s[at]], axis=1) * root[None, :]
    factor = jax.scipy.linalg.cho_factor(gram, lower=True, overwrite_a=True)
    return jax.scipy.linalg.cho_solve(factor, back.T).T * root[None, :]


Inversion = KaiserSquires | AkraCG | AkraDense
