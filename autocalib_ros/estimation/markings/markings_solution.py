"""Lens and plane from road markings, and the checks on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, evaluate_at
from autocalib_ros.estimation.adjustment.combination import Mode, combine
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.parameters import (
    RIGHT_ANGLE_SIGMA_RAD,
    AdjustmentConfig,
    AdjustmentState,
)
from autocalib_ros.estimation.markings.grid_mixture import MarkingGrid, refine_grid
from autocalib_ros.estimation.markings.grid_search import (
    ANNEALING_WIDTHS_RAD,
    find_grids,
    find_grids_near,
    keep_segments_near_traffic,
)
from autocalib_ros.estimation.markings.road_segments import ProjectedSegments, RoadSegments, segments_on_road
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.verification.gates import check_markings_view
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import UNDETERMINED, Statement, assumption

MIN_ALIGNED_FRACTION = 0.1
"""Fraction of the segments along either direction, of those that are not upright: by chance it is a few per cent, and a
single road's own markings are along the other direction. Posts and walls say nothing about it. Judgement."""
MIN_PLACES, MIN_PLACES_CONFIRMED = 5, 3
"""Distinct groups along either direction, without and with confirmation by the traffic: a single stop line, or the
shadow of a lamp post, may be askew. Judgement."""
AMBIGUITY_NATS, MAX_AMBIGUITY_DEG = 5.0, 3.0
"""A second solution contradicts the best if its log-evidence is at most this much lower, and its plane differs by more
than this angle, or its focal length by more than the accepted uncertainty. Judgement."""
MODE_NATS = 8.0
"""Log-evidence below the best solution beyond which another one is left out: 1 in 3000."""
SAME_MODE_FOCAL, SAME_MODE_DEG = 0.005, 0.2
"""Solutions that differ by less, in log focal length and in the plane, are one."""
MIN_VARIANCE = 1e-12
"""Regularisation for segments without noise, as in tests."""
MAX_SKEW_SIGMAS = 2.5
"""Largest deviation from a right angle, in standard deviations of `RIGHT_ANGLE_SIGMA_RAD`. Judgement."""


@dataclass(frozen=True)
class MarkingsFit:
    """Lens and plane from lane markings alone."""

    fit: Adjustment
    with_free_aspect: Adjustment
    """The same with the pixel aspect free: lane markings at right angles measure it, too."""
    assumption: Statement


def fit_to_markings(
    evidence: Evidence, tracks: TrackSet, priors: list[LensPrior], config: AdjustmentConfig, gate: GateOptions
) -> MarkingsFit | Reason:
    """Estimate lens and plane from segments on the road; the reason why not if they do not determine them."""
    candidates = segments_on_road(evidence)
    grids = find_grids(candidates, priors)
    # a loose principal point turns planes and lenses that a usual one tells apart into one: no ambiguity of the best
    grids = [grid for grid in grids if grid.prior.sigma[1] == grids[0].prior.sigma[1]]
    accepted = _accepted_grid(candidates, grids, evidence, gate, MIN_PLACES)
    if isinstance(accepted, Reason):
        return accepted
    segments, best = accepted
    fit = _adjustment_of(_covering_others(segments, best, grids), tracks, config)
    if not fit.focal_sigma <= gate.max_sigma_focal_rel:
        return reason(
            'no_markings', 'focal_length', sigma=min(fit.focal_sigma, UNDETERMINED), limit=gate.max_sigma_focal_rel
        )
    against = check_markings_view(fit, tracks)
    if against:
        return against
    prior = best.prior.with_pixel_aspect(best.camera.pixel_aspect, np.inf)
    with_free_aspect = refine_grid(segments, prior, best.camera, best.rotation, ANNEALING_WIDTHS_RAD[-1:])
    return MarkingsFit(fit, _adjustment_of(with_free_aspect, tracks, config), _describe(segments, best))


def _adjustment_of(grid: MarkingGrid, tracks: TrackSet, config: AdjustmentConfig) -> Adjustment:
    """Return a grid as an adjustment, with the tracks evaluated at its lens and plane."""
    state = AdjustmentState(grid.camera, grid.rotation, np.array([0.0, np.pi / 2 + grid.skew_rad]))
    return evaluate_at(state, tracks, replace(config, prior=grid.prior, crossing_rad=None), grid.covariance)


@dataclass(frozen=True)
class MarkingsRefinement:
    """A solution of the traffic combined with lane markings."""

    fit: Adjustment
    """The combination."""
    markings: AdjustmentState
    """What the lane markings alone give, with the roads of the traffic."""
    both_right: float
    """Probability, 0 to 1, that traffic and lane markings are both right."""
    assumption: Statement


