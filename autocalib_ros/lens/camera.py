"""Lens model: the central Kannala-Brandt camera.

A bearing at the angle theta from the optical axis is imaged at the distance

    r(theta) = focal_px * (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9)

from the principal point (Kannala & Brandt 2006, equation 6). k = 0 is the equidistant lens; k1 = 1/3, k2 = 2/15 is
the series of the distortion-free one, tan(theta). Pixel (0, 0) is the centre of the top-left pixel. Camera optical
frame: x right, y down, z forward (REP-103).

Distances are in pixel heights. Where pixels are not square, or their axes are skewed, a point (x, y) of the image
plane, in pixel heights from the principal point, lies at the pixel

    u = (x + skew y) / pixel_aspect + cx,    v = y + cy
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from autocalib_ros.errors import UsageError

ANGLE_STEP_RAD = 1e-5
"""Newton step after which the angle of an image radius has converged: its error is the square of the step."""
MAX_ANGLE_ITERATIONS = 20
"""Upper limit: Newton's method doubles the number of correct digits, so four or five iterations are usual."""
MONOTONICITY_GRID_RAD = np.linspace(0.0, np.pi, 721)
"""Angles at which r(theta) is checked for monotonicity, every 0.25 degrees."""


class Lens(Protocol):
    """A lens for images of a given size."""

    @property
    def width(self) -> int:
        """Image width in pixels."""

    @property
    def height(self) -> int:
        """Image height in pixels."""

    def project(self, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (..., 2) of bearings (..., 3), and which are valid (...)."""

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit bearings (..., 3) of pixels (..., 2), and which are valid (...)."""


@dataclass(frozen=True)
class Camera:
    """Kannala-Brandt camera; lengths in pixels, angles in radians."""

    width: int
    height: int
    focal_px: float
    """In pixel heights: fy of K."""
    principal_point_px: tuple[float, float]
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    pixel_aspect: float = 1.0
    """Width of a pixel over its height, the sample aspect ratio of video: fy / fx of K."""
    skew: float = 0.0
    """Cotangent of the angle between the pixel axes, K[0, 1] / fx: `alpha` of OpenCV's fisheye model."""

    def __post_init__(self) -> None:
        numbers = (self.focal_px, *self.principal_point_px, *self.k, self.pixel_aspect, self.skew)
        positive = min(self.focal_px, self.pixel_aspect) > 0
        if not all(map(math.isfinite, numbers)) or not positive or min(self.width, self.height) < 1:
            raise UsageError(
                f'a camera needs a positive focal length and pixel aspect, a size and finite numbers, got {self}'
            )

    @classmethod
    def equidistant(cls, width: int, height: int, focal_px: float) -> Camera:
        """Return an equidistant camera with the principal point at the image centre."""
        return cls(width, height, float(focal_px), image_centre(width, height))

    def scaled_to(self, width: int, height: int) -> Camera:
        """Return the lens for images of another size; UsageError if their aspect ratio differs.

        The image borders are scaled, which lie half a pixel outside the centres of the outer pixels.
        """
        if (width, height) == (self.width, self.height):
            return self
        across, down = scale_factors((self.width, self.height), (width, height))
        cx, cy = self.principal_point_px
        return replace(
            self,
            width=width,
            height=height,
            focal_px=self.focal_px * math.sqrt(across * down),
            principal_point_px=((cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5),
        )

    @property
    def matrix(self) -> np.ndarray:
        """K, shape (3, 3), in pixels."""
        (cx, cy), focal_x_px = self.principal_point_px, self.focal_px / self.pixel_aspect
        return np.array([[focal_x_px, self.skew * focal_x_px, cx], [0.0, self.focal_px, cy], [0.0, 0.0, 1.0]])

    @property
    def diagonal_px(self) -> float:
        """Diagonal of the image in pixel heights."""
        return float(np.hypot(self.width * self.pixel_aspect, self.height))

    @property
    def has_square_pixels(self) -> bool:
        """Whether pixels are square and not skewed."""
        return self.pixel_aspect == 1.0 and self.skew == 0.0

    def offsets(self, pixels: np.ndarray) -> np.ndarray:
        """Return the offsets (..., 2) of pixels (..., 2) from the principal point, in pixel heights."""
        offset = np.asarray(pixels, float) - self.principal_point_px
        return offset if self.has_square_pixels else offset @ self._offset_from_pixel.T

    @cached_property
    def _offset_from_pixel(self) -> np.ndarray:
        """Derivative of `offsets` by the pixel, shape (2, 2)."""
        return np.array([[self.pixel_aspect, -self.skew], [0.0, 1.0]])

    def pixels_at(self, offsets: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) at offsets (..., 2) from the principal point, in pixel heights."""
        if not self.has_square_pixels:
            offsets = offsets @ np.linalg.inv(self._offset_from_pixel).T
        return offsets + self.principal_point_px

    def radius(self, theta_rad: np.ndarray) -> np.ndarray:
        """Return the image radius in pixel heights for angles from the optical axis."""
        return self.focal_px * theta_rad * _power_series(self.k, theta_rad * theta_rad)

    def radius_derivative(self, theta_rad: np.ndarray) -> np.ndarray:
        """Return dr/dtheta in pixels per radian."""
        return self.focal_px * _power_series(self._derivative_k, theta_rad * theta_rad)

    @property
    def _derivative_k(self) -> tuple[float, float, float, float]:
        """Coefficients of dr/dtheta."""
        k1, k2, k3, k4 = self.k
        return 3 * k1, 5 * k2, 7 * k3, 9 * k4

    @cached_property
    def max_angle_rad(self) -> float:
        """Largest angle up to which r(theta) increases; beyond it the polynomial is not invertible."""
        if min(self.k) >= 0.0:
            return math.pi
        falling = np.flatnonzero(self.radius_derivative(MONOTONICITY_GRID_RAD) <= 0)
        return float(MONOTONICITY_GRID_RAD[falling[0] - 1]) if len(falling) else float(np.pi)

    def project(self, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (..., 2) of bearings (..., 3) of any length, and which are valid (...)."""
        bearings = np.asarray(bearings, float)
        across = np.hypot(bearings[..., 0], bearings[..., 1])
        theta = np.arctan2(across, bearings[..., 2])
        on_axis = across < 1e-12
        scale = np.where(on_axis, 0.0, self.radius(theta) / np.where(on_axis, 1.0, across))
        return self.pixels_at(scale[..., None] * bearings[..., :2]), theta <= self.max_angle_rad

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit bearings (..., 3) of pixels (..., 2), and which are inside the range of the lens model (...)."""
        offset = self.offsets(pixels)
        r = np.hypot(offset[..., 0], offset[..., 1])
        theta, valid = self.angle(r)
        on_axis = r < 1e-12
        scale = np.where(on_axis, 0.0, np.sin(theta) / np.where(on_axis, 1.0, r))
        return np.concatenate([scale[..., None] * offset, np.cos(theta)[..., None]], axis=-1), valid

    def angle(self, radius_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the angles in radians of image radii in pixel heights, by Newton's method, and where it converged."""
        theta = self.nearest_angle(radius_px)
        radius = np.asarray(radius_px, float) / self.focal_px
        return theta, np.abs(theta * _power_series(self.k, theta * theta) - radius) < 1e-6

    def nearest_angle(self, radius_px: np.ndarray) -> np.ndarray:
        """Return the angles of `angle`; a radius out of the range of the lens model gets the angle at its limit."""
        radius = np.asarray(radius_px, float) / self.focal_px
        limit, slope_k = self.max_angle_rad, self._derivative_k
        theta = np.minimum(np.maximum(radius, 0.0), limit)
        if any(self.k):
            for _ in range(MAX_ANGLE_ITERATIONS):
                t2 = theta * theta
                step = theta * _power_series(self.k, t2)
                step -= radius
                step /= np.maximum(_power_series(slope_k, t2), 1e-3)
                before, theta = theta, np.minimum(np.maximum(theta - step, 0.0), limit)
                # each step squares the error; out of range the angle stays at its limit
                if np.abs(theta - before).max(initial=0.0) < ANGLE_STEP_RAD:
                    break
        return theta

    def undistort(self, pixels: np.ndarray, focal_px: float | None = None) -> np.ndarray:
        """Return pixels (..., 2) of a distortion-free camera with the same principal point and pixel shape.

        Generalises `x_u = x_d tan(theta) / theta_d` of Jain & Saunier (arXiv 2001.07243) to all lenses of the model.
        Pixels at 90 degrees from the optical axis or more give nan.
        """
        bearings, valid = self.unproject(pixels)
        ahead = valid & (bearings[..., 2] > 1e-6)
        scale = np.where(ahead, (focal_px or self.focal_px) / np.where(ahead, bearings[..., 2], 1.0), np.nan)
        return self.pixels_at(scale[..., None] * bearings[..., :2])


def scale_factors(calibrated: tuple[int, int], images: tuple[int, int]) -> tuple[float, float]:
    """Return the ratios of width and height of images to those of a calibration; UsageError if their shape differs."""
    across, down = images[0] / calibrated[0], images[1] / calibrated[1]
    # allows for rounding to whole pixels
    if min(abs(calibrated[1] * across - images[1]), abs(calibrated[0] * down - images[0])) > 0.5:
        raise UsageError(
            f'the lens was calibrated in images of {calibrated[0]}x{calibrated[1]}, and these images have'
            f' {images[0]}x{images[1]}, another shape: give a calibration of their size'
        )
    return across, down


def _power_series(k: tuple[float, ...], t2: np.ndarray) -> np.ndarray:
    """Return 1 + k1 t2 + k2 t2^2 + ..., with the shape of `t2`; trailing zero coefficients cost nothing."""
    order = len(k)
    while order and not k[order - 1]:
        order -= 1
    if not order:
        return np.ones_like(t2)
    total = t2 * k[order - 1]
    for factor in reversed(k[: order - 1]):
        total += factor
        total *= t2
    return total + 1.0


def image_centre(width: int, height: int) -> tuple[float, float]:
    """Return the centre of an image in pixels, where (0, 0) is the centre of the top-left pixel."""
    return (width - 1) / 2.0, (height - 1) / 2.0


def field_of_view_deg(camera: Camera) -> tuple[float, float]:
    """Return horizontal and vertical field of view in degrees, through the principal point.

    Works for any Lens with a principal point.
    """
    cx, cy = camera.principal_point_px
    right, bottom = camera.width - 1, camera.height - 1
    bearings, _ = camera.unproject(np.array([[0, cy], [right, cy], [cx, 0], [cx, bottom]], float))
    cosines = np.clip([bearings[0] @ bearings[1], bearings[2] @ bearings[3]], -1, 1)
    across, down = np.degrees(np.arccos(cosines))
    return float(across), float(down)


def pixel_grid(camera: Lens, columns: int, rows: int) -> np.ndarray:
    """Return pixels (columns * rows, 2) evenly spaced over the image including its borders, row by row."""
    across, down = np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
