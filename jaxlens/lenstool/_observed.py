"""Member galaxies and multiple images of a parameter file."""

import math

import jax.numpy as jnp

from jaxlens._text import numbers
from jaxlens._types import Array
from jaxlens.lenstool import _catalogues
from jaxlens.lenstool._collect import Collected
from jaxlens.lenstool._par import Limit, Section, limit
from jaxlens.strong import ImageCatalogue, MemberSet


def members(c: Collected, one: Section, *, free: bool) -> MemberSet:
    """The member galaxies of a `potfile`; free numbers get box, prior and start."""
    if one.number("type", 81.0) != 81.0:
        one.fail("type", "is not read; only 81 (dPIE) is.")
    filein = one.get("filein")
    if filein is None or len(filein[1]) < 2 or filein[1][0] not in ("1", "3"):
        one.fail("filein", "is missing or not of format 1 or 3; give `filein 1 galaxies.cat`.")
    file = c.path.parent / filein[1][1]
    table = _catalogues.galaxies(file, c.reference, absolute=filein[1][0] == "3")
    slopes = [_limit(one, key, 4.0) for key in ("vdslope", "slope")]
    for key in ("vdscatter", "rcutscatter"):
        scatter = _limit(one, key, 0.0)
        if scatter.kind or scatter.first:
            one.fail(key, "is not read; set it to 0 0. 0.")
    for key, slope in zip(("vdslope", "slope"), slopes, strict=True):
        if slope.kind or not slope.first > 0.0:
            one.fail(key, "must be fixed and positive: give kind 0.")
    fixed: dict[str, Array] = {}
    for key, number in (
        ("sigma", "sigma_ref_km_s"),
        ("cut", "r_cut_ref_arcsec"),
        ("core", "r_core_ref_arcsec"),
    ):
        kpc = f"{key}kpc"
        length = one.get(kpc) is not None and key != "sigma"
        used, factor = (kpc, 1.0 / c.kpc_per_arcsec) if length else (key, 1.0)
        said = Limit(0, one.number(used), 0.0) if key == "core" else _limit(one, used, None)
        if said.first < 0.0:
            one.fail(used, "is negative; correct it.")
        if said.kind and free:
            middle = said.first if said.kind == 3 else 0.5 * (said.first + said.second)
            scaled = Limit(said.kind, factor * said.first, factor * said.second)
            c.free(f"members.{number}", scaled, factor * middle)
        else:
            fixed[number] = jnp.asarray(factor * said.first)
    return MemberSet(
        theta=jnp.asarray(table.theta),
        luminosity=jnp.asarray(10.0 ** (-0.4 * (table.mag - one.number("mag0", 17.0)))),
        e=jnp.asarray(table.ellipticity),
        pa=jnp.asarray(table.pa),
        fixed=fixed,
        exponents=(1.0 / slopes[0].first, 2.0 / slopes[1].first, 0.5),
        convention="dpie_lenstool",
    )


def _limit(one: Section, key: str, default: float | None) -> Limit:
    said = one.get(key)
    if said is None:
        if default is None:
            raise ValueError(f"{one.title}: {key} is missing; add it.")
        return Limit(0, default, 0.0)
    return limit(one, key, *said)


def images(c: Collected, section: Section | None) -> ImageCatalogue:
    """The images; free redshifts get box, prior and start."""
    said = None if section is None else section.get("multfile")
    if section is None or said is None or len(said[1]) < 2:
        raise ValueError(f"{c.path} has no images: add `multfile 1 images.cat` to the section `image`.")
    path = c.path.parent / said[1][1]
    absolute = bool(section.number("mult_wcs", 0.0))
    table = _catalogues.images(path, c.reference, absolute=absolute)
    sigma = section.number("sigposArcsec")
    if not sigma > 0.0:
        section.fail("sigposArcsec", "is not a position error; give a positive number of arcsec.")
    z_l, z_s = float(c.plane.z_l), list(table.z_s)
    limits = _redshift_limits(c, section, table.systems)
    for index, system in enumerate(table.systems):
        one = limits.get(system)
        if one is not None and one.kind == 0:
            z_s[index] = one.first
        elif one is not None or z_s[index] == 0.0:
            c.free_redshift(system, one, z_s[index])
            z_s[index] = math.nan
        if z_s[index] <= z_l:
            raise ValueError(
                f"{path}, line {table.line[index]}: the redshift {z_s[index]:g} of system {system} is not "
                f"behind the lens (z = {z_l:g}); correct it, or leave the system out."
            )
    errors = jnp.full(len(table.source), sigma)
    return ImageCatalogue(table.theta, table.source, jnp.asarray(z_s), errors, table.systems, table.image_ids)


def _redshift_limits(c: Collected, section: Section, systems: tuple[str, ...]) -> dict[str, Limit]:
    """`z_m_limit number system kind first second [precision]`; the leading number may be missing."""
    found: dict[str, Limit] = {}
    for line, key, words in section.rows:
        if key != "z_m_limit":
            continue
        if len(words) < 5:
            raise ValueError(
                f"{c.path}, line {line}: z_m_limit {' '.join(words)} is too short; give its number, "
                "the system or one of its images, the kind and two numbers."
            )
        system = next((s for s in (words[1], _catalogues.system_of(words[1])) if s in systems), None)
        if system is None:
            raise ValueError(
                f"{c.path}, line {line}: z_m_limit speaks of {words[1]}, which is not a system of the "
                "images; correct the name, or remove the line."
            )
        numbers(c.path, line, words[2:5], "kind and two redshifts", least=3)
        found[system] = limit(section, "z_m_limit", line, words[2:])
    return found
