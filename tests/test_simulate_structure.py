"""Growth of structure, concentrations, shapes, subhaloes and stars against numbers from elsewhere.

The reference of sigma, growth and M* is colossus 1.4.0 (flat, H0 = 70, Omega_m = 0.3, Omega_b = 0.045,
sigma8 = 0.8, n_s = 0.96, `relspecies=False`, transfer function `eisenstein98`).
"""

import math

import jax
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import kstest

from jaxlens.cosmology import LensPlane
from jaxlens.simulate import _concentration, _stellar, _structure, _subhaloes, _triaxial
from jaxlens.units import G_MPC_KM2_S2_MSUN

S = _structure.Structure(h=0.7, omega_m=0.3)
M1, M2 = 6.75e14, 5.25e14


# --- growth of structure ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass_msun_h", "expected"),
    [
        (6.75e14, 0.5789800158506164),
        (5.25e14, 0.617539374644413),
        (1e14, 0.9100419756117488),
        (1e13, 1.4248381078377954),
        (1e12, 2.0625429889199864),
        (1e10, 3.6613994187623358),
    ],
)
def test_rms_of_the_density_agrees_with_colossus(mass_msun_h: float, expected: float):
    # 3.5e-4 measured: colossus splines sigma(R).
    assert _structure.sigma(mass_msun_h / S.h, S) == pytest.approx(expected, rel=5e-4)


def test_growth_age_and_characteristic_mass_agree_with_colossus():
    assert _structure.growth(0.3, S) == pytest.approx(0.8559865179073366, rel=2e-5)
    # Colossus rounds the length of a year: 2e-5.
    assert _structure.age(0.0, S) == pytest.approx(13.46723918537604, rel=3e-5)
    mass = _structure.characteristic_mass(0.3, S) * S.h
    assert math.log10(mass) == pytest.approx(12.134239464881665, abs=1e-3)


def test_age_and_growth_are_the_integrals_they_stand_for():
    def expansion(z: float) -> float:
        return math.sqrt(0.3 * (1.0 + z) ** 3 + 0.7)

    hubble = 1.0 / (70.0 / 977.79222168)
    for z in (0.0, 0.3, 2.0):
        age = hubble * quad(lambda x: 1.0 / ((1.0 + x) * expansion(x)), z, np.inf)[0]
        assert _structure.age(z, S) == pytest.approx(age, rel=1e-8)
    growing = [expansion(z) * quad(lambda x: (1.0 + x) / expansion(x) ** 3, z, np.inf)[0] for z in (0.3, 0.0)]
    assert _structure.growth(0.3, S) == pytest.approx(growing[0] / growing[1], rel=1e-8)
    empty = _structure.Structure(h=0.7, omega_m=1.0)
    assert _structure.age(0.0, empty) == pytest.approx(2.0 / 3.0 * hubble, rel=1e-12)


@pytest.mark.parametrize(
    ("mass_msun_h", "printed", "pinned", "neto"),
    [
        (6.75e14, 4.14, 4.140649978656, 2.91),
        (5.25e14, 4.18, 4.180797137498, 2.99),
        (1e14, 4.70, 4.703479007105, 3.59),
        (1e13, 6.08, 6.083129508362, 4.63),
        (1e12, 7.86, 7.855860829440, 5.96),
    ],
)
def test_concentrations(mass_msun_h: float, printed: float, pinned: float, neto: float):
    mass = mass_msun_h / S.h
    c = _concentration.median("zhao", mass, 0.3, S)
    assert c == pytest.approx(printed, abs=0.005)  # another implementation, to its printed digits
    assert c == pytest.approx(pinned, rel=1e-6)  # ours, so that a change is seen
    assert _concentration.neto(mass, 0.3, S) == pytest.approx(neto, abs=0.006)


