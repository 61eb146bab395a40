"""One picture that tells what a calibration is: the image with a grid on the road and the horizon; the road from above.

Both halves show the same squares of the same moment, bent by the lens at the left and square at the right.
"""

from __future__ import annotations

import cv2
import numpy as np
from matplotlib.axes import Axes

from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera, field_of_view_deg, pixel_grid
from autocalib_ros.pictures.drawing import bgr
from autocalib_ros.pictures.plotted import PLATE_COLOUR, POINTS_PER_PX, WHITE, PlotOverlay, draw_plate, draw_scale_bar
from autocalib_ros.pictures.views import (
    TopView,
    grid_lines,
    grid_step,
    ground_to_image,
    in_image,
    length_unit,
    nearby_road_points,
    project_great_circle,
    resample,
)
from autocalib_ros.results.saved_camera import SavedCamera

IMAGE_PX, VIEW_PX, GAP_PX, STRIP_PX = 1080, 508, 12, 92
"""Widths of the image, of the view from above and of the gap between them; height of the captions below."""
TITLE_PX, SMALL_PX = 27.0, 20.0
"""A page shows the picture at about half its size."""
GRID_COLOUR, HORIZON_COLOUR = '#5ad1c8', '#ffb347'
GRID_PX, HORIZON_PX = 2.2, 3.2
NEAR_HEIGHTS = 6.0
"""The view from above is about the middle of the road that is nearer than this, so many camera heights."""
SPAN_HEIGHTS = 5.5
"""Camera heights that it shows from top to bottom: beyond, a pixel of the image covers too much."""
HORIZON_SAMPLES = 48


def showcase(known: SavedCamera, image: np.ndarray) -> np.ndarray:
    """Return the picture, BGR uint8, of a camera with a plane and one of its images, BGR uint8 (H, W, 3).

    InputError where there is no plane, or no road nearby in the image.
    """
    if known.ground is None:
        raise InputError('it holds no ground plane: calibrate with --camera-height')
    rows = round(IMAGE_PX * known.height / known.width)
    small = known.scaled_to(IMAGE_PX, rows)
    camera, ground = small.lens, _upright(known.ground)
    view = _view(camera, ground, rows)
    page = np.full((rows + STRIP_PX, IMAGE_PX + GAP_PX + VIEW_PX, 3), bgr(PLATE_COLOUR), np.uint8)
    page[:rows, :IMAGE_PX] = cv2.resize(image, (IMAGE_PX, rows), interpolation=cv2.INTER_AREA)
    page[:rows, IMAGE_PX + GAP_PX :] = _from_above(known, _upright(known.ground), image, view)
    step = grid_step(ground)
    lines = _clipped_to_both(small, ground, view, grid_lines((np.array(view.low_m) + view.high_m) / 2, step))

    def draw(axes: Axes) -> None:
        for line in lines:
            _line(axes, ground_to_image(camera, ground, line), GRID_COLOUR, GRID_PX)
            _line(axes, view.pixels(line) + [IMAGE_PX + GAP_PX, 0], GRID_COLOUR, GRID_PX)
        for line in project_great_circle(camera, ground.normal_in_camera):
            _line(axes, np.where(in_image(small, line)[:, None], line, np.nan), HORIZON_COLOUR, HORIZON_PX)
        _name_horizon(axes, camera, ground)
        draw_scale_bar(
            axes, view, 'm' if ground.metric else 'heights', (IMAGE_PX + GAP_PX + 14.0, rows - 14.0), SMALL_PX
        )
        _captions(axes, small, step, rows)

    return PlotOverlay.render(page.shape[1], page.shape[0], draw).composite(page)


def _upright(ground: GroundPlane) -> GroundPlane:
    """Turn the ground frame by quarters until the camera looks up in a view from above, so that roads stay square."""
    ahead = ground.rotation[:, 2]
    quarters = round(float((np.pi / 2 - np.arctan2(ahead[1], ahead[0])) / (np.pi / 2)))
    cosine, sine = round(np.cos(quarters * np.pi / 2)), round(np.sin(quarters * np.pi / 2))
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], float)
    return GroundPlane(turn @ ground.rotation, ground.height_m, ground.metric)


