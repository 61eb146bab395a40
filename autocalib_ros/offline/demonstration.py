"""Demonstration: simulate traffic, calibrate from it and compare with the ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from autocalib_ros.config import Options, ScaleOptions
from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import angles_deg
from autocalib_ros.offline.ground_truth import (
    MAX_COMPARED_RANGE_M,
    distance_error_percent,
    nearby_road_points,
)
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulated_recording import SimulatedRecording
from autocalib_ros.pictures.showcase import showcase
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.saved_camera import SavedCamera
from autocalib_ros.util.files import write_picture_bytes

PICTURE, PICTURE_QUALITY = 'picture.jpg', 90
MAX_FOCAL_ERROR_PERCENT = 3.0
MAX_NORMAL_ERROR_DEG = 1.0
MAX_ROAD_ANGLE_DEG, MAX_DETOUR_RATIO = 6.0, 1.05
"""A vehicle follows a road if its displacement is within this angle of it, and its path at most this ratio longer."""
MIN_DISPLACEMENT_M = 10.0


@dataclass(frozen=True)
class TruthErrors:
    """Errors of a calibration against the ground truth; nan without a ground plane."""

    focal_error_percent: float
    normal_deg: float
    height_m: float
    distance_error_percent: float
    """Median error over pairs of road points."""
    height_note: str = 'given'
    """Source of the height: 'given', or its stated standard deviation."""

    @property
    def within_tolerance(self) -> bool:
        """Whether the errors of lens and ground normal are within the limits of the demonstration."""
        return abs(self.focal_error_percent) <= MAX_FOCAL_ERROR_PERCENT and self.normal_deg <= MAX_NORMAL_ERROR_DEG

    def table(self) -> str:
        """Return the errors as text lines for the terminal."""
        rows = (
            ('focal length', f'{self.focal_error_percent:+.2f} %', f'within {MAX_FOCAL_ERROR_PERCENT:g} %'),
            ('ground normal', f'{self.normal_deg:.2f} degrees', f'within {MAX_NORMAL_ERROR_DEG:g} degree'),
            ('camera height', f'{self.height_m:+.3f} m', self.height_note),
            (f'distances within {MAX_COMPARED_RANGE_M:g} m', f'{self.distance_error_percent:.2f} %', 'median'),
        )
        lines = [f'  {name + ":":<26}{error:<16}{note}' for name, error, note in rows]
        return '\n'.join(['Errors against the truth:', *lines])


def simulated(bag: Path, seed: int) -> SimulatedRecording:
    """Return the default scene, simulated into a new bag while it is read.

    Images are stored as JPEG: raw images would take gigabytes.
    """
    return SimulatedRecording(bag, Simulation(SimulationOptions(seed=seed, compressed=True)))


def write_picture(path: Path, found: Calibration, image: np.ndarray) -> bool:
    """Write an image with the grid on the road, and its top view; return False if there is no road to show."""
    if found.ground is None:
        return False
    try:
        picture = showcase(SavedCamera.of(found), image)
    except InputError:
        return False
    _, data = cv2.imencode(path.suffix, picture, [cv2.IMWRITE_JPEG_QUALITY, PICTURE_QUALITY])
    write_picture_bytes(path, data.tobytes())
    return True


def options_from_truth(truth: dict[str, Any], scale_from: str) -> Options:
    """Return options whose metric scale (height, distance on the road, or mean speed) comes from the ground truth."""
    if scale_from == 'distance':
        (x1, y1, *first), (x2, y2, *second) = _most_distant_pair(nearby_road_points(truth))
        return Options(
            scale_from=scale_from,
            scale=ScaleOptions(
                distance_px=' '.join(f'{value:.1f}' for value in (*first, *second)),
                distance_m=float(np.hypot(x2 - x1, y2 - y1)),
            ),
        )
    if scale_from == 'speed':
        return Options(scale_from=scale_from, scale=ScaleOptions(speed_km_h=3.6 * _mean_speed(truth)))
    return Options(camera_height=truth['camera']['height'])


def _most_distant_pair(points: np.ndarray) -> np.ndarray:
    """Return the two of the points (n, 4) with the largest distance in pixels, shape (2, 4)."""
    ones, others = np.triu_indices(len(points), 1)
    best = np.argmax(np.hypot(*(points[ones, 2:] - points[others, 2:]).T))
    return points[[ones[best], others[best]]]


def _mean_speed(truth: dict[str, Any]) -> float:
    """Return the mean speed in m/s, as induction loops measure it, on the road that most vehicles follow straight."""
    speeds: list[list[float]] = [[] for _ in truth['road_directions']]
    for track in truth['vehicles']['tracks']:
        rows = np.array(track['rows'])
        displacement = rows[-1, 1:3] - rows[0, 1:3]
        length, path = np.hypot(*displacement), np.hypot(*np.diff(rows[:, 1:3], axis=0).T).sum()
        cosines = np.abs(np.array(truth['road_directions'])[:, :2] @ displacement) / max(length, 1e-9)
        if (
            length > MIN_DISPLACEMENT_M
            and path < MAX_DETOUR_RATIO * length
            and cosines.max() > np.cos(np.radians(MAX_ROAD_ANGLE_DEG))
        ):
            # averaged over distance, not time: an induction loop at a random place on the path
            speeds[int(cosines.argmax())].append(float((rows[:, 4] ** 2).sum() / rows[:, 4].sum()))
    return float(np.mean(max(speeds, key=len)))


def compare_with_truth(result: Calibration | Refusal, truth: dict[str, Any]) -> TruthErrors | None:
    """Return the errors of a result against the ground truth; None for a refusal."""
    if isinstance(result, Refusal):
        return None
    focal_error_percent = 100 * (result.camera.focal_px / truth['lens']['f'] - 1)
    if result.ground is None:
        return TruthErrors(focal_error_percent, np.nan, np.nan, np.nan)
    up = np.array(truth['camera']['R_world_from_camera'])[2]
    angle = angles_deg(result.ground.normal_in_camera, up)
    sigma = result.stddev.height_m
    return TruthErrors(
        focal_error_percent,
        float(angle),
        result.ground.height_m - truth['camera']['height'],
        distance_error_percent(result.camera, result.ground, truth),
        'given' if sigma is None else f'stated ± {sigma:.2g} m',
    )
