"""The data that ships with the package: there, documented, and the published model it claims to be."""

import csv
import functools
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import table

from jaxlens import datasets, glafic, io, lens, lenstool, strong, workflow
from jaxlens.config import ConfigError
from jaxlens.cosmology import LensPlane


def test_names_and_directories_agree():
    shipped = {item.name for item in Path(datasets.__file__).parent.iterdir() if item.is_dir()}
    assert datasets.names() == sorted(shipped - {"__pycache__"})


@pytest.mark.parametrize("name", datasets.names())
def test_every_file_has_an_origin_and_a_licence(name: str):
    readme = (Path(datasets.__file__).parent / "README.md").read_text(encoding="utf-8")
    section = readme.split(f"## {name}:")[1].split("\n## ")[0]
    entries = {
        line.split("|")[1].strip(): line.split("|")[2:-1]
        for line in section.splitlines()
        if line.count("|") > 5
    }
    for file in datasets.path(name).iterdir():
        cells = entries[f"`{file.name}`"]
        assert all(cell.strip() for cell in cells), file.name
        if file.suffix == ".csv":
            with file.open(newline="", encoding="utf-8") as handle:
                assert len(list(csv.DictReader(handle))) == int(cells[0]), file.name


def test_a_data_set_says_what_it_holds():
    assert datasets.holds("as1063") == ("strong", "weak")
    assert datasets.holds("cosmos") == ("weak",)
    assert datasets.names("weak") == ["abell2744", "as1063", "cosmos"]
    assert "as1063" in datasets.names("strong")
    assert "cosmos" not in datasets.names("strong")
    with pytest.raises(ValueError, match="`kind` is 'wake'; choose one of strong, weak"):
        datasets.names("wake")


@pytest.mark.parametrize("function", [datasets.path, datasets.citation, datasets.licence, datasets.title])
def test_an_unknown_name_lists_the_known_ones(function):
    with pytest.raises(
        ValueError, match=rf"no data set 'as1036'; the package ships {', '.join(datasets.names())}"
    ):
        function("as1036")


def test_citation_and_licence():
    text = datasets.citation("as1063")
    assert "Abell S1063" in text
    assert "Richard et al. 2014, MNRAS 444, 268" in text
    assert "facts" in datasets.licence("as1063")


def test_images_of_as1063_are_the_published_gold_set():
    images = io.read_images(datasets.path("as1063") / "images.csv", z_l=0.3475)
    assert images.theta.shape == (50, 2)
    assert len(images.systems) == 19
    assert np.isfinite(images.z_s).all()
    np.testing.assert_array_equal(images.sigma_pos, 0.5)
    numbers = datasets.reference_numbers("as1063")
    assert (numbers["n_images"], numbers["n_systems"]) == (50, 19)


def test_x_and_y_of_as1063_are_those_of_its_ra_and_dec():
    rows = io.read_table(
        datasets.path("as1063") / "images.csv", ("x_arcsec", "y_arcsec", "ra_deg", "dec_deg")
    )
    theta = io.offsets(rows["ra_deg"], rows["dec_deg"], (342.18322, -44.530889))
    given = np.stack([rows["x_arcsec"], rows["y_arcsec"]], axis=1)
    # Measured 0.0139 arcsec: the published frame is linear in RA, not gnomonic.
    assert 0.005 < np.abs(theta - given).max() < 0.02


def test_members_of_as1063_are_as_elliptical_as_their_mass():
    folder = datasets.path("as1063")
    members = io.read_members(folder / "members.csv", mag_ref=datasets.reference_numbers("as1063")["mag_ref"])
    published = datasets.reference_lens("as1063").components["members"]
    assert len(members.ids) == len(published) == 260
    np.testing.assert_allclose(members.theta, published.centre, atol=6e-5)  # given to four and six digits
    np.testing.assert_allclose(members.pa, published.pa, atol=1e-12)
    np.testing.assert_allclose(members.e, published.params.e, atol=2e-5)  # ellipticity has six digits
    q = 1.0 - members.e
    f = 2.0 * np.sqrt(q) / (1.0 + q)
    cut = datasets.reference_numbers("as1063")["r_cut_ref"] * members.luminosity**0.5
    np.testing.assert_allclose(published.params.r_cut, f * cut, rtol=2e-5)


def test_reference_lens_gives_the_published_field():
    published = datasets.reference_lens("as1063")
    assert {name: len(one) for name, one in published.components.items()} == {
        "halo": 3,
        "shear": 1,
        "members": 260,
    }
    points = table("clusters/as1063_check_points.csv")
    theta = jnp.stack([points["x_arcsec"], points["y_arcsec"]], axis=-1)
    ratio = LensPlane.at(0.3475).dls_ds(jnp.asarray(points["z_s"]))
    alpha, hessian = jax.jit(lens.alpha_and_hessian)(published, theta)
    xx, xy, yy = hessian[:, 0, 0], hessian[:, 0, 1], hessian[:, 1, 1]
    expected = np.stack([points["alpha_x_arcsec"], points["alpha_y_arcsec"]], axis=-1)
    np.testing.assert_allclose(ratio[:, None] * alpha, expected, atol=2e-3)  # arcsec
    np.testing.assert_allclose(ratio * 0.5 * (xx + yy), points["kappa"], atol=1e-5)
    np.testing.assert_allclose(ratio * 0.5 * (xx - yy), points["gamma1"], atol=1e-5)
    np.testing.assert_allclose(ratio * xy, points["gamma2"], atol=1e-5)


