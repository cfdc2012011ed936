"""The notebook on the simulated cluster runs from top to bottom in a fresh kernel."""

import re
from typing import Any

import pytest
from notebook_support import executed, figures_of, text_of

pytestmark = pytest.mark.long


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
    kappa = re.search(r"^mean kappa of the field for z_s = 2: ([\d.]+)$", text, re.MULTILINE)
    assert kappa is not None
    assert 0.11 < float(kappa[1]) < 0.15
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
