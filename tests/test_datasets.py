"""The data that ships with the package: there, documented, and the published model it claims to be."""

import csv
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import table

from jaxlens import datasets, io, lens
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


def test_names_and_paths_need_neither_astropy_nor_matplotlib():
    code = (
        "import sys; from jaxlens import datasets; datasets.path(datasets.names()[0]);"
        "assert not {'astropy', 'matplotlib'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
