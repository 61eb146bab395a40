"""Who walks or cycles: told from vehicles once lens and plane give speeds, ways and sizes in metres.

The ground plane is then solved once more without them: they sway, keep to no lane and turn on the spot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.motion.planar_motion import WALKING_SPEED_M_S
from autocalib_ros.estimation.observations.two_frame_windows import (
    RESAMPLING_INTERVAL_S,
    ResampledTracks,
    group_indices,
)
from autocalib_ros.estimation.people.cyclists import MAX_RIDER_DISTANCE_HEIGHTS, cyclists
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import ground_points
from autocalib_ros.lens.camera import Camera

MAX_PEDESTRIAN_WIDTH_M = 0.8
"""Nobody is wider, seen from anywhere; a car is twice as wide. People in a group are."""
MIN_GROUP_PATH_M = 6.0
"""A vehicle that goes on for as far as from one to the next in a queue gets faster than people walk."""
MIN_PATH_M = 2.0
"""What was seen over a shorter way is not told: a vehicle that stops, or that leaves the view."""
SPEED_INTERVALS = 3
"""Of `RESAMPLING_INTERVAL_S`: the time over which speed is taken; the noise of the places is small over so long."""
FLOW_QUANTILE, MIN_FLOW_RATIO = 0.75, 2.0
"""Traffic flows when this quantile of the highest speeds of all movers is so many times that of who walks."""


@dataclass(frozen=True)
class MovingObject:
    """Something that moved, in metres on the road."""

    speed_m_s: float
    """Highest speed, 0 where it was seen too briefly."""
    width_m: float
    """Across the line of sight, where two points and more of it are seen."""
    path_m: float
    """The farthest that one of its points went."""

    def is_pedestrian(self, *, groups: bool) -> bool:
        """Whether it is one who walks, or, where these can be told, several together."""
        slow = 0 < self.speed_m_s < WALKING_SPEED_M_S and self.path_m >= MIN_PATH_M
        return slow and (self.width_m < MAX_PEDESTRIAN_WIDTH_M or groups and self.path_m >= MIN_GROUP_PATH_M)


def people(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Numbers of those, of `evidence.track_vehicles`, that walk or cycle, ascending."""
    return np.union1d(
        find_pedestrians(evidence, camera, normal, height_m), cyclists(evidence, camera, normal, height_m)
    )


def find_pedestrians(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Numbers of those, of `evidence.track_vehicles`, that walk, ascending.

    What is seen too briefly or too far away to be told counts as a vehicle. Groups are told by going on slowly, which
    says nothing where all the traffic crawls.
    """
    instants = ResampledTracks(evidence)
    pixels, starts = instants.all()
    places = ground_points(camera, normal, height_m, pixels)
    near = np.hypot(*places.T) < MAX_RIDER_DISTANCE_HEIGHTS * height_m
    times = np.arange(len(places)) + np.repeat(instants.begin - starts[:-1], np.diff(starts))
    paths = [np.arange(*ends)[near[slice(*ends)]] for ends in zip(starts[:-1], starts[1:], strict=True)]
    groups = group_indices(evidence.track_vehicles)
    moving_objects = [_measure(places, times, [paths[track] for track in tracks]) for tracks in groups]
    speeds = np.array([moving.speed_m_s for moving in moving_objects if moving.speed_m_s > 0])
    flows = len(speeds) > 0 and bool(np.quantile(speeds, FLOW_QUANTILE) > MIN_FLOW_RATIO * WALKING_SPEED_M_S)
    return np.array(
        [
            evidence.track_vehicles[tracks[0]]
            for tracks, moving in zip(groups, moving_objects, strict=True)
            if moving.is_pedestrian(groups=flows)
        ],
        int,
    )


def _measure(places: np.ndarray, times: np.ndarray, paths: list[np.ndarray]) -> MovingObject:
    """Measure what has some paths, indices of places (n, 2) on the road at times (n,) in intervals."""
    speed, way = 0.0, 0.0
    for path in paths:
        if len(path) > SPEED_INTERVALS:
            steps = np.hypot(*(places[path[SPEED_INTERVALS:]] - places[path[:-SPEED_INTERVALS]]).T)
            speed = max(
                speed,
                float((steps / (times[path[SPEED_INTERVALS:]] - times[path[:-SPEED_INTERVALS]])).max())
                / RESAMPLING_INTERVAL_S,
            )
            way = max(way, float(np.hypot(*(places[path[-1]] - places[path[0]]))))
    own = np.concatenate(paths)
    spans = [_width_across(places[own[together]]) for together in group_indices(times[own], 2)]
    return MovingObject(speed, float(np.median(spans)) if spans else 0.0, way)


def _width_across(places: np.ndarray) -> float:
    """Width in metres across the line of sight of places (n, 2) on the road from the camera's foot."""
    middle = places.mean(axis=0)
    across = np.array([-middle[1], middle[0]]) / max(float(np.hypot(*middle)), 1e-9)
    return float(np.ptp(places @ across))
