"""The derivative rule of a stacked sum of profiles, against differences and against plain autodiff.

The sum over a component has a custom rule that computes the partial derivatives of each profile once and
contracts them with all directions. Here its Jacobian in every number of a component and in the positions, in
forward and reverse mode, is compared with `jax.jvp` of the same sum without the rule and with finite
differences.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from support import differences, strewn
from test_profiles import ENTRIES, general

from jaxlens import _component as component_module
from jaxlens import lens as lens_module
from jaxlens.lens import Lens, alpha, source_and_jacobian
from jaxlens.profiles import NFW, PROFILES, SIE, TSIS, Profile, Shear

ALL = ("potential", "deflection", "field")
FIELD = ("field",)
POINTS = 3


def flat(sums: Any, kinds: tuple[str, ...], arguments: Any) -> jax.Array:
    """All outputs of the kinds for (component, theta), as one vector."""
    component, theta = arguments
    return jnp.concatenate([jnp.concatenate(sums(kind, component, theta)) for kind in kinds])


@partial(jax.jit, static_argnums=(0, 1))
def compared(kinds: tuple[str, ...], unravel: Any, vector: Any) -> dict[str, jax.Array]:
    """The outputs and their Jacobians by the rule, in both modes, and by plain autodiff."""
    ruled = lambda v: flat(component_module.sum_of, kinds, unravel(v))
    plain = lambda v: flat(component_module._sum_plain, kinds, unravel(v))
    return {
        "value": ruled(vector),
        "plain": jax.jacfwd(plain)(vector),
        "forward": jax.jacfwd(ruled)(vector),
        "reverse": jax.jacrev(ruled)(vector),
    }


def assert_rows_close(found: Any, expected: Any, rtol: float) -> None:
    """Equality relative to the largest derivative of the same output."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert_allclose(found / scales(expected), expected / scales(expected), rtol=0, atol=rtol)


def scales(jacobian: np.ndarray) -> np.ndarray:
    return np.maximum(np.abs(jacobian).max(axis=1, keepdims=True), 1e-12)


@pytest.mark.parametrize(
    ("entry", "n", "kinds"),
    # A field holds the deflection; the rule is the same for all kinds: one profile with each is enough.
    [
        *((entry, 2, FIELD) for entry in ENTRIES),
        (PROFILES[TSIS], 2, ALL),
        (PROFILES[SIE], 6, ("deflection",)),
    ],
    ids=lambda v: v.name if isinstance(v, Profile) else str(len(v)) if isinstance(v, tuple) else str(v),
)
def test_rule_equals_plain_autodiff_and_differences(entry: Profile, n: int, kinds: tuple[str, ...]):
    theta = jnp.asarray(strewn(POINTS, seed=11, min_radius=2.0, max_radius=60.0))
    vector, unravel = ravel_pytree((general(entry, n, seed=1), theta))
    found = compared(kinds, unravel, vector)
    # The same arithmetic in another order.
    assert_rows_close(found["forward"], found["plain"], rtol=1e-12)
    assert_rows_close(found["reverse"], found["plain"], rtol=1e-12)
    step = 1e-3 * np.maximum(np.abs(vector), 0.1)
    expected = differences(lambda v: compared(kinds, unravel, v)["value"], vector, step).T
    # Fourth order with relative steps of 1e-3: 1e-9, where profiles bend on the scale of their radii.
    assert_rows_close(found["forward"], expected, rtol=3e-8)


@pytest.mark.parametrize("entry", [PROFILES[SIE]], ids=["sie"])
def test_one_number_at_a_time_gives_the_columns_of_the_whole(entry: Profile):
    # Numbers that do not vary are symbolic zeros in the rule: every subset is another path through it.
    component, theta = general(entry, 2, seed=2), jnp.asarray(strewn(POINTS, seed=12, min_radius=2.0))
    leaves, structure = jax.tree.flatten((component, theta))

    def value(*some: Any) -> jax.Array:
        return jnp.concatenate(component_module.sum_of("deflection", *jax.tree.unflatten(structure, some)))

    @jax.jit
    def both(*some: Any) -> Any:
        each = tuple(jax.jacfwd(value, argnums=k)(*some) for k in range(len(some)))
        return jax.jacfwd(value, argnums=tuple(range(len(some))))(*some), each

    together, apart = both(*leaves)
    for a, b in zip(together, apart, strict=True):
        assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def small_lens() -> Lens:
    """One rule inside another (NFW), a sum long enough to be scanned, a field that is a mere factor."""
    return Lens(halo=general(PROFILES[NFW], 1, seed=3), shear=general(PROFILES[Shear], 5, seed=3))


