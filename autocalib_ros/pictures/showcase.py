"""Picture of a calibration: the image with ground grid and horizon, next to a top view with the same grid."""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Lens, field_of_view_deg, pixel_grid
from autocalib_ros.pictures.annotations import add_scale_bar
from autocalib_ros.pictures.drawing import INK, PAPER, Overlay, bgr, text_size
from autocalib_ros.pictures.known_views import require_ground
from autocalib_ros.pictures.scene_geometry import ScaleBar
from autocalib_ros.pictures.views import (
    TopView,
    format_length,
    grid_lines,
    grid_step,
    ground_to_image,
    in_image,
    nearby_road_points,
    project_great_circle,
    resample,
)
from autocalib_ros.results.saved_camera import SavedCamera

IMAGE_PX, VIEW_PX, GAP_PX, STRIP_PX = 1080, 508, 12, 92
"""Widths of the image, of the top view and of the gap between them; height of the caption strip."""
TITLE_PX, SMALL_PX = 30.0, 24.0
"""Text heights; web pages show the picture at about half its size."""
GRID_COLOUR, HORIZON_COLOUR, SUBTITLE_COLOUR = '#5ad1c8', '#ffb347', '#a9b6c2'
GRID_PX, HORIZON_PX, RIM_PX = 2, 3, 1
"""Line widths, and the additional width of the dark rim."""
LINE_OPACITY, RIM_OPACITY, PLATE_OPACITY = 0.75, 0.3, 0.72
NEAR_HEIGHTS = 6.0
"""The top view is centred on the visible road within this distance, camera heights."""
SPAN_HEIGHTS = 5.5
"""Height of the top view, camera heights: farther away, an image pixel covers too much road."""
ROAD_SAMPLES_PER_SIDE = 48
"""Samples along each image side for the extent of the road."""


def showcase(known: SavedCamera, image: np.ndarray) -> np.ndarray:
    """Return the picture, BGR uint8, of a camera and one of its images, BGR uint8 (H, W, 3).

    InputError if there is no ground plane or no road nearby in the image.
    """
    upright = _upright(require_ground(known))
    rows = round(IMAGE_PX * known.height / known.width)
    small = known.scaled_to(IMAGE_PX, rows)
    view = _centred_view(small, upright, rows)
    page = np.full((rows + STRIP_PX, IMAGE_PX + GAP_PX + VIEW_PX, 3), bgr(INK), np.uint8)
    page[:rows, :IMAGE_PX] = cv2.resize(image, (IMAGE_PX, rows), interpolation=cv2.INTER_AREA)
    page[:rows, IMAGE_PX + GAP_PX :] = _top_view(known, upright, image, view)
    overlay = Overlay(*page.shape[:2])
    _add_grid(overlay, small, upright, view)
    _add_horizon(overlay, small, upright)
    bar = ScaleBar.of(view, upright)
    add_scale_bar(overlay, bar, IMAGE_PX + GAP_PX + SMALL_PX, rows - SMALL_PX, SMALL_PX, GRID_PX)
    _add_captions(overlay, small, upright, rows)
    return overlay.composite(page)


def _upright(ground: GroundPlane) -> GroundPlane:
    """Rotate the ground frame by quarter turns so that the camera looks up in a top view; roads stay axis-aligned."""
    ahead = ground.rotation[:, 2]
    quarters = round(float((np.pi / 2 - np.arctan2(ahead[1], ahead[0])) / (np.pi / 2)))
    cosine, sine = round(np.cos(quarters * np.pi / 2)), round(np.sin(quarters * np.pi / 2))
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], float)
    return GroundPlane(turn @ ground.rotation, ground.height_m, ground.metric)


def _centred_view(camera: Lens, ground: GroundPlane, rows: int) -> TopView:
    near = nearby_road_points(
        camera, ground, pixel_grid(camera, ROAD_SAMPLES_PER_SIDE, ROAD_SAMPLES_PER_SIDE), NEAR_HEIGHTS
    )
    if len(near) < 2:
        raise InputError(f'its image shows no road within {NEAR_HEIGHTS:g} camera heights')
    middle = (near.min(axis=0) + near.max(axis=0)) / 2
    span = SPAN_HEIGHTS * ground.height_m * np.array([VIEW_PX / rows, 1.0])
    px_per_m = rows / span[1]
    low = middle - span / 2
    return TopView((float(low[0]), float(low[1])), float(px_per_m), VIEW_PX, rows)


