"""ROS 2 parameter files, and assignments on the command line."""

from __future__ import annotations

import pytest

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.parameter_file import camera_info_file, override_options, parse_assignments, read_params_file


def options_from(tmp_path, text: str) -> Options:
    path = tmp_path / 'params.yaml'
    path.write_text(text)
    return override_options(Options(), read_params_file(path))


def test_nested_names_are_read(tmp_path):
    options = options_from(tmp_path, '/**:\n  ros__parameters:\n    camera_height: 8\n    tracking: {max_points: 99}\n')
    assert options.camera_height == 8.0
    assert options.tracking.max_points == 99


@pytest.mark.parametrize('name', ['autocalib', '/cam1/autocalib', '/**', '/*', 'whatever'])
def test_any_name_of_a_single_node_serves(tmp_path, name):
    assert options_from(tmp_path, f'{name}: {{ros__parameters: {{camera_height: 8.0}}}}').camera_height == 8.0


def test_a_nested_namespace_serves(tmp_path):
    text = 'cam1: {autocalib: {ros__parameters: {camera_height: 8.0}}}'
    assert options_from(tmp_path, text).camera_height == 8.0


def test_the_named_node_overrides_the_wildcard(tmp_path):
    text = (
        'autocalib: {ros__parameters: {camera_height: 9.0}}\n'
        '/**: {ros__parameters: {camera_height: 8.0, random_seed: 3}}'
    )
    options = options_from(tmp_path, text)
    assert (options.camera_height, options.random_seed) == (9.0, 3)


def test_other_nodes_in_the_file_are_left_alone(tmp_path):
    text = 'driver: {ros__parameters: {fps: 30}}\nautocalib: {ros__parameters: {camera_height: 8.0}}'
    assert options_from(tmp_path, text).camera_height == 8.0


def test_two_cameras_in_one_file_are_wrong_usage(tmp_path):
    text = 'a: {autocalib: {ros__parameters: {}}}\nb: {autocalib: {ros__parameters: {}}}'
    with pytest.raises(UsageError, match='several nodes: /a/autocalib, /b/autocalib'):
        options_from(tmp_path, text)


def test_names_of_the_live_node_and_of_ros_are_ignored(tmp_path):
    text = (
        '/**: {ros__parameters: {image_transport: raw, camera_name: cam1, use_sim_time: true, camera_height: 8.0,'
        ' qos_overrides: {/tf: {publisher: {depth: 3}}}}}'
    )
    assert options_from(tmp_path, text) == Options(camera_height=8.0)


def test_the_lens_that_the_live_node_is_given_is_found(tmp_path):
    path = tmp_path / 'params.yaml'
    path.write_text('/**: {ros__parameters: {camera_info_file: /etc/north.yaml, camera_height: 8.0}}')
    assert camera_info_file(path) == '/etc/north.yaml'
    path.write_text('/**: {ros__parameters: {camera_height: 8.0}}')
    assert camera_info_file(path) == ''


def test_a_lens_that_is_no_file_name_is_wrong_usage(tmp_path):
    path = tmp_path / 'params.yaml'
    path.write_text('/**: {ros__parameters: {camera_info_file: 3}}')
    with pytest.raises(UsageError, match="'camera_info_file' takes a str, got 3"):
        camera_info_file(path)


def test_an_unknown_name_is_an_error_with_a_hint(tmp_path):
    with pytest.raises(UsageError, match="unknown option 'camera_hight'; did you mean 'camera_height'"):
        options_from(tmp_path, '/**: {ros__parameters: {camera_hight: 8.0}}')


def test_a_float_that_yaml_takes_for_text_is_read(tmp_path):
    options = options_from(tmp_path, '/**: {ros__parameters: {motion: {min_area: 1e-05}}}')
    assert options.motion.min_area == 1e-5


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', "has no 'ros__parameters'"),
        ('camera_height: 8.0', "has no 'ros__parameters'"),
        ('[1, 2]', 'has no'),
        ('{', 'is not YAML'),
        ('/**: {ros__parameters: {camera_height: high}}', "takes a float, got 'high'"),
        ('/**: {ros__parameters: {tracking: 3}}', "unknown option 'tracking'"),
    ],
)
def test_a_broken_file_is_one_clear_line(tmp_path, text, message):
    with pytest.raises((InputError, UsageError), match=message) as raised:
        options_from(tmp_path, text)
    assert '\n' not in str(raised.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r'cannot read .*nowhere\.yaml: No such file'):
        read_params_file(tmp_path / 'nowhere.yaml')


@pytest.mark.parametrize('text', ['joint.noise_px=0.25', 'joint.noise_px:=0.25', 'joint.noise_px=25e-2'])
def test_assignments_are_read(text):
    assert override_options(Options(), parse_assignments([text])).joint.noise_px == 0.25


@pytest.mark.parametrize('text', ['noise', '=3', 'a=[1'])
def test_a_malformed_assignment_is_wrong_usage(text):
    with pytest.raises(UsageError, match='-p '):
        parse_assignments([text])


def test_a_distance_stands_in_a_file_as_text(tmp_path):
    options = options_from(
        tmp_path,
        "/**: {ros__parameters: {scale_from: distance, scale: {distance_px: '412 530 888 530', distance_m: 12}}}",
    )
    assert options.scale.pixels == ((412.0, 530.0), (888.0, 530.0)) and options.scale.distance_m == 12.0


def test_a_distance_is_assigned_on_the_command_line():
    values = parse_assignments(['scale_from=distance', 'scale.distance_px=412 530 888 530', 'scale.distance_m:=12'])
    assert override_options(Options(), values).scale.pixels == ((412.0, 530.0), (888.0, 530.0))
