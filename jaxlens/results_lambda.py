"""The files of a comparison of both probes: what is written, and under which name.

`lambda_rec.fits`, `kappa_wl_corrected.fits`, `kappa_sl_matched.fits`, with a noise map `kappa_combined.fits`;
`profiles.ecsv`, `summary.json` and figures.
"""

from importlib import metadata
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlens import io, mass_sheet, plotting, radial, transition
from jaxlens._types import Array
from jaxlens.analysis_lambda import Outcome


def _spread(found: mass_sheet.Distribution, error: mass_sheet.Distribution) -> dict[str, Any]:
    values = {
        name: {"value": float(getattr(found, name)), "error": float(getattr(error, name))}
        for name in ("peak", "biweight", "median", "half_width")
    }
    return {**values, "asymmetry": float(found.asymmetry), "pixels": int(found.count)}


def _crossings(outcome: Outcome, first: Array, second: Array) -> list[dict[str, Any]]:
    made = transition.crossings(outcome.rings.r, first, second)
    return [
        {"r_kpc_h": float(r), "to": "weak lensing" if d > 0 else "strong lensing"}
        for r, d in zip(np.asarray(made.radius), np.asarray(made.direction), strict=True)
        if d != 0
    ]


def summary(outcome: Outcome) -> dict[str, Any]:
    """The content of `summary.json`; what is not known is null."""
    pair, options, excess = outcome.pair, outcome.options, outcome.excess
    ends = np.asarray(outcome.rings.edges)
    found = excess is not None and bool(excess.transition.found)
    scatter = outcome.scatter
    content: dict[str, Any] = {
        "name": pair.name,
        "z_lens": float(pair.plane.z_l),
        "dls_ds": pair.dls_ds,
        "kappa_sl_scaled_by": pair.scale_sl,
        "smoothing_arcsec": pair.smoothing,
        "h": options.h,
        "omega_m": options.omega_m,
        "centre_arcsec": [options.x, options.y],
        "edges_kpc_h": ends,
        "n_pixels": int((pair.weight > 0.0).sum()),
        "lambda": {
            f"{options.inner[0]:g}-{options.inner[1]:g}": _spread(outcome.inner, outcome.inner_error),
            f"{options.inner[1]:g}-{ends[-1]:g}": _spread(outcome.outer, outcome.outer_error),
            f"{options.inner[0]:g}-{ends[-1]:g}": _spread(outcome.everything, outcome.everything_error),
        },
        "lambda_correction": float(outcome.inner.median),
        "transition": None,
        "scatter_minimum": {
            "found": bool(scatter.found),
            "r_kpc_h": float(scatter.radius) if scatter.found else None,
            "range_kpc_h": [float(scatter.lo), float(scatter.hi)] if scatter.found else None,
        },
        "external": None,
        "truth": None,
    }
    if excess is not None:
        sampled = float(excess.share) > 0.0
        content["transition"] = {
            "found": found,
            "r_kpc_h": float(excess.transition.radius) if found else None,
            "is_inside": bool(excess.transition.inside),
            "range_kpc_h": [float(excess.lo), float(excess.hi)] if sampled else None,
            "share_of_samples": float(excess.share),
            "share_of_samples_inside": float(excess.share_inside),
        }
    if outcome.external is not None:
        names = {1: "weak lensing", 0: "undecided", -1: "strong lensing"}
        content["external"] = {
            "lambda": options.lam,
            "error": options.lam_error,
            "better": [names[int(one)] for one in np.asarray(outcome.external.better)],
        }
    if outcome.shape is not None and outcome.errors is not None:
        shape, errors = outcome.shape, outcome.errors
        content["truth"] = {
            "lambda_wl": float(shape.lam_wl),
            "lambda_sl": float(shape.lam_sl),
            "crossings_rmse": _crossings(outcome, errors.sl, errors.wl),
            "crossings_shape": _crossings(outcome, shape.sl, shape.wl),
        }
    return {**content, "seed": options.seed, "version": metadata.version("jaxlens-cluster")}


def _profile(outcome: Outcome, values: Any) -> radial.RadialProfile:
    return radial.profile_in(jnp.asarray(values), outcome.rings)


