"""Where the road lies: directions, horizon, metres."""

from __future__ import annotations

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autocalib_ros.calibration import GroundPlane
from autocalib_ros.camera import Camera
from autocalib_ros.offline.projection import ground_to_image, image_to_ground
from autocalib_ros.offline.report.canvas import (
    DPI,
    INK,
    MARGIN,
    WIDTH_IN,
    Scene,
    draw_legend,
    draw_paths,
    faded_rgb,
    image_axes,
    road_colour,
)

CIRCLE_POINTS = 361
GRID_CELLS = 8
"""Cells of the ground grid to each side of its middle."""
FARTHEST_HEIGHTS = 10.0
"""The top view ends this many camera heights away: beyond, a pixel covers metres."""
TOP_VIEW_PX = 900
WHITE, HORIZON = '#ffffff', '#aa3377'


def directions(scene: Scene) -> Figure | None:
    """Draw the horizon, the vanishing directions and the lines that run to them, in the distorted image."""
    if scene.calibration is None or not len(scene.calibration.road_directions):
        return None
    camera, ground = scene.calibration.camera, scene.calibration.ground
    figure, axes = image_axes(scene, margin=MARGIN)
    for index, direction in enumerate(scene.calibration.road_directions):
        _draw_direction(axes, camera, direction, index)
    if ground is not None:
        draw_paths(axes, _great_circle(camera, ground.normal_in_camera), HORIZON, 'horizon', width=2)
    draw_legend(axes)
    return figure


