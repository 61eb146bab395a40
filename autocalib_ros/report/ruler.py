"""The ruler of the report: two clicks on the image or on the top view read a length and its standard deviation."""

from __future__ import annotations

from typing import Any

import numpy as np

from autocalib_ros.ground import PERTURBATION_SIGMAS, Ground
from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.views import TopView, resample
from autocalib_ros.report.rendering import data_address
from autocalib_ros.report.road_figures import top_view_extent
from autocalib_ros.report.scene import ReportScene

MAX_RULER_PX = 1280
"""Longest side of the embedded image: more helps no finger, and enlarges the page."""
RULER_TOP_VIEW_PX = 900
CLICK_SIGMA_PX = 1.0
"""Standard deviation of a click, pixels of the full image."""


def ruler_data(scene: ReportScene) -> dict[str, Any] | None:
    """Return pictures and cameras for the script of the page; None without a picture or a plane in metres.

    The first camera is the calibration; then come pairs moved by `sigmas` to both sides along each principal axis of
    its covariance, so that the script can propagate it to any length.
    """
    if scene.background is None or not scene.has_ground or not scene.ground.metric:
        return None
    ground = Ground.of(scene.calibrated)
    if not isinstance(ground.lens, Camera):
        return None
    moved = ground.perturbations or []
    camera = scene.calibrated.camera
    cameras = [(camera, ground.rotation, ground.camera_m), *moved]
    data = {
        'cameras': [_numbers(*each) for each in cameras],
        'sigmas': PERTURBATION_SIGMAS,
        'click_px': CLICK_SIGMA_PX,
        'size': [camera.width, camera.height],
        'image': data_address(scene.background, MAX_RULER_PX),
    }
    view = top_view_extent(scene, RULER_TOP_VIEW_PX)
    if view is not None:
        data['top'] = _top(scene, view)
    return data


def _top(scene: ReportScene, view: TopView) -> dict[str, Any]:
    picture = resample(np.asarray(scene.background), view.sources(scene.calibrated.camera, scene.ground))
    return {
        'image': data_address(picture[:, :, :3] if picture.ndim == 3 else picture, RULER_TOP_VIEW_PX),
        'size': [view.columns, view.rows],
        'low': [float(value) for value in view.low_m],
        'high': [float(value) for value in view.high_m],
    }


def _numbers(camera: Camera, rotation: np.ndarray, camera_m: np.ndarray) -> list[float]:
    """Return focal length, principal point, k1 to k4, pixel aspect, skew, ground_from_camera by rows, and position."""
    lens = [camera.focal_px, *camera.principal_point_px, *camera.k, camera.pixel_aspect, camera.skew]
    return [float(value) for value in (*lens, *rotation.ravel(), *camera_m)]