def table(outcome: Outcome) -> dict[str, np.ndarray]:
    """Columns of `profiles.ecsv`."""
    pair, rings = outcome.pair, outcome.rings
    ends = np.asarray(rings.edges)
    lam = radial.profile_in(outcome.lam.lam, rings, outcome.lam.weight)
    columns: dict[str, Any] = {
        "r_low_kpc_h": ends[:-1],
        "r_high_kpc_h": ends[1:],
        "r_kpc_h": rings.r,
        "pixels": rings.count,
        "lambda_rec": lam.median,
        "lambda_rec_16": lam.lo,
        "lambda_rec_84": lam.hi,
    }
    maps = {"kappa_wl": outcome.kappa_corr, "kappa_sl": pair.kappa_sl, "kappa_true": pair.kappa_true}
    for name, values in maps.items():
        if values is not None:
            made = _profile(outcome, values)
            columns |= {name: made.median, f"{name}_16": made.lo, f"{name}_84": made.hi}
    if (excess := outcome.excess) is not None:
        columns |= {"q": excess.q, "sigma_wl": np.sqrt(excess.wl), "sigma_sl": np.sqrt(excess.sl)}
    if outcome.external is not None:
        columns |= {"p_wl_better": outcome.external.p_wl}
    if outcome.shape is not None and outcome.errors is not None:
        columns |= {"rmse_wl": outcome.errors.wl, "rmse_sl": outcome.errors.sl}
        columns |= {"shape_error_wl": outcome.shape.wl, "shape_error_sl": outcome.shape.sl}
    return {name: np.asarray(values) for name, values in columns.items()}


_DESCRIPTIONS = {
    "r_kpc_h": "middle of the annulus, in units of kpc/h",
    "lambda_rec": "(kappa_wl - 1)/(kappa_sl - 1): median; then 16 and 84 percent",
    "kappa_wl": "corrected by lambda of the inner range: median; then 16 and 84 percent",
    "q": "excess variance over that of weak lensing; above 1 weak lensing is better",
    "sigma_wl": "noise and method error of the weak-lensing map without its mass sheet",
    "sigma_sl": "error of the strong-lensing map from the excess variance, its mass sheet excluded",
    "p_wl_better": "share of samples in which weak lensing is better, with the external lambda",
    "shape_error_wl": "RMSE after the map was given its best mass sheet",
    "shape_error_sl": "RMSE after the map was given its best mass sheet",
}


def figures(outcome: Outcome) -> dict[str, Any]:
    """The figures (`matplotlib.figure.Figure`) by file stem."""
    pair, options, excess, ends = (
        outcome.pair,
        outcome.options,
        outcome.excess,
        np.asarray(outcome.rings.edges),
    )
    columns = table(outcome)
    low, high = options.inner
    label = rf"${low:g}-{high:g}\,{{\rm kpc}}\,h^{{-1}}$"
    found = excess is not None and bool(excess.transition.found)
    errors, truth = outcome.errors, None
    if errors is not None:
        errors_sl, errors_wl, name, region = errors.sl, errors.wl, "RMSE", errors.comparable
    elif excess is not None:
        errors_sl, errors_wl, name, region = (
            columns["sigma_sl"],
            columns["sigma_wl"],
            r"$\sigma_\kappa$",
            None,
        )
    else:
        errors_sl = errors_wl = region = None
        name = ""
    if pair.kappa_true is not None:
        truth = plotting.Band(columns["kappa_true"], columns["kappa_true_16"], columns["kappa_true_84"])
    bands = {
        name: plotting.Band(columns[key], columns[f"{key}_16"], columns[f"{key}_84"])
        for name, key in (("weak, corrected", "kappa_wl"), ("strong", "kappa_sl"))
    }
    ranges = {
        f"{low:g}-{high:g} kpc/h": ((low, high), outcome.inner),
        f"{high:g}-{ends[-1]:g} kpc/h": ((high, float(ends[-1])), outcome.outer),
        f"{low:g}-{ends[-1]:g} kpc/h": ((low, float(ends[-1])), outcome.everything),
    }
    return {
        "lambda_profile": plotting.lambda_profile(
            ends,
            plotting.Band(columns["lambda_rec"], columns["lambda_rec_16"], columns["lambda_rec_84"]),
            lam_true=None if outcome.shape is None else outcome.shape.lam_wl,
            true_label=r"$\lambda$, truth",
            lam_inner=outcome.inner.peak,
            inner_label=label,
            rmse_sl=errors_sl,
            rmse_wl=errors_wl,
            rmse_label=name,
            region=region,
            transition=excess.transition.radius if excess is not None and found else None,
            transition_range=(excess.lo, excess.hi) if excess is not None and found else None,
            title=pair.name,
        ),
        "lambda_pdf": plotting.lambda_pdf(
            {name: _curve(outcome, span, made) for name, (span, made) in ranges.items()},
            x_label=r"$\lambda_{\rm rec}$",
            title=pair.name,
        ),
        "kappa_profile": plotting.kappa_profiles(
            ends, bands, truth=truth, inset=_inset(ends), title=pair.name
        ),
    }


