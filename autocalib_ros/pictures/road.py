"""What is drawn of a calibration in the ground frame: a grid on the road, the field of view, how sure points are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.ground import Ground
from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.views import grid_lines, grid_step, visible_road
from autocalib_ros.results.calibration import GROUND_DISTANCES_M, Calibration

POINTS_PER_SIDE = 12
"""Points along each side of the image through which its field of view is drawn: a wide lens bends the sides."""
FRUSTUM_HEIGHTS = 0.3
"""Length of the rays of the field of view, units of the camera's height."""
OUTLINE_POINTS = 49
ELLIPSE_FRACTION = 0.1
ENLARGEMENTS = (1, 2, 5, 10, 20, 50, 100)
"""Ellipses are enlarged until the largest is seen, `ELLIPSE_FRACTION` of its distance at the most."""


@dataclass(frozen=True)
class GroundGrid:
    """Squares on the road about the middle of what the image shows of it."""

    step_m: float
    middle_m: np.ndarray
    """A corner of a square, shape (2,)."""
    lines_m: list[np.ndarray]
    """Each fine, as lines bend in the image, shape (n, 3)."""

    @classmethod
    def of(cls, camera: Camera, ground: GroundPlane) -> GroundGrid | None:
        """Return the grid that suits a calibration; None where the image shows no road."""
        visible = visible_road(camera, ground)
        if not len(visible):
            return None
        step = grid_step(ground)
        middle = np.round(np.median(visible, axis=0) / step) * step
        return cls(step, middle, grid_lines(middle, step))


@dataclass(frozen=True)
class ErrorEllipse:
    """Where a point of the road that is so far ahead of the camera's foot may be, by the calibration: one sigma."""

    distance_m: float
    sigma_m: float
    """Of its place, both directions together."""
    centre_m: np.ndarray
    """Shape (2,)."""
    axes_m: np.ndarray
    """Half axes as rows, the longer one last, shape (2, 2)."""

    def outline(self, enlargement: float) -> np.ndarray:
        """Return the ellipse, so many times as large, as a closed line (n, 2)."""
        angles = np.linspace(0.0, 2 * np.pi, OUTLINE_POINTS)
        return self.centre_m + enlargement * np.column_stack([np.cos(angles), np.sin(angles)]) @ self.axes_m


def error_ellipses(result: Calibration) -> list[ErrorEllipse]:
    """Return the ellipses `GROUND_DISTANCES_M` ahead that are in the image; none where the calibration tells nothing.

    That takes a plane in metres and its covariance.
    """
    if result.ground is None or not result.ground.metric or result.covariance is None:
        return []
    ground, camera = Ground.of(result), result.camera
    ahead = ground.rotation[:2, 2] / max(float(np.hypot(*ground.rotation[:2, 2])), 1e-9)
    centres = np.outer(GROUND_DISTANCES_M, ahead)
    pixels, visible = ground.pixels(centres)
    visible &= (
        np.abs(pixels - np.array([camera.width - 1, camera.height - 1]) / 2)
        <= np.array([camera.width, camera.height]) / 2
    ).all(axis=1)
    found = ground.points(np.where(visible[:, None], pixels, 0.0))
    found_ellipses = []
    for index in np.flatnonzero(visible & found.valid):
        values, vectors = np.linalg.eigh(found.covariance_m2[index])
        axes = (vectors * np.sqrt(np.maximum(values, 0.0))).T
        found_ellipses.append(
            ErrorEllipse(GROUND_DISTANCES_M[index], float(found.sigma_m[index]), centres[index], axes)
        )
    return found_ellipses


def enlargement(shown: list[ErrorEllipse]) -> int:
    """Return by how much ellipses are enlarged so that they are seen beside the road."""
    most = max((np.hypot(*ellipse.axes_m[-1]) / ellipse.distance_m for ellipse in shown), default=ELLIPSE_FRACTION)
    return max(factor for factor in ENLARGEMENTS if factor == 1 or factor * most <= ELLIPSE_FRACTION)


def view_frustum(camera: Camera, ground: GroundPlane) -> list[np.ndarray]:
    """Return lines (n, 3) in the ground frame: from the camera to the image's corners, and around its border.

    All rays are of one length, so that a lens of 180 degrees and more is shown as it is.
    """
    left, top, right, bottom = -0.5, -0.5, camera.width - 0.5, camera.height - 0.5
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    along = np.linspace(0.0, 1.0, POINTS_PER_SIDE, endpoint=False)[:, None]
    border = np.concatenate(
        [begin + along * (end - begin) for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    bearings, valid = camera.unproject(border)
    reach = FRUSTUM_HEIGHTS * ground.height_m
    ends = ground.translation_m + reach * bearings @ ground.rotation.T
    around = ends[valid]
    rays = [
        np.stack([ground.translation_m, ends[index]])
        for index in range(0, len(border), POINTS_PER_SIDE)
        if valid[index]
    ]
    return [*rays, np.concatenate([around, around[:1]])] if len(around) else []
