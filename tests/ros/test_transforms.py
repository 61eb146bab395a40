"""The ground transform on its topic and on /tf_static, with neighbours in processes of their own."""

import importlib.util
import json
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.ros import transforms
from autocalib_ros.ros.messages import InvalidMessage, ground_transform_message, time_message, validated
from autocalib_ros.ros.transforms import conflict, relevant
from bench import ROTATION, Bench, calibration, image, wait_for

GROUND = '/autocalib/ground_transform'
with_tf2 = pytest.mark.skipif(
    importlib.util.find_spec('tf2_msgs') is None,
    reason=('tf2_msgs is not importable, so /tf_static is not tested: tests/tools/tf2_msgs/build.sh VENV compiles it'),
)


@pytest.mark.parametrize(
    'foreign',
    [
        set(),
        {('map', 'cam1_ground')},
        {('cam1_ground', 'cam1')},
        {('cam1', 'lens')},
        {('map', 'pole'), ('pole', 'cam2')},
    ],
)
def test_a_ground_over_the_camera_leaves_a_tree(foreign):
    assert conflict('cam1_ground', 'cam1', foreign, tf_parent='ground') == ''


@pytest.mark.parametrize(
    'foreign',
    [
        set(),
        {('base', 'cam1')},
        {('map', 'base'), ('base', 'cam1')},
        {('cam1', 'cam1_ground')},
        {('cam1_ground', 'site')},
    ],
)
def test_a_ground_under_the_camera_leaves_a_tree(foreign):
    assert conflict('cam1', 'cam1_ground', foreign, tf_parent='camera') == ''


@pytest.mark.parametrize(
    ('foreign', 'tf_parent', 'expected', 'remedy'),
    [
        ({('base', 'cam1')}, 'ground', "'base' as the parent of 'cam1'", "set tf_parent to 'camera'"),
        (
            {('map', 'cam1_ground')},
            'camera',
            "'map' as the parent of 'cam1_ground'",
            "set ground_frame to a unique name, or tf_parent to 'ground'",
        ),
        ({('cam1', 'cam1_ground')}, 'ground', "publishes 'cam1_ground' below 'cam1'", 'set ground_frame'),
        (
            {('cam1', 'a'), ('a', 'b'), ('b', 'cam1_ground')},
            'ground',
            "publishes 'cam1_ground' below 'cam1'",
            'set ground_frame',
        ),
        (
            {('cam1_ground', 'mast'), ('mast', 'cam1')},
            'camera',
            "publishes 'cam1' below 'cam1_ground'",
            'set ground_frame',
        ),
    ],
)
def test_a_second_parent_and_a_loop_are_reported_with_the_parameter_to_set(foreign, tf_parent, expected, remedy):
    edge = ('cam1_ground', 'cam1') if tf_parent == 'ground' else ('cam1', 'cam1_ground')
    text = conflict(*edge, foreign, tf_parent=tf_parent)
    assert expected in text and remedy in text
    assert '\n' not in text


def test_a_tree_of_others_with_a_loop_of_its_own_ends():
    assert conflict('ground', 'cam', {('a', 'b'), ('b', 'a'), ('a', 'ground')}, tf_parent='ground') == ''


def test_of_many_transforms_of_others_those_above_our_frames_are_kept():
    vehicles = {('cam1_ground', f'vehicle_{number}') for number in range(1000)}
    tree = {('map', 'site'), ('site', 'pole'), ('pole', 'cam1')}
    assert relevant('cam1_ground', 'cam1', vehicles | tree) == tree


def test_a_frame_of_others_does_not_break_the_line_of_the_log():
    text = conflict('cam1_ground', 'cam1', {('a\nb\x1b[31m', 'cam1')}, tf_parent='ground')
    assert text.isprintable() and 'publishes' in text


