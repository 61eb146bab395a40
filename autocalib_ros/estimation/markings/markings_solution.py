"""Lens and plane by the markings of the road, and what speaks against them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, evaluate_at
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.markings.grid_mixture import RIGHT_ANGLE_SIGMA_RAD, MarkingGrid
from autocalib_ros.estimation.markings.grid_search import find_grids, find_grids_near, keep_lines_near_traffic
from autocalib_ros.estimation.markings.road_segments import ProjectedSegments, RoadSegments, segments_on_road
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.observations.two_frame_windows import no_windows
from autocalib_ros.estimation.verification.gates import check_markings_view
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, assumption

MIN_ALIGNED_FRACTION = 0.1
"""Of the lines along either direction: by chance a few in a hundred are, and one road's own are along the other."""
MIN_PLACES, MIN_PLACES_CONFIRMED = 5, 3
"""Places along either direction, and where the traffic tells lens and plane as well: a single stop line, or the shadow
of a lamp post, may be askew."""
AMBIGUITY_NATS, MAX_AMBIGUITY_DEG = 5.0, 3.0
"""Another plane, so far from the best, speaks against it when its probability is no less than e to the minus this of
the best one's; and so does another focal length that is farther away than its deviation may be."""
MIN_VARIANCE = 1e-12
"""Lines without noise, as tests make them, leave parameters without any spread."""
MAX_SKEW_SIGMAS = 2.5
"""Markings are square when the angle between them differs by no more from a right one."""


def fit_to_markings(
    evidence: Evidence, tracks: TrackSet, priors: list[LensPrior], config: AdjustmentConfig, gate: GateOptions
) -> tuple[Adjustment, Statement] | Reason:
    """Estimate lens and plane from the lines on the road; with what was assumed in words, or a reason why not."""
    every = segments_on_road(evidence)
    grids = find_grids(every, priors)
    nearer = _accepted_grid(every, grids, evidence, gate, MIN_PLACES)
    if isinstance(nearer, Reason):
        return nearer
    lines, best = nearer
    state = AdjustmentState(best.camera, best.rotation, np.array([0.0, np.pi / 2 + best.skew_rad]))
    fit = evaluate_at(state, tracks, replace(config, prior=best.prior, crossing_rad=None), best.covariance)
    if not fit.focal_sigma <= gate.max_sigma_focal_rel:
        return reason('no_markings', 'focal_length', sigma=min(fit.focal_sigma, 9.99), limit=gate.max_sigma_focal_rel)
    return check_markings_view(fit, tracks) or (fit, _describe(lines, best))


def refine_with_markings(
    fit: Adjustment, evidence: Evidence, tracks: TrackSet, prior: LensPrior, gate: GateOptions
) -> tuple[Adjustment, Statement] | Reason:
    """Return the lens and plane near those of a solution to which the lines on the road lead, with its roads.

    With what was assumed in words, or a reason why not.
    """
    up, state = _upward_normal(fit), fit.state
    every = segments_on_road(evidence)
    grids = find_grids_near(every, prior, state.camera, up)
    nearer = _accepted_grid(every, grids, evidence, gate, MIN_PLACES_CONFIRMED)
    if isinstance(nearer, Reason):
        return nearer
    lines, grid = nearer
    config = replace(fit.problem.config, prior=prior, windows=no_windows(), bundle=None)
    road, normal = state.rotation[:, 0], grid.rotation[:, 2] * np.sign(state.rotation[:, 2] @ grid.rotation[:, 2])
    along = road - (road @ normal) * normal
    along /= np.linalg.norm(along)
    rotation = np.column_stack([along, np.cross(normal, along), normal])
    there = AdjustmentState(grid.camera, rotation, state.angles_rad)
    parameters, lens = Parameterisation(there, config), len(prior.free)
    covariance, angles = np.zeros((parameters.size, parameters.size)), len(parameters.free_angles)
    # turns about the axes of the grid, as turns about those of the roads
    turned = block_diag(np.eye(lens), parameters.axes @ rotation.T @ grid.rotation)
    told = parameters.size - angles
    covariance[:told, :told] = turned @ grid.covariance[:-1, :-1] @ turned.T
    if angles:
        covariance[-angles:, -angles:] = fit.covariance[-angles:, -angles:]
    return evaluate_at(there, tracks, config, covariance), _describe(lines, grid)


