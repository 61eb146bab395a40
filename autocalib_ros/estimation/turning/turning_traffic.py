"""Vehicles that turn: a solution from nothing but them, and those that a solution can use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.model_selection import select_model
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.motion.planar_motion import (
    WindowRays,
    initial_motion,
    point_slip,
    turning_centres,
    without_side_slip,
)
from autocalib_ros.estimation.motion.rigid_bodies import TrackletBundle
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.observations.tracklets import find_tracklets, no_tracklets
from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks, TwoFrameWindows
from autocalib_ros.estimation.verification.consistency import compare_solutions
from autocalib_ros.results.refusals import Reason, reason

START_FOCAL_DIAGONALS = (0.35, 0.55, 0.85)
"""Focal lengths to start from, in image diagonals: lenses of about 100, 75 and 50 degrees across the diagonal."""
START_TILTS_DEG = (20.0, 45.0)
"""Tilts of the optical axis below the horizontal to start from, without roll."""
MAX_START_WINDOWS = 60
MAX_TURNING_WINDOWS, MAX_TRACKLETS = 300, 100
MAX_CENTRE_SPREAD = 0.5
"""Vehicles that all turn about one centre show it by half of them lying within this share of their radius of it."""
MAX_SIGMA_FOCAL_ONE_CENTRE = 0.02
"""Largest relative standard deviation of a focal length that rests on one centre. What noise biases grows as its
variance does, and faster than the deviation: on simulated rings they are alike at 2.5 %, a half of it at 1.5 %."""
MAX_TRACKLET_DIFFERENCE_SIGMAS = 3.0
"""Standard deviations of the less sure one by which solutions by windows and by lives may differ."""
MAX_RESTARTS = 4
"""Most times that lives are begun anew."""
MIN_RESTART_GAIN = 1.0
"""A life begun anew is another one when its cost is lower by this: twice the negative logarithm of a probability."""
POINT_SLIP_SIGMA_FOCAL = 0.4
"""Relative standard deviation of a focal length by turning traffic, for all of the turn that sliding points take away:
it was off by 0.2 and 0.7 of that on two rendered roundabouts."""
MIN_TURNING_VEHICLES = 8
"""So many vehicles that turn, distinct, make up evidence; fewer may be one driver's whim or a wrong group each."""


def fit_turning_traffic(tracks: TrackSet, windows: TwoFrameWindows, config: AdjustmentConfig) -> Adjustment | None:
    """Solve for lens and plane from the motion of vehicles alone, from several starts; None where too few turn."""
    nothing = tracks.subset(np.zeros(0, int))
    few = replace(config, windows=windows.balanced_subset(MAX_START_WINDOWS))
    if len(np.unique(few.windows.bodies)) < MIN_TURNING_VEHICLES:
        return None
    centre = config.prior.centre
    diagonal = np.hypot(centre.width, centre.height)
    lenses = [config.prior.start(diagonal * share) for share in START_FOCAL_DIAGONALS]
    starts = [
        AdjustmentState(lens, _level_plane(tilt), np.zeros(0))
        for lens in (lenses[:1] if config.prior.focal_known else lenses)
        for tilt in START_TILTS_DEG
    ]
    best = select_model([adjust(start, nothing, few) for start in starts], nothing)
    turning = refine_with_turning(best, nothing, windows)
    return refine_with_turning(turning, tracks, windows) if turning else None


def refine_with_turning(fit: Adjustment, tracks: TrackSet, windows: TwoFrameWindows) -> Adjustment | None:
    """Solve again with the vehicles that turn in the plane of a solution; None where they are too few."""
    chosen = _turning_windows(fit, windows)
    if chosen is None:
        return None
    return adjust(
        fit.state, tracks, replace(fit.problem.config, windows=chosen.balanced_subset(MAX_TURNING_WINDOWS)), refine=True
    )


def refine_with_tracklets(
    fit: Adjustment, tracks: TrackSet, windows: TwoFrameWindows, instants: ResampledTracks
) -> tuple[Adjustment, AdjustmentState | None]:
    """Solve a last time with those vehicles over their lives, where they are followed, and how they correlate.

    Windows and lives are cut from the same tracks: solutions by the one and by the other that differ by more than
    either knows mean that one of the two models is wrong. Then windows stand, which assume less, and the state that
    lives lead to comes with them.
    """
    config = replace(fit.problem.config, vehicle_correlation=fit.vehicle_correlation)
    chosen = _turning_windows(fit, windows) if config.turning else None
    lives = no_tracklets() if chosen is None else find_tracklets(chosen, instants, MAX_TRACKLETS)
    tracklet_state = (
        None
        if chosen is None or not len(lives)
        else _adjust_with_tracklets(
            fit,
            tracks,
            replace(
                config,
                windows=chosen.subset(chosen.from_segments).balanced_subset(MAX_TURNING_WINDOWS),
                bundle=TrackletBundle(lives, config.options.noise_px, config.options.drift_px),
            ),
        )
    )
    if tracklet_state is not None and not compare_solutions(fit, tracklet_state).exceeds(
        MAX_TRACKLET_DIFFERENCE_SIGMAS
    ):
        return tracklet_state, None
    window_fit = adjust(fit.state, tracks, config, refine=True, warm_start=fit.problem.warm_start)
    return window_fit, None if tracklet_state is None else tracklet_state.state


