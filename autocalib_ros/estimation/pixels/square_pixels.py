"""Evidence in square pixels, for the published method, which knows no other ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence


def with_square_pixels(evidence: Evidence, aspect: float) -> Evidence:
    """Return evidence of images as wide as pixels of an aspect make them, of the same height; tracks and segments only.

    The left border of the image lies half a pixel outside the centres of the first column.
    """
    if aspect == 1.0:
        return evidence
    width, height = evidence.image_size
    return replace(
        evidence,
        image_size=(max(round(width * aspect), 1), height),
        points_px=_widened_columns(evidence.points_px, aspect),
        segments_px=_widened_columns(evidence.segments_px, aspect),
        pixel_aspect=0.0,
    )


def _widened_columns(coordinates: np.ndarray, aspect: float) -> np.ndarray:
    """Return pixels u, v, ... (n, 2 m) with every u in square pixels."""
    widened = np.array(coordinates, float)
    widened[:, 0::2] = (widened[:, 0::2] + 0.5) * aspect - 0.5
    return widened