def merit(arguments: Any) -> jax.Array:
    """A smooth scalar with all first and second derivatives of the potential in it."""
    lens, theta = arguments
    beta, a = source_and_jacobian(lens, theta, 0.7)
    return jnp.sum(beta**2) / 100.0 + jnp.sum(a**4)


@pytest.mark.long
def test_second_derivatives_equal_differences_of_the_gradient():
    theta = jnp.asarray(strewn(POINTS, seed=13, min_radius=5.0, max_radius=60.0))
    vector, unravel = ravel_pytree((small_lens(), theta))
    gradient = jax.jit(jax.grad(lambda v: merit(unravel(v))))
    directions = jnp.asarray(np.random.default_rng(0).normal(size=(4, len(vector))))
    # Forward over reverse, as Newton's method and samplers use it.
    found = jax.jit(lambda v: jax.lax.map(lambda d: jax.jvp(gradient, (v,), (d,))[1], directions))(vector)
    expected = differences(lambda s: gradient(vector + jnp.asarray(s) @ directions), np.zeros(4), 1e-3)
    assert_allclose(found, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


def test_vmap_over_lenses_equals_a_loop():
    # Hypothetical lenses of a sampler: the gradient of many at once.
    theta = jnp.asarray(strewn(POINTS, seed=14, min_radius=5.0, max_radius=60.0))
    lenses = [jax.tree.map(lambda v, f=f: f * v, small_lens()) for f in (0.9, 1.0, 1.1)]
    gradient = jax.jit(jax.grad(lambda lens: merit((lens, theta))))
    stacked = jax.tree.map(lambda *v: jnp.stack(v), *lenses)
    together = jax.jit(jax.vmap(jax.grad(lambda lens: merit((lens, theta)))))(stacked)
    for k, lens in enumerate(lenses):
        # Batched matrix products add in another order.
        jax.tree.map(
            lambda a, b, k=k: assert_allclose(a[k], b, rtol=1e-10, atol=1e-12), together, gradient(lens)
        )


@pytest.mark.parametrize("tile", [lens_module.TILE, lens_module.WIDE // 2, lens_module.WIDE])
def test_position_derivative_of_alpha_is_the_hessian_also_beyond_one_tile(tile: int):
    # Above `TILE` positions the work is mapped over tiles, above half of `WIDE` values and derivatives over
    # different ones; the derivative must survive that.
    lens = Lens(members=general(PROFILES[TSIS], 5, seed=6), shear=general(PROFILES[Shear], 1, seed=6))
    theta = jnp.asarray(strewn(tile + 5, seed=16))
    weight = jnp.asarray(np.random.default_rng(1).normal(size=theta.shape))
    slope = jax.jit(jax.grad(lambda t: jnp.sum(weight * alpha(lens, t))))(theta)
    _, hessian = jax.jit(lens_module.alpha_and_hessian)(lens, theta)
    assert_allclose(slope, jnp.einsum("ijk,ij->ik", hessian, weight), rtol=1e-9, atol=1e-12)


def test_gradient_and_jacobian_beyond_half_a_wide_tile():
    """Against sums over parts of at most one tile each; some numbers vary, others do not."""
    members: Any = general(PROFILES[TSIS], 5, seed=6)
    theta = jnp.asarray(strewn(lens_module.WIDE // 2 + 5, seed=16))

    def total(scale: Any, theta: Any) -> Any:
        lens = Lens(members=eqx.tree_at(lambda m: m.params.r_t, members, scale[0] * members.params.r_t))
        a, hessian = lens_module.alpha_and_hessian(lens, theta + scale[1])
        return jnp.stack([jnp.mean(a**2), jnp.mean(hessian**2)])

    at = jnp.array([1.1, 0.3])
    found = jax.jit(jax.jacfwd(total))(at, theta)
    reverse = jax.jit(jax.jacrev(total))(at, theta)
    parts = jnp.split(theta[: lens_module.WIDE // 2], 32)
    rest = theta[lens_module.WIDE // 2 :]
    one = jax.jit(jax.jacfwd(total))
    sums = sum(len(part) * one(at, part) for part in [*parts, rest])
    assert_allclose(found, sums / len(theta), rtol=1e-10)
    assert_allclose(reverse, found, rtol=1e-10)
