"""The options of config.py as ROS parameters: declared by walking the dataclasses, read back into them."""

from __future__ import annotations

import sys
from difflib import get_close_matches
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from autocalib_ros.config import NodeOptions, Options, OptionSpec, is_reconfigurable, walk_options, with_overrides
from autocalib_ros.errors import UsageError

ROS_PARAMETERS = ('use_sim_time', 'start_type_description_service')
"""Parameters that rclpy declares for every node."""
INT64_MAX = 2**63 - 1


def declare_parameters(node: Node) -> tuple[Options, NodeOptions]:
    """Declare every option as a parameter and return what was given, or raise UsageError.

    The node has to be created with `automatically_declare_parameters_from_overrides=True`: rclpy has no
    other public way to see a parameter that was given but that nobody declares, a misspelt one.
    """
    given = {
        name: parameter.value
        for name, parameter in node.get_parameters_by_prefix('').items()
        if name not in ROS_PARAMETERS and not name.startswith('qos_overrides.')
    }
    options, node_options = read(given)
    for item in (*walk_options(Options()), *walk_options(NodeOptions())):
        if item.name in given:
            node.undeclare_parameter(item.name)
        node.declare_parameter(item.name, item.default, descriptor(item))
    return options, node_options


def read(given: dict[str, Any]) -> tuple[Options, NodeOptions]:
    """Return the options with the parameters that were given, by full name."""
    items = {item.name: item for item in (*walk_options(Options()), *walk_options(NodeOptions()))}
    for name, value in given.items():
        if name not in items:
            raise UsageError(unknown_parameter(name))
        require_float(items[name], value)
    of_node = {item.name for item in walk_options(NodeOptions())}
    return (
        with_overrides(Options(), {name: value for name, value in given.items() if name not in of_node}),
        with_overrides(NodeOptions(), {name: value for name, value in given.items() if name in of_node}),
    )


def unknown_parameter(name: str) -> str:
    """Say that there is no such parameter, and which was meant."""
    names = [item.name for options in (Options(), NodeOptions()) for item in walk_options(options)]
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'?" if near else 'config/autocalib.yaml lists all of them'
    return f"unknown parameter '{name}': {hint}"


def require_float(item: OptionSpec, value: Any) -> None:
    """Raise UsageError at an int for a float: ROS keeps the type of a parameter, here and for good."""
    if type(item.default) is float and type(value) is int:
        raise UsageError(f"parameter '{item.name}' is a float: write {item.name}:={float(value)}, not {value}")


def descriptor(item: OptionSpec) -> ParameterDescriptor:
    """Describe one option."""
    describe = ParameterDescriptor(name=item.name, description=item.doc, read_only=not is_reconfigurable(item.name))
    if item.choices:
        describe.additional_constraints = f'one of: {", ".join(repr(choice) for choice in item.choices)}'
    if item.low is None and item.high is None:
        return describe
    if isinstance(item.default, float):
        low = -sys.float_info.max if item.low is None else float(item.low)
        high = sys.float_info.max if item.high is None else float(item.high)
        describe.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    else:
        low = -INT64_MAX if item.low is None else int(item.low)
        high = INT64_MAX if item.high is None else int(item.high)
        describe.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return describe