@with_tf2
@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 2**32 - 1),
            st.floats(0.1, 100),
            st.sampled_from(['ground', 'camera']),
            st.integers(0, 2**31 * 10**9 - 1),
        ),
        max_size=4,
    )
)
def test_transforms_of_any_pose_are_valid_and_survive_the_wire(poses):
    from tf2_msgs.msg import TFMessage

    sent = [
        ground_transform_message(
            GroundPlane(Rotation.random(random_state=seed).as_matrix(), height),
            time_message(stamp),
            f'ground{index}',
            f'cam{index}',
            tf_parent,
        )
        for index, (seed, height, tf_parent, stamp) in enumerate(poses)
    ]
    message = validated(TFMessage(transforms=sent))
    assert list(deserialize_message(serialize_message(message), TFMessage).transforms) == sent


@with_tf2
def test_a_list_that_gives_a_frame_two_parents_is_refused():
    from tf2_msgs.msg import TFMessage

    both = [
        ground_transform_message(GroundPlane(ROTATION, 8.0), time_message(1), ground, 'cam')
        for ground in ('north', 'south')
    ]
    with pytest.raises(InvalidMessage, match=r'TFMessage\.transforms give a frame two parents'):
        validated(TFMessage(transforms=both))


@with_tf2
@pytest.mark.parametrize(
    ('name', 'value', 'expected'),
    [
        ('x', float('nan'), r'TFMessage\.transforms.*translation\.x is nan'),
        ('x', 1, r'TFMessage\.transforms.*translation\.x is a int, not a float'),
    ],
)
def test_a_list_with_a_broken_transform_is_refused(name, value, expected):
    from tf2_msgs.msg import TFMessage

    message = TFMessage(
        transforms=[ground_transform_message(GroundPlane(ROTATION, 8.0), time_message(1), 'ground', 'cam')]
    )
    object.__setattr__(message.transforms[0].transform.translation, f'_{name}', value)
    with pytest.raises(InvalidMessage, match=expected):
        validated(message)


