"""The pose of a calibration whose camera has turned: corrected by what the picture shows, until traffic verifies it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import (
    COVARIANCE_PARAMETERS,
    GRADED_DISTANCE_M,
    GROUND_DISTANCES_M,
    Calibration,
    StandardDeviations,
)
from autocalib_ros.results.camera_move import CameraMove, rotation_from_turn
from autocalib_ros.results.grades import GroundSigma, rank_of
from autocalib_ros.results.statements import assumption

BEST_MENDED_GRADE = 'fair'
"""Best grade of a mended pose, as of all that rests on an assumption: here that the camera turned and did not shift."""
SHIFTED_GRADE = 'coarse'
"""Best grade where near and far turned otherwise: the shift is not measured, height and place are off by it."""
NEAR_ROWS, NEAREST_DOWN = 0.75, 0.1
"""Row in the middle of the lower half of the picture, as a fraction of the height, whose distance stands for what is
near; and the least slope of its ray, a tenth: farther away nothing is near."""
STEP_DEG = 1e-3
"""Step of numerical derivatives of tilt and roll."""
POSE = slice(COVARIANCE_PARAMETERS.index('tilt_deg'), COVARIANCE_PARAMETERS.index('roll_deg') + 1)
"""Rows of tilt and roll in the covariance."""


def mended(result: Calibration, move: CameraMove, stamp_ns: int) -> Calibration:
    """Return a calibration whose camera has turned by `move` since; the lens, the height and the road are the same.

    The standard deviations of tilt and roll include those of the registration, and that of the focal length, through
    which the turn was measured. `stamp_ns` is that of an image after the move. ValueError if the move does not keep the
    lens.
    """
    if not move.keeps_lens or move.sigma_deg is None:
        raise ValueError(f'the lens does not outlast this move: {move}')
    turn = move.rotation
    statement = assumption(
        'mended_pose',
        pan_deg=move.pan_deg,
        tilt_deg=move.tilt_deg,
        roll_deg=move.roll_deg,
        sigma_deg=float(np.linalg.norm(move.sigma_deg)),
    )
    moved = replace(
        result,
        assumptions=(*result.assumptions, statement),
        road_directions=result.road_directions @ turn.T,
        newest_stamp_ns=max(stamp_ns, result.newest_stamp_ns),
    )
    if move.parallax_deg:
        moved = replace(
            moved, assumptions=(*moved.assumptions, assumption('shifted_camera', parallax_deg=move.parallax_deg))
        )
    if result.ground is None:
        return moved
    ground = replace(result.ground, rotation=result.ground.rotation @ turn.T)
    registration = _registration_covariance(result, move)
    carry, measure = _pose_derivatives(result.ground, ground, turn)
    added = measure @ registration @ measure.T
    stddev = _with_shift(_with_registration(result, carry, added), ground, result.camera, move)
    best = SHIFTED_GRADE if move.parallax_deg else BEST_MENDED_GRADE
    limits = [result.grade, best, *([] if stddev.ground is None else [stddev.ground.grade])]
    return replace(
        moved,
        ground=ground,
        grade=min(limits, key=rank_of),
        stddev=stddev,
        covariance=_carried_covariance(result.covariance, carry, added),
    )


def _with_shift(sigma: StandardDeviations, ground: GroundPlane, camera: Camera, move: CameraMove) -> StandardDeviations:
    """Return the standard deviations where the camera was shifted by an unknown way: height and places have it."""
    if not move.parallax_deg:
        return sigma
    below = np.array([[camera.principal_point_px[0], NEAR_ROWS * camera.height]])
    bearing = camera.unproject(below)[0][0]
    down = -float(bearing @ ground.normal_in_camera)
    distance = ground.height_m / max(down, NEAREST_DOWN)
    shift = float(np.radians(move.parallax_deg)) * distance
    points = tuple(None if value is None else float(np.hypot(value, shift)) for value in sigma.ground_point_m)
    relative = shift / ground.height_m
    lengths = sigma.ground and GroundSigma(
        float(np.hypot(sigma.ground.along, relative)), float(np.hypot(sigma.ground.across, relative))
    )
    height_m = float(np.hypot(sigma.height_m or 0.0, shift))
    return replace(sigma, height_m=height_m, ground_point_m=points, ground=lengths)


def _registration_covariance(result: Calibration, move: CameraMove) -> np.ndarray:
    """Return the covariance (3, 3) of pan, tilt and roll in square degrees."""
    turn_deg = np.array([move.pan_deg, move.tilt_deg, move.roll_deg])
    focal = 0.0 if result.stddev.focal_px is None else result.stddev.focal_px / result.camera.focal_px
    # angles off the axis are read off the lens, a roll is not
    by_lens = focal * turn_deg * [1.0, 1.0, 0.0]
    return np.diag(np.square(move.sigma_deg or (0.0, 0.0, 0.0))) + np.outer(by_lens, by_lens)


def _pose_derivatives(before: GroundPlane, after: GroundPlane, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of tilt and roll after a turn: by those before it (2, 2), and by the turn (2, 3)."""
    now = tilt_and_roll_deg(after.normal_in_camera)
    tilt_roll = tilt_and_roll_deg(before.normal_in_camera)
    carry = [(tilt_and_roll_deg(turn @ _upward(tilt_roll + step)) - now) / STEP_DEG for step in STEP_DEG * np.eye(2)]
    measure = [
        (tilt_and_roll_deg(rotation_from_turn(step) @ after.normal_in_camera) - now) / STEP_DEG
        for step in np.radians(STEP_DEG) * np.eye(3)
    ]
    return np.column_stack(carry), np.column_stack(measure)


