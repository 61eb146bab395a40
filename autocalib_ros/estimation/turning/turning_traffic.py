"""Vehicles that turn: a solution from nothing but them, and those that a solution can use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.model_selection import select_model
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.motion.planar_motion import View, first_motion, on_course, sliding, turning_centres
from autocalib_ros.estimation.motion.rigid_bodies import Bundle
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.observations.tracklets import find_lives, no_lives
from autocalib_ros.estimation.observations.two_frame_windows import Instants, Windows
from autocalib_ros.estimation.verification.consistency import compare_solutions
from autocalib_ros.results.calibration import Reason

START_DIAGONALS = (0.35, 0.55, 0.85)
"""Focal lengths to start from, in image diagonals: lenses of about 100, 75 and 50 degrees across the diagonal."""
START_TILTS_DEG = (20.0, 45.0)
"""Tilts of the optical axis below the horizontal to start from, without roll."""
START_WINDOWS = 60
MOST_WINDOWS, MOST_LIVES = 300, 100
ONE_CENTRE = 0.5
"""Vehicles that all turn about one centre show it by half of them lying within this share of their radius of it."""
ONE_CENTRE_SIGMA = 0.02
"""Largest relative standard deviation of a focal length that rests on one centre. What noise biases grows as its
variance does, and faster than the deviation: on simulated rings they are alike at 2.5 %, a half of it at 1.5 %."""
APART = 3.0
"""Standard deviations of the less sure one by which solutions by windows and by lives may differ."""
BEGINNINGS = 4
"""Most times that lives are begun anew."""
BETTER = 1.0
"""A life begun anew is another one when its cost is lower by this: twice the negative logarithm of a probability."""
SLIDING_FOCAL = 0.4
"""Relative standard deviation of a focal length by turning traffic, for all of the turn that sliding points take away:
it was off by 0.2 and 0.7 of that on two rendered roundabouts."""
MIN_BODIES = 8
"""So many vehicles that turn, distinct, make up evidence; fewer may be one driver's whim or a wrong group each."""


def from_turning(tracks: TrackSet, windows: Windows, config: AdjustmentConfig) -> Adjustment | None:
    """Solve for lens and plane from the motion of vehicles alone, from several starts; None where too few turn."""
    nothing = tracks.subset(np.zeros(0, int))
    few = replace(config, windows=windows.spread(START_WINDOWS))
    if len(np.unique(few.windows.bodies)) < MIN_BODIES:
        return None
    centre = config.prior.centre
    diagonal = np.hypot(centre.width, centre.height)
    lenses = [config.prior.start(diagonal * share) for share in START_DIAGONALS]
    starts = [AdjustmentState(lens, _level_plane(tilt), np.zeros(0))
              for lens in (lenses[:1] if config.prior.focal_known else lenses) for tilt in START_TILTS_DEG]
    best = select_model([adjust(start, nothing, few) for start in starts], nothing)
    turning = with_turning(best, nothing, windows)
    return with_turning(turning, tracks, windows) if turning else None


def with_turning(fit: Adjustment, tracks: TrackSet, windows: Windows) -> Adjustment | None:
    """Solve again with the vehicles that turn in the plane of a solution; None where they are too few."""
    chosen = _turning(fit, windows)
    if chosen is None:
        return None
    return adjust(fit.state, tracks, replace(fit.problem.config, windows=chosen.spread(MOST_WINDOWS)),
                       refine=True)


def over_lives(fit: Adjustment, tracks: TrackSet, windows: Windows,
               instants: Instants) -> tuple[Adjustment, AdjustmentState | None]:
    """Solve a last time with those vehicles over their lives, where they are followed, and how they correlate.

    Windows and lives are cut from the same tracks: solutions by the one and by the other that differ by more than
    either knows mean that one of the two models is wrong. Then windows stand, which assume less, and the state that
    lives lead to comes with them.
    """
    config = replace(fit.problem.config, vehicle_correlation=fit.vehicle_correlation)
    chosen = _turning(fit, windows) if config.turning else None
    lives = no_lives() if chosen is None else find_lives(chosen, instants, MOST_LIVES)
    by_lives = None if chosen is None or not len(lives) else _by_lives(fit, tracks, replace(
        config, windows=chosen.subset(chosen.of_segments).spread(MOST_WINDOWS),
        bundle=Bundle(lives, config.options.noise_px, config.options.drift_px)))
    if by_lives is not None and not compare_solutions(fit, by_lives).exceeds(APART):
        return by_lives, None
    by_windows = adjust(fit.state, tracks, config, refine=True, warm_start=fit.problem.warm_start)
    return by_windows, None if by_lives is None else by_lives.state


