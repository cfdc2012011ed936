"""Files in and out: what is read, what every refusal says, and that writing is all or nothing."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.wcs import WCS

from jaxlens import io
from jaxlens.grid import Grid

REFERENCE = (342.18322, -44.530889)

IMAGES = """\
system,image_id,x_arcsec,y_arcsec,sigma_arcsec,z_spec
1,1.1,-28.9,14.0,0.5,1.2279
2,2.1,-24.3,-0.9,0.4,
1,1.10,-32.5,6.9,0.5,1.2279
2,2.2,-23.0,3.4,0.3,
"""

MEMBERS = """\
member_id,x_arcsec,y_arcsec,a_arcsec,b_arcsec,theta_deg,mag,bcg
g7,1.0,2.0,2.0,1.5,30.0,19.0,1
g8,-3.0,4.5,1.0,1.0,-60.0,21.5,0
"""


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str, name: str = "table.csv") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def says(error: pytest.ExceptionInfo[BaseException], *parts: str) -> None:
    for part in parts:
        assert part in str(error.value), f"{part!r} is not in: {error.value}"


# --- tables --------------------------------------------------------------------------------------


def test_read_table_takes_comments_blank_lines_and_text_as_it_stands(write):
    path = write('\ufeff\n# made by hand\nname, x_arcsec, note\n1.10, 1.5,\n\n# two\n1.1,-2e1,"a, b"\n')
    rows = io.read_table(
        path, ("x_arcsec",), ("name", "note", "absent"), text=("name", "note"), empty=("note",)
    )
    assert rows["name"].tolist() == ["1.10", "1.1"]
    assert rows["note"].tolist() == ["", "a, b"]
    assert rows["x_arcsec"].tolist() == [1.5, -20.0]
    assert rows.lines.tolist() == [4, 7]
    assert "absent" not in rows and len(rows) == 2


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("id,y\n1,2\n", ["no column `x_arcsec`", "`id`, `y`", "Add the column"]),
        ("id;x_arcsec\n1;2\n", ["no column `id`, `x_arcsec`", "`id;x_arcsec`", "separated by commas"]),
        ("id,x_arcsec\n", ["no row", "at least one"]),
        ("", ["is empty", "first line must name the columns"]),
        ("# only a comment\n", ["is empty"]),
        ("id,x_arcsec,id\n1,2,3\n", ["line 1", "`id` is named twice", "rename"]),
        ("#\nid,x_arcsec\n1,2\n2,3,4\n", ["line 4", "3 cells", "2 columns", "'2,3,4'", "commas"]),
        ("id,x_arcsec\n1,2\n\n2,twelve\n", ["line 4, column `x_arcsec`: 'twelve'", "number in arcsec"]),
        ("id,x_arcsec\n1,2\n2,nan\n", ["line 3, column `x_arcsec`: 'nan'", "give a number, or drop the row"]),
        ("id,x_arcsec\n1,\n", ["line 2, column `x_arcsec`: ''", "give a number, or drop the row"]),
        ("id,x_arcsec\n1,inf\n", ["line 2, column `x_arcsec`: 'inf'", "not finite"]),
        ("id,x_arcsec\n1,2\n 1,3\n", ["line 3, column `id`: '1'", "already on line 2", "name of its own"]),
        ("id,x_arcsec\n,2\n", ["line 2, column `id`: ''", "is empty"]),
    ],
)
def test_read_table_refuses(write, text: str, parts: list[str]):
    path = write(text)
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_table(path, ("id", "x_arcsec"), text=("id",), unique=("id",))
    says(error, str(path), *parts)


def test_read_table_without_a_file_or_with_a_binary_one(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.csv does not exist; check the name"):
        io.read_table(tmp_path / "nowhere.csv", ("x",))
    (tmp_path / "image.csv").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"not a text file.*UTF-8"):
        io.read_table(tmp_path / "image.csv", ("x",))


@pytest.mark.parametrize("delimiter", [" ", ","])
def test_read_table_converts_the_units_of_ecsv(tmp_path: Path, delimiter: str):
    path = tmp_path / "t.ecsv"
    table = QTable(
        {"name": ["a b", "c"], "x_arcsec": [0.5, -1.0] * u.arcmin, "z": [1.0, 2.0]}, meta={"origin": "us"}
    )
    table.write(path, format="ascii.ecsv", delimiter=delimiter)
    rows = io.read_table(path, ("x_arcsec", "z"), ("name",), text=("name",))
    np.testing.assert_allclose(rows["x_arcsec"], [30.0, -60.0], rtol=1e-14)
    assert rows["name"].tolist() == ["a b", "c"]
    assert rows.meta == {"origin": "us"}
    content = path.read_text(encoding="utf-8").splitlines()
    assert [content[line - 1].split(delimiter)[-1] for line in rows.lines] == ["1.0", "2.0"]


@pytest.mark.parametrize(
    ("name", "unit", "parts"),
    [
        ("x_arcsec", "Mpc", ["column `x_arcsec`", "'Mpc'", "not convertible to the arcsec", "Correct"]),
        ("z_spec", "km / s", ["column `z_spec`", "'km / s'", "has none", "Remove the unit"]),
        ("x_arcsec", "furlong", ["column `x_arcsec`", "'furlong'", "not convertible"]),
    ],
)
def test_read_table_refuses_a_unit_that_belies_the_name(write, name: str, unit: str, parts: list[str]):
    head = "# %ECSV 1.0\n# ---\n# datatype:\n"
    path = write(f"{head}# - {{name: {name}, unit: {unit}, datatype: float64}}\n{name}\n1.0\n")
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_table(path, (name,))
    says(error, str(path), *parts)


def test_a_broken_ecsv_header_is_named(write):
    path = write("# %ECSV 1.0\n# ---\n# datatype: {[\nx\n1\n")
    with pytest.raises(ValueError, match=r"table\.csv: the ECSV header cannot be read"):
        io.read_table(path, ("x",))


# --- catalogues ----------------------------------------------------------------------------------


def test_read_images_sorts_by_system_in_order_of_appearance(write):
    images = io.read_images(write(IMAGES.replace("\n2,", "\nb,").replace("\n1,", "\na,")))
    assert images.systems == ("a", "b")
    assert images.image_ids == ("1.1", "1.10", "2.1", "2.2")
    np.testing.assert_array_equal(images.theta, [[-28.9, 14.0], [-32.5, 6.9], [-24.3, -0.9], [-23.0, 3.4]])
    np.testing.assert_array_equal(images.source, [0, 0, 1, 1])
    np.testing.assert_array_equal(images.sigma_pos, [0.5, 0.5, 0.4, 0.3])
    np.testing.assert_array_equal(images.z_s, [1.2279, np.nan])


def test_read_images_fills_errors_and_shares_redshifts(write):
    path = write(IMAGES.replace(",0.5,1.2279\n2", ",,\n2", 1))
    images = io.read_images(path, default_sigma=0.7)
    np.testing.assert_array_equal(images.sigma_pos, [0.7, 0.5, 0.4, 0.3])
    np.testing.assert_array_equal(images.z_s, [1.2279, np.nan])


def test_read_images_can_leave_systems_out(write):
    images = io.read_images(write(IMAGES), exclude=("1",))
    assert images.systems == ("2",)
    np.testing.assert_array_equal(images.source, [0, 0])


def projected(ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
    """theta by astropy's own tangent projection."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], REFERENCE
    wcs.wcs.cdelt, wcs.wcs.crpix = [-1.0 / 3600.0, 1.0 / 3600.0], [0.0, 0.0]
    at: Any = wcs.wcs_world2pix(ra, dec, 1)
    return np.stack(at, axis=1)


