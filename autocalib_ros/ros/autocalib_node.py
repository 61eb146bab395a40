"""The live node: declares, converts, calls, publishes. What it knows about cameras is in the core."""

from __future__ import annotations

import concurrent.futures
import threading
import time
import traceback
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger

from autocalib_ros.calibration import Calibration, Refusal
from autocalib_ros.calibrator import solve
from autocalib_ros.camera_info import CameraInfo as CameraInfoFields
from autocalib_ros.camera_info import camera_info, read_camera_info
from autocalib_ros.errors import AutocalibError
from autocalib_ros.perception.images import ImageDecoder
from autocalib_ros.ros import messages
from autocalib_ros.ros.headers import DEFAULT_FRAME, Headers
from autocalib_ros.ros.image_input import ImageInput
from autocalib_ros.ros.parameters import options_of
from autocalib_ros.ros.pipeline import Pipeline, Result, Solve
from autocalib_ros.ros.qos import LATCHED
from autocalib_ros.ros.transforms import Transforms
from autocalib_ros.ros.wording import described, described_progress

TELL_PROGRESS_S = 10.0
REPEAT_S = 60.0
"""Real seconds between two lines of progress, and before an unchanged complaint is repeated."""
CLOSE_S = 4.0
"""Launch kills a node 5 s after the interrupt: by then it should have ended by itself."""


@dataclass(frozen=True)
class Published:
    """The calibration in force, with the fields that each image's camera_info repeats."""

    result: Calibration
    fields: CameraInfoFields


