"""Derivatives, in closed form, of distances from great circles and of headings by the parameters of the lens.

A parameter turns the ray of a pixel away from the optical axis or around it. The scale of a step in the image changes,
too, with the image radius and with the slope of the angle by that radius.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.great_circles import MIN_RADIUS_SLOPE
from autocalib_ros.lens.camera import Camera

LOG_FOCAL, CENTRE_X, CENTRE_Y, K1, K2, LOG_ASPECT = range(6)
"""Numbers of the parameters of the lens."""


@dataclass(frozen=True)
class _RayChange:
    """Derivatives of the rays by one parameter; shape (...), or 0 for all."""

    wider: np.ndarray | float
    """Of the angle from the axis."""
    turned: np.ndarray | float
    """Of the angle around the axis."""
    longer: np.ndarray | float
    """Of the log of the image radius."""
    steeper: np.ndarray | float
    """Of the log of the slope of the angle by the radius."""


class PolarRays:
    """Rays of pixels (..., 2), with their bearings (..., 3), in polar coordinates about the axis of the lens."""

    def __init__(self, camera: Camera, pixels: np.ndarray, bearings: np.ndarray) -> None:
        self._camera = camera
        self._across_px = pixels[..., 0] - camera.principal_point_px[0]
        x, y = self._across_px, pixels[..., 1] - camera.principal_point_px[1]
        if not camera.has_square_pixels:
            x = camera.pixel_aspect * x - camera.skew * y
        self._radius = np.maximum(np.sqrt(x * x + y * y), 1e-9)
        self._x, self._y = x / self._radius, y / self._radius
        self._sine, self._cosine = np.hypot(bearings[..., 0], bearings[..., 1]), bearings[..., 2]
        self._theta = np.arctan2(self._sine, self._cosine)
        steepness = camera.radius_derivative(self._theta)
        self._bends = steepness > MIN_RADIUS_SLOPE * camera.focal_px
        self._slope = 1.0 / np.maximum(steepness, MIN_RADIUS_SLOPE * camera.focal_px)

    def distance_slopes(self, normals: np.ndarray, parameters: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the derivatives (...) of `Rays.distance_px` by each parameter, for fixed normals (..., 3)."""
        x, y, sine, cosine, radius, slope = self._x, self._y, self._sine, self._cosine, self._radius, self._slope
        aspect, skew = self._camera.pixel_aspect, self._camera.skew
        # the normal along the radius and around the axis
        outwards, around = normals[..., 0] * x + normals[..., 1] * y, normals[..., 1] * x - normals[..., 0] * y
        product, lever = sine * outwards + cosine * normals[..., 2], cosine * outwards - sine * normals[..., 2]
        # derivatives of the product: along the radius and around the axis, by x and y, and by the pixel
        radial, tangential = slope * lever, sine * around / radius
        by_x, by_y = x * radial - y * tangential, y * radial + x * tangential
        by_u, by_v = aspect * by_x, by_y - skew * by_x
        norm2 = np.maximum(by_u * by_u + by_v * by_v, 1e-18)
        scale = 1.0 / np.sqrt(norm2)
        for parameter, change in zip(parameters, self._changes(parameters), strict=True):
            swing = around * change.turned
            more_radial = radial * change.steeper + slope * (cosine * swing - product * change.wider)
            more_tangential = (
                around * cosine * change.wider - sine * outwards * change.turned
            ) / radius - tangential * change.longer
            more_x = x * more_radial - y * more_tangential - by_y * change.turned
            more_y = y * more_radial + x * more_tangential + by_x * change.turned
            half_norm2 = by_u * aspect * more_x + by_v * (more_y - skew * more_x)
            if parameter == LOG_ASPECT:
                half_norm2 = half_norm2 + by_u * by_u
            yield scale * (lever * change.wider + sine * swing - product * half_norm2 / norm2)

    def heading_slopes(
        self, ways_px: np.ndarray, directions: np.ndarray, parameters: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Yield the derivatives (k, n) of headings by each parameter, for pixels (n, 2).

        A heading is the angle on the unit sphere from the image displacement (n, 2) of a pixel to a direction (k, 3).
        """
        x, y, sine, cosine, slope = self._x, self._y, self._sine, self._cosine, self._slope
        # each direction along the radius, around the axis and along the axis; the displacement, too
        level_x, level_y, deep = (directions[:, axis, None] for axis in range(3))
        level, around = level_x * x + level_y * y, level_y * x - level_x * y
        outwards, near = cosine * level - sine * deep, sine * level + cosine * deep
        lever = np.maximum(outwards * outwards + around * around, 1e-12)
        way_x, way_y = self._camera.pixel_aspect * ways_px[:, 0] - self._camera.skew * ways_px[:, 1], ways_px[:, 1]
        radial, tangential = way_x * x + way_y * y, way_y * x - way_x * y
        wide = sine / self._radius
        first, second = slope * radial, wide * tangential
        length2 = np.maximum(first * first + second * second, 1e-24)
        for parameter, change in zip(parameters, self._changes(parameters), strict=True):
            longer_x = self._camera.pixel_aspect * ways_px[:, 0] if parameter == LOG_ASPECT else 0.0
            more_first = first * change.steeper + slope * (tangential * change.turned + longer_x * x)
            more_second = wide * (-radial * change.turned - longer_x * y) + second * (
                cosine / np.maximum(sine, 1e-12) * change.wider - change.longer
            )
            more_outwards, more_around = cosine * around * change.turned - near * change.wider, -level * change.turned
            yield (outwards * more_around - around * more_outwards) / lever - (
                first * more_second - second * more_first
            ) / length2

    def _changes(self, parameters: np.ndarray) -> Iterator[_RayChange]:
        """Yield how the rays change with each parameter; one at the limit of the lens model keeps its angle."""
        theta, radius, slope = self._theta, self._radius, self._slope
        (k1, k2, k3, k4), theta2 = self._camera.k, theta * theta
        inside = theta < self._camera.max_angle_rad
        falling = -self._camera.focal_px * self._slope * self._bends
        bend = falling * theta * (6 * k1 + theta2 * (20 * k2 + theta2 * (42 * k3 + theta2 * 72 * k4)))
        for parameter in parameters:
            turned: np.ndarray | float = 0.0
            longer: np.ndarray | float = 0.0
            steeper: np.ndarray | float = 0.0
            if parameter == LOG_FOCAL:
                wider, steeper = -radius * slope, -1.0
            elif parameter in (K1, K2):
                order = 2 if parameter == K1 else 4
                power = theta**order
                wider, steeper = -self._camera.focal_px * slope * theta * power, (order + 1) * falling * power
            else:
                right, down = self._shift(parameter)
                longer, turned = (
                    (self._x * right + self._y * down) / radius,
                    (self._x * down - self._y * right) / radius,
                )
                wider = slope * radius * longer
            wider = wider * inside
            yield _RayChange(wider, turned, longer, steeper + bend * wider)

    def _shift(self, parameter: int) -> tuple[np.ndarray | float, float]:
        """Return how far a parameter moves the pixels in the image plane, in x and in y."""
        if parameter == CENTRE_X:
            return -self._camera.pixel_aspect, 0.0
        if parameter == CENTRE_Y:
            return self._camera.skew, -1.0
        return self._camera.pixel_aspect * self._across_px, 0.0
