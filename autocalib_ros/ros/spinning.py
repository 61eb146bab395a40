"""Run a node until a signal asks it to end."""

from __future__ import annotations

import signal
import threading
from concurrent.futures import ThreadPoolExecutor

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future


def stop_on_signals() -> threading.Event:
    """Return an event that SIGINT and SIGTERM set; rclpy's own handlers would shut down logger and publishers first.

    Call it before `rclpy.init`, with `signal_handler_options=SignalHandlerOptions.NO` there.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def spin_until(node: Node, stop: threading.Event) -> None:
    """Spin the node in its own thread until `stop`; raise what a callback raised.

    One thread is enough, since no callback waits. rclpy's MultiThreadedExecutor would lose images: it queues a ready
    callback again and again until a thread takes it, and stalls for seconds (ros2/rclpy#1452).
    """
    executor, finished = SingleThreadedExecutor(), Future()
    executor.add_node(node)
    with ThreadPoolExecutor(max_workers=1) as pool:
        spinning = pool.submit(executor.spin_until_future_complete, finished)
        spinning.add_done_callback(lambda _: stop.set())
        stop.wait()
        finished.set_result(None)
    executor.shutdown()  # only now: it destroys what a spinning thread waits for
    spinning.result()
