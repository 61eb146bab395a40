"""Figures of the residuals of a solution, in observed pixels."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from autocalib_ros.evidence.snapshot import COVERAGE_CELLS
from autocalib_ros.pictures.drawing import INK
from autocalib_ros.report.canvas import TURNING_COLOUR, cell_map, chart, draw_legend, road_colour
from autocalib_ros.report.scene import ReportScene

SHOWN_QUANTILE = 0.98
"""Quantile of the residuals at which the axis ends; larger ones are tracking errors."""
BINS = 50
"""Bins of the histogram of residuals."""
MIN_RESIDUALS_PER_CELL = 10
"""Least number of residuals for the median of a cell."""


def residuals(scene: ReportScene) -> Figure | None:
    """Draw the distribution of residuals of each road and of turning vehicles."""
    found = scene.result.figures.residuals
    if not len(found.distance_px):
        return None
    figure, (axes,) = chart(3.4)
    edges = np.linspace(0, max(np.quantile(found.distance_px, SHOWN_QUANTILE), 1e-3), BINS + 1)
    for road in np.unique(found.roads):
        distance = found.distance_px[found.roads == road]
        name = 'turning vehicles' if road < 0 else f'road {road + 1}'
        share = np.histogram(distance, edges)[0] / len(distance)
        axes.stairs(
            100 * share,
            edges,
            color=TURNING_COLOUR if road < 0 else road_colour(int(road)),
            linewidth=1.8,
            label=f'{name}: median {np.median(distance):.2f} px, {len(distance)} points',
        )
    axes.set_xlim(0, edges[-1])
    axes.set_xlabel('distance between observed and predicted point, px', color=INK)
    axes.set_ylabel('fraction of the points, %', color=INK)
    draw_legend(axes)
    return figure


def residual_map(scene: ReportScene) -> Figure | None:
    """Draw the median residual of each image cell."""
    found = scene.result.figures.residuals
    if not len(found.distance_px):
        return None
    columns, rows = COVERAGE_CELLS
    column, row = np.floor(found.points_px / scene.evidence.image_size * COVERAGE_CELLS).astype(int).T
    cell = np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1)
    medians = np.full(rows * columns, np.nan)
    for index, count in zip(*np.unique(cell, return_counts=True), strict=True):
        if count >= MIN_RESIDUALS_PER_CELL:
            medians[index] = np.median(found.distance_px[cell == index])
    if not np.isfinite(medians).any():
        return None
    return cell_map(
        scene,
        np.ma.masked_invalid(medians.reshape(rows, columns)),
        Normalize(0, np.nanquantile(medians, SHOWN_QUANTILE)),
        'median residual in a cell, px',
    )