def test_formation_redshift_and_mean_concentration():
    assert _structure.formation_redshift(M1 / S.h, 0.3, 0.04, S) == pytest.approx(2.10, abs=0.005)
    median = _concentration.median("zhao", M1 / S.h, 0.3, S)
    mean = _concentration.mean("zhao", M1 / S.h, 0.3, 0.25, S)
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    expected = median * np.sum(weights * np.exp(0.25 * nodes)) / np.sum(weights)
    assert mean == pytest.approx(expected, rel=1e-12)


# --- shapes -------------------------------------------------------------------------------------


def test_axis_ratios_follow_their_distributions():
    scale = _triaxial.axis_scale(M1 / S.h, 0.3, S)
    keys = jax.random.split(jax.random.key(3), 400)
    drawn = np.array([_triaxial.draw_axis_ratios(key, scale) for key in keys])
    a_c, b_c = drawn.T
    assert ((a_c > 0.1) & (a_c <= b_c) & (b_c <= 1.0)).all()
    # 400 draws: the mean is good to 0.087/20 = 0.0044; 4 standard deviations, false alarm 6e-5.
    assert a_c.mean() == pytest.approx(0.416, abs=0.0174)
    assert a_c.std() == pytest.approx(0.087, abs=0.0124)
    least = np.maximum(a_c, 0.5)
    t = (2.0 * a_c / b_c - 1.0 - least) / (1.0 - least)
    # Kolmogorov-Smirnov against the distribution function; false alarm 1e-4.
    assert kstest(t, lambda x: (3.0 * x - x**3 + 2.0) / 4.0).pvalue > 1e-4
    assert (a_c / b_c).mean() == pytest.approx(0.753, abs=0.02)


def test_orientations_are_rotations_without_a_preferred_direction():
    keys = jax.random.split(jax.random.key(4), 400)
    turns = np.array([_triaxial.rotation(_triaxial.draw_orientation(key)) for key in keys])
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (400, 3, 3)), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-14)
    # Each component of a random unit vector is uniform in [-1, 1]; nine tests, false alarm 1e-3 together.
    for component in turns.reshape(400, 9).T:
        assert kstest(component, "uniform", args=(-1.0, 2.0)).pvalue > 1e-4


def test_projected_axis_ratios_of_random_haloes():
    scale = _triaxial.axis_scale(M1 / S.h, 0.3, S)
    shapes = []
    for key in jax.random.split(jax.random.key(5), 400):
        first, second = jax.random.split(key)
        semi_axes = _triaxial.axes(_triaxial.draw_axis_ratios(first, scale))
        shapes.append(_triaxial.projection(semi_axes, _triaxial.rotation(_triaxial.draw_orientation(second))))
    q = np.array([shape.q for shape in shapes])
    # 400 draws: the median is good to 1.25 x 0.152/20 = 0.0095; 4 standard deviations, false alarm 6e-5.
    assert np.median(q) == pytest.approx(0.563, abs=0.038)
    assert np.median([shape.f**-0.5 for shape in shapes]) == pytest.approx(0.889, abs=0.07)


def rho(m: float) -> float:
    """NFW density in units of rho_s at radius m r_s."""
    return 1.0 / (m * (1.0 + m) ** 2)


def _round(r: float) -> float:
    """Integral of the NFW density along the line of sight at distance r from the centre."""
    return 2.0 * quad(lambda t: rho(math.hypot(r, math.sinh(t))) * math.cosh(t), 0.0, 40.0, epsrel=1e-11)[0]


