"""A cluster of 54 components and its 68 images, with 26 free numbers: the lens that all programs are given.

Two elliptical NFW haloes, two elliptical Hernquist galaxies, 50 round members on scaling relations
(`tests/reference/lenstronomy/cluster_components.csv`); 22 systems of images (`data/composite54`). The vector
p of free numbers is (strength, r_s, x, y, e, pa) of each of the four, then b and r_cut of the brightest
member.

    python benchmarks/_composite.py     # makes the images anew
"""

import csv
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import ROOT  # noqa: E402

from jaxlens import lens_equation, strong  # noqa: E402
from jaxlens.lens import Component, Lens  # noqa: E402
from jaxlens.profiles import DPIE, NFW, Hernquist  # noqa: E402

COMPONENTS = ROOT / "tests" / "reference" / "lenstronomy" / "cluster_components.csv"
IMAGES = ROOT / "benchmarks" / "data" / "composite54" / "images.csv"
MAIN = 4
CORE = 0.05
HALF_WIDTH = 80.0
"""Half the window that holds all images, arcsec."""


class Composite(NamedTuple):
    """The free numbers p `(26,)`, the members, and the images."""

    p: np.ndarray
    luminosity: np.ndarray
    x: np.ndarray
    y: np.ndarray
    images: strong.ImageCatalogue
    dls_ds: np.ndarray

    def lens(self, p: Any) -> Lens:
        """Our lens of the free numbers."""
        main = jnp.asarray(p)[: 6 * MAIN].reshape(MAIN, 6)
        each = lambda kind, rows: Component(
            kind(rows[:, 0], rows[:, 1], rows[:, 4]), centre=rows[:, 2:4], pa=rows[:, 5]
        )
        root = np.sqrt(self.luminosity)
        members = DPIE(p[-2] * root, CORE * np.ones_like(root), p[-1] * root, np.zeros_like(root))
        return Lens(
            halo=each(NFW, main[:2]),
            bcg=each(Hernquist, main[2:]),
            members=Component(members, np.stack([self.x, self.y], axis=1)),
        )

    def resized(self, members: int, copies: int = 1) -> "Composite":
        """The same with other members (repeated when there are more), and the images `copies` times."""
        pick = np.arange(members) % len(self.x)
        turn = np.exp(2j * np.pi * 0.618 * (np.arange(members) // len(self.x)))  # repetitions elsewhere
        at = (self.x + 1j * self.y)[pick] * turn
        sky, n = self.images, self.images.n_systems
        images = strong.ImageCatalogue(
            theta=jnp.tile(sky.theta, (copies, 1)),
            source=jnp.concatenate([sky.source + k * n for k in range(copies)]),
            z_s=jnp.tile(sky.z_s, copies),
            sigma_pos=jnp.tile(sky.sigma_pos, copies),
        )
        return Composite(
            self.p, self.luminosity[pick], at.real, at.imag, images, np.tile(self.dls_ds, copies)
        )


def _rows(path: Any) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _numbers() -> tuple[np.ndarray, np.ndarray]:
    """p `(26,)`, and luminosity, x and y of the members `(3, n)`, from lenstronomy's numbers."""
    rows = _rows(COMPONENTS)
    main = []
    for row in rows[:MAIN]:
        n = {key: float(value) for key, value in row.items() if value and key != "profile"}
        size = np.hypot(n["e1"], n["e2"])
        q, r_s = (1.0 - size) / (1.0 + size), n["Rs"]
        if row["profile"] == "NFW_ELLIPSE_CSE":
            strength = n["alpha_Rs"] / (4.0 * r_s * (1.0 - np.log(2.0)))
        else:
            strength, r_s = n["sigma0"] / q, r_s * np.sqrt(q)
        pa = 0.5 * np.arctan2(n["e2"], n["e1"])
        main.append([strength, r_s, n["center_x"], n["center_y"], 1.0 - q, pa])
    # The first member is the reference galaxy, L = 1; sigma0 = (b/2) (r_cut - r_core)/(r_core r_cut).
    first = rows[MAIN]
    cut = float(first["Rs"])
    b = 2.0 * float(first["sigma0"]) * CORE * cut / (cut - CORE)
    keys = ("luminosity", "center_x", "center_y")
    members = np.array([[float(row[key]) for key in keys] for row in rows[MAIN:]])
    return np.array([*np.ravel(main), b, cut]), members.T


def load() -> Composite:
    """The composite and its images."""
    p, members = _numbers()
    rows = _rows(IMAGES)
    columns = {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    system = columns["system"].astype(int)
    first = np.flatnonzero(np.diff(system, prepend=-1))
    images = strong.ImageCatalogue(
        theta=np.stack([columns["x_arcsec"], columns["y_arcsec"]], axis=1),
        source=system,
        z_s=np.full(len(first), np.nan),
        sigma_pos=columns["sigma_arcsec"],
    )
    return Composite(p, *members, images, columns["dls_ds"][first])


def make_images() -> None:
    """21 systems of three images and one of five, all brighter than |mu| = 0.2, errors of 0.15 arcsec."""
    p, members = _numbers()
    blank = strong.ImageCatalogue(np.zeros((1, 2)), np.zeros(1, int), np.ones(1), np.ones(1))
    lens = Composite(p, *members, blank, np.ones(1)).lens(p)
    rng = np.random.default_rng(20261129)
    beta, ratio = rng.uniform(-12.0, 12.0, (256, 2)), rng.uniform(0.7, 1.0, 256)
    found = lens_equation.solve(lens, beta, ratio, tiling=lens_equation.tile(lens, half_width=HALF_WIDTH))
    bright = np.asarray(found.valid) & (np.abs(np.asarray(found.mu)) > 0.2)
    count = bright.sum(axis=1)
    chosen = [*np.flatnonzero(count == 3)[:21], np.flatnonzero(count == 5)[0]]
    with open(IMAGES, "w", newline="", encoding="utf-8") as file:
        write = csv.writer(file, lineterminator="\n")
        write.writerow(["system", "x_arcsec", "y_arcsec", "sigma_arcsec", "dls_ds"])
        for system, s in enumerate(chosen):
            for x, y in np.asarray(found.theta)[s][bright[s]] + rng.normal(scale=0.15, size=(count[s], 2)):
                write.writerow([system, f"{x:.6f}", f"{y:.6f}", 0.15, f"{ratio[s]:.6f}"])


if __name__ == "__main__":
    make_images()