def test_positions_on_the_sky_are_those_of_astropy():
    rng = np.random.default_rng(1)
    ra = REFERENCE[0] + rng.uniform(-0.1, 0.1, 20)
    dec = REFERENCE[1] + rng.uniform(-0.1, 0.1, 20)
    theta = io.offsets(ra, dec, REFERENCE)
    np.testing.assert_allclose(theta, projected(ra, dec), atol=1e-8)
    np.testing.assert_allclose(io.sky(theta, REFERENCE), [ra, dec], rtol=1e-13)


def test_sky_near_the_pole_and_across_zero_hours():
    for reference in ((0.001, 10.0), (359.999, -70.0), (12.0, 90.0)):
        theta = np.array([[30.0, -20.0], [-400.0, 5.0]])
        ra, dec = io.sky(theta, reference)
        assert np.all((ra >= 0.0) & (ra < 360.0))
        np.testing.assert_allclose(io.offsets(ra, dec, reference), theta, atol=1e-8)


def test_x_is_positive_towards_the_west():
    origin = SkyCoord(*REFERENCE, unit="deg")
    moved: Any = origin.directional_offset_by([270.0, 0.0] * u.deg, 10.0 * u.arcsec)
    ra, dec = moved.ra.deg, moved.dec.deg
    np.testing.assert_allclose(io.offsets(ra, dec, REFERENCE), [[10.0, 0.0], [0.0, 10.0]], atol=1e-3)


