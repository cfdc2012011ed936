"""The files of a weak-lensing reconstruction: what is written, and under which name.

`kappa_E.fits`, `kappa_B.fits`, `snr.fits`, `shear.fits` (a shear map that `jaxlens weak` reads again),
`summary.json` and figures; with an AKRA scheme `kappa_B_beyond_E.fits`; from a catalogue also `profile.ecsv`
and `aperture_mass.fits`, and, where galaxies have photometric redshifts of their own, `kappa_z_error.fits`.
"""

from importlib import metadata
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlens import io, plotting, weak
from jaxlens._verdict_weak import verdict as verdict
from jaxlens.analysis_weak import Outcome, Profile
from jaxlens.redshift_weak import RedshiftSpread

COVERAGE = 0.7
"""Least share of an aperture with data; our choice."""


def summary(outcome: Outcome) -> dict[str, Any]:
    """The content of `summary.json`; what is not known, or has no sense for the input, is null."""
    field, options, made = outcome.field, outcome.options, outcome.made
    top = outcome.peak
    ra = dec = None
    if field.reference is not None:
        ra, dec = (float(part[0]) for part in io.sky(np.asarray(top.theta)[None], field.reference))
    error = outcome.peak_error
    best = weak.peak(jnp.asarray(outcome.snr), field.grid, jnp.asarray(outcome.used))
    profile = outcome.profile
    return {
        "name": field.name,
        "scheme": options.scheme,
        "iterations": options.iterations,
        "converged": bool(made.converged),
        "spectral_radius": float(made.spectral_radius),
        "last_change": float(made.change[-1]),
        "ridge": options.ridge,
        "padding": options.padding,
        "smoothing_arcsec": field.smoothing,
        "pixel_arcsec": field.grid.pixel,
        "shape": list(field.grid.shape),
        "n_unmasked": int(outcome.used.sum()),
        "n_galaxies": field.counts,
        "dls_ds": field.header.get("DLSDS"),
        "peak": {
            "x_arcsec": float(top.theta[0]),
            "y_arcsec": float(top.theta[1]),
            "x_error_arcsec": None if error is None else float(error[0]),
            "y_error_arcsec": None if error is None else float(error[1]),
            "ra_deg": ra,
            "dec_deg": dec,
            "kappa": float(top.value),
            "kappa_error": float(outcome.sigma[tuple(top.pixel)]),
        },
        "peak_snr": {
            "value": float(best.value),
            "x_arcsec": float(best.theta[0]),
            "y_arcsec": float(best.theta[1]),
        },
        "e_mode": outcome.e._asdict(),
        "b_mode": outcome.b._asdict(),
        "b_mode_beyond_e": None if outcome.b_beyond_e is None else outcome.b_beyond_e._asdict(),
        "null_maps": 2 * options.draws,
        "shear_axis": field.axis,
        "from_catalogue": field.setup is not None,
        "tangential_snr": None if profile is None else float(profile.significance.tangential),
        "cross_snr": None if profile is None else float(profile.significance.cross),
        "nfw": None if profile is None else _nfw(outcome, profile),
        "photometric_redshifts": None
        if outcome.redshifts is None
        else _redshifts(outcome, outcome.redshifts),
        "seconds": outcome.seconds,
        "seed": options.seed,
        "version": metadata.version("jaxlens-cluster"),
    }


def _nfw(outcome: Outcome, profile: Profile) -> dict[str, Any]:
    fit = profile.fit
    values = {
        "mass_msun": fit.mass,
        "concentration": fit.concentration,
        "calibration": fit.calibration,
    }
    setup = outcome.field.setup
    assert setup is not None  # a profile comes from a catalogue
    said = setup.config.profile
    return {
        **{
            name: {"value": float(value), "error": float(error)}
            for (name, value), error in zip(values.items(), fit.errors, strict=True)
        },
        "calibration_prior": {"value": said.calibration, "error": said.calibration_sigma},
        "overdensity": said.overdensity,
        "chi2": float(fit.chi2),
        "n_dof": int(fit.n_dof),
        "converged": bool(fit.converged),
    }


def _redshifts(outcome: Outcome, found: RedshiftSpread) -> dict[str, Any]:
    return {
        "draws": found.draws,
        "dls_ds_error": found.dls_ds,
        "kappa_error_at_peak": float(found.kappa[tuple(outcome.peak.pixel)]),
        "log10_mass_error": found.log10_mass,
    }


def profile_table(profile: Profile) -> dict[str, np.ndarray]:
    """Columns of `profile.ecsv`."""
    found, errors, (model, model_error) = profile.profile, profile.errors, profile.model
    columns = {
        "r_low_arcsec": found.edges[:-1],
        "r_high_arcsec": found.edges[1:],
        "r_arcsec": found.r,
        "count": found.count,
        "g_t": found.g_t,
        "g_t_error": found.sigma_t,
        "g_t_bootstrap": errors.sigma_t,
        "g_x": found.g_x,
        "g_x_error": found.sigma_x,
        "g_x_bootstrap": errors.sigma_x,
        "nfw": model,
        "nfw_error": model_error,
    }
    return {name: np.asarray(values) for name, values in columns.items()}


_DESCRIPTIONS = {
    "r_arcsec": "weighted mean radius",
    "g_t": "tangential shear",
    "g_x": "cross shear",
    "g_t_error": "by the scatter of the shapes",
    "g_x_error": "by the scatter of the shapes",
    "g_t_bootstrap": "by bootstrap samples of the galaxies",
    "g_x_bootstrap": "by bootstrap samples of the galaxies",
    "nfw": "tangential shear of the fitted halo",
    "nfw_error": "its error, propagated linearly",
}


