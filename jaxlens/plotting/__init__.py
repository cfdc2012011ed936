"""One function per figure: plain results in, `matplotlib.figure.Figure` out, no global state.

Figures have the width of a journal's column or page, colours that are told apart with any colour
vision, and units on every axis. `save` writes one as PDF and PNG.
"""

from jaxlens.plotting._covariance import covariance
from jaxlens.plotting._fit import residual_vectors, starts
from jaxlens.plotting._lambda_pdf import Curve, lambda_pdf, shear_input
from jaxlens.plotting._lambda_profiles import Band, kappa_profiles, lambda_maps, lambda_profile
from jaxlens.plotting._maps import kappa_map
from jaxlens.plotting._population import lambda_bias, many_profiles, success, transition_against
from jaxlens.plotting._profiles import mass_profile
from jaxlens.plotting._radial_lines import Line, radial_lines, scatter_criterion
from jaxlens.plotting._simulate import simulated_cluster, source_population, weak_data
from jaxlens.plotting._statements import statement_shares, statement_values, sweep
from jaxlens.plotting._style import COLOURS, COLUMN, PAGE, STYLE, save
from jaxlens.plotting._weak_maps import shear_maps, shear_sticks
from jaxlens.plotting._weak_profiles import iteration_history, tangential_profile

__all__ = [
    "COLOURS",
    "COLUMN",
    "PAGE",
    "STYLE",
    "Band",
    "Curve",
    "Line",
    "covariance",
    "iteration_history",
    "kappa_map",
    "kappa_profiles",
    "lambda_bias",
    "lambda_maps",
    "lambda_pdf",
    "lambda_profile",
    "many_profiles",
    "mass_profile",
    "radial_lines",
    "residual_vectors",
    "save",
    "scatter_criterion",
    "shear_input",
    "shear_maps",
    "shear_sticks",
    "simulated_cluster",
    "source_population",
    "starts",
    "statement_shares",
    "statement_values",
    "success",
    "sweep",
    "tangential_profile",
    "transition_against",
    "weak_data",
]
