"""Images of point sources: against glafic, lenstronomy, closed forms, and the caustics themselves."""

from typing import Any

import glafic_configs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from support import table

from jaxlens import _starts, critical, lens, lens_equation, profiles
from jaxlens.grid import Grid
from jaxlens.lens import Component, Lens


def solve(model: Lens, beta: Any, dls_ds: Any, half_width: float = 100.0, **options: Any) -> Any:
    tiling = lens_equation.tile(model, half_width=half_width)
    return lens_equation.solve(model, jnp.asarray(beta), jnp.asarray(dls_ds), tiling=tiling, **options)


def assert_all_solve(model: Lens, found: Any, beta: Any, dls_ds: Any) -> None:
    """Every returned image is an image, to 1e-8 arcsec in the source plane."""
    theta = found.theta
    ratio = jnp.broadcast_to(jnp.asarray(dls_ds)[..., None], theta.shape[:-1])
    back = np.asarray(lens.ray_trace(model, theta, ratio)) - np.asarray(beta)[..., None, :]
    assert_allclose(back[np.asarray(found.valid)], 0.0, atol=1e-8)


def assert_distinct(found: Any) -> None:
    for theta, valid in zip(np.asarray(found.theta), np.asarray(found.valid), strict=True):
        points = theta[valid]
        apart = np.linalg.norm(points[:, None] - points[None], axis=2) + 10.0 * np.eye(len(points))
        assert apart.min(initial=10.0) > 1e-7


@pytest.fixture(scope="module")
def composite() -> Lens:
    return glafic_configs.lens("composite_A")


@pytest.fixture(scope="module")
def composite_images(composite: Lens) -> tuple[dict[str, np.ndarray], Any, np.ndarray, np.ndarray]:
    rows = table("glafic/images_composite_A.csv")
    ids, first = np.unique(rows["source_id"], return_index=True)
    beta = np.stack([rows["xs"], rows["ys"]], axis=1)[first]
    ratio = np.asarray(glafic_configs.plane().dls_ds(jnp.asarray(rows["zs"][first])))
    assert len(ids) == 30
    return rows, solve(composite, beta, ratio), beta, ratio


def test_every_image_of_glafic_is_found(composite_images: Any) -> None:
    """30 sources behind two haloes, two BCGs, 20 uncored members and shear."""
    rows, found, beta, _ = composite_images
    for number in range(len(beta)):
        theta = np.asarray(found.theta[number])[np.asarray(found.valid[number])]
        mu = np.asarray(found.mu[number])[np.asarray(found.valid[number])]
        these = rows["source_id"] == number + 1
        for x, y, expected in zip(rows["x"][these], rows["y"][these], rows["mu"][these], strict=True):
            distance = np.hypot(theta[:, 0] - x, theta[:, 1] - y)
            assert distance.min() < 1e-6
            assert_allclose(mu[distance.argmin()], expected, rtol=1e-5)


def test_sets_of_composite_a_are_whole(composite: Lens, composite_images: Any) -> None:
    _, found, beta, ratio = composite_images
    assert_all_solve(composite, found, beta, ratio)
    assert_distinct(found)
    assert not np.any(np.asarray(found.overflow))
    assert np.all(np.asarray(found.parity_ok))
    # Odd-number theorem, the images swallowed by centres without a core counted.
    assert np.all((np.asarray(found.valid).sum(axis=1) + np.asarray(found.hidden)) % 2 == 1)


JUST_INSIDE_A_CUT = [
    (4.84367993, 0.15644022, 0.852395314484814),
    (3.83668444, 0.39139096, 0.8675951482775215),
    (0.48780865, -3.84793576, 0.8513095629737435),
    (0.54956066, -4.26410693, 0.8513095629737435),
    (12.6429921, -3.50146303, 0.8513095629737435),
    (-1.35037776, -0.32203322, 0.8513095629737435),
    (4.69406431, 0.50949755, 0.8513095629737435),
]
"""Sources (beta, D_LS/D_S) within 1e-3 of the edge of a cut, between a chord of the ring and its arc."""


def test_hidden_images_are_counted_up_to_the_edge_of_a_cut(composite: Lens) -> None:
    rows = np.resize(JUST_INSIDE_A_CUT, (30, 3))  # repeated: as many sources as above, whose program it is
    found = solve(composite, rows[:, :2], rows[:, 2])
    assert np.all(found.parity_ok)
    assert np.all((np.asarray(found.valid).sum(axis=1) + np.asarray(found.hidden)) % 2 == 1)


