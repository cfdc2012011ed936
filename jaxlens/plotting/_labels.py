"""Names beside points that hide neither each other nor the points."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_ANGLES = np.deg2rad([0, 180, 45, 135, 315, 225, 90, 270, 22, 158, 338, 202, 67, 113, 247, 293])
_RADII = (5.0, 9.0, 14.0, 20.0)  # points from the centre of the marker to the edge of the text


def halo(width: float = 1.6) -> list[patheffects.AbstractPathEffect]:
    """A white rim around text or a marker, so that it can be read on any ground."""
    return [patheffects.withStroke(linewidth=width, foreground="white")]


def _overlap(box: np.ndarray, others: np.ndarray) -> float:
    """Total area that `box` (x0, y0, x1, y1) shares with `others (n, 4)`."""
    if not len(others):
        return 0.0
    width = np.minimum(box[2], others[:, 2]) - np.maximum(box[0], others[:, 0])
    height = np.minimum(box[3], others[:, 3]) - np.maximum(box[1], others[:, 1])
    return float(np.sum(np.clip(width, 0.0, None) * np.clip(height, 0.0, None)))


def place_labels(
    fig: Figure,
    ax: Axes,
    points: np.ndarray,
    names: Sequence[str],
    colours: Sequence[str],
    *,
    avoid: np.ndarray | None = None,
    size: float = 6.5,
) -> None:
    """Write each name near its point, where it overlaps least; a thin line joins the distant ones.

    The layout of the figure must be final but for these labels: positions are worked out on the page.

    Args:
        fig: the figure.
        ax: its axes.
        points: positions in data coordinates, `(n, 2)`.
        names: text of each.
        colours: colour of each.
        avoid: further positions that names should not hide, `(m, 2)`.
        size: of the letters, points.
    """
    fig.draw_without_rendering()
    canvas: Any = fig.canvas
    renderer = canvas.get_renderer()
    dot = fig.dpi / 72.0
    at = ax.transData.transform(points)
    marker = 3.2 * dot
    markers = np.concatenate([at - marker, at + marker], axis=1)
    if avoid is not None and len(avoid):
        others = ax.transData.transform(avoid)
        markers = np.concatenate(
            [markers, np.concatenate([others - 0.5 * marker, others + 0.5 * marker], axis=1)]
        )
    frame = ax.get_window_extent(renderer)
    taken = np.zeros((0, 4))
    for index, (name, colour) in enumerate(zip(names, colours, strict=True)):
        text = ax.annotate(
            name,
            xy=points[index],
            xytext=(0, 0),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=size,
            color=colour,
            zorder=7,
            path_effects=halo(),
            annotation_clip=True,
        )
        extent = text.get_window_extent(renderer)
        half = 0.5 * np.array([extent.width, 0.8 * extent.height])
        best: tuple[float, np.ndarray, np.ndarray, float] | None = None
        for radius in _RADII:
            for rank, angle in enumerate(_ANGLES):
                direction = np.array([np.cos(angle), np.sin(angle)])
                middle = at[index] + direction * (radius * dot + half * np.abs(direction))
                box = np.concatenate([middle - half, middle + half])
                outside = np.any(box[:2] < (frame.x0, frame.y0)) or np.any(box[2:] > (frame.x1, frame.y1))
                cost = 4.0 * _overlap(box, taken) + 2.0 * _overlap(box, markers) + 1e6 * outside
                cost += dot**2 * (0.8 * radius + 0.15 * rank)
                if best is None or cost < best[0]:
                    best = (cost, middle, box, radius)
        assert best is not None
        _, middle, box, radius = best
        offset = (middle - at[index]) / dot
        text.xyann = (float(offset[0]), float(offset[1]))
        if radius > _RADII[1]:
            toward = offset / np.hypot(*offset)
            ends = ax.transData.inverted().transform(
                [at[index] + 3.5 * dot * toward, at[index] + radius * dot * toward]
            )
            ax.plot(*ends.T, "-", color=colour, lw=0.4, zorder=6)
        taken = np.concatenate([taken, box[None]])
