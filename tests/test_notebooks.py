"""Every notebook runs from top to bottom in a fresh kernel, and comes without stored results."""

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def read(path: Path) -> Any:
    return nbformat.read(path, as_version=4)


def text_of(notebook: Any) -> str:
    return "".join(
        out.text
        for cell in notebook.cells
        for out in cell.get("outputs", [])
        if out.output_type == "stream" and out.name == "stdout"
    )


def test_there_are_notebooks():
    assert [path.name for path in NOTEBOOKS][:2] == ["01_strong_lensing.ipynb", "02_simulated_cluster.ipynb"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_results_are_not_stored(path: Path):
    notebook = read(path)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None, cell.source[:60]


def executed(name: str, folder: Path) -> Any:
    """The notebook with its results; it must write nothing to its standard error."""
    notebook = read(FOLDER / name)
    # A minute on two idle cores; the limit per cell is for loaded ones.
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    done = client.execute()
    for cell in done.cells:
        for out in cell.get("outputs", []):
            assert not (out.output_type == "stream" and out.name == "stderr"), out.text
    return done


def figures_of(notebook: Any) -> int:
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    return sum("image/png" in out.get("data", {}) for out in outputs)


@pytest.fixture(scope="module")
def strong_lensing(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return executed("01_strong_lensing.ipynb", tmp_path_factory.mktemp("notebook"))


def test_strong_lensing_has_its_three_figures(strong_lensing: Any):
    assert figures_of(strong_lensing) == 3


def test_strong_lensing_fits_as1063_as_well_as_the_published_model(strong_lensing: Any):
    text = text_of(strong_lensing)
    assert "2 of 2 starts agree, at a bound: nothing" in text
    rows = re.findall(r"^(tensor|mu_mean|mean) +([\d.]+) +([\d.]+)$", text, re.MULTILINE)
    rms = {name: (float(ours), float(theirs)) for name, ours, theirs in rows}
    # The fit is of the source-plane chi^2, whose own definition is `tensor`.
    assert rms["tensor"][0] < rms["tensor"][1] < 0.42
    assert set(rms) == {"tensor", "mu_mean", "mean"}
    assert re.search(r"images produced +50 +50 +of 50", text)


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


@pytest.fixture(scope="module")
def simulated_cluster(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return executed("02_simulated_cluster.ipynb", tmp_path_factory.mktemp("notebook"))


def test_simulated_cluster_has_its_three_figures(simulated_cluster: Any):
    assert figures_of(simulated_cluster) == 3


def test_simulated_cluster_is_the_frozen_one(simulated_cluster: Any):
    text = text_of(simulated_cluster)
    # The rule by which the seed was chosen, and what came out of it.
    assert re.search(r"^25 systems with 68 images$", text, re.MULTILINE)
    assert "662.1 expected" in text
    found = re.search(r"every image solves the lens equation: (\S+) arcsec", text)
    assert found is not None
    assert float(found[1]) < 1e-6


def test_simulated_cluster_compares_the_shear_modes(simulated_cluster: Any):
    rows = re.findall(
        r"^(extended|periodic) +([\d.]+) at 60-120 arcsec, ([\d.]+) at 120-240 arcsec$",
        text_of(simulated_cluster),
        re.MULTILINE,
    )
    error = {name: (float(inner), float(outer)) for name, inner, outer in rows}
    assert max(error["extended"]) < 1e-3
    assert error["periodic"][1] > 0.01
