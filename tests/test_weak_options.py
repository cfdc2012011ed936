"""What the weak-lensing command can be asked for: a model to start from, a smoothing, drawn redshifts."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from jaxlens import cli, io, model_weak, weak, workflow_weak
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Component, Lens
from jaxlens.profiles import nfw
from jaxlens.redshift_weak import redshift_spread

GRID = Grid((9, 12), 20.0, (10.0, 0.0))
PLANE = LensPlane.at(z_l=0.3)
REFERENCE = (10.0, -5.0)
HALO = nfw.from_mass(5e14, 5.0, PLANE)


def model(path: Path, z_l: float = 0.3, reference: tuple[float, float] | None = REFERENCE) -> str:
    io.write_lens(path, Lens(halo=Component(HALO, (4.0, -7.0))), LensPlane.at(z_l=z_l), reference=reference)
    return str(path)


def shear_map(path: Path, **header: float) -> str:
    rng = np.random.default_rng(1)
    g = 0.1 * (rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape))
    io.write_shear_map(
        path, g, np.ones(GRID.shape), np.ones(GRID.shape, int), GRID, header=header, reference=REFERENCE
    )
    return str(path)


# --- a first guess ---------------------------------------------------------------------------------


def test_the_first_guess_is_the_models_convergence_where_it_lies_on_the_sky(tmp_path: Path):
    field = workflow_weak.field(shear_map(tmp_path / "a.fits", ZLENS=0.3, DLSDS=0.6))
    moved = (REFERENCE[0] - 30.0 / 3600.0 / np.cos(np.deg2rad(5.0)), REFERENCE[1])  # 30 arcsec to the West
    found = model_weak.first_guess(field, model(tmp_path / "m.toml", reference=moved))
    # The closed form of a round NFW; the engine's is a sum of profiles, right to 4e-5.
    x, y = np.moveaxis(np.asarray(GRID.theta) - np.array([34.0, -7.0]), -1, 0)
    u = np.hypot(x, y) / float(HALO.r_s)
    root = np.sqrt(np.abs(1.0 - u**2))
    middle = np.where(u < 1.0, np.arctanh(np.minimum(root, 1 - 1e-15)), np.arctan(root)) / root
    expected = 0.6 * 2.0 * float(HALO.kappa_s) * (1.0 - middle) / (u**2 - 1.0)
    assert_allclose(found, expected, rtol=1e-3)
    deep = workflow_weak.field(shear_map(tmp_path / "b.fits", ZSOURCE=2.0))
    here = model_weak.first_guess(deep, model(tmp_path / "n.toml", reference=moved))
    assert_allclose(here, np.asarray(found) * float(PLANE.dls_ds(2.0)) / 0.6, rtol=1e-12)


def test_a_model_of_another_cluster_is_refused(tmp_path: Path):
    field = workflow_weak.field(shear_map(tmp_path / "a.fits", ZLENS=0.3, DLSDS=0.6))
    with pytest.raises(ValueError, match=r"the lens is at z = 0\.4, that of a at 0\.3"):
        model_weak.first_guess(field, model(tmp_path / "m.toml", z_l=0.4))
    with pytest.raises(ValueError, match="lies outside of the map of a"):
        model_weak.first_guess(field, model(tmp_path / "n.toml", reference=(10.5, -5.0)))
    unknown = workflow_weak.field(shear_map(tmp_path / "b.fits"))
    with pytest.raises(ValueError, match="does not say how deep its galaxies lie; add DLSDS"):
        model_weak.first_guess(unknown, model(tmp_path / "o.toml"))


@pytest.mark.long
def test_the_command_starts_a3_from_it_and_smooths_as_it_is_told(tmp_path: Path):
    source, lens, out = shear_map(tmp_path / "a.fits", DLSDS=0.6), model(tmp_path / "m.toml"), tmp_path / "o"
    command = ["weak", source, "--out", str(out), "--scheme", "A3", "--model", lens, "--smoothing", "25"]
    command += ["--bootstrap", "8", "--iterations", "2", "--no-cache"]
    result = CliRunner().invoke(cli.app, command, env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert result.exit_code == 0, result.output
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert (content["scheme"], content["smoothing_arcsec"]) == ("A3", 25.0)
    field = workflow_weak.field(source)
    kappa0 = model_weak.first_guess(field, lens)
    made = [
        weak.reconstruct(field.shear, GRID, scheme="A3", smoothing=25.0, n_iter=2, kappa0=start).kappa
        for start in (kappa0, jnp.zeros(GRID.shape))
    ]
    written = io.read_map(out / "kappa_E.fits").values
    assert_allclose(written, made[0], atol=1e-12)
    assert np.abs(written - np.asarray(made[1])).max() > 1e-6  # after two iterations the start still shows


# --- redshifts -------------------------------------------------------------------------------------

CONFIG = """\
name = "test"
z_l = 0.3