def refine_with_markings(
    fit: Adjustment, evidence: Evidence, tracks: TrackSet, prior: LensPrior, gate: GateOptions
) -> MarkingsRefinement | Reason:
    """Combine lens and plane of a solution with those of the segments on the road.

    Returns why not if the segments give none.
    """
    if not np.isfinite(fit.covariance).all():
        return reason('no_markings', 'traffic')
    parameters = fit.problem.parameters
    candidates = segments_on_road(evidence)
    grids = find_grids_near(candidates, prior, fit.state.camera, _upward_normal(fit))
    accepted = _accepted_modes(candidates, grids, evidence)
    if isinstance(accepted, Reason):
        return accepted
    shared = np.concatenate([np.arange(parameters.lens), parameters.tilts])
    modes = [_mode_of(grid, fit) for _, grid in accepted]
    combined = combine(fit, modes, shared)
    both = evaluate_at(parameters.state(combined.step), tracks, fit.problem.config, combined.covariance)
    described = accepted[modes.index(combined.likeliest)]
    return MarkingsRefinement(both, combined.likeliest.state, combined.both_right, _describe(*described))


def _mode_of(grid: MarkingGrid, fit: Adjustment) -> Mode:
    """Return a grid as a mode of the parameters of a fit: the lens, and the rotations that tilt the plane."""
    state, parameters = fit.state, fit.problem.parameters
    normal = grid.rotation[:, 2] * np.sign(state.rotation[:, 2] @ grid.rotation[:, 2])
    turn, _ = Rotation.align_vectors(normal[None], state.rotation[:, 2][None])
    seen = AdjustmentState(grid.camera, turn.as_matrix() @ state.rotation, state.angles_rad)
    # rotations about the axes of the grid become rotations about the axes of the roads, but for the heading
    tilting = parameters.axes[parameters.tilts - parameters.lens]
    to_roads = block_diag(np.eye(parameters.lens), tilting @ seen.rotation.T @ grid.rotation)
    return Mode(seen, to_roads @ grid.covariance[:-1, :-1] @ to_roads.T, -grid.negative_log_evidence)


def _accepted_modes(
    candidates: RoadSegments, grids: list[MarkingGrid], evidence: Evidence
) -> list[tuple[RoadSegments, MarkingGrid]] | Reason:
    """Return the grids that fit about as well as the best, with their segments near traffic; a reason if none does."""
    if not grids:
        return reason('no_markings', lines=len(candidates))
    found: list[tuple[RoadSegments, MarkingGrid]] = []
    against: Reason | None = None
    distinct: list[MarkingGrid] = []
    for grid in grids:
        if grid.negative_log_evidence > grids[0].negative_log_evidence + MODE_NATS or any(
            _same(grid, other) for other in distinct
        ):
            continue
        distinct.append(grid)
        accepted = keep_segments_near_traffic(candidates, grid, evidence)
        failed = reason('no_markings', 'off_road') if accepted is None else _check_axes(*accepted, MIN_PLACES_CONFIRMED)
        against = against or failed
        if accepted is not None and failed is None and not any(_same(accepted[1], other) for _, other in found):
            refined = replace(accepted[1], cost=grid.cost, laplace_term=grid.laplace_term)
            found.append((accepted[0], refined))
    return found or against or reason('no_markings', lines=len(candidates))


def _same(one: MarkingGrid, other: MarkingGrid) -> bool:
    """Whether two grids are one minimum."""
    return (
        abs(float(np.log(one.camera.focal_px / other.camera.focal_px))) < SAME_MODE_FOCAL
        and unsigned_angle_deg(one.rotation[:, 2], other.rotation[:, 2]) < SAME_MODE_DEG
    )


def _upward_normal(fit: Adjustment) -> np.ndarray:
    """Ground normal (3,) of a solution, towards the top of the image."""
    normal = fit.state.rotation[:, 2]
    return -normal if normal[1] > 0 else normal


def _describe(segments: RoadSegments, grid: MarkingGrid) -> Statement:
    """Return the assumption that lines along either axis of the grid are parallel or perpendicular."""
    aligned = grid.responsibilities[:2].max(axis=0) > 0.5
    return assumption(
        'lane_markings',
        lines=aligned.sum(),
        places=len(np.unique(segments.groups[aligned])),
        sigma_deg=np.degrees(RIGHT_ANGLE_SIGMA_RAD),
        angle_deg=90.0 + np.degrees(grid.skew_rad),
    )


