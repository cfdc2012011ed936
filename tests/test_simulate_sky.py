"""What is observed of a simulated cluster: sources, images, shear; the command is in test_cli_simulate.py."""

import dataclasses
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import integrate
from support import strict, table

from jaxlens import lens as lens_module
from jaxlens import lens_equation, simulate, weak
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.grid import Grid, rebin, resample
from jaxlens.lens import Lens
from jaxlens.profiles import TSIS, hernquist, nfw
from jaxlens.simulate import ImageSettings, ShearSettings, SourceSettings, luminosity_function
from jaxlens.simulate._images import padded
from jaxlens.simulate.luminosity_function import Depth

PLANE = partial(LensPlane.at, 0.3)
H = 0.7
IMAGES, SOURCES = ImageSettings(half_width_arcsec=60.0), SourceSettings(depth=Depth(m_cut=30.0))
# The window of test_cli_simulate.py, whose programs these tests share; two hundred sources are one batch.


def two_clumps(plane: LensPlane) -> Lens:
    """The haloes of the paper with central galaxies and 40 subhaloes; not drawn by the package."""
    half = 30.0 / H / float(plane.kpc_per_arcsec)
    centre, pa = np.array([[-half, 0.0], [half, 0.0]]), np.deg2rad([17.0, 42.0])
    halo = nfw.from_mass(np.array([5.7e14, 4.5e14]) / H, np.array([3.6, 3.6]), plane, e=0.28)
    bcg = hernquist.from_mass(np.array([8.9e11, 8.1e11]) / H, np.array([0.8, 0.73]), plane, e=0.2)
    rng = np.random.default_rng(1)
    satellites = TSIS(theta_e=rng.uniform(0.05, 0.6, 40), r_t=rng.uniform(5.0, 25.0, 40))
    return Lens(
        halo=strict(halo, centre, pa),
        bcg=strict(bcg, centre, pa),
        subhaloes=strict(satellites, rng.normal(0.0, 60.0, (40, 2)), np.zeros(40)),
    )


# --- luminosity function ------------------------------------------------------------------------


@pytest.mark.parametrize("row", range(12))
def test_expected_counts_are_those_of_the_reference(row: int):
    reference = table("uvlf_counts.csv")
    one = {name: values[row] for name, values in reference.items()}
    depth = Depth(
        m_cut=float(one["m_cut"]),
        k_term=bool(one["k_correction"]),
        low_z={"step": "step", "lin": "linear"}[str(one["mode_lowz"])],
        high_z={"lin": "linear", "nearest": "nearest"}[str(one["mode_highz"])],
    )
    found = luminosity_function.counts(0.3, FlatLCDM(h=0.7, omega_m=0.3), depth)
    # The trapezium rule on 48 nodes a piece; 2e-4 measured.
    assert_allclose(found.expected(900.0), one["N_total"], rtol=3e-5)
    edges = (0.3, 1.0, 2.0, 3.0, 4.0, 6.0, 9.0)
    for low, high in pairwise(edges):
        assert_allclose(found.expected(900.0, low, high), one[f"N_{low:g}_{high:g}"], rtol=3e-4)


def test_the_limits_of_the_paper():
    depth = Depth()
    limit = luminosity_function.faintest(
        np.array([0.3, 1.0, 2.0, 4.0, 6.0, 9.0]), FlatLCDM(h=0.7, omega_m=0.3), depth
    )
    assert_allclose(limit, [-8.671, -11.348, -12.764, -14.025, -14.694, -15.321], atol=6e-4)
    found = simulate.limiting_magnitude(np.array([0.0, 50.0, 100.0, 200.0]), ImageSettings())
    assert_allclose(found, [28.0, 28.590, 28.948, 29.297], atol=6e-4)


def test_the_schechter_function_integrates_to_its_incomplete_gamma_function():
    z = np.array([3.0])
    m_star, phi, alpha = (float(v[0]) for v in luminosity_function.schechter(z, Depth()))
    assert (m_star, phi, alpha) == pytest.approx((-20.87, 2.1e-3, -1.61))
    schechter = lambda x: phi * x**alpha * np.exp(-x)  # per unit x = L/L*
    whole, _ = integrate.quad(schechter, 10.0 ** (-0.4 * (-17.0 - m_star)), np.inf, epsrel=1e-9)
    nodes = np.linspace(-27.0, -17.0, 4001)
    ours = np.trapezoid(luminosity_function.density(nodes[None], z, Depth())[0], nodes)
    assert_allclose(ours, whole, rtol=1e-5)


