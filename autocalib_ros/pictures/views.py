"""Projections between image, road and views: undistorted view, top view, ground grid and horizon.

Pixels are of the full image. A view is a table of source pixels in the image, shape (rows, columns, 2), computed once
per calibration; `resample` applies it to an image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Lens, pixel_grid

MAX_DISTANCE_HEIGHTS = 10.0
"""Largest distance shown in views of the road, camera heights: farther away, a pixel covers metres."""
OUTSIDE_PX = -1e4
"""Source coordinate of pixels outside the field of view."""
EMPTY_GREY = 224
"""Grey level outside the image."""
BAND_ROWS = 64
"""Rows computed at a time: all rows of a large image would take a gigabyte."""
GREAT_CIRCLE_POINTS = 361
"""Points along a great circle."""
GRID_CELLS = 8
"""Grid cells to each side of the centre."""
GRID_STEP_HEIGHTS = 0.8
"""Largest side of a grid square, camera heights."""
SAMPLES_PER_SIDE = 64
"""Samples along each image side for the visible part of the road."""


def ground_to_image(camera: Lens, ground: GroundPlane, points_m: np.ndarray) -> np.ndarray:
    """Project points (..., 3) in the ground frame to pixels (..., 2); nan outside the field of view."""
    bearings = (points_m - ground.translation_m) @ ground.rotation  # the row form of R^T (X - t)
    pixels, valid = camera.project(bearings)
    return np.where(valid[..., None], pixels, np.nan)


def image_to_ground(camera: Lens, ground: GroundPlane, pixels: np.ndarray) -> np.ndarray:
    """Intersect the rays of pixels (..., 2) with the road; return points (..., 2), nan at and above the horizon."""
    bearings, valid = camera.unproject(pixels)
    rays = bearings @ ground.rotation.T
    down = np.where(valid & (rays[..., 2] < -1e-6), rays[..., 2], np.nan)
    return rays[..., :2] * (-ground.height_m / down)[..., None]


def nearby_road_points(
    camera: Lens, ground: GroundPlane, pixels: np.ndarray, heights: float = MAX_DISTANCE_HEIGHTS
) -> np.ndarray:
    """Return the road points (m, 2) of the pixels (n, 2) that show the road within `heights` camera heights."""
    points = image_to_ground(camera, ground, pixels)
    return points[np.hypot(*points.T) < heights * ground.height_m]


def visible_road(camera: Lens, ground: GroundPlane) -> np.ndarray:
    """Return road points (m, 2) of a regular grid of pixels, up to `MAX_DISTANCE_HEIGHTS`."""
    return nearby_road_points(camera, ground, pixel_grid(camera, SAMPLES_PER_SIDE, SAMPLES_PER_SIDE))


def resample(picture: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Return the view of a grey (H, W) or BGR (H, W, 3) uint8 image; `EMPTY_GREY` outside the image."""
    empty = (EMPTY_GREY,) * 3
    return cv2.remap(picture, sources, None, cv2.INTER_LINEAR, borderValue=empty)  # type: ignore[call-overload]  # stub


def rectification_map(camera: Lens, matrix: np.ndarray) -> np.ndarray:
    """Return the view of a distortion-free camera with matrix (3, 3) and the image size, float32."""
    view = np.empty((camera.height, camera.width, 2), np.float32)
    to_bearing = np.linalg.inv(matrix).T
    for top in range(0, camera.height, BAND_ROWS):
        band = view[top : top + BAND_ROWS]
        x, y = np.meshgrid(np.arange(camera.width), np.arange(top, top + len(band)))
        sources, valid = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1) @ to_bearing)
        band[:] = np.where(valid[..., None], sources, OUTSIDE_PX)
    return view


