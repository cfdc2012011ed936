"""Simulated clusters: masses and scales, what is drawn, bookkeeping, and what is refused."""

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from jaxlens import lens as lensing
from jaxlens import radial
from jaxlens.cosmology import LensPlane
from jaxlens.simulate import MERGER, Clump, ClusterSettings, SimulatedCluster, _triaxial, draw_cluster
from jaxlens.units import G_MPC_KM2_S2_MSUN

H = 0.7
ROUND = (1.0, 1.0)
SMOOTH: dict[str, Any] = {"subhaloes": False}


def nfw_mass(x: float) -> float:
    return math.log1p(x) - x / (1.0 + x)


@pytest.fixture(scope="module")
def cluster() -> SimulatedCluster:
    return draw_cluster(jax.random.key(7))


@pytest.fixture(scope="module")
def smooth() -> SimulatedCluster:
    """The two haloes as spheres of median concentration without anything in them."""
    clumps = tuple(
        Clump(c.mass_msun_h, c.x_kpc_h, concentration=x, axis_ratios=ROUND, bcg_mass_msun=0.0)
        for c, x in zip(MERGER, (4.14, 4.18), strict=True)
    )
    return draw_cluster(jax.random.key(0), ClusterSettings(clumps=clumps, **SMOOTH))


# --- scales and units ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("z_s", "d_s", "d_ls", "ratio", "sigma_cr"),
    [
        (0.6, 1378.981606, 632.483562, 0.45865990, 3.94615717e15),
        (1.0, 1651.914403, 1054.715968, 0.63848100, 2.83476569e15),
        (1.5, 1745.542306, 1267.783559, 0.72629781, 2.49201363e15),
        (2.0, 1726.620691, 1328.488402, 0.76941531, 2.35236291e15),
        (3.0, 1588.921359, 1290.322142, 0.81207426, 2.22879129e15),
        (4.0, 1434.073283, 1195.193909, 0.83342596, 2.17169145e15),
        (6.0, 1178.131433, 1007.503308, 0.85517055, 2.11647143e15),
        (9.0, 921.034192, 801.594505, 0.87032003, 2.07963046e15),
    ],
)
def test_geometry_behind_the_cluster_agrees_with_astropy(
    cluster: SimulatedCluster, z_s: float, d_s: float, d_ls: float, ratio: float, sigma_cr: float
):
    plane = cluster.plane
    assert float(plane.cosmology.angular_diameter_distance(z_s)) == pytest.approx(d_s, rel=1e-6)
    assert float(plane.dls_ds(z_s)) == pytest.approx(d_ls / d_s, rel=1e-6)
    assert float(plane.dls_ds(z_s)) == pytest.approx(ratio, rel=1e-6)
    assert float(plane.sigma_cr(z_s)) == pytest.approx(sigma_cr, rel=1e-6)
    assert float(plane.kpc_per_arcsec) == pytest.approx(4.454307, rel=1e-6)


@pytest.mark.parametrize(
    ("which", "r_vir", "r_s", "rho_s", "r_200", "m_200", "c_200"),
    [
        (0, 1.50600, 0.36377, 1.341835e15, 1.21501, 5.66797e14, 3.3401),
        (1, 1.38498, 0.33134, 1.370804e15, 1.11771, 4.41243e14, 3.3733),
    ],
)
def test_scales_of_the_two_haloes(
    smooth: SimulatedCluster,
    which: int,
    r_vir: float,
    r_s: float,
    rho_s: float,
    r_200: float,
    m_200: float,
    c_200: float,
):
    # Reference in Mpc/h, Msun/h; tolerances are its printed digits.
    clump = smooth.clumps[which]
    assert clump.r_vir_mpc * H == pytest.approx(r_vir, abs=6e-6)
    assert clump.r_s_mpc * H == pytest.approx(r_s, abs=6e-6)
    assert clump.rho_s_msun_mpc3 / H**2 == pytest.approx(rho_s, rel=1e-6)
    assert clump.smooth_mass_msun == clump.mass_msun == MERGER[which].mass_msun_h / H
    density = 200.0 * float(smooth.plane.cosmology.critical_density(0.3)) / clump.rho_s_msun_mpc3
    x: float = brentq(lambda x: 3.0 * nfw_mass(x) / x**3 - density, 0.1, 100.0)  # pyright: ignore[reportAssignmentType]
    assert x == pytest.approx(c_200, abs=6e-5)
    assert x * clump.r_s_mpc * H == pytest.approx(r_200, abs=6e-6)
    assert nfw_mass(x) / nfw_mass(clump.concentration) * MERGER[which].mass_msun_h == pytest.approx(
        m_200, rel=2e-6
    )


