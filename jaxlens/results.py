"""The files of a strong-lensing fit: what is written, and under which name.

`summary.json`, `model.toml` (the lens, reads back bit for bit), `posterior.npz` (draws of it, see
`jaxlens.posterior`), `images_predicted.ecsv`, `systems.ecsv`, `images_spare.ecsv`, `masses.ecsv`, the
standard maps, `regions.reg`, and the figures. When asked for:
`kappa_draws.fits` (a cube of convergence maps of the Laplace draws) with `kappa_mean.fits` and
`kappa_std.fits`, all for D_LS/D_S = 1; `model_shear.toml` (the lens with a free external shear).
"""

from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlens import analysis_strong, critical, io, plotting, posterior
from jaxlens import lens as _lens
from jaxlens.analysis_strong import Analysis
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Lens
from jaxlens.strong import (
    DEFINITIONS,
    ImageCatalogue,
    PredictedImages,
    Prediction,
    StrongFit,
    criteria,
    edge,
    physical,
    predict,
    reported,
    rms_by_source,
    without_edges,
)
from jaxlens.workflow import Setup

PIXEL = 0.5
"""Pixel of the standard maps, arcsec (our choice: a tenth of the smallest critical features of interest)."""

N_INTERVAL = 4096
"""Draws of the numbers for their intervals: the ends are then good to 2 % of the error."""

MARGIN = 25.0
"""The maps reach this far beyond the outermost image, arcsec."""

MAP_REDSHIFTS = (1.0, 2.0, 4.0, 9.0)
"""Source redshifts of the magnification maps; those behind the lens are written."""

UNITS = {"_arcsec": "arcsec", "_km_s": "km/s", "_msun": "Msun", "_msun_h": "Msun/h", "_deg": "deg"}


@dataclass(frozen=True)
class Outcome:
    """A fit with everything derived from it.

    Attributes:
        setup: the problem.
        fit: the best start.
        predicted: predicted images by source definition.
        values: reported numbers by name.
        errors: their standard errors (Laplace, numbers at their bound held there); NaN for those. To first
            order: they may reach beyond the box.
        intervals: 16th and 84th percentile of Laplace draws, which stay inside the box; NaN at a bound.
        covariance: of the reported numbers, in the order of `values`, `(n, n)`.
        seed: of the starts.
        plane: where the chi^2 was formed.
        definition: source position of the image-plane stage, if there was one.
        analysis: what was asked beyond the fit.
    """

    setup: Setup
    fit: StrongFit
    predicted: dict[str, PredictedImages]
    values: dict[str, float]
    errors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    covariance: np.ndarray
    seed: int
    plane: str
    definition: str
    analysis: Analysis = field(default_factory=Analysis)

    @property
    def images(self) -> ImageCatalogue:
        """The observed images."""
        return self.setup.problem.images

    @property
    def main(self) -> PredictedImages:
        """The predicted images of the definition `tensor`."""
        return self.predicted["tensor"]


def derive(
    setup: Setup,
    fit: StrongFit,
    *,
    seed: int = 0,
    plane: str = "source",
    definition: str = "tensor",
    analysis: Analysis | None = None,
) -> Outcome:
    """Predicted images, reported numbers and errors of a fit."""
    predicted = predict(Prediction(fit.lens, fit.dls_ds), setup.problem.images, definitions=DEFINITIONS)

    def numbers(u: Any) -> dict[str, Any]:
        return reported(setup.model, physical(setup.problem.bounds, u))

    values = jax.jit(numbers)(fit.u)
    slopes = jax.jit(jax.jacfwd(numbers))(fit.u)
    many = posterior.draw_numbers(setup.problem, fit, jax.random.key(seed), N_INTERVAL)
    intervals = {
        name: interval(float(values[name]), np.asarray(column), periodic=name.endswith(".pa_deg"))
        for name, column in jax.jit(jax.vmap(numbers))(many).items()
    }
    rows = np.stack([np.asarray(slopes[name]) for name in values])
    held = without_edges(fit.covariance, edge(setup.problem.bounds, fit.u))
    covariance = rows @ np.asarray(held) @ rows.T
    variance = np.diag(covariance)
    spread = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    return Outcome(
        setup=setup,
        fit=fit,
        predicted=predicted,
        values={name: float(value) for name, value in values.items()},
        errors=dict(zip(values, spread.tolist(), strict=True)),
        intervals=intervals,
        covariance=covariance,
        seed=seed,
        plane=plane,
        definition=definition,
        analysis=analysis or Analysis(),
    )


def interval(value: float, draws: np.ndarray, *, periodic: bool = False) -> tuple[float, float]:
    """16th and 84th percentile of draws `(n,)`; NaN where they do not move, as for a number at its bound.

    Position angles (`periodic`, in degrees) are counted from `value`, so that the seam at 90 degrees is none.
    """
    if periodic:
        draws = value + (draws - value + 90.0) % 180.0 - 90.0
    low, high = np.percentile(draws, [15.865, 84.135]).tolist()
    return (low, high) if high > low else (np.nan, np.nan)


