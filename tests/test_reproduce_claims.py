"""The paper's statements as ranges: a verdict is where a number and its error lie, and nothing else."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from jaxlens.reproduce import _statements
from jaxlens.reproduce._numbers import largest_change
from jaxlens.reproduce._statements import CLAIMS, Claim, Measured, judge

BETWEEN = Claim("between", "It lies between.", "x", low=-1.0, high=1.0, unit="%")


@pytest.mark.parametrize(
    ("value", "error", "verdict"),
    [
        (0.0, 0.5, "holds here"),
        (0.9, 0.1, "holds here"),
        (0.9, 0.2, "undecided"),
        (1.1, 0.2, "undecided"),
        (1.3, 0.2, "does not hold here"),
        (-1.3, 0.2, "does not hold here"),
        (0.0, 5.0, "undecided"),
        (math.nan, 0.1, "undecided"),
        (0.0, math.nan, "undecided"),
        (math.inf, 0.0, "undecided"),
    ],
)
def test_verdict_is_where_the_number_and_its_error_lie(value: float, error: float, verdict: str):
    assert BETWEEN.judge(Measured(value, error)) == verdict


@given(st.floats(-1e3, 1e3), st.floats(0.0, 1e3), st.sampled_from(CLAIMS))
def test_a_larger_error_never_decides_more(value: float, error: float, claim: Claim):
    """With a growing error a verdict may only become "undecided", never turn round."""
    sharp, blunt = claim.judge(Measured(value, error)), claim.judge(Measured(value, 2.0 * error))
    assert blunt in (sharp, "undecided")


def test_every_claim_has_its_own_name_and_says_its_range():
    assert len({claim.key for claim in CLAIMS}) == len(CLAIMS)
    assert all(claim.figure and claim.text.endswith(".") for claim in CLAIMS)
    assert all(claim.low > -math.inf or claim.high < math.inf for claim in CLAIMS), "a claim that cannot fail"
    assert BETWEEN.range == "-1 to 1 %"
    assert Claim("a", "A.", "x", low=2.0).range == "above 2"
    assert Claim("a", "A.", "x", high=2.0, unit="kpc/h").range == "below 2 kpc/h"


def test_a_claim_without_a_number_is_undecided_and_a_number_without_a_claim_is_refused():
    found = judge({"a2_is_sharp": Measured(6.0)})
    assert {one.claim.key: one.verdict for one in found} == {
        claim.key: "holds here" if claim.key == "a2_is_sharp" else "undecided" for claim in CLAIMS
    }
    with pytest.raises(KeyError, match="no_such_claim"):
        judge({"no_such_claim": Measured(1.0)})


def test_summary_is_plain():
    content = _statements.judge({"between": Measured(1.3, 0.2)}, [BETWEEN])[0].summary()
    assert content["verdict"] == "does not hold here"
    assert (content["value"], content["error"], content["low"], content["high"]) == (1.3, 0.2, -1.0, 1.0)


def test_annuli_without_scatter_say_nothing_about_the_mask():
    base = np.array([[0.0, 1.0, 2.0, 1.0], [0.0, 3.0, 2.0, 1.0]])
    other = np.array([[0.5, 2.0, 1.8, 9.0], [0.7, 2.2, 2.0, 9.0]])
    found = largest_change(other, base, np.array([True, True, True, False]))
    # 2.1 against 2.0, and 1.9 against 2.0: the first of two equal ones; the last lies outside.
    assert_allclose(found.value, 5.0)
    assert_allclose(found.error, 100.0 * 0.1 * math.sqrt(2.0) / 2.0 / math.sqrt(2.0))
    assert math.isnan(largest_change(other, 0.0 * base, np.array([True, True, True, False])).value)