def _by_lives(fit: Adjustment, tracks: TrackSet, config: AdjustmentConfig) -> Adjustment:
    """Solve with a bundle, of points that drift or of such that do not: whichever makes them more probable."""
    solved = adjust(fit.state, tracks, config, refine=True)
    drifting, (_, _, shapes) = solved.problem.config.bundle, solved.problem.warm_start
    if drifting is None or shapes is None:
        return solved
    steady, camera, plane = drifting.steady(), solved.state.camera, solved.state.rotation
    if steady.noise_cost(camera, plane, shapes) < drifting.noise_cost(camera, plane, shapes):
        solved = adjust(solved.state, tracks, replace(config, bundle=steady), refine=True,
                             warm_start=solved.problem.warm_start)
    return begun_anew(solved, tracks)


def begun_anew(fit: Adjustment, tracks: TrackSet) -> Adjustment:
    """Solve again with lives begun anew at a solution, where that suits any better than how it was carried there.

    A life has more than one shape that no small change improves. Where lives are few, a single one that was begun far
    from the solution, and is stuck in such a shape, holds the solution back by degrees.
    """
    for _ in range(BEGINNINGS):
        bundle, (_, motion, shapes) = fit.problem.config.bundle, fit.problem.warm_start
        if bundle is None or shapes is None:
            return fit
        camera, plane = fit.state.camera, fit.state.rotation
        anew = bundle.begun(camera, plane)
        carried_cost, anew_cost = (bundle.cost(bundle.residuals(camera, plane, each)) for each in (shapes, anew))
        better = anew_cost < carried_cost - BETTER
        if not better.any():
            return fit
        fit = adjust(fit.state, tracks, fit.problem.config, refine=True,
                          warm_start=(None, motion, shapes.where(better, anew)))
    return fit


def with_lives_apart(fit: Adjustment, by_lives: AdjustmentState | None) -> Adjustment:
    """Widen the deviations of a solution by how far the state is that lives led to, where that was not believed."""
    if by_lives is None:
        return fit
    step = fit.problem.parameters.step_to(by_lives)
    return replace(fit, covariance=fit.covariance + np.outer(step, step))


def one_centre_doubt(fit: Adjustment, windows: Windows) -> Reason | None:
    """Say that all vehicles turn about one point and that this is not enough, if so.

    One axis for all motion tells lens and plane so weakly that noise biases them by more than the stated deviations,
    unless these are small.
    """
    sigma = fit.focal_sigma
    rests = fit.problem.config.turning and sigma >= ONE_CENTRE_SIGMA
    chosen = _turning(fit, windows) if rests else None
    if chosen is None:
        return None
    centres, radii = turning_centres(chosen, fit.state.camera, fit.state.rotation)
    apart = np.hypot(*(centres - np.median(centres, axis=0)).T)
    if not len(radii) or np.median(apart) > ONE_CENTRE * np.median(radii):
        return None
    return Reason(
        'one_centre', f'all vehicles turn about one point, as on one ring or bend (half of their centres lie within '
        f'{np.median(apart) / np.median(radii):.0%} of the radius), and tell the focal length to {sigma:.1%}; '
        f'{ONE_CENTRE_SIGMA:.0%} is needed there',
        'wait for more traffic, above all such that turns elsewhere, enters or leaves, or drives straight')


def with_sliding(fit: Adjustment, windows: Windows) -> Adjustment:
    """Widen the deviation of a focal length that rests on turning traffic by what sliding points may do to it."""
    state, prior = fit.state, fit.problem.config.prior
    rests = len(state.angles_rad) < 2 and fit.problem.config.turning and 0 in prior.free
    chosen = _turning(fit, windows) if rests else None
    if chosen is None:
        return fit
    view = View.of(chosen, state.camera, state.rotation, fit.problem.config.options)
    covariance = fit.covariance.copy()
    focal = int(np.flatnonzero(prior.free == 0)[0])
    covariance[focal, focal] += (SLIDING_FOCAL * sliding(chosen, first_motion(view), state.camera, state.rotation)) ** 2
    return replace(fit, covariance=covariance)


def _turning(fit: Adjustment, windows: Windows) -> Windows | None:
    """Windows of vehicles that turn in the plane of a solution; None where they are too few.

    Of those that turn, what they show before and after counts too, unless two roads tell more of it: whoever never
    turns may be two, side by side.
    """
    state = fit.state
    view = View.of(windows, state.camera, state.rotation, fit.problem.config.options)
    height_m = fit.problem.config.height_m or DEFAULT_CAMERA_HEIGHT_M
    course, turning = on_course(windows, view, first_motion(view), state.camera, state.rotation, height_m)
    bodies = np.unique(windows.bodies[turning])
    if len(bodies) < MIN_BODIES:
        return None
    chosen = turning if len(state.angles_rad) > 1 else course & np.isin(windows.bodies, bodies)
    return windows.subset(np.flatnonzero(chosen))


def _level_plane(tilt_deg: float) -> np.ndarray:
    """camera_from_plane, shape (3, 3), of a camera without roll: x to the right, z up."""
    tilt = np.radians(tilt_deg)
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    right = np.array([1.0, 0.0, 0.0])
    return np.column_stack([right, np.cross(up, right), up])
