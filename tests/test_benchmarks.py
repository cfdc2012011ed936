"""The benchmarks run, and say what they must: time, error, size, machine and versions."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


# Rounding for closed forms and sums; the differences of the gradient's reference have errors of 1e-8, the
# expansion of an NFW halo 4e-5. Scripts whose smoke run takes more than 15 s are not run here.
LIMITS = {
    "deflection": {"members": 1e-12, "gradient": 1e-6},
    "export": {},
    "shear_catalogue": {"map": 1e-12, "profile": 1e-12, "one aperture": 1e-12},
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
    errors = {row["name"]: row["error"] for row in result["rows"] if row["error"] is not None}
    for row, limit in LIMITS[name].items():
        assert errors[row] < limit, row
