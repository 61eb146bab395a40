"""The robust method: from traffic to a lens and a ground plane that have been doubted in every way we know."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.config import GateOptions, JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    UNMODELLED_FOCAL,
    Adjustment,
    adjust,
    regroup_vehicles,
    road_support,
)
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior, known_lens, lens_priors
from autocalib_ros.estimation.adjustment.model_selection import noise_cost
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig
from autocalib_ros.estimation.markings.markings_solution import (
    NO_MARKINGS,
    condition_on_lens,
    fit_to_markings,
    refine_with_markings,
)
from autocalib_ros.estimation.observations.track_set import TrackSet, evenly_spaced
from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks, TwoFrameWindows, find_windows
from autocalib_ros.estimation.people.pedestrians import people
from autocalib_ros.estimation.straight.initialisation import select_lens_family, solve_from_consensus
from autocalib_ros.estimation.straight.roads import (
    add_further_roads,
    add_second_road,
    drop_unsupported_roads,
    fix_right_angle,
    main_road,
)
from autocalib_ros.estimation.turning.lane_changes import refine_with_lane_changes
from autocalib_ros.estimation.turning.turning_traffic import (
    check_turning_centres,
    fit_turning_traffic,
    refine_with_tracklets,
    refine_with_turning,
    widen_by_point_slip,
    widen_by_tracklet_difference,
)
from autocalib_ros.estimation.vehicle_edges.transverse_edges import TransverseDirection, find_transverse_direction
from autocalib_ros.estimation.verification.consistency import compare_solutions
from autocalib_ros.estimation.verification.gates import check_halves, check_lens, check_plane, check_straight_traffic
from autocalib_ros.estimation.verification.ground_normal import (
    AGREEMENT_SIGMAS,
    LevelCamera,
    PlaneEstimate,
    combine_assumptions,
)
from autocalib_ros.estimation.verification.identifiability import (
    fix_unidentifiable,
    lens_assumptions,
    release_k2,
)
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Reason

LEVEL_ROLL_TOLERANCE_DEG = 5.0
"""Roll up to which walking can be told from driving as if there were none."""
PLANE_TOLERANCE_DEG = 1.5
"""Two planes that differ by less agree: it is within what the program promises."""
MAX_CONFIRMING_SIGMA_DEG = 4.5
"""Traffic that tells the plane, or its road, no better confirms nothing: standard deviation, degrees."""
MAX_SUBSAMPLE_TRACKS = 200
"""Tracks, evenly out of all, from which the starts are made and compared; the solution then uses every track."""


@dataclass(frozen=True)
class Solution:
    """A lens, the plane and its roads, with the reason why there is no ground plane where there is none."""

    fit: Adjustment
    plane: PlaneEstimate
    along: np.ndarray
    """Unit vector (3,), camera frame, along the road of most vehicles."""
    flow: TrackSet
    """Tracks that follow that road straight; none where no road is straight."""
    assumptions: tuple[str, ...]
    checks: tuple[str, ...]
    plane_refusal: Reason | None
    reduced: bool = False
    """Whether the plane rests on less than roads that cross or vehicles that turn, though `plane` assumes nothing."""
    from_markings: bool = False
    """Whether lens and plane are those of the lines on the road."""

    @property
    def assumed(self) -> bool:
        """Whether the plane rests on what is named among the assumptions."""
        return self.plane.assumed is not None or self.reduced

    @property
    def full(self) -> bool:
        """Whether roads that cross or vehicles that turn give all of it."""
        return self.plane_refusal is None and not self.assumed


@dataclass(frozen=True)
class _Observations:
    """What every stage of a solution is given."""

    tracks: TrackSet
    windows: TwoFrameWindows
    instants: ResampledTracks
    priors: list[LensPrior]
    gate: GateOptions
    evidence: Evidence
    generator: np.random.Generator

    @property
    def subsample(self) -> TrackSet:
        return self.tracks.subset(evenly_spaced(len(self.tracks), MAX_SUBSAMPLE_TRACKS))


def find_solution(
    evidence: Evidence,
    tracks: TrackSet,
    options: JointOptions,
    gate: GateOptions,
    generator: np.random.Generator,
    *,
    height_m: float = 0.0,
    lens: Camera | None = None,
) -> Solution | Reason:
    """Estimate lens, plane and roads from evidence and the tracks chosen of it; a reason when they cannot be trusted.

    Straight traffic is tried first, with what turns to complete it; where that gives no plane, or one that rests on
    an assumption, the traffic that turns alone, and then the lines on the road. A known `lens` is kept, and only the
    pose is found.
    """
    if len(tracks) < gate.min_tracks:
        return Reason(
            'too_few_tracks',
            f'{len(tracks)} tracks of the {gate.min_tracks} needed are long enough',
            'wait for more traffic, or record for longer',
        )
    priors = [known_lens(lens)] if lens is not None else lens_priors(evidence.image_size, options)
    crossing = None if options.crossing_deg is None else float(np.radians(options.crossing_deg))
    instants = ResampledTracks(evidence)
    traffic = _Observations(tracks, find_windows(evidence, instants), instants, priors, gate, evidence, generator)
    config = AdjustmentConfig(priors[0], options, height_m, crossing)
    found = _solve_traffic(traffic, config)
    if not options.road_markings:
        return found
    if isinstance(found, Solution) and found.full:
        return _refine_with_markings(found, traffic)
    by_markings = _solve_markings(traffic, config)
    if _is_better(by_markings, found):
        return by_markings
    told_more = isinstance(by_markings, Reason) and by_markings.code != NO_MARKINGS
    return _append_reason(found, by_markings.message) if told_more else found


def _append_reason(found: Solution | Reason, description: str) -> Solution | Reason:
    """Add to what is missing, if anything, what else was tried."""
    if isinstance(found, Reason):
        return replace(found, message=f'{found.message}; {description}')
    return replace(
        found,
        plane_refusal=found.plane_refusal
        and replace(found.plane_refusal, message=f'{found.plane_refusal.message}; {description}'),
    )


def _solve_traffic(traffic: _Observations, config: AdjustmentConfig) -> Solution | Reason:
    """Solve from straight traffic; where that leaves anything open, from the traffic that turns."""
    straight = _solve_straight(traffic, config)
    if isinstance(straight, Solution) and straight.full:
        return straight
    turned = fit_turning_traffic(traffic.tracks, traffic.windows, config)
    if turned is None:
        return straight
    fit, tracks = _select_noise_model(add_further_roads(turned, traffic.tracks, traffic.gate), traffic)
    turning = _refine_and_verify(fit, tracks, '', traffic, turned=True)
    return turning if _is_better(turning, straight) else straight


def _is_better(other: Solution | Reason, found: Solution | Reason) -> bool:
    """Whether another solution says more than the one that was found before."""
    if isinstance(other, Reason) or isinstance(found, Reason):
        return isinstance(other, Solution)
    if other.plane_refusal or found.plane_refusal:
        return other.plane_refusal is None
    return other.plane.worst_sigma_deg < found.plane.worst_sigma_deg


def _solve_markings(traffic: _Observations, config: AdjustmentConfig) -> Solution | Reason:
    """Solve from the lines on the road; what the traffic tells, seen by the lens found, has to agree."""
    priors = [_prior_for_markings(prior, config.options) for prior in traffic.priors]
    by_markings = fit_to_markings(traffic.evidence, traffic.tracks, priors, config, traffic.gate)
    if isinstance(by_markings, Reason):
        return by_markings
    fit, assumed = by_markings
    known = known_lens(fit.state.camera)
    straight = _solve_straight(replace(traffic, priors=[known]), replace(config, prior=known))
    turned = fit_turning_traffic(traffic.tracks, traffic.windows, replace(config, prior=known))
    checks = verify_with_traffic(
        fit,
        [
            *([] if isinstance(straight, Reason) else [straight.plane]),
            *([] if turned is None else [PlaneEstimate.of(turned, traffic.tracks)]),
        ],
    )
    if isinstance(checks, Reason):
        return checks
    along, flow = main_road(fit, traffic.tracks)
    plane = PlaneEstimate.of(fit, traffic.tracks)
    return Solution(
        fit,
        plane,
        along,
        flow,
        (*lens_assumptions(fit, ()), assumed),
        checks,
        check_plane(plane, traffic.gate, assumed=True),
        reduced=True,
        from_markings=True,
    )


def _prior_for_markings(prior: LensPrior, options: JointOptions) -> LensPrior:
    """Return the prior for lines on the road, which tell the principal point, unless that is asserted."""
    return prior if options.principal_point_sigma_px >= 0 else prior.with_loose_principal_point()


def _refine_with_markings(found: Solution, traffic: _Observations) -> Solution:
    """Return a solution with the lens and plane of the lines on the road, where both agree and the lines are surer."""
    config = found.fit.problem.config
    prior = _prior_for_markings(config.prior, config.options)
    by_markings = refine_with_markings(found.fit, traffic.evidence, traffic.tracks, prior, traffic.gate)
    if isinstance(by_markings, Reason):
        return found
    fit, assumed = by_markings
    apart = compare_solutions(found.fit, fit)
    description = (
        f'lines on the road give a focal length {apart.focal:.1%} and a ground normal {apart.normal_deg:.1f} '
        'degrees from those of the traffic'
    )
    plane = PlaneEstimate.of(fit, traffic.tracks)
    if apart.exceeds(AGREEMENT_SIGMAS) or check_plane(plane, traffic.gate):
        return replace(found, checks=(*found.checks, f'{description}: not used'))
    one, other = (
        (max(solved.focal_sigma, UNMODELLED_FOCAL), told.worst_sigma_deg)
        for solved, told in ((fit, plane), (found.fit, found.plane))
    )
    if one[0] * one[1] > other[0] * other[1]:
        return replace(found, checks=(*found.checks, description))
    along, flow = main_road(fit, traffic.tracks)
    return replace(
        found,
        fit=fit,
        plane=plane,
        along=along,
        flow=flow,
        checks=(*found.checks, description),
        assumptions=(*lens_assumptions(fit, ()), assumed),
        from_markings=True,
    )


def verify_with_traffic(by_markings: Adjustment, told: list[PlaneEstimate]) -> tuple[str, ...] | Reason:
    """Say how the lines on the road agree with planes that the traffic tells, seen by the lens of the lines.

    Each that is known well enough has to agree, and one has to be.
    """
    by_markings, checks, best_deg = condition_on_lens(by_markings), [], np.inf
    for plane in told:
        apart_deg, own_deg, other_deg, what = _separation(by_markings, plane)
        best_deg, sigma_deg = min(best_deg, own_deg), float(np.hypot(own_deg, other_deg))
        description = f'{what} are {apart_deg:.1f} degrees apart, {sigma_deg:.1f} were expected'
        if own_deg <= MAX_CONFIRMING_SIGMA_DEG and apart_deg > max(AGREEMENT_SIGMAS * sigma_deg, PLANE_TOLERANCE_DEG):
            return Reason(
                'markings_contradicted',
                description,
                'wait for more traffic; if the markings are askew, set joint.road_markings to false',
            )
        if own_deg <= MAX_CONFIRMING_SIGMA_DEG:
            checks.append(description)
    seen = f'tells the plane to {best_deg:.0f} degrees' if best_deg < 90.0 else 'tells nothing'
    return (
        tuple(checks)
        if checks
        else Reason(
            'markings_unconfirmed',
            'lines on the road give lens and plane, but nothing confirms them: with that lens the '
            f'traffic {seen}, {MAX_CONFIRMING_SIGMA_DEG:g} are needed',
            'wait for more traffic, straight or turning',
        )
    )


def _separation(by_markings: Adjustment, told: PlaneEstimate) -> tuple[float, float, float, str]:
    """Angle of what the traffic tells from the lines, its own standard deviation, that of the lines, and its name."""
    if told.fit.plane_known:
        angle = unsigned_angle_deg(by_markings.state.rotation[:, 2], told.normal(told.fit.state))
        return (
            angle,
            told.worst_sigma_deg,
            PlaneEstimate(by_markings, 1.0).worst_sigma_deg,
            'ground normals of the traffic and of the lines',
        )
    road = told.fit.state.directions[0]
    angle = min(unsigned_angle_deg(axis, road) for axis in by_markings.state.directions)
    own, other = (
        float(np.degrees(np.linalg.norm(fit.sigma(lambda state: state.directions[0]))))
        for fit in (told.fit, by_markings)
    )
    return angle, own, other, 'the road of the traffic and the lines along it'


def _solve_straight(traffic: _Observations, config: AdjustmentConfig) -> Solution | Reason:
    """Solve from the directions on which straight tracks agree."""
    tracks, gate = traffic.tracks, traffic.gate
    found = solve_from_consensus(traffic.subsample, config, traffic.generator)
    if found is None:
        return Reason(
            'no_direction',
            f'{len(tracks)} tracks agree on no common direction',
            'straight traffic is needed: wait for it, or turn the camera towards a straight road',
        )
    best, contrast = found
    fit = adjust(best.state, tracks, best.problem.config)
    support = road_support(fit, tracks)
    second = sorted(int(mask.sum()) for mask in support)[:-1]
    across = f'{min([gate.min_tracks_per_road, *(second or [0])])} of {gate.min_tracks_per_road} tracks'
    fit, tracks = _select_noise_model(drop_unsupported_roads(fit, support, tracks, gate), traffic)
    fit = add_further_roads(add_second_road(fit, tracks, gate), tracks, gate)
    return check_straight_traffic(fit, contrast, tracks) or _refine_and_verify(fit, tracks, across, traffic)


def _select_noise_model(fit: Adjustment, traffic: _Observations) -> tuple[Adjustment, TrackSet]:
    """Choose the family of the lens, and whether points drift; then tracks of one body are known as such."""
    tracks = traffic.tracks
    fit = select_lens_family(fit, traffic.priors[1:], traffic.subsample, tracks)
    if noise_cost(fit, tracks, drifting=True) < noise_cost(fit, tracks, drifting=False):
        tracks = regroup_vehicles(fit, tracks) if fit.plane_known else tracks
        fit = adjust(fit.state, tracks, replace(fit.problem.config, drifting=True), refine=True)
    return fit, tracks


def _refine_and_verify(
    fit: Adjustment, tracks: TrackSet, across: str, traffic: _Observations, *, turned: bool = False
) -> Solution | Reason:
    """Refine a solution with all that the traffic tells, and doubt it.

    `across` counts the tracks on a second road for the one who waits for them; `turned` is a solution that started
    from traffic that turns.
    """
    gate, options = traffic.gate, fit.problem.config.options
    if fit.plane_known:
        fit = refine_with_turning(fit, tracks, traffic.windows) or fit
    fit = add_further_roads(fit, tracks, gate)
    fit, angle = fix_right_angle(fit, tracks, options)
    fit = release_k2(fit, tracks)
    fit, tracklet_state = refine_with_tracklets(fit, tracks, traffic.windows, traffic.instants)
    fit, fixed = fix_unidentifiable(fit, tracks)
    failed_check = _check_lens(fit, tracks, traffic, turned=turned) or (
        check_turning_centres(fit, traffic.windows) if len(fit.state.angles_rad) < 2 else None
    )
    if failed_check:
        return failed_check
    halves = check_halves(fit, tracks, gate)
    if isinstance(halves, Reason):
        return halves
    fit = widen_by_tracklet_difference(widen_by_point_slip(fit, traffic.windows), tracklet_state)
    along, flow = main_road(fit, tracks)
    assumptions = lens_assumptions(fit, fixed)
    if fit.plane_known:
        checks = (*_angle_and_turning_checks(fit, angle), halves)
        plane = PlaneEstimate.of(fit, tracks)
        return Solution(
            fit,
            plane,
            along,
            flow,
            (*assumptions, angle) if fit.crossing_fixed and angle else assumptions,
            checks,
            check_plane(plane, gate),
        )
    return _refine_with_lane_changes(
        _complete_one_road(fit, tracks, traffic, assumptions, halves, across), tracks, traffic
    )


def _complete_one_road(
    fit: Adjustment, tracks: TrackSet, traffic: _Observations, assumptions: tuple[str, ...], halves: str, across: str
) -> Solution:
    """Complete a solution of one road, about which the plane is free, by what may be assumed."""
    gate, options = traffic.gate, fit.problem.config.options
    along, flow = main_road(fit, tracks)
    assumed, checks = _assumption_across_road(fit, tracks, traffic)
    plane, checks = PlaneEstimate.of(fit, tracks, None if isinstance(assumed, Reason) else assumed), (halves, *checks)
    if not isinstance(assumed, Reason | None):
        assumptions = (*assumptions, f'ground plane by one road and {assumed.description}')
        return Solution(fit, plane, along, flow, assumptions, checks, check_plane(plane, gate))
    return Solution(
        fit,
        plane,
        along,
        flow,
        assumptions,
        checks,
        assumed
        or Reason(
            'one_direction',
            f'too little traffic across the main road yet: {across}; {int(fit.inliers().sum())} '
            'follow one road, and rotation about it is free'
            + (': edges of vehicles do not tell it either' if options.transverse_edges else ''),
            'wait for traffic across the main road, or that turns; or allow joint.roll_prior_deg',
        ),
    )


def _refine_with_lane_changes(found: Solution, tracks: TrackSet, traffic: _Observations) -> Solution:
    """Return a solution of one road with the plane that vehicles tell which leave their lanes, where they tell more."""
    changing = refine_with_lane_changes(found.fit, tracks, traffic.windows)
    if changing is None:
        return found
    fit, vehicles = changing
    plane, road = PlaneEstimate.of(fit, tracks), fit.state.directions[0]
    if check_plane(plane, traffic.gate):
        return found
    normal = plane.normal(fit.state)
    about_deg = float(np.degrees(fit.sigma(lambda state: np.array([np.cross(normal, state.rotation[:, 2]) @ road]))[0]))
    description, checks = (
        f'{vehicles} vehicles that change lanes: +- {about_deg:.1f} degrees about the road',
        found.checks,
    )
    if found.plane_refusal is None:
        apart_deg = unsigned_angle_deg(normal, found.plane.normal(found.fit.state))
        sigma_deg = float(np.hypot(plane.worst_sigma_deg, found.plane.worst_sigma_deg))
        if apart_deg > max(AGREEMENT_SIGMAS * sigma_deg, PLANE_TOLERANCE_DEG):
            return replace(
                found,
                plane_refusal=Reason(
                    'plane_uncertain',
                    f'{found.plane.assumed.description}, and {description}, are {apart_deg:.1f} degrees apart',
                    'wait for more traffic, above all across the road or turning',
                ),
            )
        checks = (*checks, f'{description}, {apart_deg:.1f} degrees from what is assumed')
        if found.plane.worst_sigma_deg <= plane.worst_sigma_deg:
            return replace(found, checks=checks)
    along, flow = main_road(fit, tracks)
    return Solution(
        fit,
        plane,
        along,
        flow,
        (*lens_assumptions(fit, ()), f'ground plane by one road and {description}'),
        checks,
        None,
        reduced=True,
    )


def _check_lens(fit: Adjustment, tracks: TrackSet, traffic: _Observations, *, turned: bool) -> Reason | None:
    """Doubt the lens; where too few seem to keep to the road, without those who walk beside and over it."""
    evidence, gate = traffic.evidence, traffic.gate
    failed_check = check_lens(fit, tracks, evidence, gate, turned=turned)
    if failed_check is None or failed_check.code != 'turning_traffic':
        return failed_check
    return check_lens(fit, tracks, evidence, gate, turned=turned, driving=_vehicle_tracks(fit, tracks, evidence))


def _vehicle_tracks(fit: Adjustment, tracks: TrackSet, evidence: Evidence) -> np.ndarray:
    """Mask (tracks,) of those not of people; where one road leaves the plane open, a level camera is plane enough."""
    level = None if fit.plane_known else LevelCamera(LEVEL_ROLL_TOLERANCE_DEG)
    if level is not None and not level.constrains_plane(fit.state):
        return np.ones(len(tracks), bool)
    camera, normal = PlaneEstimate.of(fit, tracks, level).lens_and_normal
    told = people(evidence, camera, normal, fit.problem.config.height_m or DEFAULT_CAMERA_HEIGHT_M)
    return ~np.isin(evidence.track_vehicles[tracks.indices], told)


def _assumption_across_road(
    fit: Adjustment, tracks: TrackSet, traffic: _Observations
) -> tuple[LevelCamera | TransverseDirection | Reason | None, tuple[str, ...]]:
    """What one may assume of the direction across a lone road, a reason where that contradicts itself; and checks."""
    options = fit.problem.config.options
    level = LevelCamera(options.roll_prior_deg) if options.roll_prior_deg > 0 else None
    square = (
        find_transverse_direction(traffic.evidence, fit, tracks, traffic.generator)
        if options.transverse_edges
        else None
    )
    if level is None or square is None:
        return level or square, ()
    joined, apart_deg = combine_assumptions(level, square, fit.state)
    if joined is None:
        return Reason(
            'plane_uncertain',
            f'edges of vehicles and a level camera disagree by {apart_deg:.1f} degrees about the road',
            'set joint.roll_prior_deg to 0 to trust the edges, or to what the camera may be rolled',
        ), ()
    return joined, (
        (f'edges of vehicles and a level camera differ by {apart_deg:.1f} degrees about the road',)
        if apart_deg >= 0
        else ()
    )


def _angle_and_turning_checks(fit: Adjustment, angle: str | None) -> tuple[str, ...]:
    bodies = len(np.unique(fit.problem.vehicle_ids[fit.problem.block_of_row > 0]))
    turning = (f'{bodies} vehicles that turn move as rigid bodies in the plane',) if bodies else ()
    return turning if angle is None or fit.crossing_fixed else (angle, *turning)
