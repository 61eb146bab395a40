"""Solutions to start from: directions on which straight traffic agrees at trial focal lengths, and lens families."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import JointFit, solve_joint
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.model_selection import ASKED_FOR, most_probable
from autocalib_ros.estimation.adjustment.parameters import Directions, Setting, initial_state
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.straight.consensus import INLIER_PX, consensus_directions
from autocalib_ros.lens.camera import Camera

TRIALS = 14
"""Focal lengths tried as starts: steps of about 17 %, within which the joint problem converges."""
STARTS = 3
WELL_EXPLAINED, LOOSE = 0.5, 3.0
"""Below this share of explained tracks, agreement is looked for again with so many times wider limits."""
MIDDLE = 0.3
"""A radius in image diagonals at which two lenses of one field of view agree about best."""
APART_DEG = 15.0
"""Roads that differ by less are one road seen with errors."""


def agreed(voters: TrackSet, setting: Setting, generator: np.random.Generator) -> tuple[JointFit, float] | None:
    """Solve from the directions on which the tracks agree at trial focal lengths; the most probable solution.

    And the contrast: how much better the best trial agreed than the middling one. None without any agreement.
    Where little is explained the agreement is looked for again less strictly: a lens that is neither centred nor
    equidistant bends long tracks by many pixels at every trial.
    """
    fits, scores = _from_trials(voters, setting, generator, INLIER_PX)
    if not fits:
        return None
    best = most_probable(fits, voters)
    if best.explained().mean() < WELL_EXPLAINED:
        best = most_probable([best, *_from_trials(voters, setting, generator, LOOSE * INLIER_PX)[0]], voters)
    return best, np.inf if setting.prior.focal_known else float(scores.max() / max(np.median(scores), 1e-9))


def _from_trials(voters: TrackSet, setting: Setting, generator: np.random.Generator,
                 inlier_px: float) -> tuple[list[JointFit], np.ndarray]:
    """Solutions from the trial focal lengths of best agreement, and the scores of all trials, shape (trials,)."""
    prior = setting.prior
    size = (prior.centre.width, prior.centre.height)
    trials = [prior.centre.focal_px] if prior.focal_known else focal_trials(voters, size, TRIALS)
    agreed = [consensus_directions(prior.start(trial), voters, generator, inlier_px=inlier_px) for trial in trials]
    starts = [initial_state(prior.start(trials[index]), agreed[index]) for index in _peaks(agreed)[:STARTS]]
    fits = [solve_joint(start, voters, setting) for start in starts]
    # two roads that fell together describe one road twice, and its errors the better for it
    return [fit for fit in fits if apart(fit)] or fits, np.array([item.score for item in agreed])


def apart(fit: JointFit) -> bool:
    """Tell whether the roads of a solution that are next to each other in it differ."""
    turns = np.abs(np.sin(np.diff(fit.state.angles_rad)))
    return bool(turns.min(initial=1.0) > np.sin(np.radians(APART_DEG)))


def in_likeliest_family(fit: JointFit, priors: list[LensPrior], voters: TrackSet, tracks: TrackSet) -> JointFit:
    """Solve for another family of lenses where that makes the traffic clearly more probable; one road cannot tell."""
    if not fit.plane_known or not priors:
        return fit
    usual = solve_joint(fit.state, voters, fit.problem.setting, refine=True)
    best = most_probable([usual, *(_in_family(usual, prior, voters) for prior in priors)], voters, ASKED_FOR)
    return fit if best is usual else solve_joint(best.state, tracks, best.problem.setting)


def _in_family(fit: JointFit, prior: LensPrior, voters: TrackSet) -> JointFit:
    """Solve for a lens of another family, from the one that images the middle of the field at the same place."""
    camera = fit.state.camera
    angle, _ = camera.angle(np.array(MIDDLE * np.hypot(camera.width, camera.height)))
    focal = camera.radius(angle) / replace(prior.centre, focal_px=1.0).radius(angle)
    start = replace(fit.state, camera=prior.start(float(focal)))
    return solve_joint(start, voters, replace(fit.problem.setting, prior=prior))


def _peaks(found: list[Directions]) -> list[int]:
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
