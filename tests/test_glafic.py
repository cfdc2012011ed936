"""glafic input files: what is read, and what is refused by name."""

import shutil
from dataclasses import replace
from pathlib import Path

import glafic_configs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from support import arrays, fields, strewn, table

from jaxlens import glafic, strong, workflow
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, NFW, SIE, TSIS, Hernquist, PointMass, Shear, Sheet

CLUSTER68 = Path(__file__).parent.parent / "benchmarks" / "data" / "cluster68"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("members.dat", "obs_train.dat", "prior.dat", "start_perturbed.input"):
        shutil.copy(CLUSTER68 / name, tmp_path / name)
    return tmp_path


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_numbers_of_the_file(folder: Path) -> None:
    read = glafic.read(folder / "start_perturbed.input")
    images = read.problem.images
    assert (images.n_images, images.n_systems, strong.total_size(read.problem.bounds)) == (68, 22, 26)
    assert images.image_ids[:4] == ("1.1", "1.2", "1.3", "2.1")
    assert_allclose(images.theta[0], [30.076574, 5.943404])
    assert_allclose(images.sigma_pos, 0.15)
    assert float(read.start["lens1.mass_vir_msun_h"]) == 4e14
    assert_allclose(read.start["lens1.pa"], np.pi / 2)  # 0 degrees from +y
    box = read.problem.bounds["members.r_cut_ref_arcsec"]
    assert isinstance(box, strong.Box)
    assert (float(box.lo), float(box.hi)) == (1.0, 50.0)
    assert isinstance(read.problem.bounds["lens2.pa"], strong.Angle)


def test_galaxies_are_rounded_to_single_precision(folder: Path) -> None:
    read = glafic.read(folder / "start_perturbed.input")
    members = read.problem.build.members  # pyright: ignore[reportFunctionMemberAccess]
    assert float(members.luminosity[0]) == float(np.float32(0.50053))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "start_perturbed.input",
            "galfile members.dat",
            "galfile members.dat\nfunny 3",
            r"funny \(line 14\)",
        ),
        ("start_perturbed.input", "chi2_splane 1", "chi2_splane 0", "chi2_splane is 0; only 1"),
        (
            "start_perturbed.input",
            "lens anfw 0.3 4e+14 -10.1",
            "lens pow 0.3 4e+14 -10.1",
            "lens 1 is `pow`; read are",
        ),
        ("start_perturbed.input", "readobs_point obs_train.dat", "", "no `readobs_point`"),
        (
            "prior.dat",
            "range lens 1 2 1.0e14 1.0e15\n",
            "",
            "parameter 2 of lens 1 is free, but the prior file",
        ),
        ("prior.dat", "range lens 1 2", "match lens 1 2", "'match lens' is not read"),
        ("obs_train.dat", "30.076574 5.943404", "30.076574 north", "'north' is not a number"),
    ],
)
def test_what_is_not_understood_is_named(folder: Path, file: str, old: str, new: str, message: str) -> None:
    edit(folder / file, old, new)
    with pytest.raises(ValueError, match=message) as error:
        glafic.read(folder / "start_perturbed.input")
    assert str(folder) in str(error.value)


def test_missing_file_is_named(folder: Path) -> None:
    (folder / "prior.dat").unlink()
    with pytest.raises(FileNotFoundError, match=r"prior\.dat does not exist"):
        glafic.read(folder / "start_perturbed.input")


# --- glafic's own numbers ---------------------------------------------------------------------------


def input_of(name: str, folder: Path) -> Path:
    """One of the stored configurations as an input file."""
    config = glafic_configs.CONFIGS[name]
    lines = ["omega 0.3", "lambda 0.7", "hubble 0.7", *config.get("options", [])]
    if "galaxies" in config:
        rows = [" ".join(map(repr, row)) for row in config["galaxies"]]
        (folder / "galaxies.dat").write_text("\n".join(rows))
        lines.append("galfile galaxies.dat")
    lines.append(f"startup {len(config['lenses'])} 0 0")
    lines += [f"lens {one['model']} {' '.join(map(repr, one['p']))}" for one in config["lenses"]]
    (folder / "a.input").write_text("\n".join([*lines, "end_startup"]))
    return folder / "a.input"


