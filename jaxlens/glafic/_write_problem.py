"""A whole fit in glafic's files: model, galaxies, images, boxes and normal priors."""

import math
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array
from jaxlens.cosmology import redshift_of_dls_ds
from jaxlens.glafic._forms import ELLIPSE, GALAXIES, KINDS, degrees
from jaxlens.glafic._write import Row, head_lines, lens_rows, save, startup_lines, words_of
from jaxlens.strong import (
    FORMS,
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
from jaxlens.units import nearest_angle

_FORM_KINDS = {
    "glafic_anfw": "anfw",
    "glafic_ahern": "ahern",
    "glafic_jaffe": "jaffe",
    "dpie": "jaffe",
    "sie": "sie",
    "glafic_point": "point",
}


def write_problem(path: str | Path, problem: Problem, params: Mapping[str, Array]) -> None:
    """Write a fit: input, galaxies, images and priors, beside each other.

    Numbers that are free must be glafic's own (the kinds `glafic_*`, `dpie`, `sie`); components without
    free numbers may be any that `write` takes. Not written, because the format has no word for it:
    the weak prior, and that a box is searched in the logarithm.

    Args:
        path: the input file, e.g. `a.input`; the others are `a_galaxies.dat`, `a_images.dat`, `a_prior.dat`.
        problem: the fit; its `build` must be a `ClusterModel`.
        params: free numbers at which the file starts.

    Raises:
        ValueError: naming what the format cannot hold, such as a log-normal prior.
    """
    path, model = Path(path), problem.build
    if not isinstance(model, ClusterModel):
        raise ValueError("`problem.build` is not a ClusterModel; only these have a file format.")
    if model.groups:
        names = ", ".join(one.name for one in model.groups)
        raise ValueError(
            f"The model has groups of galaxies on scaling relations of their own ({names}), which are not "
            "written; write the fitted lens instead, it holds all of them."
        )
    _refuse_unknown(problem)
    files = {what: path.with_name(f"{path.stem}_{what}.dat") for what in ("galaxies", "images", "prior")}
    contents: dict[str, list[str]] = {}
    rows: list[Row] = []
    flags: list[list[int]] = []
    places: dict[str, tuple[str, int, int]] = {}
    for one in model.ingredients:
        _ingredient(one, problem, model, params, rows, flags, places)
    if model.members is not None:
        contents["galaxies"] = _galaxies(model, params, rows, flags, places)
    points, point_flags = _points(problem, model, params, places)
    contents["prior"] = _priors(problem, model, params, places)
    contents["images"] = _observed(problem, points)
    for what, lines in contents.items():
        save(files[what], lines)
    galfile = [f"galfile {files['galaxies'].name}"] if model.members is not None else []
    save(
        path,
        [
            *head_lines(model.plane),
            *galfile,
            "chi2_splane 1",
            "",
            *startup_lines(rows, points),
            "",
            "start_setopt",
            *(" ".join(map(str, row)) for row in [*flags, *point_flags]),
            "end_setopt",
            "",
            "start_command",
            f"readobs_point {files['images'].name}",
            f"parprior {files['prior'].name}",
            "optimize",
            "quit",
        ],
    )


def _refuse_unknown(problem: Problem) -> None:
    """Priors and errors for which the format has no word."""
    skewed = [f"`{one.name}`" for one in problem.priors if isinstance(one, LogNormalPrior)]
    if skewed:
        raise ValueError(
            f"The log-normal prior on {', '.join(skewed)} cannot be written: glafic has "
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


def _ingredient(
    one: Ingredient,
    problem: Problem,
    model: ClusterModel,
    params: Mapping[str, Array],
    rows: list[Row],
    flags: list[list[int]],
    places: dict[str, tuple[str, int, int]],
) -> None:
    free = {key.partition(".")[2]: key for key in params if key.startswith(f"{one.name}.")}
    if not free:
        alone = ClusterModel(model.plane, (one,), None, jnp.zeros(0))
        (component,) = alone.lens({}).components.values()
        rows += lens_rows(component, model.plane, f"Component {one.name!r}")
        flags.append([0] * 8)
        return
    if one.form not in _FORM_KINDS:
        raise ValueError(
            f"Component {one.name!r} has free numbers of the kind `{one.form}`, which glafic does not know; "
            f"use one of {', '.join(_FORM_KINDS)}, or fix its numbers."
        )
    kind = _FORM_KINDS[one.form]
    by_name = {number: place for place, number in {**ELLIPSE, **KINDS[kind][1]}.items()}
    if "shape" in free:
        raise ValueError(
            f"`{one.name}.shape` frees ellipticity and angle together, for which glafic has no word; free "
            f"`{one.name}.{FORMS[one.form].shape}` and `{one.name}.pa` apart."
        )
    row, flag = [float(model.plane.z_l)] + [0.0] * 7, [0] * 8
    for number, value in {**one.fixed, **{number: params[key] for number, key in free.items()}}.items():
        row[by_name[number] - 1] = degrees(float(value)) if number == "pa" else float(value)
    if "pa" not in one.fixed and "pa" not in free:
        row[5] = degrees(0.0)
    rows.append((kind, row))
    for number, key in free.items():
        if number == "pa":
            row[by_name[number] - 1] = _angle(problem, key, params)
        flag[by_name[number] - 1] = 1
        places[key] = ("lens", len(rows), by_name[number])
    flags.append(flag)


def _galaxies(
    model: ClusterModel,
    params: Mapping[str, Array],
    rows: list[Row],
    flags: list[list[int]],
    places: dict[str, tuple[str, int, int]],
) -> list[str]:
    one = model.members
    assert one is not None
    core = [float(one.fixed.get("r_core_ref_arcsec", 0.0)), float("members.r_core_ref_arcsec" in params)]
    if one.convention != "dpie" or one.exponents[0] != 0.25 or any(core):
        raise ValueError(
            f"Members with convention {one.convention!r}, sigma exponent {one.exponents[0]:g} and core "
            f"{core[0]:g} arcsec; glafic's `gals` are dPIEs (`dpie`) with exponent 0.25 and no core."
        )
    pa = [degrees(float(value)) for value in one.pa]
    columns = [one.theta[:, 0], one.theta[:, 1], one.luminosity, one.e, pa]
    lines = [words_of(list(map(float, row))) for row in zip(*columns, strict=True)]
    row, flag = [float(model.plane.z_l)] + [0.0] * 7, [0] * 8
    row[7] = one.exponents[1]
    for place, number in GALAXIES.items():
        key = f"members.{number}"
        row[place - 1] = float(params[key] if key in params else one.fixed[number])
        if key in params:
            flag[place - 1] = 1
            places[key] = ("lens", len(rows) + 1, place)
    rows.append(("gals", row))
    flags.append(flag)
    return lines


def _points(
    problem: Problem,
    model: ClusterModel,
    params: Mapping[str, Array],
    places: dict[str, tuple[str, int, int]],
) -> tuple[list[list[float]], list[list[int]]]:
    points, flags = [], []
    for index, system in enumerate(problem.images.systems):
        key, z = f"dls_ds.{system}", float(problem.images.z_s[index])
        if key in params:
            z = float(redshift_of_dls_ds(model.plane, params[key]))
            places[key] = ("point", index + 1, 1)
        points.append([z, 0.0, 0.0])
        flags.append([int(key in params), 1, 1])
    return points, flags


def _priors(
    problem: Problem,
    model: ClusterModel,
    params: Mapping[str, Array],
    places: dict[str, tuple[str, int, int]],
) -> list[str]:
    lines = []
    for key, bound in problem.bounds.items():
        of, index, place = places[key]
        if isinstance(bound, Angle):
            ends = [-180.0, 180.0]
        elif isinstance(bound, Box):
            ends = [float(bound.lo), float(bound.hi)]
            if of == "point":
                ends = [float(redshift_of_dls_ds(model.plane, end)) for end in (bound.lo, bound.hi)]
            elif key.endswith(".pa"):
                ends = [math.degrees(end) - 90.0 for end in ends]
        else:
            raise ValueError(f"`{key}` has a bound of kind {type(bound).__name__}, which cannot be written.")
        lines.append(f"range {of} {index} {place} {words_of(ends)}")
    for key, (mean, sigma) in normal_laws(problem.priors).items():
        of, index, place = places[key]
        values = [mean, sigma]
        if key.endswith(".pa"):
            # Moved by as many half turns as the angle itself, from which it is subtracted.
            away = math.degrees(mean - float(params[key]))
            values = [_angle(problem, key, params) + away, math.degrees(sigma)]
        lines.append(f"gauss {of} {index} {place} {words_of(values)}")
    return lines


def _angle(problem: Problem, key: str, params: Mapping[str, Array]) -> float:
    """A free position angle in glafic's degrees, inside the range that is written for it."""
    bound, value = problem.bounds[key], float(params[key])
    if not isinstance(bound, Box):
        return degrees(value)
    return nearest_angle(math.degrees(value) - 90.0, math.degrees(0.5 * float(bound.lo + bound.hi)) - 90.0)


def _observed(problem: Problem, points: list[list[float]]) -> list[str]:
    images = problem.images
    lines = [
        "# number, images, redshift, its error; then x, y, flux, errors of position, flux, delay, parity"
    ]
    source = np.asarray(images.source)
    for index, point in enumerate(points):
        mine = np.flatnonzero(source == index)
        lines.append(f"{index + 1} {len(mine)} {point[0]!r} 0.0")
        for k in mine:
            x, y = (float(v) for v in images.theta[k])
            lines.append(f"{x!r} {y!r} 1.0 {float(images.sigma_pos[k])!r} 0.0 0.0 0.0 0")
    return lines
