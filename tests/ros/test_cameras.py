"""Many cameras from one file: one node each, and nothing shared by mistake."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.ros.cameras import CameraNode, camera_nodes, read_cameras

FOLDER = Path('/etc/cameras')


def nodes(*cameras, **more) -> list[CameraNode]:
    return camera_nodes({'cameras': list(cameras), **more}, FOLDER)


def test_camera_needs_no_more_than_a_namespace():
    assert nodes({'namespace': 'cam1'}) == [CameraNode('cam1', (), (('image', 'image_raw'),))]


def test_camera_gets_its_file_values_and_remappings():
    (node,) = nodes(
        {
            'namespace': 'site/cam1',
            'image': '/driver/image',
            'camera_height': 8,
            'camera_info': 'camera_info',
            'params_file': 'thermal.yaml',
            'parameters': {'gate': {'min_tracks': 60}, 'joint.noise_px': 1},
        }
    )
    assert node.namespace == 'site/cam1'
    assert node.parameters == (
        '/etc/cameras/thermal.yaml',
        {'gate.min_tracks': 60, 'joint.noise_px': 1.0, 'camera_height': 8.0},
    )
    assert [type(value) for value in node.parameters[1].values()] == [int, float, float]
    assert node.remappings == (('image', '/driver/image'), ('~/camera_info', 'camera_info'))


def test_defaults_hold_where_a_camera_says_nothing():
    defaults = {'params_file': 'low_power.yaml', 'parameters': {'gate.min_tracks': 30, 'random_seed': 7}}
    first, second = nodes(
        {'namespace': 'a', 'parameters': {'gate.min_tracks': 60}},
        {'namespace': 'b', 'params_file': '/thermal.yaml'},
        defaults=defaults,
    )
    assert first.parameters == ('/etc/cameras/low_power.yaml', {'gate.min_tracks': 60, 'random_seed': 7})
    assert second.parameters == ('/thermal.yaml', {'gate.min_tracks': 30, 'random_seed': 7})


@pytest.mark.parametrize(
    ('cameras', 'expected'),
    [
        ([{'namespace': 'a'}, {'namespace': '/a'}], "share the namespace 'a'"),
        ([{'namespace': 'site/a'}, {'namespace': 'site_a'}], "share the name for frames and files 'site_a'"),
        ([{'namespace': 'a'}, {'namespace': 'b', 'parameters': {'camera_name': 'a'}}], 'share the name for frames'),
        (
            [{'namespace': 'a'}, {'namespace': 'b', 'parameters': {'ground_frame': 'a_ground'}}],
            'share the ground frame',
        ),
        ([{'namespace': 'a', 'image': '/image'}, {'namespace': 'b', 'image': '/image'}], "the image topic '/image'"),
        (
            [{'namespace': 'a', 'camera_info': '/i'}, {'namespace': 'b', 'camera_info': '/i'}],
            "the camera_info topic '/i'",
        ),
        ([{'image': 'image'}], "camera 1 has the namespace None: give it a unique name, such as 'cam1'"),
        ([{'namespace': '1 pole'}], "namespace '1 pole'"),
        ([{'namespace': 'a', 'camera_hight': 8.0}], "unknown entry 'camera_hight': did you mean 'camera_height'?"),
        ([{'namespace': 'a', 'parameters': [1]}], "'parameters' of camera 1"),
        (['cam1'], "camera 1 is 'cam1'"),
        ([{'namespace': 'a', 'image': None}], "'image' of camera 1 is None: give a text, or leave it out"),
        ([{'namespace': 'a', 'image': 5}], "'image' of camera 1 is 5"),
        ([{'namespace': 'a', 'camera_info': ['x']}], "'camera_info' of camera 1"),
        ([{'namespace': 'a', 'params_file': 2.5}], "'params_file' of camera 1"),
        ([], 'at least one camera'),
    ],
)
def test_file_that_cannot_be_used_is_refused_with_the_reason(cameras, expected):
    with pytest.raises(UsageError, match=expected):
        nodes(*cameras)


@pytest.mark.parametrize(
    ('content', 'expected'), [(None, 'cannot read'), ('a: [', 'is not YAML'), ('&a [*a]', 'contains itself')]
)
def test_file_that_cannot_be_read_is_reported(tmp_path, content, expected):
    if content is not None:
        (tmp_path / 'cameras.yaml').write_text(content)
    with pytest.raises(InputError, match=expected):
        read_cameras(tmp_path / 'cameras.yaml')


def test_example_file_gives_its_cameras(request):
    folder = request.config.rootpath / 'config'
    first, second = read_cameras(folder / 'cameras.yaml')
    assert [first.namespace, second.namespace] == ['cam1', 'cam2']
    assert Path(first.parameters[0]) == folder / 'low_power.yaml' and Path(first.parameters[0]).exists()
    assert second.parameters[1] == {'image_transport': 'compressed', 'camera_height': 6.5}


class Kept:
    """Stand-in for a class of launch, which is not on PyPI: keeps its arguments."""

    def __init__(self, *given, **named):
        self.given, self.named = given, named

    def perform(self, context):
        return context[self.given[0]]


@pytest.fixture
def launch_file(request, monkeypatch):
    """Return a loader of launch files on stand-ins for launch and launch_ros."""
    for name in ('launch', 'launch.actions', 'launch.substitutions', 'launch_ros', 'launch_ros.actions'):
        module = ModuleType(name)
        for kept in (
            'LaunchContext',
            'LaunchDescription',
            'DeclareLaunchArgument',
            'OpaqueFunction',
            'LaunchConfiguration',
            'Node',
        ):
            setattr(module, kept, type(kept, (Kept,), {}))
        monkeypatch.setitem(sys.modules, name, module)

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, request.config.rootpath / 'launch' / f'{name}.launch.py')
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


def test_launch_file_starts_a_process_for_each_camera(launch_file, tmp_path):
    (tmp_path / 'cameras.yaml').write_text('cameras: [{namespace: a, camera_height: 8}, {namespace: b}]')
    module = launch_file('cameras')
    argument, opaque = module.generate_launch_description().given[0]
    assert argument.given == ('cameras',)
    started = opaque.named['function']({'cameras': str(tmp_path / 'cameras.yaml')})
    assert [(node.named['namespace'], node.named['name'], node.named['parameters']) for node in started] == [
        ('a', 'autocalib', [{'camera_height': 8.0}]),
        ('b', 'autocalib', []),
    ]


def test_launch_file_of_one_camera_passes_what_is_given_and_nothing_else(launch_file):
    module = launch_file('autocalib')
    given = {name: default for name, default, _ in module.ARGUMENTS}
    (node,) = module.start_node({**given, 'namespace': 'cam1', 'camera_height': '8'})
    assert (node.named['namespace'], node.named['parameters'], node.named['remappings']) == (
        'cam1',
        [{'camera_height': 8.0}],
        [('image', 'image_raw')],
    )