# One of each model; `nfw` and `hern` are integrated to 5e-4 by glafic (4e-4 and 6e-4 in alpha measured).
@pytest.mark.parametrize(
    ("name", "tolerance"),
    [
        ("anfw_e03_m200c", 1e-9),
        ("nfw_e03", 1e-3),
        ("hern_e04", 1e-3),
        ("sie_core_e03", 1e-9),
        ("pert", 1e-9),
        ("point", 1e-9),
        ("composite_A", 1e-9),
    ],
)
def test_the_lens_read_has_the_deflection_of_glafic(name: str, tolerance: float, tmp_path: Path) -> None:
    lens, plane = glafic.read_lens(input_of(name, tmp_path))
    ref = table("glafic/lens_points.csv", config=name, zs="2.0")
    theta = np.stack([ref["x"], ref["y"]], axis=1)
    alpha = arrays(fields(lens, theta))["alpha"] * float(plane.dls_ds(2.0))
    expected = np.stack([ref["alpha_x"], ref["alpha_y"]], axis=1)
    length = np.linalg.norm(expected, axis=1)
    assert (np.linalg.norm(alpha - expected, axis=1) / length).max() < tolerance


# --- written and read back --------------------------------------------------------------------------

EVERYTHING = {
    "nfw": Component(
        NFW(kappa_s=jnp.array([0.31, 0.12]), r_s=jnp.array([41.0, 17.3]), e=0.3), (1.2, -3.1), 0.7
    ),
    "hernquist": Component(Hernquist(kappa_s=2.5, r_s=4.1, e=0.25), (-2.0, 0.4), -1.1),
    "dpie": Component(DPIE(b=1.3, r_core=0.15, r_cut=12.0, e=0.2), (4.0, 5.0), 2.9),
    "sie": Component(SIE(b=12.0, e=0.3, r_core=0.2), (0.3, 0.1), 0.2),
    "point": Component(PointMass(theta_e=3.1), (-7.0, 2.0), 0.0),
    "shear": Component(Shear(gamma=0.07), (0.0, 0.0), -0.4),
    "sheet": Component(Sheet(kappa=0.03), (1.0, 1.0), 0.0),
}


def test_a_lens_reads_back_to_1e_12(tmp_path: Path) -> None:
    plane = glafic_configs.plane()
    glafic.write(tmp_path / "a.input", Lens(EVERYTHING), plane)
    again, back = glafic.read_lens(tmp_path / "a.input")
    theta = strewn(20, 3)
    before, after = (np.asarray(fields(one, theta)["alpha"]) for one in (Lens(EVERYTHING), again))
    # Relative to the largest deflection, 46 arcsec.
    assert np.abs(after - before).max() < 1e-12 * np.abs(before).max()
    assert float(back.z_l) == float(plane.z_l)


def test_a_profile_without_counterpart_is_named_and_nothing_written(tmp_path: Path) -> None:
    lens = Lens(sub=Component(TSIS(theta_e=1.0, r_t=3.0)))
    with pytest.raises(ValueError, match="Component 'sub' is a tsis"):
        glafic.write(tmp_path / "a.input", lens, glafic_configs.plane())
    assert not list(tmp_path.iterdir())


def free_redshift(folder: Path) -> glafic.GlaficInput:
    """cluster68 with a free redshift that has an error, a box and a prior, and a normal prior on a mass."""
    path = folder / "start_perturbed.input"
    lines = path.read_text().splitlines()
    first = lines.index("0 1 1")  # of the points in setopt
    lines[first] = "1 1 1"
    path.write_text("\n".join(lines))
    edit(folder / "obs_train.dat", "1 3 1.4314 0.0", "1 3 1.4314 0.1")
    with (folder / "prior.dat").open("a") as file:
        file.write("range point 1 1 1.0 2.0\ngauss point 1 1 1.5 0.2\ngauss lens 1 2 5e14 1e14\n")
    return glafic.read(path)


def test_free_redshifts_and_normal_priors(folder: Path) -> None:
    read = free_redshift(folder)
    problem, plane = read.problem, read.plane
    box = problem.bounds["dls_ds.1"]
    assert isinstance(box, strong.Box) and not box.weak
    assert_allclose([box.lo, box.hi], [plane.dls_ds(1.0), plane.dls_ds(2.0)])
    assert bool(jnp.isnan(problem.images.z_s[0]))
    params = {**read.start, "dls_ds.1": plane.dls_ds(1.7)}
    rows = sorted(float(one(params)) for one in problem.priors)
    # (4e14 - 5e14)/1e14, (1.7 - 1.5)/0.2 and (1.7 - 1.4314)/0.1
    assert_allclose(rows, [-1.0, 1.0, 2.686], atol=1e-9)


