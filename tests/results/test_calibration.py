"""Results as values, and the files that are made of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autocalib_ros.geometry.ground_plane import GroundPlane, quaternion_xyzw
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, EvidenceSummary, Refusal, StandardDeviations
from autocalib_ros.results.calibration_json import to_json, write_calibration_json
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import assumption

CAMERA = Camera(1280, 720, 560.0, (639.5, 359.5))
EVIDENCE = EvidenceSummary(
    image_size=(1280, 720), seconds=60.0, frames=900, tracks=300, segments=4000, vehicles=70, coverage=0.6
)


def calibration(ground: GroundPlane | None) -> Calibration:
    return Calibration(
        method='joint',
        grade='full',
        assumptions=(assumption('paper_roads'),),
        camera=CAMERA,
        ground=ground,
        ground_refusal=None,
        road_directions=np.eye(3)[:2],
        stddev=StandardDeviations(focal_px=5.0, tilt_deg=0.3),
        paper=None,
        evidence=EVIDENCE,
        newest_stamp_ns=1,
    )


def test_a_refusal_is_false_and_a_calibration_true() -> None:
    refusal = Refusal(code='no_motion', message='nothing', remedy='wait', method='joint', evidence=EVIDENCE)
    assert not refusal
    assert calibration(None)


def test_json_of_a_refusal_keeps_code_message_and_remedy() -> None:
    refusal = Refusal(code='no_motion', message='nothing', remedy='wait', method='joint', evidence=EVIDENCE)
    document = to_json(refusal)
    assert document['state'] == 'refused' and document['camera'] is None
    assert document['refusal'] == {'code': 'no_motion', 'message': 'nothing', 'remedy': 'wait', 'values': {}}


def test_json_gives_the_reason_a_calibrated_lens_has_no_plane() -> None:
    from dataclasses import replace

    result = replace(calibration(None), grade='lens', ground_refusal=Reason('no_height', 'none given', 'give it'))
    document = to_json(result)
    assert document['state'] == 'calibrated' and document['ground_from_camera'] is None
    assert document['refusal']['code'] == 'no_height'


def test_the_pose_survives_its_file(tmp_path: Path) -> None:
    rotation = np.array([[0.0, -0.5, np.sqrt(0.75)], [-1.0, 0.0, 0.0], [0.0, -np.sqrt(0.75), -0.5]])
    write_calibration_json(tmp_path / 'c.json', calibration(GroundPlane(rotation, 7.5)), accepted_at_s=20.0)
    pose = json.loads((tmp_path / 'c.json').read_text())['ground_from_camera']
    assert pose['translation_m'] == [0.0, 0.0, 7.5]
    np.testing.assert_allclose(pose['rotation_xyzw'], quaternion_xyzw(rotation), atol=0)


@pytest.mark.parametrize('seed', range(5))
def test_both_ends_of_the_transform_tell_the_same_pose(seed: int) -> None:
    ground = GroundPlane(Rotation.random(random_state=seed).as_matrix(), 7.5)
    down, up = (ground.transform('ground', 'cam', parent) for parent in ('ground', 'camera'))
    assert (down.parent, down.child, up.parent, up.child) == ('ground', 'cam', 'cam', 'ground')
    points = np.random.default_rng(seed).normal(0, 20, (50, 3))
    in_ground = Rotation.from_quat(down.rotation_xyzw).apply(points) + down.translation_m
    np.testing.assert_allclose(in_ground, points @ ground.rotation.T + [0, 0, 7.5], atol=1e-12)
    back = Rotation.from_quat(up.rotation_xyzw).apply(in_ground) + up.translation_m
    np.testing.assert_allclose(back, points, atol=1e-12)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / 'c.json'
    write_calibration_json(path, calibration(None))
    before = path.read_text()
    broken = calibration(GroundPlane(np.eye(3), float('nan')))
    with pytest.raises(ValueError, match='JSON'):
        write_calibration_json(path, broken)
    assert path.read_text() == before and len(list(tmp_path.iterdir())) == 1
