"""Output files of a replay, and recordings with the calibration."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from autocalib_ros.errors import UsageError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline import outputs
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.write_bag import camera_info_topic, write_bag

pytestmark = pytest.mark.render

SECOND = 1_000_000_000


def written(path, store):
    """Return tuples (topic, recorded_ns, message) of a bag, and its connections by topic."""
    with AnyReader([path], default_typestore=store) as reader:
        messages = [
            (connection.topic, at, reader.deserialize(raw, connection.msgtype))
            for connection, at, raw in reader.messages()
        ]
        return messages, {connection.topic: connection for connection in reader.connections}


@pytest.fixture
def write_bag_of(request):
    """The fixture that writes recordings, renamed: `write_bag` is the function under test."""
    return request.getfixturevalue('write_bag')


@pytest.fixture
def source(tmp_path, write_bag, images):
    return open_source(write_bag(tmp_path / 'recording', images(4)))


def test_a_calibration_gives_all_files(tmp_path, lens_only, source):
    result = replace(lens_only.result, distortion_model='rational_polynomial', rectified_balance=1.0)
    lens_only = replace(lens_only, background=None, result=result)  # no background saves the time of some figures
    names = outputs.write_outputs(tmp_path, lens_only, source)
    assert names == ['camera_info.yaml', 'calibration.json', 'report.html', 'evidence.npz']
    info = yaml.safe_load((tmp_path / 'camera_info.yaml').read_text())
    assert (info['camera_name'], info['image_width'], info['distortion_model']) == ('cam1', 320, 'rational_polynomial')
    assert info['distortion_coefficients']['data'] == result.camera_info.d
    assert info['projection_matrix']['data'] == result.camera_info.p
    document = json.loads((tmp_path / 'calibration.json').read_text())
    assert (document['state'], document['grade'], document['evidence']['accepted_at_s']) == ('calibrated', 'lens', 30.0)
    assert Evidence.load(tmp_path / 'evidence.npz').track_count == lens_only.evidence.track_count


def test_a_refusal_removes_the_camera_info_of_an_earlier_run(tmp_path, refused, source):
    (tmp_path / 'camera_info.yaml').write_text('from an earlier run')
    assert outputs.write_outputs(tmp_path, refused, source) == ['calibration.json', 'report.html', 'evidence.npz']
    assert not (tmp_path / 'camera_info.yaml').exists()
    document = json.loads((tmp_path / 'calibration.json').read_text())
    assert (document['state'], document['refusal']['code']) == ('refused', 'too_few_tracks')


def test_a_refusal_keeps_an_earlier_calibration_that_was_accepted(tmp_path, monkeypatch, full, refused, source, caplog):
    monkeypatch.setattr('autocalib_ros.report.page.write_report', lambda path, _, process: path.write_text('page'))
    outputs.write_outputs(tmp_path, full, source)
    accepted = {name: (tmp_path / name).read_bytes() for name in ('calibration.json', 'evidence.npz')}
    for _ in range(2):  # a second refusal keeps the calibration, and not the first refusal
        outputs.write_outputs(tmp_path, refused, source)
        assert json.loads((tmp_path / 'calibration.json').read_text())['state'] == 'refused'
        assert {name: (tmp_path / f'{name}.bak').read_bytes() for name in accepted} == accepted
        assert (tmp_path / 'camera_info.yaml.bak').exists() and not (tmp_path / 'camera_info.yaml').exists()
    assert [record.message for record in caplog.records] == [
        f'the earlier calibration in {tmp_path} was accepted and is kept: calibration.json.bak, camera_info.yaml.bak,'
        ' report.html.bak'
    ]


def test_evidence_on_the_way_keeps_that_of_an_accepted_calibration(tmp_path, monkeypatch, full, refused, source):
    monkeypatch.setattr('autocalib_ros.report.page.write_report', lambda path, _, process: path.write_text('page'))
    outputs.write_outputs(tmp_path, full, source)
    accepted = (tmp_path / 'evidence.npz').read_bytes()
    for _ in range(2):  # runs that are killed after two checkpoints
        file = outputs.EvidenceFile(tmp_path)
        for _ in range(2):
            file.write(refused.evidence.since(0.1))
        assert (tmp_path / 'evidence.npz.bak').read_bytes() == accepted
    outputs.write_outputs(tmp_path, full, source)
    assert (tmp_path / 'evidence.npz').read_bytes() == accepted


def test_what_stands_in_the_way_is_wrong_usage(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(UsageError, match='is a file, not a folder'):
        outputs.prepare_output_dir(tmp_path / 'file', None)
    with pytest.raises(UsageError, match='cannot create the folder'):
        outputs.prepare_output_dir(tmp_path / 'file' / 'out', None)
    with pytest.raises(UsageError, match='exists already and is not overwritten'):
        outputs.prepare_output_dir(tmp_path / 'out', tmp_path / 'file')


def test_the_new_bag_holds_images_calibration_and_transforms(tmp_path, full, source, jazzy):
    write_bag(tmp_path / 'new', full.result, source)
    messages, connections = written(tmp_path / 'new', jazzy)
    assert {topic: connection.msgcount for topic, connection in connections.items()} == {
        '/cam1/image_raw': 4,
        '/cam1/camera_info': 4,
        '/autocalib/ground_transform': 1,
        '/tf_static': 1,
    }
    for topic in ('/cam1/camera_info', '/autocalib/ground_transform', '/tf_static'):
        assert connections[topic].ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL
    pairs = zip(
        [m for t, _, m in messages if t == '/cam1/image_raw'],
        [m for t, _, m in messages if t == '/cam1/camera_info'],
        strict=True,
    )
    assert all(image.header == info.header for image, info in pairs)


def test_the_transform_leads_from_camera_to_ground(tmp_path, full, source, jazzy):
    write_bag(tmp_path / 'new', full.result, source)
    messages = {topic: message for topic, _, message in written(tmp_path / 'new', jazzy)[0]}
    transform = messages['/autocalib/ground_transform']
    assert messages['/tf_static'].transforms == [transform]
    assert (transform.header.frame_id, transform.child_frame_id) == ('cam1_ground', 'cam1_optical')
    t, q = transform.transform.translation, transform.transform.rotation
    assert (t.x, t.y, t.z) == (0.0, 0.0, 8.0)
    assert np.array([q.x, q.y, q.z, q.w]) == pytest.approx(full.result.ground.rotation_xyzw)


def test_the_ground_hangs_from_the_camera_where_that_is_asked_for(tmp_path, full, source, jazzy):
    write_bag(tmp_path / 'new', full.result, source, tf_parent='camera')
    messages = {topic: message for topic, _, message in written(tmp_path / 'new', jazzy)[0]}
    transform = messages['/autocalib/ground_transform']
    assert messages['/tf_static'].transforms == [transform]
    assert (transform.header.frame_id, transform.child_frame_id) == ('cam1_optical', 'cam1_ground')
    # the foot of the camera is 8 m along the ground's downward direction, seen from the camera
    t = transform.transform.translation
    assert [t.x, t.y, t.z] == pytest.approx((-8.0 * full.result.ground.normal_in_camera).tolist())


def test_the_camera_info_is_in_the_model_that_is_asked_for(tmp_path, full, source, jazzy):
    asked = replace(full.result, distortion_model='rational_polynomial', rectified_balance=0.5)
    write_bag(tmp_path / 'new', asked, source)
    info = next(message for topic, _, message in written(tmp_path / 'new', jazzy)[0] if topic == '/cam1/camera_info')
    assert (info.distortion_model, info.d.tolist()) == ('rational_polynomial', asked.camera_info.d)
    assert info.p.tolist() == asked.camera_info.p != full.result.camera_info.p


def test_the_camera_info_is_that_of_the_calibration(tmp_path, full, source, jazzy):
    write_bag(tmp_path / 'new', full.result, source)
    info = next(message for topic, _, message in written(tmp_path / 'new', jazzy)[0] if topic == '/cam1/camera_info')
    assert (info.width, info.height, info.distortion_model, len(info.d)) == (320, 180, 'equidistant', 4)
    assert info.k[0] == 140.0
    assert any(info.d)


def test_a_lens_without_ground_gives_no_transform(tmp_path, lens_only, source, jazzy):
    write_bag(tmp_path / 'new', lens_only.result, source)
    assert set(written(tmp_path / 'new', jazzy)[1]) == {'/cam1/image_raw', '/cam1/camera_info'}


def test_images_of_ros1_become_images_of_ros2(tmp_path, full, write_bag1, images, ros1_image, jazzy):
    old = open_source(write_bag1(tmp_path / 'one.bag', images(3, make_one=ros1_image)))
    write_bag(tmp_path / 'new', full.result, old)
    again = open_source(tmp_path / 'new')
    assert [(f.stamp_ns, int(f.image[0, 0])) for f in again.frames()] == [
        (100 * SECOND + index * SECOND // 10, 5 + 10 * index) for index in range(3)
    ]


CORNER = (((0.0, 0.0), (15.0, 0.0), (15.0, 7.0), (0.0, 7.0)),)


@pytest.mark.parametrize('encoding', ['bgr8', 'bayer_grbg8', 'jpeg'])
def test_ignored_regions_are_black_in_the_new_bag(tmp_path, full, write_bag_of, images, jpeg, encoding):
    channels = 3 if encoding == 'bgr8' else 1
    if encoding == 'jpeg':
        messages = images(3, '/cam1/image_raw/compressed', jpeg, begin_ns=103 * SECOND)
    else:
        messages = images(3, encoding=encoding, step=32 * channels, data=np.full(24 * 32 * channels, 100, np.uint8))
    old = open_source(write_bag_of(tmp_path / 'old', messages))
    write_bag(tmp_path / 'new', full.result, old, ignored=CORNER)
    new = open_source(tmp_path / 'new')
    pairs = list(zip(old.frames(), new.frames(), strict=True))
    assert len(pairs) == 3
    for before, after in pairs:
        assert after.stamp_ns == before.stamp_ns
        assert after.image[:7, :15].max() <= 8  # JPEG rings
        np.testing.assert_allclose(after.image[16:].astype(int), before.image[16:], atol=2)  # another block of the JPEG


def test_images_that_cannot_be_made_black_are_not_written(tmp_path, full, write_bag_of, images):
    old = open_source(write_bag_of(tmp_path / 'old', images(3, encoding='h264')))
    with pytest.raises(UsageError, match="'ignore_regions' cannot be made black in images of encoding 'h264'"):
        write_bag(tmp_path / 'new', full.result, old, ignored=CORNER)
    assert not (tmp_path / 'new').exists()


def test_a_broken_image_is_left_out_where_regions_are_ignored(tmp_path, full, write_bag_of, images, caplog):
    messages = images(3)
    messages[1][2].data = np.zeros(5, np.uint8)
    write_bag(tmp_path / 'new', full.result, open_source(write_bag_of(tmp_path / 'old', messages)), ignored=CORNER)
    assert len(list(open_source(tmp_path / 'new').frames())) == 2
    assert '1 images cannot be decoded' in caplog.text


def test_a_video_gives_a_bag_of_calibrations(tmp_path, full, write_video, jazzy):
    write_bag(tmp_path / 'new', full.result, open_source(write_video(tmp_path / 'clip.mp4', count=5)))
    messages, connections = written(tmp_path / 'new', jazzy)
    assert connections['/camera/camera_info'].msgcount == 5
    assert next(m for t, _, m in messages if t == '/tf_static').transforms[0].child_frame_id == 'camera_optical_frame'


def test_an_existing_bag_is_left_alone(tmp_path, full, source):
    (tmp_path / 'new').mkdir()
    (tmp_path / 'new' / 'mine').touch()
    with pytest.raises(UsageError, match='new exists already'):
        write_bag(tmp_path / 'new', full.result, source)
    assert (tmp_path / 'new' / 'mine').exists()


@pytest.mark.parametrize(
    ('topic', 'kind', 'sibling', 'name'),
    [
        ('/cam1/image_raw', 'Image', '/cam1/camera_info', 'cam1'),
        ('/cam1/image_raw/compressed', 'CompressedImage', '/cam1/camera_info', 'cam1'),
        ('/site/cam1/image', 'Image', '/site/cam1/camera_info', 'site_cam1'),
        ('/image', 'Image', '/camera_info', 'optical'),
    ],
)
def test_topics_and_names_follow_the_image_topic(source, topic, kind, sibling, name):
    source.topic, source.image_type, source.camera_frame = topic, f'sensor_msgs/msg/{kind}', 'optical'
    assert camera_info_topic(source) == sibling
    assert outputs.camera_name(source) == name


def test_a_damaged_calibration_is_not_half_written(tmp_path, full, source):
    with pytest.raises(Exception):  # noqa: B017, PT011  whatever it is, nothing may be left
        write_bag(tmp_path / 'new', replace(full.result, newest_stamp_ns=None), source)
    assert not (tmp_path / 'new').exists()
