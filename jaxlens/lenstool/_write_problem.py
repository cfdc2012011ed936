"""A whole fit as Lenstool's files: potentials with limits, member galaxies, images."""

import math
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array
from jaxlens.cosmology import redshift_of_dls_ds
from jaxlens.lenstool._forms import PROFILES
from jaxlens.lenstool._write import catalogue, cosmology, grid, image, potentials, runmode, save, section
from jaxlens.strong import (
    SIGMA,
    Angle,
    Box,
    ClusterModel,
    Ingredient,
    LogNormalPrior,
    NormalPrior,
    Problem,
    RedshiftPrior,
    normal_laws,
)

_KEYS = {form: (profil, names) for profil, (form, names) in PROFILES.items()}
_MEMBERS = {"sigma": "sigma_ref_km_s", "cut": "r_cut_ref_arcsec"}


def write_problem(
    path: str | Path,
    problem: Problem,
    params: Mapping[str, Array],
    *,
    reference: tuple[float, float] | None = None,
) -> None:
    """Write a fit: parameter file, galaxies and images, beside each other.

    Free components must be of Lenstool's kinds (`dpie_lenstool`, `lenstool_*`, `shear`), members of the
    convention `dpie_lenstool`; components without free numbers may be any that `write` takes. A number with
    a normal prior is written as that prior (several of them as their product), without its box. Not
    written: the weak prior, and that a box is searched in the logarithm.

    Args:
        path: the parameter file, e.g. `a.par`; the others are `a_galaxies.cat`, `a_images.cat`.
        problem: the fit; its `build` must be a `ClusterModel`.
        params: free numbers at which the file starts.
        reference: (RA, Dec) of the origin, degrees.

    Raises:
        ValueError: naming what the format cannot hold, such as a log-normal prior.
    """
    path, model = Path(path), problem.build
    if not isinstance(model, ClusterModel):
        raise ValueError("`problem.build` is not a ClusterModel; only these have a file format.")
    _refuse_unknown(problem)
    contents: dict[Path, list[str]] = {}
    if model.groups:
        names = ", ".join(one.name for one in model.groups)
        raise ValueError(
            f"The model has groups of galaxies on scaling relations of their own ({names}), which are not "
            "written; write the fitted lens instead, it holds all of them."
        )
    file = path.with_name(f"{path.stem}_images.cat")
    contents[file], sigma = catalogue(problem.images, reference)
    about = image(problem.images, file.name, sigma)
    about[-1:] = [*_redshifts(problem, model), about[-1]]
    masses: list[str] = []
    for one in model.ingredients:
        masses += _ingredient(one, model, problem, params)
    if model.members is not None:
        galaxies = path.with_name(f"{path.stem}_galaxies.cat")
        contents[galaxies] = _galaxies(model, reference)
        masses += _potfile(model, problem, params, galaxies.name)
    count = len(model.ingredients)
    contents[path] = [
        *runmode(reference),
        *about,
        *grid(count, count),
        *masses,
        *cosmology(model.plane),
        "fini",
    ]
    save(contents)


def _refuse_unknown(problem: Problem) -> None:
    """Priors and errors for which the format has no word."""
    skewed = [f"`{one.name}`" for one in problem.priors if isinstance(one, LogNormalPrior)]
    if skewed:
        raise ValueError(
            f"The log-normal prior on {', '.join(skewed)} cannot be written: Lenstool has "
            "uniform and normal ones. Give a NormalPrior of the same median and width, or the box alone."
        )
    unknown = [one for one in problem.priors if not isinstance(one, NormalPrior | RedshiftPrior)]
    if unknown:
        raise ValueError(f"The prior {unknown[0]!r} cannot be written; only normal priors can.")
    if SIGMA in problem.bounds:
        raise ValueError(
            f"`{SIGMA}`, a free factor on the position errors, cannot be written; write the problem with "
            "fixed ones, which `strong.scale_sigma` multiplies by the fitted factor."
        )


def _limit(problem: Problem, key: str, *, turn: bool = False) -> str:
    """`kind first second precision` of a free number."""
    convert = math.degrees if turn else float
    normal, bound = normal_laws(problem.priors).get(key), problem.bounds[key]
    if normal is not None:
        return f"3 {convert(normal[0])!r} {convert(normal[1])!r} 0.01"
    if isinstance(bound, Angle):
        return "1 -90.0 90.0 0.01"
    if isinstance(bound, Box):
        return f"1 {convert(float(bound.lo))!r} {convert(float(bound.hi))!r} 0.01"
    raise ValueError(
        f"`{key}` has a bound of kind {type(bound).__name__}, for which Lenstool has no word; free the "
        "ellipticity (or shear) and the angle apart."
    )


