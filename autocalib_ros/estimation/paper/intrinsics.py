"""Intrinsic stage of Jain & Saunier (arXiv 2001.07243): focal length from the straightness of tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import PaperOptions
from autocalib_ros.estimation.observations.track_set import path_lengths
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import PaperReport

RIM_MARGIN = 1.02
"""Margin of the shortest trial focal length: it keeps tracked points within 90 degrees, where the tangent changes sign.
"""


@dataclass(frozen=True)
class PaperIntrinsics:
    """Result of the intrinsic stage, with the interval of the median focal length."""

    report: PaperReport
    sweep: np.ndarray
    """Trial focal length in pixels and summed squared error in px^2, shape (n, 2)."""
    tracks: np.ndarray
    """Indices of the tracks in the evidence, shape (m,)."""


@dataclass(frozen=True)
class ObservedInterval:
    """Tracks that the paper keeps of one observed interval, longest first."""

    paths: list[np.ndarray]
    """Pixels of each track, shape (n, 2)."""
    tracks: list[int]
    """Indices in the evidence."""


def paper_intervals(evidence: Evidence, options: PaperOptions) -> list[ObservedInterval]:
    """Apply the paper's two filters in each interval of `window_s` and keep the longest tracks.

    A track passes if it lasts for `min_lifetime` of the interval and its path is at most `max_path_ratio` times its
    displacement. Intervals with fewer tracks than the fullest are dropped, so that all estimates use the same number.
    """
    starts, tracks, intervals = _split_by_interval(evidence, options.window_s)
    points, times = evidence.points_px, evidence.times_s
    first, last = starts[:-1], starts[1:] - 1
    displacement = np.hypot(*(points[last] - points[first]).T)
    kept = (
        (last - first > 1)
        & (times[last] - times[first] >= options.min_lifetime * options.window_s)
        & (displacement > 0)
        & (path_lengths(points, starts) <= options.max_path_ratio * displacement)
    )
    longest = []
    for interval in np.unique(intervals[kept]):
        inside = np.flatnonzero(kept & (intervals == interval))
        longest.append(inside[np.argsort(-displacement[inside], kind='stable')[: options.longest]])
    fullest = max(map(len, longest), default=0)
    return [
        ObservedInterval([points[starts[part] : starts[part + 1]] for part in parts], tracks[parts].tolist())
        for parts in longest
        if len(parts) == fullest
    ]


def _split_by_interval(evidence: Evidence, window_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split tracks at the borders of the intervals.

    Returns the index of the first point of each part, followed by the number of points (parts + 1,), and the track and
    the interval of each part (parts,).
    """
    intervals = np.floor(evidence.times_s / window_s).astype(int)
    begins = np.diff(intervals, prepend=0) != 0
    begins[evidence.track_starts[:-1]] = True
    starts = np.flatnonzero(begins)
    tracks = np.searchsorted(evidence.track_starts, starts, side='right') - 1
    return np.append(starts, len(intervals)), tracks, intervals[starts]


def paper_intrinsics(evidence: Evidence, options: PaperOptions) -> PaperIntrinsics | None:
    """Run the paper's intrinsic stage on each interval and return the result of the median focal length.

    The paper uses a single clip; the median over intervals is robust. Intervals whose smallest error is at an end of
    the sweep have no minimum and are used only where no interval has one. None where no track passes the filters.
    """
    intervals = paper_intervals(evidence, options)
    if not intervals:
        return None
    centre = np.asarray(evidence.picture.lens_centre_px)
    sweeps = [_sweep(interval, centre, evidence.image_size, options) for interval in intervals]
    minima = [int(np.argmin(sweep[:, 1])) for sweep in sweeps]
    inside = [index for index, minimum in enumerate(minima) if 0 < minimum < options.focal_steps - 1]
    candidates = sorted(inside or range(len(sweeps)), key=lambda index: sweeps[index][minima[index], 0])
    median = candidates[(len(candidates) - 1) // 2]
    focal, paths = float(sweeps[median][minima[median], 0]), intervals[median].paths
    camera = Camera(*evidence.image_size, focal, evidence.picture.lens_centre_px)
    before = np.mean([_line_fit_errors(path) / len(path) for path in paths])
    after = np.mean([_line_fit_errors(camera.undistort(path)) / len(path) for path in paths])
    report = PaperReport(
        focal_px=camera.focal_px,
        polynomial_k=distortion_polynomial(camera),
        straightness_px2=(float(before), float(after)),
    )
    return PaperIntrinsics(report, sweeps[median], np.array(intervals[median].tracks, int))


def _sweep(
    interval: ObservedInterval, centre: np.ndarray, image_size: tuple[int, int], options: PaperOptions
) -> np.ndarray:
    """Return trial focal lengths up to the image diagonal and their summed squared line errors, shape (n, 2).

    `centre` (2,) is the principal point.
    """
    radii = [np.hypot(*(path - centre).T) for path in interval.paths]
    lowest = RIM_MARGIN * max(radius.max() for radius in radii) / (np.pi / 2)
    diagonal = float(np.hypot(*image_size))
    trials = np.linspace(max(lowest, diagonal / options.focal_steps), diagonal, options.focal_steps)
    errors = np.zeros(len(trials))
    for path, radius in zip(interval.paths, radii, strict=True):
        theta = np.maximum(radius, 1e-9) / trials[:, None]
        errors += _line_fit_errors((path - centre) * (np.tan(theta) / theta)[..., None])
    return np.column_stack([trials, errors])


def _line_fit_errors(points: np.ndarray) -> np.ndarray:
    """Return the summed squared distances of points (..., n, 2) from their total least squares line, shape (...)."""
    x, y = np.moveaxis(points - points.mean(axis=-2, keepdims=True), -1, 0)
    xx, xy, yy = (x * x).sum(-1), (x * y).sum(-1), (y * y).sum(-1)
    return np.maximum(0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy)), 0.0)


def distortion_polynomial(camera: Camera) -> tuple[float, float, float]:
    """Fit the paper's k1..k3 in `x_u / x_d - 1 = k1 r^2 + k2 r^4 + k3 r^6` on normalised distorted radii.

    Maps distorted to undistorted, the inverse of OpenCV's plumb_bob: for the report only, not for CameraInfo.D.
    """
    corner = np.hypot(camera.width, camera.height) / 2
    r = np.linspace(0.02, 1.0, 200) * min(corner, camera.focal_px * np.radians(80.0)) / camera.focal_px
    powers = np.column_stack([r**2, r**4, r**6])
    k, *_ = np.linalg.lstsq(powers, np.tan(r) / r - 1, rcond=None)
    return float(k[0]), float(k[1]), float(k[2])
