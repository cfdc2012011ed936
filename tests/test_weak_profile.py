"""Tangential shear, the halo fitted to it, and aperture mass, against closed forms."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from jax.test_util import check_grads
from scipy.integrate import quad
from support import angles, rotation, strict

from jaxlens import lens, weak
from jaxlens.cosmology import LensPlane
from jaxlens.lens import Lens
from jaxlens.profiles.nfw import from_mass
from jaxlens.profiles.sie import SIE

PLANE = LensPlane.at(0.3)
EDGES = jnp.array([20.0, 45.0, 80.0, 130.0])
CENTRE = (12.0, -7.0)
ONE = weak.Depth(jnp.asarray(1.0), jnp.asarray(1.0))


def noise(n: int = 500, seed: int = 0) -> weak.Galaxies:
    rng = np.random.default_rng(seed)
    eps = rng.normal(scale=0.3, size=n) + 1j * rng.normal(scale=0.3, size=n)
    weight = rng.uniform(0.5, 2.0, n) * (rng.uniform(size=n) > 0.1)
    return weak.Galaxies(rng.uniform(-120.0, 120.0, (n, 2)), eps, weight)


# --- tangential and cross ------------------------------------------------------------------------


def test_tangential_and_cross_are_the_textbook_rotation():
    galaxies = noise()
    x, y = (np.asarray(galaxies.theta) - CENTRE).T
    phi = np.arctan2(y, x)
    e1, e2 = np.asarray(galaxies.eps.real), np.asarray(galaxies.eps.imag)
    found = weak.tangential(galaxies.eps, galaxies.theta, CENTRE)
    np.testing.assert_allclose(found.real, -(e1 * np.cos(2 * phi) + e2 * np.sin(2 * phi)), atol=1e-14)
    np.testing.assert_allclose(found.imag, e1 * np.sin(2 * phi) - e2 * np.cos(2 * phi), atol=1e-14)


@pytest.mark.parametrize(
    ("place", "eps"), [((5.0, 0.0), -0.2), ((0.0, 5.0), 0.2), ((5.0, 5.0), -0.2j), ((-5.0, 5.0), 0.2j)]
)
def test_a_tangential_ellipse_is_positive(place: tuple[float, float], eps: complex):
    """West of a mass galaxies are elongated North-South, e_1 < 0; north-west of it, along x = -y."""
    found = weak.tangential(jnp.array([eps + 0j]), jnp.array([place]))
    np.testing.assert_allclose(found, [0.2 + 0j], atol=1e-15)


def test_a_galaxy_at_the_centre_has_no_direction():
    found, slope = jax.value_and_grad(lambda p: weak.tangential(jnp.array(0.3 + 0.1j), p).real)(jnp.zeros(2))
    assert float(found) == 0.0 and np.isfinite(np.asarray(slope)).all()


def test_an_isothermal_sphere_has_the_closed_form_and_no_cross_shear():
    b = 20.0
    sphere = Lens(one=strict(SIE(b=b), CENTRE))
    phi = np.linspace(0.0, 2.0 * np.pi, 40)
    r = np.repeat([25.0, 60.0, 110.0], 40)
    theta = jnp.asarray(np.asarray(CENTRE) + r[:, None] * np.tile([np.cos(phi), np.sin(phi)], 3).T)
    galaxies = weak.Galaxies(theta, lens.gamma(sphere, theta))
    profile = weak.tangential_profile(galaxies, EDGES, CENTRE)
    np.testing.assert_allclose(profile.g_t, b / (2.0 * np.array([25.0, 60.0, 110.0])), rtol=1e-10)
    np.testing.assert_allclose(profile.g_x, 0.0, atol=1e-12)
    np.testing.assert_allclose(profile.r, [25.0, 60.0, 110.0], rtol=1e-12)


@given(phi=angles())
def test_turning_the_sky_changes_nothing(phi: float):
    galaxies = noise()
    turned = weak.Galaxies(
        np.asarray(galaxies.theta) @ rotation(phi).T, galaxies.eps * np.exp(2j * phi), galaxies.weight
    )
    before, after = (weak.tangential_profile(one, EDGES) for one in (galaxies, turned))
    # A galaxy may cross an edge by rounding, but the nearest is 0.04 arcsec away.
    np.testing.assert_allclose(after.g_t, before.g_t, atol=1e-13)
    np.testing.assert_allclose(after.g_x, before.g_x, atol=1e-13)


# --- the profile ---------------------------------------------------------------------------------


def test_the_profile_is_the_weighted_mean_with_its_error():
    galaxies = noise()
    profile = weak.tangential_profile(galaxies, EDGES, CENTRE)
    r = np.hypot(*(np.asarray(galaxies.theta) - CENTRE).T)
    e = np.asarray(weak.tangential(galaxies.eps, galaxies.theta, CENTRE))
    for k, (low, high) in enumerate(zip(np.asarray(EDGES)[:-1], np.asarray(EDGES)[1:], strict=True)):
        here = (r >= low) & (r < high)
        w = np.asarray(galaxies.weight)[here]
        n = (w > 0).sum()
        mean = np.average(e[here], weights=w)
        assert int(profile.count[k]) == n
        np.testing.assert_allclose(profile.g_t[k] + 1j * profile.g_x[k], mean, rtol=1e-12)
        np.testing.assert_allclose(profile.r[k], np.average(r[here], weights=w), rtol=1e-12)
        off = w * (e[here] - mean) / w.sum()
        np.testing.assert_allclose(profile.sigma_t[k], np.sqrt(n / (n - 1) * np.sum(off.real**2)), rtol=1e-12)
        np.testing.assert_allclose(profile.sigma_x[k], np.sqrt(n / (n - 1) * np.sum(off.imag**2)), rtol=1e-12)


def test_an_empty_bin_has_no_signal_and_an_infinite_error():
    galaxies = weak.Galaxies([[30.0, 0.0], [0.0, 35.0], [60.0, 0.0]], [0.1, 0.3, 0.2])
    profile = weak.tangential_profile(galaxies, EDGES)
    assert profile.count.tolist() == [2, 1, 0]
    assert profile.sigma_t[1:].tolist() == [np.inf, np.inf]
    assert float(profile.g_t[2]) == 0.0 and float(profile.r[2]) == 105.0


def test_whole_numbers_as_edges_leave_the_centre_what_it_is():
    galaxies, edges = noise(200, 4), jnp.array([20, 45, 80, 130])
    off = (12.75, -7.5)
    found, expected = (weak.tangential_profile(galaxies, e, off) for e in (edges, EDGES))
    np.testing.assert_array_equal(found.g_t, expected.g_t)
    np.testing.assert_array_equal(found.r, expected.r)


def test_the_profile_is_differentiable_also_with_empty_bins():
    galaxies = noise(12, 3)
    edges = jnp.array([1.0, 2.0, 60.0, 100.0])

    def f(re: Any, im: Any, weight: Any) -> Any:
        p = weak.tangential_profile(weak.Galaxies(galaxies.theta, re + 1j * im, weight), edges)
        return jnp.sum(p.g_t * jnp.arange(3.0) + p.g_x**2) + jnp.sum(jnp.where(p.count > 1, p.sigma_t, 0.0))

    weight = jnp.where(galaxies.weight > 0.0, galaxies.weight, 0.5)
    check_grads(f, (galaxies.eps.real, galaxies.eps.imag, weight), order=1, modes=["rev"], rtol=1e-6)


def test_bootstrap_errors_are_those_of_the_scatter_and_bins_are_independent():
    galaxies = noise(3000, 5)
    profile = weak.tangential_profile(galaxies, EDGES)
    found = weak.bootstrap(jax.random.key(0), galaxies, EDGES, n=400)
    # Both have an error of 1/sqrt(800) = 3.5 %; limits are four of them.
    np.testing.assert_allclose(found.sigma_t, profile.sigma_t, rtol=0.14)
    np.testing.assert_allclose(found.sigma_x, profile.sigma_x, rtol=0.14)
    spread = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(spread, found.sigma_t)
    correlation = np.asarray(found.covariance) / np.outer(spread, spread)
    assert np.abs(correlation - np.eye(3)).max() < 0.2  # four times 1/sqrt(400)


def test_errors_are_the_scatter_over_realisations():
    galaxies = noise(400, 6)

    def pull(key: Any) -> Any:
        p = weak.tangential_profile(weak.scramble(key, galaxies), EDGES)
        return p.g_t / p.sigma_t, p.g_x / p.sigma_x

    pulls = np.stack(jax.jit(jax.vmap(pull))(jax.random.split(jax.random.key(3), 500)))
    # 500 realisations of 3 bins: means have an error of 0.026 and standard deviations of 0.018.
    assert np.abs(pulls.mean(axis=(1, 2))).max() < 0.1
    assert np.abs(pulls.std(axis=(1, 2)) - 1.0).max() < 0.08


def test_a_stack_is_the_mean_about_all_centres():
    galaxies = noise(200, 7)
    centres = jnp.array([[10.0, 0.0], [-30.0, 40.0]])
    both = weak.stack(galaxies, EDGES, centres)
    weight = np.zeros(3)
    mean = np.zeros(3)
    for centre in np.asarray(centres):
        r = np.hypot(*(np.asarray(galaxies.theta) - centre).T)
        w = np.histogram(r, bins=EDGES, weights=galaxies.weight)[0]
        one = weak.tangential_profile(galaxies, EDGES, (centre[0], centre[1]))
        weight, mean = weight + w, mean + w * np.asarray(one.g_t)
    np.testing.assert_allclose(both.g_t, mean / weight, rtol=1e-12)


# --- the halo ------------------------------------------------------------------------------------


def closed_form(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """kappa and gamma_t of an NFW halo over kappa_s at r/r_s = x != 1 (Wright & Brainerd 2000)."""
    a = np.where(
        x < 1.0,
        np.arctanh(np.sqrt(np.clip((1 - x) / (1 + x), 0.0, None))),
        np.arctan(np.sqrt(np.clip((x - 1) / (1 + x), 0.0, None))),
    )
    root = np.sqrt(np.abs(x**2 - 1.0))
    f = 2.0 * a / root
    kappa = 2.0 * np.where(x < 1.0, 1.0 - f, 1.0 - f) / (x**2 - 1.0)
    mean = 4.0 / x**2 * (f + np.log(x / 2.0))
    return kappa, mean - kappa


@pytest.mark.parametrize("definition", [200.0, "bryan_norman"])
def test_the_shear_of_a_halo_is_the_closed_form(definition: Any):
    r = jnp.array([2.0, 4.0, 8.0, 15.0, 40.0, 90.0, 200.0])
    halo = from_mass(3e15, 6.0, PLANE, definition=definition)
    kappa, gamma = closed_form(np.asarray(r) / float(halo.r_s))
    b, f = 0.7, 1.1
    depth = weak.Depth(jnp.asarray(b), jnp.asarray(f * b**2))
    expected = b * float(halo.kappa_s) * gamma / (1.0 - f * b * float(halo.kappa_s) * kappa)
    # Of the three parts of a supercritical halo the middle one shows the inverse.
    assert expected[0] > -1.0 and np.abs(expected).max() > 1.0 and 0.0 < expected[-1] < 1.0
    expected = np.where(np.abs(expected) > 1.0, 1.0 / expected, expected)
    found = weak.halo_shear(r, 3e15, 6.0, PLANE, depth, definition=definition)
    np.testing.assert_allclose(found, expected, rtol=3e-4)  # the tabulated NFW; measured 6e-5


class Mock(NamedTuple):
    profile: weak.TangentialProfile
    depth: weak.Depth


@pytest.fixture(scope="module")
def mock() -> Mock:
    """A noiseless profile of M_200c = 9e14 Msun, c = 3.5, with errors as of a real field."""
    depth = weak.Depth(jnp.asarray(0.7), jnp.asarray(0.55))
    edges = jnp.geomspace(20.0, 400.0, 9)
    r = jnp.sqrt(edges[:-1] * edges[1:])
    g_t = weak.halo_shear(r, 9e14, 3.5, PLANE, depth)
    sigma = jnp.full(8, 0.02) * (50.0 / r) ** 0.5
    return Mock(weak.TangentialProfile(edges, r, g_t, 0.0 * g_t, sigma, sigma, jnp.full(8, 100)), depth)


def noisy(mock: Mock, key: Any) -> weak.TangentialProfile:
    p = mock.profile
    g_t = p.g_t + p.sigma_t * jax.random.normal(key, (8,))
    return weak.TangentialProfile(p.edges, p.r, g_t, p.g_x, p.sigma_t, p.sigma_x, p.count)


def test_a_noiseless_profile_gives_its_halo_back(mock: Mock):
    fit = weak.fit_halo(mock.profile, PLANE, mock.depth, start=(2e14, 8.0))
    assert bool(fit.converged)
    np.testing.assert_allclose([fit.mass, fit.concentration], [9e14, 3.5], rtol=1e-6)
    assert float(fit.chi2) < 1e-10
    assert int(fit.n_dof) == 6
    assert fit.errors[2] == 0.0 and fit.calibration == 1.0


def test_the_errors_are_the_curvature_of_chi2(mock: Mock):
    fit = weak.fit_halo(mock.profile, PLANE, mock.depth, start=(2e14, 8.0))
    step = 1e-4

    def model(log_m: float, log_c: float) -> np.ndarray:
        return np.asarray(weak.halo_shear(mock.profile.r, 10.0**log_m, 10.0**log_c, PLANE, mock.depth))

    m, c = np.log10(9e14), np.log10(3.5)
    jacobian = (
        np.stack(
            [
                (model(m + step, c) - model(m - step, c)) / (2 * step),
                (model(m, c + step) - model(m, c - step)) / (2 * step),
            ],
            axis=1,
        )
        / np.asarray(mock.profile.sigma_t)[:, None]
    )
    np.testing.assert_allclose(fit.covariance[:2, :2], np.linalg.inv(jacobian.T @ jacobian), rtol=1e-5)


def test_the_error_of_the_fitted_shear_is_that_of_its_numbers(mock: Mock):
    r = mock.profile.r
    fit = weak.HaloFit(
        jnp.asarray(9e14),
        jnp.asarray(3.5),
        jnp.asarray(0.9),
        jnp.diag(jnp.array([0.0, 0.0, 0.1**2])),
        jnp.asarray(0.0),
        jnp.asarray(6),
        jnp.asarray(True),
        jnp.asarray(5),
    )
    model, error = weak.fitted_shear(fit, r, PLANE, mock.depth)
    np.testing.assert_allclose(model, 0.9 * mock.profile.g_t, rtol=1e-12)
    np.testing.assert_allclose(error, 0.1 * mock.profile.g_t, rtol=1e-10)
    moved = eqx.tree_at(lambda f: f.covariance, fit, jnp.diag(jnp.array([0.05**2, 0.0, 0.0])))
    step = 1e-4
    there, here = (weak.halo_shear(r, 10.0**d * 9e14, 3.5, PLANE, mock.depth) for d in (step, -step))
    expected = 0.9 * 0.05 * np.asarray(there - here) / (2.0 * step)
    np.testing.assert_allclose(weak.fitted_shear(moved, r, PLANE, mock.depth)[1], expected, rtol=1e-6)


def test_errors_of_noisy_fits_are_their_scatter(mock: Mock):
    """One compiled fit serves all realisations, and its pulls are normal."""

    def pulls(key: Any) -> tuple[Any, Any]:
        fit = weak.fit_halo(noisy(mock, key), PLANE, mock.depth)
        spread = jnp.sqrt(jnp.diagonal(fit.covariance)[:2])
        found = jnp.stack([jnp.log10(fit.mass / 9e14), jnp.log10(fit.concentration / 3.5)])
        return found / spread, fit.converged

    found, converged = jax.jit(jax.vmap(pulls))(jax.random.split(jax.random.key(0), 100))
    assert bool(converged.all())
    # 100 realisations: the mean of pulls has an error of 0.1, their standard deviation one of 0.07.
    assert np.abs(np.mean(found, axis=0)).max() < 0.4
    assert np.abs(np.std(found, axis=0) - 1.0).max() < 0.3


def test_priors_hold_concentration_and_calibration(mock: Mock):
    free = weak.fit_halo(noisy(mock, jax.random.key(1)), PLANE, mock.depth)
    fit = weak.fit_halo(
        noisy(mock, jax.random.key(1)),
        PLANE,
        mock.depth,
        concentration=weak.Prior(np.log10(3.5), 1e-4),
        calibration=weak.Prior(0.8, 0.05),
    )
    assert bool(fit.converged)
    np.testing.assert_allclose(fit.concentration, 3.5, rtol=1e-2)
    np.testing.assert_allclose(fit.errors[1], 3.5 * np.log(10.0) * 1e-4, rtol=0.02)
    assert abs(float(fit.calibration) - 0.8) < 0.15 and float(fit.errors[2]) < 0.0501
    assert float(fit.mass) > float(free.mass)  # less shear per mass
    fixed = weak.fit_halo(mock.profile, PLANE, mock.depth, calibration=weak.Prior(1.0, 0.0))
    assert float(fixed.errors[2]) == 0.0
    held = weak.fit_halo(mock.profile, PLANE, mock.depth, concentration=weak.Prior(np.log10(3.5), 0.0))
    assert bool(held.converged) and int(held.n_dof) == int(fixed.n_dof) + 1
    np.testing.assert_allclose([held.mass, held.concentration], [9e14, 3.5], rtol=1e-6)
    assert float(held.errors[1]) == 0.0 and 0.0 < float(held.errors[0]) < float(fixed.errors[0])
    with pytest.raises(ValueError, match=r"`concentration` is Prior\(mean=0.5, sigma=-1.0\)"):
        weak.fit_halo(mock.profile, PLANE, mock.depth, concentration=weak.Prior(0.5, -1.0))


def test_a_bin_without_error_has_no_influence(mock: Mock):
    p = mock.profile
    g_t = p.g_t.at[3].set(1e3)
    sigma = p.sigma_t.at[3].set(jnp.inf)
    spoilt = weak.TangentialProfile(p.edges, p.r, g_t, p.g_x, sigma, sigma, p.count)
    fit = weak.fit_halo(spoilt, PLANE, mock.depth)
    np.testing.assert_allclose([fit.mass, fit.concentration], [9e14, 3.5], rtol=1e-6)
    assert int(fit.n_dof) == 5


def test_a_profile_without_a_halo_does_not_converge_and_does_not_stop(mock: Mock):
    p = mock.profile
    nothing = weak.TangentialProfile(p.edges, p.r, -p.g_t, p.g_x, p.sigma_t, p.sigma_x, p.count)
    assert not bool(weak.fit_halo(nothing, PLANE, mock.depth).converged)


def test_a_fit_in_single_precision_is_refused(mock: Mock):
    single = jax.tree.map(lambda v: v.astype(jnp.float32) if v.dtype == jnp.float64 else v, mock.profile)
    with pytest.raises(TypeError, match=r'float32; the fit needs float64.*"jax_enable_x64", True'):
        weak.fit_halo(single, PLANE, mock.depth)


# --- aperture mass -------------------------------------------------------------------------------


def disc(radius: float, centre: tuple[float, float]) -> tuple[Any, Any]:
    """Gauss-Legendre nodes in radius times equal angles: positions and areas, for exact integrals."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    r, w = 0.5 * radius * (nodes + 1.0), 0.5 * radius * weights
    phi = 2.0 * np.pi * (np.arange(24) + 0.3) / 24
    unit = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    theta = np.asarray(centre) + (r[:, None, None] * unit).reshape(-1, 2)
    return jnp.asarray(theta), jnp.asarray(np.repeat(w * r * 2.0 * np.pi / 24, 24))


