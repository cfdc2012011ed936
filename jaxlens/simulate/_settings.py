"""What a simulated cluster is made of: plain numbers, checked when they are put together."""

import math
from dataclasses import dataclass
from typing import Literal

from jaxlens.simulate._subhaloes import ABUNDANCE, SLOPE

MAX_SUBHALOES = 100_000
"""Expected subhaloes; seventy times as many as the merger of the paper has above 1e10 Msun/h."""

CHOICES = {
    "centre": ("midpoint", "first", "mass_weighted", "given"),
    "hod": ("wang2006_moka", "wang2013"),
    "los_cut": ("inf", "rvir"),
    "concentration_relation": ("zhao", "neto"),
}
"""What the settings with names may be."""


def _positive(name: str, value: float, unit: str = "") -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"`{name}` is {value}; give a positive, finite number{unit and ' in ' + unit}.")


def _finite(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise ValueError(f"`{name}` is {value}; give a finite number.")


@dataclass(frozen=True)
class Clump:
    """One halo of a cluster. What is None is drawn.

    Attributes:
        mass_msun_h: virial mass (Bryan & Norman), Msun/h.
        x_kpc_h, y_kpc_h: position along theta_1 and theta_2, kpc/h.
        concentration: r_vir/r_s.
        axis_ratios: (a/c, b/c), 0 < a/c <= b/c <= 1; (1, 1) for a sphere.
        orientation: quaternion (w, x, y, z) that takes the axes a, b, c to (theta_1, theta_2, line of sight).
        pa_rad: position angle of the projected major axis, from +theta_1 towards +theta_2. The halo is
            turned about the line of sight until it has it.
        bcg_mass_msun: stellar mass of its central galaxy, Msun; 0 for none.
    """

    mass_msun_h: float
    x_kpc_h: float = 0.0
    y_kpc_h: float = 0.0
    concentration: float | None = None
    axis_ratios: tuple[float, float] | None = None
    orientation: tuple[float, float, float, float] | None = None
    pa_rad: float | None = None
    bcg_mass_msun: float | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that describe no halo."""
        _positive("mass_msun_h", self.mass_msun_h, "Msun/h")
        for name in ("x_kpc_h", "y_kpc_h"):
            _finite(name, getattr(self, name))
        if self.concentration is not None:
            _positive("concentration", self.concentration)
        if self.axis_ratios is not None:
            a_c, b_c = self.axis_ratios
            if not 0.0 < a_c <= b_c <= 1.0:
                raise ValueError(
                    f"`axis_ratios` is {self.axis_ratios}; give (a/c, b/c) with 0 < a/c <= b/c <= 1."
                )
        if self.orientation is not None:
            length = math.sqrt(sum(v * v for v in self.orientation))
            if len(self.orientation) != 4 or not (math.isfinite(length) and length > 0.0):
                raise ValueError(f"`orientation` is {self.orientation}; give four finite numbers, not all 0.")
        if self.pa_rad is not None:
            _finite("pa_rad", self.pa_rad)
        if self.bcg_mass_msun is not None and not (
            math.isfinite(self.bcg_mass_msun) and self.bcg_mass_msun >= 0.0
        ):
            raise ValueError(
                f"`bcg_mass_msun` is {self.bcg_mass_msun}; give a mass in Msun, or 0 for no central galaxy."
            )


MERGER = (Clump(6.75e14, x_kpc_h=-30.0), Clump(5.25e14, x_kpc_h=30.0))
"""The two clumps of the paper: masses and separation as stated there, along theta_1 (our choice)."""


@dataclass(frozen=True)
class ClusterSettings:
    """A cluster of any number of haloes; the defaults are the merger of the paper.

    Attributes:
        z_l: redshift.
        clumps: its haloes.
        pa_difference_deg: position angle of each clump minus that of the one before it, for those without
            `pa_rad` (the first keeps what was drawn); `drawn` leaves all as drawn.
        centre: what lies at the origin: the `midpoint` of the clumps, the `first` one, their
            `mass_weighted` mean, or the origin of the positions as `given`.
        field_arcmin: side of the field that must hold all clumps, arcmin.
        concentration_relation: median of the drawn concentrations, `zhao` or `neto`.
        concentration_scatter: standard deviation of ln c about it.
        subhaloes: whether the haloes have any.
        m_min_msun_h: smallest mass of a subhalo, Msun/h.
        m_max_fraction: largest, as a fraction of the host (our choice: 0.1 keeps two clumps two).
        hod: stellar masses, `wang2006_moka` or `wang2013`.
        satellite_scatter: whether stellar masses of satellites scatter; those of central galaxies always do.
        z_infall: redshift at which satellites fell in, to undo their loss of mass in the stellar masses;
            None takes their present mass.
        mass_to_light: M_star/L_B, solar units (our choice; a constant cancels in L/L_ref).
        bcg_axis_ratio: b/a of the convergence of central galaxies (our choice).
        bcg_radius_fraction: effective radius over r_vir (quoted from secondary sources).
        los_cut: `inf`, or `rvir` to cut the smooth haloes at r_vir (the ellipsoid of that radius); on the sky
            the edge is smeared out between 0.7 and 1.4 r_vir.
        contraction: whether the dark matter is contracted adiabatically by the central galaxy (Blumenthal et
            al. 1986), as in a sphere of the same mass.
        sigma8, n_s, omega_b: power spectrum behind concentrations and shapes (our choice).
    """

    z_l: float = 0.3
    clumps: tuple[Clump, ...] = MERGER
    pa_difference_deg: float | Literal["drawn"] = 25.0
    centre: str = "midpoint"
    field_arcmin: float = 8.0
    concentration_relation: str = "zhao"
    concentration_scatter: float = 0.25
    subhaloes: bool = True
    m_min_msun_h: float = 1e10
    m_max_fraction: float = 0.1
    hod: str = "wang2006_moka"
    satellite_scatter: bool = False
    z_infall: float | None = None
    mass_to_light: float = 4.0
    bcg_axis_ratio: float = 0.8
    bcg_radius_fraction: float = 0.003
    los_cut: str = "inf"
    contraction: bool = False
    sigma8: float = 0.8
    n_s: float = 0.96
    omega_b: float = 0.045

    def __post_init__(self) -> None:
        """Refuse numbers that describe no cluster."""
        if not self.clumps:
            raise ValueError("`clumps` is empty; a cluster needs at least one `Clump`.")
        for name in (
            "z_l",
            "field_arcmin",
            "m_min_msun_h",
            "mass_to_light",
            "bcg_radius_fraction",
            "sigma8",
            "omega_b",
        ):
            _positive(name, getattr(self, name))
        for name in ("m_max_fraction", "bcg_axis_ratio"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number in (0, 1].")
        if not 0.0 < self.n_s < 2.0:
            raise ValueError(f"`n_s` is {self.n_s}; give a slope of the power spectrum between 0 and 2.")
        if not 0.0 <= self.concentration_scatter < 2.0:
            raise ValueError(
                f"`concentration_scatter` is {self.concentration_scatter}; give a scatter of ln c in [0, 2)."
            )
        if self.pa_difference_deg != "drawn":
            if not isinstance(self.pa_difference_deg, int | float):
                raise ValueError(
                    f"`pa_difference_deg` is {self.pa_difference_deg!r}; give an angle in degrees or 'drawn'."
                )
            _finite("pa_difference_deg", self.pa_difference_deg)
        if self.z_infall is not None and not self.z_infall >= self.z_l:
            raise ValueError(
                f"`z_infall` is {self.z_infall} but `z_l` is {self.z_l}; give a redshift of at least `z_l`."
            )
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"`{name}` is {getattr(self, name)!r}; choose one of {', '.join(choices)}.")
        for i, clump in enumerate(self.clumps):
            if self.subhaloes and not self.m_min_msun_h < self.m_max_fraction * clump.mass_msun_h:
                raise ValueError(
                    f"`m_min_msun_h` is {self.m_min_msun_h:g} but the heaviest subhalo of `clumps[{i}]` "
                    f"(`m_max_fraction`) has {self.m_max_fraction * clump.mass_msun_h:g} Msun/h; lower the "
                    "former or set `subhaloes` to False."
                )

        expected = self._expected_subhaloes()
        if self.subhaloes and not expected <= MAX_SUBHALOES:
            raise ValueError(
                f"`m_min_msun_h` is {self.m_min_msun_h:g}: about {expected:.2g} subhaloes are expected, more "
                f"than {MAX_SUBHALOES}; raise it, or set `subhaloes` to False."
            )

    def _expected_subhaloes(self) -> float:
        """Mean number of subhaloes of all clumps, from above: the mass function without its cut-off.

        E[cbar/c] is exp(s^2) for a drawn concentration; a given one is compared with 5.
        """
        total = 0.0
        for clump in self.clumps:
            excess = math.exp(self.concentration_scatter**2)
            if clump.concentration is not None:
                excess = max(1.0, 5.0 / clump.concentration)
            total += clump.mass_msun_h * excess
        return ABUNDANCE * math.sqrt(1.0 + self.z_l) * total * self.m_min_msun_h**-SLOPE / SLOPE

    def positions_kpc_h(self) -> list[tuple[float, float]]:
        """Positions of the clumps relative to the origin that `centre` names, kpc/h."""
        x, y, m = ([getattr(c, name) for c in self.clumps] for name in ("x_kpc_h", "y_kpc_h", "mass_msun_h"))
        weights = {
            "midpoint": [1.0] * len(m),
            "first": [1.0] + [0.0] * (len(m) - 1),
            "mass_weighted": m,
            "given": [0.0] * len(m),
        }[self.centre]
        total = sum(weights) or 1.0
        x_0, y_0 = (sum(w * v for w, v in zip(weights, u, strict=True)) / total for u in (x, y))
        return [(a - x_0, b - y_0) for a, b in zip(x, y, strict=True)]