def _inset(ends: np.ndarray) -> tuple[float, float] | None:
    low, high = max(100.0, float(ends[0])), 330.0
    return (low, high) if ends[-1] > 1.3 * high and high > 1.5 * low else None


def _curve(outcome: Outcome, span: tuple[float, float], made: mass_sheet.Distribution) -> plotting.Curve:
    weight = outcome.within(*span)
    lam = np.asarray(outcome.lam.lam)
    low, high = np.percentile(lam[weight > 0.0], [1.0, 99.0])
    x = np.linspace(low - 0.15 * (high - low), high + 0.15 * (high - low), 300)
    return plotting.Curve(
        x, mass_sheet.density(outcome.lam.lam, jnp.asarray(x), jnp.asarray(weight)), made.peak
    )


def write(outcome: Outcome, out: str | Path) -> dict[str, Any]:
    """Write every file of the result to the directory `out`, all of them or none; returns the summary."""
    content, pair = summary(outcome), outcome.pair
    header = {**pair.header, "LAMBDA": (content["lambda_correction"], "mass-sheet factor of the correction")}
    on = {"grid": pair.grid, "reference": pair.reference}
    known = np.asarray(outcome.lam.weight) > 0.0
    maps = {
        "lambda_rec": np.where(known, np.asarray(outcome.lam.lam), np.nan),
        "kappa_wl_corrected": np.where(pair.weight > 0.0, outcome.kappa_corr, np.nan),
        "kappa_sl_matched": pair.kappa_sl,
    }
    if outcome.kappa_both is not None:
        maps["kappa_combined"] = np.where(pair.weight > 0.0, outcome.kappa_both, np.nan)
    drawn = figures(outcome)
    with io.staging(out) as stage:
        io.write_json(stage / "summary.json", content)
        for name, values in maps.items():
            io.write_map(stage / f"{name}.fits", values, header=header, **on)
        io.write_table(
            stage / "profiles.ecsv",
            table(outcome),
            meta={"name": pair.name, "h": outcome.options.h, "version": content["version"]},
            descriptions=_DESCRIPTIONS,
        )
        for name, figure in drawn.items():
            plotting.save(figure, stage / name)
    return content


def verdict(content: dict[str, Any]) -> str:
    """What the summary says, in a few lines."""
    lines = []
    for span, one in content["lambda"].items():
        peak, middle = one["peak"], one["median"]
        lines.append(
            f"lambda {span} kpc/h: peak {peak['value']:.4f} +- {peak['error']:.4f}, median "
            f"{middle['value']:.4f} +- {middle['error']:.4f} ({one['pixels']} pixels)"
        )
    found = content["transition"]
    if found is None:
        lines.append(
            "transition: not looked for; it needs the noise of the weak-lensing map (--sigma or --snr)"
        )
    elif found["found"]:
        low, high = found["range_kpc_h"] or (float("nan"), float("nan"))
        lines.append(
            f"transition by excess variance at {found['r_kpc_h']:.0f} kpc/h (16-84 %: {low:.0f}-{high:.0f}, "
            f"{100 * found['share_of_samples']:.0f} % of the samples have one)"
        )
    else:
        why = ": weak lensing is better from the innermost annulus on" if found["is_inside"] else ""
        lines.append(
            f"no transition found by excess variance{why} ({100 * found['share_of_samples']:.0f} % of the "
            "samples have one)"
        )
    scatter = content["scatter_minimum"]
    where = f"at {scatter['r_kpc_h']:.0f} kpc/h" if scatter["found"] else "not found"
    lines.append(f"first minimum of the scatter {where} (on one map it carries no information)")
    if (truth := content["truth"]) is not None:
        places = ", ".join(f"{one['r_kpc_h']:.0f} (to {one['to']})" for one in truth["crossings_shape"])
        lines.append(
            f"against the truth: lambda {truth['lambda_wl']:.4f}; shape errors cross at {places or '-'}"
        )
    return "\n".join(lines)
