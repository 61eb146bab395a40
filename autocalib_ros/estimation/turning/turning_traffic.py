"""Lens and ground plane from turning vehicles, on their own or to refine another solution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.model_selection import select_model
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState
from autocalib_ros.estimation.motion.planar_motion import (
    WindowRays,
    initial_motion,
    point_slip,
    without_side_slip,
)
from autocalib_ros.estimation.motion.rigid_bodies import TrackletBundle
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.observations.tracklets import find_tracklets, no_tracklets
from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks, TwoFrameWindows
from autocalib_ros.estimation.verification.consistency import compare_solutions
from autocalib_ros.results.verification_table import VerificationRow, verified

START_FOCAL_DIAGONALS = (0.35, 0.55, 0.85)
"""Initial focal lengths in image diagonals: lenses of about 100, 75 and 50 degrees across the diagonal."""
START_TILTS_DEG = (20.0, 45.0)
"""Initial tilts of the optical axis below the horizontal, without roll."""
MAX_START_WINDOWS = 60
"""Windows used in the multi-start."""
MAX_TURNING_WINDOWS, MAX_TRACKLETS = 300, 100
"""Windows and tracklets in one adjustment."""
MAX_TRACKLET_DIFFERENCE_SIGMAS = 3.0
"""Largest difference between the solutions from windows and from tracklets, in standard deviations of the less certain.
Judgement."""
MAX_RESTARTS = 4
"""Most rounds of re-initialising tracklets."""
MIN_RESTART_GAIN = 1.0
"""Cost decrease for which a re-initialised tracklet replaces the old one. Cost is twice the negative log-likelihood.
Judgement."""
POINT_SLIP_SIGMA_FOCAL = 0.4
"""Relative standard deviation of the focal length for a point slip of 1, that is all of the turn lost. On two rendered
roundabouts the focal length was wrong by 0.2 and 0.7 of the slip."""
MIN_TURNING_VEHICLES = 8
"""Fewest distinct vehicles that turn; fewer may be one unusual manoeuvre, or groups of points from several vehicles.
Judgement."""


def fit_turning_traffic(tracks: TrackSet, windows: TwoFrameWindows, config: AdjustmentConfig) -> Adjustment | None:
    """Estimate lens and plane from turning vehicles alone, by multi-start; None if too few vehicles turn."""
    no_tracks = tracks.subset(np.zeros(0, int))
    few = replace(config, windows=windows.balanced_subset(MAX_START_WINDOWS))
    if len(np.unique(few.windows.bodies)) < MIN_TURNING_VEHICLES:
        return None
    diagonal = config.prior.centre.diagonal_px
    lenses = [config.prior.start(diagonal * ratio) for ratio in START_FOCAL_DIAGONALS]
    starts = [
        AdjustmentState(lens, _level_plane(tilt), np.zeros(0))
        for lens in (lenses[:1] if config.prior.focal_known else lenses)
        for tilt in START_TILTS_DEG
    ]
    best = select_model([adjust(start, no_tracks, few) for start in starts], no_tracks)
    turning = refine_with_turning(best, no_tracks, windows)
    return refine_with_turning(turning, tracks, windows) if turning else None


def refine_with_turning(fit: Adjustment, tracks: TrackSet, windows: TwoFrameWindows) -> Adjustment | None:
    """Adjust again with the vehicles that turn in the plane of a solution; None if there are too few."""
    chosen = _turning_windows(fit, windows)
    if chosen is None:
        return None
    return adjust(
        fit.state, tracks, replace(fit.problem.config, windows=chosen.balanced_subset(MAX_TURNING_WINDOWS)), refine=True
    )


@dataclass(frozen=True)
class TrackletComparison:
    """A solution from tracklets against that from windows."""

    state: AdjustmentState
    """From the tracklets."""
    sigmas: float
    """Larger difference in focal length or normal, in standard deviations of the less certain solution."""

    @property
    def row(self) -> VerificationRow:
        """The comparison as a row of the verification table."""
        return verified('tracklets', self.sigmas, MAX_TRACKLET_DIFFERENCE_SIGMAS)

    @property
    def rejected(self) -> bool:
        """Whether the two contradict each other."""
        return not self.row.passed


def refine_with_tracklets(
    fit: Adjustment, tracks: TrackSet, windows: TwoFrameWindows, instants: ResampledTracks
) -> tuple[Adjustment, TrackletComparison | None]:
    """Run the final adjustment with tracklets where there are any, and with correlated errors within each vehicle.

    Windows and tracklets come from the same tracks. If their solutions differ by more than their uncertainty, one of
    the two models is wrong: then the window solution is returned, which assumes less. The comparison is None without
    tracklets.
    """
    config = replace(fit.problem.config, vehicle_correlation=fit.vehicle_correlation)
    turning = _turning_windows(fit, windows) if config.turning else None
    tracklets = no_tracklets() if turning is None else find_tracklets(turning, instants, MAX_TRACKLETS)
    compared = None
    if turning is not None and len(tracklets):
        segments_only = turning.subset(turning.from_segments).balanced_subset(MAX_TURNING_WINDOWS)
        bundle = TrackletBundle(tracklets, config.options.noise_px, config.options.drift_px)
        with_tracklets = _adjust_with_tracklets(fit, tracks, replace(config, windows=segments_only, bundle=bundle))
        compared = TrackletComparison(with_tracklets.state, compare_solutions(fit, with_tracklets).in_sigmas)
        if not compared.rejected:
            return with_tracklets, compared
    with_windows = adjust(fit.state, tracks, config, refine=True, warm_start=fit.problem.warm_start)
    return with_windows, compared


def _adjust_with_tracklets(fit: Adjustment, tracks: TrackSet, config: AdjustmentConfig) -> Adjustment:
    """Adjust with tracklets, with or without point drift, whichever has the higher likelihood."""
    solved = adjust(fit.state, tracks, config, refine=True)
    drifting, (_, _, unknowns) = solved.problem.config.bundle, solved.problem.warm_start
    if drifting is None or unknowns is None:
        return solved
    without_drift, camera, plane = drifting.without_drift(), solved.state.camera, solved.state.rotation
    if without_drift.noise_cost(camera, plane, unknowns) < drifting.noise_cost(camera, plane, unknowns):
        solved = adjust(
            solved.state,
            tracks,
            replace(config, bundle=without_drift),
            refine=True,
            warm_start=solved.problem.warm_start,
        )
    return restart_tracklets(solved, tracks)


def restart_tracklets(fit: Adjustment, tracks: TrackSet) -> Adjustment:
    """Adjust again with tracklets re-initialised at the solution, where that lowers their cost.

    A tracklet may have several local minima. Where tracklets are few, a single one that was initialised far from the
    solution and is stuck in a wrong minimum shifts the solution by degrees.
    """
    for _ in range(MAX_RESTARTS):
        bundle, (_, motion, unknowns) = fit.problem.config.bundle, fit.problem.warm_start
        if bundle is None or unknowns is None:
            return fit
        camera, plane = fit.state.camera, fit.state.rotation
        restarted = bundle.initialised(camera, plane)
        current_cost, restarted_cost = (
            bundle.cost(bundle.residuals(camera, plane, each)) for each in (unknowns, restarted)
        )
        better = restarted_cost < current_cost - MIN_RESTART_GAIN
        if not better.any():
            return fit
        fit = adjust(
            fit.state,
            tracks,
            fit.problem.config,
            refine=True,
            warm_start=(None, motion, unknowns.where(better, restarted)),
        )
    return fit


def widen_by_tracklet_difference(fit: Adjustment, compared: TrackletComparison | None) -> Adjustment:
    """Add the difference to a rejected tracklet solution, if there is one, to the covariance."""
    if compared is None or not compared.rejected:
        return fit
    step = fit.problem.parameters.step_to(compared.state)
    return replace(fit, covariance=fit.covariance + np.outer(step, step))


def widen_by_point_slip(fit: Adjustment, windows: TwoFrameWindows) -> Adjustment:
    """Widen the standard deviation of a focal length from turning traffic by the estimated effect of point slip."""
    state, prior = fit.state, fit.problem.config.prior
    depends_on_turning = len(state.angles_rad) < 2 and fit.problem.config.turning and 0 in prior.free
    chosen = _turning_windows(fit, windows) if depends_on_turning else None
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
    """Return the windows of vehicles that turn in the plane of a solution; None if there are too few.

    Unless there are two roads, straight windows of the turning vehicles are included. Vehicles that never turn are
    not: such a group may be two vehicles side by side.
    """
    state = fit.state
    view = WindowRays.of(windows, state.camera, state.rotation, fit.problem.config.options)
    height_m = fit.problem.config.height_m or DEFAULT_CAMERA_HEIGHT_M
    without_slip, turning = without_side_slip(
        windows, view, initial_motion(view), state.camera, state.rotation, height_m
    )
    bodies = np.unique(windows.bodies[turning])
    if len(bodies) < MIN_TURNING_VEHICLES:
        return None
    chosen = turning if len(state.angles_rad) > 1 else without_slip & np.isin(windows.bodies, bodies)
    return windows.subset(np.flatnonzero(chosen))


def _level_plane(tilt_deg: float) -> np.ndarray:
    """camera_from_plane, shape (3, 3), of a camera without roll: x to the right, z up."""
    tilt = np.radians(tilt_deg)
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    right = np.array([1.0, 0.0, 0.0])
    return np.column_stack([right, np.cross(up, right), up])