@contextmanager
def neighbour(*arguments: str):
    """Run neighbour.py; yield the list of what it has printed so far."""
    command = [sys.executable, str(Path(__file__).with_name('neighbour.py')), *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        heard: list[tuple[str, list]] = []
        reader = threading.Thread(target=lambda: heard.extend(json.loads(line) for line in process.stdout))
        reader.start()
        try:
            yield heard
        finally:
            process.stdin.close()
            process.wait(timeout=30)
            reader.join()


def last(heard: list, topic: str) -> list | None:
    """Return the transforms of the newest message of a topic, None before the first."""
    return next((transforms for name, transforms in reversed(heard) if name == topic), None)


def heights(heard: list, topic: str) -> list[float]:
    return [transform[2][2] for name, transforms in heard if name == topic for transform in transforms]


class Cameras:
    """A node that gets its next calibration, of the next height, whenever it is asked for one."""

    def __init__(self, bench: Bench, *given_heights: float, **parameters):
        left = list(given_heights)
        self.bench = bench
        self.node = bench.start(
            lambda evidence, options, lens: calibration(evidence, height_m=left.pop(0)),
            camera_height=8.0,
            idle_solve_s=1000.0,
            camera_name='north',
            **parameters,
        )
        publisher, stamps = bench.connected(bench.publisher()), iter(range(10**9, 10**13, 10**8))
        wait_for(lambda: publisher.publish(image(next(stamps))) or self.node._worker.counters.used, 'an image')

    def calibrate(self) -> None:
        answer = self.bench.calibrate()
        assert answer.success, answer.message


@with_tf2
def test_late_joiners_and_listeners_have_the_newest_calibration(bench):
    with neighbour('listen') as early:
        cameras = Cameras(bench, 8.0, 9.0)
        cameras.calibrate()
        wait_for(lambda: early and last(early, '/tf_static') and last(early, 'ground_transform'), 'the first')
        assert last(early, '/tf_static') == last(early, 'ground_transform')
        ((parent, child, translation, rotation),) = last(early, '/tf_static')
        assert (parent, child, translation) == ('north_ground', 'cam_optical', [0.0, 0.0, 8.0])
        np.testing.assert_allclose(Rotation.from_quat(rotation).as_matrix(), ROTATION, atol=1e-12)
        with neighbour('listen') as late:
            wait_for(lambda: heights(late, '/tf_static') == heights(late, 'ground_transform') == [8.0], 'the latched')
            cameras.calibrate()
            for heard in (early, late):
                wait_for(
                    lambda heard=heard: (
                        heights(heard, '/tf_static') == heights(heard, 'ground_transform') == [8.0, 9.0]
                    ),
                    'the second calibration',
                )
    with neighbour('listen') as latest:
        wait_for(lambda: heights(latest, '/tf_static') == heights(latest, 'ground_transform') == [9.0], 'the newest')


@with_tf2
@pytest.mark.parametrize('topic', ['/tf_static', '/tf'])
def test_a_camera_that_hangs_elsewhere_gets_no_second_parent(bench, capfd, topic):
    with neighbour('hang', 'cam_optical', 'mast', topic), neighbour('listen') as heard:
        cameras = Cameras(bench, 8.0)
        wait_for(lambda: cameras.node.publication.conflict, 'the conflict, before any calibration')
        cameras.calibrate()
        wait_for(lambda: heights(heard, 'ground_transform') == [8.0], 'the transform on its own topic')
        wait_for(lambda: cameras.node.publication._transforms._listened, 'the time when it would be broadcast')
        assert not any(
            child == 'cam_optical' and parent != 'mast'
            for name, found in heard
            if name == '/tf_static'
            for parent, child, *_ in found
        )
    assert "'mast' as the parent of 'cam_optical'" in cameras.node.publication.conflict
    assert capfd.readouterr().err.count("set tf_parent to 'camera'") == 1


@with_tf2
def test_a_ground_under_a_camera_that_hangs_elsewhere_is_broadcast(bench):
    with neighbour('hang', 'cam_optical', 'mast', '/tf_static'), neighbour('listen') as heard:
        Cameras(bench, 8.0, tf_parent='camera').calibrate()
        wait_for(lambda: last(heard, '/tf_static') == last(heard, 'ground_transform') is not None, 'the transform')
        ((parent, child, translation, rotation),) = last(heard, '/tf_static')
    assert (parent, child) == ('cam_optical', 'north_ground')
    # the camera looks along the road: its foot is 8 m down, which is its y
    np.testing.assert_allclose(translation, [0.0, 8.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(rotation).as_matrix(), ROTATION.T, atol=1e-12)


@with_tf2
def test_a_parent_that_comes_later_takes_the_transform_off_the_air(bench):
    cameras = Cameras(bench, 8.0, 9.0)
    cameras.calibrate()
    wait_for(lambda: cameras.node.publication._transforms._broadcasting, 'the broadcast')
    with neighbour('hang', 'cam_optical', 'mast', '/tf'):
        wait_for(lambda: cameras.node.publication.conflict, 'the conflict')
        cameras.calibrate()
        with neighbour('listen') as late:
            wait_for(lambda: last(late, 'ground_transform') and last(late, '/tf_static') == [], 'an empty list')
            assert heights(late, 'ground_transform') == [9.0]


@with_tf2
def test_nothing_is_published_on_tf_where_that_is_not_wanted(bench, capfd):
    received = bench.collect(TransformStamped, GROUND, latched=True)
    Cameras(bench, 8.0, publish_tf=False).calibrate()
    wait_for(lambda: received, 'the transform on its own topic')
    assert bench.client.count_publishers('/tf_static') == 0
    assert 'tf2_msgs' not in capfd.readouterr().err


def test_without_tf2_msgs_the_transform_has_its_own_topic_and_one_warning(bench, capfd, monkeypatch):
    monkeypatch.setattr(transforms, 'TFMessage', None)
    received = bench.collect(TransformStamped, GROUND, latched=True)
    cameras = Cameras(bench, 8.0, 9.0)
    cameras.calibrate()
    cameras.calibrate()
    wait_for(lambda: [message.transform.translation.z for message in received][-1:] == [9.0], 'the transform')
    assert bench.client.count_publishers('/tf_static') == 0
    assert capfd.readouterr().err.count('tf2_msgs is not installed') == 1
