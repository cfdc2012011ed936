"""`summary.json` of a strong-lensing fit, and what it says in a few lines."""

from importlib import metadata
from typing import Any

from jaxlens import analysis_strong
from jaxlens._outcome import Outcome, bound_names, unit_of
from jaxlens.strong import criteria, rms_by_source


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
