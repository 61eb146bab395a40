"""Geometry that every visualisation of a calibration shows: ground grid, axes, horizon and scale bar, computed once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.road import GroundGrid
from autocalib_ros.pictures.views import TopView, format_length, project_great_circle, project_road_lines, round_length

SCALE_BAR_FRACTION = 0.2
"""Largest length of a scale bar, fraction of the width of the top view."""


@dataclass(frozen=True)
class SceneGeometry:
    """Horizon, ground grid and its axes, projected into the image of a camera."""

    camera: Camera
    ground: GroundPlane
    grid: GroundGrid | None
    """None if the image shows no road."""

    @classmethod
    def of(cls, camera: Camera, ground: GroundPlane) -> SceneGeometry:
        """Return the geometry with the grid around the visible part of the road."""
        return cls(camera, ground, GroundGrid.of(camera, ground))

    def horizon_px(self) -> list[np.ndarray]:
        """Return the horizon as polylines (n, 2) in or near the image."""
        return project_great_circle(self.camera, self.ground.normal_in_camera)

    def grid_px(self) -> list[np.ndarray]:
        """Return the grid lines as polylines (n, 2) in or near the image."""
        return [] if self.grid is None else project_road_lines(self.camera, self.ground, self.grid.lines_m)

    def axes_px(self) -> dict[str, list[np.ndarray]]:
        """Return the axes as polylines (n, 2) in or near the image, by name."""
        axes = {} if self.grid is None else self.grid.axes_m()
        return {name: project_road_lines(self.camera, self.ground, [line]) for name, line in axes.items()}


@dataclass(frozen=True)
class ScaleBar:
    """Scale bar of a top view with a round length."""

    length_m: float
    length_px: float
    text: str

    @classmethod
    def of(cls, view: TopView, ground: GroundPlane) -> ScaleBar:
        """Return the scale bar for a view, at most `SCALE_BAR_FRACTION` of its width."""
        length = round_length(SCALE_BAR_FRACTION * view.columns / view.px_per_m)
        return cls(length, length * view.px_per_m, format_length(length, ground))
