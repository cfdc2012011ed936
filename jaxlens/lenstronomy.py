"""A lens in the words of lenstronomy: names of profiles and their keyword arguments, for one source redshift.

lenstronomy itself is not imported. Its strengths are those of one source plane, so that they carry the
factor D_LS/D_S; its ellipticities are e1 + i e2 = (1-q)/(1+q) exp(2 i pa), its angles those of this package.
"""

import math
from typing import Any

from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, NFW, SIE, Hernquist, PointMass, Shear, Sheet, profile_of

Profile = tuple[str, dict[str, float]]
"""Name of a profile and its keyword arguments."""


def export(lens: Lens, dls_ds: float) -> tuple[list[str], list[dict[str, float]]]:
    """`lens_model_list` and `kwargs_lens` of a lens, for `LensModel(lens_model_list)`.

    NFW and Hernquist become the sums of cored steep ellipsoids `NFW_ELLIPSE_CSE` and
    `HERNQUIST_ELLIPSE_CSE` (the latter with sigma0 = q kappa_s and Rs = r_s/sqrt(q), which turns its ellipse
    into ours); a dPIE becomes `PJAFFE` if it is round, else two `NIE` of opposite sign; SIE is `NIE`;
    `SHEAR`, `CONVERGENCE` and `POINT_MASS` are themselves. lenstronomy keeps cores above 1e-4 arcsec in
    `PJAFFE` and adds 1e-9 arcsec or more elsewhere: a dPIE with a smaller core differs near its centre.

    Args:
        lens: the lens.
        dls_ds: D_LS/D_S of the source, in (0, 1].

    Returns:
        Names, and keyword arguments in the same order.

    Raises:
        ValueError: if `dls_ds` is not in (0, 1], or a profile has no exact counterpart; the message names it.
    """
    if not 0.0 < dls_ds <= 1.0:
        raise ValueError(f"`dls_ds` is {dls_ds}; give D_LS/D_S of a source behind the lens, in (0, 1].")
    found = [
        entry
        for name, component in lens.components.items()
        for k in range(len(component))
        for entry in _entries(component, k, float(dls_ds), f"Component {name!r}")
    ]
    return [name for name, _ in found], [arguments for _, arguments in found]


def _entries(component: Component, k: int, dls_ds: float, where: str) -> list[Profile]:
    p: Any = component.params
    x, y = (float(value) for value in component.centre[k])
    pa = float(component.pa[k])
    centre, origin = {"center_x": x, "center_y": y}, {"ra_0": x, "dec_0": y}
    if isinstance(p, Shear):
        gamma = dls_ds * float(p.gamma[k])
        return [("SHEAR", {"gamma1": gamma * math.cos(2 * pa), "gamma2": gamma * math.sin(2 * pa), **origin})]
    if isinstance(p, Sheet):
        return [("CONVERGENCE", {"kappa": dls_ds * float(p.kappa[k]), **origin})]
    if isinstance(p, PointMass):
        return [("POINT_MASS", {"theta_E": math.sqrt(dls_ds) * float(p.theta_e[k]), **centre})]
    if not isinstance(p, NFW | Hernquist | DPIE | SIE):
        raise ValueError(
            f"{where} is a {profile_of(p).name}, for which lenstronomy has no exact counterpart; "
            "exported are NFW, Hernquist, DPIE, SIE, PointMass, Shear and Sheet. Take it out, or replace it."
        )
    q = 1.0 - float(p.e[k])
    e = (1.0 - q) / (1.0 + q)
    shape = {"e1": e * math.cos(2 * pa), "e2": e * math.sin(2 * pa), **centre}
    if isinstance(p, NFW):
        r_s = float(p.r_s[k])
        alpha = 4.0 * dls_ds * float(p.kappa_s[k]) * r_s * (1.0 - math.log(2.0))
        return [("NFW_ELLIPSE_CSE", {"Rs": r_s, "alpha_Rs": alpha, **shape})]
    if isinstance(p, Hernquist):
        sigma, r_s = q * dls_ds * float(p.kappa_s[k]), float(p.r_s[k]) / math.sqrt(q)
        return [("HERNQUIST_ELLIPSE_CSE", {"sigma0": sigma, "Rs": r_s, **shape})]
    b, core = dls_ds * float(p.b[k]), float(p.r_core[k])
    if isinstance(p, SIE):
        return [_nie(b, core, q, shape)]
    cut = float(p.r_cut[k])
    if q == 1.0:
        # kappa = sigma0 Ra Rs/(Rs - Ra) [...] in place of b/2 [...].
        sigma = 0.5 * b * (cut - core) / (core * cut) if core > 0.0 else math.inf
        if math.isfinite(sigma) and core >= 1e-4:
            return [("PJAFFE", {"sigma0": sigma, "Ra": core, "Rs": cut, **centre})]
    return [_nie(b, core, q, shape), _nie(-b, cut, q, shape)]


def _nie(b: float, core: float, q: float, shape: dict[str, float]) -> Profile:
    """The cored isothermal ellipsoid kappa = b/[2 sqrt(core^2 + q x^2 + y^2/q)]."""
    return "NIE", {"theta_E": b, "s_scale": core, **shape}
