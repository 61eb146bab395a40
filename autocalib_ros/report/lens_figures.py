"""Figures of the lens: undistorted image, straightness, and error against focal length."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.pictures.drawing import INK
from autocalib_ros.pictures.views import rectification_map, resample
from autocalib_ros.report.canvas import (
    MUTED_COLOUR,
    chart,
    draw_legend,
    image_axes,
    label_colour,
    mapped,
    plot_paths,
    road_colour,
)
from autocalib_ros.report.scene import ReportScene
from autocalib_ros.results.calibration import Calibration

MIN_ERROR_PX = 1e-3
"""Lower limit of straightness errors, for logarithmic axes."""


def undistorted(scene: ReportScene) -> Figure | None:
    """Draw the undistorted background with the kept tracks, which should be straight there."""
    if scene.calibration is None or (scene.background is None and not scene.groups()):
        return None
    camera = scene.calibration.camera
    matrix = rectified_matrix(camera, pixel_aspect=camera.pixel_aspect)
    figure, axes = undistorted_axes(scene)
    for name, label, tracks in scene.groups():
        paths = mapped(lambda pixels: in_undistorted(camera, matrix, pixels), tracks)
        plot_paths(axes, paths, label_colour(label), name, alpha=0.6, width=0.8)
    draw_legend(axes)
    return figure


def undistorted_axes(scene: ReportScene) -> tuple[Figure, Axes]:
    """Return a figure with axes in pixel coordinates over the undistorted background."""
    camera, picture = scene.calibrated.camera, scene.background
    if picture is not None:
        picture = resample(
            picture, rectification_map(camera, rectified_matrix(camera, pixel_aspect=camera.pixel_aspect))
        )
    return image_axes(scene, picture=picture)


def in_undistorted(camera: Camera, matrix: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return pixels (n, 2) in the undistorted image with matrix (3, 3); nan 90 degrees or more off the axis."""
    bearings, valid = camera.unproject(pixels)
    ahead = valid & (bearings[:, 2] > 1e-6)
    flat = bearings[:, :2] / np.where(ahead, bearings[:, 2], np.nan)[:, None]
    return flat * matrix[[0, 1], [0, 1]] + matrix[:2, 2]


def straightness(scene: ReportScene) -> Figure | None:
    """Draw the straightness error of each kept track before and after undistortion."""
    if scene.calibration is None or not scene.roads:
        return None
    figure, (axes,) = chart(4.4)
    camera, ends = scene.calibration.camera, []
    for label in scene.roads:
        paths = scene.paths(label)
        straightened = mapped(camera.undistort, paths)
        errors = np.array([[line_error_px(path) for path in each] for each in (paths, straightened)]).T
        errors = np.maximum(errors[np.isfinite(errors).all(axis=1)], MIN_ERROR_PX)
        if len(errors):
            before, after = np.median(errors, axis=0)
            ends.append(errors)
            axes.loglog(
                *errors.T,
                'o',
                color=road_colour(label),
                alpha=0.6,
                markersize=4,
                label=f'{scene.road_name(label)}: median {before:.2f} px before, {after:.2f} px after',
            )
    if not ends:
        return None
    span = [np.concatenate(ends).min(), np.concatenate(ends).max()]
    axes.plot(span, span, color=MUTED_COLOUR, linewidth=1, label='no change')
    axes.set_ylim(top=span[1] * 12)  # room for the legend
    axes.set_xlabel('distance from a straight line before undistortion, px (root mean square)', color=INK)
    axes.set_ylabel('after undistortion, px', color=INK)
    draw_legend(axes, 'upper left')
    return figure


def line_error_px(points: np.ndarray) -> float:
    """Return the root mean square distance of points (n, 2) from their least-squares line."""
    if not np.isfinite(points).all():
        return np.nan
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(points)))


def focal_sweep(scene: ReportScene) -> Figure | None:
    """Draw the straightness error over trial focal lengths, with the result."""
    sweep = scene.result.figures.focal_sweep_px
    sweep = sweep[np.isfinite(sweep).all(axis=1)] if len(sweep) else sweep
    if not len(sweep):
        return None
    figure, (axes,) = chart(3.6)
    axes.plot(*sweep.T, color=INK, linewidth=1.6)
    if (sweep[:, 1] > 0).all():
        axes.set_yscale('log')
    if scene.calibration is not None:
        _mark_focal(axes, scene.calibration)
        axes.set_xlim(*_around(scene.calibration, sweep[:, 0]))
    axes.set_xlabel('trial focal length, px', color=INK)
    axes.set_ylabel('straightness error, px²', color=INK)
    draw_legend(axes, 'upper center')
    return figure


def _around(calibration: Calibration, trials: np.ndarray) -> tuple[float, float]:
    """Return the plotted range of trial focal lengths, from half to twice the results."""
    found = [calibration.camera.focal_px] + ([calibration.paper.focal_px] if calibration.paper else [])
    return max(0.5 * min(found), float(trials.min())), min(2.0 * max(found), float(trials.max()))


def _mark_focal(axes: Axes, calibration: Calibration) -> None:
    """Mark the result with its two-sigma interval, and the result of the published method."""
    focal, sigma = calibration.camera.focal_px, calibration.stddev.focal_px
    paper = calibration.paper if calibration.method != 'paper' else None
    spread = f' ± {sigma:.1f}' if sigma else ''
    axes.axvline(focal, color=road_colour(0), linewidth=2, label=f'result: {focal:.1f}{spread} px')
    if sigma:
        axes.axvspan(
            focal - 2 * sigma,
            focal + 2 * sigma,
            color=road_colour(0),
            alpha=0.2,
            linewidth=0,
            label=f'95 % interval: {focal - 2 * sigma:.1f} to {focal + 2 * sigma:.1f} px',
        )
    if paper is not None:
        axes.axvline(
            paper.focal_px,
            color=road_colour(1),
            linestyle='--',
            linewidth=1.6,
            label=f'published method: {paper.focal_px:.1f} px',
        )
