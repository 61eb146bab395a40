"""The executable `autocalib_node`: starts and stops the node, and reports wrong usage in one line.

    autocalib_node --ros-args -p camera_height:=8.0 -r image:=/cam1/image_raw

Importing this module needs no ROS, so that a missing ROS can be reported.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from autocalib_ros.errors import AutocalibError, UsageError
from autocalib_ros.util.threads import limit_blas_threads

if TYPE_CHECKING:
    from autocalib_ros.ros.autocalib_node import AutocalibNode

USAGE = 'usage: autocalib_node --ros-args -p camera_height:=METRES -r image:=IMAGE_TOPIC [--params-file FILE]'
HELP_FLAGS = ('-h', '--help')
HELP_TEXT = f"""{USAGE}

Calibrates a fixed roadside camera from the traffic of an image topic.

  -p camera_height:=8.0      height of the camera above the road in metres, or another scale
  -r image:=/cam1/image_raw  image topic (sensor_msgs/Image or CompressedImage)
  -r __ns:=/cam1             namespace of the node
  --params-file FILE         parameters; config/autocalib.yaml has all of them with their meaning

Publishes ~/camera_info, ~/ground_transform and /diagnostics; services ~/calibrate, ~/save, ~/reset."""
NO_ROS = (
    "autocalib_node: ROS 2 is not installed ({}): pip install 'autocalib_ros[ros]', "
    'or apt install ros-jazzy-ros-base and source /opt/ros/jazzy/setup.bash'
)
WRONG_USAGE, INTERRUPTED = 2, 130


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted; return the exit status: 0, 2 for wrong usage, 130 before it ran."""
    words = sys.argv if args is None else args
    if set(HELP_FLAGS) & set(words[1:]):
        print(HELP_TEXT)
        return 0
    limit_blas_threads()
    try:
        return _start(words)
    except KeyboardInterrupt:  # while modules are imported: later signals end the node in order
        return INTERRUPTED


def _start(args: list[str]) -> int:
    """Run the node; return the exit status."""
    try:
        import rclpy  # noqa: F401
        import sensor_msgs.msg  # noqa: F401
        import std_srvs.srv  # noqa: F401
    except ImportError as error:
        print(NO_ROS.format(error), file=sys.stderr)
        return WRONG_USAGE
    try:
        _run(args)
    except AutocalibError as error:
        print(f'autocalib_node: {error}', file=sys.stderr)
        return WRONG_USAGE
    return 0


def _run(args: list[str]) -> None:
    """Run the node until a signal."""
    import rclpy

    from autocalib_ros.perception.opencv_threads import pin_opencv_threads
    from autocalib_ros.ros.autocalib_node import AutocalibNode
    from autocalib_ros.ros.spinning import spin_until, stop_on_signals

    pin_opencv_threads()
    stop = stop_on_signals()
    _init(args)
    try:
        node = _create(AutocalibNode)
        try:
            _tell_unused_settings(node, args)
            spin_until(node, stop)
        finally:
            node.close()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _init(args: list[str]) -> None:
    """Initialise ROS; raise UsageError at unknown arguments."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import remove_ros_args

    from autocalib_ros.ros.start_hints import with_hint

    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        left = remove_ros_args(args)[1:]
    except RuntimeError as error:
        raise UsageError(with_hint(' '.join(str(error).split()))) from error
    if left:
        raise UsageError(f'unknown argument {left[0]}; {USAGE}')


def _tell_unused_settings(node: AutocalibNode, args: list[str]) -> None:
    """Warn of a missing scale, and of parameter files that are for other nodes."""
    from autocalib_ros.ros.start_hints import missing_scale, unused_params_files

    missing = missing_scale(node.options)
    for text in [*([missing] if missing else []), *unused_params_files(args, node.get_fully_qualified_name())]:
        node.get_logger().warning(text)


def _create(node_type: type[AutocalibNode]) -> AutocalibNode:
    """Create the node; raise UsageError at a parameter that rclpy itself rejects."""
    from rclpy.exceptions import ParameterException

    try:
        return node_type()
    except ParameterException as error:
        raise UsageError(str(error)) from error


if __name__ == '__main__':
    sys.exit(main())