def test_strength_and_projected_mass_of_the_halo(smooth: SimulatedCluster):
    halo, plane = smooth.lens.components["halo"], smooth.plane
    strength = float(halo.params.kappa_s[0] * plane.dls_ds(2.0))
    assert strength == pytest.approx(0.145251, abs=6e-7)
    # M_2D(< R_200c) of the first alone.
    alone = draw_cluster(jax.random.key(0), ClusterSettings(clumps=(smooth.settings.clumps[0],), **SMOOTH))
    radius = jnp.array([1.21501 / H / float(plane.d_l) * 206264.80624709636])
    mass = float(radial.mass_within(alone.lens, plane, radius)[0]) * H
    assert mass == pytest.approx(7.38898e14, rel=1e-5)  # 4.6e-6 is the accuracy of the expansion of an NFW


def test_clumps_are_where_they_were_put(cluster: SimulatedCluster):
    first, second = cluster.clumps
    assert (first.x_arcsec, second.x_arcsec) == pytest.approx((-19.243 / 2, 19.243 / 2), abs=6e-4)
    assert first.y_arcsec == second.y_arcsec == 0.0
    assert second.x_arcsec - first.x_arcsec == pytest.approx(60.0 / H / 4.454307, rel=1e-6)
    for name in ("halo", "bcg"):
        np.testing.assert_array_equal(
            cluster.lens.components[name].centre, [[c.x_arcsec, c.y_arcsec] for c in cluster.clumps]
        )


@pytest.mark.parametrize(
    ("centre", "expected"),
    [("midpoint", -30.0), ("first", 0.0), ("mass_weighted", -60.0 * 5.25 / 12.0), ("given", 970.0)],
)
def test_origin(centre: Any, expected: float):
    clumps = (Clump(6.75e14, x_kpc_h=970.0), Clump(5.25e14, x_kpc_h=1030.0))
    found = ClusterSettings(clumps=clumps, centre=centre).positions_kpc_h()
    assert found[0] == pytest.approx((expected, 0.0), abs=1e-9)
    assert found[1][0] - found[0][0] == pytest.approx(60.0)


# --- what is drawn ------------------------------------------------------------------------------


def test_position_angles_differ_by_what_was_asked(cluster: SimulatedCluster):
    first, second = (clump.pa_rad for clump in cluster.clumps)
    assert math.sin(second - first - math.radians(25.0)) == pytest.approx(0.0, abs=1e-12)
    given = (Clump(6e14, pa_rad=0.3), Clump(5e14), Clump(4e14, pa_rad=2.0), Clump(3e14))
    made = draw_cluster(jax.random.key(1), ClusterSettings(clumps=given, pa_difference_deg=40.0, **SMOOTH))
    angles = [clump.pa_rad for clump in made.clumps]
    expected = [0.3, 0.3 + math.radians(40.0), 2.0, 2.0 + math.radians(40.0)]
    np.testing.assert_allclose(np.sin(np.subtract(angles, expected)), 0.0, atol=1e-12)
    free = draw_cluster(jax.random.key(1), ClusterSettings(clumps=given, pa_difference_deg="drawn", **SMOOTH))
    assert free.clumps[0].pa_rad == angles[0]
    assert free.clumps[1].pa_rad != angles[1]


def test_round_haloes_keep_the_position_angle_they_were_given():
    # The halo has no angle, but its elliptical galaxy does; 2.0 + 100 degrees passes pi.
    given = (Clump(6e14, axis_ratios=ROUND, pa_rad=2.0), Clump(5e14, axis_ratios=ROUND), Clump(4e14))
    settings = ClusterSettings(clumps=given, pa_difference_deg=100.0, **SMOOTH)
    made = draw_cluster(jax.random.key(1), settings)
    expected = [(2.0 + math.radians(100.0 * k)) % math.pi for k in range(3)]
    np.testing.assert_allclose([clump.pa_rad for clump in made.clumps], expected, rtol=1e-12)
    np.testing.assert_allclose(made.lens.components["bcg"].pa, expected, rtol=1e-12)
    assert made.clumps[0].q == pytest.approx(1.0, abs=1e-12)


