"""Who cycles: told from vehicles by the size of what moves, once lens and plane give it in metres.

A rider is as fast as a car that turns, and points on one say little of its size: few of them are followed, often on a
part of a car alone. What differs from the background is all of it. It tells a rider where it was seen whole several
times and was always narrow: what hides a part of a car, or tears it apart, does not last.
"""

from __future__ import annotations

import numpy as np

from autocalib_ros.estimation.motion.planar_motion import WALKING_SPEED_M_S
from autocalib_ros.estimation.observations.two_frame_windows import (
    RESAMPLING_INTERVAL_S,
    ResampledTracks,
    group_indices,
)
from autocalib_ros.estimation.people.metric_silhouettes import measure_silhouettes
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import ground_points
from autocalib_ros.lens.camera import Camera

RIDER_SIZE_M = (1.75, 0.6)
"""Length and width of a rider with a bicycle; a small car is more than twice as long and as wide."""
RIDER_WIDTH_TOLERANCE = 1.2
"""A rider seems so much broader: elbows, bags, a plane that is a little off; and by a pixel, `MOTION_CELL`, more."""
RIDER_HEIGHT_M = (1.2, 2.5)
"""Heights between which a rider seems to be: from above, what is deep reaches higher up in the image. A lamp or a wheel
alone is lower, the window of a bus higher."""
MAX_CYCLING_SPEED_M_S = 9.0
"""Few cycle faster in a town; who does, and who rides a motorcycle, is a vehicle."""
WIDTH_QUANTILE, SPEED_QUANTILE = 0.9, 0.9
"""Quantiles of widths and of speeds that stand for the largest: one outline or step in ten may be wrong."""
MIN_SILHOUETTES = 4
"""Outlines, seen whole, that tell what somebody is."""
MIN_WHOLE_FRACTION = 0.5
"""Least share of the outlines near enough that are whole: what is mostly hidden is not told."""
MOTION_CELL = 1.0 / 320
"""Side of a pixel in which motion is looked for, share of the image width."""
MIN_CLEARANCE_CELLS = 2.0
"""Outlines nearer to each other than so many such pixels, or to the border, may be of one body."""
MAX_MOTION_CELL_M = 0.5
"""What is so far away that such a pixel is as wide as a rider has no width."""
MAX_RIDER_DISTANCE_HEIGHTS = 8.0
"""Heights of the camera from its foot beyond which a pixel is worth too many metres."""
HEADING_WINDOW_S = 0.5
"""An outline goes where its points went within so long."""
MIN_HEADING_SPEED_M_S = 1.0
"""Who is slower has no sure heading."""


def cyclists(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Numbers of those, of `evidence.track_vehicles`, that cycle, ascending.

    Who is seen too briefly, too far away or seldom whole counts as a vehicle, and so do several who ride side by side.
    A motorcycle that goes no faster cannot be told from a bicycle.
    """
    outlines, owners, times = evidence.outlines_px, evidence.outline_vehicles, evidence.outline_times_s
    if len(outlines) < MIN_SILHOUETTES:
        return np.zeros(0, int)
    sizes = measure_silhouettes(outlines, camera, normal, height_m)
    side = MOTION_CELL * evidence.image_size[0]
    grain_m = side * sizes.width / np.maximum(np.ptp(outlines[:, :-1:2], axis=1), side)
    near = (sizes.distance < MAX_RIDER_DISTANCE_HEIGHTS * height_m) & (grain_m < MAX_MOTION_CELL_M)
    whole = near & (outlines[:, -1] >= MIN_CLEARANCE_CELLS * side) & ~_fragmented(owners, times)
    steps, at_s, of_step = _displacements(evidence, camera, normal, height_m)
    found = []
    for rows in group_indices(owners, MIN_SILHOUETTES):
        known = rows[whole[rows]]
        if len(known) < max(MIN_SILHOUETTES, MIN_WHOLE_FRACTION * near[rows].sum()):
            continue
        mine = of_step == owners[rows[0]]
        ways, ways_s = steps[mine], at_s[mine]
        if (
            not len(ways)
            or not WALKING_SPEED_M_S
            < np.quantile(np.hypot(*ways.T), SPEED_QUANTILE) / RESAMPLING_INTERVAL_S
            < MAX_CYCLING_SPEED_M_S
        ):
            continue
        headings = _headings(ways, ways_s, times[known])
        sure = np.isfinite(headings)
        across = np.abs(np.sin(headings[sure] - sizes.azimuth[known[sure]]))
        broadest_m = (
            RIDER_WIDTH_TOLERANCE * (RIDER_SIZE_M[0] * across + RIDER_SIZE_M[1] * np.sqrt(1.0 - across**2))
            + grain_m[known[sure]]
        )
        if (
            len(across) >= MIN_SILHOUETTES
            and np.quantile(sizes.width[known[sure]] / broadest_m, WIDTH_QUANTILE) < 1.0
            and (RIDER_HEIGHT_M[0] < np.median(sizes.height[known[sure]]) < RIDER_HEIGHT_M[1])
        ):
            found.append(int(owners[rows[0]]))
    return np.array(found, int)


def _fragmented(owners: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mask (n,) of the outlines beside others of the same vehicle at the same time: it is torn apart."""
    _, kinds, counts = np.unique(np.column_stack([owners, times]), axis=0, return_inverse=True, return_counts=True)
    return counts[kinds.ravel()] > 1


def _displacements(
    evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ways on the road (n, 2) of all points from one instant to the next, their times (n,) and vehicles (n,)."""
    instants = ResampledTracks(evidence)
    pixels, starts = instants.all()
    places = ground_points(camera, normal, height_m, pixels)
    near = np.hypot(*places.T) < MAX_RIDER_DISTANCE_HEIGHTS * height_m
    tracks = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    begin = np.flatnonzero((tracks[1:] == tracks[:-1]) & near[1:] & near[:-1])
    ordinal = instants.begin[tracks[begin]] + begin - starts[tracks[begin]]
    return (
        places[begin + 1] - places[begin],
        (ordinal + 0.5) * RESAMPLING_INTERVAL_S,
        evidence.track_vehicles[tracks[begin]],
    )


def _headings(ways: np.ndarray, ways_s: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Heading (n,) at times (n,) of what went `ways` (m, 2) at `ways_s` (m,); nan where it hardly moves."""
    headings = np.full(len(times), np.nan)
    for row, time_s in enumerate(times):
        around = np.abs(ways_s - time_s) < HEADING_WINDOW_S
        if around.any():
            x, y = np.median(ways[around], axis=0)
            headings[row] = (
                np.arctan2(y, x) if np.hypot(x, y) > MIN_HEADING_SPEED_M_S * RESAMPLING_INTERVAL_S else np.nan
            )
    return headings