def test_aperture_mass_of_an_isothermal_sphere_is_four_fifths_of_its_einstein_radius():
    theta, area = disc(90.0, CENTRE)
    gamma = lens.gamma(Lens(one=strict(SIE(b=20.0), CENTRE)), theta)
    found = weak.aperture_mass(weak.Galaxies(theta, gamma, area), jnp.asarray(CENTRE), 90.0)
    np.testing.assert_allclose(found.signal, 0.8 * 20.0 / 90.0, rtol=1e-9)
    np.testing.assert_allclose(found.cross, 0.0, atol=1e-12)
    assert int(found.count) == len(theta)


def test_aperture_mass_of_a_halo_is_its_filtered_convergence():
    """Shear filtered by Q equals convergence filtered by U: two different integrals."""
    halo = from_mass(8e14, 4.0, PLANE)
    radius, r_s = 150.0, float(halo.r_s)
    theta, area = disc(radius, CENTRE)
    component = strict(halo, CENTRE)
    galaxies = weak.Galaxies(theta, lens.gamma(Lens(one=component), theta), area)
    found = weak.aperture_mass(galaxies, jnp.asarray(CENTRE), radius)

    def integrand(r: float) -> float:
        x = r / radius
        u = 9.0 / (np.pi * radius**2) * (1.0 - x**2) * (1.0 / 3.0 - x**2)
        return 2.0 * np.pi * r * u * float(halo.kappa_s) * float(closed_form(np.array(r / r_s))[0])

    expected = quad(integrand, 0.0, radius, points=[r_s], limit=200)[0]
    np.testing.assert_allclose(found.signal, expected, rtol=1e-4)  # the tabulated NFW; measured 2e-5


