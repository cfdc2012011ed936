"""glafic input files: what is read, and what is refused by name."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxlens import glafic, strong

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
            "lens nfw 0.3 4e+14 -10.1",
            "lens 1 is `nfw`; read are",
        ),
        ("start_perturbed.input", "readobs_point obs_train.dat", "", "no `readobs_point`"),
        (
            "prior.dat",
            "range lens 1 2 1.0e14 1.0e15\n",
            "",
            "parameter 2 of lens 1 is free, but the prior file",
        ),
        ("prior.dat", "range lens 1 2", "gauss lens 1 2", "'gauss lens' is not read"),
        ("obs_train.dat", "1 3 1.4314 0.0", "1 3 1.4314 0.1", "the redshift of system 1 has an error"),
        ("obs_train.dat", "30.076574 5.943404", "30.076574 north", "should be numbers only"),
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