def test_satellites_follow_the_halo_on_the_sky():
    # A needle across the line of sight: second moments of the satellites along its position angle.
    clump = Clump(
        2e15, axis_ratios=(0.3, 0.3), orientation=(math.cos(math.pi / 4), 0.0, math.sin(math.pi / 4), 0.0)
    )
    made = draw_cluster(jax.random.key(2), ClusterSettings(clumps=(clump,)))
    (truth,) = made.clumps
    assert truth.q == pytest.approx(0.3, rel=1e-12)
    x, y = made.subhaloes["x_arcsec"], made.subhaloes["y_arcsec"]
    c, s = math.cos(truth.pa_rad), math.sin(truth.pa_rad)
    along, across = np.std(c * x + s * y), np.std(c * y - s * x)
    # 2100 satellites: the ratio of two standard deviations is good to 2 %; 4 of these.
    assert across / along == pytest.approx(0.3, rel=0.08)


def test_mass_is_shared_out(cluster: SimulatedCluster):
    subhaloes = cluster.subhaloes
    for i, clump in enumerate(cluster.clumps):
        mine = subhaloes["clump"] == i
        assert mine.sum() == clump.subhalo_count
        assert subhaloes["mass_msun"][mine].sum() == pytest.approx(clump.subhalo_mass_msun, rel=1e-14)
        whole = clump.smooth_mass_msun + clump.subhalo_mass_msun + clump.bcg_mass_msun
        assert whole == pytest.approx(clump.mass_msun, rel=1e-14)
        # The smooth halo in the lens holds its share, 4 pi kappa_s Sigma_cr r_s^2 m(c).
        halo = cluster.lens.components["halo"].params
        r_s = float(halo.r_s[i]) * 1e-3 * float(cluster.plane.kpc_per_arcsec)
        held = 4.0 * math.pi * float(halo.kappa_s[i] * cluster.plane.sigma_cr_inf) * r_s**2
        assert held * nfw_mass(clump.concentration) == pytest.approx(clump.smooth_mass_msun, rel=1e-12)
        galaxy = cluster.lens.components["bcg"].params
        r_g = float(galaxy.r_s[i]) * 1e-3 * float(cluster.plane.kpc_per_arcsec)
        held = 2.0 * math.pi * r_g**2 * float(galaxy.kappa_s[i] * cluster.plane.sigma_cr_inf)
        assert held == pytest.approx(clump.bcg_mass_msun, rel=1e-12)
        assert r_g == pytest.approx(0.551 * 0.003 * clump.r_vir_mpc, rel=1e-12)
    assert subhaloes["mass_msun"].min() >= 1e10 / H
    assert subhaloes["mass_msun"].max() <= 0.1 * 6.75e14 / H
    np.testing.assert_allclose(subhaloes["luminosity_b"], subhaloes["stellar_mass_msun"] / 4.0)


def test_deflection_of_a_subhalo_is_that_of_its_mass(cluster: SimulatedCluster):
    """alpha = M_2D/(pi Sigma_cr R) with M_2D = (m/R_t)[R arccos(R/R_t) - sqrt(R_t^2 - R^2) + R_t]."""
    component, table = cluster.lens.components["subhaloes"], cluster.subhaloes
    k = 11
    one = jax.tree.map(lambda leaf: leaf[k : k + 1], component)
    plane = cluster.plane
    mass, r_t = table["mass_msun"][k], 1e-3 * table["r_t_kpc"][k]
    assert 2.0 * table["sigma_v_kms"][k] ** 2 * r_t / G_MPC_KM2_S2_MSUN == pytest.approx(mass, rel=1e-12)
    for u in (0.01, 0.5, 0.9, 1.0, 3.0):
        r = u * r_t
        inside = u < 1.0
        within = mass / r_t * (r * math.acos(u) - math.sqrt(r_t**2 - r**2) + r_t) if inside else mass
        if u == 0.5:
            assert within / mass == pytest.approx(0.657573, abs=6e-7)
        expected = within / (math.pi * float(plane.sigma_cr_inf) * r) / float(plane.d_l)  # rad
        offset = r / (1e-3 * float(plane.kpc_per_arcsec))
        theta = component.centre[k] + offset * jnp.array([0.6, -0.8])
        alpha = lensing.alpha(lensing.Lens(one=one), theta)
        # The published constants have ten digits.
        np.testing.assert_allclose(alpha, expected * 206264.80624709636 * np.array([0.6, -0.8]), rtol=1e-9)


