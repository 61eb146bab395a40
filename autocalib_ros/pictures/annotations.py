"""Annotations of top views with OpenCV: labels, scale bar and metre grid."""

from __future__ import annotations

import numpy as np

from autocalib_ros.pictures.drawing import INK, PAPER, Overlay, line_px, text_height_px, text_size
from autocalib_ros.pictures.scene_geometry import ScaleBar
from autocalib_ros.pictures.views import TopView, round_length

LABEL_OPACITY = 0.75
METRE_GRID_STEPS = 8
"""Approximate number of grid lines along the longer side of a top view."""
METRE_GRID_OPACITY = 0.55


def add_label(overlay: Overlay, text: str, left: float, top: float, text_height: float) -> None:
    """Add dark text on a light box, legible on any image."""
    width, height = text_size(text, text_height)
    x, y = round(left), round(top)
    overlay.add_box(x - 2, y - 1, x + width + 2, y + height + 1, PAPER, LABEL_OPACITY)
    overlay.add_text(text, left, top, text_height, INK)


def add_scale_bar(
    overlay: Overlay, bar: ScaleBar, left: float, bottom: float, text_height: float, width_px: int
) -> None:
    """Add a scale bar with its length above; (left, bottom) is its left end, `width_px` the line width."""
    line = np.array([[left, bottom], [left + bar.length_px, bottom]])
    overlay.add_paths([line], PAPER, 6 * width_px)
    overlay.add_paths([line], INK, 3 * width_px)
    add_label(overlay, bar.text, left, bottom - 1.6 * text_height, text_height)


def add_metre_grid(overlay: Overlay, view: TopView, unit: str) -> None:
    """Add lines at round coordinates, with x labelled along the upper and y along the right border."""
    text_height = text_height_px(view.rows)
    low, high = np.array(view.low_m), np.array(view.high_m)
    step = round_length(1.5 * float((high - low).max()) / METRE_GRID_STEPS)
    lines, labels = [], []
    for axis in (0, 1):
        for value in step * np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1):
            ends = np.array([low, high])
            ends[:, axis] = value
            lines.append(view.pixels(ends))
            labels.append((axis, f'{value + 0.0:g} {unit}', lines[-1][0]))
    overlay.add_paths(lines, PAPER, line_px(view.rows), METRE_GRID_OPACITY)
    for axis, text, (x, y) in labels:
        width, height = text_size(text, text_height)
        left, top = (
            (x - width / 2, 0.4 * height) if axis == 0 else (view.columns - width - 0.4 * height, y - height / 2)
        )
        add_label(overlay, text, left, top, text_height)
