"""Lenstool parameter files: what is read, and what is written reads back."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from support import arrays, fields, strewn, table
from test_reference_clusters import published

from jaxlens import datasets, lenstool, strong, workflow
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, NFW, SIE, Hernquist, PointMass, Shear, dpie

# The freedom of a published model of Abell S1063 in a handful of sections, with both spellings of words.
PAR = """runmode
    reference 3 342.18322 -44.530889
    inverse 3 0.2 100
    image 1 images.cat
    end
image
    multfile 1 images.cat
    sigposArcsec 0.5
    z_m_limit 1 2.1 1 1.0 4.0 0.1
    z_m_limit 2 3 3 2.0 0.3 0.1
    end
grille
    nombre 128
    nlens_opt 2
    end
potentiel 1 cluster
    profil 81
    x_centre 0.
    y_centre 0.
    ellipticite 0.3
    angle_pos 327.9
    core_radius_kpc 25
    cut_radius_kpc 1000.
    v_disp 1000.
    z_lens 0.3475
    end
limit 1
    core_radius_kpc 1 0.0 150.0 0.01
    ellipticite 1 0.3 0.8 0.01
    angle_pos 1 -60. 0.0 0.01
    v_disp 1 800. 1500. 0.1
    end
potential O2   # shear
    profile 14
    gamma 0.1
    angle_pos -20
    z_lens 0.3475
    end
limit O2
    gamma 1 0.0 0.2 0.01
    angle_pos 1 -90 90.0 0.1
    end
potentiel O3
    profil 81
    ellipticity 0.271
    x_centre 0.006
    y_centre 0.037
    angle_pos -35.
    core_radius 0.103
    core_radius_kpc 0.508
    cut_radius 34.471
    cut_radius_kpc 169.485
    v_disp 283.946
    mag 17.037
    z_lens 0.3475
    end
limit O3
    v_disp 3 283.946 50.0 0.01
    end
potfile
    filein 1 galaxies.cat
    zlens 0.3475
    type 81
    corekpc 0.15
    mag0 19.6875
    sigma 3 158. 27.
    cutkpc 0 45. 100.
    slope 0 4. 4.2
    vdslope 0 4. 0.
    end
cosmologie
    H0 70.
    omegaM 0.3
    omegaX 0.7
    end
fini
"""

IMAGES = """#REFERENCE 0
1.1 342.1945 -44.526998 1 1 0 1.2279 0
1.2 342.1959 -44.528965 1 1 0 1.2279 0
2.1a 342.18645 -44.521197 1 1 0 0 0
2.1b 342.18 -44.53 1 1 0 0 0
3a 342.19 -44.53 1 1 0 0 0
3b 342.17 -44.53 1 1 0 0 0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.par").write_text(PAR)
    (tmp_path / "images.cat").write_text(IMAGES)
    with (datasets.path("as1063") / "members.csv").open() as file:
        rows = list(csv.DictReader(file))[:20]
    keys = ("member_id", "ra_deg", "dec_deg", "a_arcsec", "b_arcsec", "theta_deg", "mag")
    lines = ["#REFERENCE 0", *(" ".join(row[key] for key in keys) + " 0." for row in rows)]
    (tmp_path / "galaxies.cat").write_text("\n".join(lines))
    return tmp_path


def test_numbers_of_the_file(folder: Path) -> None:
    read = lenstool.read(folder / "a.par")
    bounds, plane, images = read.problem.bounds, read.plane, read.problem.images
    kpc = float(plane.kpc_per_arcsec)
    box = bounds["potential-1.r_core_arcsec"]
    assert isinstance(box, strong.Box)
    assert_allclose([box.lo, box.hi], [0.0, 150.0 / kpc])
    # 327.9 and -32.1 degrees are one ellipse; only the second is inside the limits.
    assert_allclose(read.start["potential-1.pa"], np.deg2rad(-32.1))
    assert isinstance(bounds["O2.pa"], strong.Angle)
    priors = {one.name: one for one in read.problem.priors if isinstance(one, strong.NormalPrior)}
    assert float(priors["members.sigma_ref_km_s"].sigma) == 27.0
    assert float(priors["O3.sigma_lt_km_s"].mean) == 283.946
    assert images.systems == ("1", "2.1", "3")
    assert float(images.z_s[0]) == 1.2279 and bool(jnp.isnan(images.z_s[1:]).all())
    low = bounds["dls_ds.2.1"]
    assert isinstance(low, strong.Box) and not low.weak
    assert_allclose(low.hi, plane.dls_ds(4.0))
    redshift = [one for one in read.problem.priors if isinstance(one, strong.RedshiftPrior)]
    assert [one.system for one in redshift] == ["3"]
    # The frame of published models is x = -(RA - RA0) cos(Dec0): the data set has the same images.
    assert_allclose(images.theta[0], [-28.9483, 14.0076], atol=1e-4)


