"""Where roads lead in evidence that gives no calibration: a sketch through a usual lens, for people and not for use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, level_normal
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.single_road.barrel_lens import LensChoice
from autocalib_ros.estimation.single_road.road_solution import most_followed, roads_through
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import orient_upward
from autocalib_ros.lens.camera import Camera

MAX_SKETCHED_TRACKS = 150
"""Tracks in a sketch, spread over the picture: its roads need no precision."""
MIN_SKETCHED_TRACKS = 8
"""Fewest tracks that show where a road leads; as many vehicles as a single road needs."""
MIN_SHARE = 0.15
"""Least share of the vehicles on a road that is shown: on bends fewer follow any straight line, by chance."""


@dataclass(frozen=True)
class RoadSketch:
    """Roads through a lens that was assumed."""

    camera: Camera
    directions: np.ndarray
    """Unit vectors of the roads, camera frame, shape (roads, 3)."""
    horizon: np.ndarray
    """Unit normal (3,) of the plane, camera frame, up: of two roads; of a level camera if there is one."""
    shares: tuple[float, ...]
    """Share of the vehicles that follow each road."""
    labels: np.ndarray
    """Index of the road of each track of the evidence, -1 if it was not used, -2 if it follows none."""


def sketch_roads(evidence: Evidence, options: Options) -> RoadSketch | None:
    """Return the roads that most vehicles follow through a usual lens; None without any."""
    tracks = select_tracks(evidence, MAX_SKETCHED_TRACKS)
    if len(tracks) < MIN_SKETCHED_TRACKS:
        return None
    aspect = options.lens.pixel_aspect_or(evidence.pixel_aspect)
    prior = lens_priors(evidence.image_size, options.joint, evidence.picture, aspect, options.lens)[0]
    config, generator = AdjustmentConfig(prior, options.joint), np.random.default_rng(options.random_seed)
    fits = [fit for _, fit in roads_through(LensChoice(prior, options.joint), tracks, config, generator)]
    return _sketched(most_followed(fits, tracks), tracks, evidence.track_count) if fits else None


def _sketched(fit: Adjustment, tracks: TrackSet, count: int) -> RoadSketch | None:
    followed, weight = fit.inliers(), tracks.vehicle_weight
    shares = [
        float(weight @ (followed & (fit.labels == road)) / weight.sum()) for road in range(len(fit.state.angles_rad))
    ]
    shown = [road for road in np.argsort(shares)[::-1].tolist() if shares[road] >= MIN_SHARE]
    if not shown:
        return None
    labels = np.full(count, -1)
    labels[tracks.indices] = -2
    for index, road in enumerate(shown):
        labels[tracks.indices[followed & (fit.labels == road)]] = index
    directions = fit.state.directions[shown]
    normal = fit.state.rotation[:, 2] if len(shown) > 1 else level_normal(directions[0])
    bearings, _ = fit.state.camera.unproject(tracks.pixels.reshape(-1, 2))
    up, _ = orient_upward(normal, bearings)
    return RoadSketch(fit.state.camera, directions, up, tuple(shares[road] for road in shown), labels)
