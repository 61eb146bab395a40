"""ROS parameters from the dataclasses of config.py: declaration, and back into options."""

from __future__ import annotations

import sys
from difflib import get_close_matches
from typing import Any, cast

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from autocalib_ros.config import NodeOptions, Options, OptionSpec, is_reconfigurable, walk_options, with_overrides
from autocalib_ros.errors import UsageError

ROS_PARAMETERS = ('use_sim_time', 'start_type_description_service')
"""Parameters that rclpy declares for every node."""
INT64_MAX = 2**63 - 1


def declare_parameters(node: Node) -> tuple[Options, NodeOptions]:
    """Declare every option as a parameter and return the options with the given values; UsageError if one is invalid.

    Create the node with `automatically_declare_parameters_from_overrides=True`: rclpy has no other public way to see
    a parameter that was given but not declared, such as a misspelt one.
    """
    # rclpy annotates plain values here, but returns parameters
    parameters = cast('dict[str, Parameter]', node.get_parameters_by_prefix(''))
    given = {
        name: parameter.value
        for name, parameter in parameters.items()
        if name not in ROS_PARAMETERS and not name.startswith('qos_overrides.')
    }
    options, node_options = read(given)
    for item in (*walk_options(Options()), *walk_options(NodeOptions())):
        if item.name in given:
            node.undeclare_parameter(item.name)
        node.declare_parameter(item.name, item.default, descriptor(item))
    return options, node_options


def read(given: dict[str, Any]) -> tuple[Options, NodeOptions]:
    """Return the options with the given parameters, by full name; UsageError if one is unknown or invalid."""
    items = {item.name: item for item in (*walk_options(Options()), *walk_options(NodeOptions()))}
    for name, value in given.items():
        if name not in items:
            raise UsageError(unknown_parameter(name))
        require_float(items[name], value)
    # consumers of camera_info and tf see no standard deviation
    if given.get('gate.least_grade', 'auto') == 'auto':
        given = {**given, 'gate.least_grade': 'fair'}
    of_node = {item.name for item in walk_options(NodeOptions())}
    return (
        with_overrides(Options(), {name: value for name, value in given.items() if name not in of_node}),
        with_overrides(NodeOptions(), {name: value for name, value in given.items() if name in of_node}),
    )


def unknown_parameter(name: str) -> str:
    """Return the message for an unknown parameter, with the closest name."""
    names = [item.name for options in (Options(), NodeOptions()) for item in walk_options(options)]
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'?" if near else 'config/autocalib.yaml lists all of them'
    return f"unknown parameter '{name}': {hint}"


def require_float(item: OptionSpec, value: Any) -> None:
    """Raise UsageError at an int for a float parameter: ROS does not convert types."""
    if type(item.default) is float and type(value) is int:
        raise UsageError(f"parameter '{item.name}' is a float: write {item.name}:={float(value)}, not {value}")


def descriptor(item: OptionSpec) -> ParameterDescriptor:
    """Return type, range and description of one option for ROS tools."""
    result = ParameterDescriptor(name=item.name, description=item.doc, read_only=not is_reconfigurable(item.name))
    if item.choices:
        result.additional_constraints = f'one of: {", ".join(repr(choice) for choice in item.choices)}'
    if item.low is None and item.high is None:
        return result
    if isinstance(item.default, float):
        low = -sys.float_info.max if item.low is None else float(item.low)
        high = sys.float_info.max if item.high is None else float(item.high)
        result.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    else:
        low = -INT64_MAX if item.low is None else int(item.low)
        high = INT64_MAX if item.high is None else int(item.high)
        result.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return result
