"""Derivatives, in closed form, of projected pixels by the position of the point and by the parameters of the lens."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from autocalib_ros.geometry.lens_slopes import CENTRE_X, CENTRE_Y, K1, K2, LOG_FOCAL
from autocalib_ros.lens.camera import Camera


class ProjectedPoints:
    """Points (..., 3) in the frame of the camera, not at its centre, and their pixels."""

    def __init__(self, camera: Camera, points: np.ndarray) -> None:
        self._camera, self._points = camera, points
        x, y, self._depth = points[..., 0], points[..., 1], points[..., 2]
        self._across = np.maximum(np.sqrt(x * x + y * y), 1e-12)
        self._x, self._y = x / self._across, y / self._across
        self._theta = np.arctan2(self._across, self._depth)
        self._radius = camera.radius(self._theta)

    @property
    def pixels(self) -> np.ndarray:
        """Shape (..., 2)."""
        return self._camera.pixels_at(np.stack([self._radius * self._x, self._radius * self._y], axis=-1))

    def place_slopes(self) -> np.ndarray:
        """Return the derivatives (..., 2, 3) of the pixels by the positions."""
        x, y = self._x, self._y
        # the angle from the axis and the angle around it change with the position
        tilt = self._camera.radius_derivative(self._theta) / (self._across * self._across + self._depth * self._depth)
        along, spin = tilt * self._depth, self._radius / self._across
        slopes = np.empty((*self._points.shape[:-1], 2, 3))
        mixed = (along - spin) * x * y
        slopes[..., 0, 0], slopes[..., 0, 1] = along * x * x + spin * y * y, mixed
        slopes[..., 1, 0], slopes[..., 1, 1] = mixed, along * y * y + spin * x * x
        slopes[..., 0, 2], slopes[..., 1, 2] = -tilt * self._across * x, -tilt * self._across * y
        if not self._camera.has_square_pixels:
            slopes[..., 0, :] += self._camera.skew * slopes[..., 1, :]
            slopes[..., 0, :] /= self._camera.pixel_aspect
        return slopes

    def lens_slopes(self, parameters: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the derivatives (..., 2) of the pixels by parameters of the lens, see `geometry.lens_slopes`."""
        offsets = self.pixels - self._camera.principal_point_px
        for parameter in parameters:
            if parameter == LOG_FOCAL:
                yield offsets
            elif parameter in (CENTRE_X, CENTRE_Y):
                yield np.broadcast_to(np.eye(2)[0 if parameter == CENTRE_X else 1], offsets.shape)
            elif parameter in (K1, K2):
                longer = self._camera.focal_px * self._theta ** (3 if parameter == K1 else 5)
                yield offsets * (longer / np.maximum(self._radius, 1e-12))[..., None]
            else:  # pixels are wider, so there are fewer of them
                yield offsets * (-1.0, 0.0)