def condition_on_lens(fit: Adjustment) -> Adjustment:
    """Return a fit with its covariance conditioned on the lens."""
    lens, covariance = fit.problem.parameters.lens, np.zeros(fit.covariance.shape)
    information = np.linalg.inv(fit.covariance + MIN_VARIANCE * np.eye(len(covariance)))
    covariance[lens:, lens:] = np.linalg.inv(information[lens:, lens:])
    return replace(fit, covariance=covariance)


def _accepted_grid(
    candidates: RoadSegments, grids: list[MarkingGrid], evidence: Evidence, gate: GateOptions, min_places: int
) -> tuple[RoadSegments, MarkingGrid] | Reason:
    """Return the segments near traffic and the best grid from them, or the reason against it."""
    if not grids:
        return reason('no_markings', lines=len(candidates))
    accepted = keep_segments_near_traffic(candidates, grids[0], evidence)
    if accepted is None:
        return reason('no_markings', 'off_road')
    return check_ambiguity(candidates, grids, gate) or _check_axes(*accepted, min_places) or accepted


def check_ambiguity(segments: RoadSegments, grids: list[MarkingGrid], gate: GateOptions) -> Reason | None:
    """Return a refusal if another plane or lens fits the segments as well."""
    best = grids[0]
    for other in grids[1:]:
        if other.negative_log_evidence > best.negative_log_evidence + AMBIGUITY_NATS:
            continue
        difference_deg = _normal_difference_deg(segments, best, other)
        if difference_deg > MAX_AMBIGUITY_DEG:
            return reason('no_markings', 'two_planes', difference_deg=difference_deg)
        focals = sorted(grid.camera.focal_px for grid in (best, other))
        if other.prior is best.prior and np.log(focals[1] / focals[0]) > gate.max_sigma_focal_rel:
            return reason('no_markings', 'two_lenses', focal_px=focals[0], other_focal_px=focals[1])
    return None


def _covering_others(segments: RoadSegments, best: MarkingGrid, grids: list[MarkingGrid]) -> MarkingGrid:
    """Return the best grid with a covariance that covers other lenses of its family, each by its probability.

    These are of nearly the same plane: another plane is an ambiguity, which is refused.
    """
    near = [
        other
        for other in grids
        if other.prior is best.prior
        and other.negative_log_evidence < best.negative_log_evidence + AMBIGUITY_NATS
        and _normal_difference_deg(segments, best, other) <= MAX_AMBIGUITY_DEG
    ]
    weights = np.exp([best.negative_log_evidence - other.negative_log_evidence for other in near])
    covariance = best.covariance.copy()
    for other, weight in zip(near, weights / max(float(weights.sum()), 1.0), strict=True):
        step = np.zeros(len(covariance))
        step[: len(best.prior.free)] = best.prior.step(best.camera, other.camera)
        up = other.rotation[:, 2] * np.sign(best.rotation[:, 2] @ other.rotation[:, 2])
        turn, _ = Rotation.align_vectors(up[None], best.rotation[:, 2][None])
        step[len(best.prior.free) : len(best.prior.free) + 3] = best.rotation.T @ turn.as_rotvec()
        covariance += weight * np.outer(step, step)
    return replace(best, covariance=covariance)


def _normal_difference_deg(segments: RoadSegments, one: MarkingGrid, other: MarkingGrid) -> float:
    """Angle between the normals of two grids in degrees, after aligning their rays of the segments.

    A lower principal point means an optical axis that looks farther down: that is not a different plane.
    """
    turn, _ = Rotation.align_vectors(
        *(ProjectedSegments.from_camera(grid.camera, segments.ends_px).bearings for grid in (one, other))
    )
    return unsigned_angle_deg(one.rotation[:, 2], turn.apply(other.rotation[:, 2]))


def _check_axes(segments: RoadSegments, grid: MarkingGrid, min_places: int) -> Reason | None:
    """Return a refusal if too few segments are along one of the directions, or if these are not perpendicular."""
    places = min(len(np.unique(segments.groups[mask])) for mask in grid.responsibilities[:2] > 0.5)
    fraction = grid.fractions[:2].min() / (1.0 - grid.fractions[2])
    if fraction < MIN_ALIGNED_FRACTION or places < min_places:
        return reason(
            'no_markings',
            'one_axis',
            fraction=fraction,
            places=places,
            limit=MIN_ALIGNED_FRACTION,
            limit_places=min_places,
        )
    if abs(grid.skew_rad) > MAX_SKEW_SIGMAS * RIGHT_ANGLE_SIGMA_RAD:
        return reason('no_markings', 'not_square', angle_deg=90 + np.degrees(grid.skew_rad))
    return None
