"""Systems left out, an external shear and criteria: against explicit refits and sums by hand."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from jaxlens import lens as lensing
from jaxlens import lens_equation, strong
from jaxlens.cosmology import LensPlane
from jaxlens.strong import _image_plane

PLANE = LensPlane.at(0.3)
Z = (1.5, 2.5, np.nan)


def model(z: Any) -> strong.ClusterModel:
    fixed = {"r_core_arcsec": jnp.asarray(2.0), "x_arcsec": jnp.asarray(0.4), "y_arcsec": jnp.asarray(-0.3)}
    ratios = PLANE.dls_ds(jnp.nan_to_num(jnp.asarray(z), nan=2.0))
    return strong.ClusterModel(PLANE, (strong.Ingredient("H", "sie", fixed),), None, ratios, ("1", "2", "3"))


TRUTH = {
    "H.sigma_v_km_s": jnp.asarray(800.0),
    "H.shape": jnp.array([0.25, 0.1]),
    "dls_ds.3": PLANE.dls_ds(4.0),
}
BOUNDS: strong.Bounds = {
    "H.sigma_v_km_s": strong.Box(500.0, 1200.0),
    "H.shape": strong.Disc(0.7),
    "dls_ds.3": strong.Box(PLANE.dls_ds(0.5), PLANE.dls_ds(10.0), weak=False),
}


@pytest.fixture(scope="module")
def exact() -> strong.ImageCatalogue:
    """The images of three sources behind a cored isothermal ellipsoid, where the truth has them."""
    there = model(Z)(TRUTH)
    tiling = lens_equation.tile(there.lens, half_width=40.0)
    beta = jnp.array([[0.5, 0.3], [-0.8, 0.2], [0.3, -0.7]])
    found = lens_equation.solve(there.lens, beta, there.dls_ds, tiling=tiling)
    use = np.asarray(found.valid) & (np.abs(np.asarray(found.mu)) > 0.1)
    source, place = np.nonzero(use)
    assert np.bincount(source).min() >= 3
    ids = tuple(f"{s + 1}.{k}" for k, s in enumerate(source))
    theta = np.asarray(found.theta)[source, place]
    return strong.ImageCatalogue(theta, source, Z, np.full(len(source), 0.2), ("1", "2", "3"), ids)


@pytest.fixture(scope="module")
def problem(exact: strong.ImageCatalogue) -> strong.Problem:
    """These images with 0.2 arcsec noise; one is moved by 3 arcsec."""
    theta = np.asarray(exact.theta) + np.random.default_rng(11).normal(scale=0.2, size=exact.theta.shape)
    theta[np.flatnonzero(np.asarray(exact.source) == 1)[0]] += [2.4, -1.8]
    return strong.Problem(model(Z), BOUNDS, replace(exact, theta=jnp.asarray(theta)), weak_prior=0.1)


@pytest.fixture(scope="module")
def fit(problem: strong.Problem) -> strong.StrongFit:
    return strong.fit(problem, n_starts=1, start=TRUTH)


@pytest.fixture(scope="module")
def left_out(problem: strong.Problem, fit: strong.StrongFit) -> strong.LeaveOneOut:
    return strong.leave_one_out(fit.u, problem)


def without(problem: strong.Problem, system: int) -> strong.Problem:
    """The same problem whose catalogue lacks a system; names and redshifts of the others stay."""
    keep = np.asarray(problem.images.source) != system
    others = [k for k in range(3) if k != system]
    source = np.searchsorted(others, np.asarray(problem.images.source)[keep])
    images = strong.ImageCatalogue(
        np.asarray(problem.images.theta)[keep],
        source,
        np.asarray(problem.images.z_s)[others],
        np.asarray(problem.images.sigma_pos)[keep],
    )
    build = lambda params: strong.Prediction(
        problem.build(params).lens, problem.build(params).dls_ds[jnp.asarray(others)]
    )
    return replace(problem, build=build, images=images)


@pytest.mark.parametrize("system", [1, 2])
def test_a_refit_is_that_of_the_catalogue_without_the_system(
    problem: strong.Problem, fit: strong.StrongFit, left_out: strong.LeaveOneOut, system: int
) -> None:
    """SciPy's least squares with numerical derivatives on a catalogue that never had the system."""
    fewer = without(problem, system)
    rows = jax.jit(lambda v: strong.residuals(v, fewer))
    at = int(
        np.argmax(
            np.asarray(
                strong.unbounded(BOUNDS, {**TRUTH, "dls_ds.3": PLANE.dls_ds(4.1)})
                != strong.unbounded(BOUNDS, TRUTH)
            )
        )
    )
    free = [k for k in range(4) if k != at or system != 2]

    def some(v: np.ndarray) -> np.ndarray:
        return np.asarray(rows(fit.u.at[jnp.asarray(free)].set(v)))

    found = least_squares(some, np.asarray(fit.u)[free], xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert left_out.converged[system]
    # 1e-5: forward differences of SciPy; u is of order 1.
    assert_allclose(left_out.u[system][free], found.x, rtol=1e-4, atol=1e-5)

    # The left-out images through that lens; a free redshift of theirs is the one that suits them best.
    u = fit.u.at[jnp.asarray(free)].set(found.x)
    own = np.asarray(problem.images.source) == system
    if system == 2:
        from scipy.optimize import minimize_scalar

        every = jax.jit(lambda v: strong.residuals(v, problem)[: 2 * problem.images.n_images] ** 2)
        mine = np.repeat(own, 2)
        best: Any = minimize_scalar(
            lambda t: float(np.asarray(every(u.at[at].set(t)))[mine].sum()),
            bracket=(float(u[at]) - 0.1, float(u[at]) + 0.1),
        )
        u = u.at[at].set(best.x)
    prediction = problem.predict(u)
    beta = strong.source_positions(prediction, problem.images)["tensor"][system]
    ratio = prediction.dls_ds[system]
    traced = np.asarray(lensing.ray_trace(prediction.lens, problem.images.theta[own], ratio))
    assert_allclose(
        left_out.offset_source[own], np.linalg.norm(traced - np.asarray(beta), axis=1), rtol=1e-3, atol=1e-5
    )
    back = lensing.ray_trace(prediction.lens, jnp.asarray(left_out.theta[own]), ratio)
    reached = np.isfinite(left_out.offset[own])
    assert reached.any()
    assert_allclose(np.asarray(back)[reached], np.broadcast_to(beta, back.shape)[reached], atol=1e-4)


def linear_offsets(there: strong.Prediction, images: strong.ImageCatalogue, own: np.ndarray) -> np.ndarray:
    """Offsets `(m,)` of the images `own` of one system when the first is moved by (1, 0) arcsec.

    To first order, behind the true lens: the source moves by (sum G)^-1 G_1 A_1 d, image j by A_j^-1 of that.
    """
    ratio = there.dls_ds[images.source]
    a = np.asarray(lensing.jacobian(there.lens, images.theta, ratio))[own]
    g = np.linalg.inv(a @ a.transpose(0, 2, 1))
    d = np.array([1.0, 0.0])
    shift = np.linalg.solve(g.sum(axis=0), g[0] @ a[0] @ d)
    offset = np.linalg.solve(a, np.broadcast_to(shift, (len(a), 2))[..., None])[..., 0]
    offset[0] -= d
    return np.linalg.norm(offset, axis=1)


@pytest.mark.parametrize(("times", "flagged"), [(0.75, False), (1.25, True)])
def test_an_image_is_an_outlier_from_three_errors_on(
    problem: strong.Problem, exact: strong.ImageCatalogue, times: float, flagged: bool
) -> None:
    """All images are exact but one of the second system: without this system the refit is the truth."""
    own = np.flatnonzero(np.asarray(exact.source) == 1)
    slopes = linear_offsets(problem.build(TRUTH), exact, own)
    # Its own offset is to be `times` the limit; small errors make the step short, and first order enough.
    sigma = 0.02
    step = times * 3.0 * sigma / slopes[0]
    images = replace(
        exact, theta=exact.theta.at[own[0], 0].add(step), sigma_pos=jnp.full(exact.n_images, sigma)
    )
    alone = replace(problem, images=images, weak_prior=jnp.asarray(0.0))
    out = strong.leave_one_out(strong.unbounded(BOUNDS, TRUTH), alone)
    assert out.converged[1]
    assert_allclose(out.offset[own], step * slopes, rtol=0.1)
    assert out.outlying_images()[own].tolist() == (step * slopes > 3.0 * sigma).tolist()
    assert bool(out.outlying_images()[own[0]]) is flagged


def test_what_is_said_of_the_systems_left_out(problem: strong.Problem, left_out: strong.LeaveOneOut) -> None:
    source = np.asarray(problem.images.source)
    moved = int(np.flatnonzero(source == 1)[0])
    assert left_out.outlying_images()[moved] and left_out.outlying_systems()[1]
    score = np.sqrt(np.sum((left_out.offset[source == 0] / 0.2) ** 2) / (2.0 * (source == 0).sum() - 2.0))
    assert_allclose(left_out.system_scores()[0], score, rtol=1e-12)
    assert_allclose(left_out.normalised, left_out.offset / 0.2, rtol=1e-12)
    reached = left_out.offset[np.isfinite(left_out.offset)]
    assert_allclose(left_out.rms, np.sqrt(np.mean(reached**2)), rtol=1e-12)
    assert left_out.n_found == len(reached)
    lost = left_out._replace(normalised=np.where(np.arange(len(source)) == 0, np.nan, left_out.normalised))
    assert lost.outlying_images()[0] and lost.outlying_systems()[0]


def test_criteria_by_hand(problem: strong.Problem, fit: strong.StrongFit) -> None:
    said = strong.criteria(fit, problem)
    n, k = 2 * problem.images.n_images, 4 + 2 * 3
    assert (said.n_data, said.n_fitted) == (n, k)
    assert_allclose(said.bic, float(fit.chi2) + k * np.log(n), rtol=1e-12)
    assert_allclose(said.aic, float(fit.chi2) + 2.0 * k, rtol=1e-12)
    free = strong.free_sigma(problem)
    wider = jnp.pad(fit.covariance, (0, 1))
    scaled = replace(fit, u=jnp.append(fit.u, 0.0), covariance=wider, sigma_scale=jnp.asarray(1.5))
    # ln p of n normal coordinates of spread 1.5 sigma.
    expected = float(fit.chi2) / 1.5**2 + 2.0 * n * np.log(1.5)
    assert_allclose(strong.criteria(scaled, free).minus_2_log_l, expected, rtol=1e-12)


def test_errors_of_what_the_data_hold_grow_by_the_factor(
    problem: strong.Problem, fit: strong.StrongFit
) -> None:
    plain = replace(problem, weak_prior=jnp.asarray(0.0))
    again = strong.rescale(fit, plain)
    one = replace(fit, chi2=jnp.asarray(float(strong.degrees_of_freedom(plain))))
    ratio = np.asarray(again.covariance) / np.asarray(strong.rescale(one, plain).covariance)
    assert_allclose(ratio, float(fit.chi2) / strong.degrees_of_freedom(plain), rtol=1e-6)


@pytest.mark.long
def test_an_external_shear_is_found(problem: strong.Problem, fit: strong.StrongFit) -> None:
    """Images of a lens with a shear of 0.08; the moved image is left where it was."""
    true = strong.with_shear(problem)
    there = {**TRUTH, "external_shear.shape": jnp.array([0.0, 0.08])}
    prediction = true.build(there)
    own = strong.source_positions(prediction, problem.images)["mean"]
    theta, hit = lens_equation.images_from(
        prediction.lens,
        problem.images.theta,
        own[problem.images.source],
        prediction.dls_ds[problem.images.source],
    )
    assert np.sum(hit) >= 9
    # One that is not reached has no weight: with as many images as before the fits are compiled already.
    theta = jnp.where(hit[:, None], theta, problem.images.theta)
    sigma = jnp.where(hit, 0.2, 1e8)
    images = replace(problem.images, theta=theta, sigma_pos=sigma)
    check = strong.shear_check(fit.u, replace(problem, images=images, weak_prior=jnp.asarray(0.0)))
    assert_allclose(check.gamma, 0.08, rtol=1e-3)
    assert_allclose(abs(check.pa_deg), 45.0, rtol=1e-3)
    assert check.gamma_error > 0.0 and check.pa_deg_error > 0.0
    assert float(check.with_shear.chi2) < 1e-4 < float(check.without.chi2)
    assert_allclose(check.delta_chi2, check.with_shear.chi2 - check.without.chi2, rtol=1e-12)
    assert_allclose(check.delta_bic, check.delta_chi2 + 2.0 * np.log(2.0 * len(hit)), rtol=1e-9)
    assert_allclose(check.delta_aic, check.delta_chi2 + 4.0, rtol=1e-9)


@pytest.mark.parametrize("plane", ["both", "image"])
def test_an_image_plane_stage_that_fails_is_said(
    problem: strong.Problem, fit: strong.StrongFit, plane: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = strong.Polished(jnp.full(4, jnp.nan), jnp.asarray(jnp.inf), jnp.full((4, 4), jnp.nan), False)
    monkeypatch.setattr(_image_plane, "polish", lambda u, problem, definition: lost)
    again = strong.fit(problem, n_starts=1, start=TRUTH, plane=plane)
    assert again.image_plane_failed and again.polished is False
    assert_allclose(again.u, fit.u, rtol=1e-9)
    assert not fit.image_plane_failed and fit.polished is None


def test_a_second_shear_is_refused(problem: strong.Problem) -> None:
    with pytest.raises(ValueError, match=r"has a free external shear already \(external_shear\)"):
        strong.with_shear(strong.with_shear(problem))
    with pytest.raises(ValueError, match="is not a ClusterModel"):
        strong.with_shear(replace(problem, build=lambda params: problem.build(params)))
