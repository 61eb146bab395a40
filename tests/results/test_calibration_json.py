"""Reading returns what was written."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from autocalib_ros.errors import InputError
from autocalib_ros.results.calibration import Refusal
from autocalib_ros.results.calibration_json import calibration_from_json, calibration_json, read_json_object, to_json
from autocalib_ros.results.grades import HelpfulMeasure
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import SCALE_KINDS
from stored_results import calibration, lens_only

WHOLE = calibration()
CASES = {
    'whole': WHOLE,
    'lens only': replace(lens_only(WHOLE), ground_refusal=Reason('no_height', 'none given', 'give it'), paper=None),
    'unit scale': replace(WHOLE, grade='unit_scale', ground=replace(WHOLE.ground, height_m=1.0, metric=False)),
    'helpful measure': replace(WHOLE, grade='fair', helpful=HelpfulMeasure('focal', 0.04)),
    'squeezed pixels': replace(WHOLE, camera=replace(WHOLE.camera, pixel_aspect=64 / 45, skew=0.001)),
    'no roads, no deviations': replace(
        lens_only(WHOLE),
        road_directions=np.zeros((0, 3)),
        stddev=replace(lens_only(WHOLE).stddev, principal_point_px=None, k2=None),
    ),
}


def test_whole_case_leaves_no_field_of_a_calibration_untested():
    unset = [item.name for item in fields(WHOLE) if getattr(WHOLE, item.name) is None]
    # nothing helps a calibration of grade full: the case 'helpful measure'
    assert unset == ['ground_refusal', 'helpful']  # the first goes with no ground plane: the case 'lens only'


@pytest.mark.parametrize('name', CASES)
def test_text_of_a_calibration_that_was_read_is_the_text_that_was_written(name):
    text = calibration_json(CASES[name])
    assert calibration_json(calibration_from_json(json.loads(text))) == text


@pytest.mark.parametrize('name', CASES)
def test_every_field_survives_to_the_last_bit(name):
    again = calibration_from_json(json.loads(calibration_json(CASES[name])))
    for item in fields(again):
        if item.name not in ('figures', 'ground', 'road_directions', 'covariance'):
            assert getattr(again, item.name) == getattr(CASES[name], item.name), item.name
    np.testing.assert_array_equal(again.road_directions, CASES[name].road_directions)
    np.testing.assert_array_equal(again.covariance, CASES[name].covariance)
    if again.ground is None:
        assert CASES[name].ground is None
    else:
        np.testing.assert_array_equal(again.ground.rotation, CASES[name].ground.rotation)
        assert again.ground.rotation_xyzw.tolist() == CASES[name].ground.rotation_xyzw.tolist()
        assert (again.ground.height_m, again.ground.metric) == (CASES[name].ground.height_m, CASES[name].ground.metric)


def test_a_file_from_before_pixels_had_a_shape_has_square_ones():
    document = json.loads(calibration_json(WHOLE))
    lens = {name: value for name, value in document['camera'].items() if name not in ('pixel_aspect', 'skew')}
    assert calibration_from_json({**document, 'camera': lens}).camera == WHOLE.camera


def broken(**changes) -> dict:
    return {**json.loads(calibration_json(WHOLE)), **changes}


POSE = broken()['ground_from_camera']


@pytest.mark.parametrize(
    ('document', 'expected'),
    [
        (broken(version=4), 'version is 4; versions 1 to 3 can be read'),
        (broken(assumptions=[{'kind': 'a', 'text': 'b', 'values': [1]}]), 'numbers, texts or null were expected'),
        (broken(checks=[{'kind': 'a', 'text': 'b', 'values': {'c': [1]}}]), 'numbers, texts or null were expected'),
        (broken(state='refused'), "state is 'refused'"),
        (broken(camera=None), 'no whole calibration.json'),
        (broken(image_size=[640]), 'not 2 numbers'),
        (broken(newest_stamp_ns=None), 'no whole calibration.json'),
        (broken(camera={**broken()['camera'], 'focal_px': -1.0}), 'positive focal length'),
        (broken(ground_from_camera={**POSE, 'rotation': np.diag([1.0, 1.0, 1.1]).tolist()}), 'rotation is none'),
        (broken(ground_from_camera={**POSE, 'rotation': np.diag([1.0, 1.0, -1.0]).tolist()}), 'rotation is none'),
        (broken(ground_from_camera={**POSE, 'translation_m': [0.0, 0.0, -8.0]}), 'above the road'),
    ],
)
def test_document_that_cannot_be_used_gives_the_reason(document, expected):
    with pytest.raises(InputError, match=expected):
        calibration_from_json(document)


def test_a_file_of_version_1_keeps_its_texts_and_the_source_of_its_scale():
    old = to_json(WHOLE) | {'version': 1, 'assumptions': ['square pixels', 'scale by 10 m (given)'], 'checks': ['fine']}
    found = calibration_from_json(json.loads(json.dumps(old)))
    assert [statement.text for statement in found.assumptions] == ['square pixels', 'scale by 10 m (given)']
    assert [statement.kind in SCALE_KINDS for statement in found.assumptions] == [False, True]
    assert [statement.kind for statement in found.checks] == ['unknown']
    assert found.camera == WHOLE.camera and found.stddev == WHOLE.stddev


def test_refusal_is_no_calibration():
    refusal = Refusal(code='no_motion', message='nothing', remedy='wait', method='joint', evidence=WHOLE.evidence)
    with pytest.raises(InputError, match='holds no calibration'):
        calibration_from_json(json.loads(calibration_json(refusal)))


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('', 'not JSON'),
        ('{"version": 1', 'not JSON'),
        ('[]', 'no names with values'),
        ('{"a": NaN}', 'NaN is no number'),
        ('[' * 100_000, 'not JSON'),
        (' ' * 1_000_001, 'longer than'),
        ('\x00\xff', 'not JSON'),
    ],
)
def test_file_that_is_no_calibration_gives_the_reason(tmp_path, text, expected):
    path = tmp_path / 'c.json'
    path.write_bytes(text.encode('latin-1'))
    with pytest.raises(InputError, match=expected):
        read_json_object(path)
