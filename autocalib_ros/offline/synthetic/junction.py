"""Synthetic evidence of a junction with ground truth, without images: for tests and Monte-Carlo studies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import make_interp_spline

from autocalib_ros.config import BufferOptions
from autocalib_ros.errors import UsageError
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence, Segments, Track
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.disturbances import Sway, background_drift_px, corrupt_track
from autocalib_ros.offline.synthetic.drives import (
    INTERVAL_S,
    LANE_M,
    Companion,
    Drive,
    beside,
    drive_across,
)

SEGMENT_INTERVAL_S = 0.4
MIN_TRACK_LENGTH_PX = 25.0
MIN_TRACK_POINTS = 8
MAX_TRACK_POINTS = 100
MAX_TRACKED_RANGE_M = 60.0
"""Points farther from the camera are not tracked: they are too small in the image."""
HEADWAY_S = 1.5
MAX_VEHICLES_PER_TRACK = 100
"""Limit of vehicles per wanted track: if more are needed, the junction is out of view."""


def pose(tilt_deg: float, roll_deg: float, heading_deg: float) -> np.ndarray:
    """Return camera_from_ground (3, 3): ground x points `heading_deg` to the left of the viewing direction."""
    tilt, roll, heading = np.radians([tilt_deg, roll_deg, heading_deg])
    level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # from x ahead, y left, z up
    pitch = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    about_axis = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    turn = np.array([[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    return about_axis @ pitch @ level @ turn


@dataclass(frozen=True, kw_only=True)
class Junction:
    """Camera, roads, traffic, and disturbances of a synthetic scene."""

    camera: Camera = field(default_factory=lambda: Camera(1280, 720, 560.0, (639.5, 359.5)))
    camera_from_ground: np.ndarray = field(default_factory=lambda: pose(32.0, 1.0, 35.0))
    height_m: float = 8.0
    centre_m: tuple[float, float] = (18.0, -12.0)
    """Crossing of the roads in the ground frame, whose origin is the point below the camera."""
    road_angles_deg: tuple[float, ...] = (0.0, 90.0)
    lanes_m: tuple[float, ...] = (0.5 * LANE_M, 1.5 * LANE_M)
    """Offsets of the lanes to the right of the middle of the road."""
    drive: Drive = drive_across
    """Trajectory model of the road users."""
    vehicles: int = 60
    tracks: int | None = None
    """If set, simulate until exactly this number of tracks is recorded and ignore `vehicles`."""
    points_per_vehicle: int = 4
    headway_s: float = HEADWAY_S
    """Time between vehicles."""
    turning_fraction: float = 0.2
    lane_change_fraction: float = 0.0
    merged_fraction: float = 0.0
    """Fraction of the vehicles that are merged with a companion into one vehicle."""
    companion: Companion = beside
    """Trajectory of the companion: a vehicle in the adjacent lane, a trailer, or a shadow."""
    wander_m: float = 0.1
    noise_px: float = 0.5
    outlier_fraction: float = 0.0
    """Fraction of the tracks that are gross outliers."""
    visible_columns_px: tuple[float, float] | None = None
    """Range of columns in which the road is visible; None for all."""
    sway: Sway | None = None
    """Motion of the camera about `camera_from_ground`; None if it stands still."""

    @property
    def normal_in_camera(self) -> np.ndarray:
        """Upward normal of the road in the camera frame, shape (3,)."""
        return self.camera_from_ground[:, 2]

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.camera.width, self.camera.height


def synthetic_evidence(junction: Junction, generator: np.random.Generator) -> Evidence:
    """Simulate vehicles on the junction and return the tracks of their points as evidence."""
    tracks: list[Track] = []
    newest = 0.0
    for vehicle in _vehicles(junction, tracks):
        path, heading = junction.drive(junction, generator)
        times = junction.headway_s * vehicle + INTERVAL_S * np.arange(len(path))
        newest = max(newest, float(times[-1]))
        bodies = [(path, heading)]
        if junction.merged_fraction and generator.uniform() < junction.merged_fraction:
            bodies.append(junction.companion(path, heading, generator))
        for number in range(junction.points_per_vehicle):
            track = _observe(junction, generator, *bodies[number % len(bodies)], times, vehicle)
            if track is not None and len(tracks) != junction.tracks:
                tracks.append(track)
    drift = 0.0 if junction.sway is None else background_drift_px(junction.camera, junction.sway, newest)
    return evidence_from_tracks(tracks, junction.image_size, newest, drift)


def evidence_from_tracks(
    tracks: list[Track], image_size: tuple[int, int], newest_s: float, drift_px: float = 0.0
) -> Evidence:
    """Return evidence with the given tracks and the segments that keypoint matching would give for them."""
    buffer = EvidenceBuffer(BufferOptions())
    for track in tracks:
        buffer.add_track(track)
    for segments in _segments(tracks):
        buffer.add_segments(segments)
    return buffer.snapshot(
        image_size=image_size,
        first_stamp_ns=0,
        newest_stamp_ns=int(newest_s * 1e9),
        frames=int(newest_s / INTERVAL_S),
        drift_px=drift_px,
        unfinished=[],
    )


def _vehicles(junction: Junction, tracks: list[Track]) -> Iterator[int]:
    """Yield vehicle ids: `vehicles` of them, or until the wanted number of tracks is reached."""
    if junction.tracks is None:
        yield from range(junction.vehicles)
        return
    for vehicle in range(MAX_VEHICLES_PER_TRACK * junction.tracks):
        if len(tracks) == junction.tracks:
            return
        yield vehicle
    raise UsageError(
        f'{MAX_VEHICLES_PER_TRACK * junction.tracks} vehicles left {len(tracks)} tracks of the '
        f'{junction.tracks} wanted: the road is out of view'
    )


def _observe(
    junction: Junction,
    generator: np.random.Generator,
    path: np.ndarray,
    heading: np.ndarray,
    times: np.ndarray,
    vehicle: int,
) -> Track | None:
    """Return the track of one random point of a body: its longest visible run, or None if that is too short."""
    ahead, left, up = generator.uniform([-2.0, -0.8, 0.2], [2.0, 0.8, 1.6])
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    leftward = np.column_stack([-forward[:, 1], forward[:, 0]])
    ground = path + ahead * forward + left * leftward
    relative = np.column_stack([ground, np.full(len(ground), up - junction.height_m)])
    pixels, valid = junction.camera.project(_bearings(junction, relative, times))
    seen = valid & (pixels >= 0).all(axis=1) & (pixels < junction.image_size).all(axis=1)
    seen &= np.hypot(*ground.T) < MAX_TRACKED_RANGE_M
    if junction.visible_columns_px is not None:
        seen &= (pixels[:, 0] >= junction.visible_columns_px[0]) & (pixels[:, 0] < junction.visible_columns_px[1])
    first, last = _longest_run(seen)
    points = pixels[first:last] + generator.normal(scale=junction.noise_px, size=(last - first, 2))
    if (
        len(points) >= MIN_TRACK_POINTS
        and junction.outlier_fraction
        and generator.uniform() < junction.outlier_fraction
    ):
        points = corrupt_track(points, junction.image_size, generator)
    if len(points) < MIN_TRACK_POINTS or np.hypot(*(points[-1] - points[0])) < MIN_TRACK_LENGTH_PX:
        return None
    chosen = np.unique(np.round(np.linspace(0, len(points) - 1, MAX_TRACK_POINTS)).astype(int))
    return Track(vehicle, times[first:last][chosen], points[chosen])


def _bearings(junction: Junction, relative_m: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Rotate points (n, 3) relative to the camera from ground axes into the camera frame at times (n,)."""
    steady = relative_m @ junction.camera_from_ground.T
    return steady if junction.sway is None else np.einsum('nij,nj->ni', junction.sway(times_s), steady)


