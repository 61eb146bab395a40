"""Focal length from the straightness of tracks: the published form, and a robust one on the sphere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import PaperOptions
from autocalib_ros.estimation.observations.track_set import TrackSet, path_lengths
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.great_circles import fit_circles, unproject_rays
from autocalib_ros.lens.camera import Camera, image_centre
from autocalib_ros.results.calibration import PaperReport

RIM_MARGIN = 1.02
"""The shortest trial focal length keeps tracked points this factor inside 90 degrees, where tan flips sign."""
TRACK_SCALE_PX = 1.0
"""Mean distance from its great circle at which a track is no longer believed to be straight."""


@dataclass(frozen=True)
class PaperIntrinsics:
    """Result of the published intrinsic stage, with the interval that it comes from."""

    report: PaperReport
    sweep: np.ndarray
    """Trial focal length and summed squared error, shape (n, 2)."""
    tracks: np.ndarray
    """Indices in the evidence of the tracks used."""


@dataclass(frozen=True)
class ObservedInterval:
    """One observed interval: pixel paths (n, 2) of the tracks that the paper keeps, longest first."""

    paths: list[np.ndarray]
    tracks: list[int]


def paper_intervals(evidence: Evidence, options: PaperOptions) -> list[ObservedInterval]:
    """Apply the paper's two filters in each observed interval of `window_s` and take the longest tracks.

    A track is kept if it lived for `min_lifetime` of the interval and its path is at most `max_path_ratio` its
    displacement. Intervals with fewer tracks than the fullest are left out: all estimates rest on as many.
    """
    starts, tracks, windows = _split_by_interval(evidence, options.window_s)
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
    for window in np.unique(windows[kept]):
        inside = np.flatnonzero(kept & (windows == window))
        longest.append(inside[np.argsort(-displacement[inside], kind='stable')[: options.longest]])
    fullest = max(map(len, longest), default=0)
    return [
        ObservedInterval([points[starts[part] : starts[part + 1]] for part in parts], tracks[parts].tolist())
        for parts in longest
        if len(parts) == fullest
    ]


def _split_by_interval(evidence: Evidence, window_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divide tracks into parts within an interval: where each begins, with the end (parts + 1,); track and interval."""
    windows = np.floor(evidence.times_s / window_s).astype(int)
    begins = np.diff(windows, prepend=0) != 0
    begins[evidence.track_starts[:-1]] = True
    starts = np.flatnonzero(begins)
    tracks = np.searchsorted(evidence.track_starts, starts, side='right') - 1
    return np.append(starts, len(windows)), tracks, windows[starts]


def paper_intrinsics(evidence: Evidence, options: PaperOptions) -> PaperIntrinsics | None:
    """Run the paper's intrinsic stage on each observed interval; the result is that of the median focal length.

    One interval is the paper's clip. Of many, the median is the one that a person would believe; intervals
    whose error still falls at an end of the sweep have no least error, and count only where all are like that.
    None where no track fills an interval.
    """
    intervals = paper_intervals(evidence, options)
    if not intervals:
        return None
    sweeps = [_sweep(interval, evidence.image_size, options) for interval in intervals]
    least = [int(np.argmin(sweep[:, 1])) for sweep in sweeps]
    inside = [index for index, place in enumerate(least) if 0 < place < options.focal_steps - 1]
    candidates = sorted(inside or range(len(sweeps)), key=lambda index: sweeps[index][least[index], 0])
    median = candidates[(len(candidates) - 1) // 2]
    focal, paths = float(sweeps[median][least[median], 0]), intervals[median].paths
    camera = Camera.equidistant(*evidence.image_size, focal)
    before = np.mean([_line_fit_errors(path) / len(path) for path in paths])
    after = np.mean([_line_fit_errors(camera.undistort(path)) / len(path) for path in paths])
    report = PaperReport(
        focal_px=camera.focal_px,
        polynomial_k=distortion_polynomial(camera),
        straightness_px2=(float(before), float(after)),
    )
    return PaperIntrinsics(report, sweeps[median], np.array(intervals[median].tracks, int))


def _sweep(interval: ObservedInterval, image_size: tuple[int, int], options: PaperOptions) -> np.ndarray:
    """Trial focal lengths up to the image diagonal with their summed squared errors, shape (n, 2)."""
    centre = np.asarray(image_centre(*image_size))
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
    """Summed squared distances of points (..., n, 2) from their best line, shape (...)."""
    x, y = np.moveaxis(points - points.mean(axis=-2, keepdims=True), -1, 0)
    xx, xy, yy = (x * x).sum(-1), (x * y).sum(-1), (y * y).sum(-1)
    return np.maximum(0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy)), 0.0)


def distortion_polynomial(camera: Camera) -> tuple[float, float, float]:
    """Fit the paper's k1..k3 in `x_u / x_d - 1 = k1 r^2 + k2 r^4 + k3 r^6` on normalised distorted radii.

    It maps distorted to undistorted, the opposite of OpenCV's plumb_bob: a reported quantity, never CameraInfo.D.
    """
    corner = np.hypot(camera.width, camera.height) / 2
    r = np.linspace(0.02, 1.0, 200) * min(corner, camera.focal_px * np.radians(80.0)) / camera.focal_px
    powers = np.column_stack([r**2, r**4, r**6])
    k, *_ = np.linalg.lstsq(powers, np.tan(r) / r - 1, rcond=None)
    return float(k[0]), float(k[1]), float(k[2])


def straightness_sweep(tracks: TrackSet, image_size: tuple[int, int], trials: np.ndarray) -> np.ndarray:
    """Robust straightness on the sphere of equidistant cameras with focal lengths `trials`; shape of `trials`.

    The cost of a track is the logarithm of its mean squared pixel distance: a turning vehicle costs little more
    than a wandering one. Tracks of one vehicle share one weight.
    """
    share = tracks.vehicle_weight
    costs = []
    for trial in trials:
        rays = unproject_rays(Camera.equidistant(*image_size, trial), tracks.pixels)
        _, distance2, _ = fit_circles(rays, tracks.weights)
        costs.append((share * np.log1p(distance2 / TRACK_SCALE_PX**2)).sum())
    return np.array(costs)
