"""The files of `jaxlens real`: what is written, and under which name.

For each sample of galaxies `lambda_<sample>.ecsv` (profile and error budget), `kappa_wl_<sample>.fits`,
`kappa_wl_noise_<sample>.fits`, `kappa_sl_<sample>.fits`, `lambda_rec_<sample>.fits`; `lambda_<sample>`,
`budget_<sample>`, `calibration_<sample>` and `excess_<sample>` as figures; `summary.json` and `report.html`.
"""

from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import io, plotting, radial, report
from jaxlens._verdict_real import verdict
from jaxlens.analysis_real import Analysis, Outcome
from jaxlens.budget_real import SOURCES

_COLUMN = {
    "shape noise": "error_shape_noise",
    "photometric redshifts": "error_redshifts",
    "strong lensing": "error_strong",
    "calibration": "error_calibration",
    "together": "error",
}

_DESCRIPTIONS = {
    "r_kpc_h": "middle of the annulus, in units of kpc/h",
    "lambda_rec": "(kappa_wl - 1)/(kappa_sl - 1): median over the pixels",
    "lambda_expected": "the same of a noiseless map of the strong-lensing model itself",
    "error": "half the width that holds 68 % of the draws of all ingredients together",
    "lambda_published": "with the published strong-lensing model",
    "slope": "of the measured ellipticities against the reduced shear of the strong-lensing model",
    "q": "excess variance over that of weak lensing; above 1 weak lensing is better",
}


_JOINT = (
    "lam", "lam_error", "lam_error_fixed", "lam_expected", "m", "m_error", "correlation", "chi2_images",
    "chi2_map", "n_map", "shift", "converged",
)  # fmt: skip
# Of the joint fit, what `summary.json` says.


def _profile(one: Outcome) -> np.ndarray:
    found = one.found
    return np.asarray(radial.profile_in(found.lam.lam, found.rings, found.lam.weight).median)


def table(one: Outcome) -> dict[str, np.ndarray]:
    """Columns of the profile of a sample."""
    rings, excess = one.found.rings, one.found.excess
    ends = np.asarray(rings.edges)
    columns: dict[str, Any] = {
        "r_low_kpc_h": ends[:-1],
        "r_high_kpc_h": ends[1:],
        "r_kpc_h": rings.r,
        "pixels": rings.count,
        "lambda_rec": _profile(one),
        "lambda_expected": one.expected,
    }
    columns |= {_COLUMN[source]: one.budget.error(source) for source in SOURCES}
    if one.published is not None:
        columns["lambda_published"] = one.published
    columns |= {"slope": one.slopes.value, "slope_error": one.slopes.error}
    if excess is not None:
        columns |= {"q": excess.q, "sigma_wl": np.sqrt(excess.wl), "sigma_sl": np.sqrt(excess.sl)}
    return {name: np.asarray(values) for name, values in columns.items()}


def _of(one: Outcome) -> dict[str, Any]:
    found, budget = one.found, one.budget
    inner, excess = found.options.inner, found.excess
    assert excess is not None
    has = bool(excess.transition.found)
    content: dict[str, Any] = {
        "title": one.sample.title,
        "galaxies": int(np.asarray(one.sample.field.shear.n_gal)[one.found.pair.weight > 0.0].sum()),
        "density_arcmin2": one.density,
        "dls_ds": one.sample.dls_ds,
        "calibration": {
            "mean": one.sample.calibration[0],
            "sigma": one.sample.calibration[1],
            "slope": one.slopes.mean,
            "slope_error": one.slopes.mean_error,
            "slope_chi2": one.slopes.chi2,
            "annuli": len(one.slopes.value),
        },
        "inner_kpc_h": list(inner),
        "lambda": {
            "value": float(found.inner.median),
            "interval": {source: list(budget.inner_interval(source)) for source in SOURCES},
            "expected": one.expected_inner,
            "published": one.published_inner,
        },
        "transition": {
            "found": has,
            "r_kpc_h": float(excess.transition.radius) if has else None,
            "share_of_draws": budget.share,
            "range_kpc_h": budget.interval,
        },
    }
    if one.joint is not None:
        joint = one.joint._asdict()
        content["joint"] = {name: joint[name] for name in _JOINT}
    if one.search is not None:
        search = one.search
        content["density"] = {
            "arcmin2": (search.density * search.factors).tolist(),
            "share_found": search.found.tolist(),
            "share_inside_first_annulus": search.inside.tolist(),
            "fields": search.fields,
            "needed_arcmin2": search.needed,
        }
    return content