def _draw_direction(axes: Axes, camera: Camera, direction: np.ndarray, index: int) -> None:
    """Draw great circles through a direction and points of the image, and where the direction itself is seen."""
    across = np.linspace(0.1, 0.9, 5) * camera.width
    down = np.linspace(0.35, 0.95, 3) * camera.height
    bearings, _ = camera.unproject(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    for bearing in bearings:
        normal = np.cross(direction, bearing)
        if np.linalg.norm(normal) > 0.05:
            draw_paths(axes, _great_circle(camera, normal), road_colour(index), width=0.7, alpha=0.6)
    ends, valid = camera.project(np.array([direction, -np.asarray(direction)]))
    axes.plot(*ends[valid].T, 'o', color=road_colour(index), markersize=9, markeredgecolor=WHITE,
              label=f'vanishing points of road direction {index + 1}', clip_on=True)


def _great_circle(camera: Camera, normal: np.ndarray) -> list[np.ndarray]:
    """Return the visible arcs of the great circle with that normal, as polylines in pixels near the image."""
    normal = normal / np.linalg.norm(normal)
    side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    side /= np.linalg.norm(side)
    angles = np.linspace(0, 2 * np.pi, CIRCLE_POINTS)[:, None]
    pixels, valid = camera.project(np.cos(angles) * side + np.sin(angles) * np.cross(normal, side))
    size = np.array([camera.width, camera.height])
    near = valid & (pixels > -size).all(axis=1) & (pixels < 2 * size).all(axis=1)
    return _runs(pixels, near)


def _runs(points: np.ndarray, keep: np.ndarray) -> list[np.ndarray]:
    """Split a polyline into the parts that are kept."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(int)))
    return [points[begin:end] for begin, end in zip(edges[::2], edges[1::2], strict=True) if end - begin > 1]


def ground_grid(scene: Scene) -> Figure | None:
    """Draw a grid of equal squares on the road over the distorted image, with the axes of the ground frame."""
    calibration = scene.calibration
    if calibration is None or calibration.ground is None:
        return None
    camera, ground = calibration.camera, calibration.ground
    middle = _middle(scene)
    if middle is None:
        return None
    step = nice_length(0.8 * ground.height_m)
    middle = np.round(middle / step) * step
    figure, axes = image_axes(scene)
    lines = [path for path in _grid_lines(middle, step) for path in _seen(camera, ground, path)]
    draw_paths(axes, lines, WHITE, width=2.0, alpha=0.5)
    draw_paths(axes, lines, '#117733', f'squares of {_length(step, ground)}', width=0.9, alpha=0.9)
    for index, name in enumerate(('x, along the main traffic direction', 'y, to its left')):
        arm = np.linspace([*middle, 0], [*(middle + step * np.eye(2)[index]), 0], 20)
        draw_paths(axes, _seen(camera, ground, arm), ('#cc3311', '#0077bb')[index], name, width=4)
    draw_legend(axes)
    return figure


def _grid_lines(middle: np.ndarray, step: float) -> list[np.ndarray]:
    """Return the grid's lines as fine polylines (n, 3): they bend in the image."""
    offsets = step * np.arange(-GRID_CELLS, GRID_CELLS + 1)
    fine = np.linspace(offsets[0], offsets[-1], 40 * GRID_CELLS + 1)
    lines = []
    for offset in offsets:
        for axis in (0, 1):
            line = np.zeros((len(fine), 3))
            line[:, axis], line[:, 1 - axis] = middle[axis] + fine, middle[1 - axis] + offset
            lines.append(line)
    return lines


def _seen(camera: Camera, ground: GroundPlane, points_m: np.ndarray) -> list[np.ndarray]:
    pixels = ground_to_image(camera, ground, points_m)
    size = np.array([camera.width, camera.height])
    near = np.isfinite(pixels).all(axis=1) & (pixels > -0.2 * size).all(axis=1) & (pixels < 1.2 * size).all(axis=1)
    return _runs(pixels, near)


def _middle(scene: Scene) -> np.ndarray | None:
    """Return the middle of the traffic on the road, shape (2,)."""
    points = _traffic_on_road(scene)
    return np.median(points, axis=0) if len(points) else None


def _traffic_on_road(scene: Scene) -> np.ndarray:
    """Return tracked points on the road that are not too far away, shape (n, 2)."""
    camera, ground = scene.calibration.camera, scene.calibration.ground
    points = image_to_ground(camera, ground, scene.evidence.points_px)
    return points[np.hypot(*points.T) < FARTHEST_HEIGHTS * ground.height_m]


def top_view(scene: Scene) -> Figure | None:
    """Show the road from above, the main traffic direction to the right, with a scale."""
    if scene.calibration is None or scene.calibration.ground is None or scene.background is None:
        return None
    points = _traffic_on_road(scene)
    if len(points) < 2:
        return None
    ground = scene.calibration.ground
    low, high = np.percentile(points, [2, 98], axis=0)
    pad = 0.15 * (high - low).max() + 0.5 * ground.height_m
    return _top_figure(scene, low - pad, high + pad)


def _top_figure(scene: Scene, low: np.ndarray, high: np.ndarray) -> Figure:
    camera, ground = scene.calibration.camera, scene.calibration.ground
    width, height = high - low
    figure = Figure(figsize=(WIDTH_IN, min(WIDTH_IN * height / width + 0.6, 1.2 * WIDTH_IN)), dpi=DPI,
                    layout='constrained')
    axes = figure.add_subplot()
    axes.imshow(faded_rgb(_from_above(scene, low, high), 0.1), extent=(low[0], high[0], low[1], high[1]),
                interpolation='bilinear')
    for label in range(int(scene.labels.max(initial=-1)) + 1):
        paths = [image_to_ground(camera, ground, scene.evidence.track(index).points_px)
                 for index in np.flatnonzero(scene.labels == label)]
        draw_paths(axes, paths, road_colour(label), width=0.7, alpha=0.35)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
    unit = 'm' if ground.metric else "camera's heights"
    axes.set_xlabel(f'x, {unit}', color=INK)
    axes.set_ylabel(f'y, {unit}', color=INK)
    _draw_scale(axes, low, high, ground)
    if (low < 0).all() and (high > 0).all():
        axes.plot(0, 0, '^', color='#cc3311', markersize=10, markeredgecolor=WHITE, label='camera')
        draw_legend(axes)
    return figure


def _from_above(scene: Scene, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Resample the background as seen from straight above; grey where the image does not reach."""
    camera, ground = scene.calibration.camera, scene.calibration.ground
    columns, rows = np.maximum(np.round((high - low) / (high - low).max() * TOP_VIEW_PX), 2).astype(int)
    x, y = np.linspace(low[0], high[0], columns), np.linspace(high[1], low[1], rows)
    points = np.stack([*np.meshgrid(x, y), np.zeros((rows, columns))], axis=-1)
    pixels = np.nan_to_num(ground_to_image(camera, ground, points), nan=-1e4).astype(np.float32)
    return cv2.remap(scene.background, pixels, None, cv2.INTER_LINEAR, borderValue=(224, 224, 224))


def _draw_scale(axes: Axes, low: np.ndarray, high: np.ndarray, ground: GroundPlane) -> None:
    length = nice_length(0.2 * (high[0] - low[0]))
    begin = low + 0.04 * (high - low)
    axes.plot([begin[0], begin[0] + length], [begin[1]] * 2, color=WHITE, linewidth=7, solid_capstyle='butt')
    axes.plot([begin[0], begin[0] + length], [begin[1]] * 2, color=INK, linewidth=4, solid_capstyle='butt')
    axes.text(begin[0] + length / 2, begin[1] + 0.02 * (high[1] - low[1]), _length(length, ground), ha='center',
              va='bottom', color=INK, fontsize=10,
              bbox={'boxstyle': 'round,pad=0.2', 'facecolor': WHITE, 'edgecolor': 'none', 'alpha': 0.8})


def nice_length(length: float) -> float:
    """Return 1, 2 or 5 times a power of ten, the largest not above `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9)))


def _length(length: float, ground: GroundPlane) -> str:
    return f'{length:g} m' if ground.metric else f'{length:g} camera heights'
