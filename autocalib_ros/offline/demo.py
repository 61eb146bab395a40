"""The whole program on simulated traffic, against the truth."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.calibration import Calibration, GroundPlane, Refusal
from autocalib_ros.camera import Camera
from autocalib_ros.config import Options, ScaleOptions
from autocalib_ros.errors import InputError
from autocalib_ros.offline.against_truth import angles_deg, distances_error
from autocalib_ros.pictures.views import image_to_ground

MAX_FOCAL_ERROR_PERCENT = 3.0
MAX_NORMAL_ERROR_DEG = 1.0
NEAR_M = 40.0
"""Distances are compared between points of the road this near to the camera."""
ON_ROAD_DEG, PATH_RATIO = 6.0, 1.05
"""A simulated vehicle follows a road when its way leads along it to this angle and is longer by no more than this."""
LEAST_WAY_M = 10.0


@dataclass(frozen=True)
class Comparison:
    """How far a calibration is from the truth; nan where it gives no ground plane."""

    focal_percent: float
    normal_deg: float
    height_m: float
    distance_percent: float
    """Median over pairs of points on the road."""
    height_note: str = 'given'
    """How sure the height claims to be."""

    @property
    def good(self) -> bool:
        """Whether lens and ground are as close as the demonstration promises."""
        return abs(self.focal_percent) <= MAX_FOCAL_ERROR_PERCENT and self.normal_deg <= MAX_NORMAL_ERROR_DEG

    def table(self) -> str:
        """Return the errors as lines for a terminal."""
        rows = (('focal length', f'{self.focal_percent:+.2f} %', f'within {MAX_FOCAL_ERROR_PERCENT:g} %'),
                ('ground normal', f'{self.normal_deg:.2f} degrees', f'within {MAX_NORMAL_ERROR_DEG:g} degree'),
                ('camera height', f'{self.height_m:+.3f} m', self.height_note),
                (f'distances within {NEAR_M:g} m', f'{self.distance_percent:.2f} %', 'median'))
        lines = [f'  {name + ":":<26}{error:<16}{note}' for name, error, note in rows]
        return '\n'.join(['Errors against the truth:', *lines])


def simulate_into(bag: Path, seed: int) -> dict[str, Any]:
    """Simulate the default scene into a new bag; return its truth.

    The images are JPEG: raw ones would take gigabytes.
    """
    from autocalib_ros.offline import simulate

    parser = argparse.ArgumentParser()
    simulate.add_arguments(parser)
    simulate.run(parser.parse_args([str(bag), '--seed', str(seed), '--compressed']))
    return read_truth(bag / 'truth.json')


def read_truth(path: Path) -> dict[str, Any]:
    """Read a truth.json."""
    try:
        return json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except ValueError as error:
        raise InputError(f'{path} is not a truth.json: {error}') from error


def options_from(truth: dict[str, Any], scale_from: str) -> Options:
    """Return the options of somebody who knows the height, a distance on the road, or the mean speed of a road."""
    if scale_from == 'distance':
        (x1, y1, *first), (x2, y2, *second) = _far_apart(_near_points(truth))
        return Options(scale_from=scale_from, scale=ScaleOptions(
            distance_px=' '.join(f'{value:.1f}' for value in (*first, *second)),
            distance_m=float(np.hypot(x2 - x1, y2 - y1))))
    if scale_from == 'speed':
        return Options(scale_from=scale_from, scale=ScaleOptions(speed_km_h=3.6 * _mean_speed(truth)))
    return Options(camera_height=truth['camera']['height'])


def _near_points(truth: dict[str, Any]) -> np.ndarray:
    """Rows X, Y, u, v of points of the road that are not too far away, shape (n, 4)."""
    points = np.array(truth['ground_points']['rows']).reshape(-1, 4)
    return points[np.hypot(*(points[:, :2] - truth['camera']['position'][:2]).T) <= NEAR_M]


def _far_apart(points: np.ndarray) -> np.ndarray:
    """The two of points (n, 4) whose pixels lie farthest from each other, shape (2, 4)."""
    ones, others = np.triu_indices(len(points), 1)
    best = np.argmax(np.hypot(*(points[ones, 2:] - points[others, 2:]).T))
    return points[[ones[best], others[best]]]


def _mean_speed(truth: dict[str, Any]) -> float:
    """Mean speed in metres a second, as loops would count it, of the road that most vehicles follow straight."""
    speeds: list[list[float]] = [[] for _ in truth['road_directions']]
    for track in truth['vehicles']['tracks']:
        rows = np.array(track['rows'])
        way = rows[-1, 1:3] - rows[0, 1:3]
        length, path = np.hypot(*way), np.hypot(*np.diff(rows[:, 1:3], axis=0).T).sum()
        cosines = np.abs(np.array(truth['road_directions'])[:, :2] @ way) / max(length, 1e-9)
        if length > LEAST_WAY_M and path < PATH_RATIO * length and cosines.max() > np.cos(np.radians(ON_ROAD_DEG)):
            # a loop somewhere on the way: each metre counts alike
            speeds[int(cosines.argmax())].append(float((rows[:, 4] ** 2).sum() / rows[:, 4].sum()))
    return float(np.mean(max(speeds, key=len)))


def compare(result: Calibration | Refusal, truth: dict[str, Any]) -> Comparison | None:
    """Compare with the truth; None for a refusal."""
    if isinstance(result, Refusal):
        return None
    focal_percent = 100 * (result.camera.focal_px / truth['lens']['f'] - 1)
    if result.ground is None:
        return Comparison(focal_percent, np.nan, np.nan, np.nan)
    up = np.array(truth['camera']['R_world_from_camera'])[2]
    angle = angles_deg(result.ground.normal_in_camera, up)
    sigma = result.stddev.height_m
    return Comparison(focal_percent, float(angle), result.ground.height_m - truth['camera']['height'],
                      distance_percent(result.camera, result.ground, truth),
                      'given' if sigma is None else f'stated +- {sigma:.2g} m')


def distance_percent(camera: Camera, ground: GroundPlane, truth: dict[str, Any]) -> float:
    """Return the median error of distances between points of the road that are not too far away."""
    points = _near_points(truth)
    true_m, pixels = points[:, :2], points[:, 2:]
    return 100 * distances_error(true_m, image_to_ground(camera, ground, pixels))
