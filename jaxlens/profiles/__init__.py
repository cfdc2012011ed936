"""Mass profiles. Importing this package registers every profile that ships with jaxlens."""

from jaxlens.profiles import cse, dpie, hernquist, nfw, point, shear, sheet, sie, tsis
from jaxlens.profiles._profile import PROFILES, Profile, profile_of, register
from jaxlens.profiles.cse import CSE
from jaxlens.profiles.dpie import DPIE
from jaxlens.profiles.hernquist import Hernquist
from jaxlens.profiles.nfw import NFW
from jaxlens.profiles.point import PointMass
from jaxlens.profiles.shear import Shear
from jaxlens.profiles.sheet import Sheet
from jaxlens.profiles.sie import SIE
from jaxlens.profiles.tsis import TSIS

__all__ = [
    "CSE",
    "DPIE",
    "NFW",
    "PROFILES",
    "SIE",
    "TSIS",
    "Hernquist",
    "PointMass",
    "Profile",
    "Shear",
    "Sheet",
    "cse",
    "dpie",
    "hernquist",
    "nfw",
    "point",
    "profile_of",
    "register",
    "shear",
    "sheet",
    "sie",
    "tsis",
]
