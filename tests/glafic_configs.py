"""glafic's configurations as lenses, with glafic's own norms or from masses with our constants.

glafic measures distances in c/H0, masses in Msun/h, position angles from +y, and stores member
galaxies in single precision. Its NFW has two fitted norms instead of physical constants.
"""

import json
from typing import Any

import numpy as np
from support import REFERENCE, strict

from jaxlens.cosmology import LensPlane
from jaxlens.lens import Component, Lens
from jaxlens.profiles import NFW, SIE, Hernquist, PointMass, Shear, Sheet, dpie, hernquist, nfw, point

SETUP = json.loads((REFERENCE / "glafic/configs.json").read_text(encoding="utf-8"))
CONFIGS = SETUP["configs"]
DISTANCES = {float(z): d for z, d in SETUP["distances"].items()}
K = SETUP["constants"]
H = SETUP["cosmology"]["hubble"]
Z_L = SETUP["zl"]

NORMS = ("glafic", "ours")


def plane() -> LensPlane:
    return LensPlane.at(Z_L)


def dls_ds(z_s: float) -> float:
    return DISTANCES[z_s]["D_ls"] / DISTANCES[z_s]["D_s"]


def _d_l() -> float:
    """Distance to the lens in c/H0."""
    return DISTANCES[2.0]["D_l"]


def _sigma_cr_inf() -> float:
    """glafic's critical surface density for D_LS/D_S = 1, h Msun/Mpc^2."""
    return DISTANCES[2.0]["sigma_crit_hMsun_per_Mpc2"] * dls_ds(2.0)


def _arcsec_in_mpc() -> float:
    """Length of an arcsec at the lens, Mpc/h."""
    return K["arcsec_rad"] * _d_l() * K["c_over_H0_Mpc_over_h"]


def _pa(degrees: Any) -> np.ndarray:
    """glafic counts from +y, jaxlens from +x."""
    return np.deg2rad(np.asarray(degrees, float) + 90.0)


def _nfw(p: list[float], overdensity: float | str, norms: str) -> NFW:
    mass, e, c = p[1], p[4], p[6]
    if norms == "ours":
        return nfw.from_mass(mass / H, c, plane(), e=e, definition=overdensity)
    e2 = 0.3 * (1.0 + Z_L) ** 3 + 0.7
    critical = SETUP["derived"]["delta_vir_critical"] if isinstance(overdensity, str) else overdensity
    delta = critical * e2
    r_s = K["nfw_rs_norm"] * (mass / delta) ** (1 / 3) / c  # Mpc/h
    amplitude = K["nfw_b_norm"] * (mass * delta**2) ** (1 / 3) * c**2 / (np.log(1 + c) - c / (1 + c)) * _d_l()
    return NFW(kappa_s=amplitude / 4.0, r_s=r_s / _arcsec_in_mpc(), e=e)


def _hernquist(p: list[float], norms: str) -> Hernquist:
    mass, e, r_s = p[1], p[4], p[6]
    if norms == "ours":
        return hernquist.from_mass(mass / H, r_s, plane(), e=e)
    return Hernquist(
        kappa_s=mass / (2 * np.pi * (r_s * _arcsec_in_mpc()) ** 2 * _sigma_cr_inf()), r_s=r_s, e=e
    )


def _point(p: list[float], norms: str) -> PointMass:
    if norms == "ours":
        return PointMass(theta_e=point.einstein_radius(p[1] / H, plane()))
    # theta_E^2 = 4 G M/(c^2 D_L) = 2 r_schwarzschild/D_L; h cancels between Msun/h and Mpc/h.
    r_schwarzschild = K["r_schwarzschild_sun_m"] * p[1] / K["Mpc_m"]
    d_l = _d_l() * K["c_over_H0_Mpc_over_h"]
    return PointMass(theta_e=np.sqrt(2.0 * r_schwarzschild / d_l) / K["arcsec_rad"])


def lens(name: str, norms: str = "glafic") -> Lens:
    """The lens of one configuration.

    Args:
        name: key of `CONFIGS`.
        norms: `"glafic"` for its constants, `"ours"` for masses through `from_mass`.
    """
    config = CONFIGS[name]
    overdensity = 200.0 if config.get("options") else "nakamura_suto"
    components: dict[str, Component] = {}
    for k, entry in enumerate(config["lenses"]):
        p, model = entry["p"], entry["model"]
        centre, pa = (p[2], p[3]), _pa(p[5])
        if model == "pert":
            # Given at its fiducial source redshift p[1]; its angle is counted from +x.
            ratio = dls_ds(p[1])
            components[f"{k}_shear"] = strict(Shear(gamma=p[4] / ratio), centre, np.deg2rad(p[5]))
            components[f"{k}_sheet"] = strict(Sheet(kappa=p[7] / ratio), centre)
            continue
        if model == "gals":
            g = np.array(config["galaxies"], np.float32).astype(float)
            params = dpie.from_sigma_v(p[1] * g[:, 2] ** 0.25, 0.0, p[6] * g[:, 2] ** p[7], e=g[:, 3])
            centre, pa = g[:, :2], _pa(g[:, 4])
        elif model == "anfw":
            params = _nfw(p, overdensity, norms)
        elif model == "ahern":
            params = _hernquist(p, norms)
        elif model == "jaffe":
            params = dpie.from_sigma_v(p[1], p[7], p[6], e=p[4])
        elif model == "sie":
            params = SIE(b=dpie.strength(p[1]), e=p[4], r_core=p[6])
        elif model == "point":
            params = _point(p, norms)
        else:
            raise ValueError(f"no conversion for glafic's {model!r}")
        components[f"{k}_{model}"] = strict(params, centre, pa)
    return Lens(components)