def test_kpc_wins_over_arcsec_as_in_the_published_result(folder: Path) -> None:
    read = lenstool.read(folder / "a.par")
    model = read.problem.build
    assert isinstance(model, strong.ClusterModel)
    galaxy = model.ingredients[2].fixed
    # core 0.103319 and cut 34.47065 arcsec in the published table; kpc are printed with three digits.
    assert_allclose(galaxy["r_core_arcsec"], 0.103319, rtol=2e-4)
    assert_allclose(galaxy["r_cut_arcsec"], 34.47065, rtol=2e-6)


def test_galaxies_scale_as_in_the_published_model(folder: Path) -> None:
    """Reference galaxy of the published result, sigma_* found by regression on its halos."""
    text = PAR.replace("sigma 3 158. 27.", "sigma 0 102.5 0.")
    (folder / "a.par").write_text(text)
    lens, _ = lenstool.read_lens(folder / "a.par")
    halos = table("clusters/as1063_halos.csv")
    members = lens.components["members"]
    theta = np.asarray(members.centre)
    distance = np.hypot(halos["x_arcsec"][None] - theta[:, :1], halos["y_arcsec"][None] - theta[:, 1:])
    assert distance.min(axis=1).max() < 1e-3
    same = distance.argmin(axis=1)
    ref = dpie.from_lenstool(
        halos["v_disp_kms"][same],
        halos["core_radius_arcsec"][same],
        halos["cut_radius_arcsec"][same],
        ellipticity=halos["ellipticity"][same],
    )
    # The table prints six digits; only the ratio of the strengths is known, as sigma_* is fitted.
    assert_allclose(members.params.r_cut, ref.r_cut, rtol=1e-4)
    assert_allclose(members.params.r_core, ref.r_core, rtol=1e-3)
    assert_allclose(members.params.e, ref.e, atol=1e-4)
    ratio = np.asarray(members.params.b / ref.b)
    assert_allclose(ratio, ratio[0], rtol=1e-4)


def test_a_kind_of_component_is_registered_once() -> None:
    before = strong.FORMS["lenstool_sis"]
    with pytest.raises(ValueError, match="'lenstool_sis' exists already"):
        strong.register_form("lenstool_sis", strong.Form(("sigma_v_km_s",), before.make, shape=None))
    assert strong.FORMS["lenstool_sis"] is before


@pytest.mark.parametrize("file", ["images.cat", "galaxies.cat"])
def test_degrees_that_nothing_declares_are_not_read_as_arcsec(folder: Path, file: str) -> None:
    path, before = folder / file, lenstool.read(folder / "a.par").problem.images.theta
    path.write_text(path.read_text().replace("#REFERENCE 0", ""))
    with pytest.raises(ValueError, match=rf"{file} does not say .* within 1 of the reference \(342.183, -44"):
        lenstool.read(folder / "a.par")
    par = folder / "a.par"
    if file == "images.cat":  # said in the parameter file
        par.write_text(PAR.replace("image\n    multfile", "image\n    mult_wcs 1\n    multfile"))
    else:  # arcsec without a word are arcsec
        path.write_text("1 3.0 4.0 1 0.5 30 18. 0\n2 342.0 -44.0 1 0.5 30 18. 0\n")
    assert_allclose(lenstool.read(par).problem.images.theta, before, rtol=1e-12)


def test_the_command_reads_it_as_a_setup(folder: Path) -> None:
    setup = workflow.load(str(folder / "a.par"))
    assert setup.reference == (342.18322, -44.530889)
    assert setup.problem.images.n_images == 6
    assert set(setup.start or {}) == set(setup.problem.bounds)


# --- written and read back --------------------------------------------------------------------------

PLANE = LensPlane(FlatLCDM(h=0.68, omega_m=0.31), 0.42)
EVERYTHING = {
    "dpie": Component(DPIE(b=np.array([31.0, 1.3]), r_core=0.15, r_cut=90.0, e=0.4), (4.0, 5.0), 2.9),
    "sie": Component(SIE(b=12.0, e=0.3, r_core=0.2), (0.3, 0.1), 0.2),
    "nfw": Component(NFW(kappa_s=0.31, r_s=41.0), (1.2, -3.1)),
    "shear": Component(Shear(gamma=0.07), (0.0, 0.0), -0.4),
}  # fmt: skip


def test_a_lens_reads_back_to_1e_12(tmp_path: Path) -> None:
    lenstool.write(tmp_path / "a.par", Lens(EVERYTHING), PLANE, reference=(10.0, -5.0))
    again, back = lenstool.read_lens(tmp_path / "a.par")
    theta = strewn(20, 3)
    before, after = (np.asarray(fields(one, theta)["alpha"]) for one in (Lens(EVERYTHING), again))
    assert np.abs(after - before).max() < 1e-12 * np.abs(before).max()
    assert_allclose([back.z_l, back.cosmology.h, back.cosmology.omega_m], [0.42, 0.68, 0.31], rtol=1e-15)


