"""How certain lengths on the road are, and which further measure would make them most certain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.verification.ground_normal import PlaneEstimate
from autocalib_ros.estimation.verification.scale import Scale
from autocalib_ros.geometry.ground_plane import ground_points, pixels_ahead, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import GRADED_DISTANCE_M
from autocalib_ros.results.grades import GRADE_LIMITS, GroundSigma, HelpfulMeasure

SEARCHED_DISTANCES_M = GRADED_DISTANCE_M * 2.0 ** (np.arange(-24, 25) / 8.0)
"""Distances at which road ahead is looked for: from an eighth of the graded distance to eight times of it."""
HALF_STEP_PX = 2.0
"""Half the length in the image of the lengths on the road that are graded."""
UNIT_HEIGHT_M = 8.0
"""Height of the camera that stands for one camera height where lengths are not in metres."""
PROMISED = {
    'focal': 0.05,
    'height': 0.02,
    'length_along': 0.02,
    'length_across': 0.02,
    'roll': float(np.radians(1.0)),
}
"""Standard deviation of each measure that a person may give: relative, or radians."""
ALONG, ACROSS = list(PROMISED).index('length_along'), list(PROMISED).index('length_across')
MIN_GAIN = 0.9
"""A measure helps if it reduces the larger standard deviation to this fraction or less."""


@dataclass(frozen=True)
class LengthCertainty:
    """Covariance of the logarithms of lengths on the road and of what a person may measure."""

    covariance: np.ndarray
    """Of the quantities of `PROMISED`, in its order, shape (5, 5)."""

    @property
    def ground_sigma(self) -> GroundSigma:
        """Relative standard deviations of lengths along and across the view."""
        return _ground_sigma(self.covariance)

    def most_helpful(self) -> HelpfulMeasure | None:
        """Return the measure after which lengths are most certain; None where they are, or nothing helps."""
        now = self.ground_sigma.worst
        if now <= GRADE_LIMITS['full']:
            return None
        with_each = {
            kind: _ground_sigma(_measured(self.covariance, index, sigma)).worst
            for index, (kind, sigma) in enumerate(PROMISED.items())
        }
        kind = min(with_each, key=with_each.__getitem__)
        return HelpfulMeasure(kind, with_each[kind]) if with_each[kind] <= MIN_GAIN * now else None


def _ground_sigma(covariance: np.ndarray) -> GroundSigma:
    along, across = np.sqrt(np.maximum(np.diag(covariance)[[ALONG, ACROSS]], 0.0))
    return GroundSigma(float(along), float(across))


def _measured(covariance: np.ndarray, index: int, sigma: float) -> np.ndarray:
    """Return the covariance after a measurement of one of its quantities, by the Kalman update."""
    gain = covariance[:, index] / (covariance[index, index] + sigma**2)
    return covariance - np.outer(gain, covariance[index])


def certainty_of_lengths(plane: PlaneEstimate, scale: Scale) -> LengthCertainty | None:
    """Return the certainty of lengths on the road about `GRADED_DISTANCE_M` ahead, or on the nearest road seen ahead.

    None if no road is seen ahead, or the plane has no covariance.
    """
    camera, normal = plane.lens_and_normal
    height = scale.height(camera, normal)
    metres = 1.0 if scale.metric else 1.0 / UNIT_HEIGHT_M
    pixels = pixels_ahead(camera, normal, height, metres * SEARCHED_DISTANCES_M)
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    if not len(seen):
        return None
    nearest = pixels[seen[np.argmin(np.abs(seen - len(SEARCHED_DISTANCES_M) // 2))]]
    ends = nearest + HALF_STEP_PX * _image_axes(camera, normal, nearest)

    def quantities(lens: Camera, up: np.ndarray) -> np.ndarray:
        places = ground_points(lens, up, scale.height(lens, up), ends)
        along, across = np.log(np.linalg.norm(places[::2] - places[1::2], axis=1))
        roll = np.radians(tilt_and_roll_deg(up)[1])
        return np.array([np.log(lens.focal_px), np.log(scale.height(lens, up)), along, across, roll])

    covariance = plane.covariance(quantities)
    scaled = np.array([0.0, 1.0, 1.0, 1.0, 0.0]) * scale.sigma / height
    covariance = covariance + np.outer(scaled, scaled)
    return LengthCertainty(covariance) if np.isfinite(covariance).all() else None


def _image_axes(camera: Camera, normal: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Return unit steps (4, 2) in the image that move the road point ahead and back, to the left and to the right."""
    steps = 0.5 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    places = ground_points(camera, normal, 1.0, pixel + steps)
    by_pixel = np.column_stack([places[0] - places[1], places[2] - places[3]])  # ground by image
    towards = np.linalg.inv(by_pixel).T  # rows: image steps for one unit ahead, one unit to the left
    unit = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return np.stack([unit[0], -unit[0], unit[1], -unit[1]])
