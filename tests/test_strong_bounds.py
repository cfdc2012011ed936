"""Free numbers: every bound is a bijection, and its prior is the uniform one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from jaxlens import strong

BOXES = {"linear": strong.Box(-3.0, 12.0), "log": strong.Box(0.5, 40.0, log=True)}


def vector(n: int, size: float = 4.0) -> st.SearchStrategy[list[float]]:
    return st.lists(st.floats(-size, size), min_size=n, max_size=n)


@pytest.mark.parametrize("box", BOXES.values(), ids=list(BOXES))
@given(u=vector(1))
def test_box_round_trip(box: strong.Box, u: list[float]) -> None:
    value = box.physical(jnp.asarray(u))
    assert float(box.lo) < float(value) < float(box.hi)
    # 1e-9: the logit near an edge loses digits of the place in the box.
    assert_allclose(box.unbounded(value), u, rtol=1e-9, atol=1e-9)


@given(u=vector(2))
def test_disc_round_trip(u: list[float]) -> None:
    disc = strong.Disc(0.8)
    value = disc.physical(jnp.asarray(u))
    assert float(jnp.linalg.norm(value)) < 0.8
    assert_allclose(disc.unbounded(value), u, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("bound", [*BOXES.values(), strong.Disc(0.3)], ids=[*BOXES, "disc"])
def test_values_on_the_edge_start_just_inside(bound: strong.Bound) -> None:
    edge = bound.hi if isinstance(bound, strong.Box) else jnp.array([0.3, 0.0])
    u = bound.unbounded(edge)
    assert np.all(np.isfinite(np.asarray(u)))
    assert_allclose(bound.physical(u), edge, rtol=5e-3)


def test_box_prior_is_normalised() -> None:
    u = jnp.linspace(-40.0, 40.0, 20001)
    density = jnp.exp(jax.vmap(lambda v: BOXES["linear"].log_prior(v[None]))(u))
    assert_allclose(jnp.trapezoid(density, u), 1.0, rtol=1e-6)


def test_disc_prior_is_normalised() -> None:
    # In polar coordinates of u the integrand is 1/(1+r^2)^(3/2), whose tail beyond R holds 1/(2 R^2).
    r = jnp.geomspace(1e-5, 1e3, 20001)
    density = jnp.exp(jax.vmap(lambda v: strong.Disc(0.5).log_prior(jnp.stack([v, 0.0 * v])))(r))
    assert_allclose(jnp.trapezoid(2.0 * jnp.pi * r * density, r), 1.0, atol=2e-5)


def test_order_of_names_does_not_matter_inside_or_outside_jit() -> None:
    """JAX sorts the keys of a dictionary that passes through `jit`; the vector must not notice."""
    bounds: strong.Bounds = {"z": strong.Box(0.0, 1.0), "a": strong.Disc(0.5), "m": strong.Box(10.0, 20.0)}
    u = jnp.array([0.1, -0.2, 0.3, 0.4])
    outside = strong.physical(bounds, u)
    inside = jax.jit(strong.physical)(bounds, u)
    turned = strong.physical(dict(reversed(bounds.items())), u)
    for name in bounds:
        assert_allclose(inside[name], outside[name], rtol=1e-15)
        assert_allclose(turned[name], outside[name], rtol=1e-15)
    assert_allclose(strong.unbounded(bounds, dict(reversed(outside.items()))), u, rtol=1e-9)


def test_start_must_name_every_free_number() -> None:
    with pytest.raises(ValueError, match=r"Missing: \['b'\]; unknown: \['c'\]"):
        strong.unbounded({"a": strong.Box(0, 1), "b": strong.Box(0, 1)}, {"a": 0.5, "c": 0.5})


def test_at_bound_names_the_numbers_at_an_edge() -> None:
    bounds: strong.Bounds = {"a": strong.Box(0, 1), "b": strong.Disc(0.5), "c": strong.Angle()}
    assert strong.at_bound(bounds, jnp.array([0.0, 0.1, 0.1, 50.0])) == []
    assert strong.at_bound(bounds, jnp.array([-4.7, 9.0, 0.0, 50.0])) == ["a", "b"]


def test_samples_fill_the_box() -> None:
    # 400 draws of a uniform number: the mean of u01 has a standard error of 0.0144; 5 sigma is 0.072,
    # a false alarm once in two million seeds.
    draws = [strong.sample(key, BOXES) for key in jax.random.split(jax.random.key(3), 400)]
    place = np.array(
        [[(float(d["linear"]) + 3.0) / 15.0, np.log(float(d["log"]) / 0.5) / np.log(80.0)] for d in draws]
    )
    assert place.min() > 0.0
    assert place.max() < 1.0
    assert_allclose(place.mean(axis=0), 0.5, atol=0.072)
