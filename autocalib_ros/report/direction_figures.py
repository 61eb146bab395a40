"""Figures of directions: orientations of motion segments, horizon and vanishing points."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autocalib_ros.estimation.paper.vanishing_point_voting import segment_orientations
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.pictures.drawing import INK
from autocalib_ros.pictures.views import project_great_circle
from autocalib_ros.report.canvas import MUTED_COLOUR, WHITE, chart, draw_legend, image_axes, plot_paths, road_colour
from autocalib_ros.report.scene import ReportScene

HORIZON_COLOUR = '#aa3377'
MARGIN = 0.35
"""Border shown around the image, fraction of its size: vanishing points may lie there."""
MAX_SEGMENTS = 2500
"""Most segments drawn per cluster: more would hide each other."""


def orientation_histogram(scene: ReportScene) -> Figure | None:
    """Draw the histogram of segment orientations with the two peaks and their clusters."""
    figures = scene.result.figures
    counts, half = figures.orientation_histogram, scene.options.paper.cluster_deg
    if not len(counts):
        return None
    figure, (axes,) = chart(3.2)
    width = np.median(np.diff(counts[:, 0])) if len(counts) > 1 else 1.0
    colours = np.full(len(counts), MUTED_COLOUR, object)
    for index, peak in enumerate(figures.orientation_peaks_deg):
        near = orientation_difference_deg(counts[:, 0], peak) <= half
        colours[near] = road_colour(index)
        axes.plot([], [], 's', color=road_colour(index), label=f'cluster {index + 1}: {peak:.0f} ± {half:g} degrees')
    axes.bar(counts[:, 0], counts[:, 1], width=width, color=list(colours))
    axes.set_xlabel('orientation in the undistorted image, degrees (0 across, 90 down)', color=INK)
    axes.set_ylabel('segments', color=INK)
    axes.set_ylim(0, 1.35 * max(counts[:, 1].max(), 1))
    axes.set_xticks(np.arange(counts[0, 0] // 30 * 30, counts[-1, 0] + 30, 30))
    draw_legend(axes, 'upper center')
    return figure


def clusters(scene: ReportScene) -> Figure | None:
    """Draw the segments of the two clusters in the undistorted image."""
    peaks, calibration = scene.result.figures.orientation_peaks_deg, scene.calibration
    if calibration is None or not peaks or not len(scene.evidence.segments_px):
        return None
    from autocalib_ros.report.lens_figures import undistorted_axes

    found = segment_orientations(calibration.camera, scene.evidence.segments_px, scene.options.paper)
    camera = calibration.camera
    matrix = rectified_matrix(camera, pixel_aspect=camera.pixel_aspect)
    # the segments refer to a camera with the same focal length and principal point (0, 0)
    ends = found.ends_px * (matrix[[0, 1], [0, 1]] / camera.focal_px) + matrix[:2, 2]
    figure, axes = undistorted_axes(scene)
    for index, peak in enumerate(peaks):
        near = ends[orientation_difference_deg(found.orientation_deg, peak) <= scene.options.paper.cluster_deg]
        shown = near[np.linspace(0, len(near) - 1, min(len(near), MAX_SEGMENTS)).astype(int)]
        plot_paths(axes, list(shown), road_colour(index), f'cluster {index + 1}: {len(near)} segments')
    draw_legend(axes)
    return figure


def orientation_difference_deg(orientations_deg: np.ndarray, peak_deg: float) -> np.ndarray:
    """Return the angle between undirected orientations (n,) and a peak, 0 to 90 degrees."""
    return np.abs((orientations_deg - peak_deg + 90.0) % 180.0 - 90.0)


def directions(scene: ReportScene) -> Figure | None:
    """Draw the horizon, the vanishing points and lines through them in the original image."""
    if scene.calibration is None:
        return None
    camera, ground = scene.calibration.camera, scene.calibration.ground
    if ground is None and not len(scene.calibration.road_directions):
        return None
    figure, axes = image_axes(scene, margin=MARGIN)
    for index, direction in enumerate(scene.calibration.road_directions):
        _draw_direction(axes, camera, direction, index)
    if ground is not None:
        plot_paths(axes, project_great_circle(camera, ground.normal_in_camera), HORIZON_COLOUR, 'horizon', width=2.5)
    draw_legend(axes, 'lower right')  # roads vanish above
    return figure


def _draw_direction(axes: Axes, camera: Camera, direction: np.ndarray, index: int) -> None:
    """Draw great circles through a direction and points of the image, and its vanishing points."""
    across = np.linspace(0.1, 0.9, 5) * camera.width
    down = np.linspace(0.35, 0.95, 3) * camera.height
    bearings, _ = camera.unproject(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    lines = []
    for bearing in bearings:
        normal = np.cross(direction, bearing)
        if np.linalg.norm(normal) > 0.05:
            lines += project_great_circle(camera, normal)
    plot_paths(axes, lines, road_colour(index), f'lines along road {index + 1}', width=0.7, alpha=0.6)
    draw_vanishing_points(axes, camera, direction, index)


def draw_vanishing_points(axes: Axes, camera: Camera, direction: np.ndarray, index: int) -> None:
    """Mark both vanishing points of road `index` with a direction (3,), in or near the image."""
    ends, valid = camera.project(np.array([direction, -np.asarray(direction)]))
    size = np.array([camera.width, camera.height])
    ends = ends[valid & (np.abs(ends / size - 0.5) < 0.5 + MARGIN).all(axis=1)]
    if len(ends):
        axes.plot(
            *ends.T,
            'o',
            color=road_colour(index),
            markersize=9,
            markeredgecolor=WHITE,
            label=f'vanishing point{"s" if len(ends) > 1 else ""} of road {index + 1}',
        )
