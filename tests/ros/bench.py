"""Test bench for live nodes: an executor in the background, a client node, and test data."""

import threading
import time
from dataclasses import replace

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, Refusal, StandardDeviations
from autocalib_ros.ros.autocalib_node import AutocalibNode
from autocalib_ros.ros.messages import time_message

PATIENCE_S = 30.0
SIZE = (320, 240)
ROTATION = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""ground_from_camera of a camera that looks along the road."""
PIXELS = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8)


def wait_for(condition, what: str, patience_s: float = PATIENCE_S):
    """Return the first true value of `condition`, or fail."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.02)
    raise AssertionError(f'waited {patience_s:.0f} s in vain for {what}')


def image(
    stamp_ns: int, *, frame_id: str = 'cam_optical', size: tuple[int, int] = SIZE, encoding: str = 'mono8'
) -> Image:
    message = Image(width=size[0], height=size[1], step=size[0], encoding=encoding)
    message.header.stamp, message.header.frame_id = time_message(stamp_ns), frame_id
    message.data.frombytes(np.resize(PIXELS, (size[1], size[0])).tobytes())
    return message


def calibration(evidence, focal_px: float = 300.0, *, height_m: float | None = 8.0, metric: bool = True) -> Calibration:
    """Return a calibration of the evidence's image size, as a solver would."""
    camera = replace(Camera.equidistant(*evidence.image_size, focal_px), k=(0.01, 0.0, 0.0, 0.0))
    ground = None if height_m is None else GroundPlane(ROTATION, height_m, metric)
    return Calibration(
        method='joint',
        grade='lens' if ground is None else 'full',
        assumptions=(),
        camera=camera,
        ground=ground,
        ground_refusal=None,
        road_directions=np.zeros((0, 3)),
        stddev=StandardDeviations(focal_px=1.0),
        paper=None,
        evidence=evidence.summary(),
        newest_stamp_ns=evidence.newest_stamp_ns,
    )


def refusal(evidence) -> Refusal:
    return Refusal(
        code='too_few_tracks',
        message='12 tracks of the 40 needed.',
        remedy='wait for traffic.',
        method='joint',
        evidence=evidence.summary(),
    )


class Bench:
    """Nodes on one executor; closes all of them."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.client = rclpy.create_node('client', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.client)
        self.nodes: list[AutocalibNode] = []
        self._finished = Future()
        self._thread = threading.Thread(target=self.executor.spin_until_future_complete, args=(self._finished,))
        self._thread.start()

    def start(self, solve=None, **parameters) -> AutocalibNode:
        """Run an AutocalibNode; dots in parameter names are written as double underscores."""
        overrides = [Parameter(name.replace('__', '.'), value=value) for name, value in parameters.items()]
        more = {} if solve is None else {'solve': solve}
        return self.adopt(AutocalibNode(context=self.context, parameter_overrides=overrides, **more))

    def adopt(self, node: AutocalibNode) -> AutocalibNode:
        """Run an existing node, and end it with the others."""
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def publisher(self, kind=Image, topic: str = 'image', reliability=ReliabilityPolicy.RELIABLE):
        return self.client.create_publisher(kind, topic, QoSProfile(depth=10, reliability=reliability))

    def collect(self, kind, topic: str, *, latched: bool = False) -> list:
        """Subscribe and return the list that fills."""
        received: list = []
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        self.client.create_subscription(kind, topic, received.append, QoSProfile(depth=100, durability=durability))
        return received

    def connected(self, publisher):
        """Wait for a subscriber and return the publisher."""
        wait_for(lambda: publisher.get_subscription_count() > 0, f'a subscriber of {publisher.topic_name}')
        return publisher

    def listening(self, topic: str) -> None:
        """Wait until the client's own subscription has found its publisher."""
        wait_for(lambda: self.client.count_publishers(topic) > 0, f'a publisher of {topic}')

    def asked(self, service: str, node: str = '/autocalib'):
        """Call a service of a node and return the future of its answer."""
        trigger = self.client.create_client(Trigger, f'{node}/{service}')
        assert trigger.wait_for_service(PATIENCE_S)
        return trigger.call_async(Trigger.Request())

    def ask(self, service: str, node: str = '/autocalib') -> Trigger.Response:
        """Call a service of a node and wait for its answer."""
        answer = self.asked(service, node)
        wait_for(answer.done, f'the answer of ~/{service}')
        return answer.result()

    def ask_calibrate(self):
        """Call ~/calibrate and return the future of its answer."""
        return self.asked('calibrate')

    def calibrate(self) -> Trigger.Response:
        """Call ~/calibrate and wait for its answer."""
        return self.ask('calibrate')

    def stop(self, node: AutocalibNode) -> None:
        """End one node, once the executor is in none of its callbacks."""
        self.executor.remove_node(node)
        self.nodes.remove(node)
        wait_for(self.executor.create_task(lambda: None).done, 'the executor')
        node.close()
        node.destroy_node()

    def halt(self) -> None:
        """End the executor; nothing is in a callback any more."""
        self._finished.set_result(None)
        self._thread.join(PATIENCE_S)
        self.executor.shutdown()  # only now: it destroys what a spinning thread waits for

    def close(self):
        self.halt()
        for node in self.nodes:
            node.close()
            node.destroy_node()
        self.client.destroy_node()
        rclpy.try_shutdown(context=self.context)