def _view(camera: Camera, ground: GroundPlane, rows: int) -> TopView:
    near = nearby_road_points(camera, ground, pixel_grid(camera, HORIZON_SAMPLES, HORIZON_SAMPLES), NEAR_HEIGHTS)
    if len(near) < 2:
        raise InputError(f'its image shows no road nearer than {NEAR_HEIGHTS:g} times the height of the camera')
    middle = (near.min(axis=0) + near.max(axis=0)) / 2
    span = SPAN_HEIGHTS * ground.height_m * np.array([VIEW_PX / rows, 1.0])
    px_per_m = rows / span[1]
    low = middle - span / 2
    return TopView((float(low[0]), float(low[1])), float(px_per_m), VIEW_PX, rows)


def _from_above(known: SavedCamera, ground: GroundPlane, image: np.ndarray, view: TopView) -> np.ndarray:
    """Return the view of the image, in the colour of the page where that does not reach."""
    sources = view.sources(known.lens, ground)
    seen = ((sources >= 0) & (sources <= [known.width - 1, known.height - 1])).all(axis=-1)
    return np.where(seen[..., None], resample(image, sources), np.array(bgr(PLATE_COLOUR), np.uint8))


def _clipped_to_both(
    known: SavedCamera, ground: GroundPlane, view: TopView, lines: list[np.ndarray]
) -> list[np.ndarray]:
    """Return lines (n, 3) on the road with nan where they are not in the image and in the view from above."""
    low, high = np.array(view.low_m), np.array(view.high_m)
    return [
        np.where(
            (
                in_image(known, ground_to_image(known.lens, ground, line))
                & ((line[:, :2] > low) & (line[:, :2] < high)).all(axis=1)
            )[:, None],
            line,
            np.nan,
        )
        for line in lines
    ]


def _line(axes: Axes, points: np.ndarray, colour: str, width_px: float) -> None:
    """Draw a polyline (n, 2) that is interrupted where it is nan, with a dark rim."""
    axes.plot(*points.T, color=PLATE_COLOUR, linewidth=(width_px + 1.6) * POINTS_PER_PX, alpha=0.3)
    axes.plot(*points.T, color=colour, linewidth=width_px * POINTS_PER_PX, alpha=0.85)


def _name_horizon(axes: Axes, camera: Camera, ground: GroundPlane) -> None:
    """Write its name at the left end of the horizon, below it, where it is in the image."""
    points = np.concatenate([np.zeros((0, 2)), *project_great_circle(camera, ground.normal_in_camera)])
    inside = points[(points >= 0).all(axis=1) & (points < [camera.width, camera.height - 3 * SMALL_PX]).all(axis=1)]
    if not len(inside):
        return
    x, y = inside[np.argmin(inside[:, 0])] + [14.0, 10.0]
    draw_plate(axes, x, y, x + 4.6 * SMALL_PX, y + 1.6 * SMALL_PX)
    axes.text(
        x + 2.3 * SMALL_PX,
        y + 0.8 * SMALL_PX,
        'horizon',
        color=HORIZON_COLOUR,
        fontsize=SMALL_PX * POINTS_PER_PX,
        ha='center',
        va='center_baseline',
    )


def _captions(axes: Axes, known: SavedCamera, step: float, rows: int) -> None:
    sigma = known.stddev
    tilt = float(np.degrees(np.arcsin(np.clip(-known.ground.normal_in_camera[2], -1, 1))))
    height = f' from {known.ground.height_m:.1f} m' if known.ground.metric else ''
    field = field_of_view_deg(known)[0]
    left = (
        f'Lens, horizon and road found from the traffic: squares of {step:g} {length_unit(known.ground)}',
        f'{field:.0f} degrees wide, looks {_with_sigma(tilt, sigma.tilt_deg)} degrees down{height}',
    )
    right = ('The same moment from above', 'the same squares, to scale')
    for x, (title, words) in ((16.0, left), (IMAGE_PX + GAP_PX + 4.0, right)):
        axes.text(
            x, rows + 34.0, title, color=WHITE, fontsize=TITLE_PX * POINTS_PER_PX, va='baseline', fontweight='medium'
        )
        axes.text(x, rows + 70.0, words, color='#a9b6c2', fontsize=SMALL_PX * POINTS_PER_PX, va='baseline')


def _with_sigma(value: float, sigma: float | None) -> str:
    return f'{value:.1f}' if sigma is None else f'{value:.1f} ± {sigma:.1f}'