def _adjust_with_tracklets(fit: Adjustment, tracks: TrackSet, config: AdjustmentConfig) -> Adjustment:
    """Solve with a bundle, of points that drift or of such that do not: whichever makes them more probable."""
    solved = adjust(fit.state, tracks, config, refine=True)
    drifting, (_, _, shapes) = solved.problem.config.bundle, solved.problem.warm_start
    if drifting is None or shapes is None:
        return solved
    without_drift, camera, plane = drifting.without_drift(), solved.state.camera, solved.state.rotation
    if without_drift.noise_cost(camera, plane, shapes) < drifting.noise_cost(camera, plane, shapes):
        solved = adjust(
            solved.state,
            tracks,
            replace(config, bundle=without_drift),
            refine=True,
            warm_start=solved.problem.warm_start,
        )
    return restart_tracklets(solved, tracks)


def restart_tracklets(fit: Adjustment, tracks: TrackSet) -> Adjustment:
    """Solve again with lives begun anew at a solution, where that suits any better than how it was carried there.

    A life has more than one shape that no small change improves. Where lives are few, a single one that was begun far
    from the solution, and is stuck in such a shape, holds the solution back by degrees.
    """
    for _ in range(MAX_RESTARTS):
        bundle, (_, motion, shapes) = fit.problem.config.bundle, fit.problem.warm_start
        if bundle is None or shapes is None:
            return fit
        camera, plane = fit.state.camera, fit.state.rotation
        restarted = bundle.initialised(camera, plane)
        carried_cost, restarted_cost = (
            bundle.cost(bundle.residuals(camera, plane, each)) for each in (shapes, restarted)
        )
        better = restarted_cost < carried_cost - MIN_RESTART_GAIN
        if not better.any():
            return fit
        fit = adjust(
            fit.state,
            tracks,
            fit.problem.config,
            refine=True,
            warm_start=(None, motion, shapes.where(better, restarted)),
        )
    return fit


def widen_by_tracklet_difference(fit: Adjustment, tracklet_state: AdjustmentState | None) -> Adjustment:
    """Widen the deviations of a solution by how far the state is that lives led to, where that was not believed."""
    if tracklet_state is None:
        return fit
    step = fit.problem.parameters.step_to(tracklet_state)
    return replace(fit, covariance=fit.covariance + np.outer(step, step))


def check_turning_centres(fit: Adjustment, windows: TwoFrameWindows) -> Reason | None:
    """Say that all vehicles turn about one point and that this is not enough, if so.

    One axis for all motion tells lens and plane so weakly that noise biases them by more than the stated deviations,
    unless these are small.
    """
    sigma = fit.focal_sigma
    rests = fit.problem.config.turning and sigma >= MAX_SIGMA_FOCAL_ONE_CENTRE
    chosen = _turning_windows(fit, windows) if rests else None
    if chosen is None:
        return None
    centres, radii = turning_centres(chosen, fit.state.camera, fit.state.rotation)
    distances = np.hypot(*(centres - np.median(centres, axis=0)).T)
    if not len(radii) or np.median(distances) > MAX_CENTRE_SPREAD * np.median(radii):
        return None
    return reason(
        'one_centre',
        spread=np.median(distances) / np.median(radii),
        sigma=sigma,
        limit=MAX_SIGMA_FOCAL_ONE_CENTRE,
    )


def widen_by_point_slip(fit: Adjustment, windows: TwoFrameWindows) -> Adjustment:
    """Widen the deviation of a focal length that rests on turning traffic by what sliding points may do to it."""
    state, prior = fit.state, fit.problem.config.prior
    rests = len(state.angles_rad) < 2 and fit.problem.config.turning and 0 in prior.free
    chosen = _turning_windows(fit, windows) if rests else None
    if chosen is None:
        return fit
    view = WindowRays.of(chosen, state.camera, state.rotation, fit.problem.config.options)
    covariance = fit.covariance.copy()
    focal = int(np.flatnonzero(prior.free == 0)[0])
    covariance[focal, focal] += (
        POINT_SLIP_SIGMA_FOCAL * point_slip(chosen, initial_motion(view), state.camera, state.rotation)
    ) ** 2
    return replace(fit, covariance=covariance)


def _turning_windows(fit: Adjustment, windows: TwoFrameWindows) -> TwoFrameWindows | None:
    """Windows of vehicles that turn in the plane of a solution; None where they are too few.

    Of those that turn, what they show before and after counts too, unless two roads tell more of it: whoever never
    turns may be two, side by side.
    """
    state = fit.state
    view = WindowRays.of(windows, state.camera, state.rotation, fit.problem.config.options)
    height_m = fit.problem.config.height_m or DEFAULT_CAMERA_HEIGHT_M
    course, turning = without_side_slip(windows, view, initial_motion(view), state.camera, state.rotation, height_m)
    bodies = np.unique(windows.bodies[turning])
    if len(bodies) < MIN_TURNING_VEHICLES:
        return None
    chosen = turning if len(state.angles_rad) > 1 else course & np.isin(windows.bodies, bodies)
    return windows.subset(np.flatnonzero(chosen))


def _level_plane(tilt_deg: float) -> np.ndarray:
    """camera_from_plane, shape (3, 3), of a camera without roll: x to the right, z up."""
    tilt = np.radians(tilt_deg)
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    right = np.array([1.0, 0.0, 0.0])
    return np.column_stack([right, np.cross(up, right), up])
