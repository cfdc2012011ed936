"""The benchmarks run, and say what they must: time, error, size, machine and versions."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import _composite
import _peers
import jax.numpy as jnp
import numpy as np
import pytest
import table as ratios
from _harness import Report
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
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text(encoding="utf-8"))
    assert result["smoke"] is True
    assert {"cpu", "cores", "versions", "commit"} <= set(result["machine"])
    assert result["machine"]["versions"]["jax"]
    assert result["rows"] and result["checks"]
    for row in result["rows"]:
        assert row["median_ms"] >= row["best_ms"] > 0
        assert row["runs"] >= 3
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


def report_of(folder: Path, name: str, smoke: bool = False) -> Report:
    return Report(name, argparse.Namespace(smoke=smoke, full=False, out=folder / f"{name}.json"))


def test_a_missed_target_fails_the_run_and_stays_in_the_table(tmp_path: Path, capsys, monkeypatch):
    report = report_of(tmp_path, "one")
    ours = report.measure("sum", lambda: sum(range(1000)), size={}, compiled=False, seconds=0.0)
    theirs = report.record("sum, other", [0.5e-3 * ours.best_ms], {}, None)
    report.faster("a sum", ours, theirs, 2.0)
    report.target("seconds", 3.0, most=4.0)
    assert report.finish() == 1
    report = report_of(tmp_path, "short", smoke=True)
    report.target("not measured well", 1.0, least=1.0)
    assert report.finish() == 0
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["table.py", str(tmp_path)])
    assert ratios.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2:4] == [
        "| a sum, times faster than other | 0.5 | >= 2 (missed) | `one.py` |",
        "| seconds | 3 | <= 4 | `one.py` |",
    ]
    assert not any("not measured well" in line for line in lines)


def test_memory_of_numpy_code_is_counted(tmp_path: Path):
    row = report_of(tmp_path, "memory").measure(
        "zeros", lambda: np.zeros(500_000), size={}, compiled=False, traced=True, seconds=0.0
    )
    assert row.memory_mb is not None and 4.0 <= row.memory_mb < 4.5


def test_a_missing_package_is_said_once(tmp_path: Path):
    report = report_of(tmp_path, "missing")
    assert _peers.find(report, "no_such_package", "module") is None
    assert _peers.find(report, "no_such_package", "module") is None
    assert len(report.missing) == 1 and "extra `bench`" in report.missing[0]
