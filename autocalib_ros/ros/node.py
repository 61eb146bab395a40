"""The executable `autocalib_node`: starts and stops the node, and reports wrong usage in one line.

    autocalib_node --ros-args -p camera_height:=8.0 -r image:=/cam1/image_raw

Importing this module needs no ROS, so that a missing ROS can be reported.
"""

from __future__ import annotations

import signal
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from autocalib_ros.errors import AutocalibError, UsageError
from autocalib_ros.util.threads import limit_blas_threads

if TYPE_CHECKING:
    from autocalib_ros.ros.autocalib_node import AutocalibNode

USAGE = 'usage: autocalib_node --ros-args -p camera_height:=METRES -r image:=IMAGE_TOPIC [--params-file FILE]'
NO_ROS = (
    "autocalib_node: ROS 2 is not installed ({}): pip install 'autocalib_ros[ros]', "
    'or apt install ros-jazzy-ros-base and source /opt/ros/jazzy/setup.bash'
)
WRONG_USAGE = 2


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted; return the exit status: 0, or 2 for wrong usage."""
    limit_blas_threads()
    try:
        import rclpy  # noqa: F401
        import sensor_msgs.msg  # noqa: F401
        import std_srvs.srv  # noqa: F401
    except ImportError as error:
        print(NO_ROS.format(error), file=sys.stderr)
        return WRONG_USAGE
    try:
        _run(sys.argv if args is None else args)
    except AutocalibError as error:
        print(f'autocalib_node: {error}', file=sys.stderr)
        return WRONG_USAGE
    return 0


def _run(args: list[str]) -> None:
    """Run the node until a signal; rclpy's own handlers would shut down logger and publishers first."""
    import rclpy

    from autocalib_ros.ros.autocalib_node import AutocalibNode

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    _init(args)
    try:
        node = _create(AutocalibNode)
        try:
            _spin(node, stop)
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

    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        left = remove_ros_args(args)[1:]
    except RuntimeError as error:
        raise UsageError(' '.join(str(error).split())) from error
    if left:
        raise UsageError(f'unknown argument {left[0]}; {USAGE}')


def _create(node_type: type[AutocalibNode]) -> AutocalibNode:
    """Create the node; raise UsageError at a parameter that rclpy itself rejects."""
    from rclpy.exceptions import ParameterException

    try:
        return node_type()
    except ParameterException as error:
        raise UsageError(str(error)) from error


def _spin(node: AutocalibNode, stop: threading.Event) -> None:
    """Spin the node in its own thread until `stop`; raise what a callback raised.

    One thread is enough, since no callback waits. rclpy's MultiThreadedExecutor would lose images: it queues a ready
    callback again and again until a thread takes it, and stalls for seconds (ros2/rclpy#1452).
    """
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.task import Future

    executor, finished = SingleThreadedExecutor(), Future()
    executor.add_node(node)
    with ThreadPoolExecutor(max_workers=1) as pool:
        spinning = pool.submit(executor.spin_until_future_complete, finished)
        spinning.add_done_callback(lambda _: stop.set())
        stop.wait()
        finished.set_result(None)
    executor.shutdown()  # only now: it destroys what a spinning thread waits for
    spinning.result()


if __name__ == '__main__':
    sys.exit(main())