def test_sources_follow_the_counts():
    plane, settings = PLANE(), SourceSettings(box_arcsec=60.0)
    sources = simulate.draw_sources(jax.random.key(5), settings, plane)
    found = simulate.expected_sources(settings, plane)
    mean = found.expected(60.0**2)
    assert abs(len(sources) - mean) < 4.0 * mean**0.5  # one false alarm in 16000 seeds
    # Kolmogorov and Smirnov: 1.95/sqrt(n) is exceeded once in 1000 seeds.
    limit = 1.95 / len(sources) ** 0.5
    order = np.sort(np.interp(sources.z, found.z, found.cumulative) / found.cumulative[-1])
    assert np.abs(order - (np.arange(len(order)) + 0.5) / len(order)).max() < limit
    for axis in (0, 1):
        order = np.sort(sources.beta[:, axis] / 60.0 + 0.5)
        assert np.abs(order - (np.arange(len(order)) + 0.5) / len(order)).max() < limit
    assert sources.mag.max() < 32.0
    assert sources.mag_uv.min() > -25.0
    assert_allclose(sources.dls_ds, plane.dls_ds(jnp.asarray(sources.z)), rtol=1e-12)
    # A fifth of the sources at z = 4 +- 0.5 is brighter than m = 31 by the same counts to a brighter limit.
    near = (sources.z > 3.5) & (sources.z < 4.5)
    share = np.mean(sources.mag[near] < 31.0)
    brighter = simulate.expected_sources(dataclasses.replace(settings, depth=Depth(m_cut=31.0)), plane)
    expected = brighter.expected(1.0, 3.5, 4.5) / found.expected(1.0, 3.5, 4.5)
    assert abs(share - expected) < 4.0 * (expected * (1.0 - expected) / near.sum()) ** 0.5


# --- images -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def strong() -> tuple[Lens, LensPlane, simulate.Sources, simulate.Catalogue, simulate.Images]:
    plane = PLANE()
    lens = two_clumps(plane)
    sources = simulate.draw_sources(jax.random.key(1), SOURCES, plane)
    catalogue, images = simulate.find_images(jax.random.key(2), lens, sources, plane, IMAGES)
    return lens, plane, sources, catalogue, images


def test_every_image_solves_the_lens_equation(strong):
    lens, _, sources, _, images = strong
    theta, ratio = jnp.asarray(images.theta), jnp.asarray(sources.dls_ds[images.source])
    back, jacobian = jax.jit(lens_module.source_and_jacobian)(lens, theta, ratio)
    assert_allclose(back, sources.beta[images.source], rtol=0.0, atol=1e-6)
    assert_allclose(images.mu, 1.0 / np.linalg.det(jacobian), rtol=1e-6)
    assert len(images.doubtful) == 0


def test_every_source_has_its_images_found(strong):
    lens, _, sources, _, images = strong
    # An independent window with other cells, of the same shapes, to share programs.
    some = np.resize(np.arange(len(sources)), 256)
    tiling = lens_equation.tile(padded(lens), centre=(0.3, -0.2), half_width=58.0, pixel=0.92, margin=5.0)
    beta, ratio = jnp.asarray(sources.beta[some]), jnp.asarray(sources.dls_ds[some])
    found = lens_equation.solve(padded(lens), beta, ratio, tiling=tiling)
    inside = np.all(np.abs(images.theta - [0.3, -0.2]) < 58.0, axis=1)
    count = np.bincount(images.source[inside], minlength=len(sources))
    assert np.array_equal(count[some], np.asarray(found.valid).sum(axis=1))
    assert np.bincount(images.source, minlength=len(sources)).min() >= 1