def unit_of(name: str) -> str:
    """The unit that the name of a number ends in; empty for dimensionless ones."""
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def bound_names(outcome: Outcome) -> set[str]:
    """Reported names of the numbers at their bound: a shape stands for its elongation and angle."""
    names = set()
    for key in outcome.fit.at_bound:
        owner, _, number = key.partition(".")
        if number == "shape":
            names |= {
                name
                for name in outcome.values
                if name.startswith(f"{owner}.") and name.endswith((".e", ".ellipticity", ".gamma"))
            }
        elif owner == "dls_ds":
            names.add(f"z.{number}")
        elif number != "pa":
            names.add(key)
    return names


def summary(outcome: Outcome) -> dict[str, Any]:
    """The content of `summary.json`."""
    images, fit, main = outcome.images, outcome.fit, outcome.main
    n_images, n_systems, n_free = images.n_images, images.n_systems, len(fit.u)
    chi2_image = main.chi2(images)
    dof_paper, dof = 2 * n_images - n_free, 2 * n_images - n_free - 2 * n_systems
    at_bound = bound_names(outcome)
    complete = main.n_produced == n_images
    return {
        "name": outcome.setup.name,
        "chi2_source": float(fit.chi2),
        "chi2_image": chi2_image,
        "chi2_prior": float(fit.chi2_prior),
        "rms_arcsec": main.rms(images),
        "rms_definition": main.definition,
        "rms_by_source": rms_by_source(outcome.predicted, images),
        "n_images": n_images,
        "n_produced": main.n_produced,
        "n_produced_by_source": {name: one.n_produced for name, one in outcome.predicted.items()},
        "not_produced": [name for name, hit in zip(images.image_ids, main.produced, strict=True) if not hit],
        "n_spare": len(main.spare),
        "image_search_complete": main.complete,
        "n_systems": n_systems,
        "n_free": n_free,
        # Images that are not produced have no chi^2: a ratio to the degrees of freedom of all would flatter.
        "chi2_nu_paper": chi2_image / dof_paper if dof_paper > 0 and complete else None,
        "chi2_nu": chi2_image / dof if dof > 0 and complete else None,
        "chi2_image_by_source": {name: one.chi2(images) for name, one in outcome.predicted.items()},
        "errors": "Laplace, of the source-plane chi2 with priors; numbers at their bound are held there. "
        "`error` is linear and may reach beyond the box; `lo` and `hi` are the 16th and 84th percentile of "
        "Laplace draws, inside it",
        **_criteria(outcome),
        **analysis_strong.summary(outcome.setup, fit, outcome.analysis),
        "converged": fit.converged,
        "image_plane_converged": fit.polished,
        "image_plane_failed": fit.image_plane_failed,
        "notes": list(outcome.setup.notes),
        "agreeing_starts": fit.agreeing,
        "interrupted": fit.interrupted,
        "at_bound": sorted(at_bound),
        "weak_prior": float(outcome.setup.problem.weak_prior),
        "plane": outcome.plane,
        "image_plane_definition": outcome.definition if outcome.plane != "source" else None,
        "parameters": {
            name: {
                "value": value,
                "error": outcome.errors[name],
                "lo": outcome.intervals[name][0],
                "hi": outcome.intervals[name][1],
                "unit": unit_of(name),
                "at_bound": name in at_bound,
            }
            for name, value in outcome.values.items()
        },
        "starts": [start._asdict() for start in fit.starts],
        "seconds": fit.seconds,
        "seed": outcome.seed,
        "version": metadata.version("jaxlens-cluster"),
    }


def _criteria(outcome: Outcome) -> dict[str, Any]:
    said = criteria(outcome.fit, outcome.setup.problem)
    return {"bic": said.bic, "aic": said.aic, "n_fitted": said.n_fitted}


def image_table(outcome: Outcome) -> dict[str, np.ndarray]:
    """Columns of `images_predicted.ecsv`: observed, predicted, offset, mu, chi^2 of every image."""
    images, main = outcome.images, outcome.main
    observed = np.asarray(images.theta)
    offset = np.where(main.produced[:, None], main.theta - observed, np.nan)
    chi2 = np.sum(offset**2, axis=1) / np.asarray(images.sigma_pos) ** 2
    source = np.asarray(images.source)
    z = _redshifts(outcome)
    return {
        "system": np.array(images.systems)[source],
        "image_id": np.array(images.image_ids),
        "z_s": z[source],
        "x_arcsec": observed[:, 0],
        "y_arcsec": observed[:, 1],
        "x_predicted_arcsec": np.where(main.produced, main.theta[:, 0], np.nan),
        "y_predicted_arcsec": np.where(main.produced, main.theta[:, 1], np.nan),
        "dx_arcsec": offset[:, 0],
        "dy_arcsec": offset[:, 1],
        "offset_arcsec": np.hypot(*offset.T),
        "mu": main.mu,
        "chi2": chi2,
        "produced": main.produced,
        **analysis_strong.image_columns(outcome.fit, outcome.analysis),
    }


