"""Stamps of the CameraInfo at a new solution."""

from __future__ import annotations

import types

import pytest
from builtin_interfaces.msg import Time

from autocalib_ros.ros.publication import CalibrationPublisher

EVIDENCE = types.SimpleNamespace(result=types.SimpleNamespace(newest_stamp_ns=100 * 10**9))


@pytest.mark.parametrize(
    ('image_s', 'per_image', 'expected'), [(101, True, 101), (99, True, None), (101, False, None), (None, True, None)]
)
def test_a_new_solution_takes_no_stamp_before_that_of_the_newest_image(image_s, per_image, expected):
    """A solution takes seconds, in which images had their CameraInfo: that of its evidence would step back."""
    stamp = None if image_s is None else Time(sec=image_s)
    publisher = types.SimpleNamespace(_image_stamp=stamp, _per_image=per_image)
    later = CalibrationPublisher._later_stamp(publisher, EVIDENCE)
    assert (None if later is None else later.sec) == expected
