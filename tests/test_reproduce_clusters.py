"""Many clusters: counts of verdicts with binomial errors, resuming, failures as rows, figures and report."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from matplotlib.patches import Rectangle

from jaxlens import config_simulate, io, plotting, reproduce, strong, workflow
from jaxlens._command_reproduce import write_many
from jaxlens.reproduce import CLAIMS, OURS, _clusters, _one
from jaxlens.reproduce._strong import SLModel, statistics

CLUSTER68 = Path(__file__).parent.parent / "benchmarks" / "data" / "cluster68"

KEYS = [claim.key for claim in (*CLAIMS, *OURS)]


def row(seed: int, verdict: str = "holds here", value: float | None = 1.0) -> dict[str, Any]:
    return {
        "seed": seed,
        "statements": {key: {"value": value, "error": 0.1, "verdict": verdict} for key in KEYS},
    }


ROWS = [row(0), row(1), row(2, "undecided"), row(3, "does not hold here", None), {"seed": 4, "failed": "no"}]


def content(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "made_with": {"version": "0", "realisations": 64, "settings": {}},
        "clusters": rows,
        "statements": reproduce.tally(rows),
    }


def test_shares_are_counted_over_the_clusters_that_ran():
    said = reproduce.tally(ROWS)["a2_is_sharp"]
    assert said["clusters"] == 4
    assert said["verdicts"] == {"holds here": 2, "undecided": 1, "does not hold here": 1}
    assert said["share"] == 0.5
    # Binomial error of (2 + 1)/(4 + 2).
    assert said["error"] == pytest.approx(math.sqrt(0.5 * 0.5 / 4.0))


def test_an_error_remains_when_all_clusters_agree():
    said = reproduce.tally([row(k) for k in range(10)])["a2_is_sharp"]
    assert said["share"] == 1.0
    assert said["error"] == pytest.approx(math.sqrt(11.0 / 12.0 * (1.0 / 12.0) / 10.0))


def test_no_cluster_is_no_share():
    said = reproduce.tally([ROWS[-1]])["a2_is_sharp"]
    assert said["share"] is None and said["clusters"] == 0


def test_files_and_figures_of_many_clusters(tmp_path: Path):
    write_many(content(ROWS), tmp_path)
    assert json.loads((tmp_path / "clusters.json").read_text())["clusters"][2]["seed"] == 2
    assert {path.stem for path in (tmp_path / "cluster_figures").glob("*.png")} == {"shares", *KEYS}
    text = (tmp_path / "clusters.html").read_text()
    assert "Seeds that failed: 4." in text and "5 clusters with seeds 0 to 4" in text


def test_a_cluster_that_fails_is_a_row_with_its_reason(monkeypatch: pytest.MonkeyPatch):
    def fake(seed: int, settings: Any, n: int) -> dict[str, Any]:
        if seed == 2:
            raise ValueError("Seed 2 gives no multiple images.")
        return row(seed)

    monkeypatch.setattr(_clusters, "one_cluster", fake)
    said = config_simulate.Simulate()
    rows = [reproduce.cluster_row(seed, said, 64) for seed in (1, 2, 3)]
    assert [one.get("failed") for one in rows] == [None, "ValueError: Seed 2 gives no multiple images.", None]
    content = reproduce.clusters_content(rows, said, 64)
    assert content["statements"]["a2_is_sharp"]["clusters"] == 2
    assert content["made_with"] == reproduce.stamp(said, 64)


@pytest.mark.parametrize(
    ("error", "again"),
    [
        (ValueError("no images"), False),
        (np.linalg.LinAlgError("Singular matrix"), False),
        (RuntimeError("9 galaxies were drawn but there is room for 8; take another seed."), False),
        (eqx.EquinoxRuntimeError("The linear solver failed.\n--------------------\nAdvice."), False),
        (RuntimeError("can't start new thread"), True),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes."), True),
        (MemoryError(), True),
        (OSError(28, "No space left on device"), True),
        (ModuleNotFoundError("No module named 'scipy'"), True),
        (KeyError("kappa"), True),
    ],
)
def test_failures_of_the_machine_are_told_from_those_of_the_cluster(
    error: Exception, again: bool, monkeypatch: pytest.MonkeyPatch
):
    def fake(seed: int, settings: Any, n: int) -> dict[str, Any]:
        raise error

    monkeypatch.setattr(_clusters, "one_cluster", fake)
    found = reproduce.cluster_row(1, config_simulate.Simulate(), 64)
    assert found.get("try_again", False) is again
    assert found["failed"].startswith(f"{type(error).__name__}: ")
    assert "Advice" not in found["failed"] and found["failed"].rstrip(": ") != type(error).__name__


def test_no_message_names_a_temporary_directory(monkeypatch: pytest.MonkeyPatch):
    def fake(seed: int, settings: Any, n: int) -> dict[str, Any]:
        with TemporaryDirectory(prefix=_one.SCRATCH) as folder:
            raise ValueError(f"{folder}/rectangle/strong.toml: bad, see `{folder}`.")

    monkeypatch.setattr(_clusters, "one_cluster", fake)
    found = reproduce.cluster_row(1, config_simulate.Simulate(), 64)
    assert found["failed"] == "ValueError: rectangle/strong.toml: bad, see ``."


def test_values_of_a_statement_leave_out_failures_and_mark_what_was_not_measured():
    found = reproduce.measured(ROWS, "a2_is_sharp")
    assert [one.value for one in found[:3]] == [1.0, 1.0, 1.0] and math.isnan(found[3].value)


def test_figures_show_every_cluster_and_range():
    names, held, undecided, failed, error = reproduce.shares(content(ROWS))
    fig = plotting.statement_shares(names, held, undecided, failed, error)
    widths = [patch.get_width() for patch in fig.axes[0].patches if isinstance(patch, Rectangle)]
    assert np.allclose(np.sum(np.reshape(widths, (3, -1)), axis=0), 1.0)
    fig = plotting.statement_values(
        [0.0, math.nan], [0.1, math.nan], ["1", "2"], claimed=(-1.0, math.inf), x_label="x"
    )
    texts = [text.get_text() for text in fig.axes[0].texts]
    assert texts == ["not measured"]


def test_sweep_figure_says_where_nothing_was_found():
    base = {
        "transition_kpc_h": 200.0, "transition_lo_kpc_h": 150.0, "transition_hi_kpc_h": 230.0,
        "shape_crossing_kpc_h": 210.0, "lambda_bias": -0.01, "lambda_scatter": 0.005,
    }  # fmt: skip
    nothing = {"transition_kpc_h": None, "transition_lo_kpc_h": None, "transition_hi_kpc_h": None}
    rows = [base | {"value": 50.0}, base | nothing | {"value": 100.0}, {"value": 1.0, "failed": "no images"}]
    fig = plotting.sweep(rows, x_label="n", at=50.0)
    top = fig.axes[0]
    assert [text.get_text() for text in top.texts] == ["not found"]
    assert [text.xy[0] for text in top.texts] == [100.0]  # type: ignore[attr-defined]


def test_an_unknown_sweep_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="n0, m_tele"):
        reproduce.sweep("n_0", 0, config_simulate.Simulate(), tmp_path)


def test_shipped_clusters_are_tallied_as_they_stand():
    said = reproduce.shipped()
    assert said is not None
    rows = said["clusters"]
    assert len(rows) == 10 and len({one["seed"] for one in rows}) == 10
    assert said["made_with"]["realisations"] == 256
    known = json.loads(json.dumps(reproduce.tally(rows)))
    for key, one in said["statements"].items():
        assert one["verdicts"] == known[key]["verdicts"], key
        assert one["share"] == pytest.approx(known[key]["share"])
    assert "10 clusters with seeds 101 to 110" in str(reproduce.section(said, "Shipped:").parts[0])


def test_rows_of_another_rule_are_refused(tmp_path: Path):
    """Transition radii of two rules are not mixed."""
    made_with = reproduce.stamp(config_simulate.Simulate(), 64)
    assert made_with["transition"] == {"sheet": "all annuli", "annuli_above_1": 2, "fewest_pixels": 8}
    path = reproduce.cluster_file(tmp_path, 1)
    older = {name: value for name, value in made_with.items() if name != "transition"}
    io.write_json(path, {"made_with": older, "cluster": row(1)})
    with pytest.raises(ValueError, match="other settings, realisations or version"):
        reproduce.finished(path, made_with)
    io.write_json(path, {"made_with": made_with, "cluster": row(1)})
    assert reproduce.finished(path, made_with) is not None


def test_as_many_free_numbers_as_coordinates_leave_no_reduced_chi2():
    """A cluster with 13 images, and the 26 free numbers of every model here."""
    whole = workflow.load(str(CLUSTER68 / "start_perturbed.input"))
    images = whole.problem.images
    source = images.source[:13]
    count = int(source[-1]) + 1
    few = strong.ImageCatalogue(images.theta[:13], source, images.z_s[:count], images.sigma_pos[:13])
    model = whole.model
    model = replace(model, dls_ds=model.dls_ds[:count], systems=())
    problem = replace(whole.problem, build=model, images=few)
    fit = strong.fit(strong.rounded(problem), n_starts=1, start=whole.start)
    said = statistics(SLModel("rectangle", replace(whole, problem=problem), fit, 2))
    assert said["n_parameters"] == 2 * said["n_images"] == 26
    assert said["chi2_nu"] is None and said["chi2_nu_with_sources"] is None
    assert said["rms_arcsec"] < 1.0


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not say what a process holds")
@pytest.mark.parametrize(("share", "dropped"), [(0.0, 1), (1e6, 0)])
def test_programs_are_dropped_when_memory_or_mappings_run_out(
    monkeypatch: pytest.MonkeyPatch, share: float, dropped: int
):
    times = []
    monkeypatch.setattr(_clusters, "_SHARE", share)
    monkeypatch.setattr(_clusters, "one_cluster", lambda seed, settings, n: {"seed": seed})
    monkeypatch.setattr(jax, "clear_caches", lambda: times.append(1))
    assert reproduce.cluster_row(3, config_simulate.Simulate(), 64) == {"seed": 3}
    assert len(times) == dropped
