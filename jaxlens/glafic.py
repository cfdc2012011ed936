"""A first reader of glafic input: mass model, galaxies, images and boxes become a `strong.Problem`.

Read are the commands a strong-lensing optimisation needs: cosmology, `galfile`, `startup` with `lens`
and `point`, `setopt`, `readobs_point` and `parprior` with `range`. Masses there are in Msun/h and
position angles from North through East of a frame with x to the right; both are converted here. The
norms are glafic's own (they differ from the constants of this package by 3e-5), so that its chi^2 and
masses compare digit by digit. Conventions: Oguri 2010 (PASJ 62, 1017), Oguri 2021 (PASP 133, 074504).
"""

import math
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxlens import profiles
from jaxlens._types import Array
from jaxlens.cosmology import FlatLCDM, LensPlane, nakamura_suto
from jaxlens.profiles import dpie
from jaxlens.strong import (
    FORMS,
    Angle,
    Bounds,
    Box,
    ClusterModel,
    Form,
    ImageCatalogue,
    Ingredient,
    MemberSet,
    Problem,
)
from jaxlens.units import ARCSEC, C_KM_S

# Numbers of glafic 2.1.15, in its units: masses Msun/h, distances c/H0, c/H0 in Mpc/h.
_HUBBLE_MPC_H = C_KM_S / 100.0
_NFW_RS_NORM = 9.510361e-05  # Mpc/h (Msun/h)^(-1/3)
_NFW_B_NORM = 6.34482175e-08  # (Msun/h)^(-1/3)
_SIGMA_CRIT_NORM = 5.5467248e14  # h Msun/Mpc^2, times D_s/(D_l D_ls) in c/H0


def _hubble_distance(plane: LensPlane) -> Array:
    return plane.d_l * plane.cosmology.h / _HUBBLE_MPC_H


def anfw(plane: LensPlane, e: Array, mass_h: Array, concentration: Array) -> profiles.NFW:
    """glafic's `anfw`: virial mass in Msun/h, concentration."""
    d_l = _hubble_distance(plane)
    contrast = nakamura_suto(plane.cosmology, plane.z_l) * plane.cosmology.efunc2(plane.z_l)
    c = concentration
    r_s = _NFW_RS_NORM * jnp.cbrt(mass_h / contrast) / c / (d_l * _HUBBLE_MPC_H * ARCSEC)
    shape = c**2 / (jnp.log1p(c) - c / (1.0 + c))
    return profiles.NFW(
        kappa_s=0.25 * _NFW_B_NORM * jnp.cbrt(mass_h * contrast**2) * shape * d_l, r_s=r_s, e=e
    )


def ahern(plane: LensPlane, e: Array, mass_h: Array, r_b: Array) -> profiles.Hernquist:
    """glafic's `ahern`: total mass in Msun/h, scale radius in arcsec."""
    d_l = _hubble_distance(plane)
    area = 2.0 * jnp.pi * (r_b * ARCSEC * d_l * _HUBBLE_MPC_H) ** 2
    return profiles.Hernquist(kappa_s=mass_h / area * d_l / _SIGMA_CRIT_NORM, r_s=r_b, e=e)


FORMS["glafic_anfw"] = Form(("mass_vir_msun_h", "concentration"), anfw)
FORMS["glafic_ahern"] = Form(("mass_msun_h", "r_s_arcsec"), ahern)
FORMS["glafic_jaffe"] = Form(
    ("sigma_v_km_s", "r_cut_arcsec", "r_core_arcsec"),
    lambda plane, e, sigma, cut, core: dpie.from_sigma_v(sigma, core, cut, e=e),
)

