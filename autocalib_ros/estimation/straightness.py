"""Focal length from the straightness of tracks: the published form, and a robust one on the sphere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.calibration import PaperReport
from autocalib_ros.camera import Camera
from autocalib_ros.config import PaperOptions
from autocalib_ros.estimation.great_circles import TrackSet, fit_circles, rays_of
from autocalib_ros.evidence import Evidence, Track

RIM = 1.02
"""The shortest trial focal length keeps tracked points this factor inside 90 degrees, where tan flips sign."""
TRACK_SCALE_PX = 1.0
"""Mean distance from its great circle at which a track is no longer believed to be straight."""


@dataclass(frozen=True)
class PaperIntrinsics:
    """Result of the published intrinsic stage."""

    report: PaperReport
    sweep: np.ndarray
    """Trial focal length and summed squared error, shape (n, 2)."""
    tracks: np.ndarray
    """Indices in the evidence of the tracks used."""


def paper_tracks(evidence: Evidence, options: PaperOptions) -> tuple[list[np.ndarray], np.ndarray]:
    """Apply the paper's two filters and take the longest: pixel paths (n, 2) and their track indices.

    The observed interval is a window of `window_s`; the recording is a row of such windows. A track is kept
    if it lived for `min_lifetime` of its window and its path is at most `max_path_ratio` its displacement.
    """
    kept = []
    for index, track in enumerate(evidence.tracks()):
        path = _longest_in_a_window(track, options)
        if path is None:
            continue
        displacement = np.hypot(*(path[-1] - path[0]))
        length = np.hypot(*np.diff(path, axis=0).T).sum()
        if displacement > 0 and length <= options.max_path_ratio * displacement:
            kept.append((-displacement, index, path))
    kept.sort(key=lambda item: item[:2])
    kept = kept[:options.longest]
    return [path for _, _, path in kept], np.array([index for _, index, _ in kept], int)


def _longest_in_a_window(track: Track, options: PaperOptions) -> np.ndarray | None:
    """Return the longest part of a track that fills an observed interval, or None."""
    best, best_length = None, 0.0
    windows = np.floor(track.times_s / options.window_s).astype(int)
    for window in np.unique(windows):
        inside = windows == window
        times, path = track.times_s[inside], track.points_px[inside]
        length = np.hypot(*(path[-1] - path[0]))
        if len(path) > 2 and times[-1] - times[0] >= options.min_lifetime * options.window_s and length > best_length:
            best, best_length = path, length
    return best


def paper_intrinsics(evidence: Evidence, options: PaperOptions) -> PaperIntrinsics | None:
    """Run the paper's intrinsic stage (its sections on focal length and polynomial); None without a track."""
    paths, indices = paper_tracks(evidence, options)
    if not paths:
        return None
    width, height = evidence.image_size
    farthest = max(np.hypot(*(path - Camera.equidistant(width, height, 1.0).principal_point_px).T).max()
                   for path in paths)
    lowest, diagonal = RIM * farthest / (np.pi / 2), np.hypot(width, height)
    trials = np.linspace(max(lowest, diagonal / options.focal_steps), diagonal, options.focal_steps)
    errors = np.array([sum(_line_error(Camera.equidistant(width, height, trial).undistort(path)) for path in paths)
                       for trial in trials])
    camera = Camera.equidistant(width, height, float(trials[np.argmin(errors)]))
    before = np.mean([_line_error(path) / len(path) for path in paths])
    after = np.mean([_line_error(camera.undistort(path)) / len(path) for path in paths])
    report = PaperReport(focal_px=camera.focal_px, polynomial_k=distortion_polynomial(camera),
                         straightness_px2=(float(before), float(after)))
    return PaperIntrinsics(report, np.column_stack([trials, errors]), indices)


def _line_error(points: np.ndarray) -> float:
    """Summed squared distance of points (n, 2) from their best line."""
    centred = points - points.mean(axis=0)
    return float(np.linalg.eigvalsh(centred.T @ centred)[0])


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
    share = tracks.share_of_vehicle
    costs = []
    for trial in trials:
        rays = rays_of(Camera.equidistant(*image_size, trial), tracks.pixels)
        _, distance2, _ = fit_circles(rays, tracks.weights)
        costs.append((share * np.log1p(distance2 / TRACK_SCALE_PX**2)).sum())
    return np.array(costs)


def focal_trials(tracks: TrackSet, image_size: tuple[int, int], count: int) -> np.ndarray:
    """Focal lengths to try, evenly by ratio: from all points within 120 degrees to twice the diagonal."""
    centre = Camera.equidistant(*image_size, 1.0).principal_point_px
    farthest = np.hypot(*(tracks.pixels.reshape(-1, 2) - centre).T).max()
    return np.geomspace(farthest / np.radians(120.0), 2.0 * np.hypot(*image_size), count)
