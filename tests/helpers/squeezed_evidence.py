"""Evidence of images that a recorder squeezed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence


def squeezed(evidence: Evidence, width: int, height: int) -> Evidence:
    """Return evidence as if its images had been scaled to another size; without silhouettes."""
    scale = np.array([width, height]) / evidence.image_size

    def scaled(coordinates: np.ndarray) -> np.ndarray:
        pairs = np.reshape(coordinates, (-1, 2)).astype(float)
        return ((pairs + 0.5) * scale - 0.5).reshape(coordinates.shape)

    return replace(
        evidence,
        image_size=(width, height),
        points_px=scaled(evidence.points_px),
        segments_px=scaled(evidence.segments_px),
        edges_px=scaled(evidence.edges_px),
        still_lines_px=scaled(evidence.still_lines_px),
        outlines_px=evidence.outlines_px[:0],
        outline_vehicles=evidence.outline_vehicles[:0],
        outline_times_s=evidence.outline_times_s[:0],
    )
