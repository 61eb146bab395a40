"""Multi-start initialisation from straight tracks: road directions by consensus at trial focal lengths, lens family."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.model_selection import MODEL_SELECTION_MARGIN, select_model
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, RoadDirections, initial_state
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.straight.consensus import CONSENSUS_INLIER_PX, consensus_directions
from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.geometry.ground_plane import MIN_FRACTION_BELOW_HORIZON, orient_upward
from autocalib_ros.lens.camera import Camera

FOCAL_TRIALS = 14
"""Trial focal lengths: steps of about 17 %, within the basin of convergence of the bundle adjustment."""
MAX_STARTS = 3
"""Local maxima of the consensus score over focal length that are adjusted."""
MIN_INLIER_FRACTION, LOOSE_INLIER_FACTOR = 0.5, 3.0
"""Below this fraction of inlier tracks the consensus is repeated with an inlier limit wider by the factor."""
MATCHED_RADIUS_DIAGONALS = 0.3
"""Image radius, in diagonals, at which a start in another lens family gets the same angle: two lenses of one field of
view agree about best there."""
MAX_FOCAL_DIAGONALS = 1.5
"""Focal length, in image diagonals, above which lens curvature is invisible. Judgement."""
MIN_ROAD_SEPARATION_DEG = 15.0
"""Smallest angle between two roads: closer ones are one road with errors. Judgement."""


def solve_from_consensus(
    subsample: TrackSet, config: AdjustmentConfig, generator: np.random.Generator
) -> tuple[Adjustment, float] | None:
    """Adjust the consensus directions of the best trial focal lengths and return the most probable solution.

    Also returns the contrast: best over median consensus score of the trials, inf for a known focal length. None
    without consensus. With few inliers the consensus is repeated with a loose limit: a lens that is neither centred nor
    equidistant bends long tracks by many pixels at every trial.
    """
    fits, scores = _from_trials(subsample, config, generator, CONSENSUS_INLIER_PX)
    if not fits:
        return None
    best = select_model(fits, subsample)
    if best.inliers().mean() < MIN_INLIER_FRACTION:
        best = select_model(
            [best, *_from_trials(subsample, config, generator, LOOSE_INLIER_FACTOR * CONSENSUS_INLIER_PX)[0]], subsample
        )
    return best, np.inf if config.prior.focal_known else float(scores.max() / max(np.median(scores), 1e-9))


def _from_trials(
    subsample: TrackSet, config: AdjustmentConfig, generator: np.random.Generator, inlier_px: float
) -> tuple[list[Adjustment], np.ndarray]:
    """Return adjusted solutions of the best trials, and the consensus scores of all trials, shape (trials,)."""
    prior = config.prior
    trials = [prior.centre.focal_px] if prior.focal_known else focal_trials(subsample, prior.centre, FOCAL_TRIALS)
    fits: list[Adjustment] = []
    scores: list[np.ndarray] = []
    for lenses in zip(*(prior.starts(trial) for trial in trials), strict=True):
        found = [consensus_directions(lens, subsample, generator, inlier_px=inlier_px) for lens in lenses]
        starts = [initial_state(lenses[index], found[index]) for index in _peaks(found)[:MAX_STARTS]]
        fits += [adjust(start, subsample, config) for start in starts]
        scores.append(np.array([item.score for item in found]))
    # two coincident roads fit the errors of one road, and so look more probable than they are
    fits = [fit for fit in fits if roads_separated(fit)] or fits
    # traffic is below the horizon
    fits = [fit for fit in fits if below_horizon(fit, subsample)] or fits
    return fits, np.max(scores, axis=0)


def below_horizon(fit: Adjustment, tracks: TrackSet) -> bool:
    """Return whether the traffic lies below the horizon of the plane of a solution, if it has one.

    Without lens curvature the focal length is anything, and so is the plane.
    """
    camera = fit.state.camera
    if not fit.plane_known or camera.focal_px > MAX_FOCAL_DIAGONALS * camera.diagonal_px:
        return True
    bearings = unproject_rays(camera, tracks.pixels[tracks.weights > 0]).bearings
    return orient_upward(fit.state.rotation[:, 2], bearings)[1] >= MIN_FRACTION_BELOW_HORIZON


def roads_separated(fit: Adjustment) -> bool:
    """Return whether consecutive roads of a solution are at least `MIN_ROAD_SEPARATION_DEG` apart."""
    turns = np.abs(np.sin(np.diff(fit.state.angles_rad)))
    return bool(turns.min(initial=1.0) > np.sin(np.radians(MIN_ROAD_SEPARATION_DEG)))


def select_lens_family(fit: Adjustment, priors: list[LensPrior], subsample: TrackSet, tracks: TrackSet) -> Adjustment:
    """Adjust with another lens family of `priors` where it is more probable by `MODEL_SELECTION_MARGIN`.

    Models are compared on the subsample. One road without turning vehicles cannot identify the family.
    """
    if not fit.plane_known or not priors:
        return fit
    part = len(subsample) < len(tracks)
    default = adjust(fit.state, subsample, fit.problem.config, refine=True) if part else fit
    best = select_model(
        [default, *(_solve_in_family(default, prior, subsample) for prior in priors)], subsample, MODEL_SELECTION_MARGIN
    )
    if best is default:
        return fit
    return adjust(best.state, tracks, best.problem.config) if part else best


def _solve_in_family(fit: Adjustment, prior: LensPrior, subsample: TrackSet) -> Adjustment:
    """Adjust with the prior of another lens family, from the lens that agrees at `MATCHED_RADIUS_DIAGONALS`."""
    camera = fit.state.camera
    angle, _ = camera.angle(np.array(MATCHED_RADIUS_DIAGONALS * camera.diagonal_px))
    focal = camera.radius(angle) / replace(prior.centre, focal_px=1.0).radius(angle)
    start = replace(fit.state, camera=prior.start(float(focal)))
    return adjust(start, subsample, replace(fit.problem.config, prior=prior))


def _peaks(found: list[RoadDirections]) -> list[int]:
    """Return the indices of local maxima of the score, best first, without trials of score 0."""
    scores = np.array([item.score for item in found])
    padded = np.concatenate([[-np.inf], scores, [-np.inf]])
    peaks = np.flatnonzero((scores >= padded[:-2]) & (scores >= padded[2:]) & (scores > 0))
    return sorted((int(index) for index in peaks), key=lambda index: -scores[index])


def focal_trials(tracks: TrackSet, centre: Camera, count: int) -> np.ndarray:
    """Return `count` trial focal lengths in geometric progression, about the principal point of a lens.

    From all tracked points within 120 degrees of the axis to twice the image diagonal.
    """
    farthest = np.hypot(*centre.offsets(tracks.pixels.reshape(-1, 2)).T).max()
    return np.geomspace(farthest / np.radians(120.0), 2.0 * centre.diagonal_px, count)
