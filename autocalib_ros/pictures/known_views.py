"""The views that a saved calibration gives of images of a size: undistorted, and the road from above."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.pictures.plotted import PlotOverlay, draw_metre_grid, draw_scale_bar
from autocalib_ros.pictures.views import MAX_DISTANCE_HEIGHTS, TopView, length_unit, rectification_map, resample
from autocalib_ros.results.saved_camera import SavedCamera

LONGEST_PX = 1000
"""Longer side of a view from above for which no scale is given."""
MAX_SIDE_PX = 16384


def rectified_renderer(known: SavedCamera, balance: float | None) -> Callable[[np.ndarray], np.ndarray]:
    """Return what undistorts images; without a balance as the P of the file says, or else as 0 does.

    InputError where the lens leaves a part of the image empty, so that nothing tells how large the view would be.
    """
    if balance is not None and not 0.0 <= balance <= 1.0:
        raise UsageError(f'the balance lies between 0, valid pixels only, and 1, all of the lens; got {balance:g}')
    matrix = known.rectified if balance is None else None
    if matrix is None:
        matrix = rectified_matrix(known, balance or 0.0)
    if not np.isfinite(matrix).all():
        raise InputError(
            'the distortion folds back before the border of the image, so that a view without distortion'
            ' has no size: give a calibration that was taken with the pattern near the borders too'
        )
    sources = rectification_map(known, matrix)
    return lambda image: resample(image, sources)


def choose_top_view(
    known: SavedCamera,
    px_per_m: float | None = None,
    x_m: tuple[float, float] | None = None,
    y_m: tuple[float, float] | None = None,
) -> TopView:
    """Return the road from above: the ranges of x and y that are asked for, elsewhere what the image shows.

    InputError where there is no plane or no road to see, UsageError for ranges and scales that make no picture.
    """
    if known.ground is None:
        raise InputError('it holds no ground plane: calibrate with --camera-height')
    for name, span in (('x', x_m), ('y', y_m)):
        if span is not None and not (np.isfinite(span).all() and span[0] < span[1]):
            raise UsageError(f'--{name} takes the lower and then the higher end in metres, got {span[0]:g} {span[1]:g}')
    if px_per_m is not None and not (np.isfinite(px_per_m) and px_per_m > 0):
        raise UsageError(f'--px-per-m is more than 0, got {px_per_m:g}')
    shown = TopView.of_image(known.lens, known.ground, LONGEST_PX)
    if shown is None and (x_m is None or y_m is None):
        raise InputError(
            f'the image shows no road nearer than {MAX_DISTANCE_HEIGHTS:g} times the height of the camera:'
            ' say where to look by --x and --y'
        )
    spans = np.array([span or (shown.low_m[axis], shown.high_m[axis]) for axis, span in enumerate((x_m, y_m))])
    longest = LONGEST_PX if px_per_m is None else px_per_m * float((spans[:, 1] - spans[:, 0]).max())
    if not 2 <= longest <= MAX_SIDE_PX:
        raise UsageError(
            f'the view would have {longest:.0f} pixels along its longer side, and 2 to {MAX_SIDE_PX} are'
            ' made: choose another --px-per-m, or other ranges'
        )
    return TopView.between(spans[:, 0], spans[:, 1], round(longest))


def top_view_renderer(
    known: SavedCamera, view: TopView, *, grid: bool, scale_bar: bool
) -> Callable[[np.ndarray], np.ndarray]:
    """Return what makes a view of images, with what is to be drawn over it."""
    sources = view.sources(known.lens, known.ground)
    drawings = [draw for draw, wanted in ((draw_metre_grid, grid), (draw_scale_bar, scale_bar)) if wanted]
    overlay = PlotOverlay.render(
        view.columns, view.rows, lambda axes: [draw(axes, view, length_unit(known.ground)) for draw in drawings]
    )
    return lambda image: overlay.composite(resample(image, sources))