def figures(outcome: Outcome) -> dict[str, Any]:
    """The figures (`matplotlib.figure.Figure`) by file stem."""
    field, made = outcome.field, outcome.made
    kpc, weight = field.kpc_per_arcsec, np.asarray(field.shear.weight)
    drawn: dict[str, Any] = {
        "maps": plotting.shear_maps(
            made.kappa,
            made.kappa_b,
            field.grid,
            kappa_b_rest=outcome.kappa_b_rest,
            snr=outcome.snr,
            weight=weight,
            peak=outcome.peak.theta,
            snr_label=r"S/N of $\kappa_{\rm E}$",
            kpc_per_arcsec=kpc,
            title=field.name,
        ),
        "sticks": plotting.shear_sticks(
            weak.smooth(field.shear.g, field.grid, field.smoothing, field.shear.weight),
            weight,
            field.grid,
            kappa=np.where(outcome.used, np.asarray(made.kappa), np.nan),
            kappa_label=r"$\kappa_{\rm E}$",
            step=max(1, round(max(field.grid.shape) / 32)),
            smoothing=field.smoothing,
            centre=outcome.peak.theta,
            kpc_per_arcsec=kpc,
            title=field.name,
        ),
        "iteration": plotting.iteration_history(
            made.change, spectral_radius=made.spectral_radius, title=field.name
        ),
    }
    profile = outcome.profile
    if profile is not None:
        found = profile.profile
        r, shear, error = profile.curve
        drawn["profile"] = plotting.tangential_profile(
            found.r,
            found.g_t,
            found.g_x,
            found.sigma_t,
            found.sigma_x,
            edges=found.edges,
            model_r=r,
            model=shear,
            model_band=(shear - error, shear + error),
            model_label=_model_label(profile.fit),
            kpc_per_arcsec=kpc,
            title=field.name,
        )
    return drawn


def _model_label(fit: weak.HaloFit) -> str:
    factor = float(fit.calibration)
    return "NFW" if factor == 1.0 else f"NFW, times the shape calibration {factor:.2f}"


def write(outcome: Outcome, out: str | Path) -> dict[str, Any]:
    """Write every file of the result to the directory `out`, all of them or none; returns the summary."""
    content = summary(outcome)
    field, options, made = outcome.field, outcome.options, outcome.made
    header = {
        **field.header,
        "SMOOTHAS": (field.smoothing, "[arcsec] standard deviation of the Gaussian"),
        "SHEET": ("free", "mass sheet; mean of the padded map is 0"),
        "CALIBR": ("none", "no shape calibration applied"),
        **_axis(field.axis),
        "SCHEME": options.scheme,
        "RIDGE": options.ridge,
        "PADDING": options.padding,
        "BUNIT": "",
    }
    on = {"grid": field.grid, "reference": field.reference}
    maps = {"kappa_E": made.kappa, "kappa_B": made.kappa_b, "snr": outcome.snr}
    if outcome.kappa_b_rest is not None:
        maps["kappa_B_beyond_E"] = outcome.kappa_b_rest
    if outcome.redshifts is not None:
        maps["kappa_z_error"] = outcome.redshifts.kappa
    drawn = figures(outcome)
    with io.staging(out) as stage:
        io.write_json(stage / "summary.json", content)
        for name, values in maps.items():
            io.write_map(stage / f"{name}.fits", values, header=header, **on)
        shear = field.shear
        by = (field.smoothing, "[arcsec] for kappa; not smoothed here")
        base = {**field.header, "SMOOTHBY": by, **_axis("west")}
        io.write_shear_map(stage / "shear.fits", shear.g, shear.weight, shear.n_gal, header=base, **on)
        if (profile := outcome.profile) is not None:
            io.write_table(
                stage / "profile.ecsv",
                profile_table(profile),
                meta={"field": field.name, "nfw": content["nfw"], "version": content["version"]},
                descriptions=_DESCRIPTIONS,
            )
            about = {
                "RADIUS": (profile.radius, "[arcsec] of the apertures"),
                "FILTER": "schneider",
                "MINCOVER": (COVERAGE, "least COVERAGE; else NaN"),
            }
            layers = aperture_layers(profile, outcome.used)
            io.write_cube(stage / "aperture_mass.fits", layers, header={**field.header, **about}, **on)
        for name, figure in drawn.items():
            plotting.save(figure, stage / name)
    return content


def _axis(axis: str) -> dict[str, Any]:
    return {"SHEARAX": (axis, "input shear: direction of g1 > 0")}


def aperture_layers(profile: Profile, used: np.ndarray) -> dict[str, np.ndarray]:
    """Layers of `aperture_mass.fits`: NaN in masked pixels and where less than `COVERAGE` has data.

    Args:
        profile: with the aperture mass.
        used: unmasked pixels, `(y, x)`.
    """
    found, cover = profile.aperture, np.asarray(profile.coverage)
    good = used & (cover >= COVERAGE)
    values = {"SIGNAL": found.signal, "CROSS": found.cross, "NOISE": found.noise, "SNR": found.snr}
    layers = {name: np.where(good, np.asarray(part), np.nan) for name, part in values.items()}
    return {**layers, "COUNT": np.asarray(found.count), "COVERAGE": cover}
