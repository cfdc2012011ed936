"""Simulated clusters and what is observed of them: strong and weak lensing mocks."""

from jaxlens.simulate import luminosity_function
from jaxlens.simulate._images import (
    Catalogue,
    Images,
    ImageSettings,
    all_images,
    find_images,
    limiting_magnitude,
    observe,
)
from jaxlens.simulate._sources import (
    Sources,
    SourceSettings,
    caustic_margin,
    draw_sources,
    expected_sources,
)

__all__ = [
    "Catalogue",
    "ImageSettings",
    "Images",
    "SourceSettings",
    "Sources",
    "all_images",
    "caustic_margin",
    "draw_sources",
    "expected_sources",
    "find_images",
    "limiting_magnitude",
    "luminosity_function",
    "observe",
]
