"""Every notebook comes without stored results; the first one, on strong lensing, runs from top to bottom."""

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from notebook_support import FOLDER, executed, figures_of, read, text_of

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def test_there_are_notebooks():
    assert [path.name[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_results_are_not_stored(path: Path):
    notebook = read(path)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None, cell.source[:60]


@pytest.fixture(scope="module")
def strong_lensing(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return executed("01_strong_lensing.ipynb", tmp_path_factory.mktemp("notebook"))


@pytest.mark.long
def test_strong_lensing_has_its_three_figures(strong_lensing: Any):
    assert figures_of(strong_lensing) == 3


@pytest.mark.long
def test_strong_lensing_fits_as1063_as_well_as_the_published_model(strong_lensing: Any):
    text = text_of(strong_lensing)
    assert "2 of 2 starts agree, at a bound: nothing" in text
    rows = re.findall(r"^(tensor|mu_mean|mean) +([\d.]+) +([\d.]+)$", text, re.MULTILINE)
    rms = {name: (float(ours), float(theirs)) for name, ours, theirs in rows}
    # The fit is of the source-plane chi^2, whose own definition is `tensor`.
    assert rms["tensor"][0] < rms["tensor"][1] < 0.42
    assert set(rms) == {"tensor", "mu_mean", "mean"}
    assert re.search(r"images produced +50 +50 +of 50", text)


@pytest.mark.long
def test_strong_lensing_finds_the_published_mass(strong_lensing: Any):
    found = re.findall(
        r"^(this fit|published) +theta_E\(z = 2\) = ([\d.]+) arcsec .*?, ([\d.]+) arcsec .*= ([\d.e+]+) Msun",
        text_of(strong_lensing),
        re.MULTILINE,
    )
    number = {name: [float(part) for part in parts] for name, *parts in found}
    # 1 per cent: two fits of the same images, by different chi^2.
    assert number["this fit"] == pytest.approx(number["published"], rel=0.01)
    assert number["published"][1] == pytest.approx(29.62, abs=0.05)  # reference_numbers.csv
    assert number["published"][2] == pytest.approx(2.031e14, rel=1e-3)
