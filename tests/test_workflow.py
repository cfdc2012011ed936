"""From a `strong.toml` and its catalogues to a problem: units, conventions, freedom, and what is refused."""

import csv
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxlens import datasets, io, lens, strong, workflow
from jaxlens.config import ConfigError
from jaxlens.cosmology import FlatLCDM, LensPlane

HEAD = 'name = "Test"\nz_l = 0.4\n[cosmology]\nh = 0.68\nomega_m = 0.31\n[images]\nsigma_arcsec = 0.5\n'
HALO = """[[component]]
name = "O1"
profile = "dpie"
sigma_v_km_s = { min = 300.0, max = 1500.0 }
r_core_arcsec = 5.0
r_cut_arcsec = 200.0
"""
PLANE = LensPlane.at(0.4, FlatLCDM(h=0.68, omega_m=0.31))
KPC = float(PLANE.kpc_per_arcsec)

IMAGES = """system,image_id,x_arcsec,y_arcsec,z_spec
1,1.1,-30.0,5.0,2.0
1,1.2,20.0,-10.0,2.0
b,b.1,-12.0,25.0,
b,b.2,8.0,-20.0,
"""
# Inside the rectangle, outside to the West, a BCG, outside to the North by 4 arcsec.
GALAXIES = """member_id,x_arcsec,y_arcsec,luminosity,a_arcsec,b_arcsec,theta_deg,bcg
g1,-10.0,12.0,1.5,2.0,1.2,30.0,0
g2,70.0,0.0,0.4,1.0,0.9,-20.0,0
g3,0.0,0.0,9.0,3.0,2.0,10.0,1
g4,5.0,29.0,0.7,1.0,1.0,0.0,0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "images.csv").write_text(IMAGES, encoding="utf-8")
    (tmp_path / "members.csv").write_text(GALAXIES, encoding="utf-8")
    return tmp_path


def load(folder: Path, text: str) -> workflow.Setup:
    (folder / "strong.toml").write_text(HEAD + text, encoding="utf-8")
    return workflow.load(str(folder))


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, text)
    message = str(caught.value)
    assert str(folder) in message, "the file is named"
    return message


def box(setup: workflow.Setup, name: str) -> strong.Box:
    bound = setup.problem.bounds[name]
    assert isinstance(bound, strong.Box)
    return bound


# --- which file -----------------------------------------------------------------------------------


def test_a_data_set_a_directory_and_a_file_are_found(folder: Path):
    shipped = datasets.path("as1063") / "strong.toml"
    assert workflow.find("as1063") == shipped
    assert workflow.find(str(shipped.parent)) == shipped
    other = folder / "variant.toml"
    shutil.copy(shipped, other)
    assert workflow.find(str(other)) == other


def test_a_directory_of_the_name_of_a_data_set_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "as1063").mkdir()
    shutil.copy(datasets.path("as1063") / "strong.toml", tmp_path / "as1063")
    monkeypatch.chdir(tmp_path)
    assert workflow.find("as1063") == Path("as1063/strong.toml")


@pytest.mark.parametrize("empty_directory", [False, True])
def test_anything_else_lists_the_data_sets(tmp_path: Path, empty_directory: bool):
    name = str(tmp_path) if empty_directory else "as1036"
    with pytest.raises(ConfigError) as caught:
        workflow.find(name)
    message = str(caught.value)
    assert name in message and "strong.toml" in message
    assert ", ".join(datasets.names("strong")) in message


def test_a_data_set_without_images_is_refused():
    with pytest.raises(
        ConfigError, match=r"data set cosmos \(COSMOS.* has no strong\.toml; it holds weak\.toml"
    ) as caught:
        workflow.find("cosmos")
    assert "as1063" in str(caught.value)


def test_catalogues_lie_beside_the_configuration(folder: Path):
    (folder / "deep").mkdir()
    (folder / "images.csv").rename(folder / "deep" / "arcs.csv")
    setup = load(folder, 'file = "deep/arcs.csv"\n' + HALO)
    assert setup.problem.images.n_images == 4


# --- units ----------------------------------------------------------------------------------------


def test_kpc_and_msun_h_are_converted_in_everything_a_number_says(folder: Path):
    setup = load(
        folder,
        """[[component]]
