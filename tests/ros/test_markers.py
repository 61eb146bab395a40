"""Markers of a calibration: valid, latched, and taken away with it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from visualization_msgs.msg import Marker, MarkerArray

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence
from autocalib_ros.results.calibration import COVARIANCE_PARAMETERS
from autocalib_ros.ros.markers import markers, no_markers
from autocalib_ros.ros.messages import InvalidMessage, validated
from bench import calibration, image, wait_for

TOPIC = '/autocalib/markers'


@pytest.fixture(scope='module')
def result():
    """A calibration that looks down at the road, its height good to 0.9 %."""
    made = calibration(synthetic_evidence(Junction(), np.random.default_rng(0)))
    covariance = np.zeros((len(COVARIANCE_PARAMETERS),) * 2)
    covariance[-1, -1] = 0.072**2
    return replace(
        made,
        camera=Camera(1280, 720, 560.0, (630.0, 371.0)),
        ground=GroundPlane(pose(32.0, 1.0, 0.0).T, 8.0),
        covariance=covariance,
    )


def by_namespace(array: MarkerArray) -> dict[str, list[Marker]]:
    found: dict[str, list[Marker]] = {}
    for marker in array.markers:
        found.setdefault(marker.ns, []).append(marker)
    return found


def test_all_is_valid_and_in_the_ground_frame(result):
    array = validated(markers(result, 'cam_ground'))
    assert array.markers[0].action == Marker.DELETEALL
    assert {marker.header.frame_id for marker in array.markers[1:]} == {'cam_ground'}
    for marker in array.markers[1:]:
        assert marker.pose.orientation.w == 1.0 and marker.color.a > 0
        assert (marker.scale.z if marker.type == Marker.TEXT_VIEW_FACING else marker.scale.x) > 0
        assert len(marker.points) % 2 == 0 or marker.type != Marker.LINE_LIST
        assert all(math.isfinite(value) for point in marker.points for value in (point.x, point.y, point.z))


def test_names_and_numbers_are_unique_and_stay(result):
    names = [
        [(marker.ns, marker.id) for marker in markers(calibrated, 'cam_ground').markers]
        for calibrated in (result, replace(result, camera=replace(result.camera, focal_px=500.0)))
    ]
    assert len(set(names[0])) == len(names[0])
    assert names[0] == names[1]
    assert set(by_namespace(markers(result, 'g'))) == {
        '',
        'grid',
        'field_of_view',
        'uncertainty',
        'uncertainty_text',
        'state',
    }


def test_rays_of_the_camera_start_at_its_place(result):
    (field,) = by_namespace(markers(result, 'g'))['field_of_view']
    for ray in range(4):
        begin = field.points[2 * ray]
        assert (begin.x, begin.y, begin.z) == (0.0, 0.0, 8.0)


def test_ellipses_and_words_tell_the_uncertainty_in_metres(result):
    found = by_namespace(markers(result, 'g'))
    assert [marker.text for marker in found['uncertainty_text']] == [
        '10 m: sigma 0.09 m',
        '20 m: sigma 0.18 m',
        '40 m: sigma 0.36 m',
    ]  # 0.072 m of 8 m
    (state,) = found['state']
    assert 'grade full' in state.text and 'focal length 560.00 px (sigma 1)' in state.text
    assert 'squares of 5 m' in state.text and 'enlarged 10 times' in state.text
    ellipse = np.array([[point.x, point.y] for point in found['uncertainty'][1].points])
    assert np.ptp(ellipse[:, 0]) / 2 == pytest.approx(10 * 0.18, rel=0.01)


def test_without_a_covariance_there_are_no_ellipses(result):
    found = by_namespace(validated(markers(replace(result, covariance=None), 'g')))
    assert set(found) == {'', 'grid', 'field_of_view', 'state'}
    assert 'ellipses' not in found['state'][0].text


def test_in_units_of_the_height_no_metres_are_reported(result):
    unit = replace(result, ground=GroundPlane(result.ground.rotation, 1.0, metric=False), covariance=None)
    (state,) = by_namespace(validated(markers(unit, 'g')))['state']
    assert 'squares of 0.5 camera heights' in state.text


def test_a_camera_that_sees_no_road_has_markers_without_a_grid(result):
    up = replace(result, ground=GroundPlane(pose(-80.0, 0.0, 0.0).T, 8.0))
    assert set(by_namespace(validated(markers(up, 'g')))) == {'', 'field_of_view', 'state'}


def test_numbers_that_are_none_are_found(result):
    array = markers(result, 'g')
    array.markers[1].points[3].y = math.nan
    with pytest.raises(InvalidMessage, match=r'points\.y is nan'):
        validated(array)


def start(bench, **more):
    node = bench.start(
        lambda evidence, options, lens: calibration(evidence, **more),
        camera_height=8.0,
        idle_solve_s=1000.0,
        camera_name='north',
    )
    publisher, number = bench.connected(bench.publisher()), 0

    def step():
        nonlocal number
        number += 1
        publisher.publish(image(1_700_000_000_000_000_000 + number * 100_000_000))
        return node._worker.counters.used

    wait_for(step, 'an image')
    assert bench.calibrate().success
    return node


def test_a_late_joiner_gets_them_and_a_reset_takes_them_away(bench):
    start(bench)
    received = bench.collect(MarkerArray, TOPIC, latched=True)
    array = wait_for(lambda: received, 'markers')[-1]
    assert {marker.header.frame_id for marker in array.markers[1:]} == {'north_ground'}
    bench.ask('reset')
    gone = wait_for(lambda: len(received) > 1 and received[-1], 'the end of the markers')
    assert gone == no_markers()
    late = bench.collect(MarkerArray, TOPIC, latched=True)
    assert wait_for(lambda: late, 'the last message')[-1] == no_markers()


def test_without_a_plane_there_is_nothing_to_see(bench):
    start(bench, height_m=None)
    received = bench.collect(MarkerArray, TOPIC, latched=True)
    assert wait_for(lambda: received, 'the message')[-1] == no_markers()


def test_a_fault_in_the_markers_stops_no_calibration(bench, monkeypatch):
    def broken(*_given):
        raise ValueError('torn')

    monkeypatch.setattr('autocalib_ros.ros.publication.markers', broken)
    node = start(bench)
    assert node.publication.published.markers == no_markers()
