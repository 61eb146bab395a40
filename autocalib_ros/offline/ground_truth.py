"""Read a truth.json and compute the errors of a calibration against it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from autocalib_ros.comparison import compare_calibrations
from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.views import image_to_ground
from autocalib_ros.report.scene import KnownTruth
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.saved_camera import SavedCamera
from autocalib_ros.util.documents import read_json
from autocalib_ros.util.input_limits import MAX_METADATA_BYTES

MAX_COMPARED_RANGE_M = 40.0
"""Largest distance from the camera of the road points between which distances are compared."""
MIN_COMPARED_DISTANCE_M = 2.0
"""Shorter distances are not compared: their relative error is dominated by pixel noise."""


def median_distance_error(true_m: np.ndarray, found_m: np.ndarray) -> float:
    """Return the median relative error of the distances between road points (n, 2); nan if all are too short."""
    first, second = np.triu_indices(len(true_m), 1)
    true_lengths = np.hypot(*(true_m[first] - true_m[second]).T)
    lengths = np.hypot(*(found_m[first] - found_m[second]).T)
    far_apart = true_lengths > MIN_COMPARED_DISTANCE_M
    if not far_apart.any():
        return float('nan')
    # a point above the estimated horizon counts as an infinite error, so that it stays in the median
    errors = np.where(np.isfinite(lengths), np.abs(lengths / np.maximum(true_lengths, 1e-9) - 1), np.inf)
    return float(np.median(errors[far_apart]))


def read_truth(path: Path) -> dict[str, Any]:
    """Read a truth.json, or raise InputError."""
    truth = read_json(path, 'truth.json', MAX_METADATA_BYTES)
    if not isinstance(truth, dict):
        raise InputError(f'{path}: it holds no names with values, so it is no truth.json')
    return truth


def nearby_road_points(truth: dict[str, Any]) -> np.ndarray:
    """Return rows X, Y (metres), u, v (pixels) of road points up to `MAX_COMPARED_RANGE_M` away, shape (n, 4)."""
    points = np.array(truth['ground_points']['rows']).reshape(-1, 4)
    return points[np.hypot(*(points[:, :2] - truth['camera']['position'][:2]).T) <= MAX_COMPARED_RANGE_M]


def distance_error_percent(camera: Camera, ground: GroundPlane, truth: dict[str, Any]) -> float:
    """Return the median error in percent of distances between road points up to `MAX_COMPARED_RANGE_M` away."""
    points = nearby_road_points(truth)
    true_m, pixels = points[:, :2], points[:, 2:]
    return 100 * median_distance_error(true_m, image_to_ground(camera, ground, pixels))


SUPPORTED_LENS_MODELS = ('equidistant', 'kannala_brandt')
"""Lens models of a truth.json that can be read; both are the Kannala-Brandt model of `Camera`."""


def true_camera(truth: Mapping[str, Any]) -> SavedCamera:
    """Return the lens and pose of a truth.json, or raise InputError if it has none."""
    try:
        lens, pose = truth['lens'], truth['camera']
        if lens['model'] not in SUPPORTED_LENS_MODELS:
            raise InputError(
                f'unsupported lens model {lens["model"]!r} in the truth; expected {" or ".join(SUPPORTED_LENS_MODELS)}'
            )
        k1, k2, k3, k4 = map(float, lens['k'])
        camera = Camera(
            int(truth['width']),
            int(truth['height']),
            float(lens['f']),
            (float(lens['cx']), float(lens['cy'])),
            (k1, k2, k3, k4),
        )
        ground = GroundPlane(np.array(pose['R_world_from_camera'], float).reshape(3, 3), float(pose['height']))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f'not the truth of a simulation ({type(error).__name__}: {error})') from error
    return SavedCamera(
        width=camera.width, height=camera.height, lens=camera, matrix=camera.matrix, k=camera.k, ground=ground
    )


def errors_against_truth(known: SavedCamera, truth: dict[str, Any]) -> dict[str, float | None]:
    """Return the errors of a camera by name and unit; None for quantities that the camera lacks."""
    true = true_camera(truth)
    result = compare_calibrations(true, known)
    scaled = known.scaled_to(true.width, true.height)
    pose = {item.name: item.difference for item in result.pose}
    ground = scaled.ground
    camera = cast(Camera, scaled.lens)  # `image_to_ground` needs `unproject` only, which every lens has
    return {
        'focal length, %': 100 * result.lens[0].difference / result.lens[0].first,
        'principal point, px': math.hypot(result.lens[1].difference, result.lens[2].difference),
        'rays, largest, deg': result.rays.largest_deg,
        'rays, best turned, largest, deg': result.rays_aligned.largest_deg,
        'ground normal, deg': result.normal_deg,
        'tilt, deg': pose.get('tilt'),
        'roll, deg': pose.get('roll'),
        'height, m': pose.get('height'),
        f'distances within {MAX_COMPARED_RANGE_M:g} m, median, %': distance_error_percent(camera, ground, truth)
        if ground is not None and ground.metric
        else None,
    }


def beside_truth(found: Calibration, truth: Mapping[str, Any]) -> tuple[KnownTruth, ...]:
    """Return the numbers of a calibration beside the truth of a simulation, and the errors in sigmas."""
    true, sigma = true_camera(truth), found.stddev
    lens = cast(Camera, true.lens)
    right, down = sigma.principal_point_px or (None, None)
    rows = [
        _beside('focal length', found.camera.focal_px, lens.focal_px, sigma.focal_px, 1, 'px'),
        _beside('principal point x', found.camera.principal_point_px[0], lens.principal_point_px[0], right, 1, 'px'),
        _beside('principal point y', found.camera.principal_point_px[1], lens.principal_point_px[1], down, 1, 'px'),
        _beside('k1', found.camera.k[0], lens.k[0], sigma.k1, 4, ''),
    ]
    if found.ground is not None and true.ground is not None:
        angles = zip(
            ('tilt', 'roll'),
            tilt_and_roll_deg(found.ground.normal_in_camera).tolist(),
            tilt_and_roll_deg(true.ground.normal_in_camera).tolist(),
            (sigma.tilt_deg, sigma.roll_deg),
            strict=True,
        )
        rows += [_beside(name, here, there, deviation, 2, 'degrees') for name, here, there, deviation in angles]
        if found.ground.metric:
            rows.append(_beside('camera height', found.ground.height_m, true.ground.height_m, sigma.height_m, 2, 'm'))
    return tuple(rows)


def _beside(name: str, found: float, true: float, sigma: float | None, digits: int, unit: str) -> KnownTruth:
    spread = f' ± {sigma:.{digits}f}' if sigma else ''
    return KnownTruth(
        name=name,
        found=f'{found:.{digits}f}{spread} {unit}'.strip(),
        true=f'{true:.{digits}f} {unit}'.strip(),
        error=f'{found - true:+.{digits}f} {unit}'.strip(),
        sigmas=abs(found - true) / sigma if sigma else None,
    )
