"""Every registered profile: consistency, symmetry, and finite values and gradients at the hard places.

The battery runs over `PROFILES`, so a new profile is tested without a new line here. Outside
references are in test_reference_*.py. All properties share one compiled function per profile and
number of profiles, which takes the lens and the positions as arguments.
"""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from numpy.testing import assert_allclose
from support import angles, differences, fields, one, points, rotation, strewn, strict

from jaxlens.lens import Component, Lens, alpha, alpha_and_hessian, kappa_and_gamma, psi
from jaxlens.profiles import (
    CSE,
    DPIE,
    NFW,
    PROFILES,
    SIE,
    TSIS,
    Hernquist,
    PointMass,
    Profile,
    _cse,
    hernquist,
    nfw,
    register,
)

ORIGIN = np.zeros(2)
SIX = 6
"""The number of positions everything is compiled for."""

ENTRIES = [entry for entry in PROFILES.values() if entry.params.__module__.startswith("jaxlens.")]
every = pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)
elliptical = pytest.mark.parametrize(
    "entry", [e for e in ENTRIES if "e" in e.params.__dataclass_fields__], ids=lambda entry: entry.name
)

# Accuracy of the tabulated sums against the exact convergence (Oguri 2021), measured 3.8e-5 and 2.4e-5
# for 1e-4 < xi/r_s < 1e3; every other profile is a closed form.
KAPPA_TOLERANCE = {"nfw": 4e-5, "hernquist": 4e-5}


def general(entry: Profile, n: int, seed: int = 0) -> Component:
    """`n` different profiles of one kind: off-centre, rotated, with ellipticities up to 0.6."""
    rng = np.random.default_rng([seed, n])

    def field(name: str, value: Any) -> jax.Array:
        if name == "e":
            return jnp.asarray(rng.uniform(0.05, 0.6, n))
        if name == "r_core":  # off its floor, where derivatives with respect to it are zero
            return jnp.asarray(rng.uniform(0.1, 0.4, n))
        return value * jnp.asarray(rng.uniform(0.7, 1.4, n))

    example = entry.example()
    params = entry.params(
        **{name: field(name, getattr(example, name)) for name in example.__dataclass_fields__}
    )
    return Component(params, jnp.asarray(rng.uniform(-5, 5, (n, 2))), jnp.asarray(rng.uniform(-2, 2, n)))


def scale_of(entry: Profile) -> float:
    """The scale radius of the example for the tabulated profiles, 1 arcsec for the others."""
    return float(getattr(entry.example(), "r_s", 1.0))


def assert_same_fields(found: dict[str, Any], expected: dict[str, Any], rtol: float) -> None:
    """Equality relative to each quantity's size at its own position; psi relative to its largest value."""
    for name in ("alpha", "hessian", "kappa", "gamma"):
        a, b = (np.asarray(v[name]) for v in (found, expected))
        whole = "alpha" if name == "alpha" else "hessian"
        size = np.abs(np.asarray(expected[whole])).reshape(len(a), -1).max(axis=1)
        assert np.all(np.abs(a - b) <= rtol * size.reshape(-1, *[1] * (a.ndim - 1)) + 1e-300), name
    # psi crosses zero: a potential of the size of the deflection at 1 arcsec counts as one.
    floor = rtol * (np.abs(expected["psi"]).max() + np.abs(expected["alpha"]).max())
    assert_allclose(found["psi"], expected["psi"], rtol=rtol, atol=floor)


# --- consistency -------------------------------------------------------------------------------


