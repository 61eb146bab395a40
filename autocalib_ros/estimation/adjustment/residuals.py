"""What a solution leaves unexplained, in observed pixels, for people to look at."""

from __future__ import annotations

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.results.calibration import Residuals

TURNING_VEHICLE = -1
"""Stands for the road of what turns."""


def collect_residuals(fit: Adjustment) -> Residuals:
    """Gather the residuals of the tracks that a solution explains, and of the vehicles that turn."""
    on_roads, *turning = fit.problem.blocks
    points, distance, track = on_roads.distances_px()
    rows = fit.problem.used[track]
    kept = fit.inliers()[rows]
    parts = [(points[kept], distance[kept], fit.labels[rows[kept]])]
    for kind in turning:
        points, distance = kind.distances_px()
        parts.append((points, distance, np.full(len(points), TURNING_VEHICLE)))
    points, distance, roads = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Residuals(points.astype(np.float32), distance.astype(np.float32), roads.astype(np.int8))