def _ingredient(
    one: Ingredient, model: ClusterModel, problem: Problem, params: Mapping[str, Array]
) -> list[str]:
    free = {key.partition(".")[2]: key for key in params if key.startswith(f"{one.name}.")}
    own = {key: value for key, value in params.items() if key in free.values()}
    (component,) = ClusterModel(model.plane, (one,), None, jnp.zeros(0)).lens(own).components.values()
    z_lens = {"z_lens": float(model.plane.z_l)}
    if not free:
        (rows,) = potentials(component, model.plane, f"Component {one.name!r}")
        return section(f"potentiel {one.name}", {**rows, **z_lens})
    for key in free.values():
        _limit(problem, key)  # refuses what has no word, before the kind is looked at
    if one.form not in _KEYS:
        raise ValueError(
            f"Component {one.name!r} has free numbers of the kind `{one.form}`, which Lenstool does not "
            f"know; use one of {', '.join(_KEYS)}, or fix its numbers."
        )
    profil, names = _KEYS[one.form]
    values = {**one.fixed, **{number: params[key] for number, key in free.items()}}
    rows: dict[str, float | int] = {"profil": profil}
    limits = {}
    for key, number in names.items():
        value = float(values.get(number, 0.0))
        rows[key] = math.degrees(value) if number == "pa" else value
        if number in free:
            limits[key] = _limit(problem, free[number], turn=number == "pa")
    return [
        *section(f"potentiel {one.name}", {**rows, **z_lens}),
        *section(f"limit {one.name}", limits),
    ]


def _galaxies(model: ClusterModel, reference: tuple[float, float] | None) -> list[str]:
    one = model.members
    assert one is not None
    if one.convention != "dpie_lenstool" or one.exponents[2] != 0.5:
        raise ValueError(
            f"Members with convention {one.convention!r} and core exponent {one.exponents[2]:g}; Lenstool's "
            "are `dpie_lenstool` with 0.5. Write the lens instead: every member becomes a potential."
        )
    lines = [] if reference is None else [f"#REFERENCE 3 {reference[0]!r} {reference[1]!r}"]
    ellipticity = np.asarray(one.e)
    q = np.sqrt((1.0 - ellipticity) / (1.0 + ellipticity))
    mag = -2.5 * np.log10(np.asarray(one.luminosity))
    columns = (*np.asarray(one.theta).T, q, np.rad2deg(np.asarray(one.pa)), mag)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return lines + [f"{k} {x!r} {y!r} 1.0 {b!r} {t!r} {m!r} 0.0" for k, (x, y, b, t, m) in enumerate(rows, 1)]


def _potfile(model: ClusterModel, problem: Problem, params: Mapping[str, Array], name: str) -> list[str]:
    one = model.members
    assert one is not None
    if "members.r_core_ref_arcsec" in params:
        raise ValueError("`members.r_core_ref_arcsec` is free; Lenstool's core radius of galaxies is fixed.")
    rows: dict[str, object] = {
        "filein": f"1 {name}",
        "zlens": float(model.plane.z_l),
        "type": 81,
        "mag0": 0.0,
    }
    rows["core"] = float(one.fixed.get("r_core_ref_arcsec", 0.0))
    for key, number in _MEMBERS.items():
        full = f"members.{number}"
        rows[key] = _limit(problem, full) if full in params else f"0 {float(one.fixed[number])!r} 0.0"
    rows["slope"] = f"0 {2.0 / one.exponents[1]!r} 0.0"
    rows["vdslope"] = f"0 {1.0 / one.exponents[0]!r} 0.0"
    return section("potfile 1", rows)


def _redshifts(problem: Problem, model: ClusterModel) -> list[str]:
    lines = []
    for key, bound in problem.bounds.items():
        owner, _, system = key.partition(".")
        if owner != "dls_ds":
            continue
        normal = normal_laws(problem.priors).get(key)
        if normal is not None:
            said = f"3 {normal[0]!r} {normal[1]!r}"
        else:
            assert isinstance(bound, Box)
            ends = [float(redshift_of_dls_ds(model.plane, end)) for end in (bound.lo, bound.hi)]
            said = f"1 {ends[0]!r} {ends[1]!r}"
        lines.append(f"\tz_m_limit {len(lines) + 1} {system} {said} 0.01")
    return lines
