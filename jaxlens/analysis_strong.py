"""What can be asked about a strong-lensing fit beyond the fit: errors, draws, left-out systems, a shear."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from jaxlens import config, posterior
from jaxlens.grid import Grid
from jaxlens.lens import Lens
from jaxlens.strong import (
    LeaveOneOut,
    ShearCheck,
    StrongFit,
    degrees_of_freedom,
    free_sigma,
    leave_one_out,
    rescale,
    shear_check,
    with_shear,
)
from jaxlens.workflow import Setup

SIGMA_POS = ("fixed", "rescaled", "free")
"""What can be done about the position errors of the images."""


@dataclass(frozen=True)
class Options:
    """What is asked.

    Attributes:
        sigma_pos: one of `SIGMA_POS`.
        draws: number of convergence maps drawn from the posterior; 0 for none.
        leave_one_out: fit again without each system.
        outlier: normalised offset above which an image or a system is flagged.
        shear: fit again with a free external shear.
    """

    sigma_pos: str = "fixed"
    draws: int = 0
    leave_one_out: bool = False
    outlier: float = 3.0
    shear: bool = False


@dataclass(frozen=True)
class Analysis:
    """What was asked, and the answers.

    Attributes:
        options: the questions.
        left_out: every system predicted without itself, or None.
        shear: the check with an external shear, or None.
    """

    options: Options = Options()
    left_out: LeaveOneOut | None = None
    shear: ShearCheck | None = None

    @property
    def n_lenses(self) -> int:
        """Number of lenses drawn: those that are always stored, or as many as there are maps."""
        return max(posterior.N_DRAWS, self.options.draws)


def options_of(setup: Setup, **said: Any) -> Options:
    """The options of a configuration; those of `said` that are not None win."""
    table = setup.config.errors if setup.config else config.Errors()
    read = Options(table.sigma_pos, table.draws, table.leave_one_out, table.outlier)
    return replace(read, **{name: value for name, value in said.items() if value is not None})


def prepare(setup: Setup, options: Options) -> Setup:
    """The problem as the options want it fitted.

    Raises:
        ValueError: if what is asked cannot be answered for this problem; the message says why.
    """
    if options.sigma_pos not in SIGMA_POS:
        raise ValueError(f"`sigma_pos` is {options.sigma_pos!r}; choose one of {', '.join(SIGMA_POS)}.")
    if options.shear:
        with_shear(setup.problem)  # refuses a second one before the fit
    if options.leave_one_out and setup.problem.images.n_systems < 2:
        raise ValueError("There is one system of images: none can be left out; drop leave_one_out.")
    if options.sigma_pos == "rescaled" and (nu := degrees_of_freedom(setup.problem)) <= 0:
        raise ValueError(
            f"The fit has {nu} degrees of freedom: position errors cannot be rescaled to chi2_nu = 1. "
            "Keep them fixed, or free fewer numbers."
        )
    if options.sigma_pos == "free":
        return replace(setup, problem=free_sigma(setup.problem))
    return setup


def answer(
    setup: Setup, fit: StrongFit, options: Options, *, on_step: Callable[[str], None] = lambda step: None
) -> tuple[StrongFit, Analysis]:
    """The fit with the errors that were asked for, and the other answers.

    Args:
        setup: the problem, as `prepare` returned it.
        fit: its fit.
        options: what is asked.
        on_step: called with what is being done.
    """
    if options.sigma_pos == "rescaled":
        fit = rescale(fit, setup.problem)
    left_out = shear = None
    if options.leave_one_out and not fit.interrupted:
        systems = setup.problem.images.systems
        say = lambda index: on_step(f"fitting without system {systems[index]}")
        left_out = leave_one_out(fit.u, setup.problem, on_system=say)
    if options.shear and not fit.interrupted:
        on_step("fitting with an external shear")
        shear = shear_check(fit.u, setup.problem)
    return fit, Analysis(options, left_out, shear)


def kappa_maps(draws: Lens, n: int, grid: Grid) -> dict[str, np.ndarray]:
    """Convergence of the first `n` draws, their mean and standard deviation, by file stem; none for n = 0."""
    if n == 0:
        return {}
    many = np.asarray(posterior.kappa_draws(jax.tree.map(lambda leaf: leaf[:n], draws), grid.theta))
    maps = {"kappa_draws": many, "kappa_mean": many.mean(axis=0)}
    return {**maps, "kappa_std": many.std(axis=0, ddof=1)} if n > 1 else maps


def summary(setup: Setup, fit: StrongFit, found: Analysis) -> dict[str, Any]:
    """What `summary.json` says about all this."""
    nu = degrees_of_freedom(setup.problem)
    raw = float(fit.chi2) / nu if nu > 0 else None
    factor = float(fit.sigma_scale)
    content: dict[str, Any] = {
        "sigma_pos": {
            "mode": found.options.sigma_pos,
            "scale": factor,
            "chi2_nu_source": raw,
            "chi2_nu_source_scaled": None if raw is None else raw / factor**2,
            "degrees_of_freedom": nu,
        }
    }
    if found.left_out is not None:
        content["leave_one_out"] = _left_out(setup, fit, found.left_out, found.options.outlier)
    if found.shear is not None:
        one = found.shear
        content["external_shear"] = {
            "gamma": one.gamma,
            "gamma_error": one.gamma_error,
            "pa_deg": one.pa_deg,
            "pa_deg_error": one.pa_deg_error,
            "chi2_source": float(one.with_shear.chi2),
            "delta_chi2": one.delta_chi2,
            "delta_chi2_prior": one.delta_prior,
            "delta_bic": one.delta_bic,
            "delta_aic": one.delta_aic,
            "converged": one.with_shear.converged,
        }
    return content


def _left_out(setup: Setup, fit: StrongFit, one: LeaveOneOut, limit: float) -> dict[str, Any]:
    images, scaled = setup.problem.images, limit * float(fit.sigma_scale)
    pick = lambda names, flags: [name for name, flag in zip(names, flags, strict=True) if flag]
    return {
        "rms_arcsec": one.rms,
        "rms_source_arcsec": one.rms_source,
        "n_found": one.n_found,
        "n_converged": int(one.converged.sum()),
        "definition": "source: tensor, of the left-out images; images reached from the observed positions",
        "outlier_rule": f"offset > {limit:g} position errors; systems: sqrt(chi2/(2 n - 2)) > {limit:g}",
        "outlying_images": pick(images.image_ids, one.outlying_images(scaled)),
        "outlying_systems": pick(images.systems, one.outlying_systems(scaled)),
    }


def image_columns(fit: StrongFit, found: Analysis) -> dict[str, np.ndarray]:
    """Further columns of the table of images."""
    one = found.left_out
    if one is None:
        return {}
    factor = float(fit.sigma_scale)
    return {
        "offset_left_out_arcsec": one.offset,
        "offset_source_left_out_arcsec": one.offset_source,
        "offset_left_out_in_errors": one.normalised / factor,
        "outlier": one.outlying_images(found.options.outlier * factor),
    }


def system_columns(fit: StrongFit, found: Analysis) -> dict[str, np.ndarray]:
    """Further columns of the table of systems."""
    one = found.left_out
    if one is None:
        return {}
    factor = float(fit.sigma_scale)
    source = np.asarray(one.images.source)
    count = np.bincount(source, np.isfinite(one.offset))
    squares = np.bincount(source, np.nan_to_num(one.offset) ** 2)
    rms = np.sqrt(np.divide(squares, count, out=np.full(len(count), np.nan), where=count > 0))
    return {
        "rms_left_out_arcsec": rms,
        "score_left_out": one.system_scores() / factor,
        "outlier": one.outlying_systems(found.options.outlier * factor),
    }


def verdict(content: dict[str, Any]) -> list[str]:
    """What the summary says about all this, line by line."""
    lines = [f"BIC = {content['bic']:.2f}, AIC = {content['aic']:.2f} ({content['n_fitted']} fitted numbers)"]
    said = content["sigma_pos"]
    if said["mode"] != "fixed":
        lines.append(
            f"position errors {said['mode']}: times {said['scale']:.3f} "
            f"(chi2_nu {said['chi2_nu_source']:.3f} before, {said['chi2_nu_source_scaled']:.3f} after)"
            if said["chi2_nu_source"] is not None
            else f"position errors {said['mode']}: times {said['scale']:.3f}"
        )
    if one := content.get("leave_one_out"):
        lines.append(
            f"leaving one system out: rms {one['rms_arcsec']:.3f} arcsec in the image plane "
            f"({one['n_found']} of {content['n_images']} images reached), "
            f"{one['rms_source_arcsec']:.3f} arcsec in the source plane"
        )
        for what in ("images", "systems"):
            if flagged := one[f"outlying_{what}"]:
                lines.append(f"outlying {what} ({one['outlier_rule']}): {', '.join(flagged)}")
    if one := content.get("external_shear"):
        better = "worth its two numbers" if one["delta_bic"] < 0.0 else "not worth its two numbers"
        lines.append(
            f"with a free external shear: gamma = {one['gamma']:.4f} ± {one['gamma_error']:.4f}, chi2 "
            f"{one['delta_chi2']:+.2f}, BIC {one['delta_bic']:+.2f}: {better}"
        )
    return lines