def _longest_run(seen: np.ndarray) -> tuple[int, int]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
    if not len(edges):
        return 0, 0
    runs = edges.reshape(-1, 2)
    first, last = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(first), int(last)


def _segments(tracks: list[Track]) -> Iterator[Segments]:
    """Yield the displacements of the points of all tracks between consecutive keypoint frames, frame by frame."""
    times_s, vehicles, ends_px = [np.zeros(0)], [np.zeros(0, int)], [np.zeros((0, 4))]
    for track in tracks:
        first, last = np.ceil(track.times_s[0] / SEGMENT_INTERVAL_S), np.floor(track.times_s[-1] / SEGMENT_INTERVAL_S)
        frames = np.arange(first, last + 1) * SEGMENT_INTERVAL_S
        places = make_interp_spline(track.times_s, track.points_px)(frames)
        times_s.append(frames[1:])
        vehicles.append(np.full(len(frames[1:]), track.vehicle))
        ends_px.append(np.hstack([places[:-1], places[1:]]))
    time_s, vehicle, ends = np.concatenate(times_s), np.concatenate(vehicles), np.concatenate(ends_px)
    in_order = np.argsort(time_s, kind='stable')
    for frame in np.split(in_order, np.flatnonzero(np.diff(time_s[in_order])) + 1):
        if len(frame):
            yield Segments(float(time_s[frame[0]]), vehicle[frame], ends[frame])
