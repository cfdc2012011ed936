"""The files of `jaxlens real`: what is written, and under which name.

For each sample of galaxies `lambda_<sample>.ecsv` (profile and error budget), `kappa_wl_<sample>.fits`,
`kappa_wl_noise_<sample>.fits`, `kappa_sl_<sample>.fits`, `lambda_rec_<sample>.fits`; `budget_<sample>` and
`excess_<sample>` as figures; `summary.json` and `report.html`.
"""

from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import io, plotting, radial, report
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
    "q": "excess variance over that of weak lensing; above 1 weak lensing is better",
}


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
        "galaxies": int((np.asarray(one.sample.setup.galaxies.weight) > 0.0).sum()),
        "density_arcmin2": one.density,
        "dls_ds": one.sample.dls_ds,
        "calibration": {"mean": one.sample.calibration[0], "sigma": one.sample.calibration[1]},
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
        parts = [profile]
        parts += [report.Figure.read(pngs[f"{kind}_{key}"], _CAPTIONS[kind]) for kind in _CAPTIONS]
        sections.append(report.Section(key, one["title"], parts))
    facts = {"draws": str(content["draws"]), "seed": str(content["seed"]), "version": content["version"]}
    lead = "lambda(r) from multiple images and galaxy shapes, with the error of every ingredient."
    return report.Page(content["name"], lead, sections, facts)


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


def verdict(content: dict[str, Any]) -> str:
    """What the summary says, in a few lines."""
    strong = content["strong"]
    lines = [
        f"{strong['images']} images of {strong['systems']} systems: chi2 {strong['chi2_source']:.2f} (source "
        f"plane), {strong['starts_agreeing'][0]} of {strong['starts_agreeing'][1]} starts agree"
    ]
    if strong["draws_warning"]:
        lines.append(f"note: {strong['draws_warning']}")
    for one in content["samples"].values():
        lam, (low, high) = one["lambda"], one["inner_kpc_h"]
        begin, end = lam["interval"]["together"]
        said = one["calibration"]
        lines.append(
            f"{one['title']} ({one['galaxies']}, {one['density_arcmin2']:.0f} per arcmin^2, calibration "
            f"{said['mean']:g} +- {said['sigma']:g}): lambda {low:g}-{high:g} kpc/h {lam['value']:.3f}, 68 % "
            f"{begin:.3f} to {end:.3f}; a noiseless map of the model has {lam['expected']:.3f}"
        )
        if lam["published"] is not None:
            lines.append(f"  with the published model instead of ours: {lam['published']:.3f}")
        found = one["transition"]
        span = (
            "" if found["range_kpc_h"] is None else " at {:.0f} to {:.0f} kpc/h".format(*found["range_kpc_h"])
        )
        where = f"{found['r_kpc_h']:.0f} kpc/h" if found["found"] else "not found"
        lines.append(
            f"  transition by excess variance: {where}; {100 * found['share_of_draws']:.0f} % of the draws "
            f"have one{span}"
        )
    return "\n".join(lines)


__all__ = ["figures", "page", "summary", "table", "verdict", "write"]
