"""Solutions to start from: directions on which straight traffic agrees at trial focal lengths, and lens families."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.model_selection import MODEL_SELECTION_MARGIN, select_model
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, RoadDirections, initial_state
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.straight.consensus import CONSENSUS_INLIER_PX, consensus_directions
from autocalib_ros.lens.camera import Camera

FOCAL_TRIALS = 14
"""Focal lengths tried as starts: steps of about 17 %, within which the joint problem converges."""
MAX_STARTS = 3
MIN_INLIER_FRACTION, LOOSE_INLIER_FACTOR = 0.5, 3.0
"""Below this share of explained tracks, agreement is looked for again with so many times wider limits."""
MATCHED_RADIUS_DIAGONALS = 0.3
"""A radius in image diagonals at which two lenses of one field of view agree about best."""
MIN_ROAD_SEPARATION_DEG = 15.0
"""Roads that differ by less are one road seen with errors."""


def solve_from_consensus(
    subsample: TrackSet, config: AdjustmentConfig, generator: np.random.Generator
) -> tuple[Adjustment, float] | None:
    """Solve from the directions on which the tracks agree at trial focal lengths; the most probable solution.

    And the contrast: how much better the best trial agreed than the middling one. None without any agreement.
    Where little is explained the agreement is looked for again less strictly: a lens that is neither centred nor
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
    """Solutions from the trial focal lengths of best agreement, and the scores of all trials, shape (trials,)."""
    prior = config.prior
    size = (prior.centre.width, prior.centre.height)
    trials = [prior.centre.focal_px] if prior.focal_known else focal_trials(subsample, size, FOCAL_TRIALS)
    solve_from_consensus = [
        consensus_directions(prior.start(trial), subsample, generator, inlier_px=inlier_px) for trial in trials
    ]
    starts = [
        initial_state(prior.start(trials[index]), solve_from_consensus[index])
        for index in _peaks(solve_from_consensus)[:MAX_STARTS]
    ]
    fits = [adjust(start, subsample, config) for start in starts]
    # two roads that fell together describe one road twice, and its errors the better for it
    return [fit for fit in fits if roads_separated(fit)] or fits, np.array(
        [item.score for item in solve_from_consensus]
    )


def roads_separated(fit: Adjustment) -> bool:
    """Tell whether the roads of a solution that are next to each other in it differ."""
    turns = np.abs(np.sin(np.diff(fit.state.angles_rad)))
    return bool(turns.min(initial=1.0) > np.sin(np.radians(MIN_ROAD_SEPARATION_DEG)))


def select_lens_family(fit: Adjustment, priors: list[LensPrior], subsample: TrackSet, tracks: TrackSet) -> Adjustment:
    """Solve for another family of lenses where that makes the traffic clearly more probable; one road cannot tell."""
    if not fit.plane_known or not priors:
        return fit
    usual = adjust(fit.state, subsample, fit.problem.config, refine=True)
    best = select_model(
        [usual, *(_solve_in_family(usual, prior, subsample) for prior in priors)], subsample, MODEL_SELECTION_MARGIN
    )
    return fit if best is usual else adjust(best.state, tracks, best.problem.config)


def _solve_in_family(fit: Adjustment, prior: LensPrior, subsample: TrackSet) -> Adjustment:
    """Solve for a lens of another family, from the one that images the middle of the field at the same place."""
    camera = fit.state.camera
    angle, _ = camera.angle(np.array(MATCHED_RADIUS_DIAGONALS * np.hypot(camera.width, camera.height)))
    focal = camera.radius(angle) / replace(prior.centre, focal_px=1.0).radius(angle)
    start = replace(fit.state, camera=prior.start(float(focal)))
    return adjust(start, subsample, replace(fit.problem.config, prior=prior))


def _peaks(found: list[RoadDirections]) -> list[int]:
    """Indices of trials whose score no neighbour beats, best first; trials without a direction never."""
    scores = np.array([item.score for item in found])
    padded = np.concatenate([[-np.inf], scores, [-np.inf]])
    peaks = np.flatnonzero((scores >= padded[:-2]) & (scores >= padded[2:]) & (scores > 0))
    return sorted((int(index) for index in peaks), key=lambda index: -scores[index])


def focal_trials(tracks: TrackSet, image_size: tuple[int, int], count: int) -> np.ndarray:
    """Focal lengths to try, evenly by ratio: from all points within 120 degrees to twice the diagonal."""
    centre = Camera.equidistant(*image_size, 1.0).principal_point_px
    farthest = np.hypot(*(tracks.pixels.reshape(-1, 2) - centre).T).max()
    return np.geomspace(farthest / np.radians(120.0), 2.0 * np.hypot(*image_size), count)
