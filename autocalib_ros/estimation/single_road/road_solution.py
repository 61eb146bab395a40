"""The strategy for one straight road: which traffic follows it, and what lens and plane the scene then leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust, evaluate_at
from autocalib_ros.estimation.adjustment.lens_prior import DISTORTION_FREE, known_lens
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.markings.road_segments import LINE_CORRELATION, group_segments
from autocalib_ros.estimation.observations.track_set import TrackSet, kish_weight
from autocalib_ros.estimation.single_road.barrel_lens import USUAL_VIEW_DEG, USUAL_VIEW_FACTOR, LensChoice
from autocalib_ros.estimation.single_road.direction_mixture import STILL_SEGMENTS, VEHICLE_EDGES, DirectionMixture
from autocalib_ros.estimation.single_road.posterior import road_posterior
from autocalib_ros.estimation.single_road.told_focal import mixed, probability_of_told
from autocalib_ros.estimation.straight.initialisation import solve_from_consensus
from autocalib_ros.estimation.vehicle_edges.edge_mixture import EDGE_CORRELATION
from autocalib_ros.estimation.vehicle_edges.transverse_edges import select_vehicle_edges
from autocalib_ros.estimation.verification.gates import check_halves, straight_fraction, turning_traffic_reason
from autocalib_ros.estimation.verification.identifiability import (
    given_focal_assumption,
    lens_assumptions,
    principal_point_assumption,
)
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg
from autocalib_ros.lens.camera import Camera, field_of_view_deg
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, assumption, check
from autocalib_ros.results.verification_table import VerificationRow, verified

MAX_COMPARED_TRACKS = 150
"""Tracks, evenly spaced in the list of all, by which lenses are compared."""
MAX_ROAD_SEGMENTS = 200
"""Most edges, and most still lines, in the posterior: the longest."""
FIXED_LENS_SIGMA = np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Of a lens that is fixed but for its focal length, which is known: no other one is tried."""
DEFAULT_ROLL_SIGMA_DEG = 3.0
"""Standard deviation of the roll of a camera over a single road: 2.1 degrees on 18 measured ones (BrnoCompSpeed), and
the camber of roads."""
MIN_BARREL_GAIN = 1.1
"""Factor by which more vehicles have to follow the road through a lens with more barrel distortion. Judgement."""
SAME_ROAD_DEG = 10.0
"""Roads through two lenses that differ by less are one."""
MIN_ROAD_VEHICLES = 8
"""Fewest vehicles that follow the road; among fewer, one that changes lanes weighs too much. Judgement."""
MAX_GIVEN_SIGMAS = 3.0
"""Largest difference of a given focal length from that of the road without it: 0.3 % of right ones exceed it."""
MIN_FOLLOWING = 0.25
"""Share of the vehicles that has to follow the road: on bends fewer than 15 % follow any straight line."""


@dataclass(frozen=True)
class SingleRoad:
    """Lens and plane of a single road, with what was assumed and compared."""

    fit: Adjustment
    choice: LensChoice
    """The lenses that were tried."""
    assumptions: tuple[Statement, ...]
    checks: tuple[Statement, ...]
    rows: tuple[VerificationRow, ...]

    def compared_with_given(self, free: SingleRoad | Reason, tracks: TrackSet) -> SingleRoad:
        """Return the solution with a given focal length compared, and mixed, with that of a solution without it."""
        if isinstance(free, Reason):
            return self
        camera, told_sigma = free.fit.state.camera, float(self.choice.prior.sigma[0])
        given_px = self.choice.expected_focal_px(camera.k[0] / DISTORTION_FREE[0])
        difference = float(np.log(given_px / camera.focal_px))
        sigma = float(np.hypot(free.fit.focal_sigma, told_sigma))
        row = verified('given_focal', abs(difference) / sigma, MAX_GIVEN_SIGMAS)
        believed = probability_of_told(difference, free.fit.focal_sigma, told_sigma)
        statement = check(
            'given_focal',
            given_px=given_px,
            road_px=camera.focal_px,
            road_sigma_px=free.fit.focal_sigma * camera.focal_px,
            believed=believed,
        )
        fit = mixed(self.fit, free.fit, difference, believed, tracks)
        return replace(self, fit=fit, checks=(*self.checks, statement), rows=(*self.rows, row))


