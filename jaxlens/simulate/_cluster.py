"""A simulated cluster: haloes, their subhaloes and central galaxies, drawn from one key."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import RandomKey
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.simulate import _concentration, _stellar, _subhaloes, _triaxial
from jaxlens.simulate._assemble import lens_of
from jaxlens.simulate._settings import Clump, ClusterSettings
from jaxlens.simulate._truth import ClumpTruth, Place, SimulatedCluster

HERNQUIST_RADIUS = 0.551
"""Scale radius over effective radius of a Hernquist galaxy (R_e = 1.8153 r_s)."""


def draw_cluster(
    key: RandomKey, settings: ClusterSettings | None = None, cosmology: FlatLCDM | None = None
) -> SimulatedCluster:
    """A simulated cluster; the same key, settings and precision give the same bytes.

    Each halo is a triaxial NFW seen in projection, without the mass of its subhaloes and its central galaxy;
    subhaloes are truncated isothermal spheres, central galaxies elliptical Hernquist profiles. The draws of a
    clump depend on its place in `settings.clumps` alone, and each number has a key of its own: giving one
    does not change the keys of the others. Runs on the host, is not differentiable.

    Args:
        key: used once.
        settings: default: the merger of the paper.
        cosmology: default h = 0.7, Omega_m = 0.3.

    Raises:
        TypeError: in single precision.
        ValueError: if a clump lies outside the field, or its subhaloes and galaxy outweigh it.
    """
    if jnp.result_type(float) != jnp.float64:
        raise TypeError(
            "A simulated cluster needs float64. "
            'Put `jax.config.update("jax_enable_x64", True)` before the first computation.'
        )
    settings = ClusterSettings() if settings is None else settings
    plane = LensPlane.at(settings.z_l, cosmology)
    place = Place.of(plane, settings)
    drawn: list[ClumpTruth] = []
    tables: list[dict[str, np.ndarray]] = []
    for i, clump in enumerate(settings.clumps):
        before = drawn[-1].pa_rad if drawn else None
        truth, table = _draw_clump(jax.random.fold_in(key, i), i, clump, before, settings, place)
        drawn.append(truth)
        tables.append(table)
    subhaloes = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    return SimulatedCluster(
        lens=lens_of(drawn, subhaloes, settings, place),
        subhaloes=subhaloes,
        clumps=tuple(drawn),
        plane=plane,
        settings=settings,
    )


def position(i: int, settings: ClusterSettings, place: Place) -> tuple[float, float]:
    """Position of clump i, arcsec.

    Raises:
        ValueError: if it lies outside the field.
    """
    kpc = settings.positions_kpc_h()[i]
    x, y = (v * 1e-3 / place.h / place.mpc_per_arcsec for v in kpc)
    half = 30.0 * settings.field_arcmin
    for name, value, at in (("x_kpc_h", kpc[0], x), ("y_kpc_h", kpc[1], y)):
        if abs(at) > half:
            raise ValueError(
                f"`clumps[{i}].{name}` puts the clump {value:g} kpc/h = {at:.1f} arcsec from the centre, "
                f"outside the field of {settings.field_arcmin:g} arcmin; move it or raise `field_arcmin`."
            )
    return x, y


def _draw_clump(
    key: RandomKey,
    i: int,
    clump: Clump,
    pa_before: float | None,
    settings: ClusterSettings,
    place: Place,
) -> tuple[ClumpTruth, dict[str, np.ndarray]]:
    """One halo with everything in it. Lengths in Mpc, masses in Msun."""
    x, y = position(i, settings, place)
    shape_key, turn_key, c_key, bcg_key, *satellite_keys = jax.random.split(key, 9)
    mass = clump.mass_msun_h / place.h
    r_vir = math.cbrt(3.0 * mass / (4.0 * math.pi * place.virial_density))

    relation, scatter = settings.concentration_relation, settings.concentration_scatter
    mean = _concentration.mean(relation, mass, place.z, scatter, place.structure)
    c = clump.concentration
    if c is None:
        median = _concentration.median(relation, mass, place.z, place.structure)
        c = median * math.exp(scatter * float(jax.random.normal(c_key)))
    ratios = clump.axis_ratios
    if ratios is None:
        scale = _triaxial.axis_scale(mass, place.z, place.structure)
        ratios = _triaxial.draw_axis_ratios(shape_key, scale)
    orientation = clump.orientation
    if orientation is None:
        orientation = _triaxial.draw_orientation(turn_key)
    semi_axes = _triaxial.axes(ratios)
    turn = _triaxial.rotation(orientation)
    pa = clump.pa_rad
    if pa is None and pa_before is not None and not isinstance(settings.pa_difference_deg, str):
        pa = pa_before + math.radians(settings.pa_difference_deg)
    if pa is not None:
        turn = _triaxial.turn_on_sky(turn, pa - _triaxial.projection(semi_axes, turn).pa)
    shape = _triaxial.projection(semi_axes, turn)
    if pa is not None:
        # A halo that is round on the sky has no angle of its own; its galaxy and the next clump need one.
        shape = replace(shape, pa=pa % math.pi)

    table = _draw_subhaloes(
        satellite_keys, i, (x, y), (mass, c, r_vir), mean / c, turn * semi_axes, settings, place
    )
    bcg = clump.bcg_mass_msun
    if bcg is None:
        central = _stellar.OCCUPATIONS[settings.hod][0]
        median = float(_stellar.stellar_mass(clump.mass_msun_h, central, place.h))
        bcg = median * 10.0 ** (central.scatter_dex * float(jax.random.normal(bcg_key)))
    in_subhaloes = float(np.sum(table["mass_msun"]))
    smooth = mass - in_subhaloes - bcg
    if smooth <= 0.0:
        raise ValueError(
            f"`clumps[{i}]` of {mass:.3g} Msun has {in_subhaloes:.3g} Msun in subhaloes and {bcg:.3g} in its "
            "galaxy, so nothing is left for the smooth halo; lower `m_max_fraction` or `bcg_mass_msun`."
        )
    r_s = r_vir / c
    truth = ClumpTruth(
        x_arcsec=x,
        y_arcsec=y,
        mass_msun=mass,
        r_vir_mpc=r_vir,
        concentration=c,
        mean_concentration=mean,
        axis_ratios=ratios,
        orientation=orientation,
        turn=tuple(tuple(float(v) for v in row) for row in turn),
        f=shape.f,
        q=shape.q,
        pa_rad=shape.pa,
        r_s_mpc=r_s,
        rho_s_msun_mpc3=mass / (4.0 * math.pi * r_s**3 * float(_subhaloes.nfw_mass(c))),
        smooth_mass_msun=smooth,
        subhalo_mass_msun=in_subhaloes,
        subhalo_count=len(table["mass_msun"]),
        bcg_mass_msun=bcg,
        bcg_r_s_arcsec=HERNQUIST_RADIUS * settings.bcg_radius_fraction * r_vir / place.mpc_per_arcsec,
    )
    return truth, table


def _draw_subhaloes(
    keys: list[RandomKey],
    i: int,
    position: tuple[float, float],
    host: tuple[float, float, float],
    excess: float,
    to_sky: np.ndarray,
    settings: ClusterSettings,
    place: Place,
) -> dict[str, np.ndarray]:
    """Columns of `SimulatedCluster.subhaloes` for clump i; `host` is its mass, concentration and r_vir."""
    mass, c, r_vir = host
    count_key, mass_key, radius_key, direction_key, star_key = keys
    m = np.zeros(0)
    if settings.subhaloes:
        high = settings.m_max_fraction * mass * place.h
        curve = _subhaloes.mass_function(mass * place.h, place.z, excess, settings.m_min_msun_h, high)
        m = _subhaloes.draw_masses(count_key, mass_key, *curve) / place.h
    at = r_vir * _subhaloes.draw_positions(radius_key, direction_key, len(m), c, to_sky)
    r_t = _subhaloes.truncation_radius(m, np.linalg.norm(at, axis=1), mass, c, r_vir)
    satellite = _stellar.OCCUPATIONS[settings.hod][1]
    lost = 1.0
    if settings.z_infall is not None:
        lost = _stellar.mass_loss_factor(place.z, settings.z_infall, place.structure)
    stars = _stellar.stellar_mass(m * place.h * lost, satellite, place.h)
    if settings.satellite_scatter:
        stars = stars * 10.0 ** (satellite.scatter_dex * _subhaloes.normal(star_key, len(m), 1)[:, 0])
    return {
        "x_arcsec": position[0] + at[:, 0] / place.mpc_per_arcsec,
        "y_arcsec": position[1] + at[:, 1] / place.mpc_per_arcsec,
        "z_kpc": 1e3 * at[:, 2],
        "mass_msun": m,
        "sigma_v_kms": _subhaloes.velocity_dispersion(m, r_t),
        "r_t_kpc": 1e3 * r_t,
        "stellar_mass_msun": stars,
        "luminosity_b": stars / settings.mass_to_light,
        "clump": np.full(len(m), i),
    }
