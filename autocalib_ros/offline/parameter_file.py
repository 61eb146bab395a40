"""Read options from a ROS 2 parameter file and from `name=value` arguments."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from autocalib_ros.config import NodeOptions, Options, flatten, walk_options, with_overrides
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.util.documents import parse_yaml, read_yaml

WILDCARDS = ('*', '**')
ROS_PARAMETERS = ('use_sim_time', 'start_type_description_service')
QOS_OVERRIDES_PREFIX = 'qos_overrides.'


def read_params_file(path: Path) -> dict[str, Any]:
    """Return the options in a ROS 2 parameter file by full name, without those that only a live node uses."""
    return {name: value for name, value in _read_values(path).items() if not _is_node_only(name)}


def camera_info_file(path: Path) -> str:
    """Return the option `camera_info_file` of a ROS 2 parameter file, '' if it is not set.

    Replay uses the same lens as the live node, so that both give the same result.
    """
    return NodeOptions(camera_info_file=_read_values(path).get('camera_info_file', '')).camera_info_file


def _read_values(path: Path) -> dict[str, Any]:
    tree = read_yaml(Path(path), 'parameter file')
    values: dict[str, Any] = {}
    for section in _applicable_sections(path, _sections(tree)):
        values.update(flatten(section))
    return values


def _sections(tree: Any, name: str = '') -> dict[str, Mapping[str, Any]]:
    """Return every `ros__parameters` section by the full name of its node; namespaces may be nested."""
    found: dict[str, Mapping[str, Any]] = {}
    for key, value in tree.items() if isinstance(tree, Mapping) else ():
        if key == 'ros__parameters':
            found[name] = value if isinstance(value, Mapping) else {}
        else:
            found.update(_sections(value, f'{name}/{key}'.replace('//', '/')))
    return found


def _applicable_sections(path: Path, sections: dict[str, Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the sections that apply to a replay, wildcard sections first; the file may configure several nodes."""
    if not sections:
        raise InputError(f"{path} is not a ROS 2 parameter file: it has no 'ros__parameters'")
    general = [name for name in sections if name.split('/')[-1] in WILDCARDS]
    named = [name for name in sections if name not in general]
    if len(named) > 1:
        named = [name for name in named if 'autocalib' in name.split('/')[-1]]
    if len(named) > 1:
        raise UsageError(f'{path} configures several nodes: {", ".join(named)}; a replay needs exactly one')
    return [sections[name] for name in general + named]


def _is_node_only(name: str) -> bool:
    node_names = {item.name for item in walk_options(NodeOptions())}
    return name in node_names or name in ROS_PARAMETERS or name.startswith(QOS_OVERRIDES_PREFIX)


def parse_assignments(assignments: list[str]) -> dict[str, Any]:
    """Parse `name=value` or `name:=value` arguments; values are YAML. Raise UsageError for other text."""
    values: dict[str, Any] = {}
    for text in assignments:
        name, equals, value = text.replace(':=', '=', 1).partition('=')
        if not name.strip() or not equals:
            raise UsageError(f"'-p {text[:100]}' does not have the form name=value")
        try:
            values[name.strip()] = parse_yaml(value)
        except InputError as error:
            raise UsageError(f"the value of '-p {text[:100]}' {error}") from error
    return values


def override_options(options: Options, values: Mapping[str, Any]) -> Options:
    """Return `options` with values replaced by full name; numbers such as `1e-05`, text in YAML, are converted."""
    floats = {item.name for item in walk_options(options) if isinstance(item.default, float)}
    return with_overrides(
        options, {name: _as_float(value) if name in floats else value for name, value in values.items()}
    )


def _as_float(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value  # the check of the option gives the better error message


def params_yaml(options: Options) -> str:
    """Return all options as a ROS 2 parameter file, for replays and the node alike."""
    return str(yaml.safe_dump({'/**': {'ros__parameters': dataclasses.asdict(options)}}, sort_keys=False))