@pytest.mark.parametrize("filter", sorted(weak.FILTERS))
def test_signal_to_noise_of_noise_is_normal(filter: str):
    galaxies = noise(1500, 8)
    point = jnp.array([[5.0, 5.0]])

    def snr(key: Any) -> Any:
        one = weak.aperture_mass(weak.scramble(key, galaxies), point, 80.0, filter=filter)
        return one.snr[0]

    found = np.asarray(jax.jit(jax.vmap(snr))(jax.random.split(jax.random.key(9), 400)))
    # 400 realisations: mean 0 +- 0.05, standard deviation 1 +- 0.035; limits are four of these.
    assert abs(found.mean()) < 0.2
    assert abs(found.std() - 1.0) < 0.14


def test_filters_vanish_at_the_edge_and_the_polynomial_one_is_normalised():
    # int Q d^2theta = 1 for the polynomial filter, by its convergence twin.
    area = quad(lambda x: 2.0 * x * float(weak.FILTERS["schneider"](jnp.asarray(x))), 0.0, 1.0)[0]
    assert area == pytest.approx(1.0, rel=1e-10)
    for kernel in weak.FILTERS.values():
        assert kernel(jnp.array([1.0, 2.0])).tolist() == [0.0, 0.0]
        assert float(kernel(jnp.asarray(0.3))) > 0.0
        assert np.isfinite(np.asarray(jax.vmap(jax.grad(kernel))(jnp.array([0.0, 1e-6, 0.5])))).all()


