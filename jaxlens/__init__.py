"""jaxlens: a differentiable gravitational-lensing engine for galaxy clusters.

Import it as `import jaxlens as jl`. Double precision is the user's choice and the solvers ask for it:
`jax.config.update("jax_enable_x64", True)` before the first array is made. Importing the package
changes no configuration and starts no backend; `io`, `plotting` and the other modules of the edge are
imported when first used.
"""

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

from jaxlens import (
    critical,
    lens,
    lens_equation,
    mass_sheet,
    monte_carlo,
    profiles,
    radial,
    scaling,
    strong,
    transition,
    weak,
)
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Component, Lens

if TYPE_CHECKING:
    from jaxlens import (
        analysis_lambda,
        analysis_real,
        analysis_strong,
        analysis_weak,
        budget_real,
        calibration_real,
        config,
        config_population,
        config_simulate,
        config_weak,
        datasets,
        density_real,
        glafic,
        io,
        joint_real,
        lenstool,
        lenstronomy,
        maps_real,
        model_weak,
        plotting,
        population,
        posterior,
        prediction,
        redshift_weak,
        report,
        reproduce,
        results,
        results_lambda,
        results_real,
        results_simulate,
        results_weak,
        simulate,
        twin_real,
        workflow,
        workflow_lambda,
        workflow_real,
        workflow_simulate,
        workflow_weak,
    )

__version__ = _version("jaxlens-cluster")

_EDGE = {
    "analysis_lambda",
    "analysis_real",
    "analysis_strong",
    "analysis_weak",
    "budget_real",
    "calibration_real",
    "config",
    "config_population",
    "config_simulate",
    "config_weak",
    "datasets",
    "density_real",
    "glafic",
    "io",
    "joint_real",
    "lenstool",
    "lenstronomy",
    "maps_real",
    "model_weak",
    "plotting",
    "population",
    "posterior",
    "prediction",
    "redshift_weak",
    "report",
    "reproduce",
    "results",
    "results_lambda",
    "results_real",
    "results_simulate",
    "results_weak",
    "simulate",
    "twin_real",
    "workflow",
    "workflow_lambda",
    "workflow_real",
    "workflow_simulate",
    "workflow_weak",
}


def __getattr__(name: str) -> Any:
    if name in _EDGE:
        return import_module(f"jaxlens.{name}")
    raise AttributeError(f"module 'jaxlens' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_EDGE})


__all__ = [
    "Component",
    "FlatLCDM",
    "Grid",
    "Lens",
    "LensPlane",
    "analysis_lambda",
    "analysis_real",
    "analysis_strong",
    "analysis_weak",
    "budget_real",
    "calibration_real",
    "config",
    "config_population",
    "config_simulate",
    "config_weak",
    "critical",
    "datasets",
    "density_real",
    "glafic",
    "io",
    "joint_real",
    "lens",
    "lens_equation",
    "lenstool",
    "lenstronomy",
    "maps_real",
    "mass_sheet",
    "model_weak",
    "monte_carlo",
    "plotting",
    "population",
    "posterior",
    "prediction",
    "profiles",
    "radial",
    "redshift_weak",
    "report",
    "reproduce",
    "results",
    "results_lambda",
    "results_real",
    "results_simulate",
    "results_weak",
    "scaling",
    "simulate",
    "strong",
    "transition",
    "twin_real",
    "weak",
    "workflow",
    "workflow_lambda",
    "workflow_real",
    "workflow_simulate",
    "workflow_weak",
]
