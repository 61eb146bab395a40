"""`~/debug_image`, `~/top_view` and `~/image_rect`, drawn only while subscribed.

    perception thread -> newest image that is due -> drawing thread -> publishers

Without a subscriber nothing is stored or drawn. Neither perception nor the executor waits for a picture: images that
arrive while one is drawn, or faster than `debug_rate_hz`, are not shown.
"""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from autocalib_ros.calibrator import CalibrationProgress
from autocalib_ros.config import Polygons
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.perception.ignore_regions import black_out
from autocalib_ros.pictures.drawing import Caption
from autocalib_ros.pictures.live_overlay import DebugPicture, LabelledTracks, RectifiedPicture, TopPicture
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.revalidation import CalibrationState
from autocalib_ros.ros import messages
from autocalib_ros.ros.headers import Headers
from autocalib_ros.ros.log_text import describe_numbers
from autocalib_ros.ros.publication import CalibrationPublisher, Published

VERIFIED_COLOUR, WAITING_COLOUR = '#7ee08a', '#ffd166'
"""Caption colours: calibration verified by traffic, and not."""


@dataclass(frozen=True)
class _PendingImage:
    """An image to show, with the tracked points if debug_image is subscribed."""

    header: Header
    """Its frame is that of camera_info."""
    image: np.ndarray
    followed_px: np.ndarray | None


