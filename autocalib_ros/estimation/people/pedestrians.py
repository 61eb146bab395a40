"""Classify pedestrians and cyclists by metric size and speed, once lens and plane are known.

The ground plane is then solved again without them: they sway, keep to no lane and turn on the spot.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from autocalib_ros.estimation.motion.planar_motion import WALKING_SPEED_M_S
from autocalib_ros.estimation.observations.grouping import group_indices
from autocalib_ros.estimation.observations.two_frame_windows import RESAMPLING_INTERVAL_S
from autocalib_ros.estimation.people.cyclists import find_cyclists
from autocalib_ros.estimation.people.ground_positions import GroundPositions, project_tracks
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera

MAX_PEDESTRIAN_WIDTH_M = 0.8
"""Largest width of a pedestrian from any side; a car is twice as wide. Groups of people may be wider."""
MIN_GROUP_PATH_M = 6.0
"""A vehicle that moves this far, the distance between two in a queue, exceeds walking speed."""
MIN_PATH_M = 2.0
"""Shorter paths are not classified: a vehicle that stops or leaves the view. Judgement."""
SPEED_INTERVALS = 3
"""Intervals of `RESAMPLING_INTERVAL_S` over which speed is measured; position noise is small over that time."""
FLOW_QUANTILE, MIN_FLOW_RATIO = 0.75, 2.0
"""Traffic is flowing if this quantile of the highest speeds of all objects exceeds this multiple of walking speed.
Judgement."""


@dataclass(frozen=True)
class MovingObject:
    """A moving object, in metres on the road."""

    speed_m_s: float
    """Highest speed, 0 if it was seen too briefly."""
    width_m: float
    """Width across the line of sight, where at least two of its points are seen."""
    path_m: float
    """Largest displacement of any of its points."""

    def is_pedestrian(self, *, groups: bool) -> bool:
        """Whether it is a pedestrian or, with `groups`, several pedestrians together."""
        slow = 0 < self.speed_m_s < WALKING_SPEED_M_S and self.path_m >= MIN_PATH_M
        return slow and (self.width_m < MAX_PEDESTRIAN_WIDTH_M or (groups and self.path_m >= MIN_GROUP_PATH_M))


def people(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Return the pedestrians and cyclists among `evidence.track_vehicles`, ascending."""
    return np.union1d(
        find_pedestrians(evidence, camera, normal, height_m), find_cyclists(evidence, camera, normal, height_m)
    )


def find_pedestrians(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Return the pedestrians among `evidence.track_vehicles`, ascending.

    What is seen too briefly or too far away counts as a vehicle. Groups are recognised by a long slow path, which
    means nothing while all traffic crawls.
    """
    ground = project_tracks(evidence, camera, normal, height_m)
    paths = [np.arange(begin, end)[ground.near[begin:end]] for begin, end in pairwise(ground.offsets)]
    groups = group_indices(evidence.track_vehicles)
    moving_objects = [_measure(ground, [paths[track] for track in tracks]) for tracks in groups]
    speeds = np.array([moving.speed_m_s for moving in moving_objects if moving.speed_m_s > 0])
    flowing = len(speeds) > 0 and bool(np.quantile(speeds, FLOW_QUANTILE) > MIN_FLOW_RATIO * WALKING_SPEED_M_S)
    return np.array(
        [
            evidence.track_vehicles[tracks[0]]
            for tracks, moving in zip(groups, moving_objects, strict=True)
            if moving.is_pedestrian(groups=flowing)
        ],
        int,
    )


def _measure(ground: GroundPositions, paths: list[np.ndarray]) -> MovingObject:
    """Measure an object with some paths, each of them indices of positions on the road."""
    positions, instants = ground.positions_m, ground.instants
    speed, length = 0.0, 0.0
    for path in paths:
        if len(path) > SPEED_INTERVALS:
            before, after = path[:-SPEED_INTERVALS], path[SPEED_INTERVALS:]
            steps = np.hypot(*(positions[after] - positions[before]).T)
            speed = max(speed, float((steps / (instants[after] - instants[before])).max()) / RESAMPLING_INTERVAL_S)
            length = max(length, float(np.hypot(*(positions[path[-1]] - positions[path[0]]))))
    own = np.concatenate(paths)
    widths = _widths_across(positions[own], instants[own])
    return MovingObject(speed, float(np.median(widths)) if len(widths) else 0.0, length)


def _widths_across(positions: np.ndarray, instants: np.ndarray) -> np.ndarray:
    """Widths in metres, across the line of sight, at each instant that several positions show.

    Positions (n, 2) are on the road relative to the camera's foot, at instants (n,).
    """
    order = np.argsort(instants, kind='stable')
    starts = np.flatnonzero(np.diff(instants[order], prepend=np.nan))
    if not len(starts):
        return np.zeros(0)
    positions, counts = positions[order], np.diff(starts, append=len(order))
    middles = np.add.reduceat(positions, starts) / counts[:, None]
    across = np.column_stack([-middles[:, 1], middles[:, 0]]) / np.maximum(np.hypot(*middles.T), 1e-9)[:, None]
    places = (positions * np.repeat(across, counts, axis=0)).sum(axis=1)
    return (np.maximum.reduceat(places, starts) - np.minimum.reduceat(places, starts))[counts > 1]