KINDS = {
    "anfw": ("glafic_anfw", {2: "mass_vir_msun_h", 7: "concentration"}),
    "ahern": ("glafic_ahern", {2: "mass_msun_h", 7: "r_s_arcsec"}),
    "jaffe": ("glafic_jaffe", {2: "sigma_v_km_s", 7: "r_cut_arcsec", 8: "r_core_arcsec"}),
    "sie": ("sie", {2: "sigma_v_km_s", 7: "r_core_arcsec"}),
}
ELLIPSE = {3: "x_arcsec", 4: "y_arcsec", 5: "e", 6: "pa"}
GALAXIES = {2: "sigma_ref_km_s", 7: "r_cut_ref_arcsec"}
_SETTINGS = {"omega", "lambda", "weos", "hubble", "galfile"}
_IGNORED = {
    "prefix",
    "xmin",
    "xmax",
    "ymin",
    "ymax",
    "pix_ext",
    "pix_poi",
    "maxlev",
    "chi2_restart",
    "chi2_checknimg",
}
_ACTIONS = {"optimize", "quit", "writelens", "findimg", "calcimage"}


@dataclass(frozen=True)
class GlaficInput:
    """A glafic input file, read.

    Attributes:
        problem: the fit; boxes from `parprior`, no weak prior.
        start: the numbers of the file, for the first start.
        plane: the lens plane.
    """

    problem: Problem
    start: dict[str, Array]
    plane: LensPlane


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} does not exist.") from error
    split = [(n, line.split("#")[0].split()) for n, line in enumerate(text.splitlines(), start=1)]
    return [(n, words) for n, words in split if words]


