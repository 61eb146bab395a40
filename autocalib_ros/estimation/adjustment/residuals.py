"""Residuals of a solution in observed pixels, for the report."""

from __future__ import annotations

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.results.calibration import Residuals

TURNING_VEHICLE = -1
"""Road label of turning vehicles."""


def collect_residuals(fit: Adjustment) -> Residuals:
    """Collect the residuals of inlier tracks and of turning vehicles."""
    problem = fit.problem
    points, distance, track = problem.straight.distances_px()
    rows = problem.used[track]
    kept = fit.inliers()[rows]
    parts = [(points[kept], distance[kept], fit.labels[rows[kept]])]
    for block in problem.turning_blocks:
        points, distance = block.distances_px()
        parts.append((points, distance, np.full(len(points), TURNING_VEHICLE)))
    points, distance, roads = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Residuals(points.astype(np.float32), distance.astype(np.float32), roads.astype(np.int8))
