"""The ground plane about one road: the rotation about it from an assumption, or from vehicles that change lanes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.solution import Observations, Solution
from autocalib_ros.estimation.straight.roads import main_road
from autocalib_ros.estimation.turning.lane_changes import refine_with_lane_changes
from autocalib_ros.estimation.vehicle_edges.transverse_edges import TransverseDirection, find_transverse_direction
from autocalib_ros.estimation.verification.gates import check_plane
from autocalib_ros.estimation.verification.ground_normal import (
    AGREEMENT_SIGMAS,
    LevelCamera,
    PlaneEstimate,
    combine_assumptions,
)
from autocalib_ros.estimation.verification.identifiability import lens_assumptions
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, assumption, check
from autocalib_ros.results.verification_table import VerificationRow, verified

PLANE_TOLERANCE_DEG = 1.5
"""Two planes that differ by less agree, whatever their sigmas: the promised accuracy of the ground normal."""


@dataclass(frozen=True)
class CrossTraffic:
    """Tracks on a second road, against the number that makes a road."""

    tracks: int
    needed: int


def complete_one_road(
    fit: Adjustment,
    tracks: TrackSet,
    observations: Observations,
    assumptions: tuple[Statement, ...],
    halves: Statement,
    crossing: CrossTraffic | None,
) -> Solution:
    """Complete the solution of one road, whose plane may rotate about it; without a plane if nothing fixes it."""
    along, flow = main_road(fit, tracks)
    across, compared = _assumption_across_road(fit, tracks, observations)
    plane = PlaneEstimate.of(fit, tracks, None if isinstance(across, Reason) else across)
    if isinstance(across, LevelCamera | TransverseDirection):
        assumptions = (*assumptions, across.assumption)
        refusal = check_plane(plane, observations.gate)
    else:
        refusal = across or _one_direction(fit, crossing)
    solution = Solution(fit, plane, along, flow, assumptions, (halves,), refusal)
    if compared is not None:
        statement = check('edges_and_level', difference_deg=compared.value)
        solution = replace(solution, checks=(halves, statement)).compared(compared)
    return _with_lane_changes(solution, tracks, observations)


def _one_direction(fit: Adjustment, crossing: CrossTraffic | None) -> Reason:
    along = int(fit.inliers().sum())
    if crossing is None:
        return reason('one_direction', 'turning', along=along)
    cause = 'edges_tried' if fit.problem.config.options.transverse_edges else ''
    return reason('one_direction', cause, across=crossing.tracks, limit=crossing.needed, along=along)


def _assumption_across_road(
    fit: Adjustment, tracks: TrackSet, observations: Observations
) -> tuple[LevelCamera | TransverseDirection | Reason | None, VerificationRow | None]:
    """What the options allow to assume of the direction across the road; a reason if two assumptions disagree.

    And their comparison, where there are two.
    """
    options = fit.problem.config.options
    level = LevelCamera(options.roll_prior_deg) if options.roll_prior_deg > 0 else None
    edges = None
    if options.transverse_edges:
        edges = find_transverse_direction(observations.evidence, fit, tracks, observations.generator)
    if level is None or edges is None:
        return level or edges, None
    combined, difference_deg, limit_deg = combine_assumptions(level, edges, fit.state)
    if combined is None:
        return reason('plane_uncertain', 'edges_and_level', difference_deg=difference_deg), None
    return combined, verified('edges_and_level', difference_deg, limit_deg) if difference_deg >= 0 else None


def _with_lane_changes(found: Solution, tracks: TrackSet, observations: Observations) -> Solution:
    """Return the solution with the plane from vehicles that change lanes, if they determine it better."""
    changing = refine_with_lane_changes(found.fit, tracks, observations.windows)
    if changing is None:
        return found
    fit, vehicles = changing
    plane = PlaneEstimate.of(fit, tracks)
    if check_plane(plane, observations.gate):
        return found
    sigma_deg, checks = _sigma_about_road_deg(fit, plane), found.checks
    statement = assumption('lane_changes', vehicles=vehicles, sigma_deg=sigma_deg)
    if found.plane_refusal is None:
        difference_deg = unsigned_angle_deg(plane.normal(fit.state), found.plane.normal(found.fit.state))
        combined_deg = float(np.hypot(plane.worst_sigma_deg, found.plane.worst_sigma_deg))
        limit_deg = max(AGREEMENT_SIGMAS * combined_deg, PLANE_TOLERANCE_DEG)
        if difference_deg > limit_deg:
            disagree = _planes_disagree(found, statement, difference_deg=difference_deg, limit_deg=limit_deg)
            return replace(found, plane_refusal=disagree)
        checks = (
            *checks,
            check('lane_changes', vehicles=vehicles, sigma_deg=sigma_deg, difference_deg=difference_deg),
        )
        found = found.compared(verified('lane_changes', difference_deg, limit_deg))
        if found.plane.worst_sigma_deg <= plane.worst_sigma_deg:
            return replace(found, checks=checks)
    along, flow = main_road(fit, tracks)
    assumptions, rows = (*lens_assumptions(fit, ()), statement), found.comparisons
    return Solution(fit, plane, along, flow, assumptions, checks, None, reduced=True, comparisons=rows)


def _sigma_about_road_deg(fit: Adjustment, plane: PlaneEstimate) -> float:
    """Standard deviation of the rotation of the plane about its road, degrees."""
    normal, road = plane.normal(fit.state), fit.state.directions[0]
    turn = fit.sigma(lambda state: np.array([np.cross(normal, state.rotation[:, 2]) @ road]))
    return float(np.degrees(turn)[0])


def _planes_disagree(found: Solution, changing: Statement, *, difference_deg: float, limit_deg: float) -> Reason:
    assumed = '' if found.plane.assumed is None else found.plane.assumed.assumption.text
    return reason(
        'plane_uncertain',
        'lane_changes',
        difference_deg=difference_deg,
        limit_deg=limit_deg,
        assumed=assumed,
        changing=changing.text,
    )
