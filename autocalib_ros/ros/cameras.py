"""Launch configuration of many cameras from one file: one node each, without shared names. Needs no ROS.

config/cameras.yaml is an example. `defaults` applies to all cameras; each camera has its own `namespace` and
optionally the other `CAMERA_KEYS`.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from autocalib_ros.config import NodeOptions, Options, flatten, walk_options
from autocalib_ros.errors import UsageError
from autocalib_ros.lens.camera_info_yaml import sanitised_name
from autocalib_ros.util.documents import read_yaml

CAMERA_KEYS = ('namespace', 'image', 'camera_height', 'camera_info', 'params_file', 'parameters')
"""Entries of a camera. `image`: image topic, default `image_raw`. `camera_info`: topic to publish CameraInfo on, if the
driver publishes none. `params_file`: path relative to this file. `parameters`: options by name."""
TEXT_KEYS = ('namespace', 'image', 'camera_info', 'params_file')
NODE_NAME = 'autocalib'
NAMESPACE = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)


@dataclass(frozen=True)
class CameraNode:
    """How to start the node of one camera: parameter files and values, of which later ones win, and remappings."""

    namespace: str
    parameters: tuple[str | dict[str, Any], ...]
    remappings: tuple[tuple[str, str], ...]


def read_cameras(path: Path | str) -> list[CameraNode]:
    """Return the nodes that a file describes; UsageError or InputError with the reason."""
    path = Path(path)
    tree = read_yaml(path, 'file of cameras')
    try:
        return camera_nodes(tree, path.parent)
    except UsageError as error:
        raise UsageError(f'{path}: {error}') from error


def camera_nodes(tree: Any, folder: Path) -> list[CameraNode]:
    """Return the nodes for the content of a file in `folder`."""
    if not isinstance(tree, Mapping) or not isinstance(tree.get('cameras'), list) or not tree['cameras']:
        raise UsageError("it has no list 'cameras' with at least one camera, each with its namespace")
    _require_known(tree, ('defaults', 'cameras'))
    defaults = _camera(tree.get('defaults') or {}, 'defaults')
    cameras = [_camera(item, f'camera {number}') for number, item in enumerate(tree['cameras'], 1)]
    cameras = [
        {**defaults, **camera, 'parameters': {**defaults['parameters'], **camera['parameters']}} for camera in cameras
    ]
    for number, camera in enumerate(cameras, 1):
        name = camera.get('namespace')
        if not isinstance(name, str) or not NAMESPACE.fullmatch(name):
            raise UsageError(
                f"camera {number} has the namespace {reprlib.repr(name)}: give it a unique name, such as 'cam{number}'"
            )
    _require_unique(cameras)
    return [_node(camera, folder) for camera in cameras]


def _camera(given: Any, where: str) -> dict[str, Any]:
    """Return the entries of one camera, its parameters by full name."""
    if not isinstance(given, Mapping):
        raise UsageError(f'{where} is {reprlib.repr(given)}, expected names with values such as namespace: cam1')
    _require_known(given, CAMERA_KEYS)
    for name in TEXT_KEYS:
        if name in given and not (isinstance(given[name], str) and given[name]):
            raise UsageError(f"'{name}' of {where} is {reprlib.repr(given[name])}: give a text, or leave it out")
    parameters = given.get('parameters') or {}
    if not isinstance(parameters, Mapping):
        raise UsageError(f"'parameters' of {where} are {reprlib.repr(parameters)}, expected names with values")
    return {**given, 'parameters': flatten(parameters)}


def _require_known(given: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for name in given:
        if name not in known:
            near = get_close_matches(str(name), known, n=1)
            raise UsageError(
                f"unknown entry '{name}': " + (f"did you mean '{near[0]}'?" if near else f'one of {", ".join(known)}')
            )


def _require_unique(cameras: list[dict[str, Any]]) -> None:
    """Raise UsageError if two cameras share a name, frame or topic."""
    for what, of_camera in UNIQUE_BY.items():
        seen: dict[str, str] = {}
        for camera in cameras:
            value = of_camera(camera)
            if value in seen:
                raise UsageError(
                    f"cameras '{seen[value]}' and '{camera['namespace']}' share the {what} '{value}': give each its own"
                )
            seen[value] = camera['namespace']


def _name(camera: dict[str, Any]) -> str:
    return sanitised_name(str(camera['parameters'].get('camera_name') or camera['namespace'].strip('/')))


def _resolved(camera: dict[str, Any], topic: str) -> str:
    return topic if topic.startswith('/') else f'/{camera["namespace"].strip("/")}/{topic}'


UNIQUE_BY = {
    'namespace': lambda camera: camera['namespace'].strip('/'),
    'name for frames and files': _name,
    'ground frame': lambda camera: str(camera['parameters'].get('ground_frame') or '') or f'{_name(camera)}_ground',
    'image topic': lambda camera: _resolved(camera, camera.get('image', 'image_raw')),
    'camera_info topic': lambda camera: _resolved(camera, camera.get('camera_info') or f'{NODE_NAME}/camera_info'),
}
"""Properties that must differ between cameras, with functions that return them."""


def _node(camera: dict[str, Any], folder: Path) -> CameraNode:
    values = camera['parameters']
    if 'camera_height' in camera:
        values = {**values, 'camera_height': camera['camera_height']}
    floats = {
        item.name
        for options in (Options(), NodeOptions())
        for item in walk_options(options)
        if isinstance(item.default, float)
    }
    # ROS rejects 8 for 8.0; in this file the intention is clear, so ints are converted
    values = {name: float(value) if name in floats and type(value) is int else value for name, value in values.items()}
    parameters: list[str | dict[str, Any]] = []
    if camera.get('params_file'):
        parameters.append(str(folder / camera['params_file']))
    if values:
        parameters.append(values)
    remappings = [('image', camera.get('image', 'image_raw'))]
    if camera.get('camera_info'):
        remappings.append(('~/camera_info', camera['camera_info']))
    return CameraNode(camera['namespace'], tuple(parameters), tuple(remappings))