def test_the_catalogue_holds_what_is_seen(strong):
    _, plane, sources, catalogue, images = strong
    seen = {int(s) for s in images.source[images.mag < images.limit]}
    number = {s: int(np.sum((images.source == s) & (images.mag < images.limit))) for s in seen}
    systems = sorted(s for s, n in number.items() if n >= 2)
    assert catalogue.source.tolist() == systems
    assert catalogue.n_images == sum(number[s] for s in systems)
    truth = catalogue.truth
    assert np.array_equal(catalogue.source[catalogue.system], truth.source)
    radius = np.hypot(*truth.theta.T) * float(plane.kpc_per_arcsec)
    assert_allclose(truth.limit, 29.5 - 1.5 * np.exp(-radius / 100.0), rtol=1e-12)
    assert_allclose(truth.mag, sources.mag[truth.source] - 2.5 * np.log10(np.abs(truth.mu)), rtol=1e-12)
    scatter = (catalogue.theta - truth.theta) / 0.15
    # A chi^2 of 2 n numbers; 4 standard deviations.
    assert abs(np.sum(scatter**2) / scatter.size - 1.0) < 4.0 * (2.0 / scatter.size) ** 0.5


def test_systems_need_as_many_images_as_are_asked_for(strong):
    *_, images = strong
    three = simulate.observe(jax.random.key(0), images, ImageSettings(min_images=3))
    assert np.bincount(three.system).min() >= 3
    nothing = simulate.observe(jax.random.key(0), images, ImageSettings(min_images=99))
    assert nothing.n_systems == nothing.n_images == 0


def test_margin_of_the_main_caustic(strong):
    lens, plane, *_ = strong
    margin, cut = simulate.caustic_margin(lens, plane, SourceSettings(), half_width=45.0)
    wider, _ = simulate.caustic_margin(lens, plane, SourceSettings(box_arcsec=40.0), half_width=45.0)
    assert wider == pytest.approx(margin + 5.0)
    assert 0.0 < margin < 15.0
    assert not cut
    smaller, _ = simulate.caustic_margin(lens, plane, SourceSettings(box_arcsec=10.0), half_width=45.0)
    assert smaller == pytest.approx(margin - 10.0)
    assert smaller < 0.0


def test_margin_of_a_caustic_that_is_not_whole(strong):
    lens, plane, *_ = strong
    # The main critical curve reaches 30 arcsec; the curves of subhaloes close in a smaller window.
    main = simulate.caustic_margin(lens, plane, SourceSettings(), half_width=20.0)
    assert np.isnan(main.arcsec)
    assert main.cut
    # A galaxy too light and wide for any critical curve on this grid.
    galaxy = hernquist.from_mass(np.array([1e10]), np.array([8.0]), plane)
    faint = Lens(bcg=strict(galaxy, np.zeros((1, 2)), np.zeros(1)))
    none = simulate.caustic_margin(faint, plane, SourceSettings(), half_width=20.0)
    assert np.isnan(none.arcsec)
    assert not none.cut


# --- shear --------------------------------------------------------------------------------------


def test_resampling_weighs_by_area():
    rng = np.random.default_rng(0)
    values, grid = jnp.asarray(rng.normal(size=(20, 20))), Grid((20, 20), 0.6)
    made, other = resample(values, grid, (3, 3))
    assert other.pixel == pytest.approx(4.0)
    # By way of the common divisor: 60 pixels a side hold both.
    fine = jnp.repeat(jnp.repeat(values, 3, axis=0), 3, axis=1)
    assert_allclose(made, rebin(fine, Grid((60, 60), 0.2), 20)[0], rtol=1e-12)
    assert_allclose(made.mean(), values.mean(), rtol=1e-12)
    with pytest.raises(ValueError, match="same proportions"):
        resample(values, grid, (3, 4))


SHEAR = ShearSettings(map_pixels=512)


@pytest.fixture(scope="module")
def fields(strong) -> dict[str, simulate.TrueField]:
    lens = strong[0]
    smooth = Lens(halo=lens.components["halo"], bcg=lens.components["bcg"])
    draw = partial(simulate.render, smooth)
    return {
        mode: simulate.true_field(smooth, draw, dataclasses.replace(SHEAR, mode=mode))
        for mode in simulate.SHEAR_MODES
    }


