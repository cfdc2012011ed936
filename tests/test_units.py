"""Constants against astropy's, and the boundary where units are taken off."""

# astropy makes its constants and cosmologies at run time, where the type checker does not see them.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

import math

import numpy as np
import pytest
from astropy import constants
from astropy import units as u

from jaxlens import units


def test_constants_are_those_of_astropy():
    # The same definitions (IAU 2012, IAU 2015, SI), so only rounding differs.
    assert constants.c.to_value("km/s") == units.C_KM_S
    assert pytest.approx(u.arcsec.to(u.rad), rel=1e-15) == units.ARCSEC
    assert pytest.approx(u.Mpc.to(u.m), rel=1e-14) == units.MPC_M
    assert pytest.approx(constants.GM_sun.to_value("m3/s2"), rel=1e-14) == units.GM_SUN_M3_S2
    assert u.day.to(u.s) == units.DAY_S


def test_gravitational_constant_and_surface_density_scale():
    # GM_sun/M_sun, not CODATA's G: the kilogram does not enter, so 1e-13.
    gravity = (constants.GM_sun / u.Msun).to_value("Mpc km2 / (s2 Msun)")
    assert pytest.approx(gravity, rel=1e-13) == units.G_MPC_KM2_S2_MSUN
    scale = constants.c**2 / (4 * math.pi * constants.GM_sun / u.Msun)
    assert pytest.approx(scale.to_value("Msun/Mpc"), rel=1e-13) == units.C2_4PIG


def test_strip_converts_quantities_and_passes_numbers():
    assert units.strip(1.5 * u.arcmin, "arcsec") == pytest.approx(90.0, rel=1e-15)
    np.testing.assert_allclose(units.strip([1.0, 2.0] * u.kpc, "Mpc"), [1e-3, 2e-3], rtol=1e-15)
    assert units.strip(3.0, "Msun") == 3.0


def test_strip_names_the_wrong_unit():
    with pytest.raises(ValueError, match="cannot be converted to Msun"):
        units.strip(3.0 * u.arcsec, "Msun")
