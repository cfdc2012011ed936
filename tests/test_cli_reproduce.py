"""The command `jaxlens reproduce`: what it refuses before any work. The lambda notebook runs the rest."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from jaxlens import cli, config_simulate, reproduce, workflow_simulate
from jaxlens.simulate import DEFAULT_SEED


def invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, ["reproduce", *arguments], env={"COLUMNS": "200", "NO_COLOR": "1"})


@pytest.mark.parametrize(
    ("text", "arguments", "said"),
    [
        ("", ("--sweep", "n0,depth"), "--sweep: 'depth' is not known; give one or more of n0, m_tele"),
        ("[cluster]\nz_l = -0.1", (), "z_l"),
        ("[shear]\npixel = 3", (), "pixel"),
        ("[cluster", (), "config.toml"),
    ],
)
def test_a_mistake_is_refused_before_any_work(
    text: str, arguments: tuple[str, ...], said: str, tmp_path: Path
):
    config = tmp_path / "config.toml"
    config.write_text(text, encoding="utf-8")
    result = invoke("--out", str(tmp_path / "out"), "--config", str(config), *arguments)
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_way_is_named(tmp_path: Path):
    (tmp_path / "out").write_text("mine", encoding="utf-8")
    result = invoke("--out", str(tmp_path / "out" / "deeper"))
    assert result.exit_code == 2 and "is a file" in " ".join(result.output.split())
    assert (tmp_path / "out").read_text(encoding="utf-8") == "mine"


def test_unknown_variants_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="rectangle"):
        reproduce.run(0, config_simulate.Simulate(), tmp_path, variants=("field",))


def test_the_default_is_the_default_cluster():
    assert workflow_simulate.load().seed == DEFAULT_SEED
