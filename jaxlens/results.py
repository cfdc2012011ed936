"""The files of a strong-lensing fit: what is written, and under which name.

`summary.json`, `model.toml` (the lens, reads back bit for bit), `posterior.npz` (draws of it, see
`jaxlens.posterior`), `images_predicted.ecsv`, `systems.ecsv`, `images_spare.ecsv`, `masses.ecsv`, the
standard maps, `regions.reg`, and the figures. When asked for:
`kappa_draws.fits` (a cube of convergence maps of the Laplace draws) with `kappa_mean.fits` and
`kappa_std.fits`, all for D_LS/D_S = 1; `model_shear.toml` (the lens with a free external shear).
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlens import analysis_strong, critical, io, plotting, posterior
from jaxlens import lens as _lens
from jaxlens._outcome import N_INTERVAL, UNITS, Outcome, bound_names, derive, interval, unit_of
from jaxlens._summary_strong import summary, verdict
from jaxlens._tables_strong import image_table, redshifts, spare_table, system_table
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Lens
from jaxlens.strong import (
    ImageCatalogue,
)

__all__ = [
    "MAP_REDSHIFTS",
    "MARGIN",
    "N_INTERVAL",
    "PIXEL",
    "UNITS",
    "Outcome",
    "bound_names",
    "derive",
    "figures",
    "image_table",
    "interval",
    "map_grid",
    "spare_table",
    "standard_maps",
    "summary",
    "system_table",
    "typical_source",
    "unit_of",
    "verdict",
    "write",
]

PIXEL = 0.5
"""Pixel of the standard maps, arcsec (our choice: a tenth of the smallest critical features of interest)."""

MARGIN = 25.0
"""The maps reach this far beyond the outermost image, arcsec."""

MAP_REDSHIFTS = (1.0, 2.0, 4.0, 9.0)
"""Source redshifts of the magnification maps; those behind the lens are written."""


def map_grid(images: ImageCatalogue, pixel: float = PIXEL, margin: float = MARGIN) -> Grid:
    """A square grid around all images."""
    theta = np.asarray(images.theta)
    low, high = theta.min(axis=0), theta.max(axis=0)
    middle = np.round(0.5 * (low + high), 1)
    side = float((high - low).max()) + 2.0 * margin
    return Grid.square(side, pixel, (float(middle[0]), float(middle[1])))


def standard_maps(lens: Lens, plane: LensPlane, grid: Grid) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
    """The standard map set by file stem, each with its header.

    alpha, kappa, gamma and psi are for D_LS/D_S = 1 (`ZSOURCE` is then -1); mu for each of
    `MAP_REDSHIFTS` behind the lens.
    """
    theta = grid.theta
    # On the host from here on: each operation of JAX outside of a program is a program of its own.
    alpha, hessian = (np.asarray(part) for part in jax.jit(_lens.alpha_and_hessian)(lens, theta))
    with np.errstate(all="ignore"):  # a centre without a core in the middle of a pixel
        kappa = 0.5 * (hessian[..., 0, 0] + hessian[..., 1, 1])
        gamma_1, gamma_2 = 0.5 * (hessian[..., 0, 0] - hessian[..., 1, 1]), hessian[..., 0, 1]
    # The FITS standard reserves ZSOURCE for a float: readers of the coordinates refuse any text there.
    no_source = (-1.0, "none: the map is for D_LS/D_S = 1")
    base = {"ZLENS": float(plane.z_l), "ZSOURCE": no_source, "DLSDS": 1.0}
    maps = {
        "kappa": (kappa, ""),
        "gamma_1": (gamma_1, ""),
        "gamma_2": (gamma_2, ""),
        "alpha_1": (alpha[..., 0], "arcsec"),
        "alpha_2": (alpha[..., 1], "arcsec"),
        "psi": (jax.jit(_lens.psi)(lens, theta), "arcsec2"),
    }
    out = {name: (np.asarray(values), {**base, "BUNIT": unit}) for name, (values, unit) in maps.items()}
    for z in MAP_REDSHIFTS:
        ratio = float(plane.dls_ds(z))
        if ratio > 0.0:
            with np.errstate(all="ignore"):  # or a pixel on a critical curve
                mu = 1.0 / ((1.0 - ratio * kappa) ** 2 - ratio**2 * (gamma_1**2 + gamma_2**2))
            out[f"mu_z{z:g}"] = (mu, {**base, "ZSOURCE": z, "DLSDS": ratio, "BUNIT": ""})
    return out


def typical_source(outcome: Outcome) -> tuple[float, float]:
    """Redshift and D_LS/D_S for which curves are drawn: those of the median system."""
    ratios = np.asarray(outcome.fit.dls_ds)
    index = int(np.argsort(ratios)[len(ratios) // 2])
    return float(redshifts(outcome)[index]), float(ratios[index])


def figures(
    outcome: Outcome, grid: Grid, kappa: np.ndarray, found: critical.Curves, z: float
) -> dict[str, Any]:
    """The figures (`matplotlib.figure.Figure`) of a fit by file stem.

    `kappa` and the curves `found` are for sources at redshift `z`.
    """
    images, fit, main = outcome.images, outcome.fit, outcome.main
    name = outcome.setup.name
    source = np.asarray(images.source)
    systems = np.array(images.systems)[source]
    names = list(outcome.values)
    # Numbers of many free redshifts would leave no room; the covariance figure falls back by itself.
    return {
        "kappa": plotting.kappa_map(
            kappa,
            grid,
            tangential=found.tangential,
            radial=found.radial,
            caustics=found.caustics,
            theta=np.asarray(images.theta),
            systems=systems,
            image_ids=images.image_ids,
            z_s=z,
            kappa_label=rf"$\kappa$ ($z_s$ = {z:.2f})",
            kpc_per_arcsec=float(outcome.setup.plane.kpc_per_arcsec),
            title=name,
        ),
        "residuals": plotting.residual_vectors(
            np.asarray(images.theta),
            main.theta,
            produced=main.produced,
            image_ids=images.image_ids,
            sigma_pos=float(np.median(np.asarray(images.sigma_pos))),
            tangential=found.tangential,
            source_definition=main.definition,
            title=name,
        ),
        "starts": plotting.starts(
            [start.chi2 for start in fit.starts],
            converged=[start.converged for start in fit.starts],
            title=name,
        ),
        "covariance": plotting.covariance(
            names,
            [outcome.values[key] for key in names],
            outcome.covariance,
            units=[unit_of(key) for key in names],
            at_bound=bound_names(outcome),
            title=name,
        ),
    }


def write(outcome: Outcome, out: str | Path) -> dict[str, Any]:
    """Write every file of the result to the directory `out`, all of them or none; returns the summary."""
    content = summary(outcome)
    grid = map_grid(outcome.images)
    plane, reference, lens = outcome.setup.plane, outcome.setup.reference, outcome.fit.lens
    z, ratio = typical_source(outcome)
    found = critical.curves(lens, grid, ratio)
    maps = standard_maps(lens, plane, grid)
    drawn = figures(outcome, grid, ratio * maps["kappa"][0], found, z)
    asked = outcome.analysis
    draws, quality = posterior.draws(
        outcome.setup.problem, outcome.fit, jax.random.key(outcome.seed), asked.n_lenses
    )
    content["draws"] = {
        "kind": "Laplace draws, of the source-plane chi2 with priors; chi2 of each is in posterior.npz",
        "n": asked.n_lenses,
        "median_chi2_rise": quality.rise,
        "expected_chi2_rise": quality.expected_rise,
        "warning": quality.warning,
    }
    drawn_maps = analysis_strong.kappa_maps(draws, asked.options.draws, grid)
    masses = posterior.mass_table(lens, draws, plane, np.asarray(outcome.images.theta))
    content["masses"] = [
        dict(zip(masses, row, strict=True))
        for row in zip(*(column.tolist() for column in masses.values()), strict=True)
    ]
    meta = {"cluster": outcome.setup.name, "source_definition": "tensor", "version": content["version"]}
    with io.staging(out) as stage:
        io.write_json(stage / "summary.json", content)
        io.write_lens(
            stage / posterior.MODEL,
            lens,
            plane,
            comment=f"{outcome.setup.name}, jaxlens {content['version']}",
            reference=reference,
            labels=outcome.setup.model.labels,
        )
        posterior.write_posterior(stage / posterior.POSTERIOR, lens, draws, quality)
        for name, columns in (
            ("images_predicted", image_table(outcome)),
            ("systems", system_table(outcome)),
            ("images_spare", spare_table(outcome)),
            ("masses", masses),
        ):
            io.write_table(stage / f"{name}.ecsv", columns, meta=meta)
        for name, (values, header) in maps.items():
            io.write_map(stage / f"{name}.fits", values, grid, header=header, reference=reference)
        for name, values in drawn_maps.items():
            header = {**maps["kappa"][1], "NDRAWS": (asked.options.draws, "Laplace draws")}
            kind = "float32" if values.ndim == 3 else "float64"
            io.write_map(stage / f"{name}.fits", values, grid, header=header, reference=reference, dtype=kind)
        if asked.shear is not None:
            comment = f"{outcome.setup.name} with an external shear, jaxlens {content['version']}"
            sheared = asked.shear.with_shear.lens
            io.write_lens(stage / "model_shear.toml", sheared, plane, comment=comment, reference=reference)
        io.write_regions(
            stage / "regions.reg",
            images=np.asarray(outcome.images.theta),
            labels=outcome.images.image_ids,
            predicted=outcome.main.theta[outcome.main.produced],
            curves={"tangential": found.tangential, "radial": found.radial, "caustics": found.caustics},
            reference=reference,
        )
        for name, figure in drawn.items():
            plotting.save(figure, stage / name)
    return content
