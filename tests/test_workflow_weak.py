"""From a `weak.toml` to galaxies and maps, and what the shipped fields show."""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlens import config_weak, datasets, io, weak, workflow_weak
from jaxlens._config import ConfigError

CONFIG = """\
name = "test"
z_l = 0.3

[depth]
z_s = 1.5
"""

SHEAR = """\
x_arcsec,y_arcsec,g1,g2,mag,z_phot,member,use
10.0,20.0,0.1,-0.2,0.1,0.9,0,1
-30.0,45.0,0.3,0.05,0.2,,0,1
50.0,-60.0,0.2,0.1,0.1,0.4,0,1
20.0,0.0,0.2,0.1,0.1,1.0,1,1
20.0,10.0,,,0.1,1.0,0,0
20.0,30.0,1.1,1.1,0.1,1.0,0,1
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "weak.toml").write_text(CONFIG, encoding="utf-8")
    (tmp_path / "shear.csv").write_text(SHEAR, encoding="utf-8")
    return tmp_path


def rewrite(folder: Path, name: str, old: str, new: str) -> None:
    path = folder / name
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


# --- the configuration ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", datasets.names("weak"))
def test_every_shipped_configuration_is_read(name: str):
    said = config_weak.read(datasets.path(name) / "weak.toml")
    assert said.reference is not None and said.depth.z_s is not None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("z_l = 0.3\n", "", "weak.toml: z_l: is missing; add it"),
        ("z_s = 1.5", "z_s = 0.2", r"depth.z_s = 0.2 is not behind the lens, z_l = 0.3; correct one"),
        ("z_s = 1.5", "", "weak.toml: depth: give exactly one of z_s and dls_ds"),
        ("z_s = 1.5", "z_s = 1.5\ndls_ds = 0.7", "depth: give exactly one of z_s and dls_ds"),
        ("z_s = 1.5", "z_s = 1.5\nzs = 1", "depth.zs: is not known; remove it, or use one of z_s, dls_ds"),
        ("z_s = 1.5", "z_s = 1.5\n[map]\npixel_arcsec = -1", r"map.pixel_arcsec: .*greater than 0.*-1"),
        ("z_s = 1.5", "z_s = 1.5\n[shear]\naxis = 'up'", r"shear.axis: .*'west', 'east' or 'north'.*'up'"),
        ("z_s = 1.5", "z_s = 1.5\n[profile]\nedges_arcsec = [30, 20]", "do not increase; sort them"),
        ("z_s = 1.5", "z_s = 1.5\n[profile]\nlog_c = 0.6", "needs both log_c and log_c_sigma"),
        ("z_l = 0.3\n", "z_l = 0.3\nra_deg = 1.0\n", "give both ra_deg and dec_deg, or neither"),
        ("[depth]", "[depth", "is not valid TOML"),
    ],
)
def test_a_mistake_in_the_configuration_is_explained(folder: Path, old: str, new: str, message: str):
    rewrite(folder, "weak.toml", old, new)
    with pytest.raises(ConfigError, match=message):
        workflow_weak.load(str(folder))


# --- the problem ---------------------------------------------------------------------------------


def test_the_selection_is_counted_step_by_step(folder: Path):
    setup = workflow_weak.load(str(folder))
    assert list(setup.counts.values()) == [6, 5, 4, 3, 2]
    np.testing.assert_array_equal(np.asarray(setup.galaxies.weight) > 0, [True, True] + 4 * [False])
    assert int(setup.shear.n_gal.sum()) == 2
    assert setup.smoothing_pixels == 2.0
    np.testing.assert_allclose(setup.galaxies.dls_ds, setup.plane.dls_ds(1.5))


def test_redshifts_of_their_own_weights_and_options(folder: Path):
    rewrite(folder, "weak.toml", "z_s = 1.5", "z_s = 1.5\nper_galaxy = true\n[shear]\nsigma_eps = 0.3")
    rewrite(folder, "shear.csv", "mag", "sigma")
    with open(folder / "weak.toml", "a", encoding="utf-8") as file:
        file.write("[select]\nuse = false\nmembers = true\nmax_g = 10.0\n[map]\nside_arcsec = 200.0\n")
    setup = workflow_weak.load(str(folder / "weak.toml"))
    assert list(setup.counts.values()) == [6, 6, 6, 5, 4]
    np.testing.assert_allclose(setup.galaxies.weight[:2], [1.0 / (0.09 + 0.01), 1.0 / (0.09 + 0.04)])
    np.testing.assert_allclose(
        setup.galaxies.dls_ds[:2], setup.plane.dls_ds(jnp.array([0.9, 1.5])), rtol=1e-12
    )
    assert float(setup.depth.factor) > 1.0
    assert setup.grid.shape == (14, 14) and setup.grid.centre == (0.0, 0.0)


@pytest.mark.parametrize(
    ("said", "header", "message"),
    [
        ("sigma_eps = 0.26", "weight", "has a column weight, which says it already; drop one of the two"),
        (
            "",
            "sigma",
            "has a column sigma, which gives no weight without the intrinsic scatter; set sigma_eps",
        ),
        (
            "sigma_eps = 0.26",
            "mag",
            "needs a column sigma, which shear.csv lacks; add it, or remove sigma_eps",
        ),
    ],
)
def test_a_galaxy_has_one_weight(folder: Path, said: str, header: str, message: str):
    rewrite(folder, "weak.toml", "z_s = 1.5", f"z_s = 1.5\n[shear]\n{said}")
    text = SHEAR.replace("mag", header)
    if header == "weight":
        text = f"{SHEAR.splitlines()[0]}\n".replace("mag", "sigma,weight") + "10,20,0.1,-0.2,0.1,1,0.9,0,1\n"
    (folder / "shear.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        workflow_weak.load(str(folder))


def test_the_grid_holds_every_selected_galaxy_and_can_be_padded(folder: Path):
    rewrite(folder, "weak.toml", "z_s = 1.5", "z_s = 1.5\n[select]\nz_margin = 0.05")
    setup = workflow_weak.load(str(folder))
    assert int(setup.shear.n_gal.sum()) == setup.counts["measured, |g| below the limit"] == 3
    assert setup.grid.shape[0] % 2 == 0


def test_an_empty_selection_is_refused_with_its_counts(folder: Path):
    rewrite(folder, "weak.toml", "z_s = 1.5", "z_s = 1.5\n[select]\nmax_g = 0.01")
    with pytest.raises(ConfigError, match=r"leaves no galaxy of shear\.csv \(all: 6, use: 5, .*: 0\); widen"):
        workflow_weak.load(str(folder))
    rewrite(folder, "weak.toml", "max_g = 0.01", "")
    rewrite(folder, "shear.csv", "mag", "weight")
    text = (folder / "shear.csv").read_text(encoding="utf-8").replace(",0.1,0.9,", ",0,0.9,")
    (folder / "shear.csv").write_text(text.replace(",0.2,,", ",0,,"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"every selected galaxy of shear\.csv has weight 0"):
        workflow_weak.load(str(folder))


def test_what_is_no_field_lists_the_fields(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"nor a directory holding weak\.toml.*abell2744, as1063, cosmos"):
        workflow_weak.load(str(tmp_path))


def test_a_copied_field_is_the_same(tmp_path: Path):
    shutil.copytree(datasets.path("cosmos"), tmp_path / "field")
    ours, theirs = (workflow_weak.load(name) for name in (str(tmp_path / "field"), "cosmos"))
    np.testing.assert_array_equal(ours.shear.g, theirs.shear.g)


# --- the shipped fields --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fields() -> dict[str, workflow_weak.WeakSetup]:
    return {name: workflow_weak.load(name) for name in datasets.names("weak")}


@pytest.mark.parametrize(
    ("name", "rows", "use", "background", "used"),
    [
        ("as1063", 4049, 2982, 2192, 2134),
        ("abell2744", 3712, 2669, 1975, 1886),
        ("cosmos", 11187, 11187, 11187, 11187),
    ],
)
def test_selected_galaxies_are_those_of_the_readme(
    fields, name: str, rows: int, use: int, background: int, used: int
):
    counts = fields[name].counts
    assert (counts["all"], counts["use"], counts["not in front"]) == (rows, use, background)
    assert counts["measured, |g| below the limit"] == used == int(fields[name].shear.n_gal.sum())
    readme = (Path(datasets.__file__).parent / "README.md").read_text(encoding="utf-8")
    section = readme.split(f"## {name}:")[1].split("\n## ")[0]
    assert all(str(number) in section for number in (rows, use, background, used) if number != 11187)


@pytest.mark.parametrize("name", ["as1063", "abell2744"])
def test_x_and_y_of_the_shapes_are_those_of_their_ra_and_dec(fields, name: str):
    setup = fields[name]
    rows = setup.table.rows
    theta = io.offsets(rows["ra_deg"], rows["dec_deg"], setup.config.reference)
    # Linear in RA instead of gnomonic, and rounded to 0.01 arcsec: measured up to 0.08 arcsec.
    assert np.abs(theta - setup.table.theta).max() < 0.1


@pytest.mark.parametrize(
    ("name", "signal", "inner"),
    [("as1063", 10.54, 0.190), ("abell2744", 9.38, 0.262)],
)
def test_clusters_shear_tangentially_and_not_across(fields, name: str, signal: float, inner: float):
    setup = fields[name]
    found = weak.significance(setup.galaxies, 30.0, 140.0, setup.centre)
    assert float(found.tangential) == pytest.approx(signal, abs=0.01)  # pinned: the data do not change
    assert abs(float(found.cross)) < 2.0
    profile = weak.tangential_profile(setup.galaxies, setup.edges, setup.centre)
    assert (np.asarray(profile.g_t) > 2.5 * np.asarray(profile.sigma_t)).all()
    assert float(profile.g_t[0]) == pytest.approx(inner, abs=1e-3)
    # Four bins without cross shear: chance of a larger chi^2 not below 1 in 100.
    chi2 = float(np.sum((np.asarray(profile.g_x) / np.asarray(profile.sigma_x)) ** 2))
    assert stats.chi2.sf(chi2, 4) > 0.01
    fit = setup.fit_halo(profile)
    assert bool(fit.converged)
    # A massive cluster once its shapes are calibrated to the strong-lensing model.
    assert 7e14 < float(fit.mass) < 4e15


def test_without_the_cut_in_shear_the_significance_is_that_of_the_source(fields):
    """11.4 for as1063 and 10.6 for abell2744, as quoted with the tables."""
    for name, expected in (("as1063", 11.4), ("abell2744", 10.6)):
        setup = fields[name]
        use = weak.background(
            setup.table.eps, setup.table.z, member=setup.table.member, z_min=setup.config.z_l + 0.15
        )
        galaxies = weak.Galaxies(setup.table.theta, setup.table.eps, np.asarray(use) & setup.table.use)
        found = weak.significance(galaxies, 30.0, 140.0, (0.0, 0.0))
        assert float(found.tangential) == pytest.approx(expected, abs=0.05), name


def test_the_wrong_handedness_loses_the_cluster(fields):
    """A frame towards East mistaken for one towards West turns the signal into noise."""
    galaxies = fields["as1063"].galaxies
    wrong = weak.Galaxies(galaxies.theta, jnp.conj(galaxies.eps), galaxies.weight)
    assert abs(float(weak.significance(wrong, 30.0, 140.0, (0.0, 0.0)).tangential)) < 5.0


def test_groups_of_cosmos_are_seen_in_the_stack(fields):
    setup = fields["cosmos"]
    groups = io.read_places(
        datasets.path("cosmos") / "xray_groups.csv", setup.config.reference, name="xray_id"
    )
    assert groups.ids == ("57", "59", "67", "70")
    profile = weak.stack(setup.galaxies, jnp.array([18.0, 60.0, 180.0]), jnp.asarray(groups.theta))
    inner, outer = np.asarray(profile.g_t / profile.sigma_t)
    assert inner == pytest.approx(3.04, abs=0.02)
    assert outer > 2.0
    assert np.abs(np.asarray(profile.g_x / profile.sigma_x)).max() < 2.5
    centre = weak.significance(setup.galaxies, 18.0, 180.0, setup.centre)
    assert float(centre.tangential) == pytest.approx(3.2, abs=0.1)


def test_aperture_mass_finds_the_clusters_at_their_brightest_galaxy(fields):
    for name, least in (("as1063", 8.0), ("abell2744", 8.0)):
        setup = fields[name]
        found = weak.aperture_map(setup.galaxies, setup.grid, 100.0)
        place, value, _ = weak.peak(found.snr, setup.grid)
        assert float(value) > least
        assert float(jnp.hypot(*place)) < 30.0  # two pixels
        assert float(jnp.abs(found.cross / jnp.where(found.noise > 0, found.noise, jnp.inf)).max()) < 5.0


def test_scrambled_galaxies_show_no_cluster(fields):
    setup = fields["as1063"]
    keys = jax.random.split(jax.random.key(0), 50)

    def signal(key: jax.Array) -> jax.Array:
        scrambled = weak.scramble(key, setup.galaxies)
        return weak.significance(scrambled, 30.0, 140.0, (0.0, 0.0)).tangential

    snr = np.asarray(jax.vmap(signal)(keys))
    # 50 draws of a unit normal: mean 0 +- 0.14, standard deviation 1 +- 0.1.
    assert abs(snr.mean()) < 0.6 and abs(snr.std() - 1.0) < 0.4
