"""Known lengths and control points that are followed as the camera turns."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.config import Options, ScaleOptions
from autocalib_ros.errors import InputError
from autocalib_ros.ground import Ground
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.camera_move import CameraMove, MoveKind
from autocalib_ros.results.control_points import ControlPoints
from autocalib_ros.results.given_pixels import FollowedPixels, GivenPixels
from autocalib_ros.results.mending import mended
from stored_results import SIZE, calibration

BUMP = CameraMove(MoveKind.BUMP, 20.0, 2.0, -1.5, 0.7, sigma_deg=(0.01, 0.01, 0.01))
ZOOM = CameraMove(MoveKind.ZOOM, 20.0, zoom=1.2, sigma_deg=(0.01, 0.01, 0.01))
PLACES_M = np.array([[14.0, -3.0], [22.0, 2.0], [18.0, -4.0], [18.0, 4.0]])


@pytest.fixture
def result() -> Calibration:
    return calibration(tilt_deg=15.0)


@pytest.fixture
def options(result: Calibration) -> Options:
    """Options with two lengths on the road of the calibration, one by each option."""
    pixels, _ = Ground.of(result).pixels(PLACES_M)
    first, second = (' '.join(map(repr, pair.ravel().tolist())) for pair in pixels.reshape(2, 2, 2))
    return Options(scale=ScaleOptions(distance_px=first, distance_m=9.4, distances=f'{second} 8.0'))


def known_places(options: Options, result: Calibration) -> np.ndarray:
    """Return the ends of the known lengths on the road of a calibration, shape (n, 2)."""
    pixels = np.array([pixel for known in options.scale.known_distances for pixel in known.pixels])
    return Ground.of(result).points(pixels).points_m[:, :2]


def test_lengths_stay_where_they_are_on_the_road(result: Calibration, options: Options) -> None:
    pixels = GivenPixels.of(options).turned(result, BUMP)
    moved = pixels.options_in_view(options, SIZE)
    after = mended(result, BUMP, result.newest_stamp_ns + 1)
    np.testing.assert_allclose(known_places(moved, after), PLACES_M, atol=0.01)
    assert [known.metres for known in moved.scale.known_distances] == [9.4, 8.0]
    # where the old pixels are on the road now
    assert np.abs(known_places(options, after) - PLACES_M).max() > 1.0


def test_the_uncertainty_of_the_turn_widens_that_of_the_pixels(result: Calibration, options: Options) -> None:
    pixels = GivenPixels.of(options).turned(result, BUMP)
    registration = 300.0 * np.radians(np.hypot(0.01, np.hypot(0.01, 0.01)))
    lens = np.radians(np.linalg.norm([2.0, 1.5, 0.7]))  # 1 px of 300, times 300 px
    assert pixels.sigma_px == pytest.approx(np.hypot(registration, lens))
    assert pixels.options_in_view(options, SIZE).scale.pixel_sigma_px == pytest.approx(np.hypot(1.0, pixels.sigma_px))


def test_a_length_that_left_the_image_is_not_used(result: Calibration, options: Options) -> None:
    far = replace(BUMP, pan_deg=-50.0)
    moved = GivenPixels.of(options).turned(result, far).options_in_view(options, SIZE)
    assert len(moved.scale.known_distances) < 2


def test_after_a_move_that_was_not_measured_nothing_is_known(result: Calibration, options: Options) -> None:
    only = replace(options, scale_from='distance')
    for move in (ZOOM, CameraMove(MoveKind.OTHER_VIEW, 20.0)):
        pixels = GivenPixels.of(only).turned(result, move)
        assert not pixels.options_in_view(only, SIZE).gives_scale and not pixels.is_complete


def test_options_without_pixels_are_the_same_after_a_move(result: Calibration) -> None:
    options = Options(camera_height=8.0)
    assert GivenPixels.of(options).turned(result, ZOOM).options_in_view(options, SIZE) is options


def test_control_points_follow_the_lengths(result: Calibration, options: Options) -> None:
    seen, _ = Ground.of(result).pixels(PLACES_M)
    points = ControlPoints(('a', 'b', 'c', 'd'), seen, PLACES_M)
    pixels = GivenPixels.of(options, points).turned(result, BUMP)
    moved = pixels.points_in_view(points)
    assert moved is not None
    after = Ground.of(mended(result, BUMP, result.newest_stamp_ns + 1))
    np.testing.assert_allclose(after.points(moved.pixels).points_m[:, :2], PLACES_M, atol=1e-6)
    assert pixels.turned(result, ZOOM).points_in_view(points) is None


def test_pixels_come_back_from_a_file(result: Calibration, options: Options) -> None:
    for pixels in (GivenPixels.of(options).turned(result, BUMP), GivenPixels.of(options).turned(result, ZOOM)):
        found = GivenPixels.from_document(json.loads(json.dumps(pixels.document(), allow_nan=False)))
        np.testing.assert_array_equal(found.in_view, pixels.in_view)
        np.testing.assert_array_equal(found.as_given, pixels.as_given)
        assert found.sigma_px == pixels.sigma_px


@pytest.mark.parametrize('fault', [{'in_view': []}, {'in_view': [[1.0]]}, {'sigma_px': -1.0}, {'as_given': 'x'}])
def test_a_damaged_file_is_refused(options: Options, fault: dict) -> None:
    with pytest.raises(InputError, match='given_pixels are damaged'):
        GivenPixels.from_document({**GivenPixels.of(options).document(), **fault})


def test_a_view_that_comes_back_has_its_pixels(result: Calibration, options: Options) -> None:
    given = GivenPixels.of(options)
    followed = FollowedPixels(given)
    followed.moved(result, ZOOM)
    assert not followed.present.is_complete
    followed.is_back()
    assert followed.present is given
    # two moves, the first of which was mended
    followed.moved(result, BUMP)
    followed.adopt()
    followed.moved(result, BUMP)
    np.testing.assert_allclose(
        followed.present.in_view, given.turned(result, BUMP).turned(result, BUMP).in_view, atol=1e-9
    )


def test_a_restart_goes_on_unless_other_pixels_were_given(result: Calibration, options: Options) -> None:
    turned = GivenPixels.of(options).turned(result, BUMP)
    followed = FollowedPixels(GivenPixels.of(options))
    followed.resume(turned)
    assert followed.present is turned
    other = replace(options, scale=replace(options.scale, distances=''))
    followed = FollowedPixels(GivenPixels.of(other))
    followed.resume(turned)
    assert followed.present is not turned


PRIVATE = '200 60 260 60 260 110 200 110'


def test_ignored_regions_stay_and_cover_the_same_places_in_the_view(result: Calibration, options: Options) -> None:
    private = replace(options, ignore_regions=PRIVATE)
    pixels = GivenPixels.of(private)
    assert pixels.regions_in_view(private) == private.ignored_polygons
    given, followed = pixels.turned(result, BUMP).regions_in_view(private)
    assert (given,) == private.ignored_polygons  # burnt-in text stays where it is
    corners = np.array(given)
    bearings, _ = result.camera.unproject(corners)
    places, _ = result.camera.project(bearings @ BUMP.rotation.T)
    centre = np.array(followed).mean(axis=0)
    np.testing.assert_allclose(centre, places.mean(axis=0), atol=1.0)  # the lens bends the sides by less than a pixel
    reach = np.hypot(*(places - centre).T).max()
    assert reach < np.hypot(*(np.array(followed) - centre).T).max() < 1.2 * reach
    # known lengths are followed as without regions
    lengths = GivenPixels.of(options).turned(result, BUMP).options_in_view(options, SIZE).scale
    assert pixels.turned(result, BUMP).options_in_view(private, SIZE).scale == lengths


def test_ignored_regions_follow_a_zoom_and_nothing_else_does(result: Calibration, options: Options) -> None:
    private = replace(options, ignore_regions=PRIVATE)
    pixels = GivenPixels.of(private).turned(result, ZOOM)
    _, larger = pixels.regions_in_view(private)
    grown = np.ptp(np.array(larger), axis=0) / np.ptp(np.array(private.ignored_polygons[0]), axis=0)
    assert (grown > 1.15).all() and (grown < 1.4).all()
    assert not pixels.options_in_view(private, SIZE).scale.known_distances


def test_ignored_regions_in_another_view_stay_where_they_are(result: Calibration, options: Options) -> None:
    private = replace(options, ignore_regions=PRIVATE)
    away = CameraMove(MoveKind.OTHER_VIEW, 20.0)
    assert GivenPixels.of(private).turned(result, away).regions_in_view(private) == private.ignored_polygons


def test_ignored_regions_survive_a_restart(result: Calibration, options: Options) -> None:
    private = replace(options, ignore_regions=PRIVATE)
    pixels = GivenPixels.of(private).turned(result, BUMP)
    found = GivenPixels.from_document(json.loads(json.dumps(pixels.document(), allow_nan=False)))
    assert found.regions_in_view(private) == pixels.regions_in_view(private)


def test_lengths_are_less_certain_after_a_move_that_only_the_picture_tells(options: Options) -> None:
    points = ControlPoints(('a', 'b'), np.array([[10.0, 20.0], [200.0, 180.0]]), np.array([[0.0, 0.0], [4.0, 1.0]]))
    given = GivenPixels.of(options, points)
    little = given.displaced(1.0)
    scale = little.options_in_view(options, SIZE).scale
    assert len(scale.known_distances) == 2
    assert scale.pixel_sigma_px == pytest.approx(np.hypot(options.scale.pixel_sigma_px, 1.0))
    assert little.points_in_view(points) is not None
    much = little.displaced(40.0)  # the lengths are 100 px or so
    assert not much.options_in_view(options, SIZE).scale.known_distances
    assert much.points_in_view(points) is None
    assert GivenPixels.from_document(much.document()).displaced_px == 41.0
    assert given.displaced(np.inf).points_in_view(points) is None


def test_pixels_are_as_given_when_the_first_view_is_back(options: Options) -> None:
    followed = FollowedPixels(GivenPixels.of(options))
    followed.displaced(40.0)
    followed.is_back()
    assert followed.present.options_in_view(options, SIZE) is options
