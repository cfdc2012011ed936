"""Weak-lensing input that is wrong: refused with exit code 2 and nothing written, or handled right."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from jaxlens import cli, io, workflow_weak
from jaxlens.grid import Grid

CONFIG = """\
name = "test"
z_l = 0.3
ra_deg = 10.0
dec_deg = -5.0

[shear]
file = "shear.csv"

[select]
z_margin = 0.0

[depth]
z_s = 1.5
per_galaxy = true
"""

SHEAR = """\
x_arcsec,y_arcsec,g1,g2,z_phot,use
10.0,20.0,0.1,-0.2,0.9,1
-30.0,45.0,0.3,0.05,0.8,1
50.0,-60.0,0.2,0.1,0.7,1
"""

# Name: file, what to replace, by what, what the message says.
MISTAKES: dict[str, tuple[str, str, str, str]] = {
    "|g| > 1000": ("shear.csv", "0.1,-0.2", "2000,-0.2", "line 2, column `g1`: '2000' is no ellipticity"),
    "NaN": ("shear.csv", "0.1,-0.2", "nan,-0.2", "line 2, column `g1`: 'nan' is no shape"),
    "nothing of use": ("shear.csv", ",1\n", ",0\n", "leaves no galaxy of shear.csv (all: 3, use: 0"),
    "weights of 0": ("shear.csv", ",z_phot,use\n", ",weight,use\n", "correct the weights"),
    "no shapes": ("shear.csv", ",g1,g2", ",a,b", "shear.csv has no shapes; give columns `g1` and `g2`"),
    "half a shape": ("shear.csv", ",g1,g2", ",a,g2", "has a column `g2` but no `g1`; add it"),
    "no position": ("shear.csv", "x_arcsec,", "x_pixel,", "stands alone; give `x_arcsec` as well"),
    "half a position": ("shear.csv", "-30.0,45.0", ",45.0", "line 3, column `y_arcsec`: '45.0' stands alone"),
    "empty": ("shear.csv", SHEAR.split("\n", 1)[1], "", "no row below them"),
    "sources before the lens": ("weak.toml", "z_s = 1.5", "z_s = 0.3", "z_s = 0.3 is not behind the lens"),
    "all in front": ("weak.toml", "z_margin = 0.0", "", "lies in front of the lens (z_phot <= z_l = 0.95)"),
    "no catalogue": ("weak.toml", '"shear.csv"', '"shapes.csv"', "shapes.csv does not exist"),
}


def refused(source: Path, said: str) -> None:
    """`jaxlens weak` says what is wrong, and leaves no file behind."""
    before = sorted(source.parent.rglob("*"))
    command = ["weak", str(source), "--out", str(source.parent / "out"), "--no-cache"]
    result = CliRunner().invoke(cli.app, command, env={"COLUMNS": "400", "NO_COLOR": "1"})
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error:") and "Traceback" not in result.stderr
    assert said in result.stderr and str(source.parent) in result.stderr
    assert sorted(source.parent.rglob("*")) == before


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "weak.toml").write_text(CONFIG, encoding="utf-8")
    (tmp_path / "shear.csv").write_text(SHEAR, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=list(MISTAKES))
def test_catalogues_and_configurations(mistake: tuple[str, str, str, str], folder: Path):
    name, old, new, said = mistake
    text = (folder / name).read_text(encoding="utf-8")
    assert old in text
    text = text.replace(old, new)
    if said == "correct the weights":
        text = "\n".join(line.replace(",0.9,", ",0,").replace(",0.8,", ",0,") for line in text.split("\n"))
        text = text.replace(",0.7,", ",0,")
    if "in front" in said:
        text = text.replace("z_l = 0.3", "z_l = 0.95").replace("[select]\n", "[select]\nz_margin = -1.0\n")
    (folder / name).write_text(text, encoding="utf-8")
    refused(folder / "weak.toml", said)


def test_a_catalogue_in_another_encoding(folder: Path):
    (folder / "shear.csv").write_bytes(("# \xe9toile\n" + SHEAR).encode("latin-1"))
    refused(folder / "weak.toml", "not a text file in UTF-8: byte 0xe9 on line 1")


# --- shear maps -------------------------------------------------------------------------------------

GRID = Grid((7, 10), 10.0, (5.0, -3.0))


def shear_map(path: Path, *, g: complex = 0.1 + 0.2j, weight: float = 1.0) -> Path:
    """A uniform map with one pixel, row 2 and column 3, of its own."""
    values, weights = np.full(GRID.shape, 0.1 + 0.2j), np.full(GRID.shape, weight)
    values[2, 3] = g
    io.write_shear_map(path, values, weights, np.ones(GRID.shape, int), GRID)
    return path


@pytest.mark.parametrize("kept", [0, 100, 2880, 9000])
def test_truncated_maps(kept: int, tmp_path: Path):
    path = shear_map(tmp_path / "a.fits")
    path.write_bytes(path.read_bytes()[:kept])
    # The first image alone is a whole file, but no shear map.
    refused(path, "a.fits")


def test_maps_that_are_all_masked_or_no_shear(tmp_path: Path):
    refused(shear_map(tmp_path / "a.fits", weight=0.0), "nothing to map")
    refused(shear_map(tmp_path / "b.fits", g=2e3 + 0j), "pixel [2, 3]: 2000+0j |g| is more than 1000")
    refused(shear_map(tmp_path / "c.fits", weight=-1.0), "pixel [0, 0]: -1 is negative")
    io.write_map(tmp_path / "d.fits", np.ones(GRID.shape), GRID)
    refused(tmp_path / "d.fits", "G1")
    (tmp_path / "e.fits").write_bytes("\xe9toile, no FITS".encode("latin-1"))
    refused(tmp_path / "e.fits", "is not a whole FITS file")


def test_a_pixel_that_is_not_a_number_is_masked(tmp_path: Path):
    """The map is 7 x 10 pixels: odd, not square."""
    found = workflow_weak.field(str(shear_map(tmp_path / "a.fits", g=complex(np.nan, 0.1))))
    assert found.grid == GRID and found.shear.g.shape == (7, 10)
    assert found.shear.weight[2, 3] == 0.0 and found.shear.g[2, 3] == 0.0
    assert int((np.asarray(found.shear.weight) > 0.0).sum()) == 69


# --- the sphere -------------------------------------------------------------------------------------


def on_the_sphere(ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
    """Unit vectors `(n, 3)` of degrees."""
    a, d = np.deg2rad(ra), np.deg2rad(dec)
    return np.stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)], axis=-1)


@pytest.mark.parametrize(
    ("reference", "ra"),
    [((0.001, -5.0), (359.99, 0.01, 0.002)), ((10.0, 89.99), (190.0, 100.0, 10.0))],
    ids=["across 0/360", "near the pole"],
)
def test_positions_where_right_ascension_is_awkward(
    reference: tuple[float, float], ra: tuple[float, ...], folder: Path
):
    dec = reference[1] + np.array([0.004, -0.003, 0.002])
    rows = [f"{a},{d:.6f},0.1,0.05,0.9,1" for a, d in zip(ra, dec, strict=True)]
    text = "\n".join(["ra_deg,dec_deg,g1,g2,z_phot,use", *rows, ""])
    (folder / "shear.csv").write_text(text, encoding="utf-8")
    config = CONFIG.replace("ra_deg = 10.0", f"ra_deg = {reference[0]}")
    (folder / "weak.toml").write_text(config.replace("dec_deg = -5.0", f"dec_deg = {reference[1]}"))
    theta = np.asarray(workflow_weak.load(str(folder)).galaxies.theta)
    # The gnomonic projection keeps the tangent of the distance from the reference point.
    cosine = on_the_sphere(np.array(ra), dec) @ on_the_sphere(*(np.array(part) for part in reference))
    expected = np.rad2deg(np.sqrt(1.0 / cosine**2 - 1.0)) * 3600.0
    np.testing.assert_allclose(np.hypot(*theta.T), expected, rtol=1e-5)
    assert np.abs(theta).max() < 200.0
    if reference[1] < 0.0:
        assert theta[0, 0] > 0.0 > theta[1, 0]  # 359.99 lies West of 0.001, 0.01 East
