"""Files that are wrong: one message with file, place, value and remedy; exit code 2; nothing written.

No case gets as far as a compilation of the fit.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from jaxlens import _text, cli, config, glafic, io, lenstool
from jaxlens.grid import Grid

GLAFIC = {
    "a.input": """omega 0.3
lambda 0.7
hubble 0.7
galfile galaxies.dat
startup 3 0 1
lens sie 0.3 300.0 0.1 0.2 0.3 20.0 0.0 0.0
lens pert 0.3 2.0 0.0 0.0 0.05 10.0 0.0 0.0
lens gals 0.3 200.0 0.0 0.0 0.0 0.0 10.0 0.5
point 2.0 0.0 0.0
end_startup
start_setopt
0 1 0 0 0 0 0 0
0 0 0 0 0 0 0 0
0 0 0 0 0 0 0 0
1 1 1
end_setopt
start_command
readobs_point images.dat
parprior prior.dat
optimize
""",
    "galaxies.dat": "1.0 2.0 0.5 0.1 30.0\n",
    "images.dat": "1 2 2.0 0.1\n10.0 0.0 1.0 0.1 0.0 0.0 0.0 0\n-8.0 1.0 1.0 0.1 0.0 0.0 0.0 0\n",
    "prior.dat": "range lens 1 2 100.0 500.0\n",
}

LENSTOOL = {
    "a.par": """runmode
    reference 3 10.0 -5.0
    end
image
    multfile 1 images.cat
    sigposArcsec 0.5
    z_m_limit 1 1 1 1.0 4.0 0.1
    end
potentiel O1
    profil 81
    x_centre 0.1
    y_centre 0.2
    ellipticite 0.3
    angle_pos 20.
    core_radius 5.0
    cut_radius 100.
    v_disp 800.
    z_lens 0.3
    end
limit O1
    v_disp 1 500. 1500. 0.1
    end
potfile
    filein 1 galaxies.cat
    zlens 0.3
    corekpc 0.15
    mag0 19.0
    sigma 1 50. 250.
    cutkpc 0 45.
    end
cosmologie
    H0 70.
    omega 0.3
    lambda 0.7
    end
