"""Vehicles that turn: a solution from nothing but them, and those that a solution can use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.great_circles import TrackSet
from autocalib_ros.estimation.joint import JointFit, cost_at_scale, solve_joint
from autocalib_ros.estimation.planar_motion import View, first_motion, steered
from autocalib_ros.estimation.state import Setting, State
from autocalib_ros.estimation.windows import Windows

START_DIAGONALS = (0.35, 0.55, 0.85)
"""Focal lengths to start from, in image diagonals: lenses of about 100, 75 and 50 degrees across the diagonal."""
START_TILTS_DEG = (20.0, 45.0)
"""Tilts of the optical axis below the horizontal to start from, without roll."""
START_WINDOWS = 60
MOST_WINDOWS = 300
MIN_BODIES = 8
"""So many vehicles that turn, distinct, make up evidence; fewer may be one driver's whim or a wrong group each."""


def from_turning(tracks: TrackSet, windows: Windows, setting: Setting) -> JointFit | None:
    """Solve for lens and plane from the motion of vehicles alone, from several starts; None where too few turn."""
    nothing = tracks.subset(np.zeros(0, int))
    few = replace(setting, windows=windows.spread(START_WINDOWS))
    if len(np.unique(few.windows.bodies)) < MIN_BODIES:
        return None
    centre = setting.prior.centre
    diagonal = np.hypot(centre.width, centre.height)
    lenses = [setting.prior.start(diagonal * share) for share in START_DIAGONALS]
    starts = [State(lens, _level_plane(tilt), np.zeros(0))
              for lens in (lenses[:1] if setting.prior.focal_known else lenses) for tilt in START_TILTS_DEG]
    fits = [solve_joint(start, nothing, few) for start in starts]
    scale = min(fit.window_scale for fit in fits)
    best = min(fits, key=lambda fit: cost_at_scale(fit, nothing, 1.0, scale))
    return with_steered(with_steered(best, nothing, windows), tracks, windows)


def with_steered(fit: JointFit | None, tracks: TrackSet, windows: Windows) -> JointFit | None:
    """Solve again with the vehicles that turn in the plane of a solution; None where they are too few."""
    if fit is None:
        return None
    state, setting = fit.state, fit.problem.setting
    motion = first_motion(View.of(windows, state.camera, state.rotation, setting.options))
    turning = np.flatnonzero(steered(windows, motion, state.camera, state.rotation))
    chosen = windows.subset(turning).spread(MOST_WINDOWS)
    if len(np.unique(chosen.bodies)) < MIN_BODIES:
        return None
    return solve_joint(state, tracks, replace(setting, windows=chosen), refine=True)


def _level_plane(tilt_deg: float) -> np.ndarray:
    """camera_from_plane, shape (3, 3), of a camera without roll: x to the right, z up."""
    tilt = np.radians(tilt_deg)
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    right = np.array([1.0, 0.0, 0.0])
    return np.column_stack([right, np.cross(up, right), up])