name = "bcg"
profile = "hernquist"
mass_msun_h = { min = 1e11, max = 1e13, log = true, start = 2e12, mean = 1e12, sigma = 3e11 }
r_s_kpc = 20.0
x_kpc = { min = -10.0, max = 10.0, start = 4.0, mean = 1.0, sigma = 2.0 }
y_arcsec = 0.5
""",
    )
    mass, x = box(setup, "bcg.mass_msun"), box(setup, "bcg.x_arcsec")
    assert mass.log and not x.log
    # rtol 1e-14: one multiplication by the factor.
    assert_allclose([mass.lo, mass.hi], [1e11 / 0.68, 1e13 / 0.68], rtol=1e-14)
    assert_allclose([x.lo, x.hi], [-10.0 / KPC, 10.0 / KPC], rtol=1e-14)
    assert setup.start is not None
    assert_allclose(setup.start["bcg.mass_msun"], 2e12 / 0.68, rtol=1e-14)
    assert_allclose(setup.start["bcg.x_arcsec"], 4.0 / KPC, rtol=1e-14)
    priors = {one.name: one for one in setup.problem.priors if isinstance(one, strong.NormalPrior)}
    assert_allclose(priors["bcg.mass_msun"].mean, 1e12 / 0.68, rtol=1e-14)
    assert_allclose(priors["bcg.mass_msun"].sigma, 3e11 / 0.68, rtol=1e-14)
    assert_allclose(priors["bcg.x_arcsec"].mean, 1.0 / KPC, rtol=1e-14)
    assert_allclose(priors["bcg.x_arcsec"].sigma, 2.0 / KPC, rtol=1e-14)
    fixed = setup.model.ingredients[0].fixed
    assert sorted(fixed) == ["r_s_arcsec", "y_arcsec"]
    assert_allclose(fixed["r_s_arcsec"], 20.0 / KPC, rtol=1e-14)
    assert float(fixed["y_arcsec"]) == 0.5
    # 4 kpc from a mean of 1 +- 2 kpc are 1.5 sigma, in any unit.
    assert_allclose(priors["bcg.x_arcsec"](setup.start), 1.5, rtol=1e-12)


def test_a_log_normal_prior_keeps_its_spread_in_any_unit(folder: Path):
    setup = load(
        folder,
        HALO
        + "[members]\nsigma_ref_km_s = 150.0\n"
        + 'r_cut_ref_kpc = { min = 5.0, max = 100.0, prior = "log_normal", median = 40.0, sigma_ln = 0.3 }\n',
    )
    (prior,) = setup.problem.priors
    assert isinstance(prior, strong.LogNormalPrior)
    assert prior.name == "members.r_cut_ref_arcsec"
    assert_allclose([prior.median, prior.sigma_ln], [40.0 / KPC, 0.3], rtol=1e-14)
    # 80 kpc are ln 2 from the median.
    row = prior({"members.r_cut_ref_arcsec": jnp.asarray(80.0 / KPC)})
    assert_allclose(row, np.log(2.0) / 0.3, rtol=1e-12)


def test_member_lengths_in_kpc(folder: Path):
    setup = load(
        folder,
        HALO
        + """[members]