def _redshifts(outcome: Outcome) -> np.ndarray:
    z = np.array(outcome.images.z_s)
    for index, system in enumerate(outcome.images.systems):
        z[index] = outcome.values.get(f"z.{system}", z[index])
    return z


def system_table(outcome: Outcome) -> dict[str, np.ndarray]:
    """Columns of `systems.ecsv`: source position, counts, chi^2 and rms of every system."""
    images, main = outcome.images, outcome.main
    source = np.asarray(images.source)
    columns = image_table(outcome)
    count = np.bincount(source, minlength=images.n_systems)
    produced = np.bincount(source, main.produced, images.n_systems)
    some = produced > 0
    chi2 = np.bincount(source, np.nan_to_num(columns["chi2"]), images.n_systems)
    squares = np.bincount(source, np.nan_to_num(columns["offset_arcsec"]) ** 2, images.n_systems)
    spare = np.bincount(main.spare[:, 0].astype(int), minlength=images.n_systems)
    return {
        "system": np.array(images.systems),
        "z_s": _redshifts(outcome),
        "dls_ds": np.asarray(outcome.fit.dls_ds),
        "beta_x_arcsec": main.beta[:, 0],
        "beta_y_arcsec": main.beta[:, 1],
        "n_images": count,
        "n_produced": produced.astype(int),
        "n_spare": spare,
        "chi2": np.where(some, chi2, np.nan),
        "rms_arcsec": np.where(some, np.sqrt(squares / np.maximum(produced, 1)), np.nan),
        **analysis_strong.system_columns(outcome.fit, outcome.analysis),
    }


def spare_table(outcome: Outcome) -> dict[str, np.ndarray]:
    """Columns of `images_spare.ecsv`: predicted images that no observed image belongs to."""
    spare = outcome.main.spare
    return {
        "system": np.array(outcome.images.systems)[spare[:, 0].astype(int)],
        "x_arcsec": spare[:, 1],
        "y_arcsec": spare[:, 2],
        "mu": spare[:, 3],
    }


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
    alpha, hessian = jax.jit(_lens.alpha_and_hessian)(lens, theta)
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
            mu = 1.0 / ((1.0 - ratio * kappa) ** 2 - ratio**2 * (gamma_1**2 + gamma_2**2))
            out[f"mu_z{z:g}"] = (np.asarray(mu), {**base, "ZSOURCE": z, "DLSDS": ratio, "BUNIT": ""})
    return out


def typical_source(outcome: Outcome) -> tuple[float, float]:
    """Redshift and D_LS/D_S for which curves are drawn: those of the median system."""
    ratios = np.asarray(outcome.fit.dls_ds)
    index = int(np.argsort(ratios)[len(ratios) // 2])
    return float(_redshifts(outcome)[index]), float(ratios[index])


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


def verdict(content: dict[str, Any]) -> str:
    """What the summary says, in a few lines."""
    rms = ", ".join(
        f"{name} {value:.3f}" for name, value in content["rms_by_source"].items() if value is not None
    )
    n_starts = len(content["starts"])  # one start agrees with itself, which says nothing
    lines = [
        f"chi2 = {content['chi2_source']:.2f} (source plane), {content['chi2_image']:.2f} (image plane, "
        f"{content['n_produced']} of {content['n_images']} images)",
        f"image-plane rms in arcsec by source definition: {rms}",
        f"{content['n_produced']} of {content['n_images']} images produced, one to one",
        *([f"{content['agreeing_starts']} of {n_starts} starts agree"] if n_starts > 1 else []),
        *analysis_strong.verdict(content),
        *(f"note: {note}" for note in content["notes"]),
    ]
    if warning := content.get("draws", {}).get("warning"):
        lines.append(f"warning: {warning}")
    if content["interrupted"]:
        lines.append("interrupted: the best of the starts that had ended")
    if content["not_produced"]:
        lines.append(f"not produced: {', '.join(content['not_produced'])}")
    if content["at_bound"]:
        lines.append(f"at their bound: {', '.join(content['at_bound'])}")
    if not content["converged"]:
        lines.append("the fit has not converged; give more starts or tighter boxes")
    if content["image_plane_failed"]:
        lines.append(
            "the image-plane stage failed (chi2 not finite): the numbers are those of the source plane"
        )
    elif content["image_plane_converged"] is False:
        lines.append("the image-plane stage has not converged: its chi2 was still falling")
    return "\n".join(lines)
