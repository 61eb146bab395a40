"""The rooms of the program and the walls between them."""

import ast
import os
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

import autocalib_ros

PACKAGE = Path(autocalib_ros.__file__).parent
# From the ground up. A room imports from rooms in lower lines only; rooms of one line do not know each other.
LAYERS = (
    ('errors', 'node_interface'),
    ('config', 'util'),
    ('lens', 'perception.detector'),
    ('geometry',),
    ('results',),
    ('ground', 'evidence'),
    ('comparison', 'perception', 'pictures', 'estimation.observations'),
    ('estimation.motion',),
    ('estimation.adjustment', 'estimation.people'),
    ('estimation.straight', 'estimation.vehicle_edges'),
    ('estimation.verification',),
    ('estimation.markings', 'estimation.turning', 'estimation.paper'),
    ('estimation.single_road', 'estimation.lanes'),
    ('estimation',),
    ('report', 'calibrator', 'revalidation', 'solver_process'),
    ('offline.terminal',),
    ('offline.recordings', 'offline.simulate', 'ros'),
    ('offline', 'offline.synthetic'),
    ('offline.benchmark',),
    ('commands',),
    ('cli',),
    ('__main__',),
)
LAYER = {room: height for height, rooms in enumerate(LAYERS) for room in rooms}
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
PER_COMMAND = ('HELP', 'DESCRIPTION')
"""Each command module says its own."""
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
    """Return the room of a module: the longest name in `LAYERS` that leads to it, '' for the package itself."""
    parts = module.split('.')[1:]
    inner = '.'.join(parts[:2])
    return inner if inner in LAYER else '.'.join(parts[:1])


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
            names += [inner if (inner := f'{source}.{alias.name}') in MODULES else source for alias in node.names]
    return names


def run_without_ros(modules: list[str], then: str = '') -> subprocess.CompletedProcess:
    program = WITHOUT_ROS.format(packages=set(ROS_PACKAGES), modules=modules, then=then)
    environment = {**os.environ, 'PYTHONPATH': str(PACKAGE.parent)}
    return subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, timeout=120, env=environment, check=False
    )


@cache
def imports() -> dict[str, list[str]]:
    return {module: imported_modules(module, path) for module, path in MODULES.items()}


def test_every_module_lives_in_a_known_room() -> None:
    assert not [module for module in MODULES if room_of(module) and room_of(module) not in LAYER]


def test_imports_run_downward_only() -> None:
    upward = [
        f'{module} imports {name}, which does not lie below it'
        for module, names in imports().items()
        for name in names
        if name.startswith('autocalib_ros.')
        and room_of(name) not in ('', room_of(module))
        and LAYER.get(room_of(name), -1) >= LAYER.get(room_of(module), len(LAYERS))
    ]
    assert not upward, '\n'.join(upward)


def test_no_circle_of_files() -> None:
    """Whole-file circles hide which file knows which; imports inside functions count too."""
    graph = {module: {name for name in names if name in MODULES} - {module} for module, names in imports().items()}
    while leaves := [module for module, below in graph.items() if not below & set(graph)]:
        for module in leaves:
            del graph[module]
    assert not graph, f'circles among {sorted(graph)}'


def test_only_the_live_shell_imports_ros() -> None:
    assert not [
        f'{module} imports {name}'
        for module, names in imports().items()
        for name in names
        if room_of(module) != 'ros' and (root_of(name) in ROS_PACKAGES or root_of(name).endswith('_msgs'))
    ]


def test_only_the_offline_shell_imports_rosbags() -> None:
    assert not [
        f'{module} imports {name}'
        for module, names in imports().items()
        for name in names
        if not room_of(module).startswith('offline') and root_of(name) == 'rosbags'
    ]


def root_of(name: str) -> str:
    return name.partition('.')[0]


def test_file_and_class_names_are_unique() -> None:
    """One name means one thing: neither a file nor a class may bear the name of another."""
    files = Counter(path.name for path in MODULES.values() if not path.name.startswith('__'))
    classes = Counter(
        node.name
        for path in MODULES.values()
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
        if isinstance(node, ast.ClassDef)
    )
    assert not [name for name, count in (files + classes).items() if count > 1]


def test_constants_of_one_name_have_one_value() -> None:
    values: dict[str, set[str]] = {}
    for path in MODULES.values():
        for node in ast.parse(path.read_text(encoding='utf-8')).body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id.isupper():
                values.setdefault(node.targets[0].id, set()).add(ast.unparse(node.value))
    assert not {name: found for name, found in values.items() if len(found) > 1 and name not in PER_COMMAND}


def test_kinds_of_recordings_are_imported_when_one_is_opened() -> None:
    """Whether a source is live, or what its times are, is asked of the source: no other module needs its class."""
    room = 'autocalib_ros.offline.recordings'
    kinds = {f'{room}.{kind}' for kind in ('bags', 'image_files', 'live_streams')}
    early = {
        f'{module} imports {node.module}'
        for module, path in MODULES.items()
        if not module.startswith(room)
        for node in ast.parse(path.read_text(encoding='utf-8')).body
        if isinstance(node, ast.ImportFrom) and node.module in kinds
    }
    assert not early


@pytest.mark.dds
def test_all_but_the_live_shell_imports_without_ros():
    modules = [name for name in MODULES if room_of(name) not in ('ros', '__main__')]
    done = run_without_ros(modules)
    assert done.returncode == 0, done.stderr


@pytest.mark.dds
def test_node_without_ros_says_in_one_line_how_to_install_it():
    done = run_without_ros(['autocalib_ros.ros.node'], 'sys.exit(sys.modules["autocalib_ros.ros.node"].main())')
    assert done.returncode == 2, done.stderr
    assert "pip install 'autocalib_ros[ros]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
