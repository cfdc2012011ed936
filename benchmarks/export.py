"""A lens of every kind in lenstronomy's own hands: deflection of the exported profiles against ours.

Typical (2 cores): rounding, 3e-15, for everything with a core; needs lenstronomy (extra `bench`), without
which only the export itself is timed.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Report, parser

from jaxlens import lens as lensing
from jaxlens import lenstronomy
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, NFW, SIE, Hernquist, PointMass, Shear, Sheet

DLS_DS = 0.7


def lens_of(members: int) -> Lens:
    """One of each profile, off-centre and turned, and members of both kinds."""
    rng = np.random.default_rng(3)
    place = lambda n: rng.uniform(-50.0, 50.0, (n, 2))
    each = np.ones(members)
    return Lens(
        nfw=Component(NFW(kappa_s=0.31, r_s=41.0, e=0.3), (1.2, -3.1), 0.7),
        hernquist=Component(Hernquist(kappa_s=2.5, r_s=4.1, e=0.25), (-2.0, 0.4), -1.1),
        dpie=Component(DPIE(b=1.3 * each, r_core=0.15, r_cut=12.0, e=0.2), place(members), 2.9),
        round=Component(DPIE(b=1.3 * each, r_core=0.15, r_cut=12.0), place(members)),
        sie=Component(SIE(b=12.0, e=0.3, r_core=0.2), (0.3, 0.1), 0.2),
        point=Component(PointMass(theta_e=3.1), (-7.0, 2.0)),
        shear=Component(Shear(gamma=0.07), (1.0, 0.0), -0.4),
        sheet=Component(Sheet(kappa=0.03), (1.0, 1.0)),
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the comparison."""
    report = Report("export", parser(__doc__ or "").parse_args(arguments))
    theta = np.random.default_rng(1).uniform(-80.0, 80.0, (50, 2))
    for members in (2,) if report.smoke else (2, 20, 100):
        lens, size = lens_of(members), {"members": members}
        alpha = DLS_DS * np.asarray(jax.jit(lensing.alpha)(lens, jnp.asarray(theta)))
        names, numbers = lenstronomy.export(lens, DLS_DS)
        report.measure(
            "export", lambda lens=lens: lenstronomy.export(lens, DLS_DS), size=size, compiled=False
        )
        try:
            from lenstronomy.LensModel.lens_model import LensModel
        except ImportError:
            continue
        found = np.stack(LensModel(names).alpha(theta[:, 0], theta[:, 1], numbers), axis=1)
        worst = float(np.abs(found - alpha).max() / np.abs(alpha).max())
        report.check(f"the exported deflection equals ours to {worst:.0e} (limit 1e-13)", worst < 1e-13)
    names, _ = lenstronomy.export(lens_of(1), DLS_DS)
    report.check("every profile has a name there", len(names) == 9)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
