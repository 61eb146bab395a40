"""What is told at the start of the node."""

from __future__ import annotations

import pytest

from autocalib_ros.config import LaneOptions, Options, ScaleOptions
from autocalib_ros.ros import ground_points_node, node
from autocalib_ros.ros.start_hints import missing_scale, unused_params_files, with_hint


@pytest.mark.parametrize(
    ('text', 'hint'),
    [
        (
            "Couldn't parse params file: '--params-file p.yaml'. Error: Cannot have a value before ros__parameters",
            'two',
        ),
        ("Couldn't parse remap rule: '-r image'. Error: Expected lexeme type (19) not found", 'from:=to'),
        ("Couldn't parse parameter override rule: '-p a'. Error: Expected lexeme type (19)", 'name:=value'),
    ],
)
def test_errors_of_rcl_get_a_hint(text, hint):
    assert with_hint(text).startswith(text) and hint in with_hint(text)


def test_other_errors_stay_as_they_are():
    assert with_hint('something else') == 'something else'


def test_a_missing_scale_is_told_and_a_given_one_is_not():
    assert 'no camera height is given' in missing_scale(Options())
    for options in (
        Options(camera_height=8.0),
        Options(scale=ScaleOptions(distances='1 2 300 4 5')),
        Options(scale=ScaleOptions(speed_km_h=50.0)),
        Options(lanes=LaneOptions(country='us')),
        Options(allow_unit_scale=True),
    ):
        assert not missing_scale(options)


@pytest.mark.parametrize(
    ('names', 'used'),
    [
        ('/**', True),
        ('/cam1/autocalib', True),
        ('/cam1/*', True),
        ('/*/autocalib', True),
        ('cam1: {autocalib', True),
        ('other_node', False),
        ('autocalib', False),
        ('/cam2/autocalib', False),
    ],
)
def test_a_parameter_file_for_other_nodes_is_told(tmp_path, names, used):
    file = tmp_path / 'p.yaml'
    file.write_text(f'{names}: {{ros__parameters: {{camera_height: 8.0}}}}' + '}' * names.count('{'))
    warnings = unused_params_files(['node', '--ros-args', '--params-file', str(file)], '/cam1/autocalib')
    assert bool(warnings) != used
    assert all('nothing of' in line and 'this node is /cam1/autocalib' in line for line in warnings)


def test_a_file_that_cannot_be_read_is_left_to_rcl(tmp_path):
    (tmp_path / 'p.yaml').write_text('{')
    assert not unused_params_files(['--params-file', str(tmp_path / 'p.yaml')], '/autocalib')
    assert not unused_params_files(['--params-file', str(tmp_path / 'nowhere.yaml')], '/autocalib')


@pytest.mark.parametrize('flag', ['-h', '--help'])
def test_both_executables_have_a_help(flag, capsys):
    assert node.main(['autocalib_node', flag]) == 0
    assert capsys.readouterr().out.startswith('usage: autocalib_node')
    assert ground_points_node.main(['ground_points_node', flag]) == 0
    assert 'ground_points_node --ros-args' in capsys.readouterr().out


def test_an_interrupt_while_modules_are_imported_is_quiet(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(node, '_start', interrupted)
    assert node.main(['autocalib_node']) == 130
    assert capsys.readouterr() == ('', '')
