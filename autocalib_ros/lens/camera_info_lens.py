"""Exact projection and unprojection by a sensor_msgs/CameraInfo, in the pixels of the images that come with it.

K and D are in the full resolution of the sensor (REP-104). Images may be cropped and binned: a pixel u of the image is
u * binning + offset of the region of interest in full resolution, as in image_geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info_yaml import lens_from_fields
from autocalib_ros.lens.opencv_lens import OpencvLens, distort, distortion_jacobian, invertible_radii

MAX_UNDISTORT_ITERATIONS = 12
"""Upper limit: from the lookup table four or five iterations reach full precision."""
UNDISTORT_TOLERANCE = 1e-10
"""Maximum residual in focal lengths for a converged inversion: less than 1e-6 px."""
LENS_FIELDS = ('width', 'height', 'distortion_model', 'k', 'd')


@dataclass(frozen=True)
class CameraInfoLens:
    """A lens in pixels of the delivered images: full resolution minus `offset_px`, divided by `binning`."""

    full: OpencvLens
    binning: tuple[int, int] = (1, 1)
    offset_px: tuple[int, int] = (0, 0)

    @classmethod
    def of(cls, info: Any, *, rectified: bool = False) -> CameraInfoLens:
        """Return the lens of an object with the attributes of a CameraInfo, also of ROS 1; InputError if it is invalid.

        `rectified` gives the lens of image_proc's image_rect: P, without distortion.
        """
        fields = {name: message_field(info, name) for name in LENS_FIELDS}
        if not any(fields['k']):
            raise InputError(
                'its K is zero: the camera is not calibrated now. Either it never was, or it has moved, or its picture '
                'says nothing: see the topic ~/status of autocalib'
            )
        if rectified:
            projection = _numbers(message_field(info, 'p'))
            if len(projection) != 12 or not (projection[0] > 0 and projection[5] > 0):
                raise InputError(
                    "its 'p' has no valid projection: rectified images need 12 numbers with positive focal lengths;"
                    ' use the unrectified image, or calibrate'
                )
            fields |= {
                'k': [*projection[0:3], *projection[4:7], *projection[8:11]],
                'distortion_model': 'plumb_bob',
                'd': [0.0] * 5,
            }
        region = message_field(info, 'roi')
        return cls(
            lens_from_fields(
                {name: value if isinstance(value, (str, int)) else _numbers(value) for name, value in fields.items()}
            ),
            (max(int(info.binning_x), 1), max(int(info.binning_y), 1)),
            (int(region.x_offset), int(region.y_offset)),
        )

    @cached_property
    def _polynomial(self) -> Camera:
        """Equidistant lens with focal length 1 and principal point (0, 0)."""
        k1, k2, k3, k4 = self.full.coefficients[:4]
        return Camera(self.full.width, self.full.height, 1.0, (0.0, 0.0), (k1, k2, k3, k4))

    @cached_property
    def _radial_table(self) -> tuple[np.ndarray, np.ndarray]:
        return invertible_radii(self.full.coefficients)

    def project(self, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (n, 2) of bearings (n, 3) of any length, nan where invalid, and which are valid (n,)."""
        if self.full.equidistant:
            ideal, valid = self._polynomial.project(bearings)
        else:
            ahead = bearings[:, 2] > 0
            normalised = bearings[:, :2] / np.where(ahead, bearings[:, 2], np.nan)[:, None]
            ideal, valid = distort(normalised, self.full.coefficients), ahead & self._in_invertible_range(normalised)
        matrix = self.full.matrix
        full = ideal @ matrix[:2, :2].T + matrix[:2, 2]
        return np.where(valid[:, None], (full - self.offset_px) / self.binning, np.nan), valid

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit bearings (n, 3) of pixels (n, 2), nan where invalid, and which are valid (n,)."""
        full = np.asarray(pixels, float) * self.binning + self.offset_px
        ideal = np.linalg.solve(self.full.matrix[:2, :2], (full - self.full.matrix[:2, 2]).T).T
        if self.full.equidistant:
            bearings, valid = self._polynomial.unproject(ideal)
        else:
            normalised, valid = self._undistort(ideal)
            bearings = np.column_stack([normalised, np.ones(len(normalised))])
            bearings /= np.linalg.norm(bearings, axis=1)[:, None]
        return np.where(valid[:, None], bearings, np.nan), valid

    def _undistort(self, ideal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Invert the distortion by Newton's method, started from the radial table; and return where it converged."""
        radius, imaged = self._radial_table
        length = np.hypot(*ideal.T)
        ideal = np.where(length[:, None] < imaged[-1], ideal, np.nan)
        normalised = ideal * (np.interp(length, imaged, radius) / np.maximum(length, 1e-12))[:, None]
        with np.errstate(all='ignore'):  # some diverge at the edge of the invertible range and are rejected below
            for _ in range(MAX_UNDISTORT_ITERATIONS):
                error = distort(normalised, self.full.coefficients) - ideal
                xx, xy, yy = distortion_jacobian(normalised, self.full.coefficients)
                determinant = xx * yy - xy * xy
                step = np.stack([yy * error[:, 0] - xy * error[:, 1], xx * error[:, 1] - xy * error[:, 0]], axis=1)
                normalised = normalised - step / determinant[:, None]
                if not (np.abs(error) > UNDISTORT_TOLERANCE).any():
                    break
            reached = np.hypot(*(distort(normalised, self.full.coefficients) - ideal).T) < UNDISTORT_TOLERANCE
            return normalised, reached & (determinant > 0) & self._in_invertible_range(normalised)

    def _in_invertible_range(self, normalised: np.ndarray) -> np.ndarray:
        return np.hypot(*normalised.T) < self._radial_table[0][-1]


def message_field(message: Any, name: str) -> Any:
    """Return a field of a message; ROS 1 names matrices in upper case."""
    return getattr(message, name if hasattr(message, name) else name.upper())


def _numbers(value: Any) -> list[float]:
    return [float(item) for item in value]
