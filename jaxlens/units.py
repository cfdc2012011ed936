"""Constants and unit factors of the package.

Inside the package every number is in arcsec, radian, Mpc (physical, no h), Msun and km/s.
Sources: IAU 2015 resolution B3 (GM_sun), IAU 2012 resolution B2 (au, hence the parsec), SI (c).
"""

import math
from typing import Any

C_KM_S = 299792.458
"""Speed of light, km/s."""

ARCSEC = math.pi / (180.0 * 3600.0)
"""One arcsecond in radian."""

MPC_M = 149597870700.0 / ARCSEC * 1e6
"""One megaparsec in metre."""

GM_SUN_M3_S2 = 1.3271244e20
"""Nominal solar mass parameter, m^3/s^2."""

G_MPC_KM2_S2_MSUN = GM_SUN_M3_S2 / (MPC_M * 1e6)
"""Gravitational constant, Mpc (km/s)^2 / Msun."""

C2_4PIG = C_KM_S**2 / (4.0 * math.pi * G_MPC_KM2_S2_MSUN)
"""c^2/(4 pi G), Msun/Mpc; divided by a distance in Mpc it is a surface density."""

DAY_S = 86400.0
"""One day in seconds."""


def strip(value: Any, unit: str) -> Any:
    """The bare number of `value` in `unit`.

    Args:
        value: an `astropy.units.Quantity`, or a number already in `unit`.
        unit: name of the unit as astropy spells it, e.g. `"arcsec"`, `"Msun"`.

    Returns:
        A float or NumPy array.

    Raises:
        ValueError: if the quantity cannot be converted to `unit`.
    """
    if not hasattr(value, "unit"):
        return value
    from astropy import units as u  # costs 0.6 s, so only when a Quantity is met

    try:
        return u.Quantity(value).to_value(unit)
    except u.UnitConversionError as error:
        raise ValueError(
            f"`{value}` cannot be converted to {unit}; give a quantity in {unit} or a bare number."
        ) from error


def nearest_angle(angle: float, middle: float) -> float:
    """The angle of the same ellipse, half turns away, that is nearest to `middle`; degrees."""
    return angle - 180.0 * round((angle - middle) / 180.0)