def test_read_images_projects_where_x_and_y_are_missing(write):
    text = "system,image_id,ra_deg,dec_deg,x_arcsec,y_arcsec\n"
    text += "1,a,342.19,-44.53,1.0,2.0\n1,b,342.19,-44.53,,\n"
    images = io.read_images(write(text), REFERENCE, 0.5)
    np.testing.assert_array_equal(images.theta[0], [1.0, 2.0])
    expected = projected(np.array([342.19]), np.array([-44.53]))[0]
    np.testing.assert_allclose(images.theta[1], expected, atol=1e-8)
    assert images.theta[1, 0] < 0.0  # larger RA: to the East


@pytest.mark.parametrize(
    ("old", "new", "options", "parts"),
    [
        ("1,1.10,", "1,1.1,", {}, ["line 4, column `image_id`: '1.1'", "already on line 2"]),
        (
            "0.5,1.2279\n2,2.2",
            "0.5,1.3\n2,2.2",
            {},
            ["line 4, column `z_spec`: '1.3'", "1.2279 on line 2", "'1'"],
        ),
        ("2,2.2,-23.0", "3,2.2,-23.0", {}, ["line 3, column `system`: '2'", "single image", "drop the row"]),
        ("0.4,\n", ",\n", {}, ["line 3: image '2.1' has no position error", "[images] in strong.toml"]),
        ("0.4,\n", "-0.4,\n", {}, ["line 3, column `sigma_arcsec`: '-0.4'", "positive"]),
        ("0.4,\n", "0.4,0\n", {}, ["line 3, column `z_spec`: '0'", "leave the cell empty"]),
        ("2,2.1", "2,2.1", {"z_l": 1.5}, ["line 2, column `z_spec`: '1.2279'", "behind the lens (z = 1.5)"]),
        ("2,2.1", "2,2.1", {"exclude": ("9",)}, ["no system '9'", "1, 2", "`exclude`"]),
        ("2,2.1", "2,2.1", {"exclude": ("1", "2")}, ["leaves no system"]),
        ("-32.5,6.9", "-28.9,14.0", {}, ["line 4, column `image_id`: '1.10'", "image on line 2", "drop one"]),
        ("-32.5,6.9", "-32.5,", {}, ["line 4, column `x_arcsec`: '-32.5'", "give `y_arcsec` as well"]),
        ("-32.5,6.9", ",6.9", {}, ["line 4, column `y_arcsec`: '6.9'", "give `x_arcsec` as well"]),
        ("-32.5,6.9", ",", {}, ["line 4: no position", "`ra_deg` and `dec_deg`"]),
        ("z_spec", "redshift_spec,z_spec", {}, ["cells", "columns"]),
    ],
)
def test_read_images_refuses(write, old: str, new: str, options: dict[str, Any], parts: list[str]):
    assert old in IMAGES
    path = write(IMAGES.replace(old, new))
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_images(path, **options)
    says(error, str(path), *parts)


@pytest.mark.parametrize(
    ("cells", "reference", "parts"),
    [
        ("342.1,-44.5", None, ["line 2: RA and Dec", "no reference point", "strong.toml"]),
        ("342.1,", REFERENCE, ["line 2, column `ra_deg`", "give `dec_deg` as well"]),
        ("342.1,-144.5", REFERENCE, ["line 2, column `dec_deg`: '-144.5'", "between -90 and 90"]),
        ("22.8,-44.5", REFERENCE, ["line 2, column `ra_deg`: '22.8'", "more than a degree", "in degrees?"]),
    ],
)
def test_read_images_refuses_positions_on_the_sky(write, cells: str, reference: Any, parts: list[str]):
    path = write(f"system,image_id,ra_deg,dec_deg\n1,a,{cells}\n1,b,342.2,-44.53\n")
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_images(path, reference, 0.5)
    says(error, str(path), *parts)