def test_shear_modes_against_the_lens_itself(strong, fields):
    plane = strong[1]
    ratio, radius = float(plane.dls_ds(2.0)), np.asarray(SHEAR.grid.radius)
    rings = ((40.0, 96.0), (96.0, 160.0), (160.0, 240.0))

    def rms(mode: str) -> list[float]:
        off = ratio * np.abs(np.asarray(fields[mode].gamma - fields["analytic"].gamma))
        return [float(np.sqrt(np.mean(off[(radius >= a) & (radius < b)] ** 2))) for a, b in rings]

    assert max(rms("extended")) < 6e-4  # 4e-4 measured: the haloes have no edge, the map has
    # What the map does not hold, and the periodic images of what it does.
    assert 5e-3 < rms("padded")[2] < 2e-2
    assert 3e-2 < rms("periodic")[2] < 6e-2


def test_periodic_shear_returns_the_convergence_without_its_mean(fields):
    found = fields["periodic"]
    kappa, gamma = np.asarray(found.kappa), np.asarray(found.gamma)
    k_y, k_x = np.meshgrid(np.fft.fftfreq(48), np.fft.fftfreq(48), indexing="ij")
    k = k_x + 1j * k_y
    k[0, 0] = 1.0
    # kappa_k = conj(D) gamma_k, D = k^2/|k|^2 (Kaiser & Squires 1993).
    back = np.fft.ifft2(np.conj(k**2) / np.abs(k) ** 2 * np.fft.fft2(gamma))
    assert_allclose(back, kappa - kappa.mean(), rtol=0.0, atol=1e-12)
    # The package's own inversion has the modes below the Nyquist frequency.
    made, b_mode = weak.kaiser_squires(found.gamma, padding=1.0)
    k[0, 0] = 1.0
    band = np.fft.ifft2(np.where(np.abs(k) < 0.5, np.fft.fft2(kappa), 0.0)).real
    assert_allclose(made, band, rtol=0.0, atol=1e-12)
    assert_allclose(b_mode, 0.0, atol=1e-12)


def test_kappa_is_the_mean_over_the_pixel(strong, fields):
    lens = strong[0]
    fine = Grid((48 * 12, 48 * 12), 10.0 / 12.0)
    smooth = Lens(halo=lens.components["halo"], bcg=lens.components["bcg"])
    mean, _ = rebin(jax.jit(lambda lens: lens_module.kappa(lens, fine.theta))(smooth), fine, 12)
    far = np.asarray(SHEAR.grid.radius) > 30.0
    assert_allclose(np.asarray(fields["extended"].kappa)[far], np.asarray(mean)[far], rtol=2e-3)


def test_shear_is_tangential(strong, fields):
    radius, theta = np.asarray(SHEAR.grid.radius), np.asarray(SHEAR.grid.theta)
    turn = np.exp(-2j * np.arctan2(theta[..., 1], theta[..., 0]))
    for found in fields.values():
        tangential = -np.real(np.asarray(found.gamma) * turn)
        assert tangential[(radius > 60.0) & (radius < 200.0)].min() > 0.0


def test_expected_galaxies_of_the_paper():
    mean = np.asarray(simulate.mean_counts(ShearSettings(), PLANE()))[0]
    assert mean.sum() == pytest.approx(26720.62, abs=0.01)
    assert (mean.min(), mean.max(), mean.mean()) == pytest.approx((8.759, 11.974, 11.597), abs=1e-3)
    two = ShearSettings(bins=(simulate.Bin(1.0, 0.25), simulate.Bin(3.0, 0.75)))
    assert_allclose(np.asarray(simulate.mean_counts(two, PLANE()))[0], 0.25 * mean, rtol=1e-12)


def test_galaxies_make_the_map(strong, fields):
    plane = strong[1]
    settings = dataclasses.replace(SHEAR, bins=(simulate.Bin(1.0, 0.3), simulate.Bin(2.0, 0.7)))
    bins, galaxies = simulate.shear_field(
        jax.random.key(3), jax.random.key(4), fields["extended"], plane, settings
    )
    for one in bins:
        here = galaxies.z == one.z_s
        own = weak.Galaxies(galaxies.theta, galaxies.eps, (galaxies.use & here).astype(float))
        made = weak.to_grid(own, settings.grid)
        used = np.asarray(one.shear.weight) > 0.0
        assert_allclose(np.asarray(made.g)[used], np.asarray(one.shear.g)[used], atol=1e-13)
        assert np.array_equal(np.asarray(made.n_gal)[used], np.asarray(one.shear.n_gal)[used])
        assert np.array_equal(used, (np.abs(np.asarray(one.g)) <= 0.5) & (np.asarray(one.shear.n_gal) > 0))
        assert np.asarray(made.weight)[~used].max() == 0.0
    # Nearer sources are sheared less, and masked less.
    assert np.abs(bins[0].g).max() < np.abs(bins[1].g).max()
    assert np.abs(galaxies.eps).max() < 1.0
    assert np.abs(galaxies.theta).max() <= 240.0


