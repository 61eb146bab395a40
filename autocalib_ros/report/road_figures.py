"""Figures of the ground plane: grid in the image and top view."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.ground import Ground
from autocalib_ros.pictures.drawing import INK
from autocalib_ros.pictures.road import GroundGrid
from autocalib_ros.pictures.scene_geometry import ScaleBar, SceneGeometry
from autocalib_ros.pictures.views import (
    GRID_CELLS,
    TopView,
    format_length,
    grid_step,
    ground_to_image,
    image_to_ground,
    in_image,
    length_unit,
    nearby_road_points,
    resample,
)
from autocalib_ros.report.canvas import (
    BELOW_IN,
    DPI,
    EDGE_IN,
    HALO,
    LEFT_IN,
    PANEL_COLOUR,
    WHITE,
    WIDTH_IN,
    draw_legend,
    faded_rgb,
    image_axes,
    label_colour,
    mapped,
    plot_paths,
)
from autocalib_ros.report.scene import ReportScene

TOP_VIEW_PX = 1100
"""Longer side of the top view, pixels: hardly more than those in which it is shown."""
CONTOURS_M = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Candidate levels of the contours of position uncertainty, metres."""
MAX_SHOWN_SIGMA_M = 2.0
"""Largest standard deviation of a position that the top view shows, metres: half a lane and more."""
MAX_CONTOURS = 5
"""Most contours, the largest levels first."""
MAX_EXTENT_POINTS = 4000
"""Most tracked points from which the extent of a top view is taken: its border, the 2 and 98 % quantiles, is then known
to a fifth of a per cent of the points. Each point is projected through two dozen lenses."""
CONTOUR_SAMPLES = 90
"""Samples of the standard deviation along the longer side of the top view."""
GRID_COLOUR, CONTOUR_COLOUR = '#117733', '#aa0044'
X_AXIS, Y_AXIS = '#cc3311', '#0055aa'
LABEL_SPACING_FRACTION = 0.06
"""Least distance between two labels, fraction of the image width."""


def ground_grid(scene: ReportScene) -> Figure | None:
    """Draw a grid of squares on the road over the original image, with coordinates along two lines."""
    if not scene.has_ground:
        return None
    camera, ground = scene.calibrated.camera, scene.ground
    points = tracked_road_points(scene)
    if not len(points):
        view = TopView.of_image(camera, ground, 2)
        if view is None:
            return None
        points = np.array([view.low_m, view.high_m])
    geometry = SceneGeometry(camera, ground, GroundGrid.around(points, ground))
    figure, axes = image_axes(scene, fade=0.15)
    lines = geometry.grid_px()
    plot_paths(axes, lines, WHITE, width=2.0, alpha=0.5)
    plot_paths(axes, lines, GRID_COLOUR, f'squares of {format_length(grid_step(ground), ground)}', width=0.9, alpha=0.9)
    taken: list[np.ndarray] = []
    for index, (name, paths) in enumerate(geometry.axes_px().items()):
        colour, direction = (X_AXIS, Y_AXIS)[index], ('along the main traffic', 'to its left')[index]
        plot_paths(axes, paths, colour, f'{name}: {direction}, {length_unit(ground)}', width=4)
        _mark(axes, geometry, index, colour, taken)
    draw_legend(axes)
    return figure


def _mark(axes: Axes, geometry: SceneGeometry, index: int, colour: str, taken: list[np.ndarray]) -> None:
    """Label the grid crossings along a central line with their coordinates, nearest first, where there is room."""
    camera, ground, grid = geometry.camera, geometry.ground, geometry.grid
    if grid is None:
        return
    for offset in sorted(np.arange(-GRID_CELLS, GRID_CELLS + 1), key=abs):
        place = grid.middle_m + offset * grid.step_m * np.eye(2)[index]
        (pixel,) = ground_to_image(camera, ground, np.array([[*place, 0.0]]))
        room = LABEL_SPACING_FRACTION * camera.width
        low, high = np.array([0.5, 0.3]) * room, np.array([camera.width, camera.height]) - np.array([0.5, 0.3]) * room
        inside = np.isfinite(pixel).all() and (pixel > low).all() and (pixel < high).all()
        if not inside or any(np.hypot(*(pixel - other)) < room for other in taken):
            continue
        taken.append(pixel)
        axes.text(
            pixel[0],
            pixel[1],
            f'{"xy"[index]} {place[index]:g}',
            color=colour,
            fontsize=9,
            ha='center',
            va='center',
            bbox={'boxstyle': 'square,pad=0.1', 'facecolor': WHITE, 'edgecolor': 'none', 'alpha': 0.8},
        )


def tracked_road_points(scene: ReportScene) -> np.ndarray:
    """Return the tracked points on the road, up to `MAX_DISTANCE_HEIGHTS`, shape (n, 2)."""
    return nearby_road_points(scene.calibrated.camera, scene.ground, scene.evidence.points_px)


def top_view(scene: ReportScene) -> Figure | None:
    """Draw the top view of the road, main traffic to the right, with scale bar and contours of position uncertainty."""
    if not scene.has_ground:
        return None
    camera, ground = scene.calibrated.camera, scene.ground
    view = top_view_extent(scene, TOP_VIEW_PX)
    if view is None:
        return None
    figure, axes = ground_axes(view, ground)
    if scene.background is not None:
        extent = (view.low_m[0], view.high_m[0], view.low_m[1], view.high_m[1])
        axes.imshow(
            faded_rgb(resample(scene.background, view.sources(camera, ground)), 0.1),
            extent=extent,
            interpolation='nearest',
        )
    for _, label, tracks in scene.groups():
        paths = mapped(lambda pixels: image_to_ground(camera, ground, pixels), tracks)
        plot_paths(axes, paths, label_colour(label), width=0.7, alpha=0.35)
    _draw_contours(axes, scene, view)
    _draw_scale(axes, view, ground)
    if (np.array(view.low_m) < 0).all() and (np.array(view.high_m) > 0).all():
        axes.plot(0, 0, '^', color=X_AXIS, markersize=10, markeredgecolor=WHITE, linestyle='none', label='camera')
    draw_legend(axes)
    return figure