def test_numbers_of_many_clusters():
    """20 draws; `benchmarks/simulated_cluster.py` has 200."""
    single = (Clump(6.75e14, concentration=4.140649978656 * math.exp(0.25**2 / 2)),)
    settings = ClusterSettings(clumps=single)
    made = [draw_cluster(jax.random.key(s), settings) for s in range(20)]
    counts = np.array([m.clumps[0].subhalo_count for m in made])
    fractions = np.array([m.clumps[0].subhalo_mass_msun / m.clumps[0].mass_msun for m in made])
    # Poisson, 4 standard deviations of the mean of 20: false alarm 6e-5 each.
    assert counts.mean() == pytest.approx(797.55, abs=4.0 * math.sqrt(797.55 / 20))
    assert counts.std() == pytest.approx(math.sqrt(797.55), rel=0.65)
    assert fractions.mean() == pytest.approx(0.150, abs=4.0 * 0.048 / math.sqrt(20))
    assert {m.clumps[0].concentration for m in made} == {single[0].concentration}


def test_scatter_of_concentrations_makes_haloes_richer_on_average():
    """849 = 797.55 E[cbar/c], cbar the mean of a log-normal c: E[cbar/c] = exp(s^2) with s = 0.25."""
    made = [draw_cluster(jax.random.key(s), ClusterSettings(clumps=(Clump(6.75e14),))) for s in range(20)]
    counts = np.array([m.clumps[0].subhalo_count for m in made])
    # Scatter of cbar/c, then Poisson: 220 for one halo. 4 standard deviations of the mean of 20: one false
    # alarm in 16,000.
    spread = math.sqrt(849.0 + 797.55**2 * (math.exp(3 * 0.25**2) - math.exp(2 * 0.25**2)))
    assert counts.mean() == pytest.approx(849.0, abs=4.0 * spread / math.sqrt(20))
    # The same draws, halo by halo: what is left is Poisson, and without the scatter they would be 52 fewer.
    ratio = [m.clumps[0].mean_concentration / m.clumps[0].concentration for m in made]
    expected = 797.55 * np.array(ratio)
    assert counts.sum() == pytest.approx(expected.sum(), abs=4.0 * math.sqrt(expected.sum()))


def test_poor_concentrations_make_rich_haloes():
    clumps = (Clump(6.75e14, concentration=2.0), Clump(6.75e14, concentration=8.0))
    first, second = draw_cluster(jax.random.key(3), ClusterSettings(clumps=clumps)).clumps
    # 1701 and 425 expected, 4 standard deviations of their ratio.
    assert first.subhalo_count / second.subhalo_count == pytest.approx(4.0, rel=0.22)
    assert first.mean_concentration == pytest.approx(4.140649978656 * math.exp(0.25**2 / 2), rel=1e-6)


# --- keys ---------------------------------------------------------------------------------------


def test_no_key_is_used_twice():
    with jax.debug_key_reuse(True):
        draw_cluster(jax.random.key(5), ClusterSettings(satellite_scatter=True))
        # The guard is awake: a second draw from one key is caught.
        key = jax.random.key(0)
        _triaxial.draw_orientation(key)
        with pytest.raises(jax.errors.KeyReuseError):
            _triaxial.draw_orientation(key)


def test_same_seed_same_bytes(cluster: SimulatedCluster):
    again, other = (draw_cluster(jax.random.key(s)) for s in (7, 8))
    for one, two in zip(jax.tree.leaves(cluster.lens), jax.tree.leaves(again.lens), strict=True):
        np.testing.assert_array_equal(one, two)
    for name, column in cluster.subhaloes.items():
        assert column.tobytes() == again.subhaloes[name].tobytes()
    assert cluster.clumps == again.clumps
    assert cluster.clumps != other.clumps