class LivePictures:
    """Publishes the pictures; thread-safe.

    Polygons in `ignored` are blacked out. `progress` returns the present progress; `failed` is called with faults of
    the program.
    """

    def __init__(
        self,
        node: Node,
        rate_hz: float,
        publication: CalibrationPublisher,
        headers: Headers,
        *,
        ignored: Polygons,
        progress: Callable[[], CalibrationProgress | None],
        failed: Callable[[Exception], None],
    ) -> None:
        self.rate_hz, self.ignored = rate_hz, ignored
        self._publication, self._headers, self._progress, self._failed = publication, headers, progress, failed
        self._debug_image = _picture_publisher(node, '~/debug_image')
        self._top_view = _picture_publisher(node, '~/top_view')
        self._image_rect = _picture_publisher(node, '~/image_rect')
        self._changed = threading.Condition()
        self._pending: _PendingImage | None = None
        self._closed = False
        self._due_s = 0.0
        self._labelled_tracks: LabelledTracks | None = None
        self._debug = _Cached(DebugPicture)
        self._top = _Cached(TopPicture.of)
        self._rectified = _Cached(RectifiedPicture)
        self._thread = threading.Thread(target=self._run, name='pictures', daemon=True)
        self._thread.start()

    def image_used(self, message: Any, image: np.ndarray, followed: Callable[[], np.ndarray]) -> None:
        """Take an image, grey or BGR, if it is subscribed and due; it is neither changed nor copied here."""
        debug = self._debug_image.get_subscription_count() > 0
        views = self._publication.published is not None and (
            self._top_view.get_subscription_count() > 0 or self._image_rect.get_subscription_count() > 0
        )
        now = time.monotonic()
        if not (debug or views) or now < self._due_s:
            return
        # keep pace with the images at any rate, without delay after a pause
        self._due_s = max(self._due_s, now - 0.5 / self.rate_hz) + 1 / self.rate_hz
        image_header = messages.header(message.header.stamp, self._headers.frame_id(message.header.frame_id))
        pending = _PendingImage(image_header, image, followed() if debug else None)
        with self._changed:
            self._pending = pending
            self._changed.notify_all()

    def solution_found(self, result: Calibration | Refusal, evidence: Evidence) -> None:
        """Show the tracks as labelled by this solution; a refusal labels none."""
        if isinstance(result, Calibration):
            self._labelled_tracks = LabelledTracks(
                evidence.image_size, evidence.points_px, evidence.track_starts, result.figures.track_labels
            )

    def forget(self) -> None:
        """Drop the track labels of earlier solutions and the pending image."""
        with self._changed:
            self._labelled_tracks = self._pending = None

    def close(self, timeout_s: float) -> None:
        """Stop drawing."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._pending is not None)
                if self._closed or self._pending is None:
                    return
                pending, self._pending = self._pending, None
            try:
                self._show(pending)
            except Exception as error:  # a fault in drawing does not stop the node
                if not self._closed:
                    self._failed(error)

    def _show(self, pending: _PendingImage) -> None:
        """Draw the subscribed pictures."""
        image = black_out(pending.image, self.ignored)  # the only source of all pictures
        height, width = image.shape[:2]
        published, state = self._publication.published, self._publication.state
        withheld = self._publication.withheld
        if published is not None and (withheld or published.result.evidence.image_size != (width, height)):
            published = None
        result = None if published is None else published.result
        if pending.followed_px is not None:
            picture = self._debug.of((width, height), result, self._labelled_tracks)
            caption = caption_of(state, result, self._progress())
            if withheld:
                caption = Caption('WITHHELD', withheld, WAITING_COLOUR)
            self._publish(self._debug_image, picture.draw(image, pending.followed_px, caption), pending.header)
        if published is None:
            return
        if self._image_rect.get_subscription_count():
            self._publish(self._image_rect, self._rectified.of(published.result).draw(image), pending.header)
        if self._top_view.get_subscription_count() and published.transform is not None:
            self._draw_top_view(published, image, pending.header)

    def _draw_top_view(self, published: Published, image: np.ndarray, image_header: Header) -> None:
        picture = self._top.of(published.result)
        if picture is not None:
            ground_frame = self._headers.ground_frame(image_header.frame_id)
            self._publish(self._top_view, picture.draw(image), messages.header(image_header.stamp, ground_frame))

    def _publish(self, publisher: Publisher, picture: np.ndarray, picture_header: Header) -> None:
        publisher.publish(messages.validated(image_message(picture, picture_header)))


class _Cached:
    """Caches the result of a function until its arguments change; arguments are compared by identity."""

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make
        self._of: tuple[Any, ...] | None = None
        self._made: Any = None

    def of(self, *values: Any) -> Any:
        """Return the result for these arguments."""
        same = self._of is not None and all(
            new is old or (isinstance(new, tuple) and new == old) for new, old in zip(values, self._of, strict=True)
        )
        if not same:
            self._made, self._of = None, None  # free the old result first: tables are large
            self._made, self._of = self._make(*values), values
        return self._made


def caption_of(state: CalibrationState, result: Calibration | None, progress: CalibrationProgress | None) -> Caption:
    """Return the caption: the published calibration, or the progress with the missing evidence."""
    if result is None or state is CalibrationState.NONE:
        return Caption(*_collecting(progress), WAITING_COLOUR)
    numbers = ', '.join(describe_numbers(result))
    if state in (CalibrationState.RESTORED, CalibrationState.MENDED):
        title, missing = _collecting(progress)
        return Caption(
            f'{state.name}, not yet verified, grade {result.grade}', f'{numbers}; {title}: {missing}', WAITING_COLOUR
        )
    return Caption(f'CALIBRATED, grade {result.grade}', numbers, VERIFIED_COLOUR)


def _collecting(progress: CalibrationProgress | None) -> tuple[str, str]:
    """Return progress and missing evidence."""
    if progress is None:
        return 'COLLECTING', ''
    return f'COLLECTING {progress.percent:.0f} %', '; '.join([*progress.missing, *filter(None, [progress.outlook])])


def image_message(picture: np.ndarray, image_header: Header) -> Image:
    """Return a picture, grey (H, W) or BGR (H, W, 3) uint8, as an Image message."""
    height, width = picture.shape[:2]
    data = array('B')
    data.frombytes(np.ascontiguousarray(picture).data.cast('B'))
    return Image(
        header=image_header,
        height=height,
        width=width,
        encoding='mono8' if picture.ndim == 2 else 'bgr8',
        is_bigendian=0,
        step=picture.strides[0],
        data=data,
    )


def _picture_publisher(node: Node, topic: str) -> Publisher:
    """Create a reliable publisher: RViz requests that by default, and best effort loses large images.

    A slow subscriber gets only the newest picture and delays nothing but the drawing thread.
    """
    profile = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
    overriding = QoSOverridingOptions.with_default_policies()
    return node.create_publisher(Image, topic, profile, qos_overriding_options=overriding)
