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
from autocalib_ros.estimation.people.ground_positions import MAX_PERSON_DISTANCE_HEIGHTS, project_tracks
from autocalib_ros.estimation.people.metric_silhouettes import measure_silhouettes
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
MOTION_CELL = 1.0 / 320
"""Pixel size of the motion mask, as a fraction of the image width."""
MIN_CLEARANCE_CELLS = 2.0
"""Silhouettes closer to each other or to the border, in pixels of the motion mask, may be parts of one body."""
MAX_MOTION_CELL_M = 0.5
"""Largest size of such a pixel on the road at which a width can be measured."""
HEADING_WINDOW_S = 0.5
"""The heading of a silhouette is that of its tracked points within this time."""
MIN_HEADING_SPEED_M_S = 1.0
"""Slower objects have no reliable heading. Judgement."""


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
    whole = near & (silhouettes[:, -1] >= MIN_CLEARANCE_CELLS * cell_px) & ~_fragmented(vehicles, times)
    displacements, displacement_times, displacement_vehicles = _displacements(evidence, camera, normal, height_m)
    found = []
    for rows in group_indices(vehicles, MIN_SILHOUETTES):
        seen = rows[whole[rows]]
        if len(seen) < max(MIN_SILHOUETTES, MIN_WHOLE_FRACTION * near[rows].sum()):
            continue
        own = displacement_vehicles == vehicles[rows[0]]
        if not _at_cycling_speed(displacements[own]):
            continue
        headings = _headings(displacements[own], displacement_times[own], times[seen])
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


def _fragmented(vehicles: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mask (n,) of the silhouettes whose vehicle has others at the same time: they are parts of it."""
    _, groups, counts = np.unique(np.column_stack([vehicles, times]), axis=0, return_inverse=True, return_counts=True)
    return counts[groups.ravel()] > 1


def _displacements(
    evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacements on the road (n, 2) of all points between instants, their times (n,) and vehicles (n,)."""
    ground = project_tracks(evidence, camera, normal, height_m)
    tracks, near = ground.tracks, ground.near
    first = np.flatnonzero((tracks[1:] == tracks[:-1]) & near[1:] & near[:-1])
    displacements = ground.positions_m[first + 1] - ground.positions_m[first]
    times_s = (ground.instants[first] + 0.5) * RESAMPLING_INTERVAL_S
    return displacements, times_s, evidence.track_vehicles[tracks[first]]


def _headings(displacements: np.ndarray, displacement_times: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Heading (n,) at times (n,) of an object with displacements (m, 2) at some times (m,); nan if it hardly moves."""
    headings = np.full(len(times), np.nan)
    for row, time_s in enumerate(times):
        around = np.abs(displacement_times - time_s) < HEADING_WINDOW_S
        if around.any():
            x, y = np.median(displacements[around], axis=0)
            headings[row] = (
                np.arctan2(y, x) if np.hypot(x, y) > MIN_HEADING_SPEED_M_S * RESAMPLING_INTERVAL_S else np.nan
            )
    return headings