def _upward_normal(fit: Adjustment) -> np.ndarray:
    """The normal (3,) of a solution, to the side where the image's top is."""
    normal = fit.state.rotation[:, 2]
    return -normal if normal[1] > 0 else normal


def _describe(lines: RoadSegments, grid: MarkingGrid) -> Statement:
    """Return the assumption that lines along either axis of the grid are parallel or perpendicular."""
    aligned = grid.responsibilities[:2].max(axis=0) > 0.5
    return assumption(
        'lane_markings',
        lines=aligned.sum(),
        places=len(np.unique(lines.groups[aligned])),
        sigma_deg=np.degrees(RIGHT_ANGLE_SIGMA_RAD),
        angle_deg=90.0 + np.degrees(grid.skew_rad),
    )


def condition_on_lens(fit: Adjustment) -> Adjustment:
    """Return a fit with the deviations that it has for somebody who knows its lens."""
    lens, covariance = fit.problem.parameters.lens, np.zeros(fit.covariance.shape)
    information = np.linalg.inv(fit.covariance + MIN_VARIANCE * np.eye(len(covariance)))
    covariance[lens:, lens:] = np.linalg.inv(information[lens:, lens:])
    return replace(fit, covariance=covariance)


def _accepted_grid(
    every: RoadSegments, grids: list[MarkingGrid], evidence: Evidence, gate: GateOptions, min_places: int
) -> tuple[RoadSegments, MarkingGrid] | Reason:
    """Return the lines beside traffic and the best grid by them, or what speaks against it."""
    if not grids:
        return reason('no_markings', lines=len(every))
    nearer = keep_lines_near_traffic(every, grids[0], evidence)
    if nearer is None:
        return reason('no_markings', 'off_road')
    return _check_ambiguity(every, grids, gate) or _check_axes(*nearer, min_places) or nearer


def _check_ambiguity(lines: RoadSegments, grids: list[MarkingGrid], gate: GateOptions) -> Reason | None:
    """Say that another plane or lens suits the lines as well, if so."""
    best = grids[0]
    for other in grids[1:]:
        if other.negative_log_evidence > best.negative_log_evidence + AMBIGUITY_NATS:
            continue
        difference_deg = _normal_difference_deg(lines, best, other)
        if difference_deg > MAX_AMBIGUITY_DEG:
            return reason('no_markings', 'two_planes', difference_deg=difference_deg)
        focals = sorted(grid.camera.focal_px for grid in (best, other))
        if other.prior is best.prior and np.log(focals[1] / focals[0]) > gate.max_sigma_focal_rel:
            return reason('no_markings', 'two_lenses', focal_px=focals[0], other_focal_px=focals[1])
    return None


def _normal_difference_deg(lines: RoadSegments, one: MarkingGrid, other: MarkingGrid) -> float:
    """Angle between the normals of two grids, degrees, once their rays of the lines are turned onto each other.

    A principal point farther down is an axis that looks farther down: that is no other plane.
    """
    turn, _ = Rotation.align_vectors(
        *(ProjectedSegments.from_camera(grid.camera, lines.ends_px).bearings for grid in (one, other))
    )
    return unsigned_angle_deg(one.rotation[:, 2], turn.apply(other.rotation[:, 2]))


def _check_axes(lines: RoadSegments, grid: MarkingGrid, min_places: int) -> Reason | None:
    """Say that too little is along either of the two directions, or that these are not square, if so."""
    places = min(len(np.unique(lines.groups[mask])) for mask in grid.responsibilities[:2] > 0.5)
    share = grid.fractions[:2].min()
    if share < MIN_ALIGNED_FRACTION or places < min_places:
        return reason(
            'no_markings',
            'one_axis',
            fraction=share,
            places=places,
            limit=MIN_ALIGNED_FRACTION,
            limit_places=min_places,
        )
    if abs(grid.skew_rad) > MAX_SKEW_SIGMAS * RIGHT_ANGLE_SIGMA_RAD:
        return reason('no_markings', 'not_square', angle_deg=90 + np.degrees(grid.skew_rad))
    return None
