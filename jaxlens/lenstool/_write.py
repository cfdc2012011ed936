"""A lens, with or without images, as a Lenstool parameter file."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens.cosmology import LensPlane
from jaxlens.io import atomic
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, NFW, SIE, Shear, nfw, profile_of
from jaxlens.strong import ImageCatalogue
from jaxlens.units import ARCSEC, C_KM_S

Potential = dict[str, float | int]
"""Keys and values of one `potentiel` section."""


def _sigma(b: float, f: float, where: str) -> float:
    """The velocity dispersion of a strength b = f 6 pi (sigma/c)^2 [arcsec], km/s."""
    if b < 0.0:
        raise ValueError(f"{where} has the negative strength {b:g} arcsec, and so no velocity dispersion.")
    return C_KM_S * math.sqrt(b * ARCSEC / (6.0 * math.pi * f))


def potentials(component: Component, plane: LensPlane, where: str) -> list[Potential]:
    """One section for each profile of a component."""
    p: Any = component.params
    found: list[Potential] = []
    for k in range(len(component)):
        x, y = (float(v) for v in component.centre[k])
        angle = math.degrees(float(component.pa[k]))
        place = {"x_centre": x, "y_centre": y}
        if isinstance(p, DPIE | SIE):
            q = 1.0 - float(p.e[k])
            f, ellipticity = 2.0 * math.sqrt(q) / (1.0 + q), (1.0 - q**2) / (1.0 + q**2)
            shape = {**place, "ellipticite": ellipticity, "angle_pos": angle}
            core = float(p.r_core[k]) / f
            if isinstance(p, DPIE):
                cut = float(p.r_cut[k]) / f
                sigma = _sigma(float(p.b[k]) * (cut - core) / cut, f, where)
                found.append({"profil": 81, **shape, "core_radius": core, "cut_radius": cut, "v_disp": sigma})
            else:
                sigma = _sigma(float(p.b[k]), f, where)
                found.append({"profil": 8, **shape, "core_radius": core, "v_disp": sigma})
        elif isinstance(p, NFW) and float(p.e[k]) == 0.0:
            r_s, kappa_s = float(p.r_s[k]), float(p.kappa_s[k])
            length = float(plane.d_l) * ARCSEC * r_s
            rho = float(plane.cosmology.critical_density(plane.z_l))
            ratio = kappa_s * float(plane.sigma_cr_inf) / (200.0 / 3.0 * rho * length)
            c = nfw.concentration_of(ratio)
            found.append({"profil": 12, **place, "scale_radius": r_s, "concentration": c})
        elif isinstance(p, Shear):
            if (x, y) != (0.0, 0.0):
                raise ValueError(
                    f"{where} is a shear about ({x:g}, {y:g}); Lenstool's is about the origin. Move it "
                    "there: that shifts the sources alone."
                )
            found.append({"profil": 14, "gamma": float(p.gamma[k]), "angle_pos": angle})
        else:
            elliptical = "n elliptical" if isinstance(p, NFW) else ""
            raise ValueError(
                f"{where} is a{elliptical} {profile_of(p).name}, for which Lenstool has no exact "
                "counterpart; written are DPIE, SIE, round NFW and Shear. Take it out, or replace it."
            )
    return found


def section(head: str, rows: dict[str, Any]) -> list[str]:
    """The lines of one section."""
    said = [f"\t{key} {float(v)!r}" if isinstance(v, float) else f"\t{key} {v}" for key, v in rows.items()]
    return [head, *said, "\tend"]


def cosmology(plane: LensPlane) -> list[str]:
    """The section `cosmologie`."""
    omega = float(plane.cosmology.omega_m)
    numbers = {"H0": 100.0 * float(plane.cosmology.h), "omega": omega, "lambda": 1.0 - omega}
    return section("cosmologie", numbers)


def catalogue(images: ImageCatalogue, reference: tuple[float, float] | None) -> tuple[list[str], float]:
    """Lines of a `multfile` in arcsec, and the common position error.

    Raises:
        ValueError: if the errors differ.
    """
    sigma = np.asarray(images.sigma_pos)
    if np.ptp(sigma) > 1e-12 * sigma.max():
        raise ValueError(
            f"The position errors differ ({sigma.min():g} to {sigma.max():g} arcsec); `sigposArcsec` is one "
            "number for all images. Give them one error, or write the systems apart."
        )
    lines = [] if reference is None else [f"#REFERENCE 3 {reference[0]!r} {reference[1]!r}"]
    source, count = np.asarray(images.source), {}
    for k, (x, y) in enumerate(np.asarray(images.theta).tolist()):
        s = int(source[k])
        count[s] = count.get(s, 0) + 1
        z = float(images.z_s[s])
        # Names are made from the system, by which images are grouped when they are read.
        name = f"{images.systems[s]}.{count[s]}"
        lines.append(f"{name} {x!r} {y!r} 1.0 1.0 0.0 {0.0 if math.isnan(z) else z!r} 0.0")
    return lines, float(sigma[0])


def runmode(reference: tuple[float, float] | None) -> list[str]:
    """The section `runmode`."""
    ra, dec = reference or (0.0, 0.0)
    return section("runmode", {"reference": f"3 {ra!r} {dec!r}"})


def image(images: ImageCatalogue, name: str, sigma: float) -> list[str]:
    """The section `image`."""
    return section("image", {"multfile": f"1 {name}", "forme": 0, "sigposArcsec": sigma})


def grid(count: int, free: int) -> list[str]:
    """The section `grille`."""
    return section("grille", {"nombre": 128, "polaire": 0, "nlentille": count, "nlens_opt": free})


def save(contents: dict[Path, list[str]]) -> None:
    """Write the files, each in one step."""
    for path, lines in contents.items():
        with atomic(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write(
    path: str | Path,
    lens: Lens,
    plane: LensPlane,
    *,
    images: ImageCatalogue | None = None,
    reference: tuple[float, float] | None = None,
) -> None:
    """Write a lens as a parameter file that reads back to 1e-12 in the deflection.

    Every profile becomes one `potentiel`, numbered within its component: `halo-1`, `halo-2`.

    Args:
        path: the file, e.g. `a.par`; replaced in one step.
        lens: the lens.
        plane: its plane.
        images: multiple images, for `a_images.cat` beside it.
        reference: (RA, Dec) of the origin, degrees.

    Raises:
        ValueError: naming what the format cannot hold.
    """
    path = Path(path)
    sections = []
    for name, component in lens.components.items():
        for k, one in enumerate(potentials(component, plane, f"Component {name!r}"), start=1):
            sections += section(f"potentiel {name}-{k}", {**one, "z_lens": float(plane.z_l)})
    contents: dict[Path, list[str]] = {}
    about: list[str] = []
    if images is not None:
        file = path.with_name(f"{path.stem}_images.cat")
        contents[file], sigma = catalogue(images, reference)
        about = image(images, file.name, sigma)
    count = sum(len(component) for component in lens.components.values())
    contents[path] = [*runmode(reference), *about, *grid(count, 0), *sections, *cosmology(plane), "fini"]
    save(contents)