@pytest.mark.parametrize("seed", range(3))
def test_projection_is_the_integral_along_the_line_of_sight(seed: int):
    rng = np.random.default_rng(seed)
    semi_axes = _triaxial.axes(tuple(np.sort(rng.uniform(0.3, 1.0, 2))))
    turn = _triaxial.rotation(tuple(rng.normal(size=4)))
    form = _triaxial.quadratic_form(semi_axes, turn)
    f, s = _triaxial.project(form)
    assert math.sqrt(f * np.linalg.det(s)) == pytest.approx(1.0, abs=1e-10)
    shape = _triaxial.projection(semi_axes, turn)
    kappa_s, r_s = _triaxial.flattened(1.0, 1.0, shape)
    for x in rng.normal(size=(3, 2)):
        # Along the line of sight from the point nearest to the centre in the metric of the ellipsoid.
        z_0 = -(form[2, :2] @ x) / form[2, 2]

        def density(t: float, x: np.ndarray = x, z_0: float = z_0) -> float:
            point = np.array([*x, z_0 + math.sinh(t)])
            return rho(math.sqrt(point @ form @ point)) * math.cosh(t)

        expected = quad(density, -40.0, 40.0, limit=400, epsrel=1e-10, points=[-2.0, 0.0, 2.0])[0]
        c, d = math.cos(shape.pa), math.sin(shape.pa)
        u, v = c * x[0] + d * x[1], c * x[1] - d * x[0]
        xi = math.sqrt(shape.q * u**2 + v**2 / shape.q) / r_s
        assert kappa_s * _round(xi) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("angle", [0.4, 2.9])
def test_turning_on_the_sky_adds_to_the_position_angle_alone(angle: float):
    semi_axes, turn = _triaxial.axes((0.4, 0.7)), _triaxial.rotation((0.3, -0.5, 0.2, 0.9))
    before, after = (_triaxial.projection(semi_axes, t) for t in (turn, _triaxial.turn_on_sky(turn, angle)))
    assert (after.f, after.q) == pytest.approx((before.f, before.q), rel=1e-12)
    assert math.sin(after.pa - before.pa - angle) == pytest.approx(0.0, abs=1e-12)


# --- subhaloes ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass", "cap", "count", "fraction"),
    [
        (M1, 1.0, 797.74, 0.1857),
        (M1, 0.1, 797.55, 0.1504),
        (M2, 1.0, 620.44, 0.1785),
        (M2, 0.1, 620.26, 0.1441),
    ],
)
def test_mean_number_and_mass_of_subhaloes(mass: float, cap: float, count: float, fraction: float):
    log_m, below = _subhaloes.mass_function(mass, 0.3, 1.0, 1e10, cap * mass)
    assert below[-1] == pytest.approx(count, abs=0.006)
    middle = np.exp(0.5 * (log_m[1:] + log_m[:-1]))
    assert np.sum(middle * np.diff(below)) / mass == pytest.approx(fraction, abs=6e-5)
    # The trapezia are fine enough for rounding in what is drawn.
    exact = quad(
        lambda x: 9.33e-4 * mass * 1.3**0.5 * math.exp(-0.9 * x - 12.2715 * (math.exp(x) / mass) ** 3),
        log_m[0], log_m[-1], epsrel=1e-12,
    )[0]  # fmt: skip
    assert below[-1] == pytest.approx(exact, rel=1e-6)


def test_masses_and_positions_follow_their_laws():
    log_m, below = _subhaloes.mass_function(M1, 0.3, 25.0, 1e10, 0.1 * M1)
    keys = jax.random.split(jax.random.key(6), 4)
    m = _subhaloes.draw_masses(keys[0], keys[1], log_m, below)
    # Poisson with mean 19939: 4 standard deviations, false alarm 6e-5; the two others 1e-4 each.
    assert len(m) == pytest.approx(25.0 * 797.55, abs=4.0 * math.sqrt(25.0 * 797.55))
    assert kstest(np.log(m), lambda x: np.interp(x, log_m, below / below[-1])).pvalue > 1e-4
    light = np.log(m[m < 1e12] / 1e10)
    top, n = math.log(100.0), len(light)
    # Maximum likelihood of an exponential cut at `top`.
    slope = max(
        np.linspace(-1.0, -0.8, 401),
        key=lambda s: n * math.log(s / (math.exp(s * top) - 1)) + s * light.sum(),
    )
    assert slope == pytest.approx(-0.90, abs=0.02)  # 3 standard deviations of 0.007
    c = 4.14
    to_sky = _triaxial.rotation((0.3, -0.5, 0.2, 0.9)) * _triaxial.axes((0.4, 0.7))
    at = _subhaloes.draw_positions(keys[2], keys[3], len(m), c, to_sky)
    inside = at @ np.linalg.inv(to_sky).T
    radius = np.linalg.norm(inside, axis=1)
    assert kstest(radius, lambda x: _subhaloes.fraction_within(x, c)).pvalue > 1e-4
    assert np.median(radius) == pytest.approx(0.697, abs=0.008)
    assert (radius < 0.5).mean() == pytest.approx(0.2386, abs=0.0121)
    for cosine in (inside / radius[:, None]).T:
        assert kstest(cosine, "uniform", args=(-1.0, 2.0)).pvalue > 1e-4


