"""The options of config.py as ROS parameters."""

import json
import os
import re
import signal
import subprocess
import sys

import pytest
import yaml
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter

from autocalib_ros.config import NodeOptions, Options, flatten, is_reconfigurable, walk_options
from autocalib_ros.errors import UsageError
from autocalib_ros.ros.declared_parameters import read
from autocalib_ros.ros.live_parameters import changed_options
from bench import PATIENCE_S, Bench, wait_for

OPTIONS = [*walk_options(Options()), *walk_options(NodeOptions())]
NODE = [sys.executable, '-m', 'autocalib_ros.ros.node', '--ros-args']
PARAMETER_TYPE = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}


ONE_AFTER_ANOTHER = """
import json, sys
from autocalib_ros.ros.node import main
for arguments in json.loads(sys.argv[1]):
    print(main(['autocalib_node', '--ros-args', *arguments]), flush=True)
    print('--', file=sys.stderr, flush=True)
"""
"""Starts nodes that are to end at once; prints their statuses, and a line of two dashes after what each says."""


def run_node(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([*NODE, *arguments], capture_output=True, text=True, timeout=60, check=False)


def run_nodes(*runs: tuple[str, ...]) -> list[tuple[int, str]]:
    """Return status and stderr of nodes that end at once, all in one process: a start of ROS takes a second."""
    command = [sys.executable, '-c', ONE_AFTER_ANOTHER, json.dumps(runs)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    told = done.stderr.split('--\n')[:-1]
    return list(zip(map(int, done.stdout.split()), told, strict=True))


def test_every_option_is_a_described_parameter(bench: Bench):
    node = bench.start()
    for item in OPTIONS:
        descriptor = node.describe_parameter(item.name)
        assert node.get_parameter(item.name).value == item.default
        assert (descriptor.type, descriptor.read_only) == (
            PARAMETER_TYPE[type(item.default)],
            not is_reconfigurable(item.name),
        )
        assert descriptor.description == item.doc


def test_range_of_an_option_is_its_parameters_range(bench: Bench):
    node = bench.start()
    assert node.describe_parameter('camera_height').floating_point_range[0].to_value == 500.0
    assert node.describe_parameter('tracking.max_points').integer_range[0].from_value == 20
    assert node.describe_parameter('method').additional_constraints == "one of: 'joint', 'paper'"


def test_given_parameters_become_options(bench: Bench):
    node = bench.start(camera_height=7.5, tracking__max_points=100, image_transport='compressed')
    assert (node.options.camera_height, node.options.tracking.max_points) == (7.5, 100)
    assert node.node_options.image_transport == 'compressed'
    assert node.get_parameter('tracking.max_points').value == 100


def test_a_distance_is_a_parameter_of_text(bench: Bench):
    node = bench.start(scale_from='distance', scale__distance_px='412 530 888 530', scale__distance_m=12.5)
    assert node.options.scale.pixels == ((412.0, 530.0), (888.0, 530.0))
    assert node.get_parameter('scale.distance_px').value == '412 530 888 530'


@pytest.mark.parametrize(
    ('name', 'expected'),
    [
        ('camera_height', True),
        ('gate.min_tracks', True),
        ('scale.speed_km_h', True),
        ('joint.noise_px', True),
        ('camera_info_mode', True),
        ('tracking.max_points', False),
        ('buffer.seconds', False),
        ('max_image_width', False),
        ('image_transport', False),
        ('camera_frame', False),
        ('camera_info_file', False),
        ('gate_of_another', False),
    ],
)
def test_what_is_read_at_each_solution_may_change_and_what_shapes_the_evidence_may_not(name, expected):
    assert is_reconfigurable(name) is expected


@pytest.mark.parametrize(
    ('given', 'expected'),
    [
        ({'camera_height': 9}, 'write camera_height:=9.0, not 9'),
        ({'camera_height': -1.0}, "'camera_height' lies between 0 and 500"),
        ({'camera_height': None}, "'camera_height' takes a float"),
        ({'gate.min_tracks': 3.5}, "'min_tracks' takes a int"),
        ({'camera_info_mode': 'never'}, 'one of per_image, latched_only'),
        ({'scale_from': 'speed'}, "needs 'scale.speed_km_h'"),
        ({'tracking.max_points': 100}, "'tracking.max_points' is read-only while the node runs"),
        ({'image_transport': 'compressed'}, 'start the node with -p image_transport:=compressed'),
    ],
)
def test_change_that_is_not_possible_is_refused_with_the_reason(given, expected):
    with pytest.raises(UsageError, match=expected):
        changed_options(Options(), NodeOptions(), given)


def test_change_gives_new_options_and_leaves_other_parameters_to_ros():
    options, node_options = changed_options(
        Options(camera_height=7.5),
        NodeOptions(),
        {
            'camera_height': 9.0,
            'gate.min_tracks': 60,
            'camera_info_mode': 'latched_only',
            'use_sim_time': True,
            'tracking.max_points': Options().tracking.max_points,
        },
    )
    assert (options.camera_height, options.gate.min_tracks, node_options.camera_info_mode) == (9.0, 60, 'latched_only')


def set_remotely(bench: Bench, *parameters: Parameter, atomically: bool = False) -> list:
    """Set parameters by the node's service, as `ros2 param set` does; return the results."""
    kind = SetParametersAtomically if atomically else SetParameters
    client = bench.client.create_client(kind, f'/autocalib/set_parameters{"_atomically" if atomically else ""}')
    assert client.wait_for_service(PATIENCE_S)
    answer = client.call_async(kind.Request(parameters=[parameter.to_parameter_msg() for parameter in parameters]))
    wait_for(answer.done, 'the answer')
    return [answer.result().result] if atomically else list(answer.result().results)


def test_ros_param_set_is_refused_in_words_that_help(bench: Bench):
    bench.start(camera_height=7.5)
    cases = {
        ('camera_height', 9): 'write camera_height:=9.0, not 9',
        ('camera_height', 900.0): 'lies between 0 and 500',
        ('buffer.seconds', 60.0): 'is read-only while the node runs',
        ('camera_hight', 9.0): "unknown parameter 'camera_hight': did you mean 'camera_height'?",
    }
    answers = [set_remotely(bench, Parameter(name, value=value))[0] for name, value in cases]
    assert not any(answer.successful for answer in answers)
    told = [answer.reason for answer in answers]
    assert not [words for words, reason in zip(cases.values(), told, strict=True) if words not in reason], told


def test_source_of_the_scale_changes_at_once_or_not_at_all(bench: Bench):
    node = bench.start(camera_height=7.5)
    changes = [
        Parameter('scale_from', value='speed'),
        Parameter('scale.speed_km_h', value=50.0),
        Parameter('camera_height', value=0.0),
    ]
    assert not set_remotely(bench, *changes[:2], atomically=True)[0].successful
    assert (node.options.scale_from, node.get_parameter('scale_from').value) == ('all', 'all')
    assert set_remotely(bench, *changes, atomically=True)[0].successful
    assert (node.options.scale_from, node.options.scale.speed_km_h, node.options.camera_height) == ('speed', 50.0, 0.0)


def test_parameter_that_shapes_the_evidence_does_not_change(bench: Bench):
    node = bench.start()
    assert not node.set_parameters([Parameter('tracking.max_points', value=100)])[0].successful
    assert node.options.tracking.max_points == node.get_parameter('tracking.max_points').value == 200


@pytest.mark.parametrize('name', ['thermal', 'low_power'])
def test_example_file_holds_only_options_that_differ_and_can_be_used(request, name):
    file = request.config.rootpath / 'config' / f'{name}.yaml'
    values = flatten(yaml.safe_load(file.read_text())['/**']['ros__parameters'])
    read(values)
    defaults = {item.name: item.default for item in OPTIONS}
    assert values and not [key for key, value in values.items() if value == defaults[key]]


@pytest.mark.parametrize('name', ['thermal', 'low_power'])
def test_every_line_of_an_example_file_gives_the_reason(request, name):
    lines = (request.config.rootpath / 'config' / f'{name}.yaml').read_text().splitlines()
    options = [number for number, line in enumerate(lines) if re.match(r' *\w+: \S', line)]
    assert options and all(lines[number - 1].lstrip().startswith('#') for number in options)


@pytest.mark.parametrize(
    ('given', 'expected'),
    [
        ({'camera_height': 8}, 'camera_height:=8.0, not 8'),
        ({'camera_hight': 8.0}, "unknown parameter 'camera_hight': did you mean 'camera_height'"),
        ({'image_transprt': 'raw'}, "did you mean 'image_transport'"),
        ({'zzz': 1}, r'config/autocalib\.yaml lists all of them'),
        ({'camera_height': -1.0}, "'camera_height' lies between 0 and 500"),
        ({'tracking.max_points': 3.5}, "'max_points' takes a int"),
        ({'method': 'magic'}, 'one of joint, paper'),
        ({'scale_from': 'distance'}, "needs 'scale.distance_px'"),
        ({'scale.distance_m': 12.0}, "needs 'scale.distance_px'"),
        ({'scale.distance_px': [412.0, 530.0, 888.0, 530.0]}, 'four numbers in one text'),
        ({'scale.distance_m': 12}, 'scale.distance_m:=12.0, not 12'),
    ],
)
def test_unusable_parameter_is_refused_with_what_would_be_accepted(given, expected):
    with pytest.raises(UsageError, match=expected):
        read(given)


@pytest.mark.dds
def test_node_ends_with_status_2_and_one_line_at_what_it_cannot_use(tmp_path):
    (tmp_path / 'lens.yaml').write_text('image_width: 640')
    cases = {
        'camera_height:=8': ['write camera_height:=8.0, not 8'],
        'camera_height:=501.0': ['lies between 0 and 500'],
        'camera_hight:=8.0': ["did you mean 'camera_height'?"],
        'scale.distance_px:=412 530 888 530': ["needs 'scale.distance_m'"],
        'scale.distance_px:=[412.0, 530.0, 888.0, 530.0]': ['four numbers in one text'],
        f'camera_info_file:={tmp_path}/none.yaml': [f'{tmp_path}/none.yaml', 'No such file or directory'],
        f'camera_info_file:={tmp_path}/lens.yaml': [f'{tmp_path}/lens.yaml', "it has no 'image_height'"],
        'camera_info_url:=/etc/lens.yaml': ['write file:///FOLDER/FILE.yaml'],
        'detector.model:=/nowhere/model.onnx': ["'detector.model' is /nowhere/model.onnx, which is not a file"],
    }
    ended = run_nodes(*(('-p', argument) for argument in cases))
    wrong = {
        argument: (status, told)
        for (argument, words), (status, told) in zip(cases.items(), ended, strict=True)
        if status != 2 or len(told.splitlines()) != 1 or not all(word in told for word in words)
    }
    assert not wrong


@pytest.mark.dds
def test_executable_ends_with_status_2_at_a_missing_parameter_file():
    done = run_node('--params-file', '/nowhere/autocalib.yaml')
    assert done.returncode == 2
    assert '/nowhere/autocalib.yaml' in done.stderr


@pytest.mark.dds
@pytest.mark.parametrize(
    ('number', 'name'), [(signal.SIGINT, 'autocalib'), (signal.SIGTERM, 'thermal'), (signal.SIGINT, 'low_power')]
)
def test_node_reads_each_parameter_file_and_ends_with_status_0_when_interrupted(request, number, name):
    file = request.config.rootpath / 'config' / f'{name}.yaml'
    assert ended_by(number, '--params-file', str(file), '-p', 'camera_height:=8.0') == 0


def ended_by(number: int, *arguments: str) -> int:
    """Return the exit status of a node that was sent a signal while it waited for images."""
    with subprocess.Popen([*NODE, *arguments], stderr=subprocess.PIPE, text=True, env=os.environ) as process:
        try:
            wait_for(lambda: 'waiting for images' in process.stderr.readline(), 'the node')
            process.send_signal(number)
            _, rest = process.communicate(timeout=20)
        finally:
            process.kill()
    assert 'Traceback' not in rest
    return process.returncode
