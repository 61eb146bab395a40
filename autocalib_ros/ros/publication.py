"""Publication of the current calibration: latched topics, one CameraInfo per image, and its replacement."""

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
from autocalib_ros.results.camera_move import CameraMove
from autocalib_ros.results.control_points import ControlPoints
from autocalib_ros.results.given_pixels import FollowedPixels
from autocalib_ros.results.mending import mended
from autocalib_ros.revalidation import CalibrationState, Decision, reconcile
from autocalib_ros.ros import messages
from autocalib_ros.ros.driver_info import DriverInfo
from autocalib_ros.ros.headers import DEFAULT_FRAME, Headers
from autocalib_ros.ros.map_transform import MapTransformPublisher
from autocalib_ros.ros.markers import markers, no_markers
from autocalib_ros.ros.qos import latched_publisher
from autocalib_ros.ros.transforms import GroundTransformPublisher

SAME_FRAMES = 3
"""Images in a row with another frame_id before that is believed."""


@dataclass(frozen=True)
class Published:
    """A calibration with the messages made from it."""

    result: Calibration
    fields: CameraInfoFields
    image_frame: str
    transform: TransformStamped | None
    """Ground plane; None if there is none, or none in metres and `allow_unit_scale` is off."""
    markers: MarkerArray
    """Grid, field of view and uncertainty for RViz and Foxglove."""


