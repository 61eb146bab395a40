"""Geometry of a calibration in the ground frame: grid, viewing frustum and error ellipses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.ground import Ground
from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.views import grid_lines, grid_step, visible_road
from autocalib_ros.results.calibration import GROUND_DISTANCES_M, Calibration

POINTS_PER_SIDE = 12
"""Points along each image side of the frustum: a wide-angle lens bends the sides."""
AXIS_POINTS = 20
"""Points along an axis: it bends in the image of a wide-angle lens."""
FRUSTUM_HEIGHTS = 0.3
"""Length of the rays of the frustum, camera heights."""
OUTLINE_POINTS = 49
"""Points along the outline of an ellipse."""
ELLIPSE_FRACTION = 0.1
"""Largest half axis of an enlarged ellipse, fraction of its distance."""
ENLARGEMENTS = (1, 2, 5, 10, 20, 50, 100)
"""Enlargements of ellipses; the largest is chosen with all half axes below `ELLIPSE_FRACTION` of the distance."""


@dataclass(frozen=True)
class GroundGrid:
    """Grid of squares on the road."""

    step_m: float
    middle_m: np.ndarray
    """Central grid corner, shape (2,)."""
    lines_m: list[np.ndarray]
    """Finely sampled lines, because they bend in the image, each of shape (n, 3)."""

    @classmethod
    def around(cls, points_m: np.ndarray, ground: GroundPlane) -> GroundGrid:
        """Return the grid around the median of road points (n, 2)."""
        step = grid_step(ground)
        middle = np.round(np.median(points_m, axis=0) / step) * step
        return cls(step, middle, grid_lines(middle, step))

    @classmethod
    def of(cls, camera: Camera, ground: GroundPlane) -> GroundGrid | None:
        """Return the grid around the visible part of the road; None if the image shows no road."""
        visible = visible_road(camera, ground)
        return cls.around(visible, ground) if len(visible) else None

    def axes_m(self) -> dict[str, np.ndarray]:
        """Return lines (n, 3) from the central corner to the next along x and y, by name."""
        start = [*self.middle_m, 0.0]
        return {
            name: np.linspace(start, [*(self.middle_m + self.step_m * direction), 0.0], AXIS_POINTS)
            for name, direction in zip('xy', np.eye(2), strict=True)
        }


@dataclass(frozen=True)
class ErrorEllipse:
    """One-sigma ellipse of the position of a road point ahead of the camera, by the calibration uncertainty."""

    distance_m: float
    sigma_m: float
    """Root of the trace of the covariance."""
    centre_m: np.ndarray
    """Shape (2,)."""
    axes_m: np.ndarray
    """Half axes as rows, the longer one last, shape (2, 2)."""

    def outline(self, enlargement: float) -> np.ndarray:
        """Return the ellipse, scaled by `enlargement`, as a closed line (n, 2)."""
        angles = np.linspace(0.0, 2 * np.pi, OUTLINE_POINTS)
        return self.centre_m + enlargement * np.column_stack([np.cos(angles), np.sin(angles)]) @ self.axes_m


def error_ellipses(result: Calibration) -> list[ErrorEllipse]:
    """Return the ellipses at `GROUND_DISTANCES_M` ahead of the camera that are in the image.

    Empty without a metric ground plane and its covariance.
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
    if found.covariance_m2 is None or found.sigma_m is None:
        return []
    found_ellipses = []
    for index in np.flatnonzero(visible & found.valid):
        values, vectors = np.linalg.eigh(found.covariance_m2[index])
        axes = (vectors * np.sqrt(np.maximum(values, 0.0))).T
        found_ellipses.append(
            ErrorEllipse(GROUND_DISTANCES_M[index], float(found.sigma_m[index]), centres[index], axes)
        )
    return found_ellipses


def enlargement(shown: list[ErrorEllipse]) -> int:
    """Return the factor by which to enlarge ellipses so that they are visible at the scale of the road."""
    most = max((np.hypot(*ellipse.axes_m[-1]) / ellipse.distance_m for ellipse in shown), default=ELLIPSE_FRACTION)
    return max(factor for factor in ENLARGEMENTS if factor == 1 or factor * most <= ELLIPSE_FRACTION)


def view_frustum(camera: Camera, ground: GroundPlane) -> list[np.ndarray]:
    """Return the frustum as lines (n, 3) in the ground frame: from the camera to the image corners, and the border.

    All rays have one length, which also shows lenses of 180 degrees and more correctly.
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
