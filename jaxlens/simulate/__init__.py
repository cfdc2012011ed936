"""Simulated clusters: masses that are known, and what observations of them would hold."""

from jaxlens.simulate import luminosity_function
from jaxlens.simulate._cluster import draw_cluster
from jaxlens.simulate._images import (
    Catalogue,
    Images,
    ImageSettings,
    all_images,
    find_images,
    limiting_magnitude,
    observe,
)
from jaxlens.simulate._settings import MERGER, Clump, ClusterSettings
from jaxlens.simulate._shear import (
    SHEAR_MODES,
    Bin,
    GalaxyCatalogue,
    ShearBin,
    ShearSettings,
    TrueField,
    intrinsic_ellipticities,
    mean_counts,
    reduced_shear,
    shear_field,
    true_field,
)
from jaxlens.simulate._sources import (
    Sources,
    SourceSettings,
    caustic_margin,
    draw_sources,
    expected_sources,
)
from jaxlens.simulate._truth import ClumpTruth, SimulatedCluster

__all__ = [
    "MERGER",
    "SHEAR_MODES",
    "Bin",
    "Catalogue",
    "Clump",
    "ClumpTruth",
    "ClusterSettings",
    "GalaxyCatalogue",
    "ImageSettings",
    "Images",
    "ShearBin",
    "ShearSettings",
    "SimulatedCluster",
    "SourceSettings",
    "Sources",
    "TrueField",
    "all_images",
    "caustic_margin",
    "draw_cluster",
    "draw_sources",
    "expected_sources",
    "find_images",
    "intrinsic_ellipticities",
    "limiting_magnitude",
    "luminosity_function",
    "mean_counts",
    "observe",
    "reduced_shear",
    "shear_field",
    "true_field",
]