def solve_single_road(
    evidence: Evidence,
    tracks: TrackSet,
    config: AdjustmentConfig,
    gate: GateOptions,
    generator: np.random.Generator,
) -> SingleRoad | Reason:
    """Estimate lens and plane from one straight road, the scene along it, and wide priors; a reason if that fails."""
    choice = LensChoice(config.prior, config.options)
    subsample = tracks.at_most(MAX_COMPARED_TRACKS)
    road = _find_road(choice, subsample, config, generator)
    if road is None:
        return reason('no_direction', tracks=len(tracks))
    start, compared = road
    whole = adjust(start.state, tracks, start.problem.config, refine=True)
    following = _following(whole, tracks)
    if isinstance(following, Reason):
        return following
    roll_deg, segments = config.options.roll_prior_deg or DEFAULT_ROLL_SIGMA_DEG, _segments(evidence, whole, tracks)
    parameters, covariance = road_posterior(
        start, subsample.subset(compared), choice, segments, float(np.radians(roll_deg))
    )
    fit = evaluate_at(parameters.base, tracks, parameters.config, covariance)
    halves = check_halves(_along_the_road(fit, whole, tracks), tracks, gate, _lenses_about(fit))
    if isinstance(halves, Reason):
        return halves
    edges, lines = segments
    seen = check('single_road', edges=len(edges.weights), lines=len(lines.weights), following=following)
    return SingleRoad(
        fit,
        choice,
        (*_lens_statements(fit, choice), assumption('level_camera', sigma_deg=roll_deg)),
        (seen, halves.statement),
        (verified('straight_share', following, MIN_FOLLOWING), *halves.rows),
    )


def _along_the_road(fit: Adjustment, road: Adjustment, tracks: TrackSet) -> Adjustment:
    """Return the direction of the road through the mean lens of the posterior."""
    start = AdjustmentState(fit.state.camera, fit.state.rotation, np.zeros(1))
    return adjust(start, tracks, replace(road.problem.config, prior=known_lens(fit.state.camera)), refine=True)


def _lenses_about(fit: Adjustment) -> list[Camera]:
    """Return lenses one standard deviation from that of the posterior, along each axis of their covariance."""
    lens = slice(0, fit.problem.parameters.lens)
    variances, axes = np.linalg.eigh(fit.covariance[lens, lens])
    steps = (np.sqrt(np.maximum(variances, 0.0)) * axes).T
    return [fit.problem.config.prior.moved(fit.state.camera, step) for step in steps if step.any()]


def _following(fit: Adjustment, tracks: TrackSet) -> float | Reason:
    """Return the share of the vehicles that follow the road; a reason if it is, or they are, too few."""
    vehicles = len(np.unique(tracks.vehicles[fit.inliers()]))
    if vehicles < MIN_ROAD_VEHICLES or not np.isfinite(fit.covariance).all():
        return reason('too_few_vehicles', 'single_road', vehicles=vehicles, limit=MIN_ROAD_VEHICLES)
    following = straight_fraction(fit, tracks)
    return turning_traffic_reason(fit, following, MIN_FOLLOWING) if following < MIN_FOLLOWING else following


def _segments(evidence: Evidence, fit: Adjustment, tracks: TrackSet) -> tuple[DirectionMixture, DirectionMixture]:
    """Return the edges of the vehicles that follow the road, and the lines of the still scene, as options allow."""
    options = fit.problem.config.options
    edges, lines = _edges(evidence, tracks.subset(fit.inliers())), _lines(evidence)
    return edges if options.transverse_edges else edges.without(), lines if options.road_markings else lines.without()


