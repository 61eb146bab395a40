"""A camera from a saved file: its lens, and if known its pose and their uncertainty.

The files are calibration.json, the node's NAME.autocalib.json, and any camera_info.yaml.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera, scale_factors
from autocalib_ros.lens.camera_info_lens import CameraInfoLens
from autocalib_ros.lens.camera_info_yaml import read_exact_lens
from autocalib_ros.lens.opencv_lens import OpencvLens, fit_kannala_brandt
from autocalib_ros.results.calibration import Calibration, StandardDeviations
from autocalib_ros.results.calibration_json import calibration_from_json, read_json_object


@dataclass(frozen=True, kw_only=True)
class SavedCamera:
    """A lens for images of a given size, and what else is known of the camera; lengths in pixels."""

    width: int
    height: int
    lens: Camera | CameraInfoLens
    """Exact in both directions."""
    matrix: np.ndarray
    """K, shape (3, 3)."""
    k: tuple[float, ...] | None = None
    """Kannala-Brandt coefficients, for another model those of the closest such lens; None if none is close enough."""
    rectified: np.ndarray | None = None
    """P R, shape (3, 3), which projects bearings to the rectified image of the file."""
    ground: GroundPlane | None = None
    stddev: StandardDeviations = field(default_factory=StandardDeviations)
    covariance: np.ndarray | None = None
    """Covariance of `calibration.COVARIANCE_PARAMETERS`, shape (10, 10)."""

    @classmethod
    def of(cls, result: Calibration, rectified: np.ndarray | None = None) -> SavedCamera:
        """Return the camera of a calibration."""
        camera = result.camera
        return cls(
            width=camera.width,
            height=camera.height,
            lens=camera,
            matrix=camera.matrix,
            k=camera.k,
            rectified=rectified,
            ground=result.ground,
            stddev=result.stddev,
            covariance=result.covariance,
        )

    @classmethod
    def from_opencv_lens(cls, lens: OpencvLens, rectified: np.ndarray | None = None) -> SavedCamera:
        """Return the camera of a CameraInfo, without pose and uncertainty."""
        try:
            camera = fit_kannala_brandt(lens)
        except InputError:  # no Kannala-Brandt lens is close; its rays are still known
            camera = None
        return cls(
            width=lens.width,
            height=lens.height,
            lens=CameraInfoLens(lens),
            matrix=lens.matrix,
            k=None if camera is None else camera.k,
            rectified=rectified,
        )

    @property
    def focal_px(self) -> float:
        """Focal length in pixel heights, as of a `Camera`."""
        return float(self.matrix[1, 1])

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """Principal point in pixels."""
        return float(self.matrix[0, 2]), float(self.matrix[1, 2])

    def project(self, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (..., 2) of bearings (..., 3), and which are valid (...)."""
        pixels, valid = self.lens.project(np.reshape(bearings, (-1, 3)))
        return pixels.reshape(*bearings.shape[:-1], 2), valid.reshape(bearings.shape[:-1])

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit bearings (..., 3) of pixels (..., 2), and which are valid (...)."""
        bearings, valid = self.lens.unproject(np.reshape(pixels, (-1, 2)))
        return bearings.reshape(*pixels.shape[:-1], 3), valid.reshape(pixels.shape[:-1])

    def scaled_to(self, width: int, height: int) -> SavedCamera:
        """Return the camera for images of another size; UsageError if their aspect ratio differs."""
        if (width, height) == (self.width, self.height):
            return self
        across, down = scale_factors((self.width, self.height), (width, height))
        # image borders are scaled, which lie half a pixel outside the centres of the outer pixels
        scale = np.array([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]])
        matrix, focal = scale @ self.matrix, np.sqrt(across * down)
        lens = (
            self.lens.scaled_to(width, height)
            if isinstance(self.lens, Camera)
            else CameraInfoLens(replace(self.lens.full, width=width, height=height, matrix=matrix))
        )
        units = np.array([focal, across, down, *[1.0] * 7])
        point = self.stddev.principal_point_px
        stddev = replace(
            self.stddev,
            focal_px=None if self.stddev.focal_px is None else focal * self.stddev.focal_px,
            principal_point_px=None if point is None else (across * point[0], down * point[1]),
        )
        return replace(
            self,
            width=width,
            height=height,
            lens=lens,
            stddev=stddev,
            matrix=lens.matrix if isinstance(lens, Camera) else matrix,
            rectified=None if self.rectified is None else scale @ self.rectified,
            covariance=None if self.covariance is None else self.covariance * np.outer(units, units),
        )


def read_saved_camera(path: Path) -> SavedCamera:
    """Return the camera of any of the files; InputError names the fault and what was expected."""
    if path.suffix.lower() != '.json':
        return SavedCamera.from_opencv_lens(*read_exact_lens(path))
    document = read_json_object(path)
    try:
        return SavedCamera.of(calibration_from_json(document), _rectified_projection(document))
    except InputError as error:
        raise InputError(
            f'{path}: {error}; give a calibration.json, NAME.autocalib.json or camera_info.yaml'
        ) from error


def _rectified_projection(document: Mapping[str, Any]) -> np.ndarray | None:
    """Return P of the document's camera_info, whose R is the identity; None if it has no valid one."""
    try:
        projection = np.array(document['camera_info']['p'], float).reshape(3, 4)
    except (KeyError, TypeError, ValueError):
        return None
    return projection[:, :3] if projection[0, 0] > 0 and projection[1, 1] > 0 else None