def test_read_members(write):
    members = io.read_members(write(MEMBERS), mag_ref=20.0)
    np.testing.assert_array_equal(members.theta, [[1.0, 2.0], [-3.0, 4.5]])
    np.testing.assert_allclose(members.luminosity, [2.51188643150958, 0.251188643150958], rtol=1e-13)
    np.testing.assert_allclose(members.e, [0.25, 0.0], rtol=1e-15)
    np.testing.assert_allclose(members.pa, [np.pi / 6.0, -np.pi / 3.0], rtol=1e-15)
    assert members.bcg.tolist() == [True, False]
    assert members.ids == ("g7", "g8")
    assert members.mag.tolist() == [19.0, 21.5]


def test_read_members_of_few_columns(write):
    text = "member_id,ra_deg,dec_deg,luminosity\n1,342.19,-44.53,2.0\n2,342.18,-44.53,0.5\n"
    members = io.read_members(write(text), reference=REFERENCE)
    np.testing.assert_array_equal(members.luminosity, [2.0, 0.5])
    assert not members.e.any() and not members.pa.any() and not members.bcg.any()
    assert np.isnan(members.mag).all()
    expected = projected(np.array([342.19, 342.18]), np.array([-44.53, -44.53]))
    np.testing.assert_allclose(members.theta, expected, atol=1e-8)


def test_read_members_prefers_luminosity_and_e(write):
    text = "member_id,x_arcsec,y_arcsec,a_arcsec,b_arcsec,e,theta_deg,mag,luminosity\n1,0,0,2,1,0.1,0,20,3\n"
    members = io.read_members(write(text))
    assert (members.luminosity[0], members.e[0], members.mag[0]) == (3.0, 0.1, 20.0)


@pytest.mark.parametrize(
    ("old", "new", "mag_ref", "parts"),
    [
        ("g8", "g7", 20.0, ["line 3, column `member_id`: 'g7'", "already on line 2"]),
        ("mag", "mag", None, ["reference galaxy", "`mag_ref`", "`luminosity`"]),
        ("mag", "magnitude", 20.0, ["neither a column `luminosity` (L/L_ref) nor `mag`"]),
        ("mag", "luminosity", None, []),
        ("19.0,1", "19.0,2", 20.0, ["line 2, column `bcg`: '2'", "1 or 0"]),
        (
            "2.0,1.5,",
            "1.5,2.0,",
            20.0,
            ["line 2, column `a_arcsec`: '1.5'", "smaller than `b_arcsec`", "by 90"],
        ),
        ("2.0,1.5,", "2.0,0.0,", 20.0, ["line 2, column `b_arcsec`: '0.0'", "positive"]),
        ("b_arcsec", "minor", 20.0, ["`a_arcsec` alone", "needs `a_arcsec` and `b_arcsec`"]),
        ("a_arcsec,b_arcsec", "e,b", 20.0, ["line 2, column `e`: '2.0'", "1 - b/a"]),
        ("theta_deg", "angle", 20.0, ["no column `theta_deg`", "West through North"]),
    ],
)
def test_read_members_refuses(write, old: str, new: str, mag_ref: float | None, parts: list[str]):
    path = write(MEMBERS.replace(old, new))
    if not parts:
        io.read_members(path, mag_ref=mag_ref)
        return
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_members(path, mag_ref=mag_ref)
    says(error, str(path), *parts)


def test_read_members_refuses_a_luminosity_of_nothing(write):
    path = write("member_id,x_arcsec,y_arcsec,luminosity\n1,0,0,0\n")
    with pytest.raises(ValueError, match="line 2, column `luminosity`: '0' is not a luminosity"):
        io.read_members(path)


HALOS = """\
halo_id,profile,x_arcsec,y_arcsec,ellipticity,angle_deg,core_radius_arcsec,cut_radius_arcsec,v_disp_kms,gamma
O1,dPIE_81,1.0,-2.0,0.5,-36.0,20.0,200.0,1200.0,
O2,external_shear,0.0,0.0,,50.0,,,,0.1
77,dPIE_81,3.0,4.0,0.1,10.0,0.05,16.0,130.0,
"""


