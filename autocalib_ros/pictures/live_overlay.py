"""Live pictures of a running calibration: debug overlay, top view and undistorted image.

Each is prepared once per calibration and drawn for each image; static parts are cached.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.pictures.annotations import add_label, add_scale_bar
from autocalib_ros.pictures.drawing import (
    GREY,
    INK,
    PAPER,
    ROAD_COLOURS,
    Caption,
    Overlay,
    RemapTable,
    caption_panel,
    draw_dots,
    draw_panel,
    draw_paths,
    line_px,
    text_height_px,
    text_size,
)
from autocalib_ros.pictures.scene_geometry import ScaleBar, SceneGeometry
from autocalib_ros.pictures.views import (
    EMPTY_GREY,
    TopView,
    format_length,
    grid_step,
    rectification_map,
    visible_road,
)
from autocalib_ros.results.calibration import Calibration

TRACKED_COLOUR, HORIZON_COLOUR, AXIS_COLOURS = '#ffe14d', '#ff7bd5', ('#ff5544', '#55cc55')
"""Colours of tracked points, horizon, and x and y axes of the ground frame."""
MAX_PATHS = 80
"""Most tracks drawn per label: more would hide the road."""
LIVE_TOP_VIEW_PX = 640
"""Longer side of the top view, pixels."""
FOOT_MARGIN_HEIGHTS = 0.6
"""Margin of the top view around the nadir of the camera, camera heights."""


@dataclass(frozen=True)
class LabelledTracks:
    """Tracks with the labels that a solution gave them."""

    image_size: tuple[int, int]
    points_px: np.ndarray
    """Points of all tracks, concatenated, shape (points, 2)."""
    starts: np.ndarray
    """Index at which each track starts, then the number of points, shape (tracks + 1,)."""
    labels: np.ndarray
    """Road index of each track; -1 not used, -2 rejected; shape (tracks,)."""

    def of(self, label: int) -> list[np.ndarray]:
        """Return the paths (n, 2) of a label, evenly subsampled to at most `MAX_PATHS`."""
        indices = np.flatnonzero(self.labels == label)
        indices = indices[:: max(1, -(-len(indices) // MAX_PATHS))]
        return [self.points_px[self.starts[index] : self.starts[index + 1]] for index in indices]


class DebugPicture:
    """Camera image with tracks, horizon, ground grid and a caption."""

    def __init__(
        self, image_size: tuple[int, int], calibration: Calibration | None, labelled_tracks: LabelledTracks | None
    ) -> None:
        """Prepare the overlay for images of a size; without a ground plane it has no horizon and no grid."""
        width, height = image_size
        self._overlay = Overlay(height, width)
        self._entries = [(TRACKED_COLOUR, 'followed now')]
        self._caption: Caption | None = None
        if labelled_tracks is not None and labelled_tracks.image_size == image_size:
            self._add_tracks(labelled_tracks, height)
        if calibration is not None and calibration.ground is not None:
            self._add_road(calibration.camera, calibration.ground, height)
        self._add_legend(height, width)

    def draw(self, image: np.ndarray, followed_px: np.ndarray, caption: Caption) -> np.ndarray:
        """Return the picture of a grey or BGR image with the recent positions (n, steps, 2) of tracked points."""
        picture = self._overlay.composite(image)
        width_px = line_px(len(picture))
        draw_paths(picture, followed_px, TRACKED_COLOUR, width_px)
        if len(followed_px):
            draw_dots(picture, followed_px[:, -1], TRACKED_COLOUR, 3 * width_px)
        if caption != self._caption:
            self._caption, self._panel = caption, caption_panel(caption, *picture.shape[:2])
        draw_panel(picture, self._panel)
        return picture

    def _add_tracks(self, labelled_tracks: LabelledTracks, height: int) -> None:
        rejected = labelled_tracks.of(-2)
        if rejected:
            self._overlay.add_paths(rejected, GREY, line_px(height), 0.6)
            self._entries.append((GREY, 'turning or stray'))
        for road in range(int(labelled_tracks.labels.max(initial=-1)) + 1):
            colour = ROAD_COLOURS[road % len(ROAD_COLOURS)]
            self._overlay.add_paths(labelled_tracks.of(road), colour, line_px(height), 0.6)
            self._entries.append((colour, f'road {road + 1}'))

    def _add_road(self, camera: Camera, ground: GroundPlane, height: int) -> None:
        """Add the horizon and the ground grid."""
        width_px = line_px(height)
        scene = SceneGeometry.of(camera, ground)
        self._overlay.add_paths(scene.horizon_px(), HORIZON_COLOUR, 2 * width_px)
        self._entries.append((HORIZON_COLOUR, 'horizon'))
        if scene.grid is None:
            return
        lines = scene.grid_px()
        self._overlay.add_paths(lines, INK, 3 * width_px, 0.2)
        self._overlay.add_paths(lines, PAPER, width_px, 0.6)
        self._entries.append((PAPER, f'squares of {format_length(scene.grid.step_m, ground)}'))
        for (name, paths), colour in zip(scene.axes_px().items(), AXIS_COLOURS, strict=True):
            for path in paths:
                self._overlay.add_paths([path], colour, 2 * width_px)
                x, y = path[-1] + width_px
                self._overlay.add_text(name, x, y, text_height_px(height), colour)

    def _add_legend(self, height: int, width: int) -> None:
        """Add the legend along the lower border, in as many rows as necessary."""
        text_height = text_height_px(height)
        stroke, gap = round(1.4 * text_height), round(0.5 * text_height)
        places, left, row = [], gap, 0
        for colour, name in self._entries:
            needed = stroke + gap + text_size(name, text_height)[0]
            if left > gap and left + needed + gap > width:
                left, row = gap, row + 1
            places.append((left, row, colour, name))
            left += needed + 2 * gap
        leading = round(1.15 * text_height)
        top = height - (row + 1) * leading - gap
        self._overlay.add_box(0, top, width, height, INK, 0.65)
        for left, row, colour, name in places:
            line_top = top + gap / 2 + row * leading
            middle = line_top + text_height / 2
            self._overlay.add_paths(
                [np.array([[left, middle], [left + stroke, middle]])], colour, 2 * line_px(height) + 1
            )
            self._overlay.add_text(name, left + stroke + gap, line_top, text_height, PAPER)


class TopPicture:
    """Top view of the road, x of the ground frame to the right, with scale bar and camera position."""

    def __init__(self, view: TopView, camera: Camera, ground: GroundPlane) -> None:
        self.view = view
        self._lookup = RemapTable(view.sources(camera, ground), EMPTY_GREY)
        self._overlay = Overlay(view.rows, view.columns)
        text_height = text_height_px(view.rows)
        self._add_camera(ground, text_height)
        bar, margin = ScaleBar.of(view, ground), text_height
        add_scale_bar(self._overlay, bar, margin, view.rows - margin, text_height, line_px(view.rows))

    @classmethod
    def of(cls, calibration: Calibration) -> TopPicture | None:
        """Prepare the top view of a calibration; None if it has no ground plane or the image shows no road."""
        camera, ground = calibration.camera, calibration.ground
        if ground is None:
            return None
        visible = visible_road(camera, ground)
        if len(visible) < 2:
            return None
        foot = FOOT_MARGIN_HEIGHTS * ground.height_m * np.array([[-1.0, -1.0], [1.0, 1.0]])
        around = np.concatenate([visible, foot])
        return cls(TopView.between(around.min(axis=0), around.max(axis=0), LIVE_TOP_VIEW_PX), camera, ground)

    def draw(self, image: np.ndarray) -> np.ndarray:
        """Return the top view of a grey or BGR image."""
        return self._overlay.composite(self._lookup.of(image))

    def _add_camera(self, ground: GroundPlane, text_height: float) -> None:
        """Mark the nadir of the camera by an arrow in its viewing direction, and draw the axes of the ground frame."""
        foot, width_px = self.view.pixels(np.zeros(2)), line_px(self.view.rows)
        for axis, (name, colour) in enumerate(zip('xy', AXIS_COLOURS, strict=True)):
            end = self.view.pixels(0.8 * grid_step(ground) * np.eye(2)[axis])
            self._overlay.add_paths([np.array([foot, end])], colour, 2 * width_px)
            self._overlay.add_text(name, end[0] + 2, end[1] - text_height / 2, text_height, colour)
        ahead = ground.rotation[:2, 2] * [1.0, -1.0]
        ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
        aside = np.array([-ahead[1], ahead[0]])
        arrow = foot + 0.6 * text_height * np.array(
            [1.5 * ahead, 0.8 * aside - ahead, -0.8 * aside - ahead, 1.5 * ahead]
        )
        self._overlay.add_paths([arrow], INK, 4 * width_px)
        self._overlay.add_paths([arrow], TRACKED_COLOUR, 2 * width_px)
        text, beside = 'camera', 1.5 * text_height
        left = foot[0] - beside - text_size(text, text_height)[0]
        arms = 0.8 * grid_step(ground) * self.view.px_per_m
        left = left if left > 2 else foot[0] + beside + arms
        add_label(self._overlay, text, left, foot[1] - text_height / 2, text_height)


class RectifiedPicture:
    """Undistorted image by P of the CameraInfo message; black outside the field of view."""

    def __init__(self, calibration: Calibration) -> None:
        matrix = np.array(calibration.camera_info.p).reshape(3, 4)[:, :3]
        self._lookup = RemapTable(rectification_map(calibration.camera, matrix), 0)

    def draw(self, image: np.ndarray) -> np.ndarray:
        """Return the undistorted view of a grey or BGR image."""
        return self._lookup.of(image)
