"""The paper's experiment, from a seed to figures, a table and the verdict on each of its statements."""

from jaxlens.reproduce._analysis import NEAR, Analysis, Errors, ExcessOutcome, analyse
from jaxlens.reproduce._cluster import EDGES, VARIANTS, ClusterRun, Variant, run
from jaxlens.reproduce._clusters import (
    NOT_APPLICABLE,
    cluster_file,
    cluster_row,
    clusters_content,
    clusters_page,
    finished,
    measured,
    section,
    shares,
    shipped,
    stamp,
    tally,
)
from jaxlens.reproduce._figures import CAPTIONS, figures
from jaxlens.reproduce._numbers import numbers, own_numbers
from jaxlens.reproduce._one import one_cluster
from jaxlens.reproduce._paper import Row, rows
from jaxlens.reproduce._statements import CLAIMS, OURS, Claim, Judged, Measured, judge
from jaxlens.reproduce._strong import SLModel, fit_model, statistics, with_shear, write_problem
from jaxlens.reproduce._sweep import LABELS, VALUES, sweep
from jaxlens.reproduce._write import summary, verdict, write

__all__ = [
    "CAPTIONS",
    "CLAIMS",
    "EDGES",
    "LABELS",
    "NEAR",
    "NOT_APPLICABLE",
    "OURS",
    "VALUES",
    "VARIANTS",
    "Analysis",
    "Claim",
    "ClusterRun",
    "Errors",
    "ExcessOutcome",
    "Judged",
    "Measured",
    "Row",
    "SLModel",
    "Variant",
    "analyse",
    "cluster_file",
    "cluster_row",
    "clusters_content",
    "clusters_page",
    "figures",
    "finished",
    "fit_model",
    "judge",
    "measured",
    "numbers",
    "one_cluster",
    "own_numbers",
    "rows",
    "run",
    "section",
    "shares",
    "shipped",
    "stamp",
    "statistics",
    "summary",
    "sweep",
    "tally",
    "verdict",
    "with_shear",
    "write",
    "write_problem",
]
