"""The options of config.py as ROS parameters."""

import os
import signal
import subprocess
import sys

import pytest
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter

from autocalib_ros.config import NodeOptions, Options, declared
from autocalib_ros.errors import UsageError
from autocalib_ros.ros.parameters import read
from bench import Bench, wait_for

OPTIONS = [*declared(Options()), *declared(NodeOptions())]
NODE = [sys.executable, '-m', 'autocalib_ros.ros.node', '--ros-args']
PARAMETER_TYPE = {bool: ParameterType.PARAMETER_BOOL, int: ParameterType.PARAMETER_INTEGER,
                  float: ParameterType.PARAMETER_DOUBLE, str: ParameterType.PARAMETER_STRING}


def run_node(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([*NODE, *arguments], capture_output=True, text=True, timeout=60, check=False)


def test_every_option_is_a_described_read_only_parameter(bench: Bench):
    node = bench.start()
    for item in OPTIONS:
        descriptor = node.describe_parameter(item.name)
        assert node.get_parameter(item.name).value == item.default
        assert (descriptor.type, descriptor.read_only) == (PARAMETER_TYPE[type(item.default)], True)
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


def test_a_source_of_the_scale_does_not_change_while_running(bench: Bench):
    node = bench.start(camera_height=7.5)
    for name, value in (('scale_from', 'speed'), ('scale.distance_px', '1 2 3 4'), ('scale.speed_km_h', 50.0)):
        assert not node.set_parameters([Parameter(name, value=value)])[0].successful


def test_parameters_do_not_change_while_running(bench: Bench):
    node = bench.start(camera_height=7.5)
    assert not node.set_parameters([Parameter('camera_height', value=9.0)])[0].successful
    assert node.get_parameter('camera_height').value == 7.5


@pytest.mark.parametrize(('given', 'told'), [
    ({'camera_height': 8}, 'camera_height:=8.0, not 8'),
    ({'camera_hight': 8.0}, "unknown parameter 'camera_hight': did you mean 'camera_height'"),
    ({'image_transprt': 'raw'}, "did you mean 'image_transport'"),
    ({'zzz': 1}, r'config/autocalib\.yaml lists all of them'),
    ({'camera_height': -1.0}, "'camera_height' lies between 0 and 500"),
    ({'tracking.max_points': 3.5}, "'max_points' takes a int"),
    ({'method': 'magic'}, 'one of joint, paper'),
    ({'scale_from': 'distance'}, "needs 'scale.distance_px'"),
    ({'scale.speed_km_h': 50.0}, "'scale.speed_km_h' is given too"),
    ({'scale.distance_px': [412.0, 530.0, 888.0, 530.0]}, 'four numbers in one text'),
    ({'scale.distance_m': 12}, 'scale.distance_m:=12.0, not 12'),
])
def test_unusable_parameter_is_refused_with_what_would_be_accepted(given, told):
    with pytest.raises(UsageError, match=told):
        read(given)


@pytest.mark.parametrize(('argument', 'told'), [
    ('camera_height:=8', 'write camera_height:=8.0, not 8'),
    ('camera_height:=501.0', 'lies between 0 and 500'),
    ('camera_hight:=8.0', "did you mean 'camera_height'?"),
    ('scale.distance_px:=412 530 888 530', "'scale.distance_px' is given too"),
    ('scale.distance_px:=[412.0, 530.0, 888.0, 530.0]', 'four numbers in one text'),
])
def test_node_ends_with_status_2_and_one_line_at_an_unusable_parameter(argument, told):
    done = run_node('-p', argument)
    assert done.returncode == 2
    assert told in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(('content', 'told'), [
    (None, 'No such file or directory'),
    ('image_width: 640', "it has no 'image_height'"),
])
def test_node_ends_with_status_2_and_one_line_at_an_unusable_camera_info_file(tmp_path, content, told):
    path = tmp_path / 'lens.yaml'
    if content is not None:
        path.write_text(content)
    done = run_node('-p', f'camera_info_file:={path}')
    assert done.returncode == 2
    assert str(path) in done.stderr and told in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_node_ends_with_status_2_at_a_missing_parameter_file():
    done = run_node('--params-file', '/nowhere/autocalib.yaml')
    assert done.returncode == 2
    assert '/nowhere/autocalib.yaml' in done.stderr


def test_node_reads_the_documented_parameter_file(request):
    file = request.config.rootpath / 'config' / 'autocalib.yaml'
    assert ended_by(signal.SIGINT, '--params-file', str(file)) == 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_node_ends_with_status_0_when_interrupted(number):
    assert ended_by(number, '-p', 'camera_height:=8.0') == 0


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