def summary(found: Analysis) -> dict[str, Any]:
    """The content of `summary.json`; what is not known is null."""
    fit, images = found.fit, found.cluster.strong.problem.images
    return {
        "name": found.cluster.name,
        "z_lens": float(found.cluster.plane.z_l),
        "h": float(found.cluster.plane.cosmology.h),
        "strong": {
            "images": images.n_images,
            "systems": images.n_systems,
            "chi2_source": float(fit.chi2),
            "starts_agreeing": [int(fit.agreeing), len(fit.starts)],
            "at_bound": list(fit.at_bound),
            "draws_warning": found.quality.warning,
        },
        "samples": {one.sample.key: _of(one) for one in found.outcomes},
        "draws": found.options.draws,
        "max_g": found.options.max_g,
        "seed": found.options.seed,
        "version": metadata.version("jaxlens-cluster"),
    }


def figures(found: Analysis) -> dict[str, Any]:
    """The figures (`matplotlib.figure.Figure`) by file stem."""
    drawn = {}
    for one in found.outcomes:
        columns, budget, excess = table(one), one.budget, one.found.excess
        assert excess is not None
        ends, key, title = np.asarray(one.found.rings.edges), one.sample.key, one.found.pair.name
        lam, error = columns["lambda_rec"], columns["error"]
        lines = {
            "measured, all errors": plotting.Line(lam, lo=lam - error, hi=lam + error),
            "noiseless map of the model": plotting.Line(one.expected),
        }
        if one.published is not None:
            lines["published model"] = plotting.Line(one.published)
        drawn[f"lambda_{key}"] = plotting.radial_lines(
            ends, lines, y_label=r"$\lambda_{\rm rec}$", title=title
        )
        drawn[f"budget_{key}"] = plotting.radial_lines(
            ends,
            {source: plotting.Line(budget.error(source)) for source in SOURCES},
            y_label=r"error of $\lambda_{\rm rec}$",
            log=True,
            title=title,
        )
        m0, width = one.sample.calibration
        flat = np.full(len(lam), m0)
        drawn[f"calibration_{key}"] = plotting.radial_lines(
            ends,
            {
                "shapes against the model": plotting.Line(one.slopes.value, one.slopes.error),
                "prior of the calibration": plotting.Line(flat, lo=flat - width, hi=flat + width),
            },
            y_label="slope",
            title=title,
        )
        marks = {"transition": excess.transition.radius} if bool(excess.transition.found) else None
        drawn[f"excess_{key}"] = plotting.radial_lines(
            ends,
            {"excess / weak-lensing variance": plotting.Line(excess.q)},
            y_label="$q$",
            level=1.0,
            marks=marks,
            title=title,
        )
    return drawn


_CAPTIONS = {
    "lambda": "Mass-sheet factor of weak against strong lensing; the band is the error of all ingredients "
    "together. Agreement means the measured profile equals that of the noiseless map of the model.",
    "budget": "Error of every ingredient by itself and of all together.",
    "calibration": "Slope of the measured ellipticities against the reduced shear of the strong-lensing "
    "model, which holds no mass sheet. One calibration is used for all radii: where the slope changes with "
    "radius, the map is wrong.",
    "excess": "Excess variance of the difference of both maps over the variance of weak-lensing noise; where "
    "it is above 1 the strong-lensing map is the worse one.",
}


