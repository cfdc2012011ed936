"""Simulated clusters: masses that are known, and what observations of them would hold."""

from jaxlens.simulate._cluster import draw_cluster
from jaxlens.simulate._render import render
from jaxlens.simulate._settings import MERGER, Clump, ClusterSettings
from jaxlens.simulate._truth import ClumpTruth, SimulatedCluster

__all__ = [
    "MERGER",
    "Clump",
    "ClumpTruth",
    "ClusterSettings",
    "SimulatedCluster",
    "draw_cluster",
    "render",
]
