"""Components and lenses: broadcasting, positions of any shape, tiles, and what follows from the fields."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from support import fields, one, strewn, strict
from test_profiles import general

from jaxlens import lens as lens_module
from jaxlens._tiling import singular_centres
from jaxlens.cosmology import LensPlane
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, NFW, PROFILES, SIE, TSIS, PointMass, Shear, Sheet, profile_of, register


def cluster() -> Lens:
    """Spheres (scanned), points (side by side) and a shear: off-centre, rotated, quick to compile."""
    return Lens(
        members=general(PROFILES[TSIS], 5, seed=22),
        points=general(PROFILES[PointMass], 2, seed=21),
        shear=strict(Shear(gamma=0.05), pa=0.3),
    )


def test_numbers_of_different_length_are_broadcast():
    component = Component(DPIE(b=[1.0, 2.0, 3.0], r_core=0.1, r_cut=10.0), centre=(1.0, 2.0), pa=[0.5])
    assert len(component) == 3
    assert component.params.r_core.shape == component.pa.shape == (3,)
    assert component.centre.shape == (3, 2)
    assert len(Component(Sheet(0.1))) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((Sheet, [0.1], np.zeros(3)), "last axis must be"),
        ((Sheet, [0.1, 0.2], np.zeros((3, 2))), "same number of profiles"),
        ((Sheet, np.zeros((2, 2)), np.zeros(2)), "one axis"),
    ],
)
def test_component_refuses_lengths_that_do_not_fit(arguments: Any, message: str):
    kind, numbers, centre = arguments
    with pytest.raises(ValueError, match=message):
        Component(kind(jnp.asarray(numbers)), centre)


def test_unregistered_parameters_and_empty_lenses_are_refused():
    with pytest.raises(TypeError, match="not a registered mass profile"):
        Component({"mass": 1.0})
    with pytest.raises(ValueError, match="at least one component"):
        Lens()
    with pytest.raises(ValueError, match="registered already"):
        register(Sheet, potential=lambda p, x: x[0], example=lambda: Sheet(0.1))
    with pytest.raises(ValueError, match="has the fields"):
        register(
            Component, potential=lambda p, x: x[0], example=lambda: Component(Sheet(0.1)), strength="mass"
        )
    with pytest.raises(TypeError, match="known: "):
        profile_of(3.0)


@pytest.mark.parametrize("n", [2, 6])  # side by side, and scanned
def test_types_may_be_mixed(n: int):
    """Single-precision positions at a lens in double precision, as maps are sometimes stored."""
    model = Lens(members=general(PROFILES[TSIS], n, seed=22))
    theta = jnp.asarray([[3.0, 1.0], [-2.0, 4.0]], jnp.float32)
    found = lens_module.alpha(model, theta)
    assert found.dtype == jnp.float64
    assert_allclose(found, lens_module.alpha(model, theta.astype(float)), rtol=1e-12)


@pytest.mark.parametrize("many", [8 * lens_module.TILE, lens_module.WIDE])
def test_reverse_mode_does_not_keep_what_every_tile_needs(many: int):
    """Many times the positions would need as many times the memory if all partial derivatives were kept."""
    model = Lens(members=general(PROFILES[TSIS], 40, seed=22))
    theta = jnp.asarray(np.random.default_rng(0).uniform(-30.0, 30.0, (many, 2)))

    def memory(points: Any) -> float:
        total = lambda model: jnp.sum(lens_module.kappa(model, points) ** 2)
        usage = jax.jit(jax.grad(total)).lower(model).compile().memory_analysis()
        assert usage is not None
        return usage.temp_size_in_bytes

    # Maps of all positions there are: the map itself, its cotangent and some copies.
    assert memory(theta) < 2.0 * memory(theta[: 2 * lens_module.TILE]) + 20.0 * 8.0 * many


def test_positions_of_any_shape():
    lens, theta = cluster(), strewn(6, seed=23)
    flat = fields(lens, theta)
    for shape in ((2, 3), (1, 6, 1)):
        found = fields(lens, theta.reshape(*shape, 2))
        for name, value in flat.items():
            assert_allclose(found[name], np.reshape(value, shape + value.shape[1:]), rtol=1e-13)
    single = fields(lens, theta[0])
    assert single["psi"].shape == () and single["alpha"].shape == (2,)
    assert_allclose(single["alpha"], flat["alpha"][0], rtol=1e-13)


@pytest.mark.parametrize("tile", [lens_module.TILE, lens_module.WIDE // 2, lens_module.WIDE])
def test_tiles_change_nothing(tile: int):
    lens, theta = cluster(), strewn(tile + lens_module.TILE + 7, seed=24)
    whole = fields(lens, theta)
    middle = len(theta) // 2
    for part in (slice(0, 6), slice(middle, middle + 6), slice(tile - 3, tile + 3), slice(-6, None)):
        piece = fields(lens, theta[part])
        for name, value in piece.items():
            assert_allclose(whole[name][part], value, rtol=1e-12, atol=1e-14)


def test_components_add_up_whatever_their_names_and_order():
    lens, theta = cluster(), strewn(6, seed=25)
    parts = [fields(Lens(x=component), theta) for component in lens.components.values()]
    reverse = Lens(dict(reversed([(f"z_{k}", v) for k, v in lens.components.items()])))
    for name, value in fields(lens, theta).items():
        assert_allclose(sum(part[name] for part in parts), value, rtol=1e-12, atol=1e-12)
        assert_allclose(fields(reverse, theta)[name], value, rtol=1e-12, atol=1e-12)


def test_what_follows_from_the_fields():
    lens, theta = cluster(), jnp.asarray(strewn(6, seed=26))
    ratio = jnp.linspace(0.3, 0.9, 6)
    f = fields(lens, theta)
    hessian = np.asarray(f["hessian"]) * np.asarray(ratio)[:, None, None]
    beta, a = lens_module.source_and_jacobian(lens, theta, ratio)
    assert_allclose(beta, theta - ratio[:, None] * f["alpha"], rtol=1e-13)
    assert_allclose(lens_module.ray_trace(lens, theta, ratio), beta, rtol=1e-13)
    assert_allclose(a, np.eye(2) - hessian, rtol=1e-12, atol=1e-13)
    assert_allclose(lens_module.jacobian(lens, theta, ratio), a, rtol=1e-13)
    # mu from kappa and gamma against the determinant of the matrix.
    assert_allclose(lens_module.mu(lens, theta, ratio), 1 / np.linalg.det(a), rtol=1e-10)
    assert_allclose(
        f["gamma"], 0.5 * (f["hessian"][:, 0, 0] - f["hessian"][:, 1, 1]) + 1j * f["hessian"][:, 0, 1]
    )
    expected = ratio * f["gamma"] / (1 - ratio * f["kappa"])
    assert_allclose(lens_module.reduced_shear(lens, theta, ratio), expected, rtol=1e-12)


def test_sheet_leaves_the_reduced_shear_and_scales_the_jacobian():
    # The mass-sheet transformation: kappa -> lam kappa + 1 - lam, gamma -> lam gamma.
    lam, theta = 0.8, jnp.asarray(strewn(6, seed=27))
    lens = Lens(halo=general(PROFILES[NFW], 1, seed=28))
    kappa_s = lens.components["halo"].params.kappa_s
    params = NFW(lam * kappa_s, lens.components["halo"].params.r_s, lens.components["halo"].params.e)
    halo = lens.components["halo"]
    degenerate = Lens(halo=Component(params, halo.centre, halo.pa), sheet=Component(Sheet(1.0 - lam)))
    g = lens_module.reduced_shear(lens, theta, 1.0)
    assert_allclose(lens_module.reduced_shear(degenerate, theta, 1.0), g, rtol=1e-9)
    a = np.eye(2) - np.asarray(fields(lens, theta)["hessian"])
    assert_allclose(
        np.eye(2) - np.asarray(fields(degenerate, theta)["hessian"]), lam * a, rtol=1e-12, atol=1e-13
    )


def test_images_are_stationary_points_of_the_arrival_time():
    # Fermat: d/dtheta [|theta - beta|^2/2 - ratio psi] = 0 at an image of beta.
    lens, theta, ratio = cluster(), jnp.array([14.0, -6.0]), 0.7
    beta = lens_module.ray_trace(lens, theta, ratio)

    def arrival(t: jax.Array) -> jax.Array:
        return 0.5 * jnp.sum((t - beta) ** 2) - ratio * lens_module.psi(lens, t)

    assert_allclose(jax.jit(jax.grad(arrival))(theta), 0.0, atol=1e-12)
    assert_allclose(lens_module.fermat_potential(lens, theta, ratio), arrival(theta), rtol=1e-12)


def test_time_delay_of_a_point_mass():
    # Two images theta_+- of a source at beta: the classical closed form (Schneider, Ehlers & Falco 1992).
    plane, z_s, einstein, beta = LensPlane.at(0.3), 2.0, 3.0, 1.1
    ratio = plane.dls_ds(z_s)
    lens = one(PointMass(theta_e=einstein / jnp.sqrt(ratio)))
    root = np.sqrt(beta**2 + 4 * einstein**2)
    images = jnp.array([[(beta + root) / 2, 0.0], [(beta - root) / 2, 0.0]])
    assert_allclose(lens_module.ray_trace(lens, images, ratio)[:, 0], beta, rtol=1e-13)
    delays = lens_module.time_delay(lens, images, plane, jnp.asarray(z_s))
    expected = 0.5 * beta * root + einstein**2 * np.log((root + beta) / (root - beta))
    assert_allclose(delays[1] - delays[0], plane.time_delay_scale(z_s) * expected, rtol=1e-11)


def test_centres_and_which_of_them_lack_a_core():
    lens = Lens(
        points=Component(PointMass([1.0, 2.0]), [[1.0, 2.0], [3.0, 4.0]]),
        cored=Component(DPIE(1.0, 0.1, 10.0)),
        coreless=Component(DPIE([1.0, 1.0, 1.0], 0.0, 10.0)),
        sie=Component(SIE(1.0)),
    )
    assert lens_module.centres(lens).shape == (7, 2)
    assert_allclose(lens_module.centres(lens)[:2], [[1.0, 2.0], [3.0, 4.0]])
    where, lacks = singular_centres(lens)
    assert where.shape == (7, 2)  # all may, by their kind
    assert int(lacks.sum()) == 2 + 3 + 1
