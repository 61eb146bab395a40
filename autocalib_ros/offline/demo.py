"""The whole program on simulated traffic, against the truth."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.calibration import Calibration, Refusal
from autocalib_ros.errors import InputError
from autocalib_ros.offline.projection import angles_deg, distances_error, image_to_ground

MAX_FOCAL_ERROR_PERCENT = 3.0
MAX_NORMAL_ERROR_DEG = 1.0
NEAR_M = 40.0
"""Distances are compared between points of the road this near to the camera."""


@dataclass(frozen=True)
class Comparison:
    """How far a calibration is from the truth; nan where it gives no ground plane."""

    focal_percent: float
    normal_deg: float
    height_m: float
    distance_percent: float
    """Median over pairs of points on the road."""

    @property
    def good(self) -> bool:
        """Whether lens and ground are as close as the demonstration promises."""
        return abs(self.focal_percent) <= MAX_FOCAL_ERROR_PERCENT and self.normal_deg <= MAX_NORMAL_ERROR_DEG

    def table(self) -> str:
        """Return the errors as lines for a terminal."""
        rows = (('focal length', f'{self.focal_percent:+.2f} %', f'within {MAX_FOCAL_ERROR_PERCENT:g} %'),
                ('ground normal', f'{self.normal_deg:.2f} degrees', f'within {MAX_NORMAL_ERROR_DEG:g} degree'),
                ('camera height', f'{self.height_m:+.3f} m', 'given'),
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


def compare(result: Calibration | Refusal, truth: dict[str, Any]) -> Comparison | None:
    """Compare with the truth; None for a refusal."""
    if isinstance(result, Refusal):
        return None
    focal_percent = 100 * (result.camera.focal_px / truth['lens']['f'] - 1)
    if result.ground is None:
        return Comparison(focal_percent, np.nan, np.nan, np.nan)
    up = np.array(truth['camera']['R_world_from_camera'])[2]
    angle = angles_deg(result.ground.normal_in_camera, up)
    return Comparison(focal_percent, float(angle), result.ground.height_m - truth['camera']['height'],
                      _distance_percent(result, truth))


def _distance_percent(result: Calibration, truth: dict[str, Any]) -> float:
    """Return the median error of distances between points of the road that are not too far away."""
    points = np.array(truth['ground_points']['rows']).reshape(-1, 4)
    near = np.hypot(*(points[:, :2] - truth['camera']['position'][:2]).T) <= NEAR_M
    true_m, pixels = points[near, :2], points[near, 2:]
    return 100 * distances_error(true_m, image_to_ground(result.camera, result.ground, pixels))