def page(
    content: dict[str, Any], tables: dict[str, dict[str, np.ndarray]], pngs: dict[str, Path]
) -> report.Page:
    """The report.

    Args:
        content: of `summary`.
        tables: of every sample, by key.
        pngs: files of the figures by stem.
    """
    sections = [report.Section("result", "What was found", verdict(content).splitlines())]
    for key, one in content["samples"].items():
        columns = tables[key]
        names = ["r_kpc_h", "pixels", "lambda_rec", "lambda_expected", *_COLUMN.values(), "q"]
        names = [name for name in names if name in columns]
        rows = [[f"{columns[name][i]:.4g}" for name in names] for i in range(len(columns["r_kpc_h"]))]
        profile = report.Table(
            names, rows, caption="Profile and errors", numeric=frozenset(range(len(names)))
        )
        parts: list[Any] = [profile]
        if "joint" in one:
            parts.append(_routes(one))
        parts += [report.Figure.read(pngs[f"{kind}_{key}"], _CAPTIONS[kind]) for kind in _CAPTIONS]
        sections.append(report.Section(key, one["title"], parts))
    facts = {
        "draws": str(content["draws"]),
        "largest |g|": f"{content['max_g']:g}",
        "seed": str(content["seed"]),
        "version": content["version"],
    }
    lead = "lambda(r) from multiple images and galaxy shapes, with the error of every ingredient."
    return report.Page(content["name"], lead, sections, facts)


def _routes(one: dict[str, Any]) -> report.Table:
    """lambda and calibration by both routes."""
    lam, joint, prior = one["lambda"], one["joint"], one["calibration"]
    half = lambda source: 0.5 * (lam["interval"][source][1] - lam["interval"][source][0])
    rows = [
        ["lambda, two steps", f"{lam['value']:.3f}", f"{half('together'):.3f}"],
        ["the same, calibration known", "", f"{half('shape noise'):.3f}"],
        ["lambda, together", f"{joint['lam']:.3f}", f"{joint['lam_error']:.3f}"],
        ["the same, calibration known", "", f"{joint['lam_error_fixed']:.3f}"],
        ["expected of the model", f"{lam['expected']:.3f}", ""],
        ["calibration, prior", f"{prior['mean']:.3f}", f"{prior['sigma']:.3f}"],
        ["calibration, together", f"{joint['m']:.3f}", f"{joint['m_error']:.3f}"],
        ["correlation of lambda and calibration", f"{joint['correlation']:+.2f}", ""],
    ]
    caption = (
        "Two steps: median of the pixels, half of the 68 % interval of all draws (and of shape noise alone). "
        "Together: images and map in one least-squares problem, Laplace errors. The numbers of the "
        f"strong-lensing model moved by at most {joint['shift']:.2f} of their errors; chi2 of the map "
        f"{joint['chi2_map']:.0f} for {joint['n_map']} pixels."
    )
    return report.Table(["", "value", "error"], rows, caption=caption, numeric=frozenset({1, 2}))


def write(found: Analysis, out: str | Path) -> dict[str, Any]:
    """Write every file of the result to the directory `out`, all of them or none; returns the summary."""
    content, drawn = summary(found), figures(found)
    tables = {one.sample.key: table(one) for one in found.outcomes}
    with io.staging(out) as stage:
        io.write_json(stage / "summary.json", content)
        for one in found.outcomes:
            pair, key, known = one.found.pair, one.sample.key, one.found.pair.weight > 0.0
            maps = {
                "kappa_wl": np.where(known, pair.kappa_wl, np.nan),
                "kappa_wl_noise": np.where(known, np.asarray(pair.sigma), np.nan),
                "kappa_sl": pair.kappa_sl,
                "lambda_rec": np.where(
                    np.asarray(one.found.lam.weight) > 0.0, np.asarray(one.found.lam.lam), np.nan
                ),
            }
            for name, values in maps.items():
                io.write_map(
                    stage / f"{name}_{key}.fits",
                    values,
                    header=pair.header,
                    grid=pair.grid,
                    reference=pair.reference,
                )
            io.write_table(
                stage / f"lambda_{key}.ecsv",
                tables[key],
                meta={"name": pair.name, "h": content["h"], "version": content["version"]},
                descriptions=_DESCRIPTIONS,
            )
        pngs = {name: stage / f"{name}.png" for name in drawn}
        for name, figure in drawn.items():
            plotting.save(figure, stage / name)
        (stage / "report.html").write_text(report.html(page(content, tables, pngs)), encoding="utf-8")
    return content


__all__ = ["figures", "page", "summary", "table", "verdict", "write"]