def _numbers(path: Path, n: int, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{path}, line {n}: {' '.join(words)!r} should be numbers only.") from error


@dataclass
class _Raw:
    settings: dict[str, str]
    lenses: list[tuple[str, list[float]]]
    redshifts: list[float]
    free: list[list[int]]
    files: dict[str, str]


def _scan(path: Path) -> _Raw:
    raw = _Raw({}, [], [], [], {})
    unknown: list[str] = []
    in_options = False
    for n, words in _lines(path):
        head = words[0]
        if head in {"startup", "end_startup", "start_command"} or head in _IGNORED | _ACTIONS:
            continue
        if head in {"start_setopt", "end_setopt"}:
            in_options = head == "start_setopt"
        elif in_options:
            raw.free.append([int(value) for value in _numbers(path, n, words)])
        elif head == "chi2_splane":
            if words[1] != "1":
                raise ValueError(
                    f"{path}, line {n}: chi2_splane is {words[1]}; only 1 (source plane) is read."
                )
        elif head in _SETTINGS:
            raw.settings[head] = words[1]
        elif head == "lens":
            raw.lenses.append((words[1], _numbers(path, n, words[2:])))
        elif head == "point":
            raw.redshifts.append(_numbers(path, n, words[1:])[0])
        elif head in {"readobs_point", "parprior"}:
            raw.files[head] = words[1]
        else:
            unknown.append(f"{head} (line {n})")
    if unknown:
        raise ValueError(
            f"{path} has commands that are not read: {', '.join(unknown)}. "
            "Remove them, or the parts they set up."
        )
    if "readobs_point" not in raw.files:
        raise ValueError(f"{path} has no `readobs_point`: there are no images to fit.")
    return raw


def read_observations(path: Path) -> ImageCatalogue:
    """Read a `readobs_point` file: systems of images with redshift and position error."""
    lines = _lines(path)
    theta, source, sigma, z_s, names, ids = [], [], [], [], [], []
    at = 0
    while at < len(lines):
        n, words = lines[at]
        head = _numbers(path, n, words)
        count = int(head[1])
        if len(head) > 3 and head[3] != 0.0:
            raise ValueError(
                f"{path}, line {n}: the redshift of system {words[0]} has an error; "
                "free redshifts are not read."
            )
        rows = lines[at + 1 : at + 1 + count]
        if len(rows) < count:
            raise ValueError(
                f"{path}, line {n}: system {words[0]} announces {count} images, the file has {len(rows)}."
            )
        for k, (m, row) in enumerate(rows, start=1):
            x, y, _, error = _numbers(path, m, row)[:4]
            theta.append((x, y))
            sigma.append(error)
            source.append(len(z_s))
            ids.append(f"{words[0]}.{k}")
        z_s.append(head[2])
        names.append(words[0])
        at += 1 + count
    return ImageCatalogue(
        np.array(theta), np.array(source), np.array(z_s), np.array(sigma), tuple(names), tuple(ids)
    )


def _ranges(path: Path) -> dict[tuple[int, int], tuple[float, float]]:
    found = {}
    for n, words in _lines(path):
        if words[:2] != ["range", "lens"]:
            raise ValueError(f"{path}, line {n}: {' '.join(words[:2])!r} is not read; only `range lens` is.")
        lens, number, low, high = _numbers(path, n, words[2:6])
        found[int(lens), int(number)] = (low, high)
    return found


def _galaxies(path: Path) -> np.ndarray:
    rows = [_numbers(path, n, words) for n, words in _lines(path)]
    # The program holds galaxies in single precision; rounding first makes the comparison exact.
    return np.array(rows, dtype=np.float32).astype(float)


def radians(degrees: float) -> float:
    """glafic's angle, from +y counter-clockwise, as ours, from +x."""
    return math.radians(degrees + 90.0)


def read(path: Path) -> GlaficInput:
    """Read a glafic input file and the files it names (relative to it).

    Raises:
        ValueError: naming file, line and command, if something is not understood.
        FileNotFoundError: if a file is missing.
    """
    raw = _scan(path)
    folder = path.parent
    cosmology = FlatLCDM(
        h=float(raw.settings.get("hubble", 0.7)), omega_m=float(raw.settings.get("omega", 0.3))
    )
    plane = LensPlane(cosmology, raw.lenses[0][1][0])
    images = read_observations(folder / raw.files["readobs_point"])
    ranges = _ranges(folder / raw.files["parprior"]) if "parprior" in raw.files else {}

    ingredients: list[Ingredient] = []
    members: MemberSet | None = None
    bounds: Bounds = {}
    start: dict[str, Array] = {}
    for index, (kind, values) in enumerate(raw.lenses, start=1):
        flags = raw.free[index - 1] if raw.free else [0] * len(values)
        if kind == "gals":
            name, names = "members", dict(GALAXIES)
        elif kind in KINDS:
            name, names = f"lens{index}", {**ELLIPSE, **KINDS[kind][1]}
        else:
            raise ValueError(f"{path}: lens {index} is `{kind}`; read are {', '.join([*KINDS, 'gals'])}.")
        fixed: dict[str, Array] = {}
        for position, number in names.items():
            value = radians(values[position - 1]) if number == "pa" else values[position - 1]
            if not flags[position - 1]:
                fixed[number] = jnp.asarray(value)
                continue
            if (index, position) not in ranges:
                raise ValueError(
                    f"{path}: parameter {position} of lens {index} is free, "
                    "but the prior file has no `range` for it."
                )
            low, high = ranges[index, position]
            if number == "pa" and high - low >= 180.0:
                bounds[f"{name}.{number}"] = Angle()
            else:
                low, high = (radians(low), radians(high)) if number == "pa" else (low, high)
                bounds[f"{name}.{number}"] = Box(low, high)
            start[f"{name}.{number}"] = jnp.asarray(value)
        if kind == "gals":
            galaxies = _galaxies(folder / raw.settings["galfile"])
            members = MemberSet(
                theta=jnp.asarray(galaxies[:, :2]),
                luminosity=jnp.asarray(galaxies[:, 2]),
                e=jnp.asarray(galaxies[:, 3]),
                pa=jnp.deg2rad(jnp.asarray(galaxies[:, 4]) + 90.0),
                fixed=fixed,
                exponents=(0.25, values[7], 0.5),
            )
        else:
            ingredients.append(Ingredient(name, KINDS[kind][0], fixed))
    model = ClusterModel(plane, tuple(ingredients), members, plane.dls_ds(images.z_s), images.systems)
    return GlaficInput(Problem(model, bounds, images), start, plane)
