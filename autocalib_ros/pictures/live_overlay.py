"""The pictures of a running calibration: what is drawn over the camera's image, and the road from above.

Each is made once for a calibration and then drawn for image after image; what does not change is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
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
from autocalib_ros.pictures.road import GroundGrid
from autocalib_ros.pictures.views import (
    EMPTY_GREY,
    TopView,
    format_length,
    grid_step,
    project_great_circle,
    project_road_lines,
    rectification_map,
    round_length,
    visible_road,
)
from autocalib_ros.results.calibration import Calibration

TRACKED_COLOUR, HORIZON_COLOUR, AXIS_COLOURS = '#ffe14d', '#ff7bd5', ('#ff5544', '#55cc55')
"""Colours: points followed now, the horizon, x and y of the ground frame."""
MAX_PATHS = 80
"""Tracks of a road, or rejected, that are drawn: more would hide the road."""
LIVE_TOP_VIEW_PX = 640
SCALE_BAR_FRACTION = 0.2
"""Length of the scale bar, share of the picture's width at the most."""
FOOT_MARGIN_HEIGHTS = 0.6
"""Around the camera's foot, units of its height."""


@dataclass(frozen=True)
class LabelledTracks:
    """What became of the tracks in a solution."""

    image_size: tuple[int, int]
    points_px: np.ndarray
    """Of all tracks one after another, shape (points, 2)."""
    starts: np.ndarray
    """Where each track begins, with the total at the end, shape (tracks + 1,)."""
    labels: np.ndarray
    """For each track -1 not used, -2 rejected, else the index of its road direction, shape (tracks,)."""

    def of(self, label: int) -> list[np.ndarray]:
        """Return the paths (n, 2) of a label; where there are too many to draw, every so manieth."""
        indices = np.flatnonzero(self.labels == label)
        indices = indices[:: max(1, -(-len(indices) // MAX_PATHS))]
        return [self.points_px[self.starts[index] : self.starts[index + 1]] for index in indices]


class DebugPicture:
    """The camera's image with tracks, horizon, a grid on the road, and the state in words."""

    def __init__(
        self, image_size: tuple[int, int], calibration: Calibration | None, labelled_tracks: LabelledTracks | None
    ) -> None:
        """Take what is known for images of that size: nothing yet, or a lens, or a lens and the plane."""
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
        """Return the picture of an image, grey or BGR, with where points went of late (n, steps, 2), newest last."""
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
        """Add the horizon, and a grid about the middle of the road that is in the image."""
        width_px = line_px(height)
        self._overlay.add_paths(project_great_circle(camera, ground.normal_in_camera), HORIZON_COLOUR, 2 * width_px)
        self._entries.append((HORIZON_COLOUR, 'horizon'))
        grid = GroundGrid.of(camera, ground)
        if grid is None:
            return
        lines = project_road_lines(camera, ground, grid.lines_m)
        self._overlay.add_paths(lines, INK, 3 * width_px, 0.2)
        self._overlay.add_paths(lines, PAPER, width_px, 0.6)
        self._entries.append((PAPER, f'squares of {format_length(grid.step_m, ground)}'))
        for axis, (name, colour) in enumerate(zip('xy', AXIS_COLOURS, strict=True)):
            arm = np.linspace([*grid.middle_m, 0], [*(grid.middle_m + grid.step_m * np.eye(2)[axis]), 0], 20)
            for path in project_road_lines(camera, ground, [arm]):
                self._overlay.add_paths([path], colour, 2 * width_px)
                self._overlay.add_text(name, *(path[-1] + width_px), text_height_px(height), colour)

    def _add_legend(self, height: int, width: int) -> None:
        """Say what is what along the lower border, in as many rows as it takes."""
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
    """The road from straight above, x of the ground frame to the right, with a scale and the camera."""

    def __init__(self, view: TopView, camera: Camera, ground: GroundPlane) -> None:
        self.view = view
        self._lookup = RemapTable(view.sources(camera, ground), EMPTY_GREY)
        self._overlay = Overlay(view.rows, view.columns)
        text_height = text_height_px(view.rows)
        self._add_camera(ground, text_height)
        self._add_scale(ground, text_height)

    @classmethod
    def of(cls, calibration: Calibration) -> TopPicture | None:
        """Show the road of a calibration; None where that has no plane, or the image shows no road."""
        camera, ground = calibration.camera, calibration.ground
        seen = np.zeros((0, 2)) if ground is None else visible_road(camera, ground)
        if len(seen) < 2:
            return None
        foot = FOOT_MARGIN_HEIGHTS * ground.height_m * np.array([[-1.0, -1.0], [1.0, 1.0]])
        around = np.concatenate([seen, foot])
        return cls(TopView.between(around.min(axis=0), around.max(axis=0), LIVE_TOP_VIEW_PX), camera, ground)

    def draw(self, image: np.ndarray) -> np.ndarray:
        """Return the picture of an image, grey or BGR."""
        return self._overlay.composite(self._lookup.of(image))

    def _add_camera(self, ground: GroundPlane, text_height: float) -> None:
        """Mark the camera's foot by an arrow to where it looks, and the axes of the ground frame by arms."""
        foot, width_px = self.view.pixels(np.zeros(2)), line_px(self.view.rows)
        for axis, (name, colour) in enumerate(zip('xy', AXIS_COLOURS, strict=True)):
            end = self.view.pixels(0.8 * grid_step(ground) * np.eye(2)[axis])
            self._overlay.add_paths([np.array([foot, end])], colour, 2 * width_px)
            self._overlay.add_text(name, *(end + [2, -text_height / 2]), text_height, colour)
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
        self._write(text, left if left > 2 else foot[0] + beside + arms, foot[1] - text_height / 2, text_height)

    def _add_scale(self, ground: GroundPlane, text_height: float) -> None:
        bar_m = round_length(SCALE_BAR_FRACTION * self.view.columns / self.view.px_per_m)
        left, foot, width_px = text_height, self.view.rows - text_height, line_px(self.view.rows)
        bar = np.array([[left, foot], [left + bar_m * self.view.px_per_m, foot]])
        self._overlay.add_paths([bar], PAPER, 6 * width_px)
        self._overlay.add_paths([bar], INK, 3 * width_px)
        self._write(format_length(bar_m, ground), left, foot - 1.6 * text_height, text_height)

    def _write(self, text: str, left: float, top: float, text_height: float) -> None:
        """Write dark on a light box: what lies below may be anything."""
        width, height = text_size(text, text_height)
        self._overlay.add_box(
            round(left) - 2, round(top) - 1, round(left) + width + 2, round(top) + height + 1, PAPER, 0.75
        )
        self._overlay.add_text(text, left, top, text_height, INK)


class RectifiedPicture:
    """The image without distortion, by the P of the calibration's camera_info; black where the lens does not see."""

    def __init__(self, calibration: Calibration) -> None:
        matrix = np.array(calibration.camera_info.p).reshape(3, 4)[:, :3]
        self._lookup = RemapTable(rectification_map(calibration.camera, matrix), 0)

    def draw(self, image: np.ndarray) -> np.ndarray:
        """Return an image, grey or BGR, as the distortion-free camera of P takes it."""
        return self._lookup.of(image)
