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


@dataclass(frozen=True)
class _PixelGradient:
    """Gradients by the pixel of scalar products of rays with normals, each of shape (...)."""

    lever: np.ndarray
    """The normal along the radius, at right angles to the bearing."""
    around: np.ndarray
    """The normal around the axis."""
    radial: np.ndarray
    """Derivative along the radius in the image plane."""
    tangential: np.ndarray
    """Derivative around the principal point in the image plane."""
    to_radial: np.ndarray
    """Derivative of half the squared norm by `radial`; that is `radial` itself where pixels are square."""
    to_tangential: np.ndarray
    """Derivative of half the squared norm by `tangential`."""
    spin: np.ndarray | float
    """Derivative of half the squared norm by the angle around the axis: 0 where pixels are square."""
    by_u: np.ndarray
    """Derivative by u."""
    norm2: np.ndarray
    """Squared norm of the derivatives by u and v."""


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
        x, y, sine, cosine = self._x, self._y, self._sine, self._cosine
        # the normal along the radius and around the axis
        outwards, around = normals[..., 0] * x + normals[..., 1] * y, normals[..., 1] * x - normals[..., 0] * y
        product, lever = sine * outwards + cosine * normals[..., 2], cosine * outwards - sine * normals[..., 2]
        gradient = self._gradient(lever, around)
        norm2 = np.maximum(gradient.norm2, 1e-18)
        scale = 1.0 / np.sqrt(norm2)
        for slope in self._whitened_slopes(product, gradient, (lever, around), product / norm2, parameters):
            yield scale * slope

    def normal_along(self, by_u: np.ndarray, by_v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return components of a vector along the radius and around the axis, from its products with `Rays`.

        `by_u` and `by_v` (...) are the scalar products of the vector with `Rays.radial` and `Rays.tangential`.
        """
        if not self._camera.has_square_pixels:
            by_x = by_u / self._camera.pixel_aspect
            by_y = by_v + self._camera.skew * by_x
            by_u, by_v = self._x * by_x + self._y * by_y, self._x * by_y - self._y * by_x
        return by_u / self._slope, by_v * self._radius / np.maximum(self._sine, 1e-12)

    def epipolar_slopes(
        self,
        error: np.ndarray,
        lines: tuple[np.ndarray, np.ndarray],
        pulls: tuple[np.ndarray, np.ndarray],
        ratio: np.ndarray,
        parameters: np.ndarray,
    ) -> Iterator[np.ndarray]:
        """Yield the derivatives (...) of an epipolar error, less `ratio` times those of half its squared gradient.

        Rays are of both ends, shape (2, ...), and so are the results, of which the sum over the ends is the whole:
        `lines` is the normal at each end, along the radius and around the axis, and `pulls` the derivative by the
        bearing of each end of all that is not the ray's own gradient.
        """
        return self._whitened_slopes(error, self._gradient(*lines), pulls, ratio, parameters)

    def _gradient(self, lever: np.ndarray, around: np.ndarray) -> _PixelGradient:
        """Return the gradient by the pixel of products with normals, given along the radius and around the axis."""
        radial, tangential = self._slope * lever, self._sine * around / self._radius
        if self._camera.has_square_pixels:
            norm2 = radial * radial + tangential * tangential
            # the derivative by u is needed squared, and by the pixel aspect alone
            by_u = self._x * radial - self._y * tangential
            return _PixelGradient(lever, around, radial, tangential, radial, tangential, 0.0, by_u, norm2)
        x, y, aspect, skew = self._x, self._y, self._camera.pixel_aspect, self._camera.skew
        by_x, by_y = x * radial - y * tangential, y * radial + x * tangential
        by_u, by_v = aspect * by_x, by_y - skew * by_x
        by_u_x = aspect * by_u - skew * by_v
        return _PixelGradient(
            lever,
            around,
            radial,
            tangential,
            x * by_u_x + y * by_v,
            x * by_v - y * by_u_x,
            by_v * by_x - by_u_x * by_y,
            by_u,
            by_u * by_u + by_v * by_v,
        )

    def _whitened_slopes(
        self,
        product: np.ndarray,
        gradient: _PixelGradient,
        pulls: tuple[np.ndarray, np.ndarray],
        ratio: np.ndarray,
        parameters: np.ndarray,
    ) -> Iterator[np.ndarray]:
        """Yield the derivatives (...) of products, less `ratio` times those of half their squared gradients.

        `pulls` are the derivatives by the bearing along the radius and around the axis. All is linear in the change of
        the rays, so that one parameter more costs little.
        """
        lever, around, sine, cosine = gradient.lever, gradient.around, self._sine, self._cosine
        radial, tangential = ratio * gradient.to_radial, ratio * gradient.to_tangential
        by_angle = pulls[0] + self._slope * product * radial - around * cosine / self._radius * tangential
        by_turn = (
            sine * pulls[1]
            - self._slope * cosine * around * radial
            + sine / self._radius * (sine * product + cosine * lever) * tangential
            - ratio * gradient.spin
        )
        by_length, by_steepness = gradient.tangential * tangential, -gradient.radial * radial
        for parameter, change in zip(parameters, self._changes(parameters), strict=True):
            slope = by_angle * change.wider + by_steepness * change.steeper
            if parameter not in (LOG_FOCAL, K1, K2):
                slope += by_turn * change.turned + by_length * change.longer
            if parameter == LOG_ASPECT:
                slope -= ratio * gradient.by_u * gradient.by_u
            yield slope

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
