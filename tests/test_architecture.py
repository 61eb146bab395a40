"""The rooms of the program and the walls between them."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import autocalib_ros

PACKAGE = Path(autocalib_ros.__file__).parent
# From the ground up. A room imports from rooms in lower lines only; rooms of one line do not know each other.
STOREYS = (
    ('errors', 'threads', 'redundancy'),
    ('config', 'files'),
    ('camera',),
    ('opencv_lens',),
    ('camera_info',),
    ('calibration', 'info_lens'),
    ('calibration_reader',),
    ('evidence', 'ground', 'store', 'known_camera', 'comparison'),
    ('perception', 'estimation', 'pictures'),
    ('compare',),
    ('calibrator', 'standing'),
    ('report',),
    ('ros', 'offline'),
    ('commands',),
    ('cli',),
    ('__main__', 'benchmark'),
)
STOREY = {room: height for height, rooms in enumerate(STOREYS) for room in rooms}
ROS_PACKAGES = (
    'rclpy',
    'ament_index_python',
    'builtin_interfaces',
    'diagnostic_msgs',
    'geometry_msgs',
    'rcl_interfaces',
    'rosgraph_msgs',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'tf2_msgs',
    'tf2_ros',
    'visualization_msgs',
    'rosidl_parser',
    'rpyutils',
)
WITHOUT_ROS = """
import importlib, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {packages!r}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, NoRos())
for name in {modules!r}:
    importlib.import_module(name)
{then}
"""


def module_name(path: Path) -> str:
    parts = ['autocalib_ros', *path.relative_to(PACKAGE).with_suffix('').parts]
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob('*.py'))}


def room_of(module: str) -> str:
    return module.split('.')[1] if '.' in module else ''


def imported_modules(module: str, path: Path) -> list[str]:
    """Return the full names a module imports, wherever in it that happens."""
    package = module if path.name == '__init__.py' else module.rpartition('.')[0]
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split('.')[: len(package.split('.')) - node.level + 1] if node.level else []
            source = '.'.join([*above, *([node.module] if node.module else [])])
            names += [f'{source}.{alias.name}' for alias in node.names] if source == 'autocalib_ros' else [source]
    return names


def run_without_ros(modules: list[str], then: str = '') -> subprocess.CompletedProcess:
    program = WITHOUT_ROS.format(packages=set(ROS_PACKAGES), modules=modules, then=then)
    environment = {**os.environ, 'PYTHONPATH': str(PACKAGE.parent)}
    return subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, timeout=120, env=environment, check=False
    )


@pytest.mark.parametrize('module', [name for name in MODULES if room_of(name)])
def test_every_module_lives_in_a_known_room(module):
    assert room_of(module) in STOREY


@pytest.mark.parametrize('module', MODULES)
def test_imports_run_downward_only(module):
    room = room_of(module)
    for name in imported_modules(module, MODULES[module]):
        other = room_of(name) if name.partition('.')[0] == 'autocalib_ros' else ''
        if other in STOREY and other != room:
            assert STOREY[other] < STOREY.get(room, 0), f'{module} imports {name}, which does not lie below it'


@pytest.mark.parametrize('module', [name for name in MODULES if room_of(name) != 'ros'])
def test_only_the_live_shell_imports_ros(module):
    roots = {name.partition('.')[0] for name in imported_modules(module, MODULES[module])}
    assert not {root for root in roots if root in ROS_PACKAGES or root.endswith('_msgs')}


@pytest.mark.parametrize('module', [name for name in MODULES if room_of(name) != 'offline'])
def test_only_the_replay_shell_imports_rosbags(module):
    assert 'rosbags' not in {name.partition('.')[0] for name in imported_modules(module, MODULES[module])}


def test_all_but_the_live_shell_imports_without_ros():
    modules = [name for name in MODULES if room_of(name) not in ('ros', '__main__')]
    done = run_without_ros(modules)
    assert done.returncode == 0, done.stderr


def test_node_without_ros_says_in_one_line_how_to_install_it():
    done = run_without_ros(['autocalib_ros.ros.node'], 'sys.exit(sys.modules["autocalib_ros.ros.node"].main())')
    assert done.returncode == 2, done.stderr
    assert "pip install 'autocalib_ros[ros]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