def test_read_lenstool_halos(write):
    lens = io.read_lenstool_halos(write(HALOS))
    assert {name: len(one) for name, one in lens.components.items()} == {"halo": 1, "shear": 1, "members": 1}
    halo, shear = lens.components["halo"], lens.components["shear"]
    q = np.sqrt(0.5 / 1.5)
    f = np.sqrt(1.0 - ((1.0 - q) / (1.0 + q)) ** 2)
    b = f * 6.0 * np.pi * (1200.0 / 299792.458) ** 2 * 206264.80624709636 * 200.0 / 180.0
    np.testing.assert_allclose(halo.params.b, b, rtol=1e-12)
    np.testing.assert_allclose(halo.params.r_core, 20.0 * f, rtol=1e-12)
    np.testing.assert_allclose(halo.params.e, 1.0 - q, rtol=1e-12)
    np.testing.assert_allclose(halo.pa, np.deg2rad(-36.0))
    np.testing.assert_array_equal(halo.centre, [[1.0, -2.0]])
    np.testing.assert_array_equal(shear.params.gamma, [0.1])
    np.testing.assert_allclose(shear.pa, np.deg2rad(50.0))


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("77,dPIE_81", "77,NFW", ["line 4, column `profile`: 'NFW'", "dPIE_81, external_shear"]),
        ("130.0,", ",", ["line 4, column `v_disp_kms`: ''", "missing for the profile dPIE_81"]),
        (",,,,0.1", ",,,,", ["line 3, column `gamma`: ''", "missing for the profile external_shear"]),
        ("16.0", "0.01", ["line 4, column `cut_radius_arcsec`: '0.01'", "core < cut"]),
    ],
)
def test_read_lenstool_halos_refuses(write, old: str, new: str, parts: list[str]):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_lenstool_halos(write(HALOS.replace(old, new)))
    says(error, *parts)


# --- maps ----------------------------------------------------------------------------------------

GRID = Grid(shape=(7, 5), pixel=2.5, centre=(10.0, -5.0))


def test_a_map_lies_where_astropy_says(tmp_path: Path):
    path = tmp_path / "kappa.fits"
    io.write_map(path, np.zeros(GRID.shape), GRID, reference=REFERENCE)
    wcs = WCS(fits.getheader(path))
    assert wcs.wcs.cdelt[0] < 0.0
    rows, columns = np.indices(GRID.shape)
    ra, dec = wcs.wcs_pix2world(columns.ravel(), rows.ravel(), 0)
    theta = np.asarray(GRID.theta).reshape(-1, 2)
    np.testing.assert_allclose(io.offsets(ra, dec, REFERENCE), theta, atol=1e-8)
    west = SkyCoord(*wcs.wcs_pix2world(2.0, 5.0, 0), unit="deg")  # theta = (10, 0)
    origin = SkyCoord(*REFERENCE, unit="deg")
    assert origin.separation(west).arcsec == pytest.approx(10.0, abs=1e-6)
    assert origin.position_angle(west).deg == pytest.approx(270.0, abs=1e-3)


def test_a_map_without_a_reference_point_has_offsets(tmp_path: Path):
    path = tmp_path / "kappa.fits"
    io.write_map(path, np.zeros(GRID.shape), GRID)
    wcs = WCS(fits.getheader(path))
    x, y = wcs.wcs_pix2world([0, 4], [0, 6], 0)
    np.testing.assert_allclose(x, [5.0, 15.0], atol=1e-10)
    np.testing.assert_allclose(y, [-12.5, 2.5], atol=1e-10)
    assert list(wcs.wcs.cunit) == ["arcsec", "arcsec"]


@pytest.mark.parametrize("reference", [None, REFERENCE])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_map_reads_back(tmp_path: Path, reference: Any, dtype: str):
    values = np.random.default_rng(0).normal(size=GRID.shape)
    values[0, 0], values[1, 1] = np.nan, np.inf
    header = {
        "ZLENS": jnp.asarray(0.3),
        "zsource": (np.float64(2.0), "of the source"),
        "DLSDS": 0.7,
        "BUNIT": "",
    }
    io.write_map(
        tmp_path / "m.fits", jnp.asarray(values), GRID, header=header, reference=reference, dtype=dtype
    )
    back = io.read_map(tmp_path / "m.fits")
    np.testing.assert_array_equal(back.values, values.astype(dtype))
    assert back.values.dtype == np.float64
    assert back.grid == GRID
    assert back.reference == reference
    assert back.header == {"ZLENS": 0.3, "ZSOURCE": 2.0, "DLSDS": 0.7, "BUNIT": ""}
    assert fits.getheader(tmp_path / "m.fits").comments["ZSOURCE"] == "of the source"
    with fits.open(tmp_path / "m.fits") as file:
        file.verify("exception")
        hdu: Any = file[0]
        assert hdu.data.dtype.itemsize == {"float64": 8, "float32": 4}[dtype]


