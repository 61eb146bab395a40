"""Headers as drivers really send them."""

import pytest
from builtin_interfaces.msg import Time

from autocalib_ros.config import NodeOptions
from autocalib_ros.ros.headers import Headers


@pytest.fixture
def warnings() -> list[str]:
    return []


def headers(warnings: list[str], namespace: str = '/', **options) -> Headers:
    return Headers(NodeOptions(**options), namespace, warnings.append, lambda: 42)


def test_good_header_is_kept_without_a_warning(warnings):
    read = headers(warnings)
    assert read.stamp_ns(Time(sec=3, nanosec=7)) == 3_000_000_007
    assert read.frame_id('cam_optical') == 'cam_optical'
    assert not warnings


def test_zero_stamp_becomes_the_time_of_receipt_with_one_warning(warnings):
    read = headers(warnings)
    assert [read.stamp_ns(Time()), read.stamp_ns(Time())] == [42, 42]
    assert len(warnings) == 1


def test_empty_frame_becomes_the_default_with_one_warning(warnings):
    read = headers(warnings)
    assert [read.frame_id(''), read.frame_id('')] == ['camera_optical_frame', 'camera_optical_frame']
    assert len(warnings) == 1


def test_empty_frame_becomes_the_frame_that_was_set(warnings):
    assert headers(warnings, camera_frame='north').frame_id('') == 'north'


def test_leading_slash_is_left_out_with_one_warning(warnings):
    read = headers(warnings)
    assert [read.frame_id('/cam'), read.frame_id('/cam')] == ['cam', 'cam']
    assert len(warnings) == 1


@pytest.mark.parametrize(
    ('namespace', 'options', 'ground'),
    [
        ('/', {}, 'cam_1_optical_ground'),
        ('/site/cam1', {}, 'site_cam1_ground'),
        ('/cam1', {'camera_name': 'north pole'}, 'north_pole_ground'),
        ('/cam1', {'ground_frame': 'road'}, 'road'),
    ],
)
def test_ground_frame_holds_the_name_of_the_camera(warnings, namespace, options, ground):
    assert headers(warnings, namespace, **options).ground_frame('cam-1/optical') == ground


@pytest.mark.parametrize(('given', 'frame'), [('cam\n\x1b[31m', 'cam__[31m'), (300 * 'x', 255 * 'x')])
def test_frame_that_cannot_be_shown_is_cleaned_with_one_warning(warnings, given, frame):
    read = headers(warnings)
    assert [read.frame_id(given), read.frame_id(given)] == [frame, frame]
    assert len(warnings) == 1
    assert warnings[0].isprintable()


def test_frames_without_end_do_not_fill_the_log(warnings):
    read = headers(warnings)
    for number in range(100):
        read.frame_id(f'/cam{number}')
    assert len(warnings) == 20