@jax.jit
def slopes(lens: Lens, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """grad psi and the Jacobian of alpha, by automatic differentiation in the position."""
    return jax.vmap(jax.grad(lambda x: psi(lens, x)))(theta), jax.vmap(jax.jacfwd(lambda x: alpha(lens, x)))(
        theta
    )


@every
@given(x=points())
def test_alpha_is_the_gradient_of_psi_and_the_hessian_its_jacobian(entry: Profile, x: np.ndarray):
    lens = Lens(one=general(entry, 1))
    found = fields(lens, x)
    gradient, jacobian = slopes(lens, x)
    # Both sides are exact to rounding; the terms of alpha differ by up to 1e4 between themselves.
    assert_same_fields({**found, "alpha": gradient, "hessian": jacobian}, found, rtol=1e-10)
    assert_allclose(found["hessian"], np.swapaxes(found["hessian"], -1, -2), rtol=0, atol=0)


@every
def test_psi_differenced_is_alpha(entry: Profile):
    # The same fact without automatic differentiation: fourth-order differences of psi along x and y.
    lens, x = Lens(one=general(entry, 1)), strewn(SIX, seed=5, min_radius=3.0)
    gradient = differences(lambda shift: fields(lens, x + shift)["psi"], np.zeros(2), 1e-3).T
    # Step 1e-3 arcsec at 3 arcsec or more: truncation below 1e-9, rounding of psi about 1e-10.
    assert_allclose(gradient, fields(lens, x)["alpha"], rtol=1e-7, atol=1e-9)


@every
@given(unit=points(min_radius=3e-4, max_radius=400.0), e=st.floats(0.0, 0.6))
def test_kappa_is_half_the_trace_and_equals_the_closed_form(entry: Profile, unit: np.ndarray, e: float):
    assert entry.kappa is not None
    params = entry.example()
    if hasattr(params, "e"):
        params = eqx.tree_at(lambda p: p.e, params, jnp.asarray(e))
    x = scale_of(entry) * unit
    found = fields(one(params), x)
    trace = 0.5 * (found["hessian"][:, 0, 0] + found["hessian"][:, 1, 1])
    assert_allclose(found["kappa"], trace, rtol=1e-14, atol=0)
    closed = closed_kappa(entry)(params, x)
    tolerance = KAPPA_TOLERANCE.get(entry.name, 1e-9)
    # 1e-13 of the Hessian: psi_xx and psi_yy cancel in the convergence far from a compact mass.
    floor = 1e-13 * np.abs(found["hessian"]).max(axis=(1, 2))
    assert np.all(np.abs(found["kappa"] - closed) <= tolerance * np.abs(closed) + floor)


@cache
def closed_kappa(entry: Profile) -> Any:
    assert entry.kappa is not None
    return jax.jit(jax.vmap(entry.kappa, in_axes=(None, 0)))


# --- symmetry ----------------------------------------------------------------------------------


@every
@given(x=points(), phi=angles())
def test_rotating_lens_and_point_rotates_the_fields(entry: Profile, x: np.ndarray, phi: float):
    r = rotation(phi)
    still, turned = fields(one(entry.example(), pa=0.0), x), fields(one(entry.example(), pa=phi), x @ r.T)
    expected = {
        "psi": still["psi"],
        "alpha": np.asarray(still["alpha"]) @ r.T,
        "hessian": r @ np.asarray(still["hessian"]) @ r.T,
        "kappa": still["kappa"],
        "gamma": np.asarray(still["gamma"]) * np.exp(2j * phi),
    }
    # Rounding of the rotated position, amplified by cancellation of psi_xx - psi_yy.
    assert_same_fields(turned, expected, rtol=1e-10)


@every
@given(x=points(), shift=points(1, min_radius=0.1, max_radius=100.0))
def test_moving_lens_and_point_changes_nothing(entry: Profile, x: np.ndarray, shift: np.ndarray):
    still, moved = fields(one(entry.example()), x), fields(one(entry.example(), centre=shift[0]), x + shift)
    # x + shift - shift differs from x by 1e-14 arcsec, 1e-11 of the smallest distance, and the Hessian
    # of a point mass falls as its square.
    assert_same_fields(moved, still, rtol=1e-9)


@every
@given(x=points())
def test_turning_by_half_a_turn_changes_nothing(entry: Profile, x: np.ndarray):
    assert_same_fields(fields(one(entry.example(), pa=np.pi), x), fields(one(entry.example()), x), rtol=1e-10)


# --- many profiles -----------------------------------------------------------------------------


def member(component: Component, index: Any) -> Component:
    """The profiles of `component` at `index`."""
    params, centre, pa = jax.tree.map(lambda v: v[index], (component.params, component.centre, component.pa))
    return Component(params, centre, pa)


def total(parts: list[dict[str, Any]]) -> dict[str, Any]:
    return {name: sum(np.asarray(part[name]) for part in parts) for name in parts[0]}


@every
@pytest.mark.parametrize("n", [3, 7], ids=["side by side", "scanned"])
def test_stacked_profiles_are_the_sum_of_single_ones(entry: Profile, n: int):
    x = strewn(SIX, seed=1)
    component = general(entry, n)
    singles = total([fields(Lens(one=member(component, slice(k, k + 1))), x) for k in range(n)])
    # Only the order of the sum differs.
    assert_same_fields(fields(Lens(one=component), x), singles, rtol=1e-12)


@every
def test_order_of_members_is_irrelevant(entry: Profile):
    x, component = strewn(SIX, seed=2), general(entry, 7)
    shuffled = member(component, np.array([4, 0, 6, 2, 1, 5, 3]))
    assert_same_fields(fields(Lens(one=shuffled), x), fields(Lens(one=component), x), rtol=1e-12)


# --- hard places -------------------------------------------------------------------------------


def outputs(component: Component, theta: Any) -> jax.Array:
    """alpha and the Hessian, `(i, 2, 3)`."""
    deflection, hessian = alpha_and_hessian(Lens(one=component), theta)
    return jnp.concatenate([deflection[..., None], hessian], axis=-1)


def stacked(component: Component, theta: Any) -> np.ndarray:
    """`outputs` by the program that is compiled already."""
    found = fields(Lens(one=component), theta)
    return np.concatenate([found["alpha"][..., None], found["hessian"]], axis=-1)


@jax.jit
def parameter_jacobian(component: Component, theta: Any) -> Component:
    """d(alpha, Hessian)/d(every parameter, centre, pa), in the structure of the component."""
    return jax.jacfwd(outputs)(component, theta)


def six(theta: Any) -> np.ndarray:
    """Positions repeated to the number that everything here is compiled for."""
    return np.resize(np.asarray(theta, float), (SIX, 2))


def assert_finite(component: Component, theta: Any) -> tuple[np.ndarray, Component]:
    """The outputs at `six(theta)` and their derivatives, all of them finite."""
    values, jacobian = stacked(component, six(theta)), parameter_jacobian(component, six(theta))
    assert np.isfinite(values).all()
    for leaf in jax.tree.leaves(jacobian):
        assert np.isfinite(leaf).all()
    return values, jacobian


def assert_jacobian_equals_differences(component: Component, theta: Any, rtol: float, atol: float) -> None:
    flat, unravel = ravel_pytree(component)
    _, jacobian = assert_finite(component, theta)
    found = np.concatenate([leaf.reshape(SIX * 6, -1) for leaf in jax.tree.leaves(jacobian)], axis=1)
    step = 1e-3 * np.maximum(np.abs(flat), 0.1)
    expected = differences(lambda v: stacked(unravel(v), six(theta)).ravel(), flat, step)
    assert_allclose(found.T, expected, rtol=rtol, atol=atol)


@pytest.mark.parametrize("entry", [e for e in ENTRIES if not e.singular], ids=lambda entry: entry.name)
def test_finite_at_r_0(entry: Profile):
    component = strict(entry.example(), [0.3, -0.2], 0.4)
    theta = [[0.3, -0.2], [0.3, -0.2 + 1e-9]]
    values, jacobian = assert_finite(component, theta)
    hessian = values[0, :, 1:]
    # By symmetry nothing is deflected at the centre, whatever the parameters; moving the centre is
    # moving the position the other way.
    assert_allclose(values[0, :, 0], 0.0, atol=1e-12)
    for leaf in (*jax.tree.leaves(jacobian.params), jacobian.pa):
        assert_allclose(leaf[0, :, 0], 0.0, atol=1e-12)
    assert_allclose(np.asarray(jacobian.centre)[0, :, 0, 0], -hessian, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("entry", [PROFILES[NFW], PROFILES[Hernquist]], ids=lambda entry: entry.name)
def test_finite_at_r_equals_r_s(entry: Profile):
    params = entry.example()
    q, r_s = 1.0 - float(params.e), float(params.r_s)
    # On the ellipse xi = r_s, where the closed forms are 0/0.
    phi = np.array([0.0, 0.7, np.pi / 2])
    theta = six(r_s * np.stack([np.cos(phi) / np.sqrt(q), np.sin(phi) * np.sqrt(q)], axis=1))
    component = strict(params, ORIGIN)
    assert_jacobian_equals_differences(component, theta, rtol=1e-7, atol=1e-8)
    at = {"nfw": 1 / 3 * 2.0 * params.kappa_s, "hernquist": 4 / 15 * params.kappa_s}[entry.name]
    assert_allclose(fields(Lens(one=component), theta)["kappa"], at, rtol=4e-5)  # the table, Oguri 2021


def circular_alpha(params: Any, r: np.ndarray) -> np.ndarray:
    """Deflection of the circular profile in closed form, at distances `r`, arcsec."""
    if isinstance(params, NFW | Hernquist):
        u = r / float(params.r_s)
        inside, outside = np.where(u < 1, u, 0.5), np.where(u > 1, u, 2.0)
        g = np.where(
            u < 1,
            np.arccosh(1 / inside) / np.sqrt(1 - inside**2),
            np.arccos(1 / outside) / np.sqrt(outside**2 - 1),
        )
        if isinstance(params, NFW):  # Wright & Brainerd 2000
            return 4.0 * float(params.kappa_s) * float(params.r_s) * (np.log(u / 2) + g) / u
        return 2.0 * float(params.kappa_s) * r * (1.0 - g) / (u**2 - 1.0)  # Keeton 2001

    if isinstance(params, CSE):
        u = r / float(params.r_s)
        return 2.0 * float(params.kappa_0) * float(params.r_s) ** 2 * (1.0 - 1.0 / np.sqrt(1.0 + u**2)) / r

    def cored(core: float) -> np.ndarray:
        return float(params.b) * (np.sqrt(core**2 + r**2) - core) / r

    if isinstance(params, DPIE):
        return cored(float(params.r_core)) - cored(float(params.r_cut))
    assert isinstance(params, SIE)
    return cored(float(params.r_core))


@elliptical
def test_e_0_value_and_gradient(entry: Profile):
    params = eqx.tree_at(lambda p: p.e, entry.example(), jnp.asarray(0.0))
    if isinstance(params, SIE):  # off the floor of the core, where the derivative would be zero
        params = eqx.tree_at(lambda p: p.r_core, params, jnp.asarray(0.4))
    component = strict(params, ORIGIN, 0.3)
    theta = strewn(SIX, seed=3, min_radius=0.3, max_radius=60.0)
    _, jacobian = assert_finite(component, theta)
    r = np.hypot(*np.asarray(theta).T)
    expected = circular_alpha(params, r)[:, None] * theta / r[:, None]
    # Closed forms to rounding; the tables to 4.6e-6 (Oguri 2021).
    tolerance = 5e-6 if entry.name in KAPPA_TOLERANCE else 1e-12
    assert_allclose(fields(Lens(one=component), theta)["alpha"], expected, rtol=tolerance, atol=1e-13)
    # A circle has no direction, and the expressions are analytic through e = 0: differences may use e < 0.
    assert_allclose(jacobian.pa, 0.0, atol=1e-11)
    assert_jacobian_equals_differences(component, theta, rtol=1e-7, atol=1e-8)
    assert np.abs(jacobian.params.e).max() > 1e-3


@elliptical
def test_small_e_joins_e_0_smoothly(entry: Profile):
    x = strewn(SIX, seed=4, min_radius=0.3, max_radius=60.0)

    def at(e: float) -> np.ndarray:
        return np.asarray(
            fields(one(eqx.tree_at(lambda p: p.e, entry.example(), jnp.asarray(e)), pa=0.3), x)["alpha"]
        )

    # A branch at small e would show as a jump: linear extrapolation from 1e-4 and 2e-4 has error e^2.
    assert_allclose(2 * at(1e-4) - at(2e-4), at(0.0), rtol=2e-7, atol=1e-9)
    assert_allclose(at(1e-12), at(0.0), rtol=1e-11)


@pytest.mark.parametrize("excess", [0.0, 1e-12, 1e-7])
def test_r_core_to_r_cut(excess: float):
    core = 2.0
    params = DPIE(b=1.3, r_core=core, r_cut=core * (1.0 + excess), e=0.3)
    component, theta = strict(params, ORIGIN, 0.5), strewn(SIX, seed=6)
    values, jacobian = assert_finite(component, theta)
    # With no mass left, only the two radii matter, and they matter oppositely.
    d_core, d_cut = (np.asarray(v)[..., 0] for v in (jacobian.params.r_core, jacobian.params.r_cut))
    assert_allclose(d_core, -d_cut, rtol=100 * excess + 1e-10, atol=1e-12)
    assert np.abs(d_cut).max() > 1e-3
    # Rounding of the two radii themselves, 2e-16/excess, limits the first-order value.
    first_order = d_cut * float(params.r_cut - params.r_core)
    assert_allclose(values, first_order, rtol=1e-3 if excess == 1e-12 else 1e-6, atol=1e-15)


@pytest.mark.parametrize("entry", [e for e in ENTRIES if e.singular], ids=lambda entry: entry.name)
def test_singular_profiles_at_1e_8_arcsec(entry: Profile):
    component = strict(entry.example(), ORIGIN, 0.4)
    theta = six([[1e-8, 0.0], [0.0, 1e-8], [-0.6e-8, 0.8e-8]])
    assert_finite(component, theta)
    found = fields(Lens(one=component), theta)
    assert all(np.isfinite(v).all() for v in found.values())
    if entry.name in ("sie", "tsis"):  # isothermal: kappa = alpha/(2 r) averaged, so alpha stays finite
        assert np.abs(found["alpha"]).max() < 100.0


def test_dpie_without_a_core_is_finite_at_1e_8_arcsec():
    component = strict(DPIE(b=1.2, r_core=0.0, r_cut=12.0, e=0.0), ORIGIN, 0.4)
    theta = six([[1e-8, 0.0], [-0.6e-8, 0.8e-8]])
    values, _ = assert_finite(component, theta)
    # The singular isothermal sphere; the floored core of 1e-10 takes 1e-2 off at 1e-8.
    assert_allclose(values[..., 0], 1.2e8 * theta, rtol=1.1e-2, atol=1e-12)


@every
def test_finite_far_away(entry: Profile):
    assert_finite(strict(entry.example(), ORIGIN, 0.4), [[3e5, 0.0], [0.0, -3e5], [2e5, 1e5]])


@elliptical
def test_finite_for_a_very_flat_profile(entry: Profile):
    component = strict(eqx.tree_at(lambda p: p.e, entry.example(), jnp.asarray(0.95)), ORIGIN, 0.4)
    assert_finite(component, strewn(SIX, seed=8))


# --- closed forms against multi-precision arithmetic ---------------------------------------------


def nfw_shape(u: Any) -> Any:
    return (1 - mpmath.acosh(1 / u) / mpmath.sqrt(1 - u * u)) / (u * u - 1)


def hernquist_shape(u: Any) -> Any:
    return ((2 + u * u) * mpmath.acosh(1 / u) / mpmath.sqrt(1 - u * u) - 3) / (u * u - 1) ** 2


@pytest.mark.parametrize(
    ("shape", "exact", "at_1", "tolerance"),
    # The quotients lose (u - 1)^-1 and (u - 1)^-2 digits just outside their series.
    [
        (nfw.convergence_shape, nfw_shape, 1 / 3, 1e-11),
        (hernquist.convergence_shape, hernquist_shape, 4 / 15, 3e-10),
    ],
    ids=["nfw", "hernquist"],
)
def test_convergence_shape_equals_mpmath(shape: Any, exact: Any, at_1: float, tolerance: float):
    d = np.array([1e-8, 1e-5, 1e-3, 2.9e-3, 3.1e-3, 9.9e-3, 1.01e-2, 0.1, 0.9])
    u = np.concatenate([1 - d, 1 + d, [1e-4, 30.0, 1e3]])
    with mpmath.workdps(40):
        expected = [float(mpmath.re(exact(mpmath.mpf(v)))) for v in u]
        slope = [float(mpmath.re(mpmath.diff(exact, mpmath.mpf(v)))) for v in u]
    assert_allclose(jax.vmap(shape)(jnp.asarray(u)), expected, rtol=tolerance)
    # One more power of u - 1 is lost in the derivative.
    assert_allclose(jax.vmap(jax.grad(shape))(jnp.asarray(u)), slope, rtol=2e3 * tolerance)
    assert_allclose(shape(jnp.asarray(1.0)), at_1, rtol=1e-15)


def test_tsis_deflection_is_the_integral_of_its_convergence():
    params = TSIS(theta_e=2.0, r_t=15.0)
    radii = [0.01, 3.0, 14.9, 15.1, 80.0]

    def convergence(r: Any) -> Any:
        u = r / 15
        return (mpmath.mpf(2) / 15) ** 2 / 2 * mpmath.acos(u) / u if u < 1 else mpmath.mpf(0)

    expected = [
        float(2 / mpmath.mpf(r) * mpmath.quad(lambda s: convergence(s) * s, [0, min(r, 15.0)])) for r in radii
    ]
    theta = np.array([[r, 0.0] for r in radii])
    found = fields(one(params), theta)
    assert_allclose(found["alpha"][:, 0], expected, rtol=1e-12)
    assert_allclose(found["kappa"][:3], [float(convergence(r)) for r in radii[:3]], rtol=1e-10)
    # Outside it is a point mass of Einstein radius theta_e, and psi is zero at the truncation radius.
    point = fields(one(PointMass(theta_e=2.0)), theta)
    assert_allclose(found["alpha"][3:], point["alpha"][3:], rtol=1e-13)
    assert_allclose(found["psi"][4], 4.0 * np.log(80.0 / 15.0), rtol=1e-13)


# --- the registry ------------------------------------------------------------------------------


class Plummer(eqx.Module):
    """psi = b^2/2 ln(1 + r^2/s^2): kappa = b^2 s^2/(s^2 + r^2)^2."""

    b: Float[Array, "*n"]
    s: Float[Array, "*n"]


def test_a_profile_needs_no_more_than_its_potential():
    register(
        Plummer,
        potential=lambda p, x: 0.5 * p.b**2 * jnp.log1p((x @ x) / p.s**2),
        example=lambda: Plummer(jnp.array(2.0), jnp.array(3.0)),
    )
    centre, x = np.array([1.0, -2.0]), strewn(SIX, seed=7)
    r2 = ((x - centre) ** 2).sum(axis=1)
    component = strict(Plummer(jnp.array(2.0), jnp.array(3.0)), centre, 0.7)
    found = fields(Lens(one=component), x)
    assert_allclose(found["alpha"], 4.0 * (x - centre) / (9.0 + r2)[:, None], rtol=1e-12)
    assert_allclose(found["kappa"], 36.0 / (9.0 + r2) ** 2, rtol=1e-10, atol=1e-16)
    assert_jacobian_equals_differences(component, x, rtol=1e-7, atol=1e-8)
    # Registered anew, it is another profile for all that is not compiled as a whole.
    first = alpha(Lens(one=component), jnp.asarray(x))
    del PROFILES[Plummer]
    register(
        Plummer,
        potential=lambda p, x: p.b**2 * jnp.log1p((x @ x) / p.s**2),
        example=lambda: Plummer(jnp.array(2.0), jnp.array(3.0)),
    )
    assert_allclose(alpha(Lens(one=component), jnp.asarray(x)), 2.0 * first, rtol=1e-12)
    del PROFILES[Plummer]


# --- precision ---------------------------------------------------------------------------------


@every
def test_float32_stays_float32_with_x64_on(entry: Profile):
    lens = jax.tree.map(lambda v: v.astype(jnp.float32), Lens(one=general(entry, 2)))
    theta = jnp.zeros((5, 2), jnp.float32)
    shapes = jax.eval_shape(fields, lens, theta)
    assert {name: shape.dtype for name, shape in shapes.items()} == {
        "psi": jnp.float32,
        "alpha": jnp.float32,
        "hessian": jnp.float32,
        "kappa": jnp.float32,
        "gamma": jnp.complex64,
    }
    gradient = jax.eval_shape(jax.grad(lambda v: kappa_and_gamma(v, theta)[0].sum()), lens)
    assert {leaf.dtype for leaf in jax.tree.leaves(gradient)} == {jnp.dtype(jnp.float32)}


@pytest.mark.parametrize("e", [0.0, 0.6])
@pytest.mark.parametrize("make", [lambda e: NFW(0.3, 20.0, e), lambda e: Hernquist(0.3, 20.0, e)])
def test_tabulated_sums_in_single_precision(make: Any, e: float):
    """Fields and their derivatives from 1e-7 to 1e4 r_s: 44 terms, each rounded to 6e-8 some ten times."""
    x = 20.0 * np.geomspace(1e-7, 1e4, 23)
    points = np.stack([0.6 * x, 0.8 * x], axis=1)
    lens = Lens(halo=Component(make(e)))
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), lens)

    def numbers(lens: Lens, theta: jax.Array) -> jax.Array:
        a, hessian = alpha_and_hessian(lens, theta)
        return jnp.concatenate([a, hessian.reshape(4)])

    both = lambda lens, theta: (numbers(lens, theta), jax.jacfwd(numbers, argnums=1)(lens, theta))
    exact = jax.vmap(lambda p: both(lens, p))(jnp.asarray(points))
    found = jax.vmap(lambda p: both(single, p))(jnp.asarray(points, jnp.float32))
    for name, near, other, limit in zip(("fields", "slopes"), found, exact, (2e-5, 1e-4), strict=True):
        scale = np.abs(other).max(axis=tuple(range(1, other.ndim)), keepdims=True)
        assert_allclose(np.asarray(near) / scale, np.asarray(other) / scale, atol=limit, err_msg=name)


def test_parameters_in_single_precision_at_positions_in_double():
    """The derivative along the position alone, with parameters of another type."""
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), NFW(0.3, 20.0, 0.2))
    slope = jax.jacfwd(lambda p: jnp.stack(_cse.deflection("nfw", single.r_s, single.e, p)))
    at = jnp.array([3.0, -4.0])
    field = _cse.field("nfw", single.r_s, single.e, at)
    assert_allclose(np.asarray(slope(at)), [[field[2], field[3]], [field[3], field[4]]], rtol=1e-5)