[depth]
z_s = 1.5
per_galaxy = true

[map]
pixel_arcsec = 30.0
sigma_arcsec = 30.0

[profile]
edges_arcsec = [10.0, 60.0, 130.0]
log_c = 0.6
log_c_sigma = 0.15
"""


def setup_of(folder: Path, width: float) -> workflow_weak.Field:
    """80 galaxies about an isothermal lens; every second has a redshift, with percentiles `width` away."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-90.0, 90.0, (2, 80))
    r = np.hypot(x, y) + 5.0
    g = -8.0 / r * (x + 1j * y) ** 2 / r**2 + 0.05 * (rng.normal(size=80) + 1j * rng.normal(size=80))
    lines = ["x_arcsec,y_arcsec,g1,g2,z_phot,z68_lo,z68_hi"]
    for i in range(80):
        z = f"{0.8 + 0.01 * i},{0.8 + 0.01 * i - width},{0.8 + 0.01 * i + width}" if i % 2 else ",,"
        lines.append(f"{x[i]:.3f},{y[i]:.3f},{g[i].real:.4f},{g[i].imag:.4f},{z}")
    (folder / "shear.csv").write_text("\n".join([*lines, ""]), encoding="utf-8")
    (folder / "weak.toml").write_text(CONFIG, encoding="utf-8")
    return workflow_weak.field(str(folder))


@pytest.mark.long
def test_drawn_redshifts_spread_depth_map_and_mass(tmp_path: Path):
    field = setup_of(tmp_path, 0.3)
    setup = field.setup
    assert setup is not None and setup.has_photometric_redshifts
    keys = jax.random.split(jax.random.key(0), 8)
    profile = weak.tangential_profile(setup.galaxies, setup.edges, setup.centre)
    found = redshift_spread(field, setup, profile, keys, smoothing=30.0, n_iter=3)
    # The same draws, by NumPy: galaxies without a redshift stay at z_s = 1.5.
    ratios = []
    for key in keys:
        z = weak.draw_redshifts(key, setup.table.z, setup.table.z_lo, setup.table.z_hi)
        b = np.asarray(setup.plane.dls_ds(jnp.where(jnp.isfinite(z), z, 1.5)))
        ratios.append(np.mean(b**2) / np.mean(b))
    assert_allclose(found.dls_ds, np.std(ratios, ddof=1), rtol=1e-9)
    assert np.asarray(ratios).mean() == pytest.approx(field.header["DLSDS"], abs=5.0 * found.dls_ds)
    # The shear stays, so kappa at one depth scatters by about as much as the depth.
    kappa = np.asarray(weak.reconstruct(field.shear, field.grid, smoothing=30.0, n_iter=3).kappa)
    expected = np.abs(kappa) * found.dls_ds / field.header["DLSDS"]
    at = np.unravel_index(np.argmax(kappa), kappa.shape)
    assert found.kappa[at] == pytest.approx(expected[at], rel=0.5)
    assert 0.0 < found.log10_mass < 0.1


def test_redshifts_without_errors_do_not_spread(tmp_path: Path):
    setup = setup_of(tmp_path, 0.0).setup
    assert setup is not None
    drawn = setup.redrawn(jax.random.key(1)).dls_ds
    assert_allclose(drawn, setup.galaxies.dls_ds, rtol=1e-12)
    fixed = workflow_weak.load("as1063")  # one effective source plane for all: no redshift enters
    assert not fixed.has_photometric_redshifts
