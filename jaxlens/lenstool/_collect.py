"""What is collected while a parameter file is read: boxes, priors and starts."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import jax.numpy as jnp

from jaxlens._types import Array
from jaxlens.cosmology import LensPlane
from jaxlens.lenstool._par import Limit
from jaxlens.strong import Angle, Bounds, Box, NormalPrior, RedshiftPrior
from jaxlens.units import nearest_angle

_WIDTH = 5.0
# A number with a normal prior gets a box of so many standard deviations on either side.

Z_MAX = 10.0
"""Largest free redshift where no `z_m_limit` says otherwise."""


@dataclass
class Collected:
    """Boxes, priors and starts of one parameter file.

    Attributes:
        path: the file.
        plane: the lens plane.
        reference: (RA, Dec) of the origin in degrees, or None.
        bounds, priors, start: of the fit.
    """

    path: Path
    plane: LensPlane
    reference: tuple[float, float] | None
    bounds: Bounds = field(default_factory=dict)
    priors: list[NormalPrior | RedshiftPrior] = field(default_factory=list)
    start: dict[str, Array] = field(default_factory=dict)

    @property
    def kpc_per_arcsec(self) -> float:
        """Physical kpc per arcsec at the lens."""
        return float(self.plane.kpc_per_arcsec)

    def free(self, full: str, said: Limit, value: float, *, turn: bool = False) -> None:
        """Box, prior and start of one free number; angles in degrees here, in rad there."""
        convert = math.radians if turn else float
        lo, hi = said.first, said.second
        if said.kind == 3:
            lo, hi = said.first - _WIDTH * said.second, said.first + _WIDTH * said.second
            if not turn and not full.endswith((".x_arcsec", ".y_arcsec")) and said.first > 0.0:
                lo = max(lo, 1e-3 * said.first)
            self.priors.append(NormalPrior(full, convert(said.first), convert(said.second)))
        if turn and hi - lo >= 180.0:
            self.bounds[full] = Angle()
        else:
            if full.endswith(".ellipticity"):
                hi = min(hi, 0.99)
            self.bounds[full] = Box(convert(lo), convert(hi))
        if turn and not lo <= value <= hi:
            value = nearest_angle(value, 0.5 * (lo + hi))
        inside = lo <= value <= hi or (turn and hi - lo >= 180.0)
        self.start[full] = jnp.asarray(convert(value if inside else 0.5 * (lo + hi)))

    def free_redshift(self, system: str, said: Limit | None, z: float) -> None:
        lowest = float(self.plane.z_l) + 0.1
        lo, hi = lowest, Z_MAX
        if said is not None and said.kind == 1:
            lo, hi = max(said.first, float(self.plane.z_l) + 1e-3), said.second
        elif said is not None:
            lo = max(lowest, said.first - _WIDTH * said.second)
            hi = said.first + _WIDTH * said.second
            self.priors.append(RedshiftPrior(system, self.plane, said.first, said.second))
        if not lo < hi:
            raise ValueError(
                f"{self.path}: z_m_limit of system {system} ends at {hi:g}, not behind the lens; raise it."
            )
        at = z if lo < z < hi else 0.5 * (lo + hi)
        self.bounds[f"dls_ds.{system}"] = Box(self.plane.dls_ds(lo), self.plane.dls_ds(hi), weak=False)
        self.start[f"dls_ds.{system}"] = self.plane.dls_ds(at)