@pytest.mark.parametrize("turns", [1, -1])
@pytest.mark.parametrize("outside", [1e-3, 1e-5, -1e-5, -1e-3])
def test_winding_of_a_smooth_curve_at_its_edge(turns: int, outside: float) -> None:
    """Points beside an egg of 64 corners, inside or outside the curve by less than its chords are."""
    curve = lambda phi: np.stack([1.3 * np.cos(phi) + 0.1 * np.cos(2 * phi), 0.7 * np.sin(phi)], axis=-1)
    slope = lambda phi: np.stack([-1.3 * np.sin(phi) - 0.2 * np.sin(2 * phi), 0.7 * np.cos(phi)], axis=-1)
    corners = curve(turns * np.linspace(0.0, 2.0 * np.pi, 65))
    corners[-1] = corners[0]
    phi = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, 500)
    along = slope(phi) / np.linalg.norm(slope(phi), axis=1, keepdims=True)
    point = curve(phi) + outside * np.stack([along[:, 1], -along[:, 0]], axis=1)
    found = np.asarray(_starts.winding_smooth(jnp.asarray(corners - point[:, None])))
    assert np.all(found == (0 if outside > 0.0 else turns))


def test_every_image_of_lenstronomy_is_found() -> None:
    """12 sources behind 54 components; its list may miss demagnified images, ours may not."""
    from test_reference_lenstronomy import cluster

    model = cluster()
    rows = table("lenstronomy/cluster_images.csv")
    ids, first = np.unique(rows["source"], return_index=True)
    beta = np.stack([rows["beta_x"], rows["beta_y"]], axis=1)[first]
    found = solve(model, beta, np.ones(len(ids)))
    for number, source in enumerate(ids):
        theta = np.asarray(found.theta[number])[np.asarray(found.valid[number])]
        mu = np.asarray(found.mu[number])[np.asarray(found.valid[number])]
        these = rows["source"] == source
        for x, y, expected in zip(
            rows["theta_x"][these], rows["theta_y"][these], rows["mu"][these], strict=True
        ):
            distance = np.hypot(theta[:, 0] - x, theta[:, 1] - y)
            assert distance.min() < 1e-6
            assert_allclose(mu[distance.argmin()], expected, rtol=1e-5)
    assert_all_solve(model, found, beta, np.ones(len(ids)))


def test_point_mass_has_its_two_images() -> None:
    model = Lens(one=Component(profiles.PointMass(theta_e=3.0), (1.0, -2.0)))
    found = solve(model, [[2.0, -2.0]], [1.0], half_width=20.0)
    x = np.sort(np.asarray(found.theta[0])[np.asarray(found.valid[0])][:, 0]) - 1.0
    assert_allclose(x, 0.5 * (1.0 + np.array([-1.0, 1.0]) * np.sqrt(1.0 + 4.0 * 9.0)), rtol=1e-10)


def elliptical(galaxy: float = 0.0) -> Lens:
    """A halo and a shear; with `galaxy` > 0 a galaxy of that strength near the critical curve."""
    one = profiles.DPIE(b=galaxy, r_core=0.05, r_cut=15.0, e=0.2)
    return Lens(
        halo=Component(profiles.NFW(kappa_s=0.5, r_s=40.0, e=0.45), (0.3, 0.1), 0.4),
        shear=Component(profiles.Shear(gamma=0.05), (0.0, 0.0), 1.2),
        galaxy=Component(one, (-24.75, 5.08), 1.0),
    )


@pytest.fixture(scope="module")
def caustic() -> critical.Curve:
    found = critical.curves(elliptical(), Grid.square(80.0, 0.2), 0.9)
    (curve,) = [one for one in found.items if one.kind == "tangential"]
    return curve


def counts(model: Lens, beta: np.ndarray) -> np.ndarray:
    n = len(beta)
    assert n <= 200
    beta = np.resize(beta, (200, 2))  # repeated: one program for all
    found = solve(model, beta, np.full(200, 0.9), half_width=50.0)
    assert_all_solve(model, found, beta, np.full(200, 0.9))
    assert_distinct(found)
    assert np.all(np.asarray(found.valid).sum(axis=1) % 2 == 1)
    return np.asarray(found.valid).sum(axis=1)[:n]


@pytest.mark.parametrize("distance", [1e-3, 1e-6])
def test_a_pair_appears_across_every_fold(caustic: critical.Curve, distance: float) -> None:
    """Sources on both sides of the caustic differ by two images, however close to it they are."""
    points = caustic.beta[:-1:12]
    along = np.roll(caustic.beta[:-1], -1, axis=0)[::12] - points
    length = np.linalg.norm(along, axis=1)
    # Away from cusps, where the caustic turns back on itself within one chord.
    smooth = length > 0.05
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)[smooth] / length[smooth, None]
    base = points[smooth]
    # The chord's normal misses the curve by its sagitta; only points of the polyline itself are used.
    left, right = (counts(elliptical(), base + side * distance * normal) for side in (1.0, -1.0))
    assert np.all(np.abs(left - right) == 2)
    assert len(base) >= 8


