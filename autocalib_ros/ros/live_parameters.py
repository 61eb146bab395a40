"""Parameter changes of a running node: validation, and the options that result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from autocalib_ros.config import NodeOptions, Options, is_reconfigurable, walk_options, with_overrides
from autocalib_ros.errors import UsageError
from autocalib_ros.ros.declared_parameters import require_float, unknown_parameter

Changed = Callable[[Options, NodeOptions], None]


class LiveParameters:
    """The present options. `changed` is called with new ones; `image_size` returns the size of the images, or None."""

    def __init__(
        self,
        node: Node,
        options: Options,
        node_options: NodeOptions,
        changed: Changed,
        image_size: Callable[[], tuple[int, int] | None],
    ) -> None:
        self.options, self.node_options = options, node_options
        self._node, self._changed, self._image_size = node, changed, image_size
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def refusal(self, parameters: list[Parameter]) -> SetParametersResult | None:
        """Return why these parameters cannot be set together; None if they can."""
        foreign = [parameter.name for parameter in parameters if not self._node.has_parameter(parameter.name)]
        if foreign:
            return SetParametersResult(successful=False, reason=unknown_parameter(foreign[0]))
        result = self._check(parameters)
        return None if result.successful else result

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            options, _ = changed_options(self.options, self.node_options, _values(parameters))
            size = self._image_size()
            if size is not None:
                options.scale.require_inside(*size)
        except UsageError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        options, node_options = changed_options(self.options, self.node_options, _values(parameters))
        if (options, node_options) != (self.options, self.node_options):
            self.options, self.node_options = options, node_options
            self._changed(options, node_options)


def changed_options(
    options: Options, node_options: NodeOptions, values: Mapping[str, Any]
) -> tuple[Options, NodeOptions]:
    """Return the options with other values by full name; parameters of ROS itself are ignored.

    UsageError for a value that is invalid or read-only while the node runs.
    """
    core, of_node = ({item.name: item for item in walk_options(group)} for group in (options, node_options))
    for name, value in values.items():
        item = core.get(name) or of_node.get(name)
        if item is None:
            continue
        require_float(item, value)
        if not is_reconfigurable(name) and value != item.default:
            raise UsageError(
                f"'{name}' is read-only while the node runs: the evidence so far depends on it; restart the node with "
                f'-p {name}:={value}'
            )
    return (
        with_overrides(options, {name: value for name, value in values.items() if name in core}),
        with_overrides(node_options, {name: value for name, value in values.items() if name in of_node}),
    )


def _values(parameters: list[Parameter]) -> dict[str, Any]:
    return {parameter.name: parameter.value for parameter in parameters}