def _top_view(known: SavedCamera, ground: GroundPlane, image: np.ndarray, view: TopView) -> np.ndarray:
    """Return the top view of the image, with the page colour outside the image."""
    sources = view.sources(known, ground)
    covered = np.all((sources >= 0) & (sources <= [known.width - 1, known.height - 1]), axis=-1, keepdims=True)
    return np.where(covered, resample(image, sources), np.array(bgr(INK), np.uint8))


def _add_grid(overlay: Overlay, known: SavedCamera, ground: GroundPlane, view: TopView) -> None:
    """Add the grid around the centre of the top view to both halves, where both show the road."""
    low, high = np.array(view.low_m), np.array(view.high_m)
    paths = []
    for line in grid_lines((low + high) / 2, grid_step(ground)):
        pixels = ground_to_image(known, ground, line)
        shown = in_image(known, pixels) & ((line[:, :2] > low) & (line[:, :2] < high)).all(axis=1)
        paths += _visible_parts(pixels, shown)
        paths += _visible_parts(view.pixels(line) + np.array([IMAGE_PX + GAP_PX, 0]), shown)
    _add_rimmed(overlay, paths, GRID_COLOUR, GRID_PX)


def _visible_parts(path: np.ndarray, shown: np.ndarray) -> list[np.ndarray]:
    """Split a polyline (n, 2) into the parts where the mask `shown` (n,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], shown, [False]]).astype(int)))
    return [path[begin:end] for begin, end in zip(edges[::2], edges[1::2], strict=True) if end - begin > 1]


def _add_rimmed(overlay: Overlay, paths: list[np.ndarray], colour: str, width_px: int) -> None:
    """Add polylines (n, 2) with a dark rim."""
    overlay.add_paths(paths, INK, width_px + RIM_PX, RIM_OPACITY)
    overlay.add_paths(paths, colour, width_px, LINE_OPACITY)


def _add_horizon(overlay: Overlay, camera: Lens, ground: GroundPlane) -> None:
    """Add the horizon inside the image, labelled below its left end."""
    lines = project_great_circle(camera, ground.normal_in_camera)
    _add_rimmed(
        overlay,
        [part for line in lines for part in _visible_parts(line, in_image(camera, line))],
        HORIZON_COLOUR,
        HORIZON_PX,
    )
    points = np.concatenate([np.zeros((0, 2)), *lines])
    inside = points[(points >= 0).all(axis=1) & (points < [camera.width, camera.height - 3 * SMALL_PX]).all(axis=1)]
    if not len(inside):
        return
    left, top = (int(value) for value in inside[np.argmin(inside[:, 0])] + [14.0, 10.0])
    width, height = text_size('horizon', SMALL_PX)
    margin = height // 3
    overlay.add_box(left, top, left + width + 2 * margin, top + height + 2 * margin, INK, PLATE_OPACITY)
    overlay.add_text('horizon', left + margin, top + margin, SMALL_PX, HORIZON_COLOUR)


def _add_captions(overlay: Overlay, known: SavedCamera, ground: GroundPlane, rows: int) -> None:
    tilt = float(np.degrees(np.arcsin(np.clip(-ground.normal_in_camera[2], -1, 1))))
    height = f', {ground.height_m:.1f} m above the road' if ground.metric else ''
    field = field_of_view_deg(known)[0]  # type: ignore[arg-type]  # any lens with a principal point
    squares = format_length(grid_step(ground), ground)
    image_caption = (
        f'Lens, horizon and ground plane from traffic: squares of {squares}',
        f'field of view {field:.0f} degrees, tilt {_with_sigma(tilt, known.stddev.tilt_deg)} degrees{height}',
    )
    view_caption = ('Top view', 'the same squares, to scale')
    for left, (title, subtitle) in ((16.0, image_caption), (IMAGE_PX + GAP_PX + 4.0, view_caption)):
        overlay.add_text(title, left, rows + 12.0, TITLE_PX, PAPER)
        overlay.add_text(subtitle, left, rows + 52.0, SMALL_PX, SUBTITLE_COLOUR)


def _with_sigma(value: float, sigma: float | None) -> str:
    return f'{value:.1f}' if sigma is None else f'{value:.1f} ± {sigma:.1f}'