def test_a_triplet_inside_every_cusp(caustic: critical.Curve) -> None:
    """Just inside a cusp three images huddle together; outside there is one."""
    beta = caustic.beta[:-1]
    radius = np.linalg.norm(beta - beta.mean(axis=0), axis=1)
    peaks = np.flatnonzero((radius > np.roll(radius, 1)) & (radius > np.roll(radius, -1)))
    tips = beta[peaks[np.argsort(radius[peaks])[-2:]]]  # the two cusps on the long axis
    inward = beta.mean(axis=0) - tips
    inward /= np.linalg.norm(inward, axis=1)[:, None]
    inside, outside = counts(elliptical(), tips + 0.02 * inward), counts(elliptical(), tips - 0.02 * inward)
    assert np.all(inside - outside == 2)


def cusps(caustic: np.ndarray) -> int:
    """How often a closed polyline turns back on itself."""
    step = np.diff(caustic, axis=0)
    step = step[np.linalg.norm(step, axis=1) > 1e-9]
    return int(np.sum(np.sum(step * np.roll(step, -1, axis=0), axis=1) < 0.0))


@pytest.mark.long
def test_swallowtail() -> None:
    """A galaxy near the critical curve folds an arm of the caustic: each swallowtail has two more cusps."""
    model = elliptical(galaxy=2.5)
    found = critical.curves(model, Grid.square(80.0, 0.2), 0.9)
    main = next(one for one in found.items if one.kind == "tangential")
    assert cusps(main.beta) >= 6  # four without the galaxy
    loops = np.concatenate([one.beta for one in found.items if one.kind == "tangential"])
    rng = np.random.default_rng(4)
    beta = loops[rng.integers(len(loops), size=200)] + rng.normal(scale=0.03, size=(200, 2))
    number = counts(model, beta)
    assert number.max() >= 5
    # A tiling of more than twice the resolution finds the same.
    fine = lens_equation.tile(model, half_width=50.0, pixel=0.4)
    again = lens_equation.solve(model, jnp.asarray(beta), jnp.full(200, 0.9), tiling=fine)
    assert np.array_equal(np.asarray(again.valid).sum(axis=1), number)


def test_derivatives_of_images_and_magnifications() -> None:
    """The implicit function theorem against finite differences of whole solutions."""
    tiling = lens_equation.tile(elliptical(), half_width=50.0)

    def images(v: jax.Array) -> jax.Array:
        model = Lens(
            halo=Component(profiles.NFW(kappa_s=v[0], r_s=40.0, e=v[1]), (0.3, 0.1), 0.4),
            shear=Component(profiles.Shear(gamma=0.05), (0.0, 0.0), 1.2),
        )
        found = lens_equation.solve(model, v[2:4], v[4], tiling=tiling, k=7)
        return jnp.concatenate([found.theta.ravel(), found.mu])

    at = jnp.array([0.5, 0.45, 0.8, -0.6, 0.9])

    @jax.jit
    def every(v: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Images, and their Jacobian in forward and in reverse mode: one search for all three."""
        value, push = jax.linearize(images, v)
        pull = jax.linear_transpose(push, v)
        reverse = jax.vmap(lambda row: pull(row)[0])(jnp.eye(len(value)))
        return value, jax.vmap(push, out_axes=1)(jnp.eye(5)), reverse

    compiled = lambda v: every(v)[0]
    value, forward, reverse = every(at)
    assert int((value[14:] != 0.0).sum()) >= 3
    assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9)
    for k in range(5):
        numeric = (compiled(at.at[k].add(1e-5)) - compiled(at.at[k].add(-1e-5))) / 2e-5
        # Central differences of positions known to 1e-10: 1e-5 absolute; curvature near the fold adds 1e-6.
        assert_allclose(forward[:, k], numeric, rtol=2e-5, atol=2e-5 * float(jnp.abs(forward[:, k]).max()))


def test_images_from_follows_an_image() -> None:
    model = elliptical()
    start = jnp.array([[20.0, 10.0], [-12.0, -7.0]])
    beta = lens.ray_trace(model, start, 0.9) + 0.05
    theta, found = lens_equation.images_from(model, start, beta, 0.9)
    assert np.all(np.asarray(found))
    assert_allclose(lens.ray_trace(model, theta, 0.9), beta, atol=1e-9)
    assert float(jnp.linalg.norm(theta - start, axis=1).max()) < 2.0


def test_single_precision_is_refused_with_the_remedy() -> None:
    model = elliptical()
    tiling = lens_equation.tile(model, half_width=50.0)
    with pytest.raises(TypeError, match="jax_enable_x64"):
        lens_equation.solve(model, jnp.zeros(2, jnp.float32), jnp.float32(0.9), tiling=tiling)