@dataclass(frozen=True)
class TopView:
    """Orthographic top view of the road, x of the ground frame to the right, y up."""

    low_m: tuple[float, float]
    """Least x and y, at the outer edge of the pixels."""
    px_per_m: float
    columns: int
    rows: int

    @classmethod
    def around(cls, points_m: np.ndarray, ground: GroundPlane, longest_px: int) -> TopView | None:
        """Return a view of road points (n, 2) with a margin; None for fewer than two."""
        if len(points_m) < 2:
            return None
        low, high = np.percentile(points_m, [2, 98], axis=0)
        pad = 0.15 * (high - low).max() + 0.5 * ground.height_m
        return cls.between(low - pad, high + pad, longest_px)

    @classmethod
    def of_image(cls, camera: Lens, ground: GroundPlane, longest_px: int) -> TopView | None:
        """Return a view of the visible road; None if the image shows none."""
        points = visible_road(camera, ground)
        return cls.between(points.min(axis=0), points.max(axis=0), longest_px) if len(points) > 1 else None

    @classmethod
    def between(cls, low_m: np.ndarray, high_m: np.ndarray, longest_px: int) -> TopView:
        """Return a view of a rectangle of the ground frame, corners (2,), with `longest_px` along its longer side."""
        px_per_m = longest_px / float(np.max(high_m - low_m))
        columns, rows = np.maximum(np.round((high_m - low_m) * px_per_m), 2).astype(int)
        return cls((float(low_m[0]), float(low_m[1])), px_per_m, int(columns), int(rows))

    @property
    def high_m(self) -> tuple[float, float]:
        """Largest x and y."""
        return (self.low_m[0] + self.columns / self.px_per_m, self.low_m[1] + self.rows / self.px_per_m)

    @cached_property
    def _points_m(self) -> np.ndarray:
        """Road point of each pixel centre, (rows, columns, 3)."""
        x = self.low_m[0] + (np.arange(self.columns) + 0.5) / self.px_per_m
        y = self.high_m[1] - (np.arange(self.rows) + 0.5) / self.px_per_m
        return np.stack([*np.meshgrid(x, y), np.zeros((self.rows, self.columns))], axis=-1)

    def sources(self, camera: Lens, ground: GroundPlane) -> np.ndarray:
        """Return the source pixels in the image, float32 (rows, columns, 2)."""
        return np.nan_to_num(ground_to_image(camera, ground, self._points_m), nan=OUTSIDE_PX).astype(np.float32)

    def pixels(self, points_m: np.ndarray) -> np.ndarray:
        """Return the view pixels (..., 2) of road points (..., 2)."""
        x = (points_m[..., 0] - self.low_m[0]) * self.px_per_m - 0.5
        return np.stack([x, (self.high_m[1] - points_m[..., 1]) * self.px_per_m - 0.5], axis=-1)


def project_great_circle(camera: Lens, normal: np.ndarray) -> list[np.ndarray]:
    """Return the visible arcs of the great circle with normal (3,) as polylines in pixels, in or near the image.

    The great circle of the ground normal is the horizon.
    """
    normal = normal / np.linalg.norm(normal)
    side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    side /= np.linalg.norm(side)
    angles = np.linspace(0, 2 * np.pi, GREAT_CIRCLE_POINTS)[:, None]
    pixels, valid = camera.project(np.cos(angles) * side + np.sin(angles) * np.cross(normal, side))
    return _parts_near_image(camera, np.where(valid[:, None], pixels, np.nan), beyond=1.0)


def project_road_lines(camera: Lens, ground: GroundPlane, lines_m: list[np.ndarray]) -> list[np.ndarray]:
    """Project lines (n, 3) in the ground frame to polylines in pixels, in or near the image."""
    return [
        part
        for line in lines_m
        for part in _parts_near_image(camera, ground_to_image(camera, ground, line), beyond=0.2)
    ]


def grid_step(ground: GroundPlane) -> float:
    """Return the side of the grid squares for a camera height, a round length."""
    return round_length(GRID_STEP_HEIGHTS * ground.height_m)


def grid_lines(middle_m: np.ndarray, step_m: float) -> list[np.ndarray]:
    """Return a grid of squares around a centre (2,) as finely sampled lines (n, 3), which bend in the image."""
    middle = np.round(middle_m / step_m) * step_m
    offsets = step_m * np.arange(-GRID_CELLS, GRID_CELLS + 1)
    fine = np.linspace(offsets[0], offsets[-1], 40 * GRID_CELLS + 1)
    lines = []
    for offset in offsets:
        for axis in (0, 1):
            line = np.zeros((len(fine), 3))
            line[:, axis], line[:, 1 - axis] = middle[axis] + fine, middle[1 - axis] + offset
            lines.append(line)
    return lines


def _parts_near_image(camera: Lens, pixels: np.ndarray, *, beyond: float) -> list[np.ndarray]:
    """Split a polyline (n, 2) into the parts in the image, extended by `beyond` as a fraction of its size."""
    size = np.array([camera.width, camera.height])
    near = (np.isfinite(pixels) & (pixels > -beyond * size) & (pixels < (1 + beyond) * size)).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]]).astype(int)))
    return [pixels[begin:end] for begin, end in zip(edges[::2], edges[1::2], strict=True) if end - begin > 1]


def round_length(length: float) -> float:
    """Return 1, 2 or 5 times a power of ten, the largest not above `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9)))


def length_unit(ground: GroundPlane) -> str:
    """Return the unit of lengths on the road, 'm' or 'camera heights'."""
    return 'm' if ground.metric else 'camera heights'


def format_length(length: float, ground: GroundPlane) -> str:
    """Return a length on the road with its unit."""
    return f'{length:g} {length_unit(ground).removesuffix("s") if length == 1 else length_unit(ground)}'


def in_image(camera: Lens, pixels: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of pixels (n, 2) inside the image, with the outer halves of border pixels; false for nan."""
    inside: np.ndarray = (pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])
    return np.asarray(inside.all(axis=1))
