"""Simulations that cannot be are refused with key, value and remedy before any work."""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from jaxlens import cli, config_simulate, simulate, workflow_simulate
from jaxlens._config import ConfigError

CLUMPS = "[cluster]\ncentre = 'given'\n[[cluster.clumps]]\nmass_msun_h = 6e14\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[cluster]\nz_l = 2.5\n[[shear.bins]]\nz_s = 3.0",
            "`cluster.z_l` is 2.5, but `kappa_true.fits` is for sources at z = 2; lower it",
        ),
        ("[cluster]\nz_l = 0.04", "`cluster.z_l` is 0.04; .* begin at z = 0.05: raise it"),
        ("[cluster]\nomega_b = 0.4", "`cluster.omega_b` is 0.4, all of the matter .*; lower it"),
        ("[cosmology]\nomega_m = 0.045", "`cluster.omega_b` is 0.045"),
        ("[cluster]\nsigma8 = 0.001", r"`cluster.sigma8` is 0.001, .* give a number between 0\.\d+ and \d"),
        ("[cluster]\nsigma8 = 50.0", "`cluster.sigma8` is 50"),
        ("[cluster]\nn_s = 40.0", "`n_s` is 40.0; give a slope"),
        ("[cluster]\nm_min_msun_h = 1.0", r"`m_min_msun_h` is 1: about 1.\de\+12 subhaloes .*; raise it"),
        (
            "[sources]\nbox_arcsec = 1e6",
            r"`sources.box_arcsec` is 1e\+06: 7.36e\+11 sources .* at most 164 arc",
        ),
        (
            "[sources.depth]\nm_cut = 39.9",
            "`sources.box_arcsec` is 30: .* more than 20000; .* brighter `m_cut`",
        ),
        ("[sources.depth]\nm_cut = 99.0", "`m_cut` is 99.0; give an apparent magnitude between 0 and 40"),
        ("[images]\nhalf_width_arcsec = 1e5", "`half_width_arcsec` is 100000; give at most 300"),
        ("[images]\npixel_arcsec = 0.01", r"`pixel_arcsec` is 0.01: .* 2.*e\+08 cells.*; give at least 0.15"),
        (
            "[shear]\ndensity_arcmin2 = 1e9",
            r"`density_arcmin2` is 1e\+09: 6.4e\+10 galaxies .* at most 78125",
        ),
        ("[shear]\npixels = 4096\nmode = 'analytic'", "`pixels` is 4096; give 2 to 256"),
        (f"{CLUMPS}x_kpc_h = 2000.0", r"`clumps\[0\].x_kpc_h` puts the clump 2000 kpc/h .* move it or raise"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(text: str, said: str, tmp_path: Path):
    (tmp_path / "bad.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=said) as refused:
        workflow_simulate.load(tmp_path / "bad.toml")
    assert str(refused.value).startswith(str(tmp_path / "bad.toml"))


def test_what_is_unusual_is_not_refused():
    ok = "[cluster]\nz_l = 0.8\nsigma8 = 0.6\nm_min_msun_h = 3e9\n[sources]\nbox_arcsec = 100.0"
    said = config_simulate.parse(tomllib.loads(ok), "test")
    simulate.check(said.cluster, said.sources, said.settings.cosmology)


@pytest.mark.parametrize("command", ["simulate", "reproduce"])
def test_a_seed_without_a_key_is_refused(command: str, tmp_path: Path):
    arguments = [command, "--out", str(tmp_path / "out"), "--seed", str(2**63)]
    result = CliRunner().invoke(cli.app, arguments, env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert result.exit_code == 2
    assert "9223372036854775807" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_mock_refuses_such_a_seed(seed: int):
    with pytest.raises(ValueError, match=f"`seed` is {seed}; give an integer from 0"):
        simulate.stage_keys(seed)


@pytest.mark.parametrize(
    "table",
    [
        {},
        {"cluster": {"pa_difference_deg": "drawn"}},
        {"cluster": {"pa_difference_deg": 0.0, "z_infall": 1.0, "clumps": [{"mass_msun_h": 6e14}]}},
        {"cluster": {"clumps": [{"mass_msun_h": 6e14, "axis_ratios": [1.0, 1.0], "pa_rad": 1.0}]}},
        {"seed": 2**63 - 1, "shear": {"bins": [{"z_s": 1.0, "share": 0.5}, {"z_s": 3.0, "share": 0.5}]}},
    ],
)
def test_a_configuration_is_read_back_as_it_was_written(table: dict[str, Any]):
    said = config_simulate.parse(table, "test")
    text = config_simulate.text(said)
    assert config_simulate.parse(tomllib.loads(text), "test") == said
    # What is left out of the text is what is drawn, and there is no default that says otherwise.
    assert "pa_difference_deg = " in text
    chosen = table.get("cluster", {}).get("pa_difference_deg", 25.0)
    assert tomllib.loads(text)["cluster"]["pa_difference_deg"] == chosen


def test_another_word_than_drawn_is_refused():
    with pytest.raises(ConfigError, match=r"pa_difference_deg: .*'drawn'"):
        config_simulate.parse({"cluster": {"pa_difference_deg": "random"}}, "test")