def _find_road(
    choice: LensChoice, tracks: TrackSet, config: AdjustmentConfig, generator: np.random.Generator
) -> tuple[Adjustment, np.ndarray] | None:
    """Return the road that most vehicles follow, through the lens that shows it best, and the tracks that follow it.

    The mask (tracks,) is of those that follow the same road through any of the lenses that are tried. None without one.
    """
    config = replace(config, crossing_rad=None)
    found = [
        _busiest_road(fit, tracks, replace(config, prior=known_lens(lens)))
        for lens, fit in roads_through(choice, tracks, config, generator)
    ]
    if not found:
        return None
    best = most_followed(found, tracks)
    same = [
        fit.inliers()
        for fit in found
        if unsigned_angle_deg(fit.state.directions[0], best.state.directions[0]) < SAME_ROAD_DEG
    ]
    return best, np.any(same, axis=0)


def roads_through(
    choice: LensChoice, tracks: TrackSet, config: AdjustmentConfig, generator: np.random.Generator
) -> list[tuple[Camera, Adjustment]]:
    """Return the lenses that are tried and show roads, straighter ones first, with the roads through each."""
    found = []
    for lens in choice.trials():
        trial = replace(config, prior=replace(known_lens(lens), sigma=FIXED_LENS_SIGMA))
        solved = solve_from_consensus(tracks, trial, generator)
        if solved is not None and len(solved[0].state.angles_rad):
            found.append((lens, solved[0]))
    return found


def most_followed(fits: Sequence[Adjustment], tracks: TrackSet) -> Adjustment:
    """Return the solution that most vehicles follow, of solutions through lenses in the order of `roads_through`.

    Barrel distortion is believed where it explains clearly more.
    """
    follow = np.array([float(tracks.vehicle_weight @ fit.inliers()) for fit in fits])
    return fits[int(np.argmax(follow > follow.max() / MIN_BARREL_GAIN))]


def _busiest_road(fit: Adjustment, tracks: TrackSet, config: AdjustmentConfig) -> Adjustment:
    """Return the solution of the road with the most vehicles alone."""
    followed = fit.inliers()
    weights = [tracks.vehicle_weight @ (followed & (fit.labels == road)) for road in range(len(fit.state.angles_rad))]
    along, up = fit.state.directions[int(np.argmax(weights))], fit.state.rotation[:, 2]
    state = AdjustmentState(fit.state.camera, np.column_stack([along, np.cross(up, along), up]), np.zeros(1))
    return adjust(state, tracks, config, refine=True)


def _lens_statements(fit: Adjustment, choice: LensChoice) -> tuple[Statement, ...]:
    """Return what was assumed of the lens."""
    prior = choice.prior
    if choice.known:
        return lens_assumptions(fit, ())
    k1_sigma = float(fit.sigma(lambda state: np.array([state.camera.k[0]]))[0])
    statements = [
        assumption('lens_barrel', k1=fit.state.camera.k[0], sigma=k1_sigma),
        principal_point_assumption(prior),
    ]
    if prior.focal_known:
        return (*statements, given_focal_assumption(prior))
    view_deg = field_of_view_deg(fit.state.camera)[0]
    return (
        *statements,
        assumption(
            'field_of_view',
            usual_deg=USUAL_VIEW_DEG,
            factor=USUAL_VIEW_FACTOR,
            view_deg=view_deg,
            sigma=fit.focal_sigma,
        ),
    )


def _edges(evidence: Evidence, along: TrackSet) -> DirectionMixture:
    """Return the longest edges of the vehicles that follow the road."""
    edges = select_vehicle_edges(evidence, along)
    longest = edges.subset(_longest(edges.ends_px))
    return DirectionMixture(VEHICLE_EDGES, longest.ends_px, kish_weight(longest.vehicles, EDGE_CORRELATION))


def _lines(evidence: Evidence) -> DirectionMixture:
    """Return the longest lines of the still scene."""
    ends = evidence.still_lines_px[_longest(evidence.still_lines_px)]
    groups = group_segments(ends, evidence.image_size[0])
    return DirectionMixture(STILL_SEGMENTS, ends, kish_weight(groups, LINE_CORRELATION))


def _longest(ends: np.ndarray) -> np.ndarray:
    """Return the indices of the longest of segments (n, 4)."""
    return np.argsort(-np.hypot(*(ends[:, 2:] - ends[:, :2]).T), kind='stable')[:MAX_ROAD_SEGMENTS]
