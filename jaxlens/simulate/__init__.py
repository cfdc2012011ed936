"""Simulated clusters: masses that are known, and what observations of them would hold."""

from jaxlens.simulate import luminosity_function
from jaxlens.simulate._cluster import draw_cluster
from jaxlens.simulate._galaxies import (
    GalaxyCatalogue,
    ShearBin,
    intrinsic_ellipticities,
    mean_counts,
    shear_field,
)
from jaxlens.simulate._images import (
    Catalogue,
    Images,
    ImageSettings,
    all_images,
    find_images,
    limiting_magnitude,
    observe,
    padded,
)
from jaxlens.simulate._limits import check
from jaxlens.simulate._mock import (
    DEFAULT_SEED,
    STAGES,
    Mock,
    Settings,
    StrongMock,
    mock,
    stage_keys,
    strong_mock,
)
from jaxlens.simulate._render import render
from jaxlens.simulate._settings import MERGER, Clump, ClusterSettings
from jaxlens.simulate._shear import SHEAR_MODES, Bin, ShearSettings, TrueField, reduced_shear, true_field
from jaxlens.simulate._sources import (
    CausticMargin,
    Sources,
    SourceSettings,
    caustic_margin,
    draw_sources,
    expected_sources,
)
from jaxlens.simulate._truth import ClumpTruth, SimulatedCluster

__all__ = [
    "DEFAULT_SEED",
    "MERGER",
    "SHEAR_MODES",
    "STAGES",
    "Bin",
    "Catalogue",
    "CausticMargin",
    "Clump",
    "ClumpTruth",
    "ClusterSettings",
    "GalaxyCatalogue",
    "ImageSettings",
    "Images",
    "Mock",
    "Settings",
    "ShearBin",
    "ShearSettings",
    "SimulatedCluster",
    "SourceSettings",
    "Sources",
    "StrongMock",
    "TrueField",
    "all_images",
    "caustic_margin",
    "check",
    "draw_cluster",
    "draw_sources",
    "expected_sources",
    "find_images",
    "intrinsic_ellipticities",
    "limiting_magnitude",
    "luminosity_function",
    "mean_counts",
    "mock",
    "observe",
    "padded",
    "reduced_shear",
    "render",
    "shear_field",
    "stage_keys",
    "strong_mock",
    "true_field",
]
