"""Who walks or cycles: told from vehicles once lens and plane give speeds, ways and sizes in metres.

The ground plane is then solved once more without them: they sway, keep to no lane and turn on the spot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.motion.planar_motion import WALK_M_S
from autocalib_ros.estimation.observations.two_frame_windows import INTERVAL_S, Instants, members_of
from autocalib_ros.estimation.people.cyclists import BELIEVED, cyclists
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import ground_points
from autocalib_ros.lens.camera import Camera

NARROW_M = 0.8
"""Nobody is wider, seen from anywhere; a car is twice as wide. People in a group are."""
STROLL_M = 6.0
"""A vehicle that goes on for as far as from one to the next in a queue gets faster than people walk."""
LEAST_WAY_M = 2.0
"""What was seen over a shorter way is not told: a vehicle that stops, or that leaves the view."""
INTERVALS = 3
"""Of `INTERVAL_S`: the time over which speed is taken; the noise of the places is small over so long."""
FASTER, FLOWS = 0.75, 2.0
"""Traffic flows when this quantile of the highest speeds of all movers is so many times that of who walks."""


@dataclass(frozen=True)
class Mover:
    """Something that moved, in metres on the road."""

    speed_m_s: float
    """Highest speed, 0 where it was seen too briefly."""
    width_m: float
    """Across the line of sight, where two points and more of it are seen."""
    way_m: float
    """The farthest that one of its points went."""

    def walks(self, *, groups: bool) -> bool:
        """Whether it is one who walks, or, where these can be told, several together."""
        slow = 0 < self.speed_m_s < WALK_M_S and self.way_m >= LEAST_WAY_M
        return slow and (self.width_m < NARROW_M or groups and self.way_m >= STROLL_M)


def people(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Numbers of those, of `evidence.track_vehicles`, that walk or cycle, ascending."""
    return np.union1d(walkers(evidence, camera, normal, height_m), cyclists(evidence, camera, normal, height_m))


def walkers(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
    """Numbers of those, of `evidence.track_vehicles`, that walk, ascending.

    What is seen too briefly or too far away to be told counts as a vehicle. Groups are told by going on slowly, which
    says nothing where all the traffic crawls.
    """
    instants = Instants(evidence)
    pixels, starts = instants.all()
    places = ground_points(camera, normal, height_m, pixels)
    near = np.hypot(*places.T) < BELIEVED * height_m
    times = np.arange(len(places)) + np.repeat(instants.begin - starts[:-1], np.diff(starts))
    paths = [np.arange(*ends)[near[slice(*ends)]] for ends in zip(starts[:-1], starts[1:], strict=True)]
    groups = members_of(evidence.track_vehicles)
    movers = [_mover(places, times, [paths[track] for track in tracks]) for tracks in groups]
    speeds = np.array([mover.speed_m_s for mover in movers if mover.speed_m_s > 0])
    flows = len(speeds) > 0 and bool(np.quantile(speeds, FASTER) > FLOWS * WALK_M_S)
    return np.array([evidence.track_vehicles[tracks[0]] for tracks, mover in zip(groups, movers, strict=True)
                     if mover.walks(groups=flows)], int)


def _mover(places: np.ndarray, times: np.ndarray, paths: list[np.ndarray]) -> Mover:
    """Measure what has some paths, indices of places (n, 2) on the road at times (n,) in intervals."""
    speed, way = 0.0, 0.0
    for path in paths:
        if len(path) > INTERVALS:
            steps = np.hypot(*(places[path[INTERVALS:]] - places[path[:-INTERVALS]]).T)
            speed = max(speed, float((steps / (times[path[INTERVALS:]] - times[path[:-INTERVALS]])).max()) / INTERVAL_S)
            way = max(way, float(np.hypot(*(places[path[-1]] - places[path[0]]))))
    own = np.concatenate(paths)
    spans = [_span(places[own[together]]) for together in members_of(times[own], 2)]
    return Mover(speed, float(np.median(spans)) if spans else 0.0, way)


def _span(places: np.ndarray) -> float:
    """Width in metres across the line of sight of places (n, 2) on the road from the camera's foot."""
    middle = places.mean(axis=0)
    across = np.array([-middle[1], middle[0]]) / max(float(np.hypot(*middle)), 1e-9)
    return float(np.ptp(places @ across))
