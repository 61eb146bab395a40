"""Classify cyclists by the metric size of their silhouettes, once lens and plane are known.

A cyclist is as fast as a turning car, and tracked points say little about size: few of them are tracked, and on a car
often on one part only. Foreground silhouettes cover the whole body. An object is a cyclist if it was seen whole
several times and was always narrow: what hides or splits a car does not last.
"""

from __future__ import annotations

import numpy as np

from autocalib_ros.estimation.motion.planar_motion import WALKING_SPEED_M_S
from autocalib_ros.estimation.observations.grouping import group_indices
from autocalib_ros.estimation.observations.two_frame_windows import RESAMPLING_INTERVAL_S
from autocalib_ros.estimation.people.ground_positions import MAX_PERSON_DISTANCE_HEIGHTS
from autocalib_ros.estimation.people.metric_silhouettes import measure_silhouettes
from autocalib_ros.estimation.people.silhouette_headings import MOTION_CELL, RoadDisplacements, are_whole
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera

RIDER_SIZE_M = (1.75, 0.6)
"""Length and width of a rider with a bicycle; a small car is more than twice as long and wide."""
RIDER_WIDTH_TOLERANCE = 1.2
"""Factor by which a rider may appear wider, besides one `MOTION_CELL`: elbows, bags, an error of the plane.
Judgement."""
RIDER_HEIGHT_M = (1.2, 2.5)
"""Range of the apparent height of a rider: seen from above, depth adds to it. A lamp or a wheel alone is lower, the
window of a bus higher."""
MAX_CYCLING_SPEED_M_S = 9.0
"""Few cyclists are faster in a town; faster ones and motorcycles count as vehicles."""
WIDTH_QUANTILE, SPEED_QUANTILE = 0.9, 0.9
"""Quantiles used as the largest width and the largest speed: one silhouette or step in ten may be wrong."""
MIN_SILHOUETTES = 4
"""Whole silhouettes needed to classify an object. Judgement."""
MIN_WHOLE_FRACTION = 0.5
"""Fraction of the near silhouettes that must be whole; mostly hidden objects are not classified. Judgement."""
MAX_MOTION_CELL_M = 0.5
"""Largest size of such a pixel on the road at which a width can be measured."""


def find_cyclists(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Return the cyclists among `evidence.track_vehicles`, ascending.

    What is seen too briefly, too far away or seldom whole counts as a vehicle, and so do cyclists side by side. A slow
    motorcycle cannot be distinguished from a bicycle.
    """
    silhouettes, vehicles, times = evidence.outlines_px, evidence.outline_vehicles, evidence.outline_times_s
    if len(silhouettes) < MIN_SILHOUETTES:
        return np.zeros(0, int)
    sizes = measure_silhouettes(silhouettes, camera, normal, height_m)
    cell_px = MOTION_CELL * evidence.image_size[0]
    cell_m = cell_px * sizes.width / np.maximum(np.ptp(silhouettes[:, :-1:2], axis=1), cell_px)
    near = (sizes.distance < MAX_PERSON_DISTANCE_HEIGHTS * height_m) & (cell_m < MAX_MOTION_CELL_M)
    whole = near & are_whole(evidence)
    moves = RoadDisplacements.of(evidence, camera, normal, height_m)
    found = []
    for rows in group_indices(vehicles, MIN_SILHOUETTES):
        seen = rows[whole[rows]]
        if len(seen) < max(MIN_SILHOUETTES, MIN_WHOLE_FRACTION * near[rows].sum()):
            continue
        own = moves.of_vehicle(vehicles[rows[0]])
        if not _at_cycling_speed(own.displacements_m):
            continue
        headings = own.headings_at(times[seen])
        moving = np.isfinite(headings)
        seen, headings = seen[moving], headings[moving]
        if len(seen) >= MIN_SILHOUETTES and _of_rider_size(
            sizes.width[seen], sizes.height[seen], headings - sizes.azimuth[seen], cell_m[seen]
        ):
            found.append(int(vehicles[rows[0]]))
    return np.array(found, int)


def _at_cycling_speed(displacements: np.ndarray) -> bool:
    """Whether displacements (n, 2) within one interval are faster than walking and no faster than cycling."""
    if not len(displacements):
        return False
    speed_m_s = np.quantile(np.hypot(*displacements.T), SPEED_QUANTILE) / RESAMPLING_INTERVAL_S
    return bool(WALKING_SPEED_M_S < speed_m_s < MAX_CYCLING_SPEED_M_S)


def _of_rider_size(width_m: np.ndarray, height_m: np.ndarray, aspect_rad: np.ndarray, cell_m: np.ndarray) -> bool:
    """Whether silhouettes (n,), seen under an angle from their heading, are as wide and high as a rider."""
    across = np.abs(np.sin(aspect_rad))
    length_m, breadth_m = RIDER_SIZE_M
    largest_m = RIDER_WIDTH_TOLERANCE * (length_m * across + breadth_m * np.sqrt(1.0 - across**2)) + cell_m
    narrow = np.quantile(width_m / largest_m, WIDTH_QUANTILE) < 1.0
    return bool(narrow and RIDER_HEIGHT_M[0] < np.median(height_m) < RIDER_HEIGHT_M[1])
