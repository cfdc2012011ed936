"""The README's example runs as it stands, and its commands and links exist."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    """What the examples leave behind, run one after the other as in a notebook."""
    found: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        exec(compile(code, "README.md", "exec"), found)
    return found


def test_the_example_finds_images_of_its_source(names: dict[str, Any]) -> None:
    jl, images = names["jl"], names["images"]
    theta = images.theta[images.valid]
    assert len(theta) >= 3
    beta = jl.lens.ray_trace(names["lens"], theta, names["ratio"])
    assert_allclose(beta, np.broadcast_to([1.0, 0.5], beta.shape), atol=1e-8)


def test_the_numbers_of_the_example_are_sane(names: dict[str, Any]) -> None:
    # 1e15 Msun clusters hold a few 1e13 Msun within 100 kpc; the Einstein radius grows with mass.
    assert 1e13 < float(names["mass"][0]) < 2e14
    assert float(names["slope"]) > 0.0
    assert names["kappa"].shape == names["grid"].shape
    assert any(curve.closed and curve.kind == "tangential" for curve in names["curves"].items)


def test_the_map_of_abell_s1063_is_that_of_a_cluster(names: dict[str, Any]) -> None:
    kappa, grid = np.asarray(names["found"].kappa), names["setup"].grid
    row, column = np.unravel_index(kappa.argmax(), kappa.shape)
    assert bool(names["found"].converged)
    # Three pixels from the brightest galaxy: the peak of a map smoothed by 30 arcsec scatters by about one.
    assert np.hypot(grid.x[column], grid.y[row]) < 45.0


def test_links_lead_to_files() -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (ROOT / link).exists(), link


def test_commands_are_in_the_makefile() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"make (run|test|bench|check)\b", TEXT):
        assert f"\n{target}:" in makefile
