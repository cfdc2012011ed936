"""The notebook on a population: its figures, and what it prints, from the rows that ship with the package."""

import re
from typing import Any

import numpy as np
import pytest
from notebook_support import executed, figures_of, text_of
from numpy.testing import assert_allclose
from scipy.stats import spearmanr

from jaxlens import population


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return executed("06_population.ipynb", tmp_path_factory.mktemp("notebook"))


@pytest.fixture(scope="module")
def table() -> dict[str, np.ndarray]:
    shipped = population.shipped()
    assert shipped is not None
    return dict(population.columns(shipped["clusters"]))


def test_notebook_draws_every_figure_of_the_report(done: Any):
    assert figures_of(done) == 5


def test_notebook_says_what_the_report_says(done: Any, table: dict[str, np.ndarray]):
    text = text_of(done)
    assert f"{len(table['failed'])} clusters, 256 noise realisations of each" in text
    for name, value in population.facts(table).items():
        assert f"{name}: {value}" in text


def test_rank_correlations_are_those_of_scipy(done: Any, table: dict[str, np.ndarray]):
    good = table["failed"] == ""
    outcomes = (
        np.abs(table["lambda_rec"] / table["lambda_true_inner"] - 1.0),
        np.isfinite(table["shape_crossing_kpc_h"]).astype(float),
        table["transition_share_found"],
        table["transition_share_near_crossing"],
    )
    rows = re.findall(r"^ *(\w+)((?: +-?(?:\d\.\d\d|nan)){4})$", text_of(done), re.MULTILINE)
    assert len(rows) == 10
    for name, values in rows:
        for printed, outcome in zip(map(float, values.split()), outcomes, strict=True):
            use = good & np.isfinite(table[name]) & np.isfinite(outcome)
            expected = np.asarray(spearmanr(table[name][use], outcome[use]))[0]
            assert_allclose(printed, expected, atol=0.006)  # two digits are printed
