"""The store: interrupted writes, corrupt files, and files of other programs."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.lens.camera_info_yaml import camera_info_yaml, read_camera_info
from autocalib_ros.results.given_pixels import GivenPixels
from autocalib_ros.results.store import Store, StoreState, resolve_url, stored_json
from stored_results import calibration, lens_only, stored

KILLS = 30
FIRST, SECOND, THIRD = (stored(calibration(focal, number=number)) for number, focal in enumerate((300.0, 310.0, 320.0)))
CHECKERBOARD = camera_info_yaml(stored(calibration(444.0)).info, 'north')


@pytest.fixture
def store(quick_path) -> Store:
    return Store(quick_path / 'camera_info' / 'north.yaml')


def number_of(found) -> int:
    return found.stored.calibration.evidence.frames


@pytest.mark.parametrize(
    ('url', 'path'),
    [
        ('', '/ros/camera_info/cam_1.yaml'),
        ('file:///etc/${NAME}/lens.yaml', '/etc/cam_1/lens.yaml'),
        ('FILE:///lens.yaml', '/lens.yaml'),
        ('file://${ROS_HOME}/x.yaml', '/ros/x.yaml'),
        ('package://some_robot/config/${NAME}.yaml', '{share}/config/cam_1.yaml'),
    ],
)
def test_url_names_a_file_as_camera_info_manager_reads_it(quick_path, url, path):
    marker = quick_path / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'some_robot'
    marker.parent.mkdir(parents=True)
    marker.touch()
    environment = {'ROS_HOME': '/ros', 'AMENT_PREFIX_PATH': f'/nowhere:{quick_path}'}
    share = quick_path / 'share' / 'some_robot'
    assert resolve_url(url, 'cam_1', environment) == Path(path.format(share=share))


def test_default_folder_is_in_the_home_without_ros_home():
    assert resolve_url('', 'cam', {'HOME': '/home/ann'}) == Path('/home/ann/.ros/camera_info/cam.yaml')


@pytest.mark.parametrize(
    ('url', 'expected'),
    [
        ('/etc/lens.yaml', 'write file:///FOLDER/FILE.yaml'),
        ('file://lens.yaml', 'names no file'),
        ('file:///folder/', 'names no file'),
        ('http://host/x.yaml', 'names no file'),
        ('package://x', 'names no file'),
        ('file:///${CAMERA}.yaml', r'contains \$\{CAMERA\}: only'),
        ('package://no_such/x.yaml', "package 'no_such'"),
    ],
)
def test_url_that_names_no_file_is_wrong_usage(url, expected):
    with pytest.raises(UsageError, match=expected):
        resolve_url(url, 'cam', {'HOME': '/home/ann'})


def test_nothing_is_found_where_nothing_was_saved(store):
    assert (store.load().state, store.load().note) == (StoreState.EMPTY, '')


@pytest.mark.parametrize('kept', [FIRST, replace(FIRST, calibration=lens_only(FIRST.calibration))])
def test_what_was_saved_comes_back_to_the_last_bit(store, kept):
    store.save(kept)
    found = store.load()
    assert (found.state, found.note) == (StoreState.INTACT, '')
    assert stored_json(found.stored) == stored_json(kept)
    assert (found.stored.camera_name, found.stored.image_frame) == ('north', 'cam_optical')


def test_pixels_that_were_given_come_back_and_damaged_ones_are_refused(store):
    pixels = GivenPixels(np.array([[100.0, 200.0], [300.0, 210.0]]), np.array([[104.5, 198.0], [np.nan, np.nan]]), 0.3)
    store.save(replace(FIRST, given_pixels=pixels))
    found = store.load().stored.given_pixels
    assert found.document() == pixels.document()
    store.json_path.write_text(stored_json(replace(FIRST, given_pixels=replace(pixels, sigma_px=-1.0))))
    assert 'given_pixels are damaged' in store.load().note


def test_yaml_is_the_lens_for_camera_info_manager(store):
    store.save(FIRST)
    assert read_camera_info(store.path) == FIRST.calibration.camera
    assert yaml.safe_load(store.path.read_text())['camera_name'] == 'north'


def test_version_before_is_kept(store):
    for kept in (FIRST, SECOND, THIRD):
        store.save(kept)
    for path in (store.path, store.json_path):
        path.write_bytes(path.with_name(path.name + '.bak').read_bytes())
    assert number_of(store.load()) == 1


def test_pair_that_a_kill_tore_gives_the_calibration_before(store):
    store.save(FIRST)
    before = store.path.read_bytes()
    store.save(SECOND)
    store.path.write_bytes(before)
    found = store.load()
    assert (found.state, number_of(found)) == (StoreState.INTERRUPTED, 0)
    assert 'interrupted write' in found.note
    store.save(THIRD)
    assert (store.load().state, number_of(store.load())) == (StoreState.INTACT, 2)


def test_what_killed_writers_left_is_removed(store):
    store.save(FIRST)
    left = store.path.with_name(f'.{store.path.name}~abcd1234')
    left.write_text('half a li')
    another = store.path.with_name('.another.yaml~abcd1234')
    another.touch()
    store.remove_leftovers()
    assert not left.exists() and another.exists()


@pytest.mark.dds
def test_files_are_never_broken_whenever_the_writer_is_killed(quick_path):
    script = Path(__file__).parents[1] / 'helpers' / 'kill_saves.py'
    done = subprocess.run(
        [sys.executable, str(script), str(quick_path), str(KILLS)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, 'PYTHONPATH': str(Path(__file__).parents[2])},
    )
    assert done.returncode == 0, done.stderr
    kills, saves = map(int, re.findall(r'\d+', done.stdout)[:2])
    assert kills == KILLS
    assert saves > 10, 'hardly a save in all those lives: the kills hit nothing'


@pytest.mark.parametrize('broken', ['', 'image_width: [', 'image_width: 640\n', 'camera_name: north\n', '\x00\x01'])
def test_broken_yaml_gives_the_pair_before_and_is_told(store, broken):
    store.save(FIRST)
    store.save(SECOND)
    store.path.write_text(broken)
    found = store.load()
    assert (found.state, number_of(found)) == (StoreState.CORRUPT, 0)
    assert str(store.path) in found.note and 'using the previous pair' in found.note
    store.save(THIRD)
    assert number_of(store.load()) == 2


@pytest.mark.parametrize('broken', ['', '{"version": 1', '[]', '{"version": 1, "state": "calibrated"}'])
def test_broken_json_gives_the_previous_pair_and_is_reported(store, broken):
    store.save(FIRST)
    store.save(SECOND)
    store.json_path.write_text(broken)
    found = store.load()
    assert (found.state, number_of(found)) == (StoreState.CORRUPT, 0)
    assert str(store.json_path) in found.note


def test_broken_file_without_a_pair_before_is_reported(store):
    store.save(FIRST)
    store.json_path.write_text('{')
    assert store.load().stored is None
    assert str(store.json_path) in store.load().note and 'nothing is restored' in store.load().note


def test_removed_yaml_means_that_nothing_is_kept(store):
    store.save(FIRST)
    store.save(SECOND)
    store.path.unlink()
    assert (store.load().state, store.load().stored) == (StoreState.EMPTY, None)
    assert 'is missing' in store.load().note


def test_yaml_that_a_driver_wrote_of_our_numbers_with_fewer_digits_is_ours(store):
    store.save(FIRST)
    rounded = re.sub(
        r'\d+\.\d+',
        lambda match: f'{float(match[0]):.10g}' if '.' in f'{float(match[0]):.10g}' else match[0],
        store.path.read_text(),
    )
    assert rounded != store.path.read_text()
    store.path.write_text(rounded)
    assert store.load().state is StoreState.INTACT


@pytest.mark.parametrize('ours_before', [False, True])
def test_yaml_of_another_program_is_not_taken_for_ours_and_left_alone(store, ours_before):
    store.path.parent.mkdir()
    if ours_before:
        store.save(FIRST)
        store.save(SECOND)
    store.path.write_text(CHECKERBOARD)
    found = store.load()
    assert (found.state, found.stored) == (StoreState.FOREIGN, None)
    assert 'was not written by this node, or changed since' in found.note
    with pytest.raises(InputError, match='not overwritten: call ~/save'):
        store.save(THIRD)
    assert store.path.read_text() == CHECKERBOARD


def test_yaml_of_another_program_is_kept_when_it_is_replaced(store):
    store.path.parent.mkdir()
    store.path.write_text(CHECKERBOARD)
    store.save(FIRST, replace_foreign=True)
    for kept in (SECOND, THIRD):
        store.save(kept)
    assert store.path.with_name('north.yaml.orig').read_text() == CHECKERBOARD
    assert number_of(store.load()) == 2


def test_second_yaml_of_another_program_is_not_lost(store):
    store.path.parent.mkdir()
    store.path.write_text(CHECKERBOARD)
    store.save(FIRST, replace_foreign=True)
    store.path.write_text(CHECKERBOARD.replace('north', 'south').replace('444', '445'))
    with pytest.raises(InputError, match='move one of them away'):
        store.save(SECOND, replace_foreign=True)


def test_folder_that_cannot_be_made_is_reported(quick_path):
    (quick_path / 'file').touch()
    blocked = Store(quick_path / 'file' / 'north.yaml')
    assert blocked.load().state is StoreState.EMPTY
    with pytest.raises(InputError, match=f'cannot write {quick_path}/file/north.autocalib.json'):
        blocked.save(FIRST)


def test_full_disk_leaves_what_was_there(store, monkeypatch):
    store.save(FIRST)
    store.save(SECOND)

    def full(handle):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('autocalib_ros.util.files.os.fsync', full)
    with pytest.raises(InputError, match='No space left on device'):
        store.save(THIRD)
    monkeypatch.undo()
    assert (store.load().state, number_of(store.load())) == (StoreState.INTACT, 1)
    assert len(list(store.path.parent.iterdir())) == 4


@pytest.mark.parametrize(
    ('path', 'value'),
    [
        (('camera', 'focal_px'), 77.0),
        (('ground_from_camera', 'translation_m'), [0.0, 0.0, 9.0]),
        (('stddev', 'tilt_deg'), 0.01),
        (('stored', 'image_frame'), 'another'),
        (('newest_stamp_ns',), 5),
    ],
)
def test_any_change_of_what_is_published_is_noticed(store, path, value):
    store.save(FIRST)
    document = json.loads(store.json_path.read_text())
    inner = document
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    store.json_path.write_text(json.dumps(document))
    found = store.load()
    assert found.stored is None
    assert 'checksum' in found.note


@pytest.mark.parametrize(
    ('path', 'value', 'expected'),
    [
        (('camera', 'focal_px'), 77.0, 'its camera is not that of its camera_info'),
        (('camera', 'principal_point_px'), [1e9, 0.0], 'its camera is not that'),
        (('stddev', 'focal_px'), -1.0, 'standard deviation is negative'),
        (('newest_stamp_ns',), -5, 'its stamp or its grade'),
        (('grade',), '<script>', 'its stamp or its grade'),
        (('stored', 'image_frame'), 'cam\x00', 'cannot be printed'),
        (('stored', 'image_frame'), '\ud800', 'half a character'),
        (('stored', 'camera_info', 'k'), [10**400, 0, 0, 0, 1, 0, 0, 0, 1], 'camera_info'),
    ],
)
def test_nonsense_in_a_file_without_a_checksum_is_not_restored(store, path, value, expected):
    store.save(FIRST)
    document = json.loads(store.json_path.read_text())
    del document['checksum']
    inner = document
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    store.json_path.write_text(json.dumps(document))
    found = store.load()
    assert found.stored is None
    assert expected in found.note
