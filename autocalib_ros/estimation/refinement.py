"""From an initial solution to a verified one: noise model, turning vehicles, identifiability, cross-validation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust, regroup_vehicles
from autocalib_ros.estimation.adjustment.model_selection import noise_cost
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.one_road import CrossTraffic, complete_one_road
from autocalib_ros.estimation.people.pedestrians import people
from autocalib_ros.estimation.solution import MAX_SUBSAMPLE_TRACKS, Observations, Solution
from autocalib_ros.estimation.straight.initialisation import select_lens_family
from autocalib_ros.estimation.straight.roads import add_further_roads, expect_right_angle, main_road
from autocalib_ros.estimation.turning.turning_traffic import (
    refine_with_tracklets,
    refine_with_turning,
    widen_by_point_slip,
    widen_by_tracklet_difference,
)
from autocalib_ros.estimation.verification.cut_picture import compare_cut_picture
from autocalib_ros.estimation.verification.focal_modes import widen_by_focal_modes
from autocalib_ros.estimation.verification.focal_profile import widen_by_focal_profile
from autocalib_ros.estimation.verification.gates import check_focal_length, check_halves, check_lens, check_plane
from autocalib_ros.estimation.verification.ground_normal import LevelCamera, PlaneEstimate
from autocalib_ros.estimation.verification.identifiability import fix_unidentifiable, free_k2, lens_assumptions
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import Statement, check
from autocalib_ros.results.verification_table import VerificationRow

LEVEL_ROLL_TOLERANCE_DEG = 5.0
"""Roll up to which pedestrians are classified as if the camera were level."""


def select_noise_model(fit: Adjustment, observations: Observations) -> tuple[Adjustment, TrackSet]:
    """Select the lens family and the noise model; with drifting points, tracks of one body become one vehicle."""
    tracks = observations.tracks
    fit = select_lens_family(fit, observations.priors[1:], observations.subsample, tracks)
    if noise_cost(fit, tracks, drifting=True) < noise_cost(fit, tracks, drifting=False):
        tracks = regroup_vehicles(fit, tracks) if fit.plane_known else tracks
        fit = adjust(fit.state, tracks, replace(fit.problem.config, drifting=True), refine=True)
    return fit, tracks


def refine_and_verify(
    fit: Adjustment,
    tracks: TrackSet,
    observations: Observations,
    *,
    crossing: CrossTraffic | None = None,
    turned: bool = False,
) -> Solution | Reason:
    """Refine a solution with all traffic, and verify it.

    `crossing` counts the tracks on a second road, for the message of a refusal; `turned` marks a solution that was
    initialised by turning traffic.
    """
    gate, options = observations.gate, fit.problem.config.options
    # Turning vehicles join the adjustment as rigid bodies between two instants.
    if fit.plane_known:
        fit = refine_with_turning(fit, tracks, observations.windows) or fit
    # Further roads; two roads near 90 degrees are expected at a right angle.
    fit = add_further_roads(fit, tracks, gate)
    fit, angle = expect_right_angle(fit, tracks, options)
    # k2 is free within its prior where the plane is known.
    fit = free_k2(fit, tracks)
    # Turning vehicles as rigid bodies over several seconds.
    fit, tracklets = refine_with_tracklets(fit, tracks, observations.windows, observations.instants)
    # Parameters that the evidence does not determine return to their prior.
    fit, fixed = fix_unidentifiable(fit, tracks)
    # Gates on the lens; cross-validation in time.
    explained = _check_lens(fit, tracks, observations, turned=turned)
    if isinstance(explained, Reason):
        # a lens that the traffic does not determine bends roads: then few vehicles seem to follow one
        return (explained.code == 'turning_traffic' and check_focal_length(fit, gate, turned=turned)) or explained
    halves = check_halves(fit, tracks, gate)
    if isinstance(halves, Reason):
        return halves
    # A turn of the camera that the halves do not exclude, and errors that no residual shows, widen the covariance.
    fit = halves.covered_by(fit)
    fit = widen_by_point_slip(fit, observations.windows)
    fit = widen_by_tracklet_difference(fit, tracklets)
    # Other focal lengths that are about as probable widen it, too.
    some = tracks.at_most(MAX_SUBSAMPLE_TRACKS)
    fit = widen_by_focal_profile(widen_by_focal_modes(fit, some), some)
    # A picture that was cut off away from its centre, too.
    cut = compare_cut_picture(fit, tracks)
    fit = fit if cut is None else cut.covered()
    uncertain = check_focal_length(fit, gate, turned=turned)
    assumptions = lens_assumptions(fit, fixed)
    compared = (*explained, *halves.rows, *(() if tracklets is None else (tracklets.row,)))
    if not fit.plane_known:
        if uncertain:
            return uncertain
        return complete_one_road(fit, tracks, observations, assumptions, halves.statement, crossing).compared(*compared)
    if fit.crossing_known and angle:
        assumptions = (*assumptions, angle)
    along, flow = main_road(fit, tracks)
    plane = PlaneEstimate.of(fit, tracks)
    checks = (*_plane_checks(fit, angle), halves.statement)
    refusal = check_plane(plane, gate)
    return Solution(
        fit,
        plane,
        along,
        flow,
        assumptions,
        checks,
        refusal,
        lens_refusal=uncertain,
        comparisons=compared,
        clearly_cut=cut is not None and cut.is_clear,
    )


def _check_lens(
    fit: Adjustment, tracks: TrackSet, observations: Observations, *, turned: bool
) -> Reason | tuple[VerificationRow, ...]:
    """Check the lens; if too few tracks follow the road, check again without pedestrians."""
    evidence = observations.evidence
    outcome = check_lens(fit, tracks, evidence, turned=turned)
    if not isinstance(outcome, Reason) or outcome.code != 'turning_traffic':
        return outcome
    return check_lens(fit, tracks, evidence, turned=turned, driving=_vehicle_tracks(fit, tracks, evidence))


def _vehicle_tracks(fit: Adjustment, tracks: TrackSet, evidence: Evidence) -> np.ndarray:
    """Mask (tracks,) of the tracks of vehicles; about a lone road the camera is taken as level to classify them."""
    level = None if fit.plane_known else LevelCamera(LEVEL_ROLL_TOLERANCE_DEG)
    if level is not None and not level.constrains_plane(fit.state):
        return np.ones(len(tracks), bool)
    camera, normal = PlaneEstimate.of(fit, tracks, level).lens_and_normal
    pedestrians = people(evidence, camera, normal, fit.problem.config.height_m or DEFAULT_CAMERA_HEIGHT_M)
    return ~np.isin(evidence.track_vehicles[tracks.indices], pedestrians)


def _plane_checks(fit: Adjustment, angle: Statement | None) -> tuple[Statement, ...]:
    vehicles = len(np.unique(fit.problem.vehicle_ids[fit.problem.block_of_row > 0]))
    turning = (check('turning_vehicles', vehicles=vehicles),) if vehicles else ()
    return turning if angle is None or fit.crossing_known else (angle, *turning)
