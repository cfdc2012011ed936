"""The notebook on weak lensing runs from top to bottom in a fresh kernel."""

import re
from typing import Any

import pytest
from notebook_support import executed, figures_of, text_of

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def weak_lensing(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return executed("03_weak_lensing.ipynb", tmp_path_factory.mktemp("notebook"))


def test_weak_lensing_shows_where_kaiser_squires_fails(weak_lensing: Any):
    text = text_of(weak_lensing)
    rows = re.findall(r"^(\w\d): median lambda ([\d.]+), half-width ([\d.]+), .*radius ([\d.]+)", text, re.M)
    width = {name: float(width) for name, _, width, _ in rows}
    assert list(width) == ["K1", "K2", "A1", "A2", "A3"]
    assert max(width["A1"], width["A2"], width["A3"]) < 5e-4
    assert min(width["K1"], width["K2"]) > 0.01
    assert all(1.0 < float(median) < 1.3 and float(radius) < 1.0 for _, median, _, radius in rows)


def test_weak_lensing_diverges_where_the_radius_says_so(weak_lensing: Any):
    text = text_of(weak_lensing)
    runs = re.findall(r"^(.*?) +spectral radius +([\d.]+), converged: (\w+)$", text, re.MULTILINE)
    assert [converged for *_, converged in runs] == ["True", "False", "False"]
    assert all((float(radius) < 1.0) == (converged == "True") for _, radius, converged in runs)
    width = re.search(r"GMRES without a mask: half-width ([\d.]+), converged: True", text)
    assert width is not None and float(width[1]) < 0.005


def test_weak_lensing_maps_a_real_cluster_in_four_figures(weak_lensing: Any):
    assert "2134 galaxies in 256 pixels" in text_of(weak_lensing)
    assert "tangential 10.5 sigma, cross -0.5 sigma" in text_of(weak_lensing)
    assert figures_of(weak_lensing) == 4
