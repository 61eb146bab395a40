"""The place of the ground frame in a map."""

from __future__ import annotations

import types

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from scipy.spatial.transform import Rotation

from autocalib_ros.ground import Ground
from autocalib_ros.results.control_points import ControlPoints, MapPlacement
from autocalib_ros.ros import map_transform
from autocalib_ros.ros.map_transform import MapTransformPublisher, map_transform_message
from stored_results import calibration

STAMP = Time(sec=5, nanosec=7)


class Recorder:
    """A node, its logger and a publisher in one, which keep what they are given."""

    def __init__(self):
        self.messages, self.lines = [], []
        self.info = self.error = self.lines.append
        self.publish = self.messages.append

    def get_logger(self):
        return self


@pytest.fixture
def node(monkeypatch):
    """Return a recorder in the place of the node and of its publishers."""
    recorder = Recorder()
    monkeypatch.setattr(map_transform, 'latched_publisher', lambda *_: recorder)
    monkeypatch.setattr(map_transform, 'TFMessage', None)
    return recorder


def control_points(pixels, places):
    return ControlPoints(tuple(map(str, range(1, 1 + len(pixels)))), np.array(pixels, float), np.array(places, float))


def map_publisher(node, tf_parent='ground', map_frame='map'):
    return MapTransformPublisher(node, map_frame=map_frame, tf_parent=tf_parent, publish_tf=True)


def test_the_message_takes_ground_points_to_the_map():
    placement = MapPlacement('EPSG:32633', 35.0, (412_000.25, 5_655_000.5), 1.0, (), ())
    message = map_transform_message(placement, STAMP, 'map', 'cam1_ground')
    assert (message.header.frame_id, message.child_frame_id, message.header.stamp) == ('map', 'cam1_ground', STAMP)
    turn, shift = message.transform.rotation, message.transform.translation
    ground = np.array([[10.0, -3.0, 0.0], [25.0, 4.0, 0.0]])
    in_map = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply(ground) + [shift.x, shift.y, shift.z]
    assert in_map[:, :2] == pytest.approx(placement.to_map(ground))


def test_a_calibration_is_placed_by_its_control_points(node):
    result = calibration()
    places = np.array([[10.0, -3.0], [18.0, 4.0], [14.0, 1.0]])
    pixels, seen = Ground.of(result).pixels(places)
    assert seen.all()
    points = control_points(pixels, places + [100.0, 200.0])
    map_publisher(node, map_frame='city').publish(result, points, STAMP, 'cam1_ground')
    (message,) = node.messages
    assert (message.transform.translation.x, message.transform.translation.y) == pytest.approx((100.0, 200.0))
    assert message.header.frame_id == 'city' and 'at most 0.00 m off' in node.lines[0]


def test_points_above_the_horizon_are_logged_and_nothing_is_published(node):
    points = control_points([[300, 5], [320, 300]], [[0, 0], [1, 1]])
    map_publisher(node).publish(calibration(), points, STAMP, 'cam1_ground')
    assert not node.messages and 'control points 1 lie above the horizon' in node.lines[0]


def test_points_of_an_earlier_view_place_nothing(node):
    map_publisher(node).publish(calibration(), None, STAMP, 'cam1_ground')
    assert not node.messages and 'pixels of the view before the camera moved' in node.lines[0]


@pytest.mark.parametrize(('tf_parent', 'broadcasts'), [('ground', True), ('camera', False)])
def test_a_ground_below_the_camera_gets_no_second_parent(node, monkeypatch, tf_parent, broadcasts):
    monkeypatch.setattr(map_transform, 'TFMessage', types.SimpleNamespace)
    made = []
    node.create_publisher = lambda *arguments: made.append(arguments) or node
    map_publisher(node, tf_parent)
    assert bool(made) == broadcasts