@pytest.mark.parametrize("name", ["abell2744", "as1063", "macs1149", "smacs0723"])
def test_published_models_read_back_with_their_check_points(name: str, tmp_path: Path) -> None:
    lens, plane = published(name)
    lenstool.write(tmp_path / "a.par", lens, plane)
    again, _ = lenstool.read_lens(tmp_path / "a.par")
    ref = table(f"clusters/{name}_check_points.csv")
    theta = np.stack([ref["x_arcsec"], ref["y_arcsec"]], axis=1)
    before, after = (arrays(fields(one, theta)) for one in (lens, again))
    scale = np.abs(before["alpha"]).max()
    # A core below the floor of 1e-10 arcsec would show; rounding of some 200 potentials does not.
    assert np.abs(after["alpha"] - before["alpha"]).max() < 1e-12 * scale
    alpha = after["alpha"] * np.asarray(plane.dls_ds(jnp.asarray(ref["z_s"])))[:, None]
    # The tolerances of the published tables themselves: see test_reference_clusters.py.
    assert np.abs(alpha[:, 0] - ref["alpha_x_arcsec"]).max() < 2e-3
    assert np.abs(alpha[:, 1] - ref["alpha_y_arcsec"]).max() < 2e-3


def test_a_fit_reads_back(folder: Path) -> None:
    read = lenstool.read(folder / "a.par")
    lenstool.write_problem(folder / "b.par", read.problem, read.start, reference=read.reference)
    again = lenstool.read(folder / "b.par")
    assert set(again.problem.bounds) == set(read.problem.bounds)
    for name, bound in read.problem.bounds.items():
        new = again.problem.bounds[name]
        assert type(new) is type(bound)
        for old, back in zip(jax.tree.leaves(bound), jax.tree.leaves(new), strict=True):
            assert_allclose(back, old, rtol=1e-9, atol=1e-12)
    for name, value in read.start.items():
        assert_allclose(again.start[name], value, rtol=1e-9)
    assert len(again.problem.priors) == len(read.problem.priors)
    for field in ("theta", "source", "z_s", "sigma_pos"):
        assert_allclose(getattr(again.problem.images, field), getattr(read.problem.images, field), rtol=1e-13)
    theta = strewn(20, 3)
    lenses = [one.problem.build(read.start).lens for one in (read, again)]
    before, after = (np.asarray(fields(lens, theta)["alpha"]) for lens in lenses)
    assert np.abs(after - before).max() < 1e-12 * np.abs(before).max()


def test_several_priors_on_one_number_are_written_as_their_product(folder: Path) -> None:
    read = lenstool.read(folder / "a.par")
    more = (
        strong.NormalPrior("potential-1.sigma_lt_km_s", 800.0, 100.0),
        strong.NormalPrior("potential-1.sigma_lt_km_s", 1000.0, 50.0),
        strong.RedshiftPrior("3", read.plane, 3.0, 0.4),
    )
    problem = replace(read.problem, priors=(*read.problem.priors, *more))
    lenstool.write_problem(folder / "b.par", problem, read.start, reference=read.reference)
    back: dict[str, Any] = {
        getattr(one, "name", ""): one for one in lenstool.read(folder / "b.par").problem.priors
    }
    sigma, z = back["potential-1.sigma_lt_km_s"], back["dls_ds.3"]
    # (800/100^2 + 1000/50^2)/(1/100^2 + 1/50^2) = 960, and 3 +- 0.4 with the 2 +- 0.3 of the file: 2.36.
    assert_allclose([sigma.mean, sigma.sigma], [960.0, 2000.0**0.5], rtol=1e-12)
    assert_allclose([z.mean, z.sigma], [2.36, 0.24], rtol=1e-12)
    ratio = replace(read.problem, priors=(strong.NormalPrior("dls_ds.3", 0.5, 0.1),))
    with pytest.raises(ValueError, match=r"distance ratio `dls_ds.3` has no counterpart"):
        lenstool.write_problem(folder / "c.par", ratio, read.start)


@pytest.mark.parametrize(
    ("component", "said"),
    [
        (Component(Hernquist(kappa_s=2.5, r_s=4.1)), "'one' is a hernquist"),
        (Component(PointMass(theta_e=1.0)), "'one' is a point"),
        (Component(NFW(kappa_s=0.3, r_s=40.0, e=0.2)), "'one' is an elliptical nfw"),
        (Component(Shear(gamma=0.1), (1.0, 0.0)), "about the origin"),
    ],
)
def test_what_has_no_counterpart_is_named_and_nothing_written(
    component: Component, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=said):
        lenstool.write(tmp_path / "a.par", Lens(one=component), PLANE)
    assert not list(tmp_path.iterdir())


def test_a_problem_that_cannot_be_written_is_named_and_nothing_written(folder: Path) -> None:
    read = lenstool.read(folder / "a.par")
    before = sorted(folder.iterdir())
    skewed = replace(read.problem, priors=(strong.LogNormalPrior("members.sigma_ref_km_s", 200.0, 0.2),))
    with pytest.raises(ValueError, match=r"log-normal prior on `members.sigma_ref_km_s` cannot be written"):
        lenstool.write_problem(folder / "b.par", skewed, read.start)
    with pytest.raises(ValueError, match=r"`errors.sigma_scale`, a free factor on the position errors"):
        lenstool.write_problem(folder / "b.par", strong.free_sigma(read.problem), read.start)
    assert sorted(folder.iterdir()) == before
