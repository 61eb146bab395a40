"""Where the road lies: directions, horizon, metres."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autocalib_ros.calibration import GroundPlane
from autocalib_ros.camera import Camera
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
from autocalib_ros.pictures.views import (
    TopView,
    great_circle,
    grid_lines,
    grid_step,
    image_to_ground,
    near_on_road,
    nice_length,
    resample,
    road_lines,
)

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
        draw_paths(axes, great_circle(camera, ground.normal_in_camera), HORIZON, 'horizon', width=2)
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
            draw_paths(axes, great_circle(camera, normal), road_colour(index), width=0.7, alpha=0.6)
    ends, valid = camera.project(np.array([direction, -np.asarray(direction)]))
    axes.plot(*ends[valid].T, 'o', color=road_colour(index), markersize=9, markeredgecolor=WHITE,
              label=f'vanishing points of road direction {index + 1}', clip_on=True)


def ground_grid(scene: Scene) -> Figure | None:
    """Draw a grid of equal squares on the road over the distorted image, with the axes of the ground frame."""
    calibration = scene.calibration
    if calibration is None or calibration.ground is None:
        return None
    camera, ground = calibration.camera, calibration.ground
    middle = _middle(scene)
    if middle is None:
        return None
    step = grid_step(ground)
    middle = np.round(middle / step) * step
    figure, axes = image_axes(scene)
    lines = road_lines(camera, ground, grid_lines(middle, step))
    draw_paths(axes, lines, WHITE, width=2.0, alpha=0.5)
    draw_paths(axes, lines, '#117733', f'squares of {_length(step, ground)}', width=0.9, alpha=0.9)
    for index, name in enumerate(('x, along the main traffic direction', 'y, to its left')):
        arm = np.linspace([*middle, 0], [*(middle + step * np.eye(2)[index]), 0], 20)
        draw_paths(axes, road_lines(camera, ground, [arm]), ('#cc3311', '#0077bb')[index], name, width=4)
    draw_legend(axes)
    return figure


def _middle(scene: Scene) -> np.ndarray | None:
    """Return the middle of the traffic on the road, shape (2,)."""
    points = _traffic_on_road(scene)
    return np.median(points, axis=0) if len(points) else None


def _traffic_on_road(scene: Scene) -> np.ndarray:
    """Return tracked points on the road that are not too far away, shape (n, 2)."""
    return near_on_road(scene.calibration.camera, scene.calibration.ground, scene.evidence.points_px)


def top_view(scene: Scene) -> Figure | None:
    """Show the road from above, the main traffic direction to the right, with a scale."""
    if scene.calibration is None or scene.calibration.ground is None or scene.background is None:
        return None
    view = TopView.around(_traffic_on_road(scene), scene.calibration.ground, TOP_VIEW_PX)
    return None if view is None else _top_figure(scene, view)


def _top_figure(scene: Scene, view: TopView) -> Figure:
    camera, ground = scene.calibration.camera, scene.calibration.ground
    low, high = np.array(view.low_m), np.array(view.high_m)
    width, height = high - low
    figure = Figure(figsize=(WIDTH_IN, min(WIDTH_IN * height / width + 0.6, 1.2 * WIDTH_IN)), dpi=DPI,
                    layout='constrained')
    axes = figure.add_subplot()
    axes.imshow(faded_rgb(resample(scene.background, view.sources(camera, ground)), 0.1),
                extent=(low[0], high[0], low[1], high[1]), interpolation='bilinear')
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


def _draw_scale(axes: Axes, low: np.ndarray, high: np.ndarray, ground: GroundPlane) -> None:
    length = nice_length(0.2 * (high[0] - low[0]))
    begin = low + 0.04 * (high - low)
    axes.plot([begin[0], begin[0] + length], [begin[1]] * 2, color=WHITE, linewidth=7, solid_capstyle='butt')
    axes.plot([begin[0], begin[0] + length], [begin[1]] * 2, color=INK, linewidth=4, solid_capstyle='butt')
    axes.text(begin[0] + length / 2, begin[1] + 0.02 * (high[1] - low[1]), _length(length, ground), ha='center',
              va='bottom', color=INK, fontsize=10,
              bbox={'boxstyle': 'round,pad=0.2', 'facecolor': WHITE, 'edgecolor': 'none', 'alpha': 0.8})


def _length(length: float, ground: GroundPlane) -> str:
    return f'{length:g} m' if ground.metric else f'{length:g} camera heights'
