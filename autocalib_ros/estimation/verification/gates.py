"""Acceptance gates: each check returns the reason why a solution is not accepted, or None."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    MIN_RESIDUAL_ROWS,
    Adjustment,
    adjust,
    assign_roads,
    road_support,
)
from autocalib_ros.estimation.adjustment.covariance import sigma_without_prior
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks, long_tracks
from autocalib_ros.estimation.observations.tracklets import no_tracklets
from autocalib_ros.estimation.straight.roads import MIN_VEHICLES_PER_ROAD
from autocalib_ros.estimation.verification.consistency import compare_solutions, expected_half_differences
from autocalib_ros.estimation.verification.ground_normal import LevelCamera, PlaneEstimate, orient_above_traffic
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import MIN_FRACTION_BELOW_HORIZON
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, check

MIN_STRAIGHT_FRACTION = 0.25
"""Share of vehicles that follow the roads; below it the traffic turns, and what it agrees on is a turn."""
MIN_ONE_ROAD_FRACTION, MIN_KEPT_ROAD_FRACTION = 0.75, 0.5
"""The same where one road alone is found: on a ring or a bend some arc always passes for a road. Half of the vehicles
are enough when those that follow the road keep to it: on a ring they drive on round it."""
LANE_KEEPING_PATH_FRACTION = 0.9
MIN_LANE_KEEPING_FRACTION = 0.8
"""A vehicle keeps to a road that it follows for so much of its way; so many, of all that follow it anywhere, have to.
"""
MIN_TRACKS_PER_VEHICLE = 3
"""Tracks of a vehicle that tell whether it keeps to a road: a single one is on it or not."""
MIN_FOCAL_CONTRAST = 1.3
"""Agreement at the best trial focal length over that at the median one: wrong lenses bend straight paths apart."""
MAX_FOCAL_DIAGONALS = 1.5
"""Focal length, in image diagonals, beyond which no lens curvature can be seen."""
MAX_K1_SIGMAS = 3.5
MAX_TURNING_FOCAL_SIGMA = 0.03
"""Largest relative standard deviation of a focal length that was found by traffic that turns: there noise biases, and
the bias grows faster than the deviation."""
MAX_MOTION_FOCAL_SIGMA = 0.1
"""Vehicles that turn vouch for a lens when their motion alone tells the focal length to this share, one sigma: turns
that were taken for roads are off by more."""
ASSUMED_PLANE_SIGMA_FACTOR = 3.0
"""A plane that rests on an assumption may be so many times less sure than one that was measured."""
MAX_HALVES_SIGMAS, MAX_WHOLE_SIGMAS = 3.5, 3.0
"""Two halves of the evidence may differ by so many standard deviations: of their own, and of what the whole lets them.
"""
HALVES_FOCAL_TOLERANCE = 0.03
HALVES_NORMAL_TOLERANCE_DEG = 1.5
"""Two halves of the evidence may always differ by so much: it is within what the program promises."""


def check_straight_traffic(fit: Adjustment, contrast: float, tracks: TrackSet) -> Reason | None:
    """Say why the straight traffic that a solution started from tells nothing, if so.

    `contrast` is how sharply it agreed on the focal length.
    """
    prior = fit.problem.config.prior
    share = _straight_fraction(fit, tracks)
    if share < MIN_STRAIGHT_FRACTION:
        return _turning_traffic_reason(fit, share, MIN_STRAIGHT_FRACTION)
    if contrast < MIN_FOCAL_CONTRAST and not (prior.family == 'distortion_free' and len(fit.state.angles_rad) > 1):
        return reason('no_agreement', contrast=contrast, limit=MIN_FOCAL_CONTRAST)
    return _check_horizon(fit, tracks)


def check_lens(
    fit: Adjustment,
    tracks: TrackSet,
    evidence: Evidence,
    gate: GateOptions,
    *,
    turned: bool,
    driving: np.ndarray | None = None,
) -> Reason | None:
    """Say why the lens cannot be trusted, if so; `turned` where the solution started from traffic that turns.

    `tracks` are those that were chosen out of the evidence; where `driving`, a mask (tracks,), is given, the others are
    of people, who need not keep to a road.
    """
    failed_check = (
        _check_horizon(fit, tracks) or _check_focal_length(fit, gate, turned=turned) or _check_lens_model(fit)
    )
    if failed_check or turned and motion_constrains_focal(fit):
        return failed_check
    needed = MIN_STRAIGHT_FRACTION if len(fit.state.angles_rad) > 1 else MIN_ONE_ROAD_FRACTION
    share = _straight_fraction(fit, tracks, driving)
    if (
        needed == MIN_ONE_ROAD_FRACTION > share > MIN_KEPT_ROAD_FRACTION
        and lane_keeping_fraction(fit, evidence) > MIN_LANE_KEEPING_FRACTION
    ):
        return None
    return _turning_traffic_reason(fit, share, needed) if share < needed else None


def check_markings_view(fit: Adjustment, tracks: TrackSet) -> Reason | None:
    """Say why what was found without the traffic cannot be how it is seen, if so."""
    return _check_horizon(fit, tracks) or _check_lens_model(fit)


def _check_horizon(fit: Adjustment, tracks: TrackSet) -> Reason | None:
    _, fraction_below_horizon = orient_above_traffic(fit.state.rotation[:, 2], fit.state.camera, tracks)
    if not fit.plane_known or fraction_below_horizon >= MIN_FRACTION_BELOW_HORIZON:
        return None
    return _above_horizon_reason(fraction_below_horizon)


def _above_horizon_reason(fraction_below_horizon: float) -> Reason:
    return reason('horizon', fraction=1 - fraction_below_horizon, limit=1 - MIN_FRACTION_BELOW_HORIZON)


def motion_constrains_focal(fit: Adjustment) -> bool:
    """Whether the motion of vehicles that turn tells the focal length by itself, or need not."""
    if not fit.problem.config.turning or 0 not in fit.problem.config.prior.free:
        return fit.problem.config.turning
    _, known = fit.problem.parameters.prior_gradient(fit.state.camera)
    return bool(sigma_without_prior(fit.turning_information, known)[0] < MAX_MOTION_FOCAL_SIGMA)


def _straight_fraction(fit: Adjustment, tracks: TrackSet, driving: np.ndarray | None = None) -> float:
    share = tracks.vehicle_weight if driving is None else tracks.vehicle_weight * driving
    return float((share * fit.inliers()).sum() / max(share.sum(), 1e-9))


def lane_keeping_fraction(fit: Adjustment, evidence: Evidence) -> float:
    """Share of the vehicles that follow a road anywhere that do so all along, 0 where too few tell."""
    every = long_tracks(evidence)
    labels, _ = assign_roads(fit.state, UnprojectedTracks.through(fit.state.camera, every))
    lengths = np.hypot(*np.moveaxis(np.diff(every.pixels, axis=1), -1, 0)).sum(axis=1)
    _, vehicle_ids = np.unique(every.vehicles, return_inverse=True)
    share = np.bincount(vehicle_ids, lengths * (labels >= 0)) / np.maximum(np.bincount(vehicle_ids, lengths), 1e-9)
    following = (share > 1.0 - LANE_KEEPING_PATH_FRACTION) & (np.bincount(vehicle_ids) >= MIN_TRACKS_PER_VEHICLE)
    kept = following & (share > LANE_KEEPING_PATH_FRACTION)
    return float(kept.sum() / following.sum()) if following.sum() >= MIN_VEHICLES_PER_ROAD else 0.0


def _turning_traffic_reason(fit: Adjustment, fraction: float, limit: float) -> Reason:
    roads = len(fit.state.angles_rad)
    return reason('turning_traffic', '' if roads > 1 else 'one_road', fraction=fraction, limit=limit, roads=roads)


def _check_focal_length(fit: Adjustment, gate: GateOptions, *, turned: bool) -> Reason | None:
    camera, prior = fit.state.camera, fit.problem.config.prior
    sigma = fit.focal_sigma
    diagonals = camera.focal_px / np.hypot(camera.width, camera.height)
    too_long = diagonals > MAX_FOCAL_DIAGONALS and not prior.focal_known
    # without distortion only an angle between roads tells the focal length, and one that was found by that focal
    # length proves nothing
    circular = prior.family == 'distortion_free' and not (
        prior.focal_known or fit.problem.config.options.crossing_deg is not None
    )
    needed = min(gate.max_sigma_focal_rel, MAX_TURNING_FOCAL_SIGMA) if turned else gate.max_sigma_focal_rel
    if not (too_long or circular or not sigma <= needed):
        return None
    code = 'too_little_turning' if turned else 'too_little_curvature'
    return reason(code, focal_px=camera.focal_px, sigma=min(sigma, 9.99), limit=needed)


def _check_lens_model(fit: Adjustment) -> Reason | None:
    camera, prior = fit.state.camera, fit.problem.config.prior
    if prior.sigma[3] <= 0:
        return None
    off = abs(camera.k[0] - prior.centre.k[0]) / prior.sigma[3]
    if off > MAX_K1_SIGMAS:
        return reason('lens_model', family=prior.family, k1=camera.k[0], sigmas=off, limit=MAX_K1_SIGMAS)
    return None


def check_plane(plane: PlaneEstimate, gate: GateOptions, *, assumed: bool = False) -> Reason | None:
    """Say why the ground plane cannot be trusted, if so; one that is `assumed` may be less sure."""
    sigma = plane.worst_sigma_deg
    if isinstance(plane.assumed, LevelCamera) and not plane.assumed.constrains_plane(plane.fit.state):
        return reason('plane_uncertain', 'level_road')
    if plane.assumed is not None and plane.fraction_below_horizon < MIN_FRACTION_BELOW_HORIZON:
        return _above_horizon_reason(plane.fraction_below_horizon)
    needed = gate.max_sigma_tilt_deg * (ASSUMED_PLANE_SIGMA_FACTOR if assumed or plane.assumed is not None else 1.0)
    if not sigma <= needed:
        return reason('plane_uncertain', sigma_deg=min(sigma, 90.0), limit_deg=needed)
    return None


def check_halves(fit: Adjustment, tracks: TrackSet, gate: GateOptions) -> Reason | Statement:
    """Solve the earlier and the later half of the vehicles; they have to agree within what they know."""
    config = replace(fit.problem.config, vehicle_correlation=fit.vehicle_correlation)
    tracklets = no_tracklets() if config.bundle is None else config.bundle.tracklets
    early, lived, windows = _earlier_half(
        (tracks.vehicles, tracks.times_s),
        (tracklets.bodies, tracklets.times_s),
        (config.windows.bodies, config.windows.times_s),
    )
    fits = []
    for half, seen, living in ((early, windows, lived), (~early, ~windows, ~lived)):
        part, bundle = tracks.subset(half), config.bundle and config.bundle.subset(living)
        part_setting = replace(config, windows=config.windows.subset(seen), bundle=bundle)
        if half.sum() + seen.sum() + living.sum() < MIN_RESIDUAL_ROWS or config.turning and not part_setting.turning:
            return check('halves_not_compared')
        _, motion, shapes = fit.problem.warm_start
        warm_start = None, motion.subset(seen) if motion else None, shapes.subset(living) if bundle and shapes else None
        fits.append(adjust(fit.state, part, part_setting, refine=True, warm_start=warm_start))
        if any(mask.sum() < gate.min_tracks_per_road // 2 for mask in road_support(fits[-1], part)):
            return check('halves_not_compared')
    apart = compare_solutions(*fits)
    focal, turn = apart.focal, apart.normal_deg if fit.plane_known else 0.0  # one road leaves the normal free
    # what either half says of itself is no excuse where the whole claims to know better
    focal_limit, turn_limit = np.maximum(
        (HALVES_FOCAL_TOLERANCE, HALVES_NORMAL_TOLERANCE_DEG),
        np.minimum(MAX_HALVES_SIGMAS * apart.sigmas, MAX_WHOLE_SIGMAS * expected_half_differences(fit, *fits)),
    )
    if focal > focal_limit or turn > turn_limit:
        return reason(
            'halves_disagree', focal=focal, focal_limit=focal_limit, normal_deg=turn, normal_limit_deg=turn_limit
        )
    return check('halves', focal=focal, normal_deg=turn if fit.plane_known else None)


def _earlier_half(*seen: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    """Masks of the earlier half of owners (n,) and times (n,), by each owner's mean time: no vehicle is in both halves.

    The middle is that of all that are seen, each as often as it has owners.
    """
    means = [_mean_times(vehicle_ids, times_s) for vehicle_ids, times_s in seen]
    each = [
        mean[np.unique(vehicle_ids, return_index=True)[1]] for mean, (vehicle_ids, _) in zip(means, seen, strict=True)
    ]
    middle = np.median(np.concatenate(each))
    return [mean <= middle for mean in means]


def _mean_times(vehicle_ids: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    _, inverse, counts = np.unique(vehicle_ids, return_inverse=True, return_counts=True)
    return (np.bincount(inverse, times_s) / counts)[inverse]
