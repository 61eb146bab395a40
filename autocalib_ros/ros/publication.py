"""The calibration in force: what is published of it, and what a new solution or other images make of it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from visualization_msgs.msg import MarkerArray

from autocalib_ros.config import NodeOptions, Options
from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera_info import CameraInfo as CameraInfoFields
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.revalidation import CalibrationState, Decision, reconcile
from autocalib_ros.ros import messages
from autocalib_ros.ros.driver_info import DriverInfo
from autocalib_ros.ros.headers import DEFAULT_FRAME, Headers
from autocalib_ros.ros.markers import markers, no_markers
from autocalib_ros.ros.qos import latched_publisher
from autocalib_ros.ros.transforms import GroundTransformPublisher


@dataclass(frozen=True)
class Published:
    """A calibration with the messages that are made of it."""

    result: Calibration
    fields: CameraInfoFields
    image_frame: str
    transform: TransformStamped | None
    """The ground plane; None where there is none that may be published."""
    markers: MarkerArray
    """The same for people to look at."""


class CalibrationPublisher:
    """Publishes one calibration at a time, latched and image by image; safe in any thread.

    `taken(published, save)` is told of each calibration that the traffic of this run vouches for, and whether it is
    new; `withdrawn()` that there is none any more. Both are called with the lock held, in the order of events.
    """

    def __init__(
        self,
        node: Node,
        options: Options,
        node_options: NodeOptions,
        headers: Headers,
        *,
        driver: DriverInfo,
        taken: Callable[[Published, bool], None],
        withdrawn: Callable[[], None],
    ) -> None:
        self.options, self._headers = options, headers
        self._node, self._driver, self._taken, self._withdrawn = node, driver, taken, withdrawn
        self._per_image = node_options.camera_info_mode == 'per_image'
        self._lock = threading.RLock()
        self.published: Published | None = None
        self.state = CalibrationState.NONE
        self.image_frame = ''
        """Of the newest image; '' before the first."""
        self.image_size: tuple[int, int] | None = None
        """Of the newest image that was decoded."""
        self._camera_info = latched_publisher(node, CameraInfo, '~/camera_info')
        self._markers = latched_publisher(node, MarkerArray, '~/markers')
        self._transforms = GroundTransformPublisher(
            node, tf_parent=options.tf_parent, publish_tf=node_options.publish_tf
        )

    def change(self, options: Options, node_options: NodeOptions) -> None:
        """Publish by other options from now on."""
        self.options, self._per_image = options, node_options.camera_info_mode == 'per_image'

    @property
    def topic(self) -> str:
        """Name of the topic of camera_info."""
        return self._camera_info.topic_name

    @property
    def conflict(self) -> str:
        """Why nothing is on /tf_static, '' where nothing stands in the way."""
        return self._transforms.conflict

    def on_image(self, message: Any, image_frame: str) -> Published | None:
        """Give an image its camera_info; return a restored calibration that is withdrawn because it is of other frames.

        Of compressed images the first has to be decoded before their size is known.
        """
        with self._lock:
            foreign = self._on_new_frame(image_frame) if image_frame != self.image_frame else None
            size = (message.width, message.height) if hasattr(message, 'width') else self.image_size
            published = self.published
            if self._per_image and published is not None and size == (published.fields.width, published.fields.height):
                self._camera_info.publish(self.camera_info(published, message.header.stamp, image_frame))
        return foreign

    def _on_new_frame(self, image_frame: str) -> Published | None:
        self.image_frame = image_frame
        self._transforms.announce_frames(
            self._headers.ground_frame(image_frame), self._headers.camera_frame(image_frame)
        )
        published = self.published
        if self.state is not CalibrationState.RESTORED or published.image_frame == image_frame:
            return None
        self.withdraw()
        return published

    def on_image_size(self, width: int, height: int) -> tuple[CalibrationState, Published] | None:
        """Take the size of an image; return what is withdrawn because its lens was calibrated in other pixels."""
        with self._lock:
            self.image_size = (width, height)
            state, published = self.state, self.published
            if published is None or published.result.evidence.image_size == self.image_size:
                return None
            self.withdraw()
        return state, published

    def on_evidence_reset(self) -> None:
        """Keep what is in force until a solution of the new evidence is as sure, or contradicts it."""
        with self._lock:
            if self.state is CalibrationState.CALIBRATED:
                self.state = CalibrationState.VERIFIED

    def solved(self, result: Calibration) -> Decision | None:
        """Let a new solution confirm or replace what is in force; None where images have another size by now."""
        while True:
            before, state = self.published, self.state
            decision = reconcile(state, before.result if before else None, result)
            new = decision.calibration is result
            # this may take a while, and images do not wait for it
            published = (
                self._make_messages(result, self.image_frame or DEFAULT_FRAME) if new or before is None else before
            )
            with self._lock:
                if self.image_size not in (None, result.evidence.image_size):
                    return None
                if self.published is before:
                    self._apply(decision, published, new=new)
                    return decision

    def _apply(self, decision: Decision, published: Published, *, new: bool) -> None:
        confirmed = self.state is not decision.state
        if new:
            self._publish(decision.state, published)
        self.state = decision.state
        if new or confirmed:
            self._taken(published, new)
        if decision.contradicted:
            self._clear_latched()

    def restore(self, result: Calibration, image_frame: str) -> None:
        """Publish a calibration of an earlier run; AutocalibError where it is not of these images."""
        restored = self._make_messages(result, image_frame)
        with self._lock:
            if self.state is not CalibrationState.NONE:
                raise InputError(f'there is a {self.state.value} one already')
            if self.image_frame not in ('', image_frame):
                raise InputError(f"it is of the frame '{image_frame}', and images are of '{self.image_frame}'")
            if self.image_size not in (None, result.evidence.image_size):
                raise InputError(
                    'it is of images of {}x{}, and these have {}x{}'.format(
                        *result.evidence.image_size, *self.image_size
                    )
                )
            self._publish(CalibrationState.RESTORED, restored)

    def withdraw(self) -> CalibrationState:
        """Publish nothing any more; return what was in force."""
        with self._lock:
            was, self.state, self.published = self.state, CalibrationState.NONE, None
            if was is not CalibrationState.NONE:
                self._markers.publish(no_markers())
            self._withdrawn()
            self._clear_latched()
        return was

    def camera_info(self, published: Published, stamp: Time | None = None, image_frame: str = '') -> CameraInfo:
        """Return the message of an image, or of the newest one that a calibration rests on.

        The driver's binning and region of interest are in it where they are of these images; where they are not,
        diagnostics say so.
        """
        fields, frame = published.fields, image_frame or published.image_frame
        stamp = stamp or messages.time_message(published.result.newest_stamp_ns)
        try:
            return messages.validated(messages.camera_info_message(fields, stamp, frame, self._driver.newest))
        except InputError:
            return messages.validated(messages.camera_info_message(fields, stamp, frame))

    def _make_messages(self, result: Calibration, image_frame: str) -> Published:
        transform = self._make_transform(result, image_frame)
        shown = no_markers() if transform is None else self._make_markers(result, image_frame)
        return Published(result, result.camera_info, image_frame, transform, shown)

    def _make_markers(self, result: Calibration, image_frame: str) -> MarkerArray:
        """Return the markers of a ground plane; nothing that is only looked at stops a calibration."""
        try:
            return messages.validated(markers(result, self._headers.ground_frame(image_frame)))
        except Exception as error:
            self._node.get_logger().error(f'no markers: {type(error).__name__}: {error}')
            return no_markers()

    def _make_transform(self, result: Calibration, image_frame: str) -> TransformStamped | None:
        """Return the message of the ground plane, unless its scale is made up and nobody allowed that."""
        ground = result.ground
        if ground is None or not (ground.metric or self.options.allow_unit_scale):
            return None
        return messages.ground_transform_message(
            ground,
            messages.time_message(result.newest_stamp_ns),
            self._headers.ground_frame(image_frame),
            self._headers.camera_frame(image_frame),
            self.options.tf_parent,
        )

    def _publish(self, state: CalibrationState, published: Published) -> None:
        self._camera_info.publish(self.camera_info(published))
        if published.transform is not None:
            self._transforms.publish(published.transform)
        self._markers.publish(published.markers)
        self.published, self.state = published, state

    def _clear_latched(self) -> None:
        """Let late joiners no longer have what is not in force: a latched message goes with its publisher.

        Publishers change in the executor's thread, which may be waiting for their events.
        """
        if self._node.executor is not None:
            self._node.executor.create_task(self._renew_publishers)

    def _renew_publishers(self) -> None:
        with self._lock:
            if self.published is None:
                self._node.destroy_publisher(self._camera_info)
                self._camera_info = latched_publisher(self._node, CameraInfo, '~/camera_info')
            if self.published is None or self.published.transform is None:
                self._transforms.forget()
