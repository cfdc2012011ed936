"""The figures of the experiment, by file stem."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlens import mass_sheet, monte_carlo, plotting, radial, weak
from jaxlens.plotting import Band, Curve, Line
from jaxlens.reproduce import _analysis
from jaxlens.reproduce._analysis import Analysis
from jaxlens.reproduce._cluster import FIRST, ClusterRun, noise_key

CAPTIONS = {
    "weak_data": "The mock weak-lensing data: galaxies per pixel, mask, reduced shear as observed and "
    "smoothed.",
    "pdf_noiseless": "Distribution of lambda = (kappa_wl - 1)/(kappa_true - 1) over pixels at 100-700 kpc/h, "
    "without shape noise.",
    "pdf_noisy": "The same with shape noise: mean over the realisations, shaded by their scatter.",
    "pdf_ranges": "Distribution of lambda_rec = (kappa_wl - 1)/(kappa_sl - 1) in three ranges of radius.",
    "lambda_maps": "Maps of lambda without noise: A2 differs from the truth by one factor, K2 by one "
    "that varies.",
    "lambda_profile": "lambda_rec(r) of one realisation, and below it the RMSE of both probes over all "
    "realisations, with the paper's transition region.",
    "shape_errors": "Errors of both probes after each map was given its best mass sheet, and the transition "
    "found without the truth.",
    "kappa_profile": "Convergence of the truth, of corrected weak lensing and of strong lensing, "
    "smoothed alike.",
    "scatter_criterion": "The paper's criterion beside its null test: a perfect strong-lensing map has a "
    "minimum "
    "as well.",
    "excess_variance": "Excess variance of the difference of both maps, without the mass sheet between them, "
    "over the variance of weak lensing.",
    "decomposition": "Both factors of lambda_rec: scatter of the first, and the second with its 16-84 % "
    "range.",
    "lambda_error": "Error of lambda from single annuli: scatter over realisations, bias, and both.",
    "combined": "RMSE of the combined map over that of the better probe, with lambda_P and with the true "
    "lambda.",
    "mask": "Scatter of lambda_rec with the mask at |g| > 0.5 and at |g| > 0.7.",
    "depletion": "Scatter of lambda_rec with and without depletion of the galaxy counts in the core.",
    "external_shear": "RMSE of strong lensing: members in the rectangle, in the field, and with external "
    "shear.",
}
"""What is seen in each figure."""


NAMES = {
    "rectangle": "members in rectangle",
    "field": "members in field",
    "shear": "with external shear",
    "perfect": "perfect SL map",
}
"""Strong-lensing maps in legends."""


def _pdfs(found: ClusterRun) -> dict[str, Any]:
    base = found.base
    clean, noisy, setup = base.clean, base.noisy, base.setup
    x = np.asarray(noisy.pdf_x)
    free = {}
    for name, kappa in setup.clean.items():
        lam = mass_sheet.ratio(kappa, setup.kappa_true, setup.weight)
        values, weight = setup.sample(lam.lam, lam.weight, -1)
        wide = np.linspace(x[0], x[-1], 1201)
        density = mass_sheet.density(values, jnp.asarray(wide), weight)
        peak = float(getattr(clean, name.lower()).peak[-1])
        free[name] = Curve(wide, density, peak)
    good = noisy.good
    mean_peak = lambda one, which: float(np.asarray(one.peak)[:, which].mean())
    curve = lambda row, peak: Curve(x, noisy.pdf[row], peak, noisy.pdf_scatter[row])
    true = float(clean.a2.peak[-1])
    names = [rf"${low:g} \leq r < {high:g}$" for low, high in setup.ranges]
    return {
        "pdf_noiseless": plotting.lambda_pdf(free),
        "pdf_noisy": plotting.lambda_pdf(
            {"A2": curve(0, mean_peak(good.a2, -1)), "K2": curve(1, mean_peak(good.k2, -1))},
            reference=true,
            reference_label="A2, noiseless",
        ),
        "pdf_ranges": plotting.lambda_pdf(
            {name: curve(2 + k, mean_peak(good.rec, k)) for k, name in enumerate(names)},
            reference=true,
            x_label=r"$\lambda_{\rm rec}$",
        ),
    }


def _bands(found: ClusterRun) -> dict[str, Any]:
    """lambda_rec(r) and kappa(r) of the first realisation."""
    setup = found.base.setup
    first = monte_carlo_first(found)
    lam = mass_sheet.ratio(first, setup.kappa_sl, setup.weight)
    profile = radial.profile_in(lam.lam, setup.rings, lam.weight)
    corrected = mass_sheet.regauge(first, float(np.asarray(found.base.noisy.measured.lam)[0]))
    band = lambda values: _band(radial.profile_in(values, setup.rings))
    return {
        "lam": _band(profile),
        "wl": band(corrected),
        "sl": band(setup.kappa_sl),
        "true": band(setup.kappa_true),
    }


def _band(profile: radial.RadialProfile) -> Band:
    return Band(*(np.asarray(a)[FIRST:] for a in (profile.median, profile.lo, profile.hi)))


def monte_carlo_first(found: ClusterRun) -> Any:
    """The first good A2 map, not corrected, `(y, x)`."""
    good = np.flatnonzero(np.asarray(found.base.noisy.measured.good))
    return found.a2[int(good[0])]


def figures(found: ClusterRun, made: Analysis) -> dict[str, Any]:
    """All figures (`matplotlib.figure.Figure`) that the variants of the run allow, by file stem."""
    base = found.base
    setup, clean = base.setup, base.clean
    edges = np.asarray(setup.rings.edges)[FIRST:]
    wrong, bands = made.errors, _bands(found)
    true = float(clean.a2.peak[-1])
    inner = float(np.asarray(base.noisy.good.rec.peak)[:, 0].mean())
    noisy = monte_carlo.draw(noise_key(found.seed), 0, setup)
    smooth = weak.smooth(noisy.g, setup.grid, setup.smoothing, noisy.weight * setup.weight)
    main = made.excess["rectangle"]
    found_at = main.mean_radius
    clean_maps = {
        name: mass_sheet.ratio(kappa, setup.kappa_true, setup.weight).lam
        for name, kappa in setup.clean.items()
    }
    drawn = {
        "weak_data": plotting.shear_input(noisy.n_gal, setup.weight, noisy.g, smooth, setup.grid),
        **_pdfs(found),
        "lambda_maps": plotting.lambda_maps(clean_maps, setup.weight, setup.grid),
        "lambda_profile": plotting.lambda_profile(
            edges,
            bands["lam"],
            lam_true=true,
            lam_inner=inner,
            rmse_sl=wrong.sl,
            rmse_wl=wrong.wl,
            region=np.abs(wrong.sl - wrong.wl) < 0.25 * (wrong.sl + wrong.wl),
        ),
        "shape_errors": plotting.lambda_profile(
            edges,
            bands["lam"],
            lam_true=true,
            rmse_sl=wrong.shape_sl,
            rmse_wl=wrong.shape_wl,
            rmse_label="shape error",
            transition=found_at if math.isfinite(found_at) else None,
            transition_range=_interval(main),
        ),
        "kappa_profile": plotting.kappa_profiles(
            edges, {"weak, corrected": bands["wl"], "strong": bands["sl"]}, truth=bands["true"]
        ),
        "scatter_criterion": plotting.scatter_criterion(
            edges,
            _analysis.scatter_of(base)[:, FIRST:],
            _analysis.null_scatter(base)[:, FIRST:],
            made.criterion.shares,
            made.criterion.null_shares,
            crossing=wrong.first,
        ),
        "excess_variance": plotting.radial_lines(
            edges,
            {NAMES[name]: Line(np.asarray(one.mean.q)[FIRST:]) for name, one in made.excess.items()},
            y_label=r"$q$, excess over weak-lensing variance",
            level=1.0,
            marks={"transition": found_at, "equal shape errors": wrong.first},
        ),
    }
    return drawn | _details(found, made, edges) | _checks(found, edges)


def _interval(outcome: _analysis.ExcessOutcome) -> tuple[float, float] | None:
    """16-84 % of the radii of single realisations."""
    known = outcome.radius[np.isfinite(outcome.radius)]
    if len(known) < 8:
        return None
    low, high = np.percentile(known, [16.0, 84.0])
    return float(low), float(high)


def _details(found: ClusterRun, made: Analysis, edges: np.ndarray) -> dict[str, Any]:
    split, error = made.decomposition, made.lambda_errors
    line = lambda part, of: Line(of[part], of["error"])
    return {
        "decomposition": plotting.radial_lines(
            edges,
            {
                r"$1 +$ scatter of $(\kappa_{\rm wl}-1)/(\kappa_{\rm true}-1)$": Line(
                    1.0 + split["first_scatter"]
                ),
                r"$(\kappa_{\rm true}-1)/(\kappa_{\rm sl}-1)$": Line(
                    split["second_median"], None, split["second_lo"], split["second_hi"]
                ),
            },
            y_label="factors",
            level=1.0,
        ),
        "lambda_error": plotting.radial_lines(
            edges,
            {
                "scatter": Line(error["scatter"]),
                "bias, absolute": Line(np.abs(error["bias"])),
                "both": Line(error["total"]),
            },
            y_label=r"error of $\lambda/\lambda_{\rm true}$",
            marks={"equal shape errors": made.errors.first},
            log=True,
        ),
        "combined": plotting.radial_lines(
            edges,
            {
                r"with $\lambda_P$": line("ratio", made.combined),
                r"with the true $\lambda$": line("ratio", made.combined_true),
            },
            y_label="RMSE, combined over the better probe",
            level=1.0,
        ),
    }


def _checks(found: ClusterRun, edges: np.ndarray) -> dict[str, Any]:
    drawn: dict[str, Any] = {}
    scatter = {name: _analysis.scatter_of(one)[:, FIRST:] for name, one in found.variants.items()}
    mean = {
        name: Line(one.mean(axis=0), one.std(axis=0, ddof=1) / math.sqrt(len(one)))
        for name, one in scatter.items()
    }
    label = r"scatter of $\lambda_{\rm rec}$"
    if "mask" in mean:
        pair = {r"masked $|g| > 0.5$": mean["rectangle"], r"masked $|g| > 0.7$": mean["mask"]}
        drawn["mask"] = plotting.radial_lines(edges, pair, y_label=label)
    if "no_depletion" in mean:
        pair = {"depleted core": mean["rectangle"], "no depletion": mean["no_depletion"]}
        drawn["depletion"] = plotting.radial_lines(edges, pair, y_label=label)
    several = [name for name in ("rectangle", "field", "shear") if name in found.variants]
    if len(several) > 1:
        errors = {name: _analysis.errors(found, found.variants[name]) for name in several}
        drawn["external_shear"] = plotting.radial_lines(
            edges,
            {NAMES[name]: Line(one.sl) for name, one in errors.items()}
            | {"weak lensing, corrected": Line(errors["rectangle"].wl)},
            y_label="RMSE",
            log=True,
        )
    return drawn