def test_without_noise_the_map_is_the_reduced_shear(strong, fields):
    plane, settings = strong[1], dataclasses.replace(SHEAR, sigma_eps=0.0)
    (one,), _ = simulate.shear_field(
        jax.random.key(3), jax.random.key(4), fields["extended"], plane, settings
    )
    ratio = float(plane.dls_ds(2.0))
    g = ratio * np.asarray(fields["extended"].gamma) / (1.0 - ratio * np.asarray(fields["extended"].kappa))
    weak_pixels = (np.abs(g) < 1.0) & (np.asarray(one.shear.n_gal) > 0)
    assert_allclose(np.asarray(one.shear.g)[weak_pixels], g[weak_pixels], atol=1e-12)
    averaged = dataclasses.replace(SHEAR, average_g=True)
    _, other = simulate.reduced_shear(fields["extended"], ratio, averaged)
    far = np.asarray(SHEAR.grid.radius) > 60.0
    assert 0.0 < np.abs(np.asarray(other) - g)[far].max() < 2e-2


def test_intrinsic_ellipticities_are_a_truncated_gaussian():
    eps = np.asarray(simulate.intrinsic_ellipticities(jax.random.key(0), 200_000, 0.24))
    assert np.abs(eps).max() < 0.999
    # Standard errors 4e-4 and 5e-4; truncation takes 0.1 % off the scatter.
    assert np.real(eps).std() == pytest.approx(0.2398, abs=2e-3)
    assert np.imag(eps).std() == pytest.approx(0.2398, abs=2e-3)
    assert abs(eps.mean()) < 3e-3
    assert np.mean(np.abs(eps) > 0.48) == pytest.approx(np.exp(-2.0), abs=3e-3)


# --- randomness and refusals --------------------------------------------------------------------


def test_no_key_is_used_twice(strong, fields):
    plane, images = strong[1], strong[4]
    with jax.debug_key_reuse(True):
        keys = simulate.stage_keys(3)
        sources = simulate.draw_sources(keys["sources"], SourceSettings(), plane)
        simulate.observe(keys["image_noise"], images, ImageSettings())
        simulate.shear_field(keys["counts"], keys["ellipticities"], fields["extended"], plane, SHEAR)
        simulate.draw_cluster(keys["cluster"], simulate.ClusterSettings(m_min_msun_h=5e12))
        # Each is spent now, so the check works; that of the cluster is only folded, once for each halo.
        for name in ("sources", "image_noise", "counts", "ellipticities"):
            with pytest.raises(jax.errors.KeyReuseError):
                jax.random.uniform(keys[name])
    assert len(sources) > 0


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ShearSettings(mode="exact"), "`mode` is 'exact'"),
        (lambda: ShearSettings(map_pixels=100), "`map_pixels` is 100"),
        (lambda: ShearSettings(map_pixels=100_000), "`map_pixels` is 100000; 80 GB"),
        (lambda: ShearSettings(bins=(simulate.Bin(2.0, 0.5),)), "must add up to 1"),
        (lambda: ShearSettings(density_arcmin2=0.0), "`density_arcmin2` is 0.0"),
        (lambda: SourceSettings(box_arcsec=-1.0), "`box_arcsec` is -1.0"),
        (lambda: ImageSettings(min_images=1), "`min_images` is 1"),
        (lambda: ImageSettings(scale_kpc=0.0), "`scale_kpc` is 0.0"),
        (lambda: Depth(z_max=12.0), "`z_max` is 12.0"),
        (lambda: Depth(low_z="best"), "`low_z` is 'best'"),
        (lambda: simulate.Settings(shear=ShearSettings(bins=(simulate.Bin(0.2),))), "not behind the lens"),
        (lambda: simulate.Settings(shear=ShearSettings(field_arcmin=6.0)), "give one field"),
    ],
)
def test_impossible_settings_are_refused(make, said: str):
    with pytest.raises(ValueError, match=said):
        make()
