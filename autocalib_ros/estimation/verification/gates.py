"""Acceptance gates: each check returns the reason why a solution is not accepted, or None."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    MIN_RESIDUAL_ROWS,
    Adjustment,
    adjust,
    assign_roads,
    road_support,
)
from autocalib_ros.estimation.adjustment.covariance import sigma_without_prior
from autocalib_ros.estimation.adjustment.lens_prior import known_lens
from autocalib_ros.estimation.adjustment.model_selection import select_model
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks, long_tracks
from autocalib_ros.estimation.observations.tracklets import no_tracklets
from autocalib_ros.estimation.straight.initialisation import MAX_FOCAL_DIAGONALS
from autocalib_ros.estimation.straight.roads import MIN_VEHICLES_PER_ROAD
from autocalib_ros.estimation.verification.consistency import (
    compare_solutions,
    expected_half_differences,
    half_change,
    half_difference,
)
from autocalib_ros.estimation.verification.ground_normal import LevelCamera, PlaneEstimate, orient_above_traffic
from autocalib_ros.estimation.verification.half_starts import turned_start
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import MIN_FRACTION_BELOW_HORIZON, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import UNDETERMINED, Statement, check
from autocalib_ros.results.verification_table import VerificationRow, verified

MAX_DOWN_IN_IMAGE = float(np.sin(np.radians(10.0)))
"""Component of the upward normal down the image above which the picture is upside down. Looking straight down, within
ten degrees, there is no upright picture."""
MIN_STRAIGHT_FRACTION = 0.25
"""Fraction of the vehicles that have to follow the roads. Below it the traffic turns, and the common direction is that
of a turn. Judgement."""
MIN_ONE_ROAD_FRACTION, MIN_KEPT_ROAD_FRACTION = 0.75, 0.5
"""The same for a single road: on a ring or a bend some arc always resembles a road. Half of the vehicles are enough if
those that follow the road stay on it, since on a ring they drive on round it: at most 64 % do in 60 simulated rings,
at least 85 % on simulated roads."""
LANE_KEEPING_PATH_FRACTION = 0.9
MIN_LANE_KEEPING_FRACTION = 0.8
"""A vehicle is lane-keeping if it follows the road for the first fraction of its path; the second fraction of all
vehicles that follow the road anywhere have to be."""
MIN_TRACKS_PER_VEHICLE = 3
"""Tracks of a vehicle that show whether it is lane-keeping: a single track is on the road or not."""
MIN_FOCAL_CONTRAST = 1.3
"""Support at the best trial focal length over that at the median one: a wrong lens bends straight paths. Judgement."""
MAX_K1_SIGMAS = 3.5
"""Deviation of k1 from the mean of its family, in sigmas of the prior: 0.05 % of the lenses of the family exceed it."""
MAX_MOTION_FOCAL_SIGMA = 0.1
"""Relative sigma of the focal length from the motion of turning vehicles alone, below which that motion confirms the
lens: turns mistaken for roads have larger errors. Judgement."""
MAX_HALVES_SIGMAS, MAX_WHOLE_SIGMAS = 3.5, 3.0
"""Allowed difference between two halves of the evidence: in their own sigmas, and in the sigmas that follow from the
whole."""
MAX_SHARE_SIGMAS = 4.0
"""Largest difference between the shares of vehicles that follow the roads in two halves, in standard deviations: it is
exceeded by 0.006 % of normal differences, and by 0.4 % where the standard deviation comes from blocks."""
SHARE_BLOCKS, MIN_BLOCK_VEHICLES = 5, 2
"""Blocks of vehicles in a row in each half, by which the standard deviation of a share is measured, and fewest vehicles
in a block. Judgement."""
HALVES_FOCAL_TOLERANCE = 0.03
HALVES_NORMAL_TOLERANCE_DEG = 1.5
"""Difference between two halves that is always allowed: the promised accuracy."""


def check_straight_traffic(fit: Adjustment, contrast: float, tracks: TrackSet) -> Reason | None:
    """Check the straight traffic behind an initial solution.

    `contrast` is the support at the best trial focal length over that at the median one.
    """
    prior = fit.problem.config.prior
    fraction = straight_fraction(fit, tracks)
    if fraction < MIN_STRAIGHT_FRACTION:
        return turning_traffic_reason(fit, fraction, MIN_STRAIGHT_FRACTION)
    if contrast < MIN_FOCAL_CONTRAST and not (prior.family == 'distortion_free' and len(fit.state.angles_rad) > 1):
        return reason('no_agreement', contrast=contrast, limit=MIN_FOCAL_CONTRAST)
    return _check_horizon(fit, tracks)


def check_lens(
    fit: Adjustment,
    tracks: TrackSet,
    evidence: Evidence,
    *,
    turned: bool,
    driving: np.ndarray | None = None,
) -> Reason | tuple[VerificationRow, ...]:
    """Check the lens; `turned` marks a solution that was initialised by turning traffic.

    `tracks` are those selected from the evidence. `driving` is a mask (tracks,) of the tracks of vehicles: pedestrians
    need not follow a road. Returns the rows of the verification table where all is well.
    """
    failed_check = _check_horizon(fit, tracks) or _check_lens_model(fit)
    if failed_check or (turned and motion_constrains_focal(fit)):
        return failed_check or ()
    needed = MIN_STRAIGHT_FRACTION if len(fit.state.angles_rad) > 1 else MIN_ONE_ROAD_FRACTION
    fraction = straight_fraction(fit, tracks, driving)
    if (
        needed == MIN_ONE_ROAD_FRACTION > fraction > MIN_KEPT_ROAD_FRACTION
        and lane_keeping_fraction(fit, evidence) > MIN_LANE_KEEPING_FRACTION
    ):
        needed = MIN_KEPT_ROAD_FRACTION
    share = verified('straight_share', fraction, needed)
    return (share,) if share.passed else turning_traffic_reason(fit, fraction, needed)


def check_markings_view(fit: Adjustment, tracks: TrackSet) -> Reason | None:
    """Check a markings-only solution against the traffic: horizon and lens model."""
    return _check_horizon(fit, tracks) or _check_lens_model(fit)


def _check_horizon(fit: Adjustment, tracks: TrackSet) -> Reason | None:
    if not fit.plane_known:
        return None
    up, fraction_below_horizon = orient_above_traffic(fit.state.rotation[:, 2], fit.state.camera, tracks)
    if up[1] > MAX_DOWN_IN_IMAGE:
        return reason('horizon', 'upside_down', roll_deg=abs(tilt_and_roll_deg(up)[1]))
    return check_below_horizon(fraction_below_horizon)


def check_below_horizon(fraction: float) -> Reason | None:
    """Check the fraction of the tracked points that lie below the horizon of a plane."""
    if fraction >= MIN_FRACTION_BELOW_HORIZON:
        return None
    return reason('horizon', fraction=1 - fraction, limit=1 - MIN_FRACTION_BELOW_HORIZON)


def motion_constrains_focal(fit: Adjustment) -> bool:
    """Whether the motion of turning vehicles determines the focal length by itself, or the focal length is known."""
    if not fit.problem.config.turning or 0 not in fit.problem.config.prior.free:
        return fit.problem.config.turning
    _, known = fit.problem.parameters.prior_gradient(fit.state)
    return bool(sigma_without_prior(fit.turning_information, known)[0] < MAX_MOTION_FOCAL_SIGMA)


def straight_fraction(fit: Adjustment, tracks: TrackSet, driving: np.ndarray | None = None) -> float:
    """Return the fraction of the vehicles that follow the roads; `driving` is a mask (tracks,) of those that count."""
    weight = tracks.vehicle_weight if driving is None else tracks.vehicle_weight * driving
    return float((weight * fit.inliers()).sum() / max(weight.sum(), 1e-9))


def lane_keeping_fraction(fit: Adjustment, evidence: Evidence) -> float:
    """Return the fraction of lane-keeping vehicles among those that follow a road anywhere, 0 if too few do."""
    every = long_tracks(evidence)
    labels, _ = assign_roads(fit.state, UnprojectedTracks.through(fit.state.camera, every))
    lengths = np.hypot(*np.moveaxis(np.diff(every.pixels, axis=1), -1, 0)).sum(axis=1)
    _, vehicle_ids = np.unique(every.vehicles, return_inverse=True)
    on_road = np.bincount(vehicle_ids, lengths * (labels >= 0)) / np.maximum(np.bincount(vehicle_ids, lengths), 1e-9)
    following = (on_road > 1.0 - LANE_KEEPING_PATH_FRACTION) & (np.bincount(vehicle_ids) >= MIN_TRACKS_PER_VEHICLE)
    kept = following & (on_road > LANE_KEEPING_PATH_FRACTION)
    return float(kept.sum() / following.sum()) if following.sum() >= MIN_VEHICLES_PER_ROAD else 0.0


def turning_traffic_reason(fit: Adjustment, fraction: float, limit: float) -> Reason:
    """Return the refusal of roads that only a `fraction` of the vehicles follow, less than `limit`."""
    roads = len(fit.state.angles_rad)
    return reason('turning_traffic', '' if roads > 1 else 'one_road', fraction=fraction, limit=limit, roads=roads)


def check_focal_length(fit: Adjustment, gate: GateOptions, *, turned: bool) -> Reason | None:
    """Check whether the traffic alone determines the focal length."""
    camera, prior = fit.state.camera, fit.problem.config.prior
    sigma = fit.focal_sigma
    diagonals = camera.focal_px / camera.diagonal_px
    too_long = diagonals > MAX_FOCAL_DIAGONALS and not prior.focal_known
    # without distortion only an angle between roads determines the focal length, and an angle that was measured with
    # that focal length proves nothing
    circular = prior.family == 'distortion_free' and not (
        prior.focal_known or fit.problem.config.options.crossing_deg is not None
    )
    needed = gate.max_sigma_focal_rel
    if not (too_long or circular or not sigma <= needed):
        return None
    code = 'too_little_turning' if turned else 'too_little_curvature'
    return reason(code, focal_px=camera.focal_px, sigma=min(sigma, UNDETERMINED), limit=needed)


def _check_lens_model(fit: Adjustment) -> Reason | None:
    camera, prior = fit.state.camera, fit.problem.config.prior
    if prior.sigma[3] <= 0:
        return None
    off = k1_prior_sigmas(fit)
    if off > MAX_K1_SIGMAS:
        return reason('lens_model', family=prior.family, k1=camera.k[0], sigmas=off, limit=MAX_K1_SIGMAS)
    return None


def k1_prior_sigmas(fit: Adjustment) -> float:
    """Return the deviation of k1 from the mean of its lens family, in standard deviations of its prior."""
    prior = fit.problem.config.prior
    return abs(fit.state.camera.k[0] - prior.centre.k[0]) / float(prior.sigma[3])


def check_plane(plane: PlaneEstimate, gate: GateOptions) -> Reason | None:
    """Check the ground plane."""
    sigma = plane.worst_sigma_deg
    if isinstance(plane.assumed, LevelCamera) and not plane.assumed.constrains_plane(plane.fit.state):
        return reason('plane_uncertain', 'level_road')
    above = None if plane.assumed is None else check_below_horizon(plane.fraction_below_horizon)
    if above:
        return above
    if not sigma <= gate.max_sigma_tilt_deg:
        return reason('plane_uncertain', sigma_deg=min(sigma, 90.0), limit_deg=gate.max_sigma_tilt_deg)
    return None


@dataclass(frozen=True)
class ComparedHalves:
    """The comparison of two halves of the traffic, or why there is none."""

    statement: Statement
    rows: tuple[VerificationRow, ...] = ()
    steps: np.ndarray | None = None
    """Steps (2, parameters) from the solution to the view of each half, times the root of the probability that this is
    the view, as the camera turned in between; None where nothing was compared."""

    def covered_by(self, fit: Adjustment) -> Adjustment:
        """Return the solution whose covariance covers two views, by how probable they are (model averaging)."""
        return fit if self.steps is None else replace(fit, covariance=fit.covariance + self.steps.T @ self.steps)


NOT_COMPARED = ComparedHalves(check('halves_not_compared'))
"""Of traffic too little for two halves."""


def check_halves(
    fit: Adjustment, tracks: TrackSet, gate: GateOptions, lenses: Sequence[Camera] = ()
) -> Reason | ComparedHalves:
    """Cross-validate in time: solve the earlier and the later half of the vehicles, and compare.

    A lens that is held may be wrong, and then shows traffic in other lanes in other directions. `lenses` are one
    standard deviation from it along each axis of its covariance: what they change in the difference is expected.
    """
    config = replace(fit.problem.config, vehicle_correlation=fit.vehicle_correlation)
    tracklets = no_tracklets() if config.bundle is None else config.bundle.tracklets
    early, lived, windows = _earlier_half(
        (tracks.vehicles, tracks.times_s),
        (tracklets.bodies, tracklets.times_s),
        (config.windows.bodies, config.windows.times_s),
    )
    share = _compare_shares(fit, tracks, early)
    if isinstance(share, Reason):
        return share
    masks = (early, windows, lived), (~early, ~windows, ~lived)
    fits = _solve_halves(fit, tracks, config, gate, masks)
    if fits is None:
        return replace(NOT_COMPARED, rows=(*share, *_compare_roads(fit, tracks, early)))
    apart = compare_solutions(*fits)
    focal, turn = apart.focal, apart.normal_deg if fit.plane_known else 0.0  # one road does not determine the normal
    # a large sigma of one half excuses no difference that the sigma of the whole rules out
    focal_limit, turn_limit = np.maximum(
        (HALVES_FOCAL_TOLERANCE, HALVES_NORMAL_TOLERANCE_DEG),
        np.minimum(MAX_HALVES_SIGMAS * apart.sigmas, MAX_WHOLE_SIGMAS * expected_half_differences(fit, *fits)),
    )
    rows = verified('halves_focal', focal, focal_limit), verified('halves_normal', turn, turn_limit)
    if not all(row.passed for row in rows):
        return reason(
            'halves_disagree', focal=focal, focal_limit=focal_limit, normal_deg=turn, normal_limit_deg=turn_limit
        )
    through = []
    for lens in lenses:
        state, held = replace(fit.state, camera=lens), replace(config, prior=known_lens(lens))
        through.append(_solve_halves(replace(fit, state=state), tracks, held, gate, masks))
    poses = _compare_poses(*fits, [other for other in through if other is not None])
    if isinstance(poses, Reason):
        return poses
    together, turned = poses
    steps = np.array([fit.problem.parameters.step_to(each.state) for each in fits])
    statement = check('halves', focal=focal, normal_deg=turn if fit.plane_known else None)
    compared = (*share, *(rows if fit.plane_known else rows[:1]), *together)
    return ComparedHalves(statement, compared, np.sqrt(0.5 * turned) * steps)


def _solve_halves(
    fit: Adjustment,
    tracks: TrackSet,
    config: AdjustmentConfig,
    gate: GateOptions,
    masks: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...],
) -> tuple[Adjustment, Adjustment] | None:
    """Solve both halves; None if one of them has too little traffic."""
    first, second = (_solve_half(fit, tracks, config, gate, mask) for mask in masks)
    return None if first is None or second is None else (first, second)


def _solve_half(
    fit: Adjustment,
    tracks: TrackSet,
    config: AdjustmentConfig,
    gate: GateOptions,
    masks: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Adjustment | None:
    """Solve half of the traffic, given by masks of tracks, windows and tracklets; None if it has too little."""
    half, seen, living = masks
    part, bundle = tracks.subset(half), config.bundle and config.bundle.subset(living)
    part_setting = replace(config, windows=config.windows.subset(seen), bundle=bundle)
    if half.sum() + seen.sum() + living.sum() < MIN_RESIDUAL_ROWS or (config.turning and not part_setting.turning):
        return None
    _, motion, shapes = fit.problem.warm_start
    warm_start = None, motion.subset(seen) if motion else None, shapes.subset(living) if bundle and shapes else None
    fits = [adjust(fit.state, part, part_setting, refine=True, warm_start=warm_start)]
    # a camera that turned in between shows each half roads that are not those of the whole
    turned = turned_start(fit.state, part)
    if turned is not None:
        fits.append(adjust(turned, part, part_setting))
    supported = [
        each for each in fits if all(mask.sum() >= gate.min_tracks_per_road // 2 for mask in road_support(each, part))
    ]
    return select_model(supported, part) if supported else None


def _compare_shares(fit: Adjustment, tracks: TrackSet, early: np.ndarray) -> Reason | tuple[VerificationRow, ...]:
    """Compare the shares of vehicles that follow the roads in two halves, the earlier one of tracks `early` (tracks,).

    A camera that turned in between shows one half a road where the other half has none; a half without support is then
    no lack of traffic.
    """
    on_road = fit.inliers()
    compared = share_difference(*_halves_in_order(tracks, np.ones(len(tracks), bool), on_road, early))
    if compared is None:
        return ()
    earlier, later, sigmas = compared
    row = verified('halves_share', sigmas, MAX_SHARE_SIGMAS)
    if row.passed:
        return (row,)
    return reason('halves_disagree', 'share', earlier=earlier, later=later, sigmas=row.value, limit=row.limit)


def _compare_roads(fit: Adjustment, tracks: TrackSet, early: np.ndarray) -> tuple[VerificationRow, ...]:
    """Compare how the vehicles of each half are spread over the roads, where the halves cannot be solved each.

    One road early and another one late may be the phases of a traffic light, or two views, and nothing tells which.
    """
    on_road = fit.inliers()
    differences = [
        share_difference(*_halves_in_order(tracks, on_road, fit.labels == road, early))
        for road in range(len(fit.state.angles_rad))
    ]
    sigmas = [compared[2] for compared in differences if compared is not None]
    return (verified('halves_roads', max(sigmas), MAX_SHARE_SIGMAS),) if len(sigmas) > 1 else ()


def _halves_in_order(tracks: TrackSet, of: np.ndarray, seen: np.ndarray, early: np.ndarray) -> list[np.ndarray]:
    """Return for each half, of the vehicles with a track (tracks,) in the mask `of`, which have one that is `seen`.

    In the order of their mean times.
    """
    halves = []
    for half in (early, ~early):
        rows = np.flatnonzero(half & of)
        _, first, vehicle = np.unique(tracks.vehicles[rows], return_index=True, return_inverse=True)
        times = _mean_times(tracks.vehicles[rows], tracks.times_s[rows])[first]
        halves.append((np.bincount(vehicle, seen[rows], len(first)) > 0)[np.argsort(times, kind='stable')])
    return halves


def share_difference(earlier: np.ndarray, later: np.ndarray) -> tuple[float, float, float] | None:
    """Return the shares of two masks of vehicles, in order of time, and their difference in standard deviations.

    None for fewer than `MIN_VEHICLES_PER_ROAD` vehicles in a half, or for less than half as many as in the other.
    Vehicles come in platoons and in the phases of traffic lights, so that the standard deviation is not only that of
    independent vehicles: where it is larger, that of the means of `SHARE_BLOCKS` blocks in a row is taken.
    """
    counts = np.array([len(earlier), len(later)])
    if counts.min() < max(MIN_VEHICLES_PER_ROAD, 0.5 * counts.max()):
        return None
    whole = float(np.concatenate([earlier, later]).mean())
    independent = max(whole * (1.0 - whole), 1e-9) * float((1.0 / counts).sum())
    in_blocks = 0.0
    if counts.min() >= MIN_BLOCK_VEHICLES * SHARE_BLOCKS:
        blocks = [[part.mean() for part in np.array_split(half, SHARE_BLOCKS)] for half in (earlier, later)]
        in_blocks = float(sum(np.var(means, ddof=1) for means in blocks)) / SHARE_BLOCKS
    shares = float(earlier.mean()), float(later.mean())
    return (*shares, abs(shares[0] - shares[1]) / float(np.sqrt(max(independent, in_blocks))))


def _compare_poses(
    first: Adjustment, second: Adjustment, through: Sequence[tuple[Adjustment, Adjustment]]
) -> Reason | tuple[tuple[VerificationRow, ...], float]:
    """Compare focal length and rotation of two halves together; no row where a half determines nothing.

    `through` are the halves through other lenses, each a standard deviation away. Returns also the probability that the
    camera turned in between.
    """
    changes = np.array([half_change(*halves) - half_change(first, second) for halves in through]).reshape(-1, 4)
    vehicles = min(len(np.unique(fit.problem.vehicle_ids)) for fit in (first, second))
    difference = half_difference(first, second, vehicles, changes.T @ changes)
    if difference is None:
        return (), 0.0
    row = verified('halves_pose', difference.sigmas, difference.limit)
    if row.passed:
        return (row,), difference.turned
    turned = Rotation.from_matrix(first.state.rotation.T @ second.state.rotation).magnitude()
    return reason('halves_disagree', 'pose', sigmas=row.value, limit=row.limit, turned_deg=float(np.degrees(turned)))


def _earlier_half(*seen: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    """Masks of the earlier half of pairs of vehicles (n,) and times (n,), by mean time: no vehicle is in both halves.

    The median is that of all vehicles, one value for each kind of observation that they have.
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
