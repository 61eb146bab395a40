"""The whole program on simulated traffic, against the truth."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.config import Options, ScaleOptions
from autocalib_ros.geometry.ground_plane import angles_deg
from autocalib_ros.offline.ground_truth import (
    MAX_COMPARED_RANGE_M,
    distance_error_percent,
    nearby_road_points,
    read_truth,
)
from autocalib_ros.results.calibration import Calibration, Refusal

MAX_FOCAL_ERROR_PERCENT = 3.0
MAX_NORMAL_ERROR_DEG = 1.0
MAX_ROAD_ANGLE_DEG, MAX_DETOUR_RATIO = 6.0, 1.05
"""A simulated vehicle follows a road when its way leads along it to this angle and is longer by no more than this."""
MIN_DISPLACEMENT_M = 10.0


@dataclass(frozen=True)
class TruthErrors:
    """How far a calibration is from the truth; nan where it gives no ground plane."""

    focal_error_percent: float
    normal_deg: float
    height_m: float
    distance_error_percent: float
    """Median over pairs of points on the road."""
    height_note: str = 'given'
    """How sure the height claims to be."""

    @property
    def within_tolerance(self) -> bool:
        """Whether lens and ground are as close as the demonstration promises."""
        return abs(self.focal_error_percent) <= MAX_FOCAL_ERROR_PERCENT and self.normal_deg <= MAX_NORMAL_ERROR_DEG

    def table(self) -> str:
        """Return the errors as lines for a terminal."""
        rows = (
            ('focal length', f'{self.focal_error_percent:+.2f} %', f'within {MAX_FOCAL_ERROR_PERCENT:g} %'),
            ('ground normal', f'{self.normal_deg:.2f} degrees', f'within {MAX_NORMAL_ERROR_DEG:g} degree'),
            ('camera height', f'{self.height_m:+.3f} m', self.height_note),
            (f'distances within {MAX_COMPARED_RANGE_M:g} m', f'{self.distance_error_percent:.2f} %', 'median'),
        )
        lines = [f'  {name + ":":<26}{error:<16}{note}' for name, error, note in rows]
        return '\n'.join(['Errors against the truth:', *lines])


def simulate_bag(bag: Path, seed: int) -> dict[str, Any]:
    """Simulate the default scene into a new bag; return its truth.

    The images are JPEG: raw ones would take gigabytes.
    """
    from autocalib_ros.offline import simulate

    parser = argparse.ArgumentParser()
    simulate.add_arguments(parser)
    simulate.run(parser.parse_args([str(bag), '--seed', str(seed), '--compressed']))
    return read_truth(bag / 'truth.json')


def options_from_truth(truth: dict[str, Any], scale_from: str) -> Options:
    """Return the options of somebody who knows the height, a distance on the road, or the mean speed of a road."""
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
        if (
            length > MIN_DISPLACEMENT_M
            and path < MAX_DETOUR_RATIO * length
            and cosines.max() > np.cos(np.radians(MAX_ROAD_ANGLE_DEG))
        ):
            # a loop somewhere on the way: each metre counts alike
            speeds[int(cosines.argmax())].append(float((rows[:, 4] ** 2).sum() / rows[:, 4].sum()))
    return float(np.mean(max(speeds, key=len)))


def compare_with_truth(result: Calibration | Refusal, truth: dict[str, Any]) -> TruthErrors | None:
    """Compare with the truth; None for a refusal."""
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
        'given' if sigma is None else f'stated +- {sigma:.2g} m',
    )