def test_draws_of_a_clump_do_not_depend_on_the_others(cluster: SimulatedCluster):
    three = ClusterSettings(clumps=(*MERGER, Clump(1e14)), centre="given")
    more = draw_cluster(jax.random.key(7), three)
    assert more.clumps[:2] == cluster.clumps
    fixed = ClusterSettings(clumps=(Clump(6.75e14, x_kpc_h=-30.0, axis_ratios=(0.5, 0.6)), MERGER[1]))
    changed = draw_cluster(jax.random.key(7), fixed)
    assert changed.clumps[0].concentration == cluster.clumps[0].concentration
    assert changed.clumps[1].axis_ratios == cluster.clumps[1].axis_ratios


def test_single_precision_is_refused():
    with jax.enable_x64(False), pytest.raises(TypeError, match="jax_enable_x64"):
        draw_cluster(jax.random.key(0))


# --- bad settings -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "named"),
    [
        ({"mass_msun_h": -1e14}, "mass_msun_h"),
        ({"mass_msun_h": math.nan}, "mass_msun_h"),
        ({"x_kpc_h": math.inf}, "x_kpc_h"),
        ({"concentration": 0.0}, "concentration"),
        ({"axis_ratios": (0.8, 0.5)}, "axis_ratios"),
        ({"axis_ratios": (0.5, 1.2)}, "axis_ratios"),
        ({"orientation": (0.0, 0.0, 0.0, 0.0)}, "orientation"),
        ({"pa_rad": math.nan}, "pa_rad"),
        ({"bcg_mass_msun": -1.0}, "bcg_mass_msun"),
    ],
)
def test_a_clump_that_cannot_be_is_refused(bad: dict[str, Any], named: str):
    with pytest.raises(ValueError, match=f"`{named}` is"):
        replace(Clump(1e14), **bad)


@pytest.mark.parametrize(
    ("bad", "named"),
    [
        ({"clumps": ()}, "clumps"),
        ({"z_l": 0.0}, "z_l"),
        ({"field_arcmin": -8.0}, "field_arcmin"),
        ({"m_max_fraction": 1.5}, "m_max_fraction"),
        ({"m_min_msun_h": 1e14}, "m_min_msun_h"),
        ({"concentration_scatter": -0.1}, "concentration_scatter"),
        ({"bcg_axis_ratio": 0.0}, "bcg_axis_ratio"),
        ({"z_infall": 0.1}, "z_infall"),
        ({"hod": "wang2014"}, "hod"),
        ({"centre": "bcg"}, "centre"),
        ({"los_cut": "r200"}, "los_cut"),
        ({"concentration_relation": "duffy"}, "concentration_relation"),
        ({"pa_difference_deg": math.inf}, "pa_difference_deg"),
    ],
)
def test_settings_that_cannot_be_are_refused(bad: dict[str, Any], named: str):
    with pytest.raises(ValueError, match=f"`{named}` is"):
        ClusterSettings(**bad)


def test_a_clump_outside_the_field_is_refused():
    far = ClusterSettings(clumps=(Clump(6e14, x_kpc_h=-800.0), Clump(5e14, x_kpc_h=800.0)))
    with pytest.raises(ValueError, match=r"`clumps\[0\].x_kpc_h` puts the clump -800 kpc/h"):
        draw_cluster(jax.random.key(0), far)


def test_a_halo_lighter_than_what_it_holds_is_refused():
    with pytest.raises(ValueError, match=r"`clumps\[0\]` of 1.43e\+14 Msun"):
        draw_cluster(jax.random.key(0), ClusterSettings(clumps=(Clump(1e14, bcg_mass_msun=2e14),)))


def test_other_universes_and_options():
    plane = LensPlane.at(0.5)
    settings = ClusterSettings(z_l=0.5, hod="wang2013", satellite_scatter=True, z_infall=1.0)
    made = draw_cluster(jax.random.key(9), settings, plane.cosmology)
    assert float(made.plane.z_l) == 0.5
    assert np.isfinite(jax.tree.leaves(made.lens)[0]).all()
    plain = draw_cluster(jax.random.key(9), ClusterSettings(z_l=0.5, hod="wang2013"))
    ratio = made.subhaloes["stellar_mass_msun"] / plain.subhaloes["stellar_mass_msun"]
    # Stars of the mass at infall, with a scatter of 0.192 dex.
    assert np.median(ratio) > 1.0
    assert np.std(np.log10(ratio)) > 0.19
