"""Catalogues of galaxy shapes and shear maps: what is read, in which frame, and what every refusal says."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from hypothesis import given
from hypothesis import strategies as st
from support import angles

from jaxlens import io
from jaxlens.grid import Grid
from jaxlens.io._shear import to_frame

SHEAR = """\
x_arcsec,y_arcsec,g1,g2,weight,z_phot,member,use
1.0,2.0,0.1,-0.2,1.5,0.9,0,1
-3.0,4.5,0.3,0.05,2.0,,1,1
5.0,-6.0,,,1.0,0.2,0,0
"""
REFERENCE = (342.18322, -44.530889)


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str, name: str = "shear.csv") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def says(error: pytest.ExceptionInfo[BaseException], *parts: str) -> None:
    for part in parts:
        assert part in str(error.value), f"{part!r} is not in: {error.value}"


def degrees(places: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(places.ra.deg), np.asarray(places.dec.deg)


def fits_table(path: Path, **columns: Any) -> Path:
    Table(columns).write(path, format="fits")
    return path


# --- catalogues ----------------------------------------------------------------------------------


def test_a_catalogue_is_read(write):
    found = io.read_shear(write(SHEAR))
    np.testing.assert_array_equal(found.theta, [[1.0, 2.0], [-3.0, 4.5], [5.0, -6.0]])
    np.testing.assert_array_equal(found.eps[:2], [0.1 - 0.2j, 0.3 + 0.05j])
    assert np.isnan(found.eps[2])
    np.testing.assert_array_equal(found.weight, [1.5, 2.0, 1.0])
    np.testing.assert_array_equal(found.z, [0.9, np.nan, 0.2])
    assert found.member.tolist() == [False, True, False]
    assert found.use.tolist() == [True, True, False]
    assert np.isnan(found.sigma).all() and np.isnan(found.z_lo).all()


def test_without_weights_flags_and_redshifts_all_galaxies_count_alike(write):
    found = io.read_shear(write("x_arcsec,y_arcsec,e1,e2,sigma\n0,1,0.1,0.2,0.05\n"), responsivity=0.5)
    np.testing.assert_array_equal(found.eps, [0.2 + 0.4j])
    np.testing.assert_array_equal(found.sigma, [0.1])
    assert (found.weight.tolist(), found.use.tolist(), found.member.tolist()) == ([1.0], [True], [False])


def test_ecsv_and_fits_hold_the_same_as_csv(tmp_path: Path, write):
    csv = io.read_shear(write(SHEAR))
    columns = {
        "x_arcsec": csv.theta[:, 0],
        "y_arcsec": csv.theta[:, 1],
        "g1": np.real(csv.eps),
        "g2": np.imag(csv.eps),
        "weight": csv.weight,
        "z_phot": csv.z,
        "member": csv.member,
        "use": csv.use,
    }
    io.write_table(tmp_path / "shear.ecsv", columns)
    table = Table(columns)
    table["y_arcsec"] = (csv.theta[:, 1] / 60.0) * u.arcmin  # converted by its unit
    table["psf"] = np.zeros((3, 2))  # a column of vectors is left alone
    table.write(tmp_path / "shear.fits")
    for name, rtol in (("shear.ecsv", 0.0), ("shear.fits", 1e-15)):
        found = io.read_shear(tmp_path / name)
        for field in ("theta", "eps", "weight", "z", "member", "use"):
            np.testing.assert_allclose(getattr(found, field), getattr(csv, field), rtol=rtol, err_msg=name)


def test_columns_of_another_name_are_found(write):
    text = SHEAR.replace("g1,g2", "e1_corr,e2_corr").replace("weight", "w_lens")
    names = {"g1": "e1_corr", "g2": "e2_corr", "weight": "w_lens"}
    found = io.read_shear(write(text), rename=names)
    np.testing.assert_array_equal(found.eps[0], 0.1 - 0.2j)
    np.testing.assert_array_equal(found.weight, [1.5, 2.0, 1.0])
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_shear(write(SHEAR), rename={"g1": "e1_corr"})
    says(error, "no column `e1_corr`, which should be `g1`", "`x_arcsec`", "Correct the name")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (SHEAR.replace("0.3,", "twelve,"), ["line 3, column `g1`: 'twelve'", "a plain number"]),
        (SHEAR.replace("0.3,", ","), ["line 3, column `g1`: ''", "set `use` to 0"]),
        (SHEAR.replace("0.05,", "nan,"), ["line 3, column `g2`: 'nan'", "set `use` to 0"]),
        (SHEAR.replace("0.05,", "-2e3,"), ["line 3, column `g2`: '-2e3'", "more than 1000", "drop the row"]),
        (SHEAR.replace("0.05,", "inf,"), ["line 3, column `g2`: 'inf'", "not finite"]),
        (SHEAR.replace("g2", "shape"), ["has a column `g1` but no `g2`", "add it"]),
        (SHEAR.replace("g1,g2", "a,b"), ["has no shapes", "`e1` and `e2`", "`columns` under [shear]"]),
        (SHEAR.replace("weight,z_phot", "e1,e2"), ["both `g1, g2` and `e1, e2`", "drop one pair"]),
        (SHEAR.replace("2.0,,1", "-2.0,,1"), ["line 3, column `weight`: '-2.0'", "0 or a positive"]),
        (SHEAR.replace("weight", "sigma").replace("1.5,", "0,"), ["column `sigma`: '0'", "positive number"]),
        (SHEAR.replace("0.9,", "-0.9,"), ["line 2, column `z_phot`: '-0.9'", "leave the cell empty"]),
        (SHEAR.replace("0.9,0", "0.9,x"), ["line 2, column `member`: 'x'", "1 or 0"]),
        (SHEAR.replace("1.0,2.0", ",2.0"), ["line 2, column `y_arcsec`: '2.0'", "give `x_arcsec`"]),
        ("x_arcsec,y_arcsec,g1,g2\n", ["no row"]),
    ],
)
def test_a_catalogue_that_cannot_be_used_is_refused(write, text: str, parts: list[str]):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_shear(write(text))
    says(error, "shear.csv", *parts)


def test_a_fits_table_is_refused_by_its_row(tmp_path: Path):
    path = fits_table(
        tmp_path / "a.fits", x_arcsec=[0.0, 1.0], y_arcsec=[0.0, 1.0], g1=[0.1, 5e3], g2=[0.0, 0.0]
    )
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_shear(path)
    says(error, "a.fits, row 2, column `g1`: '5000.0'", "no ellipticity")
    path = fits_table(tmp_path / "b.fits", ra_deg=[10.0], dec_deg=[0.0], g1=[0.1], g2=[0.0])
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_shear(path)
    says(error, "b.fits, row 1: RA and Dec but no x and y", "weak.toml")


def test_files_that_are_no_whole_fits_tables_are_refused(tmp_path: Path):
    n = 4000
    path = fits_table(
        tmp_path / "a.fits", **{name: np.zeros(n) for name in ("x_arcsec", "y_arcsec", "g1", "g2")}
    )
    whole = path.read_bytes()
    for size in (len(whole) // 2, 3000):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"a\.fits (is not a whole FITS file|holds no table)"):
            io.read_shear(path)
    path.write_text("no")
    with pytest.raises(ValueError, match=r"a\.fits is not a whole FITS file"):
        io.read_shear(path)
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    with pytest.raises(ValueError, match=r"image\.fits holds no table; give a FITS file with a table"):
        io.read_shear(tmp_path / "image.fits")
    with pytest.raises(FileNotFoundError, match=r"none\.fits does not exist"):
        io.read_shear(tmp_path / "none.fits")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"axis": "up"}, "`axis` is 'up'; choose one of west, east, north"),
        ({"x_axis": "north"}, "`x_axis` is 'north'; choose west or east"),
        ({"meridian": "galactic"}, "`meridian` is 'galactic'; choose plane or local"),
        ({"meridian": "local"}, r"need a column `ra_deg` and a reference point; add them, or use plane"),
        ({"responsivity": 0.0}, r"`responsivity` is 0\.0; give a positive number"),
    ],
)
def test_options_that_mean_nothing_are_refused(write, options: Any, match: str):
    read: Any = io.read_shear
    with pytest.raises(ValueError, match=match):
        read(write(SHEAR), **options)


# --- frames --------------------------------------------------------------------------------------


@given(pa=angles(), size=st.floats(0.0, 0.9))
def test_one_ellipse_in_three_conventions(pa: float, size: float):
    """An ellipse whose long axis lies at position angle `pa` from North through East."""
    # In (West, North) North is at 90 degrees and East at 180: phi = 90 degrees + pa.
    ours = size * np.exp(2j * (0.5 * np.pi + pa))
    from_north = size * np.exp(2j * pa)
    from_east = size * np.exp(2j * (0.5 * np.pi - pa))
    for axis, given_as in (("west", ours), ("east", from_east), ("north", from_north)):
        found = to_frame(np.array([given_as]), axis)
        np.testing.assert_allclose(found, ours, atol=1e-14)


def test_x_towards_east_is_turned(write):
    found = io.read_shear(write(SHEAR), axis="east", x_axis="east")
    np.testing.assert_array_equal(found.theta[0], [-1.0, 2.0])
    np.testing.assert_array_equal(found.eps[0], 0.1 + 0.2j)


@pytest.mark.parametrize(
    "reference", [REFERENCE, (0.05, 20.0), (359.98, -30.0), (120.0, 89.9), (10.0, -89.95)]
)
def test_ra_and_dec_are_projected_across_zero_and_near_a_pole(write, reference: tuple[float, float]):
    origin: Any = SkyCoord(*reference, unit="deg")
    pa, r = np.array([0.0, 90.0, 200.0, 300.0]), np.array([600.0, 400.0, 300.0, 900.0])
    places = origin.directional_offset_by(pa * u.deg, r * u.arcsec)
    lines = [f"{float(c.ra.deg)},{float(c.dec.deg)},0.1,0.0" for c in places]
    found = io.read_shear(write("\n".join(["ra_deg,dec_deg,g1,g2", *lines])), reference)
    # Gnomonic: the distance is the tangent of the arc, the direction its position angle from North to East.
    radius = np.tan(np.deg2rad(r / 3600.0)) * np.rad2deg(1.0) * 3600.0
    expected = radius[:, None] * np.stack([-np.sin(np.deg2rad(pa)), np.cos(np.deg2rad(pa))], axis=1)
    np.testing.assert_allclose(found.theta, expected, atol=2e-6)


@pytest.mark.parametrize("reference", [(150.0, 2.0), (0.02, 89.5), (200.0, -88.0)])
def test_local_meridians_are_turned_to_the_plane(write, reference: tuple[float, float]):
    """A short step to local North, projected, gives the direction by which shapes must turn."""
    rng = np.random.default_rng(0)
    origin = SkyCoord(*reference, unit="deg")
    places = origin.directional_offset_by(
        rng.uniform(0, 360, 5) * u.deg, rng.uniform(100, 1500, 5) * u.arcsec
    )
    ra, dec = degrees(places)
    step = places.directional_offset_by(0.0 * u.deg, 0.1 * u.arcsec)
    along = io.offsets(*degrees(step), reference) - io.offsets(ra, dec, reference)
    phi = np.arctan2(along[:, 1], along[:, 0])  # direction of local North from +theta_1
    lines = [f"{a},{d},-0.3,0.0" for a, d in zip(ra.tolist(), dec.tolist(), strict=True)]
    found = io.read_shear(write("\n".join(["ra_deg,dec_deg,g1,g2", *lines])), reference, meridian="local")
    # e_1 < 0 is elongated along local North.
    np.testing.assert_allclose(found.eps, 0.3 * np.exp(2j * phi), atol=2e-6)
    if abs(reference[1]) < 10.0:
        np.testing.assert_allclose(found.eps, -0.3, atol=1e-3)


def test_a_position_on_the_other_side_of_the_sky_is_refused(write):
    ra, dec = (REFERENCE[0] + 180.0) % 360.0, -REFERENCE[1]
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_shear(write(f"ra_deg,dec_deg,g1,g2\n{ra},{dec},0.1,0.1\n"), REFERENCE)
    says(error, "line 2, column `ra_deg`", "more than a degree from the reference point")


# --- positions of lenses -------------------------------------------------------------------------


def test_places_are_read(write):
    found = io.read_places(write("xray_id,x_arcsec,y_arcsec,z\n57,1,2,0.36\n59,3,4,\n"), name="xray_id")
    np.testing.assert_array_equal(found.theta, [[1.0, 2.0], [3.0, 4.0]])
    assert found.ids == ("57", "59")
    np.testing.assert_array_equal(found.z, [0.36, np.nan])


# --- maps ----------------------------------------------------------------------------------------

GRID = Grid(shape=(3, 4), pixel=15.0, centre=(10.0, -5.0))


def layers(**change: Any) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    found = {
        "G1": rng.normal(size=GRID.shape),
        "G2": rng.normal(size=GRID.shape),
        "WEIGHT": np.arange(12.0).reshape(3, 4),
        "N_GAL": np.arange(12).reshape(3, 4),
    }
    return {name: values for name, values in {**found, **change}.items() if values is not None}


def test_a_shear_map_reads_back(tmp_path: Path):
    here = layers()
    g = here["G1"] + 1j * here["G2"]
    path = tmp_path / "shear.fits"
    io.write_shear_map(
        path, g, here["WEIGHT"], here["N_GAL"], GRID, header={"ZLENS": 0.3}, reference=REFERENCE
    )
    back = io.read_shear_map(path)
    np.testing.assert_array_equal(back.g, g)
    np.testing.assert_array_equal(back.weight, here["WEIGHT"])
    np.testing.assert_array_equal(back.n_gal, here["N_GAL"])
    assert (back.grid, back.reference, back.header) == (GRID, REFERENCE, {"ZLENS": 0.3})
    np.testing.assert_array_equal(io.read_shear_map(path, axis="east").g, np.conj(g))


def test_pixels_without_shear_have_no_weight(tmp_path: Path):
    here = layers(WEIGHT=None, N_GAL=None)
    here["G2"][1, 2] = np.nan
    io.write_cube(tmp_path / "s.fits", here, GRID)
    back = io.read_shear_map(tmp_path / "s.fits")
    assert back.g[1, 2] == back.weight[1, 2] == back.n_gal[1, 2] == 0
    assert back.weight.sum() == back.n_gal.sum() == 11
    assert back.reference is None


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"G2": None}, r"has no image G2; it has G1, WEIGHT, N_GAL. Name the extensions \(EXTNAME\) G1, G2"),
        ({"WEIGHT": np.full((3, 4), -1.0)}, r"image WEIGHT, pixel \[0, 0\]: -1 is negative"),
        (
            {"G1": np.full((3, 4), 2e3)},
            r"image G1, G2, pixel \[0, 0\]: .* more than 1000; set such",
        ),
        ({"WEIGHT": np.zeros((3, 4))}, "no pixel has both a finite shear and a positive weight"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused(tmp_path: Path, change: dict[str, Any], match: str):
    io.write_cube(tmp_path / "s.fits", layers(**change), GRID)
    with pytest.raises(ValueError, match=match):
        io.read_shear_map(tmp_path / "s.fits")


def test_a_truncated_map_is_refused(tmp_path: Path):
    path = tmp_path / "s.fits"
    grid = Grid((60, 60), 1.0)
    io.write_cube(path, {name: np.zeros(grid.shape) for name in ("G1", "G2")}, grid)
    path.write_bytes(path.read_bytes()[:-9000])
    with pytest.raises(ValueError, match=r"s\.fits is not a whole FITS file .* copy it again"):
        io.read_shear_map(path)
    with pytest.raises(ValueError, match=r"`G1` has shape \(2, 2\) but `grid.shape` is \(60, 60\)"):
        io.write_cube(path, {"G1": np.zeros((2, 2))}, grid)