def test_an_aperture_without_galaxies_is_zero_and_not_nan():
    galaxies = weak.Galaxies([[0.0, 0.0]], [0.1 + 0j])
    found = weak.aperture_mass(galaxies, jnp.array([[500.0, 0.0], [10.0, 0.0]]), 40.0)
    assert found.signal[0] == found.noise[0] == found.snr[0] == 0.0
    assert found.count.tolist() == [0, 1]


def test_the_map_peaks_at_the_lens_and_an_unknown_filter_is_refused():
    from jaxlens.grid import Grid

    grid = Grid((9, 11), 10.0, (5.0, 0.0))
    theta, area = disc(160.0, (0.0, 0.0))
    at = (25.0, -20.0)
    galaxies = weak.Galaxies(theta, lens.gamma(Lens(one=strict(SIE(b=20.0), at)), theta), area)
    found = weak.aperture_map(galaxies, grid, 50.0)
    place, value, pixel = weak.peak(found.snr, grid)
    np.testing.assert_allclose(place, at, atol=10.0)
    assert float(value) == float(found.snr.max()) == float(found.snr[tuple(pixel)])
    with pytest.raises(ValueError, match="`filter` is 'gauss'; choose one of schirmer, schneider"):
        weak.aperture_map(galaxies, grid, 50.0, filter="gauss")
