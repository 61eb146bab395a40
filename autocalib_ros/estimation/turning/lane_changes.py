"""Rotation of the ground plane about a single road, from vehicles that change lanes or merge.

Their paths lie in the plane but a few degrees off the road direction. One vehicle constrains the rotation to tens of
degrees, hundreds constrain it to a few.
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
"""Range of the angle between path and road in a lane change: above the wander within a lane, below turning off.
Judgement."""
MIN_LANE_CHANGING_VEHICLES = 8
"""Fewer vehicles may be groups of points from several vehicles. Judgement."""
MAX_LANE_CHANGE_WINDOWS = 300
"""Windows in one adjustment."""


def refine_with_lane_changes(
    fit: Adjustment, tracks: TrackSet, windows: TwoFrameWindows
) -> tuple[Adjustment, int] | None:
    """Adjust again with the vehicles that leave their lanes on the only road; None if there are too few.

    Returns the adjustment and the number of those vehicles.
    """
    if fit.plane_known or len(fit.state.angles_rad) != 1:
        return None
    camera, road, config = fit.state.camera, fit.state.directions[0], fit.problem.config
    up = upward_normal(fit.state, config, unproject_rays(camera, tracks.pixels))
    plane = np.column_stack([road, np.cross(up, road), up])
    view = WindowRays.of(windows, camera, plane, config.options)
    without_slip, _ = without_side_slip(
        windows, view, initial_motion(view), camera, plane, config.height_m or DEFAULT_CAMERA_HEIGHT_M
    )
    chosen = np.flatnonzero(without_slip & ~windows.from_segments)
    first, _, second = paths(windows.subset(chosen), camera, plane)
    outside = ~windows.mask[chosen]
    along, sideways = (
        np.ma.array((second - first)[..., axis], mask=outside).mean(axis=1).filled(0.0) for axis in (0, 1)
    )
    angle_deg = np.degrees(np.arctan2(np.abs(sideways), np.abs(along)))
    chosen = chosen[(angle_deg > LANE_CHANGE_DEG[0]) & (angle_deg < LANE_CHANGE_DEG[1])]
    vehicles = len(np.unique(windows.bodies[chosen]))
    if vehicles < MIN_LANE_CHANGING_VEHICLES:
        return None
    changing = replace(config, windows=windows.subset(chosen).balanced_subset(MAX_LANE_CHANGE_WINDOWS))
    return adjust(AdjustmentState(camera, plane, np.zeros(1)), tracks, changing, refine=True), vehicles
