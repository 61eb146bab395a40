"""Evidence of a made-up junction with known truth, without images: for tests and Monte-Carlo studies."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from autocalib_ros.camera import Camera
from autocalib_ros.config import BufferOptions
from autocalib_ros.evidence import Evidence, EvidenceBuffer, Segments, Track

INTERVAL_S = 0.1
SEGMENT_INTERVAL_S = 0.4
MIN_LENGTH_PX = 25.0
LANE_M = 3.5


def pose(tilt_deg: float, roll_deg: float, heading_deg: float) -> np.ndarray:
    """Return camera_from_ground (3, 3): ground x is `heading_deg` to the left of where the camera looks."""
    tilt, roll, heading = np.radians([tilt_deg, roll_deg, heading_deg])
    level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # from x ahead, y left, z up
    pitch = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    about_axis = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    turn = np.array([[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    return about_axis @ pitch @ level @ turn


@dataclass(frozen=True, kw_only=True)
class Junction:
    """What is seen, and how badly."""

    camera: Camera = field(default_factory=lambda: Camera(1280, 720, 560.0, (639.5, 359.5)))
    camera_from_ground: np.ndarray = field(default_factory=lambda: pose(32.0, 1.0, 35.0))
    height_m: float = 8.0
    centre_m: tuple[float, float] = (18.0, -12.0)
    """Where the roads cross, relative to the camera's foot point in the ground frame."""
    road_angles_deg: tuple[float, ...] = (0.0, 90.0)
    vehicles: int = 60
    points_per_vehicle: int = 4
    turning_share: float = 0.2
    wander_m: float = 0.1
    noise_px: float = 0.5

    @property
    def normal_in_camera(self) -> np.ndarray:
        """Upward normal of the road in the camera frame, shape (3,)."""
        return self.camera_from_ground[:, 2]


def synthetic_evidence(junction: Junction, generator: np.random.Generator) -> Evidence:
    """Drive vehicles through the junction and record their points as a tracker would."""
    buffer = EvidenceBuffer(BufferOptions())
    newest = 0.0
    for vehicle in range(junction.vehicles):
        start = 1.5 * vehicle
        path, heading = _drive(junction, generator)
        times = start + INTERVAL_S * np.arange(len(path))
        newest = max(newest, float(times[-1]))
        for _ in range(junction.points_per_vehicle):
            track = _observe(junction, generator, path, heading, times, vehicle)
            if track is not None:
                buffer.add_track(track)
                buffer.add_segments(_segments(track))
    return buffer.snapshot(
        image_size=(junction.camera.width, junction.camera.height), first_stamp_ns=0,
        newest_stamp_ns=int(newest * 1e9), frames=int(newest / INTERVAL_S), drift_px=0.0, unfinished=[])


def _drive(junction: Junction, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n, 2) in metres and headings (n,) in radians of one vehicle, every `INTERVAL_S`."""
    road = np.radians(generator.choice(junction.road_angles_deg))
    way = generator.choice([0.0, np.pi])
    speed = generator.uniform(6.0, 13.0)
    along = np.arange(-45.0, 45.0, speed * INTERVAL_S)
    heading = np.full(len(along), road + way)
    lane = -LANE_M * (generator.integers(2) + 0.5)
    if generator.uniform() < junction.turning_share:
        radius = generator.uniform(8.0, 25.0)
        turned = np.clip((along + radius) / radius, 0.0, np.pi / 2) * generator.choice([-1.0, 1.0])
        heading = heading + turned
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    start = np.array(junction.centre_m) + along[0] * forward[0] + lane * np.array([forward[0, 1], -forward[0, 0]])
    centre = start + np.concatenate([[[0.0, 0.0]], np.cumsum(forward[:-1], axis=0) * speed * INTERVAL_S])
    sway = sum(np.sin(along * 2 * np.pi / generator.uniform(25, 80) + generator.uniform(0, 2 * np.pi))
               for _ in range(2))
    lateral = junction.wander_m * np.asarray(sway)[:, None] * np.column_stack([-forward[:, 1], forward[:, 0]])
    return centre + lateral, heading


def _observe(junction: Junction, generator: np.random.Generator, path: np.ndarray, heading: np.ndarray,
             times: np.ndarray, vehicle: int) -> Track | None:
    """Project one point of the body; keep the longest run inside the image."""
    ahead, left, up = generator.uniform([-2.0, -0.8, 0.2], [2.0, 0.8, 1.6])
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    leftward = np.column_stack([-forward[:, 1], forward[:, 0]])
    ground = path + ahead * forward + left * leftward
    relative = np.column_stack([ground, np.full(len(ground), up - junction.height_m)])
    pixels, valid = junction.camera.project(relative @ junction.camera_from_ground.T)
    size = (junction.camera.width, junction.camera.height)
    seen = valid & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1) & (np.hypot(*ground.T) < 60.0)
    first, last = _longest_run(seen)
    points = pixels[first:last] + generator.normal(scale=junction.noise_px, size=(last - first, 2))
    if len(points) < 8 or np.hypot(*(points[-1] - points[0])) < MIN_LENGTH_PX:
        return None
    chosen = np.unique(np.round(np.linspace(0, len(points) - 1, 32)).astype(int))
    return Track(vehicle, times[first:last][chosen], points[chosen])


def _longest_run(seen: np.ndarray) -> tuple[int, int]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
    if not len(edges):
        return 0, 0
    runs = edges.reshape(-1, 2)
    first, last = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(first), int(last)


def _segments(track: Track) -> Segments:
    """Pairs of positions `SEGMENT_INTERVAL_S` apart, as matches between masked frames would give."""
    later = np.searchsorted(track.times_s, track.times_s + SEGMENT_INTERVAL_S - 1e-6)
    paired = later < len(track.times_s)
    ends = np.hstack([track.points_px[paired], track.points_px[later[paired]]])
    return Segments(float(track.times_s[-1]), np.full(len(ends), track.vehicle), ends)
