"""The method on one page: evidence in, a calibration or a refusal out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior, known_lens, lens_priors
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig
from autocalib_ros.estimation.given_lens import check_view, verify_given_lens
from autocalib_ros.estimation.known_lengths import adjust_to_lengths, scale_of, with_seen_lengths
from autocalib_ros.estimation.observations.selection import drop_pedestrians
from autocalib_ros.estimation.observations.track_set import TrackSet, long_tracks, select_tracks
from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks, find_windows
from autocalib_ros.estimation.paper.intrinsics import paper_intrinsics
from autocalib_ros.estimation.paper.published_method import solve_paper
from autocalib_ros.estimation.pixels.aspect_hypotheses import AspectHypotheses
from autocalib_ros.estimation.pixels.aspect_test import choose_aspect, with_stated_aspect
from autocalib_ros.estimation.pixels.square_pixels import with_square_pixels
from autocalib_ros.estimation.plausibility import with_usual_vehicles
from autocalib_ros.estimation.publish import (
    ResultDraft,
    choose_solution,
    count_pedestrians,
    find_pedestrians,
    require_grade,
    with_requested_model,
)
from autocalib_ros.estimation.solution import (
    MAX_SUBSAMPLE_TRACKS,
    Observations,
    Solution,
    accepted,
    append_reason,
    is_better,
)
from autocalib_ros.estimation.solution_rows import with_solution_rows
from autocalib_ros.estimation.strategies import (
    complete_with_lane_markings,
    estimate_from_lane_markings,
    estimate_from_single_road,
    estimate_from_straight_traffic,
    estimate_from_turning_traffic,
    sharpen_with_lane_markings,
    with_cut_picture,
    with_single_road,
)
from autocalib_ros.estimation.verification.readiness import check_readiness
from autocalib_ros.estimation.verification.scale import is_unusual
from autocalib_ros.estimation.verification.stated_family import verify_stated_family
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.refusals import Reason, reason

SINGLE_ROAD_CODES = (
    'no_agreement',
    'too_little_curvature',
    'too_little_turning',
    'turning_traffic',
    'one_direction',
)
"""Reasons that one straight road without visible curvature gives; other ones contradict something."""
CUT_CONTRADICTIONS = ('horizon', 'lens_model', 'halves_disagree')
"""Refusals of a centred picture after which one that was cut off is tried: those that its wrong centre causes."""
COMPARED_FAMILIES = ('equidistant', 'distortion_free')
"""Lens families that exclude each other."""
PLENTY = 2.0
"""Tracks over those needed from which on it is not their number that fails: half of them and more are of no use."""


def solve(evidence: Evidence, options: Options, *, lens: Camera | None = None) -> Calibration | Refusal:
    """Estimate lens and ground plane from a snapshot; a pure function of its arguments.

    With a known `lens`, of the size of the images, only the pose is estimated; method paper ignores it. Raises
    UsageError if a pixel of scale.distance_px lies outside the image.
    """
    options.scale.require_inside(*evidence.image_size)
    # The published intrinsic stage: part of method paper, a comparison for method joint.
    aspect = options.lens.pixel_aspect_or(evidence.pixel_aspect)
    draft = ResultDraft.begin(evidence, options, paper_intrinsics(with_square_pixels(evidence, aspect), options.paper))
    # A given lens that cannot be of these images is not tried.
    impossible = None if lens is None or options.method == 'paper' else check_view(lens, evidence.points_px)
    if impossible:
        return draft.refusal(impossible)
    # Pedestrians that a detector saw are left out.
    traffic, kept = drop_pedestrians(evidence)
    # Without enough evidence nothing is estimated.
    not_ready = check_readiness(traffic, options.gate)
    if not_ready:
        return draft.refusal(not_ready)
    # Lens, plane and roads.
    if options.method == 'paper':
        result = solve_paper(evidence, options, draft.intrinsics, draft.figures)
    else:
        result = _solve_joint(traffic, kept, draft, lens)
    # A result of too low a grade, or a lens that the requested distortion model cannot represent, is refused.
    if isinstance(result, Reason):
        return draft.refusal(result)
    modelled = with_requested_model(result, options)
    return require_grade(modelled, options.gate.least) if isinstance(modelled, Calibration) else modelled


def _solve_joint(traffic: Evidence, kept: np.ndarray, draft: ResultDraft, lens: Camera | None) -> Calibration | Reason:
    """Estimate from traffic, which holds the tracks `kept` of the evidence; again without pedestrians if it has any."""
    found = _estimate_and_scale(traffic, kept, draft, lens)
    if isinstance(found, Reason):
        return found
    result, from_markings = found
    # Pedestrians and cyclists are known once lens and plane are: all is estimated again without them.
    pedestrians = find_pedestrians(result, traffic)
    vehicles = traffic.without_vehicles(pedestrians)
    if len(pedestrians) and not from_markings:
        driving = kept[~np.isin(traffic.track_vehicles, pedestrians)]
        again = check_readiness(vehicles, draft.options.gate) or _estimate_and_scale(vehicles, driving, draft, lens)
        result = choose_solution(result, again if isinstance(again, Reason) else again[0])
    # Size and speed of the vehicles test scale and plane.
    return count_pedestrians(with_usual_vehicles(result, vehicles), len(pedestrians))


def _estimate_and_scale(
    traffic: Evidence, kept: np.ndarray, draft: ResultDraft, lens: Camera | None
) -> tuple[Calibration, bool] | Reason:
    """Estimate, then add scale, sigmas and grade; and whether lens and plane come from lane markings."""
    options = draft.options
    tracks = select_tracks(traffic, options.joint.max_tracks)

    def found_at(height_m: float) -> Solution | Reason:
        found = find_solution(traffic, tracks, options, height_m=height_m, lens=lens)
        return found if isinstance(found, Reason) else with_seen_lengths(found, traffic, options)

    solution = found_at(options.camera_height)
    height_m = _unusual_height_m(solution, options)
    if height_m is not None:
        solution = found_at(height_m)
    if isinstance(solution, Reason):
        return solution
    solution = adjust_to_lengths(solution, tracks, options)
    return draft.calibration(with_solution_rows(solution, options.gate), kept[tracks.indices]), solution.from_markings


def _unusual_height_m(solution: Solution | Reason, options: Options) -> float | None:
    """Height of the camera that follows from the solution, if it is unlike the default for an unknown height."""
    if options.camera_height > 0 or isinstance(solution, Reason) or solution.plane_refusal:
        return None
    scale = scale_of(solution, options)
    if isinstance(scale, Reason) or not scale.metric:
        return None
    height_m = scale.height(*solution.plane.lens_and_normal)
    return height_m if is_unusual(height_m) else None


def find_solution(
    evidence: Evidence, tracks: TrackSet, options: Options, *, height_m: float = 0.0, lens: Camera | None = None
) -> Solution | Reason:
    """Estimate lens, plane and roads from evidence and the tracks selected from it; a reason if that fails.

    Straight traffic comes first, completed by turning vehicles. If that gives no plane, or one that rests on an
    assumption, turning traffic alone is tried, and then lane markings. `height_m` is 0 if unknown.
    """
    gate, joint = options.gate, options.joint
    if len(tracks) < gate.min_tracks:
        return _too_few_tracks(evidence, len(tracks), gate.min_tracks)
    instants = ResampledTracks(evidence)
    windows = find_windows(evidence, instants)

    given = options.lens.pixel_aspect
    hypotheses = AspectHypotheses.of(evidence.image_size)
    if evidence.pixel_aspect > 0.0:
        hypotheses = hypotheses.expecting(evidence.pixel_aspect)
    unmeasured = 0.0 if given > 0.0 or evidence.pixel_aspect > 0.0 else hypotheses.unmeasured_sigma

    def estimate_under(priors: list[LensPrior]) -> Solution | Reason:
        generator = np.random.default_rng(options.random_seed)
        observations = Observations(tracks, windows, instants, priors, gate, evidence, generator, unmeasured)
        return _estimate(observations, AdjustmentConfig(priors[0], joint, height_m, joint.crossing_rad))

    def estimate_with_aspect(aspect: float, sigma: float) -> Solution | Reason:
        families = lens_priors(evidence.image_size, joint, evidence.picture, aspect, options.lens)
        families = [prior.with_pixel_aspect(aspect, sigma) for prior in families]
        found = estimate_under(families)
        if not _may_be_cut(found):
            return found
        return with_cut_picture(estimate_under([prior.with_loose_centre() for prior in families]), found)

    if lens is not None:
        return verify_given_lens(
            lens, estimate_under([known_lens(lens)]), tracks, lambda: estimate_with_aspect(lens.pixel_aspect, 0.0)
        )
    if given > 0.0:
        found = with_stated_aspect(estimate_with_aspect(given, 0.0), given, 'given')
    else:
        found = choose_aspect(hypotheses, estimate_with_aspect, tracks, gate)
        found = with_stated_aspect(found, evidence.pixel_aspect, 'recording')
    return _with_stated_family(found, evidence, tracks, options, height_m)


def _may_be_cut(found: Solution | Reason) -> bool:
    """Whether the traffic shows a picture that was cut off, or refuses a centred one as a wrong centre would."""
    return found.code in CUT_CONTRADICTIONS if isinstance(found, Reason) else found.clearly_cut


def _with_stated_family(
    found: Solution | Reason, evidence: Evidence, tracks: TrackSet, options: Options, height_m: float
) -> Solution | Reason:
    """Add to a solution the comparison of the lens family that an option states with others; a reason if it is wrong.

    The family between the others, which contains both, is not compared.
    """
    joint = options.joint
    if joint.lens_prior not in COMPARED_FAMILIES:
        return found
    fit = None if isinstance(found, Reason) else found.of_traffic or found.fit
    aspect = options.lens.pixel_aspect_or(evidence.pixel_aspect) if fit is None else fit.state.camera.pixel_aspect

    def priors(family: str) -> list[LensPrior]:
        stated = replace(joint, lens_prior=family)
        return lens_priors(evidence.image_size, stated, evidence.picture, aspect, options.lens)

    others = [prior for family in COMPARED_FAMILIES if family != joint.lens_prior for prior in priors(family)]
    config = AdjustmentConfig(priors(joint.lens_prior)[0], joint, height_m, joint.crossing_rad)
    generator = np.random.default_rng(options.random_seed)
    compared = verify_stated_family(fit, config, others, tracks, tracks.at_most(MAX_SUBSAMPLE_TRACKS), generator)
    if isinstance(compared, Reason):
        return compared
    return found if compared is None or isinstance(found, Reason) else found.compared(compared)


def _too_few_tracks(evidence: Evidence, usable: int, limit: int) -> Reason:
    """Return why too few tracks are usable: few vehicles so far, paths that are not straight, or short ones.

    Where there are several times as many tracks as needed, their kind is the cause, and more of them will not help.
    """
    kind = ''
    if evidence.track_count >= PLENTY * limit:
        kind = 'curved' if len(long_tracks(evidence)) >= limit else 'far'
    return reason('too_few_tracks', kind or 'short', tracks=usable, all=evidence.track_count, limit=limit)


def _estimate(observations: Observations, config: AdjustmentConfig) -> Solution | Reason:
    """Estimate lens, plane and roads under the priors of the observations, by one strategy after the other."""
    # Traffic: straight first; turning alone if that leaves anything open.
    straight, turning = estimate_from_straight_traffic(observations, config), None
    found = accepted(straight)
    if not (isinstance(found, Solution) and found.full):
        turning = estimate_from_turning_traffic(observations, config)
        found = found if turning is None or not is_better(accepted(turning), found) else accepted(turning)
    # Lane markings: a sharper estimate if the traffic gives all, another strategy if it does not.
    if config.options.road_markings:
        found = _with_lane_markings(found, (straight, turning), observations, config)
    # A single road: its vehicles and scenery, and wide priors.
    if config.options.single_road and _leaves_a_road_open(found):
        found = with_single_road(found, estimate_from_single_road(observations, config))
    return found


def _with_lane_markings(
    found: Solution | Reason,
    by_traffic: tuple[Solution | Reason | None, ...],
    observations: Observations,
    config: AdjustmentConfig,
) -> Solution | Reason:
    """Sharpen what was found with lane markings, complete solutions of the traffic with them, or use them alone."""
    if isinstance(found, Solution) and found.full:
        return sharpen_with_lane_markings(found, observations)
    markings = estimate_from_lane_markings(observations, config)
    completed = [
        complete_with_lane_markings(traffic, observations)
        for traffic in by_traffic
        if isinstance(traffic, Solution) and traffic.fit.plane_known and not traffic.full
    ]
    best = found
    for other in (*completed, markings):
        best = other if is_better(other, best) else best
    if best is found and isinstance(markings, Reason) and markings.code != 'no_markings':
        return append_reason(found, markings)
    return best


def _leaves_a_road_open(found: Solution | Reason) -> bool:
    """Whether a road may be there, but lens or plane about it are open."""
    if isinstance(found, Reason):
        return found.code in SINGLE_ROAD_CODES
    if found.plane_refusal:
        return found.plane_refusal.code in SINGLE_ROAD_CODES
    sharp = found.from_markings or (found.fit.plane_known and found.sharp)
    return not sharp or found.rests_on_told_focal
