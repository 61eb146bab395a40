"""Figure of what was found so far where there is no calibration, and of the still lines along and across the road."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from autocalib_ros.lens.camera import Camera, field_of_view_deg
from autocalib_ros.pictures.views import project_great_circle
from autocalib_ros.report.canvas import MUTED_COLOUR, draw_legend, image_axes, label_colour, plot_paths, road_colour
from autocalib_ros.report.direction_figures import HORIZON_COLOUR, draw_vanishing_points
from autocalib_ros.report.scene import REJECTED, ReportScene

MAX_LINE_ANGLE_DEG = 2.0
"""Largest angle between a still line and a direction of the road, seen from the camera, at which it counts as along it:
two standard deviations of the ends of a short line, and of posts that lean."""
LINE_DIRECTIONS = {'along the road': 0, 'across it': 1, 'upright': 2}


def roads_so_far(scene: ReportScene) -> Figure | None:
    """Draw the straight roads that were found, where they vanish, and the horizon; None with a calibration."""
    sketch = scene.sketch
    if sketch is None:
        return None
    figure, axes = image_axes(scene, margin=0.35)
    plot_paths(
        axes, _labelled(scene, sketch.labels, REJECTED), label_colour(REJECTED), 'on none of them', width=0.7, alpha=0.5
    )
    for road, share in enumerate(sketch.shares):
        name = f'road {road + 1}: {share:.0%} of the vehicles'
        plot_paths(axes, _labelled(scene, sketch.labels, road), road_colour(road), name, width=1.0, alpha=0.7)
        draw_vanishing_points(axes, sketch.camera, sketch.directions[road], road)
    if sketch.horizon is not None:
        plot_paths(axes, project_great_circle(sketch.camera, sketch.horizon), HORIZON_COLOUR, 'horizon', width=2.5)
    draw_legend(axes, 'lower right')  # roads vanish above
    return figure


def sketch_note(scene: ReportScene) -> str:
    """Say which lens was assumed, and where the horizon comes from."""
    sketch = scene.sketch
    if sketch is None:
        return ''
    view_deg = field_of_view_deg(sketch.camera)[0]
    lens = f'Through an assumed lens that sees {view_deg:.0f} degrees'
    if sketch.horizon is None:
        return f'{lens}; no horizon has the traffic below it.'
    return f'{lens}; the horizon is that of {"both roads" if sketch.is_of_two_roads else "a camera without roll"}.'


def still_lines(scene: ReportScene) -> Figure | None:
    """Draw the lines of the still scene by the direction of the road that they follow; None without plane or lines."""
    lines = scene.evidence.still_lines_px
    if not scene.has_ground or not len(lines):
        return None
    directions = line_directions(scene.calibrated.camera, scene.ground.rotation.T, lines)
    figure, axes = image_axes(scene)
    plot_paths(axes, list(lines[directions < 0].reshape(-1, 2, 2)), MUTED_COLOUR, 'any other direction', width=0.8)
    for name, index in LINE_DIRECTIONS.items():
        paths = list(lines[directions == index].reshape(-1, 2, 2))
        plot_paths(axes, paths, road_colour(index), f'{name}: {len(paths)}', width=2.0)
    draw_legend(axes)
    return figure


def still_lines_note(scene: ReportScene) -> str:
    """Say whether the result rests on these lines."""
    found = scene.calibration
    if found is None:
        return ''
    kinds = {item.kind for item in (*found.assumptions, *found.checks)}
    used = kinds & {'lane_markings', 'single_road'}
    return 'They were used for this result.' if used else 'They were not needed for this result.'


def line_directions(camera: Camera, camera_from_ground: np.ndarray, lines_px: np.ndarray) -> np.ndarray:
    """Return for each of lines (n, 4) the axis of the ground frame, a column of the matrix, that it follows; else -1.

    A line in the image spans a plane through the camera, which contains the direction of the line in space.
    """
    bearings, valid = camera.unproject(np.reshape(lines_px, (-1, 2)))
    ends, seen = bearings.reshape(-1, 2, 3), valid.reshape(-1, 2).all(axis=1)
    planes = np.cross(ends[:, 0], ends[:, 1])
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arcsin(np.clip(np.abs(planes @ camera_from_ground), 0.0, 1.0)))
    best = angles.argmin(axis=1)
    return np.where(seen & (angles.min(axis=1) <= MAX_LINE_ANGLE_DEG), best, -1)


def _labelled(scene: ReportScene, labels: np.ndarray, label: int) -> list[np.ndarray]:
    return [scene.evidence.track(int(index)).points_px for index in np.flatnonzero(labels == label)]
