"""chi^2 of multiple images: against glafic's value, a brute-force sum and finite differences."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxlens import glafic, lens, profiles, strong
from jaxlens.cosmology import LensPlane
from jaxlens.strong import _chi2, _descent, _image_plane

CLUSTER68 = Path(__file__).parent.parent / "benchmarks" / "data" / "cluster68"


def truth68() -> dict[str, Any]:
    """The numbers that made the mock, by our names."""
    content = json.loads((CLUSTER68 / "truth_train.json").read_text())
    numbers = {}
    for index, one in enumerate(content["lenses"], start=1):
        galaxies = one["model"] == "gals"
        names = glafic.GALAXIES if galaxies else {**glafic.ELLIPSE, **glafic.KINDS[one["model"]][1]}
        for position, name in names.items():
            value = one["p"][position - 1]
            full = f"{'members' if galaxies else f'lens{index}'}.{name}"
            numbers[full] = jnp.asarray(glafic.radians(value) if name == "pa" else value)
    return numbers


@pytest.fixture(scope="module")
def cluster68() -> glafic.GlaficInput:
    return glafic.read(CLUSTER68 / "start_perturbed.input")


def small_problem(**changes: Any) -> strong.Problem:
    """Two systems behind one halo with shear, three images each, one redshift free."""
    plane = LensPlane.at(0.3)
    model = strong.ClusterModel(
        plane,
        (
            strong.Ingredient("H", "dpie", {"x_arcsec": jnp.asarray(0.3), "r_cut_arcsec": jnp.asarray(90.0)}),
            strong.Ingredient("S", "shear", {}),
        ),
        None,
        plane.dls_ds(jnp.array([1.5, 3.0])),
        ("1", "2"),
    )
    bounds: strong.Bounds = {
        "H.sigma_v_km_s": strong.Box(500.0, 1500.0),
        "H.r_core_arcsec": strong.Box(1.0, 20.0, log=True),
        "H.shape": strong.Disc(0.7),
        "S.shape": strong.Disc(0.2),
        "dls_ds.2": strong.Box(0.2, 0.9, weak=False),
    }
    rng = np.random.default_rng(5)
    images = strong.ImageCatalogue(
        rng.uniform(-30, 30, (6, 2)),
        np.array([0, 0, 0, 1, 1, 1]),
        np.array([1.5, np.nan]),
        np.full(6, 0.4),
        ("1", "2"),
    )
    return strong.Problem(model, bounds, images, **changes)


def test_truth_of_cluster68_has_the_chi2_of_glafic(cluster68: glafic.GlaficInput) -> None:
    """89.91500 is printed by glafic 2.1.15 for these parameters with its own norms."""
    chi2 = strong.chi2_source(cluster68.problem.build(truth68()), cluster68.problem.images)
    assert_allclose(chi2, 89.91500, atol=5e-6)  # half a unit of the last printed digit


@pytest.mark.parametrize("floor", [0.0, 0.3])
def test_chi2_is_the_minimum_over_source_positions(floor: float) -> None:
    """Against a plain NumPy sum in which the source positions are found by least squares."""
    problem = small_problem()
    prediction = problem.predict(jnp.linspace(-0.5, 0.6, 7))
    images = problem.images
    ratio = prediction.dls_ds[images.source]
    beta_k, a = (np.asarray(v) for v in lens.source_and_jacobian(prediction.lens, images.theta, ratio))
    total = 0.0
    for system in range(2):
        rows, values = [], []
        for k in np.flatnonzero(np.asarray(images.source) == system):
            covariance = 0.4**2 * a[k] @ a[k].T + floor**2 * np.eye(2)
            root = np.linalg.inv(np.linalg.cholesky(covariance))
            rows.append(root)
            values.append(root @ beta_k[k])
        _, residue, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values))
        total += float(residue[0])
    assert_allclose(strong.chi2_source(prediction, images, floor), total, rtol=1e-9)


def test_floor_keeps_chi2_finite_on_a_critical_curve() -> None:
    """An image of an isothermal sphere exactly on its Einstein ring has det A = 0."""
    ring = lens.Lens(one=lens.Component(profiles.SIE(b=10.0), (0.0, 0.0), 0.0))
    images = strong.ImageCatalogue([[10.0, 0.0], [-9.0, 1.0]], np.zeros(2, int), [2.0], [0.5, 0.5])
    prediction = strong.Prediction(ring, jnp.ones(1))
    det = float(jnp.linalg.det(lens.jacobian(ring, images.theta[0], 1.0)))
    assert det == pytest.approx(0.0, abs=1e-10)  # the floor of the core over the radius
    assert np.isfinite(float(strong.chi2_source(prediction, images, 0.01)))


@pytest.mark.parametrize("eps", [0.0, 1e-9, 1e-8, 1e-7])
def test_images_next_to_a_critical_curve_have_finite_rows(eps: float) -> None:
    """A = R diag(eps, 0.8) R^T: rounding in det C must not decide (s = 0)."""
    angle = np.random.default_rng(2).uniform(0.0, np.pi, 200)
    turn = np.moveaxis(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]), -1, 0)
    a = jnp.asarray(turn @ np.diag([eps, 0.8]) @ np.swapaxes(turn, 1, 2))
    images = strong.ImageCatalogue(
        np.zeros((200, 2)), np.repeat(np.arange(100), 2), np.full(100, 2.0), np.full(200, 0.1)
    )
    beta_k = jnp.asarray(np.random.default_rng(3).normal(scale=0.1, size=(200, 2)))
    seen = _chi2.seen_from(beta_k, a, images, 0.0)
    rows = np.asarray(_chi2.whiten(seen.beta_k - seen.beta[images.source], seen.covariance))
    # The best source of two images lies at most as far away as they are apart, but for the scale 1/sin of
    # the angle between their degenerate directions; the rows are bounded by the floor, 1e6 sigma.
    assert np.isfinite(rows).all()
    assert np.isfinite(np.asarray(seen.beta)).all()
    assert np.abs(rows).max() < 1e8


@pytest.mark.parametrize("floor", [0.0, 0.1])
def test_jacobian_of_the_residuals(floor: float) -> None:
    problem = small_problem(weak_prior=0.55)
    u = jnp.linspace(-0.5, 0.6, 7)
    rows = jax.jit(lambda v: strong.residuals(v, problem, floor))
    jacobian = jax.jit(jax.jacfwd(lambda v: strong.residuals(v, problem, floor)))(u)
    step = 1e-5
    for k in range(7):
        slope = (rows(u.at[k].add(step)) - rows(u.at[k].add(-step))) / (2.0 * step)
        # Central differences of rows of size 1e2 to 1e3: rounding 1e-13/1e-5, curvature 1e-10.
        assert_allclose(jacobian[:, k], slope, rtol=1e-6, atol=1e-6 * float(jnp.abs(jacobian).max()))


def test_gradient_of_a_round_start_is_right() -> None:
    """e = 0 is the first guess of every shape; its gradient decides where the fit goes."""
    problem = small_problem()
    u = jnp.array([0.2, 0.0, 0.0, -0.3, 0.0, 0.0, 0.1])
    chi2 = jax.jit(lambda v: jnp.sum(strong.residuals(v, problem, 0.1) ** 2))
    slope = jax.grad(chi2)(u)
    for k in range(7):
        numeric = (chi2(u.at[k].add(1e-4)) - chi2(u.at[k].add(-1e-4))) / 2e-4
        # The shape is shifted by 1e-6 at exactly zero: the difference is curvature times that.
        assert_allclose(slope[k], numeric, rtol=2e-5, atol=1e-5 * float(jnp.abs(slope).max()))


def test_priors_are_rows_of_their_own() -> None:
    plain = small_problem()
    prior = small_problem(priors=(lambda p: (p["H.sigma_v_km_s"] - 900.0) / 50.0,), weak_prior=0.55)
    u = jnp.linspace(-0.5, 0.6, 7)
    rows = strong.prior_residuals(u, prior)
    assert_allclose(rows[0], (strong.physical(prior.bounds, u)["H.sigma_v_km_s"] - 900.0) / 50.0)
    parts = {name: float(bound.weak) for name, bound in sorted(prior.bounds.items())}
    assert parts["dls_ds.2"] == 0.0
    # Alphabetical order: H.r_core, H.shape (2), H.sigma_v, S.shape (2), dls_ds.2 without a weak prior.
    assert_allclose(rows[1:], 0.55 * u * jnp.array([1, 1, 1, 1, 1, 1, 0]))
    data = strong.residuals(u, prior)[:12]
    assert_allclose(data, strong.residuals(u, plain)[:12])


def test_log_posterior_is_chi2_and_uniform_boxes() -> None:
    problem = small_problem()
    u, v = jnp.linspace(-0.5, 0.6, 7), jnp.linspace(0.4, -0.2, 7)

    @jax.jit
    def by_hand(w: Any) -> Any:
        s, d = w[3], w[6]
        boxes = sum(jax.nn.log_sigmoid(x) + jax.nn.log_sigmoid(-x) for x in (w[0], s, d))
        discs = sum(-jnp.log(jnp.linalg.norm(p)) - 1.5 * jnp.log1p(p @ p) for p in (w[1:3], w[4:6]))
        return -0.5 * strong.chi2_source(problem.predict(w), problem.images) + boxes + discs

    both = jax.jit(jax.value_and_grad(lambda w, p: strong.log_posterior(w, p)))
    (there, gradient), (here, _) = both(u, problem), both(v, problem)
    assert_allclose(there - here, by_hand(u) - by_hand(v), rtol=1e-10)
    assert_allclose(gradient, jax.jit(jax.grad(by_hand))(u), rtol=1e-8)

    # The weak prior takes the place of the uniform law of the boxes it applies to, not of that of the discs.
    weak = small_problem(weak_prior=0.55)

    def change(w: Any) -> Any:
        return sum(
            -0.5 * (0.55 * x) ** 2 - jax.nn.log_sigmoid(x) - jax.nn.log_sigmoid(-x) for x in (w[0], w[3])
        )

    moved = (both(u, weak)[0] - both(v, weak)[0]) - (there - here)
    assert_allclose(moved, change(u) - change(v), rtol=1e-6)  # a small difference of large numbers


def test_members_cost_no_more_derivatives_than_free_numbers(cluster68: glafic.GlaficInput) -> None:
    """The Jacobian of 26 numbers differentiates 64 members along two of theirs, not along 26 directions."""
    problem = cluster68.problem
    u = jnp.zeros(26)
    text = str(jax.make_jaxpr(jax.jacfwd(lambda v: strong.residuals(v, problem)))(u))
    # A member array with a direction axis of 26 would have this shape.
    assert "f64[26,64,68" not in text
    assert "f64[64,68,26" not in text


def test_a_lost_image_costs_more_than_its_source_plane_residual() -> None:
    """Both images of an isothermal sphere on its axis, in closed form; a weak one has lost the second."""
    sigma, floor = 0.5, _image_plane.FLOORS[0]
    images = strong.ImageCatalogue(
        jnp.array([[6.2, 0.0], [-0.2, 0.0]]), [0, 0], [2.0], jnp.full(2, sigma), ("1",)
    )

    def squares(b: Any) -> Any:
        model = strong.Prediction(lens.Lens(one=lens.Component(profiles.SIE(b=b))), jnp.array([1.0]))
        return jnp.sum(strong.definition_residuals(model, images, "mean") ** 2, axis=1)

    # The sources are at 6.2 - b and b - 0.2, their mean at 3: below b = 3 the image at 3 - b < 0 is gone.
    at, slope = jax.jit(squares), jax.jit(jax.jacfwd(squares))
    assert_allclose(at(3.1), [(0.1 / sigma) ** 2, (0.1 / sigma) ** 2], rtol=1e-7)
    lost = 0.3**2 / (sigma**2 + floor**2)
    assert_allclose(at(2.9), [(0.3 / sigma) ** 2, lost + _image_plane.LOST**2], rtol=1e-7)
    assert_allclose(slope(2.9), [-0.6 / sigma**2, -0.6 / (sigma**2 + floor**2)], rtol=1e-7)


def test_chi2_and_information_are_those_of_the_rows():
    problem = small_problem(weak_prior=0.55)
    u = jnp.asarray(np.random.default_rng(2).normal(scale=0.5, size=strong.total_size(problem.bounds)))
    chi2, information = _descent.chi2_and_information(u, problem)
    assert_allclose(chi2, strong.chi2_source(problem.predict(u), problem.images), rtol=1e-10)
    rows = differences_of(lambda v: _chi2.residuals(v, problem), u)
    assert_allclose(information, rows.T @ rows, rtol=1e-5, atol=1e-5 * float(jnp.abs(information).max()))


class Counted:
    """A model that counts how often it is traced."""

    def __init__(self, build: Any):
        self.build, self.traced = build, 0

    def __call__(self, params: dict[str, Any]) -> strong.Prediction:
        self.traced += 1
        return self.build(params)


def test_descents_and_covariance_share_the_trace_of_the_model():
    plain = small_problem(weak_prior=0.55)
    count = Counted(plain.build)
    problem = replace(plain, build=count)
    u = jnp.zeros(strong.total_size(problem.bounds))
    _descent.run(u, _descent.Data(problem, jnp.asarray(1.0)))
    # The solver's structure, and its loop.
    assert count.traced == 2
    _descent.run(u, _descent.Data(problem, jnp.asarray(0.0)))
    _descent.chi2_and_information(u, problem)
    assert count.traced == 2


def differences_of(function: Any, u: jax.Array, step: float = 1e-5) -> np.ndarray:
    """Central differences, `(m, n)`."""
    columns = [(function(u + step * e) - function(u - step * e)) / (2.0 * step) for e in jnp.eye(len(u))]
    return np.stack(columns, axis=1)