def _upward(tilt_roll_deg: np.ndarray) -> np.ndarray:
    """Return the upward normal (3,) of tilt and roll in degrees (2,)."""
    tilt, roll = np.radians(tilt_roll_deg)
    return -np.array([np.cos(tilt) * np.sin(roll), np.cos(tilt) * np.cos(roll), np.sin(tilt)])


def _with_registration(result: Calibration, carry: np.ndarray, added: np.ndarray) -> StandardDeviations:
    """Return the standard deviations after a move; `added` is the covariance (2, 2) of tilt and roll by it."""
    sigma = result.stddev
    if sigma.tilt_deg is None or sigma.roll_deg is None or result.ground is None:
        return sigma
    pose = np.diag([sigma.tilt_deg**2, sigma.roll_deg**2])
    if result.covariance is not None:
        pose = result.covariance[POSE, POSE]
    tilt_deg, roll_deg = np.sqrt(np.diag(carry @ pose @ carry.T + added))
    tilt_rad, height = float(np.radians(np.sqrt(added[0, 0]))), result.ground.height_m
    # a point at distance d moves by (d^2 + h^2) / h times the error of the tilt, a length there by 2 d / h of itself
    points = tuple(
        None if value is None else float(np.hypot(value, (distance**2 + height**2) / height * tilt_rad))
        for value, distance in zip(sigma.ground_point_m, GROUND_DISTANCES_M, strict=False)
    )
    slope = GRADED_DISTANCE_M / (height if result.ground.metric else 8.0 * height) * tilt_rad
    ground = sigma.ground and GroundSigma(
        float(np.hypot(sigma.ground.along, 2.0 * slope)), float(np.hypot(sigma.ground.across, slope))
    )
    return replace(sigma, tilt_deg=float(tilt_deg), roll_deg=float(roll_deg), ground_point_m=points, ground=ground)


def _carried_covariance(covariance: np.ndarray | None, carry: np.ndarray, added: np.ndarray) -> np.ndarray | None:
    """Return the covariance (10, 10) with the rows of tilt and roll after the move."""
    if covariance is None:
        return None
    whole = np.eye(len(covariance))
    whole[POSE, POSE] = carry
    carried = whole @ covariance @ whole.T
    carried[POSE, POSE] += added
    return carried
