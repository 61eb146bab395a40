"""Figures of the observed traffic: all tracks, kept tracks and image coverage."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from autocalib_ros.evidence.snapshot import COVERAGE_CELLS
from autocalib_ros.report.canvas import TURNING_COLOUR, cell_map, draw_legend, image_axes, label_colour, plot_paths
from autocalib_ros.report.scene import NOT_USED, REJECTED, ReportScene


def all_tracks(scene: ReportScene) -> Figure | None:
    """Draw all trajectories over the background; None if there are neither."""
    if scene.background is None and not scene.evidence.track_count:
        return None
    figure, axes = image_axes(scene)
    paths = [track.points_px for track in scene.evidence.tracks()]
    plot_paths(axes, paths, '#3355bb', f'{len(paths)} trajectories', width=0.9, alpha=0.55)
    if paths:
        ends = np.array([path[-1] for path in paths])
        axes.plot(*ends.T, '.', color='#1b2f77', markersize=2.5, label='end points')
    draw_legend(axes)
    return figure


def kept_tracks(scene: ReportScene) -> Figure | None:
    """Draw the trajectories coloured by road, and turning vehicles; None if nothing was kept."""
    if not scene.roads and not len(scene.turning_px):
        return None
    figure, axes = image_axes(scene)
    for label in (NOT_USED, REJECTED, *scene.roads):
        paths, used = scene.paths(label), label >= 0
        plot_paths(
            axes,
            paths,
            label_colour(label),
            f'{scene.road_name(label)}: {len(paths)}',
            width=1.0 if used else 0.7,
            alpha=0.7 if used else 0.5,
        )
    if len(scene.turning_px):
        axes.plot(
            *scene.turning_px.T,
            '.',
            color=TURNING_COLOUR,
            markersize=2,
            label=f'on turning vehicles: {len(scene.turning_px)} points',
        )
    draw_legend(axes)
    return figure


def coverage(scene: ReportScene) -> Figure | None:
    """Draw the number of tracks that cross each image cell; empty cells stay clear."""
    evidence = scene.evidence
    if not evidence.track_count:
        return None
    cells = np.floor(evidence.points_px / evidence.image_size * COVERAGE_CELLS).astype(int)
    column, row = np.clip(cells, 0, np.array(COVERAGE_CELLS) - 1).T
    tracks = np.repeat(np.arange(evidence.track_count), np.diff(evidence.track_starts))
    columns, rows = COVERAGE_CELLS
    crossed = np.unique((tracks * rows + row) * columns + column) % (rows * columns)
    counts = np.bincount(crossed, minlength=rows * columns).reshape(rows, columns)
    return cell_map(scene, np.ma.masked_equal(counts, 0), LogNorm(1, max(counts.max(), 10)), 'trajectories in a cell')


def coverage_note(scene: ReportScene) -> str:
    """State the coverage and the required coverage."""
    least = scene.options.gate.min_coverage
    return f'Here {100 * scene.evidence.coverage:.0f} % of the image; at least {100 * least:.0f} % required.'
