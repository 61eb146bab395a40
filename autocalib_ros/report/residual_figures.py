"""What the solution leaves unexplained, in observed pixels."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from autocalib_ros.evidence.snapshot import COVERAGE_CELLS
from autocalib_ros.report.canvas import INK, TURNING, cell_map, chart, draw_legend, road_colour
from autocalib_ros.report.scene import Scene

SHOWN = 0.98
"""Share of the residuals that a diagram reaches to; the few beyond are the mistakes of tracking."""
BINS = 50
LEAST_IN_CELL = 10
"""Fewer residuals say nothing of their cell."""


def residuals(scene: Scene) -> Figure | None:
    """Draw how far observed points lie from where the solution has them, for each road and for what turns."""
    told = scene.result.figures.residuals
    if not len(told.distance_px):
        return None
    figure, (axes,) = chart(3.4)
    edges = np.linspace(0, max(np.quantile(told.distance_px, SHOWN), 1e-3), BINS + 1)
    for road in np.unique(told.roads):
        distance = told.distance_px[told.roads == road]
        name = 'vehicles that turn' if road < 0 else f'road {road + 1}'
        share = np.histogram(distance, edges)[0] / len(distance)
        axes.stairs(100 * share, edges, color=TURNING if road < 0 else road_colour(int(road)),
                    linewidth=1.8, label=f'{name}: median {np.median(distance):.2f} px, {len(distance)} points')
    axes.set_xlim(0, edges[-1])
    axes.set_xlabel('distance of an observed point from its place in the solution, px', color=INK)
    axes.set_ylabel('share of the points, %', color=INK)
    draw_legend(axes)
    return figure


def residual_map(scene: Scene) -> Figure | None:
    """Colour the cells of the image by the median residual in each."""
    told = scene.result.figures.residuals
    if not len(told.distance_px):
        return None
    columns, rows = COVERAGE_CELLS
    column, row = np.floor(told.points_px / scene.evidence.image_size * COVERAGE_CELLS).astype(int).T
    cell = np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1)
    medians = np.full(rows * columns, np.nan)
    for index, count in zip(*np.unique(cell, return_counts=True), strict=True):
        if count >= LEAST_IN_CELL:
            medians[index] = np.median(told.distance_px[cell == index])
    if not np.isfinite(medians).any():
        return None
    return cell_map(scene, np.ma.masked_invalid(medians.reshape(rows, columns)),
                    Normalize(0, np.nanquantile(medians, SHOWN)), 'median distance in a cell, px')
