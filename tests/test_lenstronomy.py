"""Export to lenstronomy: the stored cases come out as they went in.

`test_reference_lenstronomy.py` compares the fields of the same lenses with lenstronomy's values, and
`benchmarks/export.py` with lenstronomy itself.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_reference_lenstronomy import CASES, NUMBERS, converted

from jaxlens import lenstronomy
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, SIE, TSIS, PointMass

SAME = [
    "nfw_ellipse_cse_q08",
    "nfw_ellipse_cse_q05_off",
    "hernquist_glafic_convention_q08",
    "hernquist_ellipse_cse_q05_off",
    "pjaffe",
    "pjaffe_smallcore_off",
    "nie_q07",
    "shear",
    "convergence",
    "point_mass",
]


@pytest.mark.parametrize("case", SAME)
def test_stored_cases_come_out_as_they_went_in(case: str) -> None:
    names, numbers = lenstronomy.export(Lens(one=converted(CASES[case], NUMBERS[case])), 1.0)
    assert names == [CASES[case]]
    assert set(numbers[0]) == set(NUMBERS[case])
    for key, value in NUMBERS[case].items():
        assert_allclose(numbers[0][key], value, rtol=1e-12, atol=1e-14, err_msg=key)


def test_an_elliptical_dpie_is_two_isothermals_of_opposite_sign() -> None:
    component = Component(DPIE(b=1.3, r_core=0.0, r_cut=12.0, e=0.2), (4.0, 5.0), 0.3)
    names, (core, cut) = lenstronomy.export(Lens(one=component), 0.5)
    assert names == ["NIE", "NIE"]
    assert_allclose([core["theta_E"], cut["theta_E"]], [0.65, -0.65])
    assert (core["s_scale"], cut["s_scale"]) == (0.0, 12.0)
    assert_allclose(np.hypot(core["e1"], core["e2"]), 0.2 / 1.8)
    # Round, but with a core too small for PJAFFE there.
    tiny = Component(DPIE(b=1.3, r_core=1e-6, r_cut=12.0))
    assert lenstronomy.export(Lens(one=tiny), 0.5)[0] == ["NIE", "NIE"]


def test_strengths_are_those_of_the_source_plane() -> None:
    lens = Lens(a=Component(SIE(b=10.0)), b=Component(PointMass(theta_e=2.0)))
    _, (isothermal, point) = lenstronomy.export(lens, 0.25)
    assert (isothermal["theta_E"], point["theta_E"]) == (2.5, 1.0)


def test_what_cannot_be_exported_is_named() -> None:
    with pytest.raises(ValueError, match="Component 'sub' is a tsis"):
        lenstronomy.export(Lens(sub=Component(TSIS(theta_e=1.0, r_t=3.0))), 0.5)
    with pytest.raises(ValueError, match="`dls_ds` is 0"):
        lenstronomy.export(Lens(one=Component(SIE(b=10.0))), 0.0)
