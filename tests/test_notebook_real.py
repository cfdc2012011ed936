"""The notebook on a real cluster runs from top to bottom; what it prints agrees with itself."""

import re
from typing import Any

import pytest
from notebook_support import executed, figures_of, text_of

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    notebook: Any = executed("05_real_clusters.ipynb", tmp_path_factory.mktemp("notebook"))
    assert figures_of(notebook) == 3
    return text_of(notebook)


def test_the_ingredients_add_up(text: str):
    rows = re.findall(r"^ *([a-z -]+): lambda ([\d.]+) to ([\d.]+)$", text, re.MULTILINE)
    width = {name: float(high) - float(low) for name, low, high in rows}
    assert set(width) == {
        "shape noise", "photometric redshifts", "strong lensing", "calibration", "together"
    }  # fmt: skip
    alone = [value for name, value in width.items() if name != "together"]
    # 32 draws know a width to an eighth, and the sources of error add in quadrature.
    assert max(alone) < 1.3 * width["together"]
    assert width["together"] < sum(alone)
    # The images know the core far better than the shapes know the field.
    assert width["strong lensing"] < width["shape noise"]


def test_both_routes_agree(text: str):
    pattern = r"^{}: +lambda = ([\d.]+) \+- ([\d.]+), m = ([\d.]+) \+- ([\d.]+)$"
    two, one = (
        [float(part) for part in re.findall(pattern.format(name), text, re.MULTILINE)[0]]
        for name in ("two steps", "together")
    )
    assert abs(two[0] - one[0]) < 2.0 * (two[1] + one[1])
    # The map knows something about the calibration that its prior does not.
    assert one[3] < two[3]
    correlation = re.search(r"correlation ([+-][\d.]+); error of lambda for a known m ([\d.]+)", text)
    assert correlation is not None
    # Laplace: the error for a known m is the marginal one times sqrt(1 - c^2), up to what is printed.
    expected = one[1] * (1.0 - float(correlation[1]) ** 2) ** 0.5
    assert float(correlation[2]) == pytest.approx(expected, rel=0.1)


def test_the_twin_has_the_truth_near(text: str):
    found = re.search(r"lambda of the twin ([\d.]+), 68 % ([\d.]+) to ([\d.]+)\ntrue lambda ([\d.]+)", text)
    assert found is not None
    lam, low, high, true = (float(part) for part in found.groups())
    assert low < high
    assert abs(lam - true) < 2.0 * (high - low)
