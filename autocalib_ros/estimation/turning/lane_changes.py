"""The rotation of the ground plane about a lone road, from vehicles that change lanes or merge.

Their ways lie in the plane as all ways do, and not along the road: a few degrees off it, so that one vehicle tells the
rotation to tens of degrees, and hundreds to a few.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState, upward_normal
from autocalib_ros.estimation.motion.planar_motion import WindowRays, initial_motion, paths, without_side_slip
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.observations.two_frame_windows import TwoFrameWindows
from autocalib_ros.geometry.great_circles import unproject_rays

LANE_CHANGE_DEG = 1.5, 20.0
"""A window is of a change of lanes when it leads aside from the road by more than drivers wander, and less than who
turns off."""
MIN_LANE_CHANGING_VEHICLES = 8
"""Fewer may be wrong groups each."""
MAX_LANE_CHANGE_WINDOWS = 300


def refine_with_lane_changes(
    fit: Adjustment, tracks: TrackSet, windows: TwoFrameWindows
) -> tuple[Adjustment, int] | None:
    """Solve again with the vehicles that leave their lanes on the one road of a solution; None where they are few.

    With the number of those vehicles.
    """
    if fit.plane_known or len(fit.state.angles_rad) != 1:
        return None
    camera, road, config = fit.state.camera, fit.state.directions[0], fit.problem.config
    up = upward_normal(fit.state, config, unproject_rays(camera, tracks.pixels))
    plane = np.column_stack([road, np.cross(up, road), up])
    view = WindowRays.of(windows, camera, plane, config.options)
    course, _ = without_side_slip(
        windows, view, initial_motion(view), camera, plane, config.height_m or DEFAULT_CAMERA_HEIGHT_M
    )
    chosen = np.flatnonzero(course & ~windows.from_segments)
    first, _, second = paths(windows.subset(chosen), camera, plane)
    away = ~windows.mask[chosen]
    along, aside = (np.ma.array((second - first)[..., axis], mask=away).mean(axis=1).filled(0.0) for axis in (0, 1))
    off_deg = np.degrees(np.arctan2(np.abs(aside), np.abs(along)))
    chosen = chosen[(off_deg > LANE_CHANGE_DEG[0]) & (off_deg < LANE_CHANGE_DEG[1])]
    vehicles = len(np.unique(windows.bodies[chosen]))
    if vehicles < MIN_LANE_CHANGING_VEHICLES:
        return None
    changing = replace(config, windows=windows.subset(chosen).balanced_subset(MAX_LANE_CHANGE_WINDOWS))
    return adjust(AdjustmentState(camera, plane, np.zeros(1)), tracks, changing, refine=True), vehicles
