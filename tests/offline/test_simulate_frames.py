"""Simulated frames agree with the options."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.truth import truth_of

pytestmark = [pytest.mark.render, pytest.mark.usefixtures('shared_backdrops')]

SMALL = {'width_px': 320, 'height_px': 180, 'focal_px': 140.0, 'rate_hz': 5.0, 'duration_s': 4.0}


def _simulation(**given) -> Simulation:
    return Simulation(SimulationOptions(**{**SMALL, **given}))


@pytest.fixture(scope='module')
def day() -> Simulation:
    return _simulation()


def _motion_error_px(simulation: Simulation, first: int, second: int, turn: np.ndarray) -> float:
    """Track corners from one frame to another; return their median distance from the prediction.

    turn: rotation (3, 3) of the camera in its own frame.
    """
    grey = [cv2.cvtColor(simulation.frame(i), cv2.COLOR_BGR2GRAY) for i in (first, second)]
    corners = cv2.goodFeaturesToTrack(grey[0], 80, 0.05, 8)
    found, status, _ = cv2.calcOpticalFlowPyrLK(grey[0], grey[1], corners, None, winSize=(11, 11))
    rays = simulation.lens.bearings(corners[:, 0])
    expected, _ = simulation.lens.project(rays @ turn)
    errors = np.linalg.norm(found[:, 0] - expected, axis=1)[status[:, 0] > 0]
    return float(np.median(errors))


def test_day_frames_are_bgr8(day):
    frame = day.frame(0)
    assert (frame.shape, frame.dtype) == ((180, 320, 3), np.uint8)


def test_frame_does_not_depend_on_the_frames_before(day):
    first = day.frame(7)
    day.frame(15)
    assert np.array_equal(day.frame(7), first)


def test_traffic_moves(day):
    change = np.abs(day.frame(0).astype(int) - day.frame(5)).max(-1)
    assert (change > 40).mean() > 0.003


def test_empty_road_changes_by_noise_only():
    simulation = _simulation(empty=True, noise_sigma=2.0)
    change = simulation.frame(0).astype(float) - simulation.frame(9)
    # Two independent noises of sigma 2, rounded.
    assert change.std() == pytest.approx(2.0 * 2**0.5, rel=0.1)
    assert np.abs(change).max() < 8 * 2.0


def test_without_noise_an_empty_road_does_not_change_at_all():
    simulation = _simulation(empty=True, noise_sigma=0.0)
    assert np.array_equal(simulation.frame(0), simulation.frame(9))


def test_thermal_frames_are_mono16_within_14_bits():
    frame = _simulation(thermal=True).frame(3)
    assert (frame.shape, frame.dtype) == ((180, 320), np.uint16)
    assert 4096 < np.median(frame) < 12000
    assert frame.max() < 16384


def test_thermal_offset_drifts():
    simulation = _simulation(thermal=True, empty=True, noise_sigma=0.0)
    change = simulation.frame(19).astype(int) - simulation.frame(0)
    assert abs(np.median(change)) > 5
    assert change.std() < 20


def test_thermal_contrast_is_some_hundred_counts():
    simulation = _simulation(thermal=True)
    frame = simulation.frame(3)
    road = frame[120:]  # below the houses: asphalt, pavement, vehicles
    assert 30 < road.std() < 300
    assert np.abs(np.diff(frame[-20:, :60].astype(int), axis=1)).mean() < 12  # noise of three counts, and texture


def test_the_shutter_freezes_the_image_and_changes_offset_and_pattern():
    simulation = _simulation(thermal=True, empty=True, shutter_every_s=2.0, rate_hz=10.0)
    before, *shut = (simulation.frame(index) for index in range(19, 25))
    assert all(np.array_equal(frame, before) for frame in shut)
    change = simulation.frame(25).astype(int) - before
    calm = simulation.frame(19).astype(int) - simulation.frame(18)
    assert abs(np.median(change)) > 10 > abs(np.median(calm))
    assert change.std() > 1.1 * calm.std()


def test_shutter_image_is_flat():
    options = {'thermal': True, 'shutter_every_s': 2.0, 'rate_hz': 10.0}
    simulation = _simulation(**options, shutter_shows='flat')
    assert simulation.frame(22).std() < 0.2 * simulation.frame(19).std()
    assert np.array_equal(simulation.frame(26), _simulation(**options).frame(26))


def test_night_is_darker_and_has_bright_lamps(day):
    night = _simulation(night=True).frame(4)
    assert night.mean() < 0.5 * day.frame(4).mean()
    assert night.max() > 220


def test_bump_moves_the_image_as_the_lens_predicts():
    simulation = _simulation(empty=True, bump_at_s=2.0, bump_deg=1.0, noise_sigma=0.0)
    turn = simulation.pose.world_from_camera.T @ simulation.bumped_pose().world_from_camera
    # Error of the corner tracker itself.
    assert _motion_error_px(simulation, 9, 10, turn) < 0.1


def test_shake_moves_the_image_as_the_lens_predicts():
    simulation = _simulation(empty=True, shake_px=2.0, noise_sigma=0.0)
    second = int(np.argmax([np.trace(-simulation.shake(i)) for i in range(20)]))
    assert _motion_error_px(simulation, 0, second, simulation.shake(second)) < 0.1


def test_shake_has_the_stated_size():
    simulation = _simulation(shake_px=2.0, duration_s=200.0, empty=True)
    centre = np.array(simulation.lens.centre_px)
    ray = simulation.lens.bearings(centre)
    moved = [simulation.lens.project(ray @ simulation.shake(i))[0] - centre for i in range(1000)]
    assert np.std(moved, axis=0) == pytest.approx((2.0, 2.0), rel=0.2)


def test_another_seed_gives_another_image(day):
    assert not np.array_equal(day.frame(0), _simulation(seed=5).frame(0))


@pytest.mark.parametrize('given', [{'one_way': True}, {'scene': 'road'}, {'road_angle_deg': 60.0}], ids=str)
def test_other_networks_can_be_drawn(given):
    simulation = _simulation(**given)
    assert simulation.frame(2).std() > 20
    assert len(truth_of(simulation)['road_directions']) == len(simulation.network.roads)


def test_stamps_advance_by_the_frame_time(day):
    assert day.stamp_ns(5) - day.stamp_ns(0) == 1_000_000_000