class AutocalibNode(Node):
    """Node `autocalib`; `solve` may be replaced by another solver of the same signature."""

    def __init__(self, *, solve: Solve = solve, **node_arguments: Any) -> None:
        super().__init__('autocalib', automatically_declare_parameters_from_overrides=True, **node_arguments)
        self.options, self.node_options = options_of(self)
        lens_file = self.node_options.camera_info_file
        lens = read_camera_info(lens_file) if lens_file else None
        if lens is not None:
            camera_info(lens, self.options.distortion_model)  # a model that cannot say it is wrong usage at once
        self._headers = Headers(self.node_options, self.get_namespace(), self.get_logger().warning,
                                lambda: self.get_clock().now().nanoseconds)
        self._lock = threading.Lock()
        self._published: Published | None = None
        self._frame_id = ''
        self._image_size: tuple[int, int] | None = None
        self._said: dict[str, float] = {}
        self._camera_info = self.create_publisher(CameraInfo, '~/camera_info', LATCHED)
        self._transforms = Transforms(self, tf_parent=self.options.tf_parent, publish_tf=self.node_options.publish_tf)
        self._pipeline = Pipeline(self.options, idle_solve_s=self.node_options.idle_solve_s,
                                  decode=ImageDecoder().decode, solve=solve, listener=self, lens=lens)
        # While a caller waits for its solution, everything outside this group goes on.
        self.create_service(Trigger, '~/calibrate', self._on_calibrate, callback_group=MutuallyExclusiveCallbackGroup())
        self._input = ImageInput(self, self.node_options, self._on_image)
        self.create_timer(TELL_PROGRESS_S, self._tell_progress, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f'waiting for images on {self._input.topic}')

    def close(self) -> None:
        """Stop the threads; to be called once before the node is destroyed."""
        if not self._pipeline.close(CLOSE_S):
            self.get_logger().warning('a solution was still running at shutdown and is abandoned')
        self.get_logger().info(f'shut down: {self._pipeline.counters}')

    def _on_image(self, message: Any) -> None:
        """Keep the image for the perception thread and give it its camera_info; nothing here takes long."""
        frame_id = self._headers.frame_id(message.header.frame_id)
        if frame_id != self._frame_id:
            self._frame_id = frame_id
            self._transforms.expect(self._headers.ground_frame(frame_id), self._headers.camera_frame(frame_id))
        self._pipeline.offer(self._headers.stamp_ns(message.header.stamp), message)
        if self.node_options.camera_info_mode == 'per_image':
            with self._lock:
                published = self._published
                if published is not None and _same_size(message, published.fields):
                    self._publish(self._camera_info, messages.camera_info_message(
                        published.fields, message.header.stamp, frame_id))

    async def _on_calibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._pipeline.counters.used:
            response.success, response.message = False, f'no image yet on {self._input.topic}'
            return response
        result = await self._solution()
        response.success = isinstance(result, Calibration)
        response.message = 'no solution: see the log of the node' if result is None else described(result)
        return response

    def _solution(self) -> Future:
        """Return a solution of what is there now, to be awaited; the solver thread wakes the executor for it."""
        executor = self.executor
        solution = Future(executor=executor)

        def hand_over(solved: concurrent.futures.Future) -> None:
            solution.set_result(solved.result())
            if executor is not None:
                executor.wake()

        self._pipeline.solve_now().add_done_callback(hand_over)
        return solution

    def _tell_progress(self) -> None:
        if self._published is None and self._pipeline.counters.used:
            self.get_logger().info(described_progress(self._pipeline.progress))

    def image_taken(self, width: int, height: int) -> None:
        """Withdraw the calibration of another image size: the lens was calibrated in its pixels."""
        with self._lock:
            self._image_size = (width, height)
            published = self._published
            if published is None or published.result.evidence.image_size == self._image_size:
                return
            self._published = None
        old_width, old_height = published.result.evidence.image_size
        self.get_logger().warning(f'the image size changed from {old_width}x{old_height} to {width}x{height}: '
                                  'the calibration is withdrawn and collecting starts anew')

    def image_unreadable(self, error: AutocalibError) -> None:
        """Log an image that could not be used."""
        self._say_seldom('unreadable', f'image left out: {error} ({self._pipeline.counters})')

    def failed(self, error: Exception) -> None:
        """Log a fault of the program itself, for a bug report."""
        self._say_seldom(f'fault {type(error).__name__}', ''.join(traceback.format_exception(error)).rstrip())

    def solved(self, result: Result) -> None:
        """Publish a calibration; after a refusal, or a lens without the plane that is known, the one before stays."""
        if isinstance(result, Refusal):
            self._say_seldom(f'refusal {result.code}', described(result), error=False)
            return
        if self._loses_plane(result):
            self._say_seldom('plane', f'the calibration before stays, as this one has no ground plane:'
                             f' {described(result)}', error=False)
            return
        fields = result.camera_info
        transform = self._transform_of(result)
        with self._lock:
            if self._image_size not in (None, result.evidence.image_size):
                return
            self._publish(self._camera_info, messages.camera_info_message(
                fields, messages.time_message(result.newest_stamp_ns), self._frame_id or DEFAULT_FRAME))
            if transform is not None:
                self._transforms.publish(transform)
            self._published = Published(result, fields)
        self._said = {}
        self.get_logger().info(described(result))

    def _loses_plane(self, result: Calibration) -> bool:
        """Say whether consumers would go on to use a ground plane in force with a lens that it does not belong to."""
        published = self._published
        return result.ground is None and published is not None and published.result.ground is not None

    def _transform_of(self, result: Calibration) -> TransformStamped | None:
        """Return the message of the ground plane, unless its scale is made up and nobody allowed that."""
        ground, image_frame = result.ground, self._frame_id or DEFAULT_FRAME
        if ground is None or not (ground.metric or self.options.allow_unit_scale):
            return None
        return messages.ground_transform_message(
            ground, messages.time_message(result.newest_stamp_ns), self._headers.ground_frame(image_frame),
            self._headers.camera_frame(image_frame), self.options.tf_parent)

    @staticmethod
    def _publish(publisher: Publisher, message: Any) -> None:
        publisher.publish(messages.validated(message))

    def _say_seldom(self, topic: str, text: str, *, error: bool = True) -> None:
        """Log a line unless the same was said less than REPEAT_S ago."""
        now = time.monotonic()
        if now - self._said.get(topic, -REPEAT_S) < REPEAT_S:
            return
        self._said[topic] = now
        # rclpy allows one severity for each place in the code.
        if error:
            self.get_logger().error(text)
        else:
            self.get_logger().warning(text)


def _same_size(message: Any, fields: CameraInfoFields) -> bool:
    """Say whether the calibration is of this image's size; a compressed image does not tell."""
    return not hasattr(message, 'width') or (message.width, message.height) == (fields.width, fields.height)