def top_view_extent(scene: ReportScene, longest_px: int) -> TopView | None:
    """Return the part of the road for a top view: where there was traffic, and positions are sure to 2 m."""
    points = tracked_road_points(scene)
    points = points[:: max(1, len(points) // MAX_EXTENT_POINTS)]
    sigma = position_sigma_m(scene, points) if len(points) else None
    if sigma is not None and (sigma <= MAX_SHOWN_SIGMA_M).any():
        points = points[sigma <= MAX_SHOWN_SIGMA_M]
    return TopView.around(points, scene.ground, longest_px) or TopView.of_image(
        scene.calibrated.camera, scene.ground, longest_px
    )


def ground_axes(view: TopView, ground: GroundPlane, below_in: float = 0.0) -> tuple[Figure, Axes]:
    """Return a figure with axes of the ground frame and `below_in` inches of free space below."""
    (low_x, low_y), (high_x, high_y) = view.low_m, view.high_m
    width_in = WIDTH_IN - LEFT_IN - EDGE_IN
    shown_in = min(width_in * (high_y - low_y) / (high_x - low_x), 1.2 * WIDTH_IN)
    height_in = shown_in + BELOW_IN + EDGE_IN + below_in
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI)
    axes = figure.add_axes(
        (LEFT_IN / WIDTH_IN, (BELOW_IN + below_in) / height_in, width_in / WIDTH_IN, shown_in / height_in)
    )
    axes.set_facecolor(PANEL_COLOUR)
    axes.set(xlim=(low_x, high_x), ylim=(low_y, high_y), aspect='equal')
    axes.set_xlabel(f'x, along the main traffic, {length_unit(ground)}', color=INK)
    axes.set_ylabel(f'y, {length_unit(ground)}', color=INK)
    return figure, axes


def position_sigma_m(scene: ReportScene, points_m: np.ndarray) -> np.ndarray | None:
    """Return one sigma in metres of road points (n, 2), nan outside the image; None if it is unknown."""
    calibration = scene.calibrated
    if not scene.ground.metric or calibration.covariance is None:
        return None
    camera = calibration.camera
    pixels = ground_to_image(camera, scene.ground, np.pad(points_m, ((0, 0), (0, 1))))
    inside = in_image(camera, pixels)
    sigma = Ground.of(calibration).points(np.where(inside[:, None], pixels, np.nan)).sigma_m
    return None if sigma is None else np.where(inside, sigma, np.nan)


def accuracy_note(scene: ReportScene) -> str:
    """Describe the contours of the top view, or say that there are none."""
    if scene.ground.metric and scene.calibrated.covariance is not None:
        return (
            'Dashed lines: one sigma of the position of a road point, from lens, pose and scale. The view ends where '
            f'it exceeds {MAX_SHOWN_SIGMA_M:g} m.'
        )
    return 'The position uncertainty of this result is unknown.'


def _draw_contours(axes: Axes, scene: ReportScene, view: TopView) -> None:
    """Draw contours of equal position uncertainty."""
    size = np.array([view.columns, view.rows])
    x, y = (
        np.linspace(view.low_m[axis], view.high_m[axis], count)
        for axis, count in enumerate(np.maximum(CONTOUR_SAMPLES * size // size.max(), 2))
    )
    sigma = position_sigma_m(scene, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    if sigma is None or not np.isfinite(sigma).any():
        return
    low, high = np.nanquantile(sigma, [0.01, 0.99])
    levels = [level for level in CONTOURS_M if low < level < high][-MAX_CONTOURS:]
    if not levels:
        return
    lines = axes.contour(
        x,
        y,
        np.ma.masked_invalid(sigma.reshape(len(y), len(x))),
        levels=levels,
        colors=CONTOUR_COLOUR,
        linewidths=1.4,
        linestyles='dashed',
    )
    for letters in axes.clabel(lines, fmt='± %g m', fontsize=9, inline=False):
        letters.set_path_effects(HALO)
    axes.plot([], [], '--', color=CONTOUR_COLOUR, linewidth=1.4, label='position uncertainty (1 sigma)')


def _draw_scale(axes: Axes, view: TopView, ground: GroundPlane) -> None:
    low, high = np.array(view.low_m), np.array(view.high_m)
    bar = ScaleBar.of(view, ground)
    begin = low + 0.04 * (high - low)
    axes.plot([begin[0], begin[0] + bar.length_m], [begin[1]] * 2, color=WHITE, linewidth=7, solid_capstyle='butt')
    axes.plot([begin[0], begin[0] + bar.length_m], [begin[1]] * 2, color=INK, linewidth=4, solid_capstyle='butt')
    axes.text(
        begin[0],
        begin[1] + 0.025 * (high[1] - low[1]),
        bar.text,
        va='bottom',
        color=INK,
        bbox={'boxstyle': 'round,pad=0.2', 'facecolor': WHITE, 'edgecolor': 'none', 'alpha': 0.8},
    )
