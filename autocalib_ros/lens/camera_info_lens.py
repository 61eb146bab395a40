"""The lens of a sensor_msgs/CameraInfo, exact both ways, in the pixels of the images that it comes with.

K and D are of the full resolution of the sensor (REP-104). Its images may be cut out and binned: a pixel u of the
image is u * binning + offset of the region of interest in full resolution, as image_geometry has it.
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
"""Most: from the table of radii four or five steps reach the last digit."""
UNDISTORT_TOLERANCE = 1e-10
"""A slope counts as found when it is imaged so near to what was asked for, in focal lengths: below 1e-6 px."""
LENS_FIELDS = ('width', 'height', 'distortion_model', 'k', 'd')


@dataclass(frozen=True)
class CameraInfoLens:
    """A lens in pixels of delivered images: full resolution less the `offset_px`, divided by the `binning`."""

    full: OpencvLens
    binning: tuple[int, int] = (1, 1)
    offset_px: tuple[int, int] = (0, 0)

    @classmethod
    def of(cls, info: Any, *, rectified: bool = False) -> CameraInfoLens:
        """Read an object with the attributes of a CameraInfo, K and D of ROS 1 too; InputError where it is no lens.

        The `rectified` lens is that of image_proc's image_rect: P, without distortion.
        """
        fields = {name: message_field(info, name) for name in LENS_FIELDS}
        if rectified:
            projection = _numbers(message_field(info, 'p'))
            if len(projection) != 12 or not (projection[0] > 0 and projection[5] > 0):
                raise InputError(
                    "its 'p' holds no projection: rectified images come with 12 numbers, focal lengths"
                    ' above 0 among them; take the image that is not rectified, or calibrate'
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
        """The equidistant lens of focal length 1 about the pixel (0, 0)."""
        k1, k2, k3, k4 = self.full.coefficients[:4]
        return Camera(self.full.width, self.full.height, 1.0, (0.0, 0.0), (k1, k2, k3, k4))

    @cached_property
    def _radial_table(self) -> tuple[np.ndarray, np.ndarray]:
        return invertible_radii(self.full.coefficients)

    def project(self, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project bearings (n, 3), of any length, to pixels (n, 2), nan where invalid; and say where valid (n,)."""
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
        """Return unit bearings (n, 3) of pixels (n, 2), nan where no bearing is imaged there; and where valid (n,)."""
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
        """Invert the distortion by Newton's method from the radial table; and where that succeeds."""
        radius, imaged = self._radial_table
        length = np.hypot(*ideal.T)
        ideal = np.where(length[:, None] < imaged[-1], ideal, np.nan)
        normalised = ideal * (np.interp(length, imaged, radius) / np.maximum(length, 1e-12))[:, None]
        with np.errstate(all='ignore'):  # near the fold not all converge, and those are refused below
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
    """Return a field of a message; ROS 1 writes matrices in upper case."""
    return getattr(message, name if hasattr(message, name) else name.upper())


def _numbers(value: Any) -> list[float]:
    return [float(item) for item in value]