def foreign(path: Path, data: Any = None, **keys: Any) -> Path:
    """A gnomonic map of somebody else, 4 x 6 pixels of 0.5 arcsec."""
    hdu = fits.ImageHDU(np.arange(24.0).reshape(4, 6) if data is None else data)
    card = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRVAL1": 10.0,
        "CRVAL2": 20.0,
        "CRPIX1": 1.0,
        "CRPIX2": 2.0,
    }
    for key, value in {**card, "CD1_1": -0.5 / 3600.0, "CD2_2": 0.5 / 3600.0, **keys}.items():
        hdu.header[key] = value
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    return path


def test_a_map_of_another_program_is_placed_by_its_coordinates(tmp_path: Path):
    back = io.read_map(foreign(tmp_path / "a.fits"))
    assert back.reference == (10.0, 20.0)
    assert back.grid.pixel == pytest.approx(0.5)
    np.testing.assert_allclose(back.grid.x[0], 0.0, atol=1e-12)  # CRPIX1 = 1
    np.testing.assert_allclose(back.grid.y[1], 0.0, atol=1e-12)  # CRPIX2 = 2


@pytest.mark.parametrize(
    ("keys", "parts"),
    [
        ({"CTYPE1": "GLON-CAR"}, ["CTYPE1 is 'GLON-CAR'", "RA---TAN"]),
        ({"CD1_2": 1e-4}, ["turned (CD1_2 = 0.0001)", "North up"]),
        ({"CD1_1": 0.5 / 3600.0}, ["increasing to the West"]),
        ({"CD2_2": 0.6 / 3600.0}, ["square"]),
    ],
)
def test_read_map_refuses_other_coordinates(tmp_path: Path, keys: dict[str, Any], parts: list[str]):
    path = foreign(tmp_path / "a.fits", **keys)
    with pytest.raises(ValueError) as error:  # noqa: PT011
        io.read_map(path)
    says(error, str(path), *parts)


def test_read_map_refuses_what_is_no_map(tmp_path: Path):
    with pytest.raises(ValueError, match=r"cube\.fits holds no two-dimensional image"):
        io.read_map(foreign(tmp_path / "cube.fits", np.zeros((2, 2, 2))))
    (tmp_path / "text.fits").write_text("no")
    with pytest.raises(ValueError, match=r"text\.fits is not a whole FITS file"):
        io.read_map(tmp_path / "text.fits")
    with pytest.raises(FileNotFoundError, match=r"none\.fits does not exist"):
        io.read_map(tmp_path / "none.fits")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"header": {"CRPIX1": 1.0}}, "'CRPIX1' describes the array"),
        ({"header": {"SOURCE_REDSHIFT": 1.0}}, "'SOURCE_REDSHIFT' is not one of FITS"),
        ({"header": {"ZSOURCE": np.inf}}, "'ZSOURCE' has the value inf"),
        ({"header": {"ZSOURCE": [1.0, 2.0]}}, "'ZSOURCE' holds a list"),
        ({"dtype": "int16"}, "`dtype` is 'int16'"),
        ({"values": np.zeros((5, 7))}, r"shape \(5, 7\) but `grid.shape` is \(7, 5\)"),
    ],
)
def test_write_map_refuses(tmp_path: Path, options: dict[str, Any], match: str):
    values = options.pop("values", np.zeros(GRID.shape))
    with pytest.raises(ValueError, match=match):
        io.write_map(tmp_path / "m.fits", values, GRID, **options)
    assert not list(tmp_path.iterdir())


# --- tables, JSON, regions -----------------------------------------------------------------------