fini
""",
    "galaxies.cat": "#REFERENCE 3 10.0 -5.0\n1 1.0 2.0 1.0 0.8 30. 20.0 0.\n",
    "images.cat": "#REFERENCE 0\n1a 9.999 -4.999 1 1 0 0 0\n1b 10.002 -5.001 1 1 0 0 0\n",
}

# Name: file, what to replace, by what (None: remove the file), what the message says.
GLAFIC_MISTAKES: dict[str, tuple[str, str, str | None, str]] = {
    "missing file": ("images.dat", "", None, "images.dat does not exist"),
    "not a number": ("images.dat", "10.0 0.0", "ten 0.0", "images.dat, line 2: 'ten' is not a number"),
    "NaN": ("images.dat", "10.0 0.0", "nan 0.0", "line 2: 'nan' is not finite"),
    "too few columns": ("images.dat", "10.0 0.0 1.0 0.1 0.0 0.0 0.0 0", "10.0 0.0", "line 2: 2 numbers"),
    "one image": ("images.dat", "1 2 2.0", "1 1 2.0", "system 1 has 1 image, which constrains nothing"),
    "too few images": ("images.dat", "1 2 2.0", "1 3 2.0", "announces 3 images, the file has 2"),
    "duplicate image": ("images.dat", "-8.0 1.0", "10.0 0.0", "at the position of another image"),
    "flux error": (
        "images.dat",
        "10.0 0.0 1.0 0.1 0.0 0.0",
        "10.0 0.0 1.0 0.1 0.2 0.0",
        "a flux error, a time delay or a parity (0.2 0.0 0.0 0), which are not fitted",
    ),
    "no position error": ("images.dat", "10.0 0.0 1.0 0.1", "10.0 0.0 1.0 -0.1", "the position error -0.1"),
    "z_s <= z_l": ("images.dat", "1 2 2.0", "1 2 0.2", "redshift 0.2 of system 1 is not behind the lens"),
    "empty images": ("images.dat", "", "# nothing\n", "images.dat is empty"),
    "empty galaxies": ("galaxies.dat", "1.0 2.0 0.5 0.1 30.0", "", "has no galaxy"),
    "negative luminosity": ("galaxies.dat", "0.5 0.1", "-0.5 0.1", "the luminosity -0.5 is not positive"),
    "ellipticity of 1": ("galaxies.dat", "0.5 0.1", "0.5 1.0", "1 is not an ellipticity"),
    "unknown model": ("a.input", "lens sie", "lens king", "lens 1 is `king`; read are"),
    "several unknown commands": (
        "a.input",
        "hubble 0.7",
        "hubble 0.7\nfoo 1\nbar 2",
        "foo (line 4), bar (line 5)",
    ),
    "negative sigma": ("a.input", "sie 0.3 300.0", "sie 0.3 -300.0", "(sigma_v_km_s) is -300; it cannot"),
    "seven parameters": ("a.input", "20.0 0.0 0.0", "20.0 0.0", "line 6: 7 numbers"),
    "two lens planes": ("a.input", "gals 0.3", "gals 0.4", "lens 3 is at z = 0.4, the first one at 0.3"),
    "wrong count": ("a.input", "startup 3 0 1", "startup 4 0 1", "announces 4 lenses and 1 points"),
    "bad flag": ("a.input", "0 1 0 0 0 0 0 0", "0 2 0 0 0 0 0 0", "the flag '2' of setopt"),
    "too few flags": ("a.input", "0 1 0 0 0 0 0 0", "0 1", "2 flags of setopt where 8 are needed"),
    "not flat": ("a.input", "lambda 0.7", "lambda 0.6", "is not a flat universe"),
    "no range": ("prior.dat", "range lens 1 2 100.0 500.0", "", "parameter 2 of lens 1 is free"),
    "limits exchanged": ("prior.dat", "100.0 500.0", "500.0 100.0", "500 is not below the upper one 100"),
    "prior of nothing": (
        "prior.dat",
        "500.0\n",
        "500.0\nrange lens 7 2 1 2\n",
        "there is no parameter 2 of lens 7",
    ),
    "prior twice": ("prior.dat", "500.0\n", "500.0\nrange lens 1 2 1 2\n", "on line 1 already"),
    "free redshift outside": (
        "prior.dat",
        "500.0\n",
        "500.0\nrange point 1 1 3 4\n",
        "is not between 3 and 4",
    ),
}

LENSTOOL_MISTAKES: dict[str, tuple[str, str, str | None, str]] = {
    "missing file": ("galaxies.cat", "", None, "galaxies.cat does not exist"),
    "not a number": ("a.par", "v_disp 800.", "v_disp fast", "line 17: 'fast' is not a number"),
    "unknown profile": ("a.par", "profil 81", "profil 3", "profil 3 of potentiel O1 (line 9)"),
    "several unknown keys": (
        "a.par",
        "z_lens 0.3",
        "z_lens 0.3\n    beta 1\n    rcslope 2",
        "beta of potentiel O1 (line 19), rcslope of potentiel O1 (line 20)",
    ),
    "unknown section": (
        "a.par",
        "fini",
        "shapemodel\n    id 1\n    end\nfini",
        "sections that are not read: shapemodel (line ",
    ),
    "limit without potential": ("a.par", "limit O1", "limit O9", "limit O9 belongs to no potential"),
    "limit of nothing": ("a.par", "v_disp 1 500.", "gamma 1 500.", "gamma 1 500. 1500. 0.1 is not a number"),
    "limits exchanged": ("a.par", "1 500. 1500.", "1 1500. 500.", "the lower limit is not below"),
    "unknown kind of limit": ("a.par", "v_disp 1 500.", "v_disp 2 500.", "is of kind 2; read are 0"),
    "negative sigma": (
        "a.par",
        "v_disp 800.",
        "v_disp -800.",
        "line 17, potentiel O1: v_disp -800. is negative",
    ),
    "core beyond cut": ("a.par", "cut_radius 100.", "cut_radius 4.", "is not larger than core_radius"),
    "ellipticity of 1": (
        "a.par",
        "ellipticite 0.3",
        "ellipticite 1.0",
        "ellipticite 1.0 is not an ellipticity",
    ),
    "no end": ("a.par", "    z_lens 0.3\n    end", "    z_lens 0.3", "does not end before line 19"),
    "two lens planes": ("a.par", "zlens 0.3", "zlens 0.4", "zlens 0.4 is not the lens plane"),
    "no position error": ("a.par", "    sigposArcsec 0.5\n", "", "sigposArcsec is missing"),
    "no images": ("a.par", "    multfile 1 images.cat\n", "", "has no images"),
    "z_s <= z_l": (
        "a.par",
        "z_m_limit 1 1 1 1.0 4.0",
        "z_m_limit 1 1 0 0.2 0.0",
        "0.2 of system 1 is not behind",
    ),
    "redshift of nobody": ("a.par", "z_m_limit 1 1 1", "z_m_limit 1 8 1", "8, which is not a system"),
    "free exponent": ("a.par", "mag0 19.0", "mag0 19.0\n    slope 1 2. 5.", "must be fixed and positive"),
    "not flat": ("a.par", "lambda 0.7", "lambda 0.6", "do not add up to 1"),
    "one image": ("images.cat", "1b 10.002", "2a 10.002", "image 1a is alone in its system 1"),
    "duplicate image": ("images.cat", "1b 10.002 -5.001", "1b 9.999 -4.999", "has the position of line 2"),
    "two redshifts": ("images.cat", "0 0 0\n1b", "0 2.0 0\n1b", "disagrees with 2 on line 2"),
    "columns missing": ("images.cat", "1b 10.002 -5.001 1 1 0 0 0", "1b 10.002", "2 columns where 7 are"),
    "empty catalogue": ("galaxies.cat", "1 1.0 2.0 1.0 0.8 30. 20.0 0.", "", "has no galaxy"),
    "axes exchanged": ("galaxies.cat", "1.0 0.8", "0.8 1.0", "axes a = 0.8, b = 1"),
    "no cosmology": ("a.par", "cosmologie", "champ", "has no section `cosmologie`"),
    "RA without reference": ("a.par", "    reference 3 10.0 -5.0\n", "", "no reference point"),
}


def make(folder: Path, files: dict[str, str], mistake: tuple[str, str, str | None, str]) -> None:
    for name, text in files.items():
        (folder / name).write_text(text)
    name, old, new, _ = mistake
    if new is None:
        (folder / name).unlink()
    else:
        assert old in files[name]
        text = files[name].replace(old, new, 1) if old else new
        (folder / name).write_text(text)


def refused(read: Any, path: Path, said: str) -> None:
    with pytest.raises((ValueError, OSError)) as error:
        read(path)
    assert said in str(error.value)
    assert str(path.parent) in str(error.value)  # the file, with its directory


@pytest.mark.parametrize("mistake", GLAFIC_MISTAKES.values(), ids=list(GLAFIC_MISTAKES))
def test_glafic(mistake: tuple[str, str, str | None, str], tmp_path: Path) -> None:
    make(tmp_path, GLAFIC, mistake)
    refused(glafic.read, tmp_path / "a.input", mistake[3])


@pytest.mark.parametrize("mistake", LENSTOOL_MISTAKES.values(), ids=list(LENSTOOL_MISTAKES))
def test_lenstool(mistake: tuple[str, str, str | None, str], tmp_path: Path) -> None:
    make(tmp_path, LENSTOOL, mistake)
    refused(lenstool.read, tmp_path / "a.par", mistake[3])


def test_without_a_mistake_both_are_read(tmp_path: Path) -> None:
    for name, text in {**GLAFIC, **LENSTOOL}.items():
        (tmp_path / name).write_text(text)
    assert set(glafic.read(tmp_path / "a.input").problem.bounds) == {"lens1.sigma_v_km_s", "dls_ds.1"}
    bounds = lenstool.read(tmp_path / "a.par").problem.bounds
    assert set(bounds) == {"O1.sigma_lt_km_s", "members.sigma_ref_km_s", "dls_ds.1"}


# --- the command ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "files", "mistake"),
    [
        ("a.input", GLAFIC, GLAFIC_MISTAKES["unknown model"]),
        ("a.input", GLAFIC, GLAFIC_MISTAKES["missing file"]),
        ("a.par", LENSTOOL, LENSTOOL_MISTAKES["limit without potential"]),
        ("a.par", LENSTOOL, LENSTOOL_MISTAKES["one image"]),
    ],
)
def test_the_command_says_so_and_writes_nothing(
    name: str, files: dict[str, str], mistake: tuple[str, str, str | None, str], tmp_path: Path
) -> None:
    make(tmp_path, files, mistake)
    before = sorted(tmp_path.rglob("*"))
    command = ["strong", str(tmp_path / name), "--out", str(tmp_path / "out"), "--no-cache"]
    result = CliRunner().invoke(cli.app, command, env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert result.exit_code == 2
    assert result.stderr.startswith("error:") and mistake[3] in result.stderr
    assert "Traceback" not in result.stderr
    assert sorted(tmp_path.rglob("*")) == before


# --- any text file ------------------------------------------------------------------------------------

READERS = {
    "glafic": (glafic.read, "a.input"),
    "lenstool": (lenstool.read, "a.par"),
    "strong.toml": (config.read, "strong.toml"),
    "images": (io.read_images, "images.csv"),
    "members": (io.read_members, "members.csv"),
    "lens": (io.read_lens, "model.toml"),
}


@pytest.mark.parametrize(("read", "name"), READERS.values(), ids=list(READERS))
def test_files_that_are_no_text(read: Any, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    refused(read, path, "does not exist")
    path.write_bytes("first line\nAbell 2744, \xe9toile\n".encode("latin-1"))
    refused(read, path, "not a text file in UTF-8: byte 0xe9 on line 2")
    with path.open("wb") as file:
        file.truncate(200_000_000)  # sparse: takes no room
    start = time.process_time()
    refused(read, path, "has 200 MB; a text file of at most 50 MB is read")
    assert time.process_time() - start < 0.5
    path.unlink()
    path.mkdir()
    refused(read, path, "is a directory")


def test_line_ends_and_byte_order_mark_of_other_systems(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbfomega 0.3\r\n\r\nlambda 0.7 # comment\r\n")
    assert _text.lines_of_words(tmp_path / "a.txt") == [(1, ["omega", "0.3"]), (3, ["lambda", "0.7"])]


HEAD = "system,image_id,x_arcsec,y_arcsec,sigma_arcsec,z_spec\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEAD + "1,1.1,nan,1,0.1,2\n1,1.2,2,2,0.1,2\n", "line 2, column `y_arcsec`: '1' stands alone"),
        (HEAD + "1,1.1,inf,1,0.1,2\n1,1.2,2,2,0.1,2\n", "column `x_arcsec`: 'inf' is not finite"),
        (HEAD + "1,1.1,1,1,0.1,2\n", "has this single image"),
        (HEAD + "1,1.1,1,1,-0.1,2\n1,1.2,2,2,0.1,2\n", "'-0.1' is not an error"),
        (HEAD, "no row below them"),
        (
            "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: x_arcsec, unit: furlong, datatype: float64}\n"
            "# delimiter: ','\n" + HEAD + "1,1.1,1,1,0.1,2\n1,1.2,2,2,0.1,2\n",
            "the unit 'furlong', which is not convertible",
        ),
    ],
    ids=["NaN", "infinite", "one image", "negative error", "no rows", "unknown unit"],
)
def test_catalogues(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "images.csv").write_text(text)
    refused(io.read_images, tmp_path / "images.csv", said)


@pytest.mark.parametrize("kept", [0, 100, 2880, 10_000])
def test_truncated_maps(kept: int, tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    io.write_map(path, np.ones((64, 64)), Grid((64, 64), 1.0))
    path.write_bytes(path.read_bytes()[:kept])
    refused(io.read_map, path, "is not a whole FITS file")
