"""Views of images with a saved calibration: undistorted view and top view of the road."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.pictures.annotations import add_metre_grid, add_scale_bar
from autocalib_ros.pictures.drawing import Overlay, line_px, text_height_px
from autocalib_ros.pictures.scene_geometry import ScaleBar
from autocalib_ros.pictures.views import MAX_DISTANCE_HEIGHTS, TopView, length_unit, rectification_map, resample
from autocalib_ros.results.saved_camera import SavedCamera

LONGEST_PX = 1000
"""Longer side of a top view without a given scale, pixels."""
MAX_SIDE_PX = 16384
"""Longest side of a top view, pixels."""


def rectified_renderer(known: SavedCamera, balance: float | None) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that undistorts images; without a balance by P of the file, or as balance 0 if it has none.

    UsageError for an invalid balance, InputError if the distortion is not invertible up to the image border.
    """
    if balance is not None and not 0.0 <= balance <= 1.0:
        raise UsageError(
            f'the balance lies between 0 (valid pixels only) and 1 (entire field of view); got {balance:g}'
        )
    matrix = known.rectified if balance is None else None
    if matrix is None:
        matrix = rectified_matrix(known, balance or 0.0, float(known.matrix[1, 1] / known.matrix[0, 0]))
    if not np.isfinite(matrix).all():
        raise InputError(
            'the distortion folds back before the border of the image, so the undistorted view has no size:'
            ' give a calibration taken with the pattern near the borders too'
        )
    sources = rectification_map(known, matrix)
    return lambda image: resample(image, sources)


def require_ground(known: SavedCamera) -> GroundPlane:
    """Return the ground plane; InputError if there is none."""
    if known.ground is None:
        raise InputError('it holds no ground plane: calibrate with --camera-height')
    return known.ground


def choose_top_view(
    known: SavedCamera,
    px_per_m: float | None = None,
    x_m: tuple[float, float] | None = None,
    y_m: tuple[float, float] | None = None,
) -> TopView:
    """Return a top view of the given ranges of x and y; by default of the visible road.

    InputError if there is no ground plane or no visible road, UsageError for invalid ranges and scales.
    """
    ground = require_ground(known)
    for name, span in (('x', x_m), ('y', y_m)):
        if span is not None and not (np.isfinite(span).all() and span[0] < span[1]):
            raise UsageError(f'--{name} takes the lower and then the higher end in metres, got {span[0]:g} {span[1]:g}')
    if px_per_m is not None and not (np.isfinite(px_per_m) and px_per_m > 0):
        raise UsageError(f'--px-per-m is more than 0, got {px_per_m:g}')
    low, high = _ranges(known, ground, x_m, y_m)
    longest = LONGEST_PX if px_per_m is None else px_per_m * float((high - low).max())
    if not 2 <= longest <= MAX_SIDE_PX:
        raise UsageError(
            f'the view would have {longest:.0f} pixels along its longer side; 2 to {MAX_SIDE_PX} are possible:'
            ' choose another --px-per-m, or other ranges'
        )
    return TopView.between(low, high, round(longest))


def _ranges(
    known: SavedCamera, ground: GroundPlane, x_m: tuple[float, float] | None, y_m: tuple[float, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner (2,) of a top view in metres."""
    if x_m is not None and y_m is not None:
        return np.array([x_m[0], y_m[0]]), np.array([x_m[1], y_m[1]])
    shown = TopView.of_image(known, ground, LONGEST_PX)
    if shown is None:
        raise InputError(
            f'the image shows no road within {MAX_DISTANCE_HEIGHTS:g} camera heights: give the ranges by --x and --y'
        )
    spans = np.array([span or (shown.low_m[axis], shown.high_m[axis]) for axis, span in enumerate((x_m, y_m))])
    return spans[:, 0], spans[:, 1]


def top_view_renderer(
    known: SavedCamera, view: TopView, *, grid: bool, scale_bar: bool
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that renders top views of images, with a metre grid and a scale bar if requested."""
    ground = require_ground(known)
    sources = view.sources(known, ground)
    overlay, text_height = Overlay(view.rows, view.columns), text_height_px(view.rows)
    if grid:
        add_metre_grid(overlay, view, length_unit(ground))
    if scale_bar:
        bar = ScaleBar.of(view, ground)
        add_scale_bar(overlay, bar, text_height, view.rows - text_height, text_height, line_px(view.rows))
    return lambda image: overlay.composite(resample(image, sources))