def test_a_table_reads_back_bit_for_bit_with_units(tmp_path: Path):
    rng = np.random.default_rng(3)
    columns = {
        "image_id": ["1.1", "1.10", ""],
        "x_arcsec": jnp.asarray(rng.normal(size=3)),
        "mu": np.array([np.nan, -1e300, 0.1]),
        "produced": np.array([True, False, True]),
        "n": np.arange(3),
        "mass": np.ones(3),
    }
    meta = {"rms_arcsec": np.float64(0.4), "seed": jnp.asarray(3), "names": ("a", "b"), "chi2": float("nan")}
    path = tmp_path / "t.ecsv"
    io.write_table(path, columns, units={"mass": "Msun"}, meta=meta, descriptions={"mu": "magnification"})
    table = Table.read(path, format="ascii.ecsv")
    for name in ("x_arcsec", "mu", "produced", "n"):
        np.testing.assert_array_equal(np.asarray(table[name]), np.asarray(columns[name]))
    assert list(table["image_id"].filled("")) == columns["image_id"]
    assert (str(table["x_arcsec"].unit), str(table["mass"].unit), table["mu"].unit) == (
        "arcsec",
        "solMass",
        None,
    )
    assert table["mu"].description == "magnification"
    assert table.meta == {"rms_arcsec": 0.4, "seed": 3, "names": ["a", "b"], "chi2": None}
    rows = io.read_table(
        path, ("x_arcsec",), ("image_id", "mu"), text=("image_id",), empty=("mu", "image_id")
    )
    np.testing.assert_array_equal(rows["x_arcsec"], columns["x_arcsec"])
    np.testing.assert_array_equal(rows["mu"], columns["mu"])
    assert rows["image_id"].tolist() == columns["image_id"]


@pytest.mark.parametrize(
    "columns", [{"a": np.zeros(2), "b": np.zeros(3)}, {"a": np.zeros((2, 2))}, {"a": 1.0}]
)
def test_write_table_refuses_ragged_columns(tmp_path: Path, columns: dict[str, Any]):
    with pytest.raises(ValueError, match=r"one-dimensional and of one length; given \{'a':"):
        io.write_table(tmp_path / "t.ecsv", columns)


class _Start(NamedTuple):
    chi2: float
    converged: bool


def test_json_holds_numbers_of_all_kinds(tmp_path: Path):
    content = {
        "version": "0.1.0",
        "chi2": np.float64(1.0) / 3.0,
        "rms": jnp.asarray(0.1),
        "n": np.int64(3),
        "converged": np.bool_(True),
        "bad": [float("nan"), np.inf, 1.0],
        "matrix": np.arange(4.0).reshape(2, 2),
        "starts": (_Start(1.5, True), _Start(float("inf"), False)),
        "path": Path("a/b"),
        "names": {"b", "a"},
        "nested": {"empty": {}, "none": None, "ö": []},
    }
    io.write_json(tmp_path / "s.json", content)
    text = (tmp_path / "s.json").read_text(encoding="utf-8")
    back = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert list(back) == list(content)
    assert back["chi2"] == 1.0 / 3.0
    assert (back["rms"], back["n"], back["converged"]) == (0.1, 3, True)
    assert back["bad"] == [None, None, 1.0]
    assert back["matrix"] == [[0.0, 1.0], [2.0, 3.0]]
    assert back["starts"] == [{"chi2": 1.5, "converged": True}, {"chi2": None, "converged": False}]
    assert (back["path"], back["names"]) == ("a/b", ["a", "b"])
    assert back["nested"] == {"empty": {}, "none": None, "ö": []}
    assert '  "bad": [null, null, 1.0],\n' in text


def test_json_says_what_it_cannot_hold(tmp_path: Path):
    with pytest.raises(TypeError, match=r"parameters\.O1\[1\] is a complex, which JSON cannot hold"):
        io.write_json(tmp_path / "s.json", {"parameters": {"O1": [1.0, 2j]}})
    with pytest.raises(TypeError, match="The content is a object"):
        io.write_json(tmp_path / "s.json", object())
    assert not list(tmp_path.iterdir())


def shapes(path: Path) -> tuple[list[str], list[tuple[str, np.ndarray, str]]]:
    """Header lines, and (shape, coordinates (m, 2), properties) of a region file."""
    head, found = [], []
    for line in path.read_text(encoding="utf-8").splitlines():
        name, bracket, rest = line.partition("(")
        if line.startswith(("#", "global")) or not bracket:
            head.append(line)
        else:
            numbers, _, properties = rest.partition(")")
            found.append((name, np.array(numbers.split(","), float).reshape(-1, 2), properties))
    return head, found