class CalibrationPublisher:
    """Publishes one calibration at a time, latched and per image; thread-safe.

    `on_accepted(published, new)` is called with each calibration that the traffic of this run has confirmed, and
    whether it is new; `on_withdrawn()` when none is published any more. Both are called with the lock held, in the
    order of events. `pixels` says where the control points are in the present view.
    """

    def __init__(
        self,
        node: Node,
        options: Options,
        node_options: NodeOptions,
        headers: Headers,
        *,
        driver: DriverInfo,
        control_points: ControlPoints | None,
        pixels: FollowedPixels,
        on_accepted: Callable[[Published, bool], None],
        on_withdrawn: Callable[[], None],
    ) -> None:
        self.options, self._headers = options, headers
        self._node, self._driver = node, driver
        self._on_accepted, self._on_withdrawn = on_accepted, on_withdrawn
        self._per_image = node_options.camera_info_mode == 'per_image'
        self.withheld = ''
        """Why the calibration is not published for now; '' while it is."""
        self._waits_for_sight = False
        """Whether it is withheld because the picture says nothing, of which no solution can tell."""
        self.valid_since_ns = 0
        """Stamp from which the calibration holds: that of its newest evidence, or of the move that it was mended by."""
        self.doubt = ''
        """Why the newest traffic contradicts the calibration; '' if it does not."""
        self._is_superseded = False
        """Whether the options have changed since the calibration."""
        self.is_stale = False
        """Whether the camera has moved since the calibration, which was not mended."""
        self._lock = threading.RLock()
        self.published: Published | None = None
        self.state = CalibrationState.NONE
        self.image_frame = ''
        """Frame of the newest image; '' before the first."""
        self._other_frame, self._other_frames = '', 0
        self._image_stamp: Time | None = None
        """Stamp of the newest image."""
        self.image_size: tuple[int, int] | None = None
        """Size of the newest decoded image."""
        self._camera_info = latched_publisher(node, CameraInfo, '~/camera_info')
        self._markers = latched_publisher(node, MarkerArray, '~/markers')
        self._transforms = GroundTransformPublisher(
            node, tf_parent=options.tf_parent, publish_tf=node_options.publish_tf
        )
        self._control_points, self._pixels = control_points, pixels
        self._map = (
            MapTransformPublisher(
                node,
                map_frame=node_options.map_frame,
                tf_parent=options.tf_parent,
                publish_tf=node_options.publish_tf,
            )
            if control_points is not None
            else None
        )

    def change(self, options: Options, node_options: NodeOptions) -> None:
        """Use other options from now on; a calibration of this run is replaced by the next solution."""
        with self._lock:
            own = self.state in (CalibrationState.CALIBRATED, CalibrationState.DEGRADED)
            self._is_superseded = own and options != self.options
            self.options, self._per_image = options, node_options.camera_info_mode == 'per_image'

    @property
    def topic(self) -> str:
        """Name of the camera_info topic."""
        return self._camera_info.topic_name

    @property
    def conflict(self) -> str:
        """Reason why nothing is published on /tf_static; '' if there is none."""
        return self._transforms.conflict

    def on_image(self, message: Any, image_frame: str) -> Published | None:
        """Publish the CameraInfo of an image; return the calibration of before where its frame was another.

        The size of compressed images is unknown until the first is decoded. A frame is believed after `SAME_FRAMES`
        images in a row; those before that get no CameraInfo, because the transform does not name their frame.
        """
        with self._lock:
            foreign = None
            if image_frame != self.image_frame:
                same = image_frame == self._other_frame
                self._other_frame, self._other_frames = image_frame, self._other_frames + 1 if same else 1
                if self.image_frame and self._other_frames < SAME_FRAMES:
                    return None
                foreign = self._on_new_frame(image_frame)
            self._other_frame, self._other_frames = '', 0
            size = (message.width, message.height) if hasattr(message, 'width') else self.image_size
            published = self.published
            self._image_stamp = message.header.stamp
            if self._per_image and published is not None and size == (published.fields.width, published.fields.height):
                self._camera_info.publish(self._present_info(published, message.header.stamp, image_frame))
        return foreign

    def _on_new_frame(self, image_frame: str) -> Published | None:
        self.image_frame = image_frame
        self._transforms.announce_frames(
            self._headers.ground_frame(image_frame), self._headers.camera_frame(image_frame)
        )
        published = self.published
        if published is None or published.image_frame == image_frame:
            return None
        if self.state is CalibrationState.RESTORED:
            self.withdraw()
            return published
        # this camera by another name: its pose is published under that
        renamed = self._make_messages(published.result, image_frame)
        if self.withheld:
            self.published = renamed
        else:
            self._publish(self.state, renamed)
        return published

    def on_image_size(self, width: int, height: int) -> tuple[CalibrationState, Published] | None:
        """Take the size of a decoded image; return a calibration withdrawn because its image size differs."""
        with self._lock:
            self.image_size = (width, height)
            state, published = self.state, self.published
            if published is None or published.result.evidence.image_size == self.image_size:
                return None
            self.withdraw()
        return state, published

    def mend(self, move: CameraMove, stamp_ns: int) -> Published | None:
        """Publish the pose turned by a move of the camera; return what is published now, None without a calibration."""
        before = self.published
        if before is None:
            return None
        published = self._make_messages(mended(before.result, move, stamp_ns), before.image_frame)
        with self._lock:
            if self.published is not before:
                return None
            self._hold_back_no_more()
            self._publish(CalibrationState.MENDED, published)
            self.valid_since_ns = round(move.time_s * 1e9)
            self._on_accepted(published, True)
        return published

    def outdate(self) -> None:
        """Note that the camera has moved: the next solution replaces the calibration, and is not compared with it."""
        with self._lock:
            self.is_stale = True

    def withhold(self, why: str, *, is_blind: bool) -> None:
        """Publish a calibration no longer, but keep it; all CameraInfo say from now on that there is none.

        `is_blind` says that the picture shows nothing: a new solution, of images before that, is withheld as well.
        """
        with self._lock:
            published, was, self.withheld = self.published, self.withheld, why
            self._waits_for_sight = is_blind
            if published is None or was:
                return
            stamp = messages.time_message(published.result.newest_stamp_ns)
            self._camera_info.publish(
                messages.validated(messages.uncalibrated_message(published.fields, stamp, published.image_frame))
            )
            self._markers.publish(no_markers())
            self._clear_latched()

    def release(self) -> None:
        """Publish a withheld calibration again: it holds."""
        with self._lock:
            was = self.withheld
            self._hold_back_no_more()
            if was and self.published is not None:
                self._publish(self.state, self.published)

    def on_evidence_reset(self) -> None:
        """Mark the calibration as verified only: it stays until new evidence gives one as precise or contradicts it."""
        with self._lock:
            if self.state in (CalibrationState.CALIBRATED, CalibrationState.DEGRADED):
                self.state = CalibrationState.VERIFIED
                self.doubt = ''

    def solved(self, result: Calibration) -> Decision | None:
        """Let a new solution confirm or replace the calibration; None if the image size has changed since."""
        while True:
            before, state = self.published, self.state
            comparable = before is not None and not (self.is_stale or self._is_superseded)
            decision = reconcile(state, before.result if before and comparable else None, result)
            new = decision.calibration is result
            # outside the lock: this may take a while, and images do not wait for it
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
            self._is_superseded = self.is_stale = False
        if new and self._waits_for_sight:
            self._keep(decision.state, published)
        elif new:
            self._hold_back_no_more()
            self._publish(decision.state, published)
        self.state = decision.state
        self.doubt = decision.text if decision.state is CalibrationState.DEGRADED else ''
        if new or (confirmed and not self.doubt):
            self._on_accepted(published, new)
        if decision.contradicted:
            self._clear_latched()

    def restore(self, result: Calibration, image_frame: str) -> None:
        """Publish a calibration of an earlier run; AutocalibError if it does not fit the present images."""
        restored = self._make_messages(result, image_frame)
        with self._lock:
            if self.state is not CalibrationState.NONE:
                raise InputError(f'a {self.state.value} calibration is already published')
            if self.image_frame not in ('', image_frame):
                raise InputError(f"its frame is '{image_frame}', that of the images '{self.image_frame}'")
            if self.image_size is not None and self.image_size != result.evidence.image_size:
                raise InputError(
                    'its images have {}x{} pixels, the present ones {}x{}'.format(
                        *result.evidence.image_size, *self.image_size
                    )
                )
            self._publish(CalibrationState.RESTORED, restored)

    def withdraw(self) -> CalibrationState:
        """Stop publishing; return the state before."""
        with self._lock:
            was, self.state, self.published = self.state, CalibrationState.NONE, None
            self.doubt = ''
            self._hold_back_no_more()
            if was is not CalibrationState.NONE:
                self._markers.publish(no_markers())
            self._on_withdrawn()
            self._clear_latched()
        return was

    def _present_info(self, published: Published, stamp: Time, image_frame: str) -> CameraInfo:
        """Return the CameraInfo of an image now, which says so while the calibration is withheld."""
        if not self.withheld:
            return self.camera_info(published, stamp, image_frame)
        return messages.validated(messages.uncalibrated_message(published.fields, stamp, image_frame))

    def camera_info(self, published: Published, stamp: Time | None = None, image_frame: str = '') -> CameraInfo:
        """Return the CameraInfo of an image, or of the newest image in the evidence of the calibration.

        It contains binning and region of interest of the driver if they fit the images; if not, /diagnostics reports
        the mismatch.
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
        """Return the markers of a ground plane; a fault in these drawings does not stop the calibration."""
        try:
            return messages.validated(markers(result, self._headers.ground_frame(image_frame)))
        except Exception as error:
            self._node.get_logger().error(f'no markers: {type(error).__name__}: {error}')
            return no_markers()

    def _make_transform(self, result: Calibration, image_frame: str) -> TransformStamped | None:
        """Return the ground transform, unless its scale is unknown and `allow_unit_scale` is off."""
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
        self._camera_info.publish(self.camera_info(published, self._later_stamp(published)))
        if published.transform is not None:
            self._transforms.publish(published.transform)
            if self._map is not None and self._control_points is not None:
                ground_frame = self._headers.ground_frame(published.image_frame)
                points = self._pixels.present.points_in_view(self._control_points)
                self._map.publish(published.result, points, published.transform.header.stamp, ground_frame)
        self._markers.publish(published.markers)
        self._keep(state, published)

    def _keep(self, state: CalibrationState, published: Published) -> None:
        self.published, self.state = published, state
        self.valid_since_ns = published.result.newest_stamp_ns

    def _hold_back_no_more(self) -> None:
        self.withheld, self.is_stale, self._waits_for_sight = '', False, False

    def _later_stamp(self, published: Published) -> Time | None:
        """Return the stamp of the newest image if it is later than the evidence of a calibration: none steps back."""
        stamp = self._image_stamp if self._per_image else None
        later = stamp is not None and messages.stamp_ns(stamp) > published.result.newest_stamp_ns
        return stamp if later else None

    def _clear_latched(self) -> None:
        """Remove obsolete latched messages by renewing their publishers, so that late joiners do not get them.

        Publishers are renewed in the executor's thread, which may be waiting for their events.
        """
        if self._node.executor is not None:
            self._node.executor.create_task(self._renew_publishers)

    def _renew_publishers(self) -> None:
        with self._lock:
            if self.published is None:
                self._node.destroy_publisher(self._camera_info)
                self._camera_info = latched_publisher(self._node, CameraInfo, '~/camera_info')
            if self.published is None or self.published.transform is None or self.withheld:
                self._transforms.forget()
                if self._map is not None:
                    self._map.forget()
