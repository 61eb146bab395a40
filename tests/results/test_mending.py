"""A pose that is turned with its camera: the road stays where it is, and the deviations grow by the registration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.ground import Ground
from autocalib_ros.results.camera_move import CameraMove, MoveKind
from autocalib_ros.results.mending import mended
from stored_results import calibration

BUMP = CameraMove(MoveKind.BUMP, 100.0, pan_deg=1.5, tilt_deg=-0.7, roll_deg=0.4, sigma_deg=(0.02, 0.03, 0.01))
KEPT = calibration()


def test_points_of_the_road_stay_where_they_are() -> None:
    now = mended(KEPT, BUMP, 0)
    places = np.array([[15.0, 2.0, 0.0], [40.0, -4.0, 0.0]])
    pixels, seen = Ground.of(KEPT).pixels(places)
    bearings, _ = KEPT.camera.unproject(pixels)
    moved_pixels, _ = KEPT.camera.project(bearings @ BUMP.rotation.T)  # where the turned camera sees them
    assert seen.all()
    np.testing.assert_allclose(Ground.of(now).points(moved_pixels).points_m, places, atol=1e-6)
    assert now.camera == KEPT.camera


def test_tilt_of_the_camera_is_tilt_of_the_pose() -> None:
    level = calibration(roll_deg=0.0)
    down = CameraMove(MoveKind.BUMP, 0.0, tilt_deg=2.0, sigma_deg=(0.0, 0.0, 0.0))
    assert level.ground is not None
    before = tilt_and_roll_deg(level.ground.normal_in_camera)
    turned = mended(level, down, 0).ground
    assert turned is not None
    np.testing.assert_allclose(tilt_and_roll_deg(turned.normal_in_camera), before + [2.0, 0.0], atol=1e-9)


def test_deviations_include_registration_and_focal_length() -> None:
    tilt = CameraMove(MoveKind.BUMP, 0.0, tilt_deg=3.0, sigma_deg=(0.0, 0.1, 0.0))
    now = mended(replace(calibration(roll_deg=0.0), covariance=None), tilt, 0)
    assert now.stddev.tilt_deg is not None
    # 0.2 degrees of the calibration, 0.1 of the registration, 3 degrees through 1 px in 300
    assert now.stddev.tilt_deg == pytest.approx(np.sqrt(0.2**2 + 0.1**2 + 0.01**2), rel=1e-3)
    assert all(
        after is None or after > before
        for before, after in zip(KEPT.stddev.ground_point_m, now.stddev.ground_point_m, strict=True)
    )


def test_grade_and_assumptions_say_so() -> None:
    now = mended(KEPT, BUMP, KEPT.newest_stamp_ns + 5)
    assert (KEPT.grade, now.grade) == ('full', 'fair')
    assert now.assumptions[-1].kind == 'mended_pose'
    assert 'pan +1.50, tilt -0.70, roll +0.40' in str(now.assumptions[-1])
    assert now.newest_stamp_ns == KEPT.newest_stamp_ns + 5


def test_zoom_mends_nothing() -> None:
    with pytest.raises(ValueError, match='zoom'):
        mended(KEPT, replace(BUMP, kind=MoveKind.ZOOM, zoom=1.1), 0)


def test_a_shift_widens_height_and_places_and_lowers_the_grade() -> None:
    """What is near turned by half a degree more: a shift by a hundredth of its distance, in a direction unknown."""
    shifted = replace(BUMP, parallax_deg=0.5)
    turned, now = mended(KEPT, BUMP, 0), mended(KEPT, shifted, 0)
    assert now.grade == 'coarse'
    assert [one.kind for one in now.assumptions[-2:]] == ['mended_pose', 'shifted_camera']
    assert now.ground is not None and now.stddev.height_m is not None
    least_m = np.radians(0.5) * now.ground.height_m  # no place on the road is nearer than the camera is high
    assert now.stddev.height_m > max(least_m, turned.stddev.height_m or 0.0)
    for after, before in zip(now.stddev.ground_point_m, turned.stddev.ground_point_m, strict=True):
        assert after is None or before is None or after > before