@pytest.mark.parametrize("reference", [None, REFERENCE])
def test_regions(tmp_path: Path, reference: Any):
    angle = np.linspace(0.0, 2.0 * np.pi, 9)
    ring = 20.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    path = tmp_path / "r.reg"
    io.write_regions(
        path,
        images=np.array([[1.0, 2.0], [3.0, -4.0]]),
        labels=("1.1", "1.2"),
        predicted=np.array([[1.1, 2.0], [np.nan, np.nan]]),
        curves={"tangential": [ring], "radial": [ring[:3]], "other": []},
        reference=reference,
    )
    head, found = shapes(path)
    assert head[0] == "# Region file format: DS9 version 4.1"
    assert head[-1] == ("linear" if reference is None else "fk5")
    assert [name for name, _, _ in found] == ["polygon", "line", "line", "point", "point", "point"]
    to_theta = (
        (lambda at: at) if reference is None else (lambda at: io.offsets(at[:, 0], at[:, 1], reference))
    )
    expected = [ring[:-1], ring[:2], ring[1:3], [[1.0, 2.0]], [[3.0, -4.0]], [[1.1, 2.0]]]
    for (_, at, _), theta in zip(found, expected, strict=True):
        np.testing.assert_allclose(to_theta(at), theta, atol=5e-5)  # 8 decimals of a degree
    assert "color=red tag={tangential}" in found[0][2]
    assert "text={1.1}" in found[3][2] and "tag={predicted}" in found[5][2]


def test_regions_need_a_label_for_every_image(tmp_path: Path):
    with pytest.raises(ValueError, match="1 labels for 2 images"):
        io.write_regions(tmp_path / "r.reg", images=np.zeros((2, 2)), labels=("a",))


# --- all or nothing ------------------------------------------------------------------------------


@pytest.mark.parametrize("stop", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, stop: type[BaseException]):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def interrupted() -> None:
        with io.atomic(path) as temporary:
            temporary.write_text("half")
            assert (temporary.parent, temporary.suffix) == (tmp_path, ".txt")
            raise stop

    with pytest.raises(stop):
        interrupted()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_atomic_makes_directories_and_keeps_the_usual_permissions(tmp_path: Path):
    with io.atomic(tmp_path / "new" / "a.txt") as temporary:
        temporary.write_text("done")
    (tmp_path / "usual.txt").write_text("")
    assert (tmp_path / "new" / "a.txt").stat().st_mode == (tmp_path / "usual.txt").stat().st_mode
    with (
        pytest.raises(IsADirectoryError, match="new is a directory; give the name of a file"),
        io.atomic(tmp_path / "new"),
    ):
        pass


def test_staging_moves_everything_at_the_end(tmp_path: Path):
    out = tmp_path / "a" / "out"
    with io.staging(out) as stage:
        (stage / "one.txt").write_text("1")
        (stage / "figures").mkdir()
        (stage / "figures" / "two.txt").write_text("2")
        assert not (out / "one.txt").exists()
    assert stage.written == ("figures/two.txt", "one.txt")
    assert stage.untouched == ()
    assert sorted(os.listdir(out)) == ["figures", "one.txt"]


def test_staging_replaces_its_own_files_and_names_the_others(tmp_path: Path):
    (tmp_path / "one.txt").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    with io.staging(tmp_path) as stage:
        (stage / "one.txt").write_text("new")
    assert (tmp_path / "one.txt").read_text() == "new"
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert (stage.written, stage.untouched) == (("one.txt",), ("mine.txt",))


@pytest.mark.parametrize("there", [True, False])
def test_an_interrupted_staging_leaves_nothing_behind(tmp_path: Path, there: bool):
    out = tmp_path / "deep" / "out"
    if there:
        out.mkdir(parents=True)
        (out / "one.txt").write_text("old")

    def interrupted() -> None:
        with io.staging(out) as stage:
            (stage / "one.txt").write_text("new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    if there:
        assert os.listdir(out) == ["one.txt"]
        assert (out / "one.txt").read_text() == "old"
    else:
        assert not os.listdir(tmp_path)


def test_staging_refuses_a_file(tmp_path: Path):
    (tmp_path / "out").write_text("")
    with (
        pytest.raises(NotADirectoryError, match="out is a file; give the name of a directory"),
        io.staging(tmp_path / "out"),
    ):
        pass