def test_truncation_radius_is_where_the_tide_wins():
    mass, c, r_vir = M1, 4.14, 1.50600
    m, r = np.array([1e10, 1e12]), np.array([0.3, 1.2])
    r_t = _subhaloes.truncation_radius(m, r, mass, c, r_vir)

    def within(x: float) -> float:
        x *= c / r_vir
        return mass * (math.log1p(x) - x / (1.0 + x)) / (math.log1p(c) - c / (1.0 + c))

    for one, at, found in zip(m, r, r_t, strict=True):
        slope = (math.log(within(at * 1.0001)) - math.log(within(at / 1.0001))) / (2.0 * math.log(1.0001))
        assert found == pytest.approx(at * (one / ((2.0 - slope) * within(at))) ** (1.0 / 3.0), rel=1e-8)
    sigma_v = _subhaloes.velocity_dispersion(m, r_t)
    np.testing.assert_allclose(2.0 * sigma_v**2 * r_t / G_MPC_KM2_S2_MSUN, m, rtol=1e-14)
    # Down to the centre the tide is that of a cusp, and nothing is 0/0.
    assert np.isfinite(_subhaloes.truncation_radius(m, np.array([1e-6, 1e-9]), mass, c, r_vir)).all()


# --- stars --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hod", "which", "expected"),
    [
        ("wang2006_moka", 1, [7.710, 9.606, 10.780, 11.234, 11.626]),
        ("wang2013", 1, [7.181, 9.146, 10.560, 10.980, 11.281]),
    ],
)
def test_stellar_masses(hod: str, which: int, expected: list[float]):
    relation = _stellar.OCCUPATIONS[hod][which]
    found = np.log10(_stellar.stellar_mass(np.logspace(10, 14, 5), relation, 1.0))
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_stellar_masses_of_the_central_galaxies():
    relation = _stellar.OCCUPATIONS["wang2006_moka"][0]
    np.testing.assert_allclose(
        np.log10(_stellar.stellar_mass(np.array([M1, M2]), relation, 1.0)), [11.950, 11.907], atol=1e-3
    )
    # k in Msun/h, 8.9e11 Msun/h; or in Msun, whatever h is.
    assert _stellar.stellar_mass(M1, relation, 0.7) == pytest.approx(8.9e11 / 0.7, rel=2e-3)
    other = _stellar.OCCUPATIONS["wang2013"][0]
    assert _stellar.stellar_mass(M1, other, 0.7) == _stellar.stellar_mass(M1, other, 1.0)


def test_lost_mass():
    assert _stellar.mass_loss_factor(0.3, 0.3, S) == 1.0
    plane = LensPlane.at(0.3)
    rate = math.sqrt(float(plane.cosmology.efunc2(0.3)))
    tau = 2.0 / math.sqrt(125.073396 / 101.140715) / rate
    elapsed = _structure.age(0.3, S) - _structure.age(0.5, S)
    assert _stellar.mass_loss_factor(0.3, 0.5, S) == pytest.approx(math.exp(elapsed / tau), rel=1e-4)
