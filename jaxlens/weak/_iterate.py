"""The reduced-shear iteration: gamma <- g (1 - kappa), kappa <- P gamma."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool

from jaxlens._types import Array, ComplexMap, Float, Map, Scalar
from jaxlens.weak._akra import Inversion


class Reconstruction(eqx.Module):
    """A convergence map and how it came about.

    Attributes:
        kappa: E-mode convergence, `(y, x)`; a member of the mass-sheet family, see `regauge`.
        kappa_b: B-mode convergence from the final shear estimate, `(y, x)`. In a field with an edge some
            shear can be read as E and as B mode, so that a lens alone shows one; what lies beyond E is
            `residual_b_mode`.
        history: convergence after each iteration, `(t, y, x)`.
        change: root mean square of the change in unmasked pixels at each iteration, `(t,)`; the residual of
            the fixed-point equation for `solver="gmres"`.
        spectral_radius: factor by which the iteration finally multiplies its error; it diverges above 1.
        residual: of the linear solves of `kappa` and `kappa_b`, relative to their right-hand side, `(2,)`; 0
            where nothing is solved.
        converged: the last change is below the tolerance, the linear solves reached theirs and, for the plain
            iteration, the spectral radius is below 1.
        scheme, ridge, padding, band: what was asked for; maps of different settings differ by a mass sheet.
    """

    kappa: Map
    kappa_b: Map
    history: Float[Array, "t y x"]
    change: Float[Array, " t"]
    spectral_radius: Scalar
    residual: Float[Array, "2"]
    converged: Bool[Array, ""]
    scheme: str = eqx.field(static=True)
    ridge: float = eqx.field(static=True)
    padding: float = eqx.field(static=True)
    band: str = eqx.field(static=True)


def rms(values: Array, used: Array) -> Array:
    """Root mean square over the last two axes where `used`."""
    count = jnp.maximum(jnp.sum(used), 1)
    return jnp.sqrt(jnp.sum(jnp.where(used, values, 0.0) ** 2, axis=(-2, -1)) / count)


def picard(inverse: Inversion, g: ComplexMap, kappa0: Map, n_iter: int) -> tuple[Array, Array]:
    """The plain iteration from `kappa0`.

    Returns:
        Final state, and the convergence after each iteration `(n_iter, y, x)`.
    """

    def step(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], Array]:
        kappa, state = carry
        state = inverse.solve(g * (1.0 - kappa), state)
        kappa = inverse.field(state)
        return (kappa, state), kappa

    (_, state), history = lax.scan(step, (kappa0, inverse.start()), length=n_iter)
    return state, history


def gmres(inverse: Inversion, g: ComplexMap, *, tol: Scalar, max_steps: int) -> Map:
    """The fixed point itself, (1 + P g) kappa = P g, also where the plain iteration diverges.

    Its derivative is the implicit one: one solve with the transposed operator.
    """
    relative: Any = tol  # the solver's annotation knows floats only; it computes with arrays
    zero = inverse.start()
    apply = lambda gamma: inverse.field(inverse.solve(gamma, zero))
    kappa, _ = jax.scipy.sparse.linalg.gmres(
        lambda kappa: kappa + apply(g * kappa),
        apply(g),
        tol=relative,
        restart=max_steps,
        maxiter=1,
        solve_method="batched",
    )
    return kappa


def spectral_radius(inverse: Inversion, g: ComplexMap, n_steps: int) -> Scalar:
    """Largest |eigenvalue| of kappa -> P (g kappa) by power iteration from a fixed random map.

    The geometric mean of the growth over the second half of the steps, because the leading eigenvalues may be
    a complex pair. Not differentiable.
    """
    inverse, g = lax.stop_gradient((inverse, g))

    def step(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], Array]:
        v, state = carry
        state = inverse.solve(
            g * v, state
        )  # once v turns no more, the old state is the new one but for a factor
        new = inverse.field(state)
        growth = jnp.sqrt(jnp.sum(new**2))
        return (new / jnp.where(growth > 0.0, growth, 1.0), state), growth

    first = jax.random.normal(jax.random.key(0), g.shape, g.real.dtype)
    first = (first / jnp.sqrt(jnp.sum(first**2)), inverse.start())
    growth = lax.scan(step, first, length=n_steps)[1]
    late = growth[n_steps // 2 :]
    return jnp.exp(jnp.mean(jnp.log(jnp.maximum(late, jnp.finfo(late.dtype).tiny))))


def last_ratio(change: Array) -> Array:
    """Growth of the change over the last step: the differences of the iteration are a power iteration too."""
    if change.shape[-1] < 2:
        return jnp.full(change.shape[:-1], jnp.nan, change.dtype)
    floor = 100.0 * float(jnp.finfo(change.dtype).eps)  # below it the change is rounding
    return change[..., -1] / jnp.maximum(change[..., -2], floor)
