"""The command `jaxlens`: what it prints, what it returns, and what it leaves behind when it fails."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import pytest
from conftest import CommandRun
from typer.testing import CliRunner

from jaxlens import cli, datasets, results, strong


def invoke(*arguments: str) -> Any:
    result = CliRunner().invoke(cli.app, list(arguments), env={"COLUMNS": "200", "NO_COLOR": "1"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def fit(out: Path, source: str = "as1063", *more: str) -> Any:
    return invoke("strong", source, "--out", str(out), "--plane", "source", "--no-cache", *more)


# --- a fit ------------------------------------------------------------------------------------------


def test_a_fit_reports_its_progress_and_its_result(as1063_run: CommandRun):
    result, said = as1063_run.result, as1063_run.result.stderr
    assert result.exit_code == 0
    assert "Abell S1063: 50 images of 19 systems, 11 free numbers, 2 starts" in said
    assert "start  1: chi2 =" in said and "start  2: chi2 =" in said
    assert "50 of 50 images produced, one to one" in said
    assert "2 of 2 starts agree" in said
    assert "members.sigma_ref_km_s" in said
    assert "rms in arcsec by source definition: tensor 0.4" in said
    assert as1063_run.out.name in said
    assert "BIC = " in said and "leaving one system out: rms 0." in said


def test_the_options_are_in_the_summary(as1063_run: CommandRun):
    content = json.loads((as1063_run.out / "summary.json").read_text(encoding="utf-8"))
    assert (content["seed"], content["plane"], len(content["starts"])) == (0, "source", 2)


def stop_at(monkeypatch: pytest.MonkeyPatch, hook: str) -> None:
    """Let the user press Ctrl-C the first time that the fit calls `hook`."""
    real = strong.fit

    def interrupted(problem: strong.Problem, **options: Any) -> strong.StrongFit:
        say: Callable[..., None] = options[hook]

        def then_stop(*args: Any) -> None:
            say(*args)
            raise KeyboardInterrupt

        return real(problem, **{**options, hook: then_stop})

    monkeypatch.setattr(strong, "fit", interrupted)


@pytest.mark.usefixtures("as1063_run")  # its programs are compiled
def test_an_interrupt_after_a_start_keeps_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    stop_at(monkeypatch, "on_start")
    monkeypatch.setattr(results, "figures", lambda *_: {})  # seconds, and the same as of a whole fit
    result = fit(tmp_path / "out", "as1063", "--starts", "3")
    assert result.exit_code == 130
    content = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert content["interrupted"] is True
    assert len(content["starts"]) == 1
    assert content["n_produced"] == 50
    for name in ("model.toml", "images_predicted.ecsv", "kappa.fits", "regions.reg"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    assert "interrupted: the best of the starts that had ended" in result.stderr


@pytest.mark.usefixtures("as1063_run")
def test_an_interrupt_before_the_first_start_has_ended_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    stop_at(monkeypatch, "on_step")
    result = fit(tmp_path / "out")
    assert result.exit_code == 130
    assert "nothing was written" in result.stderr
    assert not (tmp_path / "out").exists()


# --- mistakes -----------------------------------------------------------------------------------------


def copy_of_as1063(folder: Path, file: str, old: str, new: str) -> str:
    """A copy of the data set in which one thing is wrong."""
    shutil.copytree(datasets.path("as1063"), folder)
    text = (folder / file).read_text(encoding="utf-8")
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1), encoding="utf-8")
    return str(folder)


MISTAKES = {
    "unknown key": ("strong.toml", "omega_m", "omega", "cosmology.omega: is not known"),
    "not TOML": ("strong.toml", "[images]", "[images", "is not valid TOML"),
    "no catalogue": ("strong.toml", '"images.csv"', '"arcs.csv"', "arcs.csv does not exist"),
    "no position": ("images.csv", "-28.9483", "east", "'east'"),
    "in front of the lens": ("images.csv", "1.2279", "0.2279", "is not behind the lens"),
    "unknown number": (
        "strong.toml",
        "sigma_lt_km_s",
        "sigma_km_s",
        "sigma_km_s is not a number of the profile",
    ),
}


@pytest.mark.parametrize(("file", "old", "new", "said"), MISTAKES.values(), ids=list(MISTAKES))
def test_a_mistake_in_the_input_is_explained_and_nothing_written(
    tmp_path: Path, file: str, old: str, new: str, said: str
):
    result = fit(tmp_path / "out", copy_of_as1063(tmp_path / "input", file, old, new))
    assert result.exit_code == 2
    assert result.stderr.startswith("error: ")
    assert said in result.stderr, result.stderr
    assert str(tmp_path / "input") in result.stderr, "the file is named"
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    assert not (tmp_path / "out").exists()


def test_an_unknown_input_lists_the_data_sets(tmp_path: Path):
    result = fit(tmp_path / "out", "as1036")
    assert result.exit_code == 2
    assert "as1036 is neither a file" in result.stderr and "as1063" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_file_in_place_of_the_directory_is_noticed_before_the_fit(tmp_path: Path):
    (tmp_path / "out").write_text("mine", encoding="utf-8")
    result = fit(tmp_path / "out")
    assert result.exit_code == 2
    assert "--out" in result.stderr and "is a file" in result.stderr
    assert (tmp_path / "out").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    "options",
    [
        ["--starts", "0"],
        ["--plane", "lens"],
        ["--definition", "own"],
        ["--seed", "-1"],
        ["--sigma-pos", "wide"],
        ["--draws", "-1"],
    ],
    ids=" ".join,
)
def test_impossible_options_are_refused(tmp_path: Path, options: list[str]):
    result = fit(tmp_path / "out", "as1063", *options)
    assert result.exit_code == 2
    assert options[0] in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_second_free_shear_is_refused_before_the_fit(tmp_path: Path):
    result = fit(tmp_path / "out", "as1063", "--shear")
    assert result.exit_code == 2
    assert "has a free external shear already (O2)" in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


def test_a_fit_needs_a_directory_for_its_results():
    result = invoke("strong", "as1063")
    assert result.exit_code == 2
    assert "--out" in result.stderr


# --- the rest -------------------------------------------------------------------------------------------


def test_help_names_the_commands():
    result = invoke("--help")
    assert result.exit_code == 0
    assert "strong" in result.stdout and "datasets" in result.stdout


def test_help_of_the_fit_names_its_options():
    result = invoke("strong", "--help")
    assert result.exit_code == 0
    options = ("--starts", "--seed", "--plane", "--definition", "--sigma-pos", "--draws", "--shear")
    for option in ("INPUT", "--out", *options):
        assert option in result.stdout


def test_data_sets_are_listed():
    result = invoke("datasets")
    assert result.exit_code == 0
    assert [line.split(":")[0] for line in result.stdout.splitlines()] == datasets.names()
    assert "Abell S1063" in result.stdout


def test_a_data_set_says_what_to_cite():
    result = invoke("datasets", "as1063")
    assert result.exit_code == 0
    assert "Richard et al. 2014, MNRAS 444, 268" in result.stdout
    assert "Licence:" in result.stdout


def test_an_unknown_data_set_lists_the_known_ones():
    result = invoke("datasets", "as1036")
    assert result.exit_code == 2
    assert f"the package ships {', '.join(datasets.names())}" in result.stderr
    assert result.stdout == ""


def test_the_module_is_the_command():
    command = [sys.executable, "-W", "error", "-m", "jaxlens.cli", "datasets"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "as1063" in done.stdout
    assert done.stderr == ""


@pytest.fixture
def no_cache():
    """No cache of compiled programs is set, as for a user who never asked for one."""
    before = getattr(jax.config, "jax_compilation_cache_dir", None)
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_cache_that_the_user_has_set_is_kept(monkeypatch: pytest.MonkeyPatch):
    said: dict[str, Any] = {}
    monkeypatch.setattr(jax.config, "update", said.__setitem__)
    cli._prepare_jax(cache=True)
    assert said == {"jax_enable_x64": True}  # the tests have set one


def test_results_that_cannot_be_written_are_refused_before_the_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(strong, "fit", lambda *_, **__: pytest.fail("the fit was begun"))
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    result = fit(tmp_path / "file" / "below", "as1063")
    assert result.exit_code == 2
    assert "is a file; give the name of a directory for the results" in " ".join(result.output.split())


@pytest.mark.usefixtures("as1063_run")  # its programs are compiled
def test_an_interrupt_after_the_fit_says_what_was_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(results, "derive", stop)
    result = fit(tmp_path / "out", "as1063", "--starts", "1")
    assert result.exit_code == 130
    assert "Interrupted after the fit (chi2 = " in result.output
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_cache")
@pytest.mark.parametrize("writable", [True, False])
def test_compiled_programs_are_kept_in_the_cache_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writable: bool
):
    home = tmp_path / "cache"
    if not writable:
        home.write_text("a file where the directory should be", encoding="utf-8")
    said: dict[str, Any] = {}
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    monkeypatch.setattr(jax.config, "update", said.__setitem__)
    cli._prepare_jax(cache=True)
    assert said["jax_enable_x64"] is True
    assert said.get("jax_compilation_cache_dir") == (str(home / "jaxlens") if writable else None)
