"""The benchmarks run, and say what they must: time, error, size, machine and versions."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import _composite
import _peers
import jax.numpy as jnp
import numpy as np
import pytest
import table as ratios
from _harness import Report, Row, parser
from _results import Target
from support import relative_error, table

from jaxlens import lens as lensing
from jaxlens import lenstronomy, strong

ROOT = Path(__file__).parent.parent


# Rounding for closed forms and sums; the differences of a gradient's reference have errors of 1e-8, the
# expansion of an NFW halo 4e-5; a pull of 6 standard errors among a few hundred pixels is no chance; no image
# is missed. Scripts whose smoke run takes more than a minute are not run here.
LIMITS = {
    "akra": {"A2 by CG, cg_tol 0.1": 2e-3},
    "chi2_gradient": {"gradient": 1e-6, "Jacobian": 1e-6},
    "deflection": {"members": 1e-12, "gradient": 1e-6},
    "export": {},
    "ks": {"E and B map": 1e-11},
    "lambda_monte_carlo": {"lambda(r), float32": 1e-3},
    "lens_equation": {"composite of 54": 1e-12},
    "map_render": {"map": 4e-5},
    "shape_noise": {"realisations": 6.0},
    "shear_catalogue": {"map": 1e-12, "profile": 1e-12, "one aperture": 1e-12},
    "strong_fit": {"cluster68 Jacobian": 1e-6},
    "strong_real": {},
    "simulated_cluster": {"map": 4e-5},
}


@pytest.mark.long
@pytest.mark.parametrize("name", LIMITS)
def test_smoke_run(name: str, tmp_path: Path):
    out = tmp_path / "result.json"
    command = [sys.executable, str(ROOT / "benchmarks" / f"{name}.py"), "--smoke", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr
    result = json.loads(out.read_text(encoding="utf-8"))
    assert result["smoke"] is True
    assert {"cpu", "cores", "threads", "versions", "commit"} <= set(result["machine"])
    assert result["machine"]["versions"]["jax"]
    assert result["rows"] and result["checks"]
    for row in result["rows"]:
        assert row["median_ms"] >= row["best_ms"] > 0
        assert row["runs"] >= (1 if row["compile_s"] is None else 3)
        assert (row["memory_mb"] is None) == (row["memory_kind"] is None)
    for row, limit in LIMITS[name].items():
        errors = [one["error"] for one in result["rows"] if one["name"] == row]
        assert errors and all(error is not None and error < limit for error in errors), row


def test_the_composite_is_that_of_the_reference():
    composite = _composite.load()
    assert (len(composite.p), composite.images.n_images, composite.images.n_systems) == (26, 68, 22)
    reference = table("lenstronomy/cluster_values.csv")
    at = jnp.stack([jnp.asarray(reference["x"]), jnp.asarray(reference["y"])], axis=1)
    alpha = np.asarray(lensing.alpha(composite.lens(composite.p), at))
    for k, name in enumerate(("alpha_x", "alpha_y")):
        assert relative_error(alpha[:, k], reference[name]) < 1e-10  # 54 terms, the same formulas


def test_other_programs_get_the_same_lens():
    composite = _composite.load()
    names, numbers = lenstronomy.export(composite.lens(composite.p), 1.0)
    assert names == _peers.names(composite)
    for ours, theirs in zip(_peers.keywords(composite.p, composite), numbers, strict=True):
        assert set(ours) == set(theirs)
        for key, value in theirs.items():
            np.testing.assert_allclose(ours[key], value, rtol=1e-12, atol=1e-14, err_msg=key)


def test_other_programs_get_the_same_chi2():
    composite = _composite.load()
    theta = composite.images.theta

    def fields(p: np.ndarray) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        alpha, h = (np.asarray(part) for part in lensing.alpha_and_hessian(composite.lens(p), theta))
        return (alpha[:, 0], alpha[:, 1]), (h[:, 0, 0], h[:, 0, 1], h[:, 1, 1])

    for p in (composite.p, 1.03 * composite.p):
        prediction = strong.Prediction(composite.lens(p), jnp.asarray(composite.dls_ds))
        ours = float(strong.chi2_source(prediction, composite.images))
        # The inverse of the covariance there, its Cholesky factor here: |mu| reaches 30.
        assert abs(float(_peers.chi2_from(fields, composite, np)(p)) / ours - 1.0) < 1e-9


def test_more_members_and_images_repeat_the_composite():
    base = _composite.load()
    more = base.resized(120, copies=3)
    assert len(more.lens(more.p).components["members"]) == 120
    assert (more.images.n_images, more.images.n_systems) == (204, 66)
    once = strong.chi2_source(strong.Prediction(base.lens(base.p), jnp.asarray(base.dls_ds)), base.images)
    thrice = base._replace(images=more.images, dls_ds=more.dls_ds)
    found = strong.chi2_source(
        strong.Prediction(base.lens(base.p), jnp.asarray(thrice.dls_ds)), thrice.images
    )
    np.testing.assert_allclose(found, 3.0 * once, rtol=1e-12)


def report_of(folder: Path, name: str, *options: str) -> Report:
    return Report(name, parser("").parse_args([*options, "--out", str(folder / f"{name}.json")]))


def measured(report: Report, seconds: float, error: float | None = 0.0, **options: Any) -> Row:
    """A row of a function that sleeps."""
    known = None if error is None else lambda _: error
    sleep = lambda: time.sleep(seconds)
    return report.measure(
        f"sleep, {seconds:g} s", sleep, size={}, compiled=False, seconds=0.0, error=known, **options
    )


def printed(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *options: str):
    """Exit status of `table.py`, and the lines that it prints."""
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["table.py", str(folder), *options])
    return ratios.main(), capsys.readouterr().out.splitlines()


def test_a_missed_target_fails_the_run_and_stays_in_the_table(tmp_path: Path, capsys, monkeypatch):
    report = report_of(tmp_path, "one")
    report.target("a sum, times faster than other", 0.4, 0.5, 0.7, least=2.0)
    report.target("seconds", 3.0, most=4.0)
    report.target("for information", 7.0)
    assert report.finish() == 1
    short = report_of(tmp_path, "short", "--smoke")
    short.target("not measured well", 1.0, least=2.0)
    assert short.finish() == 0
    status, lines = printed(tmp_path, capsys, monkeypatch)
    assert status == 0
    assert lines[2:5] == [
        "| a sum, times faster than other | 0.5 (0.4 to 0.7, 3 runs) | >= 2 (missed) |  |  | `one.py` |",
        "| seconds | 3 | <= 4 |  |  | `one.py` |",
        "| for information | 7 |  |  |  | `one.py` |",
    ]
    assert not any("not measured well" in line for line in lines)
    status, lines = printed(tmp_path, capsys, monkeypatch, "--smoke")
    assert status == 0 and "not measured well" in lines[2]


def test_functions_are_compared_in_turns(tmp_path: Path):
    report = report_of(tmp_path, "turns", "--smoke")
    ours, theirs = measured(report, 0.002), measured(report, 0.02, units=2)
    report.faster("sleep", ours, theirs, 1.0, error=1e-9)
    (one,) = report.targets
    assert one.runs == 2 and one.ratio is not None and one.lowest is not None and one.highest is not None
    assert one.lowest <= one.ratio <= one.highest
    assert 2.0 < one.ratio < 6.0  # a unit of theirs takes 10 ms; a sleep may take longer, never less
    assert [check.smoke for check in report.checks] == [False, True]
    assert one.errors == [0.0, 0.0] and one.cores is not None and max(c or 0.0 for c in one.cores) < 0.9
    report.finish()
    assert ratios.pair(Target.read(report.targets[0].saved()).errors, ".0e") == "0e+00, 0e+00"


def test_times_are_not_compared_without_errors(tmp_path: Path):
    report = report_of(tmp_path, "errors", "--smoke")
    ours, theirs = measured(report, 0.001), measured(report, 0.001, error=None)
    with pytest.raises(ValueError, match="need an `error`"):
        report.as_exact("sleep", ours, theirs, 1.0)
    report.as_exact("sleep", ours, measured(report, 0.001, error=0.1), 0.01)
    assert report.finish() == 1  # a smoke run judges errors
    recorded = report.record("elsewhere", [1.0], {})
    with pytest.raises(ValueError, match="recorded"):
        report.ratio("sleep", recorded, ours)


def test_a_missing_package_fails_a_full_run_and_keeps_its_place(tmp_path: Path, capsys, monkeypatch):
    for options, status in (((), 1), (("--without-peers",), 0), (("--smoke",), 0)):
        report = report_of(tmp_path, "missing", *options)
        assert _peers.find(report, "no_such_package", "module") is None
        assert _peers.find(report, "no_such_package", "module") is None
        assert len(report.missing) == 1 and "extra `bench`" in report.missing[0]
        report.unmeasured("a map, times faster than it", "no_such_package missing", least=75.0)
        assert report.finish() == status
    _, lines = printed(tmp_path, capsys, monkeypatch, "--smoke")
    reason = "not measured (no_such_package missing)"
    row = f"| a map, times faster than it | {reason} | >= 75 |  |  | `missing.py` |"
    assert lines[2] == row


def test_results_that_do_not_belong_together_make_no_table(tmp_path: Path, capsys, monkeypatch):
    for name in ("one", "two"):
        report = report_of(tmp_path, name)
        report.target("seconds", 3.0)
        report.finish()
    assert printed(tmp_path, capsys, monkeypatch)[0] == 0
    path = tmp_path / "two.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    other = {**content, "machine": {**content["machine"], "commit": "another"}}
    path.write_text(json.dumps(other), encoding="utf-8")
    status, lines = printed(tmp_path, capsys, monkeypatch)
    assert status == 1 and "commit" in lines[-1] and any("commit another" in line for line in lines)
    path.write_text(json.dumps({**content, "elapsed_s": 1e4}), encoding="utf-8")
    status, lines = printed(tmp_path, capsys, monkeypatch)
    assert status == 1 and "missed" in lines[-1]


def test_a_run_that_breaks_off_leaves_no_old_results(tmp_path: Path):
    report_of(tmp_path, "old").finish()
    assert (tmp_path / "old.json").exists()
    report_of(tmp_path, "old")
    assert not (tmp_path / "old.json").exists()
    names = [Report("x", parser("").parse_args(options)).path.name for options in ([], ["--smoke"])]
    assert names == ["x.json", "x.smoke.json"]


def test_memory_of_numpy_code_is_counted(tmp_path: Path):
    row = report_of(tmp_path, "memory").measure(
        "zeros", lambda: np.zeros(500_000), size={}, compiled=False, traced=True, seconds=0.0
    )
    assert row.memory_mb is not None and 4.0 <= row.memory_mb < 4.5
    assert row.memory_kind == "NumPy peak"