problem = functools.cache(workflow.load)


# Images, systems, those without a redshift, haloes, scaled galaxies, free numbers of both models.
CLUSTERS = {
    "abell2744": (83, 29, 0, 6, 252, 21, 24),
    "as1063": (50, 19, 0, 3, 260, 11, 18),
    "macs1149": (152, 47, 15, 7, 230, 55, 56),
    "smacs0723": (60, 21, 16, 5, 144, 48, 40),
}


@pytest.mark.parametrize("name", CLUSTERS)
def test_models_of_a_cluster_are_the_published_catalogues(name: str):
    n_images, n_systems, n_unknown, n_haloes, n_scaled, *free = CLUSTERS[name]
    published = datasets.reference_lens(name).components
    numbers = datasets.reference_numbers(name)
    assert (numbers["n_images"], numbers["n_systems"]) == (n_images, n_systems)
    assert (len(published["halo"]), len(published["members"])) == (n_haloes, n_scaled)
    assert datasets.models(name) == ["strong", "strong_nfw"]
    for setup, n_free in zip((problem(name), workflow.load(f"{name}/strong_nfw")), free, strict=True):
        images = setup.problem.images
        assert (images.n_images, images.n_systems) == (n_images, n_systems)
        assert int(np.isnan(images.z_s).sum()) == n_unknown
        assert strong.total_size(setup.problem.bounds) == n_free
        assert set(datasets.reference_redshifts(name)) == set(images.systems)


# Numbers of the published best files by our names; shapes as (ellipticity, degrees).
PUBLISHED = {
    "abell2744": {"members": 155.47, "north": 662.7017, "south": 286.8281},
    "macs1149": {"members": 151.63},
    "smacs0723": {"members": 154.62},
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_model_at_the_published_numbers_is_the_published_lens(name: str):
    setup = problem(name)
    with (datasets.path(name) / "reference_halos.csv").open(newline="", encoding="utf-8") as file:
        rows = {row["halo_id"]: row for row in csv.DictReader(file)}
    numbers = datasets.reference_numbers(name)
    columns = {
        "x_arcsec": "x_arcsec",
        "y_arcsec": "y_arcsec",
        "r_core_arcsec": "core_radius_arcsec",
        "r_cut_arcsec": "cut_radius_arcsec",
        "sigma_lt_km_s": "v_disp_kms",
    }
    params = {}
    for key in setup.problem.bounds:
        owner, _, number = key.partition(".")
        if number == "shape":
            e, turn = float(rows[owner]["ellipticity"]), 2.0 * np.deg2rad(float(rows[owner]["angle_deg"]))
            params[key] = jnp.array([e * np.cos(turn), e * np.sin(turn)])
        elif number == "sigma_ref_km_s":
            params[key] = jnp.array(PUBLISHED[name][owner])
        elif number == "r_cut_ref_arcsec":
            params[key] = jnp.array(numbers["r_cut_ref"])
        elif owner != "dls_ds":
            params[key] = jnp.array(float(rows[owner][columns[number]]))
        if owner != "dls_ds":
            box, value = setup.problem.bounds[key], params[key]
            np.testing.assert_allclose(box.physical(box.unbounded(value)), value, rtol=1e-9)  # inside the box
    theta = setup.problem.images.theta
    ours = jax.jit(lambda one: lens.alpha(setup.model.lens(one), theta))(params)
    # The scaling relations are rounded to five digits; a deflection is of the order of 30 arcsec.
    np.testing.assert_allclose(ours, jax.jit(lens.alpha)(datasets.reference_lens(name), theta), atol=2e-3)


def test_a_model_that_a_data_set_lacks_is_answered_with_those_it_has():
    with pytest.raises(
        ConfigError, match=r"as1063/weak_nfw: .* has no model 'weak_nfw'; it has strong, strong_nfw"
    ):
        workflow.load("as1063/weak_nfw")


def test_names_and_paths_need_neither_astropy_nor_matplotlib():
    code = (
        "import sys; from jaxlens import datasets; datasets.path(datasets.names()[0]);"
        "assert not {'astropy', 'matplotlib'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("write", [glafic.write_problem, lenstool.write_problem])
def test_a_fit_with_groups_is_not_written_without_them(write, tmp_path):
    setup = workflow.load("abell2744")
    with pytest.raises(ValueError, match=r"groups of galaxies .*\(.*\), which are not written"):
        write(tmp_path / "a.par", setup.problem, {})
    assert not list(tmp_path.iterdir())