def test_a_fit_reads_back(folder: Path) -> None:
    read = free_redshift(folder)
    glafic.write_problem(folder / "again.input", read.problem, read.start)
    again = glafic.read(folder / "again.input")
    assert set(again.problem.bounds) == set(read.problem.bounds)
    for name, bound in read.problem.bounds.items():
        for old, new in zip(jax.tree.leaves(bound), jax.tree.leaves(again.problem.bounds[name]), strict=True):
            assert_allclose(new, old, rtol=1e-12)
        assert_allclose(again.start[name], read.start[name], rtol=1e-12)
    for field in ("theta", "source", "z_s", "sigma_pos"):
        assert_allclose(getattr(again.problem.images, field), getattr(read.problem.images, field), rtol=0)
    theta = strewn(20, 3)
    lenses = [one.problem.build(one.start).lens for one in (read, again)]
    before, after = (np.asarray(fields(lens, theta)["alpha"]) for lens in lenses)
    assert np.abs(after - before).max() < 1e-12 * np.abs(before).max()
    # The two priors on the redshift have become one: (1.5/0.2^2 + 1.4314/0.1^2)/(1/0.2^2 + 1/0.1^2).
    priors = [one for one in again.problem.priors if isinstance(one, strong.RedshiftPrior)]
    assert_allclose([float(priors[0].mean), float(priors[0].sigma)], [1.44512, 125**-0.5], rtol=1e-9)


@pytest.mark.parametrize("start", [-115.0, 65.0])
def test_an_angle_stays_inside_its_range(folder: Path, start: float) -> None:
    """A box of -130 to -100 degrees from +x is one of -220 to -190 from +y, and the start lies in it."""
    read = glafic.read(folder / "start_perturbed.input")
    name = "lens2.pa"
    box = strong.Box(np.deg2rad(-130.0), np.deg2rad(-100.0))
    prior = strong.NormalPrior(name, np.deg2rad(start + 5.0), 0.1)
    problem = replace(read.problem, bounds={**read.problem.bounds, name: box}, priors=(prior,))
    params = {**read.start, name: jnp.asarray(np.deg2rad(start))}
    glafic.write_problem(folder / "again.input", problem, params)
    row = (folder / "again.input").read_text().split("\nlens ")[2].split()
    assert_allclose(float(row[6]), -205.0, rtol=1e-12)
    # Other programs write angles between -180 and 180.
    edit(folder / "again.input", row[6], "155.0")
    again = glafic.read(folder / "again.input")
    assert_allclose(again.start[name], np.deg2rad(-115.0), rtol=1e-12)
    (back,) = again.problem.priors
    assert isinstance(back, strong.NormalPrior)
    assert_allclose([back.mean, back.sigma], [np.deg2rad(-110.0), 0.1], rtol=1e-12)


def test_a_free_angle_keeps_its_distance_from_its_prior(folder: Path) -> None:
    read = glafic.read(folder / "start_perturbed.input")
    # 200 degrees from +x is 110 from +y, and would be -70 inside half a turn; the prior is 10 degrees on.
    prior = strong.NormalPrior("lens2.pa", np.deg2rad(210.0), 0.1)
    params = {**read.start, "lens2.pa": jnp.asarray(np.deg2rad(200.0))}
    glafic.write_problem(folder / "again.input", replace(read.problem, priors=(prior,)), params)
    again = glafic.read(folder / "again.input")
    (back,) = again.problem.priors
    assert isinstance(back, strong.NormalPrior)
    assert_allclose(np.rad2deg(back.mean - again.start["lens2.pa"]), 10.0, rtol=1e-9)
    text = (folder / "again_prior.dat").read_text()
    moved = next(line for line in text.splitlines() if line.startswith("gauss")).split()
    edit(folder / "again_prior.dat", moved[4], repr(float(moved[4]) - 360.0))
    (back,) = glafic.read(folder / "again.input").problem.priors
    assert isinstance(back, strong.NormalPrior)
    assert_allclose(np.rad2deg(back.mean - again.start["lens2.pa"]), 10.0, rtol=1e-9)


def test_what_the_format_cannot_hold_is_named_and_nothing_written(folder: Path) -> None:
    read = glafic.read(folder / "start_perturbed.input")
    before = sorted(folder.iterdir())
    skewed = replace(read.problem, priors=(strong.LogNormalPrior("members.sigma_ref_km_s", 200.0, 0.2),))
    with pytest.raises(ValueError, match=r"log-normal prior on `members.sigma_ref_km_s` cannot be written"):
        glafic.write_problem(folder / "a.input", skewed, read.start)
    with pytest.raises(ValueError, match=r"`errors.sigma_scale`, a free factor on the position errors"):
        glafic.write_problem(folder / "a.input", strong.free_sigma(read.problem), read.start)
    assert sorted(folder.iterdir()) == before


def test_a_file_that_would_be_fitted_in_the_image_plane_says_so(folder: Path) -> None:
    path = folder / "start_perturbed.input"
    text = path.read_text()
    assert glafic.read(path).notes == ()
    line = next(line for line in text.splitlines() if line.startswith("chi2_splane"))
    path.write_text(text.replace(line, ""))
    setup = workflow.load(str(path))
    assert len(setup.notes) == 1 and "does not set chi2_splane" in setup.notes[0]
    assert "formed in the source plane" in setup.notes[0]
