"""A truth.json, and how far distances on the road are from it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.comparison import compare_calibrations
from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.views import image_to_ground
from autocalib_ros.results.saved_camera import SavedCamera

MAX_COMPARED_RANGE_M = 40.0
"""Distances are compared between points of the road this near to the camera."""
MIN_COMPARED_DISTANCE_M = 2.0
"""Shorter distances on the road are not compared: their relative error says little."""


def median_distance_error(true_m: np.ndarray, found_m: np.ndarray) -> float:
    """Median relative error of the distances between points (n, 2) on the road; nan where all are too short."""
    first, second = np.triu_indices(len(true_m), 1)
    true_lengths = np.hypot(*(true_m[first] - true_m[second]).T)
    lengths = np.hypot(*(found_m[first] - found_m[second]).T)
    far_apart = true_lengths > MIN_COMPARED_DISTANCE_M
    if not far_apart.any():
        return float('nan')
    # a point that ends up above the horizon is as wrong as can be, and must not drop out of the median
    errors = np.where(np.isfinite(lengths), np.abs(lengths / np.maximum(true_lengths, 1e-9) - 1), np.inf)
    return float(np.median(errors[far_apart]))


def read_truth(path: Path) -> dict[str, Any]:
    """Read a truth.json."""
    try:
        return json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except ValueError as error:
        raise InputError(f'{path} is not a truth.json: {error}') from error


def nearby_road_points(truth: dict[str, Any]) -> np.ndarray:
    """Return rows X, Y, u, v of points of the road that are not too far away, shape (n, 4)."""
    points = np.array(truth['ground_points']['rows']).reshape(-1, 4)
    return points[np.hypot(*(points[:, :2] - truth['camera']['position'][:2]).T) <= MAX_COMPARED_RANGE_M]


def distance_error_percent(camera: Camera, ground: GroundPlane, truth: dict[str, Any]) -> float:
    """Return the median error of distances between points of the road that are not too far away."""
    points = nearby_road_points(truth)
    true_m, pixels = points[:, :2], points[:, 2:]
    return 100 * median_distance_error(true_m, image_to_ground(camera, ground, pixels))


SUPPORTED_LENS_MODELS = ('equidistant', 'kannala_brandt')
"""Models of a truth.json that are read; both are the one of camera.py."""


def true_camera(truth: dict[str, Any]) -> SavedCamera:
    """Return the lens and pose of a truth.json; InputError where it holds none."""
    try:
        lens, pose = truth['lens'], truth['camera']
        if lens['model'] not in SUPPORTED_LENS_MODELS:
            raise InputError(
                f'the lens of the truth is {lens["model"]!r}, expected {" or ".join(SUPPORTED_LENS_MODELS)}'
            )
        camera = Camera(
            int(truth['width']),
            int(truth['height']),
            float(lens['f']),
            (float(lens['cx']), float(lens['cy'])),
            tuple(float(value) for value in lens['k']),
        )
        ground = GroundPlane(np.array(pose['R_world_from_camera'], float).reshape(3, 3), float(pose['height']))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f'the truth is none of a simulation ({type(error).__name__}: {error})') from error
    return SavedCamera(
        width=camera.width, height=camera.height, lens=camera, matrix=camera.matrix, k=camera.k, ground=ground
    )


def errors_against_truth(known: SavedCamera, truth: dict[str, Any]) -> dict[str, float | None]:
    """Return how far a camera is from the truth, by name with the unit; None for what it does not hold."""
    true = true_camera(truth)
    result = compare_calibrations(true, known)
    scaled = known.scaled_to(true.width, true.height)
    pose = {item.name: item.difference for item in result.pose}
    metric = known.ground is not None and known.ground.metric
    return {
        'focal length, %': 100 * result.lens[0].difference / result.lens[0].first,
        'principal point, px': math.hypot(result.lens[1].difference, result.lens[2].difference),
        'rays, largest, deg': result.rays.largest_deg,
        'rays, best turned, largest, deg': result.rays_aligned.largest_deg,
        'ground normal, deg': result.normal_deg,
        'tilt, deg': pose.get('tilt'),
        'roll, deg': pose.get('roll'),
        'height, m': pose.get('height'),
        f'distances within {MAX_COMPARED_RANGE_M:g} m, median, %': distance_error_percent(
            scaled.lens, scaled.ground, truth
        )
        if metric
        else None,
    }
