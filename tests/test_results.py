"""The files of a fit: complete, consistent with each other and with the lens they describe."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from conftest import CommandRun
from numpy.testing import assert_allclose, assert_array_equal

from jaxlens import analysis_strong, datasets, io, lens, lens_equation, posterior, radial, results, strong
from jaxlens.cosmology import LensPlane
from jaxlens.lens import Lens

MAPS = ["kappa", "gamma_1", "gamma_2", "alpha_1", "alpha_2", "psi", "mu_z1", "mu_z2", "mu_z4", "mu_z9"]
FIGURES = ["kappa", "residuals", "starts", "covariance"]
TABLES = ["images_predicted", "systems", "images_spare", "masses"]
FILES = {
    "summary.json",
    "model.toml",
    "posterior.npz",
    "regions.reg",
    *(f"{name}.ecsv" for name in TABLES),
    *(f"{name}.fits" for name in (*MAPS, "kappa_draws", "kappa_mean", "kappa_std")),
    *(f"{name}.{kind}" for name in FIGURES for kind in ("pdf", "png")),
}


@pytest.fixture(scope="module")
def summary(as1063_run: CommandRun) -> dict[str, Any]:
    return json.loads((as1063_run.out / "summary.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def tables(as1063_run: CommandRun) -> dict[str, Any]:
    return {name: Table.read(as1063_run.out / f"{name}.ecsv") for name in TABLES}


@pytest.fixture(scope="module")
def model(as1063_run: CommandRun) -> tuple[Lens, LensPlane]:
    return io.read_lens(as1063_run.out / "model.toml")


@pytest.fixture
def outcome(as1063_run: CommandRun) -> results.Outcome:
    return as1063_run.outcome


def test_every_promised_file_is_there_and_no_other(as1063_run: CommandRun):
    assert {item.name for item in as1063_run.out.iterdir()} == FILES


# --- summary.json -----------------------------------------------------------------------------------


def test_the_summary_has_its_keys(summary: dict[str, Any]):
    promised = {
        "chi2_source",
        "chi2_image",
        "chi2_prior",
        "rms_arcsec",
        "rms_by_source",
        "n_images",
        "n_produced",
        "n_systems",
        "n_free",
        "chi2_nu_paper",
        "chi2_nu",
        "starts",
        "converged",
        "bic",
        "aic",
        "n_fitted",
        "sigma_pos",
        "leave_one_out",
        "image_plane_converged",
        "notes",
        "parameters",
        "seconds",
        "seed",
        "version",
    }
    assert promised <= set(summary)
    assert set(summary["rms_by_source"]) == {"tensor", "mean", "mu_mean", "own"}
    assert set(summary["seconds"]) == {"compile", "fit", "total"}
    for entry in summary["parameters"].values():
        assert set(entry) == {"value", "error", "unit", "at_bound", "lo", "hi"}


def test_the_counts(summary: dict[str, Any]):
    assert (summary["n_images"], summary["n_produced"], summary["n_systems"]) == (50, 50, 19)
    assert summary["n_free"] == 11
    assert len(summary["parameters"]) == 11
    assert summary["not_produced"] == []
    assert set(summary["n_produced_by_source"].values()) == {50}
    assert summary["image_search_complete"] is True


def test_the_fit_is_as_good_as_the_published_one(summary: dict[str, Any]):
    rms = summary["rms_by_source"]
    assert summary["rms_arcsec"] == rms["tensor"]
    assert summary["rms_definition"] == "tensor"
    assert rms["tensor"] < 0.417  # the published halos, sources by the same definition: 0.4170
    assert rms["own"] <= rms["tensor"] < rms["mean"]
    assert rms["own"] > 0.35, "better than the members' unmodelled scatter allows: wrong pairs?"
    # With 2 n - n_free - 2 n_systems degrees of freedom; the published fit has 48.852 / 51.
    assert 0.4 < summary["chi2_nu"] < 1.0


def test_chi2_adds_up(summary: dict[str, Any]):
    assert_allclose(summary["chi2_image"] / (100 - 11), summary["chi2_nu_paper"], rtol=1e-12)
    assert_allclose(summary["chi2_image"] / (100 - 11 - 38), summary["chi2_nu"], rtol=1e-12)
    best = min(start["chi2"] for start in summary["starts"])
    assert_allclose(summary["chi2_source"] + summary["chi2_prior"], best, rtol=1e-9)
    # sigma = 0.5 arcsec for all 50 images, all produced.
    assert_allclose(summary["chi2_image"], 50 * (summary["rms_arcsec"] / 0.5) ** 2, rtol=1e-10)


def test_the_starts_agree_and_nothing_is_at_a_bound(summary: dict[str, Any]):
    assert summary["converged"] is True and summary["interrupted"] is False
    assert summary["agreeing_starts"] == len(summary["starts"]) == 2
    assert [start["number"] for start in summary["starts"]] == [1, 2]
    assert all(start["converged"] for start in summary["starts"])
    assert summary["at_bound"] == []
    assert not any(entry["at_bound"] for entry in summary["parameters"].values())


def test_the_numbers_agree_with_the_published_model(summary: dict[str, Any]):
    published = {"O1.ellipticity": 0.517298, "O1.pa_deg": -36.014434, "O1.r_core_arcsec": 20.132957}
    published |= {"O1.sigma_lt_km_s": 1223.737326, "O2.gamma": 0.1039, "O2.pa_deg": 50.8049}
    published |= {"O3.sigma_lt_km_s": 290.768098, "O4.sigma_lt_km_s": 203.189436}
    published |= {"O4.x_arcsec": -20.163718, "O4.y_arcsec": 29.326486}
    published |= {"members.sigma_ref_km_s": datasets.reference_numbers("as1063")["sigma_ref_lt"]}
    assert set(summary["parameters"]) == set(published)
    for name, entry in summary["parameters"].items():
        # The same images and the same freedom, another chi^2: within one standard error (largest: 0.8).
        assert abs(entry["value"] - published[name]) < entry["error"], name
        assert entry["error"] < 0.25 * abs(entry["value"]), name


def test_units_of_the_numbers(summary: dict[str, Any]):
    units = {name: entry["unit"] for name, entry in summary["parameters"].items()}
    assert units["O1.r_core_arcsec"] == "arcsec"
    assert units["members.sigma_ref_km_s"] == "km/s"
    assert units["O2.pa_deg"] == "deg"
    assert units["O2.gamma"] == units["O1.ellipticity"] == ""
    assert results.unit_of("bcg.mass_msun") == "Msun"


def test_errors_are_those_of_the_covariance(outcome: results.Outcome):
    n = len(outcome.values)
    assert outcome.covariance.shape == (n, n)
    assert np.linalg.eigvalsh(outcome.covariance).min() > 0.0
    assert_allclose(np.sqrt(np.diag(outcome.covariance)), list(outcome.errors.values()), rtol=1e-12)


# --- beyond the fit ------------------------------------------------------------------------------------


def test_the_criteria_by_hand(summary: dict[str, Any]):
    # 11 numbers and 19 sources of two coordinates; 50 images of two.
    assert summary["n_fitted"] == 49
    assert_allclose(summary["bic"], summary["chi2_source"] + 49 * np.log(100.0), rtol=1e-12)
    assert_allclose(summary["aic"], summary["chi2_source"] + 2 * 49, rtol=1e-12)


def test_position_errors_are_fixed_unless_asked(summary: dict[str, Any]):
    said = summary["sigma_pos"]
    assert (said["mode"], said["scale"], said["degrees_of_freedom"]) == ("fixed", 1.0, 51)
    assert_allclose(said["chi2_nu_source"], summary["chi2_source"] / 51, rtol=1e-12)
    assert said["chi2_nu_source_scaled"] == said["chi2_nu_source"]


def test_left_out_systems_are_predicted(summary: dict[str, Any], tables: dict[str, Any]):
    said, images, systems = summary["leave_one_out"], tables["images_predicted"], tables["systems"]
    offset = np.asarray(images["offset_left_out_arcsec"], float)
    reached = np.isfinite(offset)
    assert said["n_found"] == reached.sum() >= 48
    assert said["n_converged"] == 19
    assert_allclose(said["rms_arcsec"], np.sqrt(np.mean(offset[reached] ** 2)), rtol=1e-9)
    in_source = np.asarray(images["offset_source_left_out_arcsec"], float)
    assert_allclose(said["rms_source_arcsec"], np.sqrt(np.mean(in_source**2)), rtol=1e-9)
    # Predictions are worse than fits, but not by much: 11 numbers and 62 constraints.
    assert summary["rms_arcsec"] < said["rms_arcsec"] < 2.0 * summary["rms_arcsec"]
    assert_allclose(images["offset_left_out_in_errors"], offset / 0.5, rtol=1e-9)
    flagged = [str(name) for name in images["image_id"][images["outlier"]]]
    assert flagged == said["outlying_images"]
    assert [str(name) for name in systems["system"][systems["outlier"]]] == said["outlying_systems"]
    assert not (offset[~np.asarray(images["outlier"])] > 1.5).any()


def test_drawn_maps_are_those_of_the_stored_lenses(as1063_run: CommandRun, model: tuple[Lens, LensPlane]):
    with fits.open(as1063_run.out / "kappa_draws.fits") as file:
        hdus: Any = file
        cube, header = np.array(hdus[0].data), hdus[0].header.copy()
        wcs = WCS(hdus[0].header)
    kappa = io.read_map(as1063_run.out / "kappa.fits")
    assert cube.shape == (3, *kappa.grid.shape)
    assert wcs.naxis == 3 and header["NDRAWS"] == 3 and header["ZSOURCE"] == -1.0
    draws = posterior.read_posterior(as1063_run.out / "posterior.npz", model[0])
    one = jax.tree.map(lambda leaf: leaf[1], draws)
    some = (slice(3, None, 40), slice(7, None, 40))
    # 4 bytes a value in the cube.
    assert_allclose(cube[1][some], lens.kappa(one, kappa.grid.theta[some]), rtol=1e-6)
    mean, std = (io.read_map(as1063_run.out / f"kappa_{name}.fits").values for name in ("mean", "std"))
    assert_allclose(mean, cube.mean(axis=0, dtype=float), rtol=1e-6)
    assert_allclose(std, cube.std(axis=0, dtype=float, ddof=1), rtol=1e-3, atol=1e-7)
    assert std.min() > 0.0
    # The streaming form, which holds two maps instead of all draws.
    three = jax.tree.map(lambda leaf: leaf[:3], draws)
    moments = posterior.kappa_moments(three, kappa.grid.theta[some])
    assert_allclose(moments[0], mean[some], rtol=1e-9)
    assert_allclose(moments[1], std[some], rtol=1e-9)


def test_rescaled_errors_and_their_draws(outcome: results.Outcome):
    setup = analysis_strong.prepare(outcome.setup, analysis_strong.Options(sigma_pos="rescaled"))
    options = analysis_strong.Options(sigma_pos="rescaled")
    fit, asked = analysis_strong.answer(setup, outcome.fit, options)
    said = analysis_strong.summary(setup, fit, asked)["sigma_pos"]
    factor = np.sqrt(float(outcome.fit.chi2) / 51.0)
    assert_allclose(said["scale"], factor, rtol=1e-9)
    assert_allclose(said["chi2_nu_source_scaled"], 1.0, rtol=1e-9)
    # The weak prior is not rescaled, and has a little share in the errors.
    ratio = np.sqrt(np.diag(fit.covariance) / np.diag(outcome.fit.covariance))
    assert_allclose(ratio, factor, rtol=0.05)


def test_numbers_at_their_bound_have_no_error_and_do_not_move_in_the_draws(outcome: results.Outcome):
    bounds = outcome.setup.problem.bounds
    names = sorted(bounds)
    at = sum(bounds[name].size for name in names[: names.index("O3.sigma_lt_km_s")])
    stuck = dataclasses.replace(outcome.fit, u=outcome.fit.u.at[at].set(6.0))
    drawn = posterior.draw_lenses(outcome.setup.problem, stuck, jax.random.key(0), 4)
    # O1, O3 and O4 are profiles of one component, in the order of the file.
    b = np.asarray(drawn.components["dpie_lenstool"].params.b)
    assert np.ptp(b[:, 1]) == 0.0 and np.ptp(b[:, 0]) > 0.0


def test_what_cannot_be_asked_is_refused_before_the_fit(outcome: results.Outcome):
    setup = outcome.setup
    with pytest.raises(ValueError, match=r"a free external shear already \(O2\)"):
        analysis_strong.prepare(setup, analysis_strong.Options(shear=True))
    with pytest.raises(ValueError, match="`sigma_pos` is 'wide'; choose one of fixed, rescaled, free"):
        analysis_strong.prepare(setup, analysis_strong.Options(sigma_pos="wide"))
    asked = analysis_strong.options_of(setup, sigma_pos=None, draws=7)
    assert (asked.sigma_pos, asked.draws, asked.leave_one_out) == ("fixed", 7, False)
    free = analysis_strong.prepare(setup, analysis_strong.Options(sigma_pos="free"))
    assert strong.SIGMA in free.problem.bounds


# --- model.toml ---------------------------------------------------------------------------------------


def test_the_model_reads_back_bit_for_bit(model: tuple[Lens, LensPlane], outcome: results.Outcome):
    back, plane = model
    assert list(back.components) == list(outcome.fit.lens.components)
    ours, theirs = (jax.tree.flatten_with_path(one)[0] for one in (outcome.fit.lens, back))
    assert [path for path, _ in ours] == [path for path, _ in theirs]
    for (path, ours_leaf), (_, theirs_leaf) in zip(ours, theirs, strict=True):
        assert np.asarray(theirs_leaf).dtype == np.float64, path
        assert_array_equal(np.broadcast_to(ours_leaf, np.shape(theirs_leaf)), theirs_leaf, err_msg=str(path))
    for ours_leaf, theirs_leaf in zip(
        jax.tree.leaves(outcome.setup.plane), jax.tree.leaves(plane), strict=True
    ):
        assert_array_equal(ours_leaf, theirs_leaf)


def test_the_model_names_its_ingredients(as1063_run: CommandRun, outcome: results.Outcome):
    """The haloes of a component keep the names of the configuration, in their order."""
    labels = io.read_lens_labels(as1063_run.out / "model.toml")
    assert labels == {"dpie_lenstool": ("O1", "O3", "O4"), "shear": ("O2",)}
    lens_of = outcome.fit.lens.components["dpie_lenstool"]
    for place, name in enumerate(labels["dpie_lenstool"]):
        x = outcome.values.get(f"{name}.x_arcsec")
        if x is not None:
            assert_allclose(lens_of.centre[place, 0], x, rtol=1e-12)
    assert "O4.x_arcsec" in outcome.values


# --- tables -------------------------------------------------------------------------------------------


def test_the_image_table_sums_to_the_summary(tables: dict[str, Any], summary: dict[str, Any]):
    images = tables["images_predicted"]
    assert len(images) == 50
    assert_allclose(images["chi2"].sum(), summary["chi2_image"], rtol=1e-12)
    assert_allclose(np.sqrt(np.mean(images["offset_arcsec"] ** 2)), summary["rms_arcsec"], rtol=1e-12)
    assert images["produced"].sum() == summary["n_produced"]
    assert images["x_arcsec"].unit == "arcsec"
    assert images.meta["source_definition"] == "tensor"


def test_the_image_table_is_consistent(tables: dict[str, Any]):
    images = tables["images_predicted"]
    for axis in "xy":
        step = images[f"{axis}_predicted_arcsec"] - images[f"{axis}_arcsec"]
        assert_allclose(images[f"d{axis}_arcsec"], step, rtol=0.0, atol=1e-12)
    assert_allclose(images["offset_arcsec"], np.hypot(images["dx_arcsec"], images["dy_arcsec"]), rtol=1e-12)
    assert_allclose(images["chi2"], (images["offset_arcsec"] / 0.5) ** 2, rtol=1e-12)


def test_observed_images_are_those_of_the_catalogue(tables: dict[str, Any]):
    said = io.read_images(datasets.path("as1063") / "images.csv")
    images = tables["images_predicted"]
    assert list(images["image_id"]) == list(said.image_ids)
    assert_array_equal(np.stack([images["x_arcsec"], images["y_arcsec"]], axis=1), said.theta)
    assert_array_equal(images["z_s"], said.z_s[said.source])


def test_the_system_table_counts(tables: dict[str, Any], summary: dict[str, Any]):
    systems, images, spare = (tables[name] for name in ("systems", "images_predicted", "images_spare"))
    assert len(systems) == 19
    for row in systems:
        mine = images[images["system"] == row["system"]]
        assert (row["n_images"], row["n_produced"]) == (len(mine), mine["produced"].sum())
        assert row["n_spare"] == (spare["system"] == row["system"]).sum()
        assert_allclose(row["chi2"], mine["chi2"].sum(), rtol=1e-12)
        assert_allclose(row["rms_arcsec"], np.sqrt(np.mean(mine["offset_arcsec"] ** 2)), rtol=1e-12)
    assert systems["n_spare"].sum() == len(spare) == summary["n_spare"]
    assert_allclose(systems["chi2"].sum(), summary["chi2_image"], rtol=1e-12)


def test_all_predicted_images_trace_back_to_their_source(
    tables: dict[str, Any], model: tuple[Lens, LensPlane]
):
    back, plane = model
    systems = {row["system"]: row for row in tables["systems"]}
    theta, beta, z, mu = [], [], [], []
    for rows, x, y in (
        (tables["images_predicted"], "x_predicted_arcsec", "y_predicted_arcsec"),
        (tables["images_spare"], "x_arcsec", "y_arcsec"),
    ):
        for row in rows:
            source = systems[row["system"]]
            theta.append((row[x], row[y]))
            beta.append((source["beta_x_arcsec"], source["beta_y_arcsec"]))
            z.append(source["z_s"])
            mu.append(row["mu"])
    ratio = plane.dls_ds(jnp.array(z))
    assert_allclose(lens.ray_trace(back, jnp.array(theta), ratio), beta, rtol=0.0, atol=1e-8)
    assert_allclose(lens.mu(back, jnp.array(theta), ratio), mu, rtol=1e-6)


# --- maps ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MAPS)
def test_maps_know_their_planes(as1063_run: CommandRun, model: tuple[Lens, LensPlane], name: str):
    header = fits.getheader(as1063_run.out / f"{name}.fits")
    assert header["ZLENS"] == 0.3475
    if name.startswith("mu_z"):
        z = float(name.removeprefix("mu_z"))
        assert header["ZSOURCE"] == z
        assert_allclose(header["DLSDS"], model[1].dls_ds(z), rtol=1e-14)
    else:
        assert (header["ZSOURCE"], header["DLSDS"]) == (-1.0, 1.0)
        assert "D_LS/D_S = 1" in header.comments["ZSOURCE"]
    assert header.get("BUNIT", "") == {"alpha_1": "arcsec", "alpha_2": "arcsec", "psi": "arcsec2"}.get(
        name, ""
    )


def test_map_values_are_those_of_the_lens(as1063_run: CommandRun, model: tuple[Lens, LensPlane]):
    back, plane = model
    maps = {name: io.read_map(as1063_run.out / f"{name}.fits") for name in MAPS}
    some = (slice(3, None, 24), slice(7, None, 24))
    theta = maps["kappa"].grid.theta[some]
    value = {name: one.values[some] for name, one in maps.items()}
    kappa, gamma = lens.kappa_and_gamma(back, theta)
    alpha = lens.alpha(back, theta)
    # 1e-10: the maps are computed tile by tile, in another order of the sum over 263 galaxies.
    assert_allclose(value["kappa"], kappa, rtol=1e-10)
    assert_allclose(value["gamma_1"] + 1j * value["gamma_2"], gamma, rtol=1e-10, atol=1e-12)
    assert_allclose(value["alpha_1"], alpha[..., 0], rtol=1e-10, atol=1e-9)
    assert_allclose(value["alpha_2"], alpha[..., 1], rtol=1e-10, atol=1e-9)
    assert_allclose(value["psi"], lens.psi(back, theta), rtol=1e-10)
    for z in (1.0, 2.0, 4.0, 9.0):
        # 1 / mu: mu itself diverges at critical curves.
        inverse = 1.0 / lens.mu(back, theta, plane.dls_ds(z))
        assert_allclose(1.0 / value[f"mu_z{z:g}"], inverse, rtol=1e-9, atol=1e-10)


def test_maps_reach_beyond_all_images(as1063_run: CommandRun, tables: dict[str, Any]):
    grid = io.read_map(as1063_run.out / "kappa.fits").grid
    assert grid.pixel == results.PIXEL
    images = tables["images_predicted"]
    for axis, places in (("x", np.asarray(grid.x)), ("y", np.asarray(grid.y))):
        assert places.min() < images[f"{axis}_arcsec"].min() - 24.0
        assert places.max() > images[f"{axis}_arcsec"].max() + 24.0


def test_west_is_west_on_the_maps(as1063_run: CommandRun):
    with fits.open(as1063_run.out / "kappa.fits") as file:
        hdus: Any = file
        wcs = WCS(hdus[0].header)
        grid = io.read_map(as1063_run.out / "kappa.fits").grid
    x, y = wcs.world_to_pixel_values(342.18322, -44.530889)
    # Zero-based pixel of theta = 0; then 20 arcsec to the West (smaller RA), then 10 to the North.
    origin = ((0.0 - float(grid.x[0])) / grid.pixel, (0.0 - float(grid.y[0])) / grid.pixel)
    assert_allclose((x, y), origin, atol=1e-6)
    west, _ = wcs.world_to_pixel_values(
        342.18322 - 20.0 / 3600.0 / np.cos(np.deg2rad(-44.530889)), -44.530889
    )
    assert_allclose(west - x, 20.0 / grid.pixel, atol=1e-2)
    _, north = wcs.world_to_pixel_values(342.18322, -44.530889 + 10.0 / 3600.0)
    assert_allclose(north - y, 10.0 / grid.pixel, atol=1e-2)
    # Image 1.1, East of the centre; x and y of the catalogue are not quite gnomonic (0.02 arcsec).
    x, y = wcs.world_to_pixel_values(342.1945, -44.526998)
    place = (float(grid.x[0]) + grid.pixel * x, float(grid.y[0]) + grid.pixel * y)
    assert_allclose(place, (-28.9483, 14.0076), atol=0.02)


# --- regions and figures ------------------------------------------------------------------------------


def test_the_region_file_has_all_images_and_curves(as1063_run: CommandRun):
    lines = (as1063_run.out / "regions.reg").read_text(encoding="utf-8").splitlines()
    assert "fk5" in lines
    observed = [line for line in lines if "tag={observed}" in line]
    assert len(observed) == 50
    assert sum("tag={predicted}" in line for line in lines) == 50
    for kind in ("tangential", "radial", "caustics"):
        assert any(line.startswith("polygon(") and f"tag={{{kind}}}" in line for line in lines), kind
    first = next(line for line in observed if "text={1.1}" in line)
    ra, dec = (float(part) for part in re.findall(r"[-\d.]+", first.partition(")")[0]))
    assert abs(ra - 342.1945) * np.cos(np.deg2rad(dec)) * 3600.0 < 0.02
    assert abs(dec - -44.526998) * 3600.0 < 0.02


@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_pdf_and_png(as1063_run: CommandRun, name: str):
    assert (as1063_run.out / f"{name}.pdf").read_bytes().startswith(b"%PDF-")
    assert (as1063_run.out / f"{name}.png").read_bytes().startswith(b"\x89PNG")


# --- fits that went less well -------------------------------------------------------------------------


def test_an_image_that_is_not_produced(outcome: results.Outcome):
    produced = outcome.main.produced.copy()
    produced[4] = False
    worse = dataclasses.replace(
        outcome, predicted={**outcome.predicted, "tensor": outcome.main._replace(produced=produced)}
    )
    name = outcome.images.image_ids[4]
    content = results.summary(worse)
    assert content["not_produced"] == [name]
    assert content["n_produced"] == 49
    table = results.image_table(worse)
    assert np.isnan(table["x_predicted_arcsec"][4]) and np.isnan(table["chi2"][4])
    assert_allclose(np.nansum(table["chi2"]), content["chi2_image"], rtol=1e-12)
    systems = results.system_table(worse)
    row = int(np.asarray(outcome.images.source)[4])
    assert systems["n_produced"][row] == systems["n_images"][row] - 1
    assert_allclose(systems["chi2"].sum(), content["chi2_image"], rtol=1e-12)
    assert f"not produced: {name}" in results.verdict(content)
    assert content["chi2_nu"] is None and content["chi2_nu_paper"] is None

    # A system without a single image has no rms.
    produced = outcome.main.produced & (np.asarray(outcome.images.source) != 0)
    worse = dataclasses.replace(
        outcome, predicted={**outcome.predicted, "tensor": outcome.main._replace(produced=produced)}
    )
    systems = results.system_table(worse)
    assert np.isnan(systems["rms_arcsec"][0]) and np.isnan(systems["chi2"][0])


def test_padding_is_no_image(outcome: results.Outcome, monkeypatch: pytest.MonkeyPatch):
    """What stands in the unused rows of a set of images never counts, not even on an observed position."""
    solve, images = lens_equation.solve, outcome.images
    where = jnp.stack([images.theta[np.asarray(images.source) == k][0] for k in range(images.n_systems)])

    def filled(*args: Any, **options: Any) -> lens_equation.ImageSet:
        found = solve(*args, **options)
        theta = jnp.where(found.valid[..., None], found.theta, where[:, None])
        return dataclasses.replace(found, theta=theta, mu=jnp.where(found.valid, found.mu, 1e3))

    monkeypatch.setattr(lens_equation, "solve", filled)
    prediction = strong.Prediction(outcome.fit.lens, outcome.fit.dls_ds)
    again = strong.predict(prediction, images, definitions=("tensor",))["tensor"]
    for name in ("theta", "mu", "produced", "spare"):
        assert_array_equal(getattr(again, name), getattr(outcome.main, name), err_msg=name)


def test_numbers_at_their_bound_carry_their_reported_names(outcome: results.Outcome):
    stuck = dataclasses.replace(
        outcome, fit=dataclasses.replace(outcome.fit, at_bound=("O1.shape", "O3.sigma_lt_km_s", "dls_ds.7"))
    )
    assert results.bound_names(stuck) == {"O1.ellipticity", "O3.sigma_lt_km_s", "z.7"}
    content = results.summary(stuck)
    assert content["parameters"]["O1.ellipticity"]["at_bound"] is True
    assert content["parameters"]["O1.pa_deg"]["at_bound"] is False
    assert "at their bound: O1.ellipticity, O3.sigma_lt_km_s" in results.verdict(content)


def test_a_fit_that_has_not_converged_says_so(outcome: results.Outcome):
    content = results.summary(
        dataclasses.replace(outcome, fit=dataclasses.replace(outcome.fit, converged=False))
    )
    assert "has not converged; give more starts or tighter boxes" in results.verdict(content)


def test_a_free_redshift_is_reported_with_its_images(outcome: results.Outcome):
    freed = dataclasses.replace(outcome, values={**outcome.values, "z.7": 1.9})
    rows = results.image_table(freed)
    assert set(rows["z_s"][rows["system"] == "7"]) == {1.9}
    systems = results.system_table(freed)
    assert systems["z_s"][systems["system"] == "7"] == [1.9]


def test_an_error_while_writing_leaves_nothing(
    outcome: results.Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(io, "write_regions", full)
    monkeypatch.setattr(results, "figures", lambda *_: {})
    with pytest.raises(KeyboardInterrupt):
        results.write(outcome, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_masses_of_the_summary_are_those_of_the_table_with_errors(
    summary: dict[str, Any], tables: dict[str, Any], model: tuple[Lens, LensPlane], outcome: results.Outcome
) -> None:
    table = tables["masses"]
    fitted, plane = model
    expected = radial.mass_within(fitted, plane, jnp.asarray(table["r_arcsec"]))
    assert_allclose(table["mass_msun"], expected, rtol=1e-12)
    assert_allclose(table["r_kpc"], table["r_arcsec"] * float(plane.kpc_per_arcsec), rtol=1e-12)
    for row, entry in zip(table, summary["masses"], strict=True):
        assert set(entry) == set(table.colnames)
        assert_allclose([entry[name] for name in table.colnames], [row[name] for name in table.colnames])
    # To first order the error is that of the covariance; 64 draws know a standard deviation to 9 %.
    bounds, build = outcome.setup.problem.bounds, outcome.setup.model
    radii = jnp.array([50.0, 100.0, 200.0]) / plane.kpc_per_arcsec
    slope = jax.jit(
        jax.jacfwd(
            lambda u: radial.mass_within(build.lens(strong.physical(bounds, u)), plane, radii, n_angles=64)
        )
    )(outcome.fit.u)
    laplace = np.sqrt(np.diag(np.asarray(slope @ outcome.fit.covariance @ slope.T)))
    rows = np.isin(table["r_kpc"], [50.0, 100.0, 200.0])
    assert_allclose(table["mass_error_msun"][rows], laplace, rtol=0.4)
    assert np.all(table["mass_lo_msun"] < table["mass_msun"]) and np.all(
        table["mass_hi_msun"] > table["mass_msun"]
    )
    r = np.hypot(*np.asarray(outcome.images.theta).T)
    assert table["n_images"][rows].tolist() == [(r < float(one)).sum() for one in radii]
