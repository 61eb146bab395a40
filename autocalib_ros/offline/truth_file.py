"""What a truth.json holds of lens and pose, and how far a saved calibration is from it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from autocalib_ros.compare import compared
from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.ground_truth import NEAR_M, distance_percent
from autocalib_ros.results.calibration import GroundPlane
from autocalib_ros.results.saved_camera import KnownCamera

TRUE_LENSES = ('equidistant', 'kannala_brandt')
"""Models of a truth.json that are read; both are the one of camera.py."""


def true_camera(truth: dict[str, Any]) -> KnownCamera:
    """Return the lens and pose of a truth.json; InputError where it holds none."""
    try:
        lens, pose = truth['lens'], truth['camera']
        if lens['model'] not in TRUE_LENSES:
            raise InputError(f"the lens of the truth is {lens['model']!r}, expected {' or '.join(TRUE_LENSES)}")
        camera = Camera(int(truth['width']), int(truth['height']), float(lens['f']), (float(lens['cx']),
                        float(lens['cy'])), tuple(float(value) for value in lens['k']))
        ground = GroundPlane(np.array(pose['R_world_from_camera'], float).reshape(3, 3), float(pose['height']))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f'the truth is none of a simulation ({type(error).__name__}: {error})') from error
    return KnownCamera(width=camera.width, height=camera.height, lens=camera, matrix=camera.matrix, k=camera.k,
                       ground=ground)


def errors_against_truth(known: KnownCamera, truth: dict[str, Any]) -> dict[str, float | None]:
    """Return how far a camera is from the truth, by name with the unit; None for what it does not hold."""
    true = true_camera(truth)
    result = compared(true, known)
    scaled = known.scaled_to(true.width, true.height)
    pose = {item.name: item.difference for item in result.pose}
    metric = known.ground is not None and known.ground.metric
    return {
        'focal length, %': 100 * result.lens[0].difference / result.lens[0].first,
        'principal point, px': math.hypot(result.lens[1].difference, result.lens[2].difference),
        'rays, largest, deg': result.rays.largest_deg,
        'rays, best turned, largest, deg': result.rays_turned.largest_deg,
        'ground normal, deg': result.normal_deg, 'tilt, deg': pose.get('tilt'), 'roll, deg': pose.get('roll'),
        'height, m': pose.get('height'),
        f'distances within {NEAR_M:g} m, median, %':
            distance_percent(scaled.lens, scaled.ground, truth) if metric else None}
