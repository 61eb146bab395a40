"""Disturbances appear only where their physics predicts them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from autocalib_ros.errors import UsageError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.simulate.camera_motion import CameraMotion
from autocalib_ros.offline.simulate.lamps import vehicle_lamps
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.weather import GroundBuffer, box_corners
from autocalib_ros.perception.view_registration import ViewPose, ViewReference, normalised

pytestmark = [pytest.mark.render, pytest.mark.usefixtures('shared_backdrops')]

SMALL = {
    'width_px': 320,
    'height_px': 180,
    'focal_px': 140.0,
    'rate_hz': 10.0,
    'duration_s': 28.0,
    'noise_sigma': 0.0,
    'pedestrians': 0,
}


@cache
def _simulation(**given) -> Simulation:
    return Simulation(SimulationOptions(**{**SMALL, **given}))


def _changed(trouble: str, first: int, second: int, **given) -> np.ndarray:
    """Mask (h, w) where two frames differ by more than rounding."""
    simulation = _simulation(trouble=trouble, **given)
    return np.abs(simulation.frame(first).astype(int) - simulation.frame(second)).max(-1) > 12


def _off_road() -> np.ndarray:
    simulation = _simulation()
    return GroundBuffer.of(simulation.options, simulation.network, simulation.pose).off_road_m


@pytest.mark.parametrize('trouble', ['trees', 'flags', 'leds', 'water', 'shadows', 'rain', 'drops', 'clock'])
def test_each_trouble_changes_an_empty_road(trouble):
    changed = _changed(trouble, 100, 104, empty=True) | _changed(trouble, 100, 260, empty=True)
    assert 5e-5 < changed.mean() < 0.5


@pytest.mark.parametrize('trouble', ['trees', 'flags', 'water'])
def test_swaying_objects_stay_in_place(trouble):
    # Later changes lie next to earlier ones: nothing travels.
    early, late = (_changed(trouble, begin, begin + 13, empty=True) for begin in (100, 140))
    reach = cv2.dilate(early.astype(np.uint8), np.ones((21, 21), np.uint8)) > 0
    assert (late & reach).sum() > 0.9 * late.sum() > 0


def test_water_lies_beside_the_road():
    assert (_off_road()[_changed('water', 100, 104, empty=True)] > 0).all()


def test_a_frame_does_not_depend_on_the_frames_before():
    simulation = _simulation(trouble='trees,flags,leds,drops,rain,water,shadows,clock')
    first = simulation.frame(30)
    simulation.frame(31)
    assert np.array_equal(simulation.frame(30), first)


def test_a_vehicle_casts_a_shadow_on_the_ground_beside_it():
    simulation, plain = _simulation(trouble='shadows'), _simulation()
    index = 150
    darker = plain.frame(index).astype(int).max(-1) - simulation.frame(index).max(-1)
    ground = GroundBuffer.of(plain.options, plain.network, plain.pose)
    clouds = _simulation(trouble='shadows', empty=True).frame(index).astype(int).max(-1)
    # Reference without vehicles: brightness under the clouds alone.
    cast = (clouds - simulation.frame(index).max(-1) > 25) & (darker > 25) & np.isfinite(ground.distance_m)
    inside = [_inside(plain, *pair) for pair in plain.states(plain.time_s(index))]
    assert (cast & ~np.logical_or.reduce(inside)).sum() > 80


def _inside(simulation: Simulation, vehicle, state) -> np.ndarray:
    """Mask (h, w) of the projected bounding box of a vehicle."""
    pixels, _ = simulation.lens.project(simulation.pose.to_camera(box_corners(vehicle, state)))
    mask = np.zeros((simulation.options.height_px, simulation.options.width_px), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
    return mask > 0


def test_a_wet_road_reflects_lamps_at_their_mirror_images():
    wet, dry = _simulation(trouble='wet', night=True), _simulation(night=True)
    index = 150
    added = wet.frame(index).astype(int).max(-1) - dry.frame(index).max(-1)
    near = [
        pixel
        for vehicle, state in dry.states(dry.time_s(index))
        for lamp in vehicle_lamps(vehicle, state)
        if (pixel := _mirrored(dry, lamp)) is not None
    ]
    bright = [added[round(y), round(x)] for x, y in near]
    assert np.quantile(bright, 0.9) > 40
    # Nothing is added above the horizon.
    ground = GroundBuffer.of(dry.options, dry.network, dry.pose)
    assert (added[np.isinf(ground.distance_m)] < 20).all()


def _mirrored(simulation: Simulation, lamp) -> np.ndarray | None:
    """Return the pixel (2,) of a lamp's mirror image, or None if outside the image or facing away."""
    below = lamp.position_m * (1, 1, -1)
    to_camera = simulation.pose.position_m - below
    pixel, valid = simulation.lens.project(simulation.pose.to_camera(below))
    size = (simulation.options.width_px - 1, simulation.options.height_px - 1)
    towards = float(lamp.direction @ to_camera[:2]) / float(np.linalg.norm(to_camera))
    return pixel if valid and (pixel > 1).all() and (pixel < np.array(size) - 1).all() and towards > 0.3 else None


@pytest.mark.parametrize(
    ('given', 'words'),
    [
        ({'trouble': 'snow'}, "unknown trouble 'snow'"),
        ({'trouble': 'wet'}, 'needs night'),
        ({'trouble': 'trees', 'thermal': True}, 'leave out trouble or thermal'),
    ],
)
def test_impossible_troubles_are_refused(given, words):
    with pytest.raises(UsageError, match=words):
        replace(SimulationOptions(), **given)


def _street() -> np.ndarray:
    generator = np.random.default_rng(0)
    image = np.full((SMALL['height_px'], SMALL['width_px']), 90.0, np.float32)
    for _ in range(120):
        x, y = generator.integers(0, (290, 160))
        image[y : y + generator.integers(4, 20), x : x + generator.integers(6, 30)] += generator.uniform(-50, 50)
    return cv2.GaussianBlur(np.clip(image, 0, 255), (0, 0), 0.8).astype(np.uint8)


@pytest.mark.parametrize('given', [{'drift_deg': 4.0}, {'sway_deg': 2.0}, {'zoom_at_s': 1.0, 'zoom': 1.1}])
def test_camera_moves_through_its_lens(given):
    options = SimulationOptions(**{**SMALL, **given})
    motion, street, lens = CameraMotion(options), _street(), options.lens
    reference = ViewReference(
        street, Camera(options.width_px, options.height_px, lens.focal_px, lens.centre_px, lens.k)
    )
    pose = reference.near(normalised(motion.moved(street, 14.3)), ViewPose.identity())
    pose = pose or reference.anywhere(normalised(motion.moved(street, 14.3)))
    assert pose is not None
    np.testing.assert_allclose(pose.rotation, motion.rotation(14.3).T, atol=2e-3)  # 0.1 degrees
    assert np.exp(pose.log_zoom) == pytest.approx(motion.zoom(14.3), abs=0.005)


def test_night_falls_from_the_first_frame_to_the_last():
    simulation = _simulation(dusk=True, empty=True)
    means = [simulation.frame(index).mean() for index in (0, 140, 279)]
    assert means[0] > 1.7 * means[1] > 2.8 * means[2]


@pytest.mark.parametrize('given', [{'zoom_at_s': 99.0}, {'dusk': True, 'night': True}])
def test_motion_that_makes_no_sense_is_refused(given):
    with pytest.raises(UsageError, match=r'outside the recording|from day to night'):
        SimulationOptions(**{**SMALL, **given})