sigma_ref_km_s = 150.0
r_cut_ref_kpc = { min = 5.0, max = 100.0, start = 40.0 }
r_core_ref_kpc = 0.15
""",
    )
    cut = box(setup, "members.r_cut_ref_arcsec")
    assert_allclose([cut.lo, cut.hi], [5.0 / KPC, 100.0 / KPC], rtol=1e-14)
    assert setup.start is not None
    assert_allclose(setup.start["members.r_cut_ref_arcsec"], 40.0 / KPC, rtol=1e-14)
    assert setup.model.members is not None
    fixed = setup.model.members.fixed
    assert float(fixed["sigma_ref_km_s"]) == 150.0
    assert_allclose(fixed["r_core_ref_arcsec"], 0.15 / KPC, rtol=1e-14)


def test_the_middle_of_the_other_boxes_completes_a_start(folder: Path):
    setup = load(folder, HALO + "x_arcsec = { min = -2.0, max = 4.0, start = 3.0 }\n")
    assert setup.start is not None
    assert set(setup.start) == set(setup.problem.bounds)
    assert float(setup.start["O1.x_arcsec"]) == 3.0
    assert_allclose(setup.start["O1.sigma_v_km_s"], 900.0, rtol=1e-14)
    assert load(folder, HALO).start is None


def test_position_angles_are_degrees_in_the_file(folder: Path):
    setup = load(folder, HALO + "e = 0.3\npa_deg = -35.0\n")
    assert_allclose(setup.model.ingredients[0].fixed["pa"], np.deg2rad(-35.0), rtol=1e-15)
    setup = load(folder, HALO + 'e = 0.3\npa_deg = "free"\n')
    assert isinstance(setup.problem.bounds["O1.pa"], strong.Angle)


def test_a_free_shape_starts_where_the_file_says(folder: Path):
    setup = load(folder, HALO + "shape = { max = 0.8, start = [0.4, 60.0] }\n")
    bound = setup.problem.bounds["O1.shape"]
    assert isinstance(bound, strong.Disc)
    assert float(bound.limit) == 0.8
    assert setup.start is not None
    said = strong.reported(setup.model, setup.start)
    assert_allclose([said["O1.e"], said["O1.pa_deg"]], [0.4, 60.0], rtol=1e-12)


# --- mistakes -------------------------------------------------------------------------------------

OTHER = '[[component]]\nname = "O2"\nprofile = "{}"\n'
WRONG = {
    "unknown number": (
        HALO + "r_s_arcsec = 3.0\n",
        "O1",
        "r_s_arcsec is not a number",
        "sigma_v_km_s, r_core",
    ),
    "missing number": (
        HALO + OTHER.format("nfw") + "concentration = 5.0\n",
        "O2",
        "mass_vir_msun missing",
        "box",
    ),
    "unknown profile": (HALO + OTHER.format("king"), "O2", "'king'", "choose one of dpie, dpie_lenstool,"),
    "shape twice": (HALO + "e = 0.2\nshape = { max = 0.8 }\n", "O1", "shape =", "leave out e and pa_deg"),
    "shape and angle": (
        HALO + "pa_deg = 3.0\nshape = { max = 0.8 }\n",
        "O1",
        "shape =",
        "leave out e and pa_deg",
    ),
    "shape of a round one": (
        HALO + OTHER.format("point") + "mass_msun = 1e12\nshape = { max = 0.8 }\n",
        "O2",
        "shape =",
        "this profile is round",
    ),
    "free angle alone": (HALO + 'pa_deg = "free"\n', "O1", "no elongation", "give e"),
    "free angle of a round one": (
        HALO + OTHER.format("point") + 'mass_msun = 1e12\npa_deg = "free"\n',
        "O2",
        "no elongation",
        "leave out pa_deg",
    ),
    "elongation without angle": (HALO + "e = 0.2\n", "O1", "e is given without pa_deg", 'or "free"'),
    "a box that is none": (HALO + "x_arcsec = { min = 3.0 }\n", "O1.x_arcsec", "max: is missing", "add it"),
    "a number twice": (
        HALO + "r_core_kpc = 20.0\n",
        "O1",
        "r_core_kpc and r_core_arcsec are the same",
        "leave out one",
    ),
    "nothing free": (
        OTHER.format("sheet") + "kappa = 0.1\n",
        "",
        "no number is free",
        "min = ..., max = ...",
    ),
}


@pytest.mark.parametrize(("text", "owner", "value", "remedy"), WRONG.values(), ids=list(WRONG))
def test_a_wrong_component_is_named_with_the_remedy(
    folder: Path, text: str, owner: str, value: str, remedy: str
):
    if text.startswith('[[component]]\nname = "O2"\nprofile = "sheet"'):
        (folder / "images.csv").write_text("".join(IMAGES.splitlines(keepends=True)[:3]), encoding="utf-8")
    message = refusal(folder, text)
    assert owner in message and value in message and remedy in message, message


def test_an_empty_model_is_refused(folder: Path):
    assert "add a [[component]] or [members]" in refusal(folder, "")  # b's redshift alone is free


def test_a_mistake_in_a_catalogue_names_its_line(folder: Path):
    (folder / "images.csv").write_text(IMAGES.replace("25.0", "north"), encoding="utf-8")
    with pytest.raises(ValueError, match=r"images\.csv, line 4.*`y_arcsec`.*'north'"):
        load(folder, HALO)


# --- members --------------------------------------------------------------------------------------


def members(folder: Path, more: str = "") -> strong.MemberSet:
    found = load(
        folder, HALO + "[members]\nsigma_ref_km_s = 150.0\nr_cut_ref_arcsec = 8.0\n" + more
    ).model.members
    assert found is not None
    return found


def test_brightest_galaxies_are_left_out(folder: Path):
    found = members(folder)
    assert_array_equal(found.luminosity, [1.5, 0.4, 0.7])
    assert_array_equal(found.theta, [[-10.0, 12.0], [70.0, 0.0], [5.0, 29.0]])


@pytest.mark.parametrize(("margin", "kept"), [(3.9, [1.5]), (4.1, [1.5, 0.7]), (50.0, [1.5, 0.4, 0.7])])
def test_only_members_near_the_images(folder: Path, margin: float, kept: list[float]):
    assert_array_equal(members(folder, f"within_images_arcsec = {margin}\n").luminosity, kept)


def test_no_member_near_the_images(folder: Path):
    (folder / "members.csv").write_text("\n".join(GALAXIES.splitlines()[i] for i in (0, 2)), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"members\.csv: no member is left inside the rectangle"):
        members(folder, "within_images_arcsec = 1.0\n")


@pytest.mark.parametrize("convention", ["dpie", "dpie_lenstool"])
def test_shapes_of_the_light_in_the_definition_of_the_convention(folder: Path, convention: str):
    found = members(folder, f'convention = "{convention}"\n')
    a, b = np.array([2.0, 1.0, 1.0]), np.array([1.2, 0.9, 1.0])
    expected = (a**2 - b**2) / (a**2 + b**2) if convention == "dpie_lenstool" else 1.0 - b / a
    assert_allclose(found.e, expected, rtol=1e-14, atol=1e-16)
    assert_allclose(found.pa, np.deg2rad([30.0, -20.0, 0.0]), rtol=1e-15)
    assert found.convention == convention


def test_round_members(folder: Path):
    assert_array_equal(members(folder, 'shape = "round"\n').e, [0.0, 0.0, 0.0])


# --- redshifts ------------------------------------------------------------------------------------


def test_redshifts_that_are_not_known_are_free(folder: Path):
    setup = load(folder, "z_max = 7.0\n" + HALO)
    assert sorted(setup.problem.bounds) == ["O1.sigma_v_km_s", "dls_ds.b"]
    free = box(setup, "dls_ds.b")
    assert not free.weak
    assert_allclose([free.lo, free.hi], [PLANE.dls_ds(0.5), PLANE.dls_ds(7.0)], rtol=1e-14)
    inside = {"O1.sigma_v_km_s": jnp.asarray(900.0), "dls_ds.b": PLANE.dls_ds(3.0)}
    assert_allclose(setup.model(inside).dls_ds, [PLANE.dls_ds(2.0), PLANE.dls_ds(3.0)], rtol=1e-14)
    assert_allclose(strong.reported(setup.model, inside)["z.b"], 3.0, rtol=1e-9)


def test_free_redshifts_begin_where_the_file_says(folder: Path):
    free = box(load(folder, "z_min = 1.1\n" + HALO), "dls_ds.b")
    assert_allclose([free.lo, free.hi], [PLANE.dls_ds(1.1), PLANE.dls_ds(10.0)], rtol=1e-14)
    message = refusal(folder, "z_min = 0.4\n" + HALO)
    assert "images.z_min = 0.4 is not behind the lens (z_l = 0.4)" in message and "raise it" in message


# --- groups ---------------------------------------------------------------------------------------

GROUP = """[[group]]
name = "outer"
file = "members.csv"
sigma_ref_km_s = { min = 20.0, max = 900.0 }
r_cut_ref_arcsec = 300.0
"""


def test_a_free_redshift_has_a_prior_and_limits_of_its_own(folder: Path):
    text = 'z_min = 0.8\n[[redshift]]\nsystem = "b"\nmax = 4.0\nmean = 2.5\nsigma = 0.3\nstart = 2.0\n' + HALO
    setup = load(folder, text)
    (prior,) = setup.problem.priors
    box, start = setup.problem.bounds["dls_ds.b"], setup.start
    assert isinstance(prior, strong.RedshiftPrior) and isinstance(box, strong.Box) and start is not None
    assert not box.weak
    assert_allclose((box.lo, box.hi), PLANE.dls_ds(jnp.array([0.8, 4.0])), rtol=1e-12)
    assert_allclose(start["dls_ds.b"], PLANE.dls_ds(2.0), rtol=1e-12)
    assert_allclose(prior({"dls_ds.b": PLANE.dls_ds(3.1)}), (3.1 - 2.5) / 0.3, rtol=1e-9)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ('system = "9"', "redshift of system 9: there is no such system; the catalogue has 1, b"),
        ('system = "1"', "redshift of system 1: the catalogue gives it"),
        ('system = "b"\nmean = 2.0', "a normal prior needs both mean and sigma"),
        ('system = "b"\nmean = 20.0\nsigma = 0.1', "mean = 20 is outside 0.5 to 10"),
        ('system = "b"\nmin = 0.2', "from 0.2 to 10 is no range behind the lens"),
        ('system = "b"\nmin = 3.0\nmax = 2.0', "min = 3.0 is not below max = 2.0"),
        ('system = "b"\nsigma_z = 0.1', "sigma_z: is not known"),
        ('system = "b"\n[[redshift]]\nsystem = "b"', "two [[redshift]] of system b"),
    ],
)
def test_a_wrong_redshift_is_named_with_the_remedy(folder: Path, said: str, expected: str):
    assert expected in refusal(folder, f"[[redshift]]\n{said}\n{HALO}")


def test_a_group_has_relations_of_its_own(folder: Path):
    text = HALO + "[members]\nsigma_ref_km_s = 150.0\nr_cut_ref_arcsec = 10.0\n" + GROUP
    setup = load(folder, text)
    assert {"O1.sigma_v_km_s", "outer.sigma_ref_km_s"} <= set(setup.problem.bounds)
    params = {"O1.sigma_v_km_s": jnp.asarray(900.0), "outer.sigma_ref_km_s": jnp.asarray(300.0)}
    components = setup.model.lens(params).components
    luminosity = np.array([1.5, 0.4, 0.7])
    assert_allclose(components["outer"].params.r_cut, 300.0 * luminosity**0.5, rtol=1e-14)
    assert_allclose(components["members"].params.r_cut, 10.0 * luminosity**0.5, rtol=1e-14)
    assert_allclose(components["outer"].params.b, 4.0 * components["members"].params.b, rtol=1e-14)


def test_a_group_with_a_name_that_is_taken_is_refused(folder: Path):
    assert "a group may not be called 'dpie', which is a profile" in refusal(
        folder, HALO + GROUP.replace("outer", "dpie")
    )
    assert "component names must be unique; used twice: O1" in refusal(
        folder, HALO + GROUP.replace("outer", "O1")
    )


def test_systems_can_be_left_out(folder: Path):
    setup = load(folder, 'exclude = ["b"]\n' + HALO)
    assert setup.problem.images.systems == ("1",)
    assert list(setup.problem.bounds) == ["O1.sigma_v_km_s"]


# --- Abell S1063 ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def as1063() -> workflow.Setup:
    return workflow.load("as1063")


def test_the_freedom_of_the_published_model(as1063: workflow.Setup):
    assert strong.total_size(as1063.problem.bounds) == 11
    assert (as1063.problem.images.n_images, as1063.problem.images.n_systems) == (50, 19)
    assert as1063.start is None, "nothing of the published model is a start"
    assert as1063.model.members is not None
    assert as1063.model.members.theta.shape == (260, 2)


def published(setup: workflow.Setup) -> dict[str, jax.Array]:
    """The free numbers of the model at the published values, from the published table of potentials."""
    with (datasets.path("as1063") / "reference_halos.csv").open(newline="", encoding="utf-8") as file:
        rows = {row["halo_id"]: row for row in csv.DictReader(file)}
    magnitude = setup.config.members.mag_ref if setup.config and setup.config.members else None
    assert magnitude is not None
    number = lambda name, key: float(rows[name][key])
    galaxy = next(row for name, row in rows.items() if not name.startswith("O"))
    light = 10.0 ** (-0.4 * (float(galaxy["mag"]) - magnitude))

    def shape(e: float, angle: float) -> jax.Array:
        return e * jnp.array([np.cos(2 * np.deg2rad(angle)), np.sin(2 * np.deg2rad(angle))])

    values = {
        "O1.shape": shape(number("O1", "ellipticity"), number("O1", "angle_deg")),
        "O1.r_core_arcsec": number("O1", "core_radius_arcsec"),
        "O1.sigma_lt_km_s": number("O1", "v_disp_kms"),
        "O2.shape": shape(number("O2", "gamma"), number("O2", "angle_deg")),
        "O3.sigma_lt_km_s": number("O3", "v_disp_kms"),
        "O4.x_arcsec": number("O4", "x_arcsec"),
        "O4.y_arcsec": number("O4", "y_arcsec"),
        "O4.sigma_lt_km_s": number("O4", "v_disp_kms"),
        "members.sigma_ref_km_s": float(galaxy["v_disp_kms"]) / light**0.25,
    }
    return {name: jnp.asarray(value) for name, value in values.items()}


def test_the_published_numbers_give_the_published_deflection(as1063: workflow.Setup):
    params = published(as1063)
    assert set(params) == set(as1063.problem.bounds)
    theta = as1063.problem.images.theta
    ours = lens.alpha(as1063.model.lens(params), theta)
    theirs = lens.alpha(datasets.reference_lens("as1063"), theta)
    # 1e-4 arcsec: cosmology and light of the table are rounded to 1e-6; one image in a hundred of its error.
    assert_allclose(ours, theirs, rtol=0.0, atol=1e-4)


def test_the_published_numbers_lie_well_inside_the_boxes(as1063: workflow.Setup):
    u = strong.unbounded(as1063.problem.bounds, published(as1063))
    assert strong.at_bound(as1063.problem.bounds, u) == []


def test_images_keep_the_positions_of_the_published_model(as1063: workflow.Setup):
    said = io.read_images(datasets.path("as1063") / "images.csv")
    assert_array_equal(as1063.problem.images.theta, said.theta)
