"""Read images from ROS 1 and ROS 2 recordings: choice of topic and stamps, tolerance of damaged files."""

from __future__ import annotations

import logging
import shutil
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from rosbags.typesys import Stores, get_typestore

from autocalib_ros.errors import AutocalibError, InputError, UsageError
from autocalib_ros.offline.recordings.bag_parts import BagPart, find_parts, one_line, open_parts
from autocalib_ros.offline.recordings.sources import Frame, StoredImage, TimeWindow, no_image_error
from autocalib_ros.offline.recordings.unpacking import unpack
from autocalib_ros.perception.header_stamps import HeaderStamps
from autocalib_ros.perception.images import ImageDecoder

LOG = logging.getLogger(__name__)

IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


@dataclass(frozen=True)
class _BagMessage:
    """A message: receive time, serialised bytes (CDR or ROS 1), and the message itself, None if damaged."""

    recorded_ns: int
    raw: bytes | memoryview
    message: Any


class BagSource:
    """Images on one topic of a rosbag2 folder, a single .mcap or .db3 file, or a ROS 1 .bag."""

    is_live = False

    def __init__(self, path: Path, topic: str | None, window: TimeWindow) -> None:
        self.name = str(path)
        self.window = window
        self._copies: Path | None = None
        self._parts = find_parts(path, self._temporary)
        with open_parts(self._parts) as readers:
            self._parts = readers  # what cannot be read was told
            topics = _Topics(self.name, readers)
            self.topic, self.image_type = topics.choose(topic)
            count = topics.counts[self.topic]
            self._ros1 = self._is_ros1(readers)
            self._types = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_JAZZY)
            first = self._peek(readers)
            recording_s = (max(reader.end_time for reader in readers) - self._first_ns) * 1e-9
        self.camera_frame = first.header.frame_id.lstrip('/') if first else ''
        self.pixel_aspect = 0.0
        duration_s = window.overlap_s(recording_s)
        self.duration_s: float | None = duration_s
        self.total: int | None = (
            count if window.is_whole_recording else round(count * duration_s / max(recording_s, 1e-9))
        )

    def _temporary(self) -> Path:
        """Return a folder for copies, which is removed with this source."""
        if self._copies is None:
            self._copies = Path(mkdtemp(prefix='autocalib_'))
            weakref.finalize(self, shutil.rmtree, self._copies, ignore_errors=True)
        return self._copies

    def _is_ros1(self, readers: list[BagPart]) -> bool:
        """Return whether the images are serialised as by ROS 1: of a .bag, or of ROS 1 in MCAP."""
        chosen = [one for reader in readers for one in reader.connections if one.topic == self.topic]
        return self._parts[0].is_ros1 or any(getattr(one, 'is_ros1', False) for one in chosen)

    def frames(self) -> Iterator[Frame]:
        """Yield the decoded images of the window in the order of recording; InputError without an image."""
        decoder = ImageDecoder()
        stamps = HeaderStamps(lambda text: LOG.warning('%s: %s', self.topic, text), self._second_stamp_ns())
        decoded, broken, reason = 0, 0, ''
        for stored in self._messages():
            try:
                if stored.message is None:
                    raise InputError('the message is damaged')
                stamp = stored.message.header.stamp
                stamp_ns = stamps.choose(stamp.sec, stamp.nanosec, stored.recorded_ns)
                image = decoder.decode(stored.message)
            except InputError as error:
                broken, reason = broken + 1, reason or str(error)
                continue
            decoded += 1
            yield Frame(stamp_ns, image)
        if broken and not decoded:
            raise InputError(f'none of the {broken} images on {self.topic} of {self.name} can be decoded: {reason}')
        if broken:
            LOG.warning(
                '%d of %d images could not be decoded and were skipped; the first: %s', broken, broken + decoded, reason
            )

    def _second_stamp_ns(self) -> int | None:
        """Return the header stamp of the second image of the window that is not damaged; None without one."""
        whole = (stored.message.header for stored in self._messages() if stored.message is not None)
        headers = list(islice(whole, 2))
        return _header_ns(headers[1]) if len(headers) > 1 else None

    def stored(self) -> Iterator[StoredImage]:
        """Yield the messages of the window as CDR."""
        for stored in self._messages():
            if stored.message is not None:
                header = stored.message.header
                cdr = self._to_ros2_cdr(stored.message) if self._ros1 else stored.raw
                yield StoredImage(stored.recorded_ns, _header_ns(header), header.frame_id, cdr)

    def _messages(self) -> Iterator[_BagMessage]:
        """Yield the messages of the window; a truncated recording yields its readable part and logs a warning."""
        start_ns, stop_ns = self.window.bounds_ns
        start_ns += self._first_ns
        stop_ns = None if stop_ns is None else stop_ns + self._first_ns
        yielded = 0
        with open_parts(self._parts) as readers:
            try:
                for stored in self._read(readers, None if self.window.start_s == 0 else start_ns, stop_ns):
                    yielded += 1
                    yield stored
            except AutocalibError:
                raise
            except Exception as error:  # decoders of damaged files raise arbitrary exceptions
                if not yielded:
                    raise InputError(f'cannot read {self.name}: {one_line(error)}') from error
                LOG.warning('%s ended early, after %d images: %s', self.name, yielded, one_line(error))
        if not yielded:
            raise no_image_error(self.name, self.window, None)

    def _read(self, readers: list[BagPart], start_ns: int | None, stop_ns: int | None) -> Iterator[_BagMessage]:
        for reader in readers:
            for recorded_ns, raw in reader.messages(self.topic, self.image_type, start_ns, stop_ns):
                try:
                    raw = _decompressed(raw)
                except Exception:  # a damaged message raises arbitrary exceptions and is skipped
                    yield _BagMessage(recorded_ns, raw, None)
                    continue
                yield _BagMessage(recorded_ns, raw, self._message(raw))

    def _message(self, raw: bytes | memoryview) -> Any:
        """Return the deserialised message, or None if it is damaged."""
        read = self._types.deserialize_ros1 if self._ros1 else self._types.deserialize_cdr
        try:
            return read(raw, self.image_type)
        except Exception:  # a damaged message raises arbitrary exceptions and is skipped
            return None

    def _peek(self, readers: list[BagPart]) -> Any:
        """Note the time of the first image; return its message, None if it is damaged."""
        try:
            first = next(self._read(readers, None, None), None)
        except AutocalibError:
            raise
        except Exception as error:  # decoders of damaged files raise arbitrary exceptions
            raise InputError(f'cannot read {self.name}: {one_line(error)}') from error
        if first is None:
            raise InputError(f'{self.name} has no images on {self.topic}')
        self._first_ns = first.recorded_ns
        return first.message

    def _to_ros2_cdr(self, message: Any) -> memoryview:
        """Return a ROS 1 message as CDR, without the `seq` of its header."""
        types = get_typestore(Stores.ROS2_JAZZY)
        time, header = types.types['builtin_interfaces/msg/Time'], types.types['std_msgs/msg/Header']
        stamp = message.header.stamp
        fields = {name: value for name, value in vars(message).items() if name not in ('header', '__msgtype__')}
        copied = types.types[self.image_type](
            header=header(stamp=time(sec=stamp.sec, nanosec=stamp.nanosec), frame_id=message.header.frame_id), **fields
        )
        return types.serialize_cdr(copied, self.image_type)


class _Topics:
    """The topics of a recording: selection of the image topic and error messages."""

    def __init__(self, name: str, readers: list[BagPart]) -> None:
        self._name = name
        self.counts: dict[str, int] = {}
        self._types: dict[str, str] = {}
        for connection in (c for reader in readers for c in reader.connections):
            self._add(connection)
        if not any(self.counts.values()):
            raise InputError(f'{name} is an empty recording: it has no messages')

    def _add(self, connection: Any) -> None:
        self.counts[connection.topic] = self.counts.get(connection.topic, 0) + connection.msgcount
        self._types[connection.topic] = connection.msgtype

    def choose(self, topic: str | None) -> tuple[str, str]:
        """Return the requested image topic, or the only one, and its type; UsageError or InputError without one."""
        images = [name for name in self.counts if self._types[name] in IMAGE_TYPES and self.counts[name]]
        if not images:
            raise InputError(f'{self._name} has no images; its topics: {self._describe(self.counts)}')
        if topic is None and len(images) > 1:
            raise UsageError(
                f'{self._name} has {len(images)} image topics, choose one with --topic: {self._describe(images)}'
            )
        chosen = images[0] if topic is None else '/' + topic.lstrip('/')
        if chosen not in self.counts:
            raise UsageError(f'{self._name} has no topic {chosen}; its image topics: {self._describe(images)}')
        if chosen not in images:
            raise UsageError(
                f'{chosen} has no images but {self._describe([chosen])}; image topics: {self._describe(images)}'
            )
        return chosen, self._types[chosen]

    def _describe(self, topics: Any) -> str:
        return ', '.join(f'{topic} ({self._types[topic]}, {self.counts[topic]} messages)' for topic in sorted(topics))


def _header_ns(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def _decompressed(raw: bytes | memoryview) -> bytes | memoryview:
    """Decompress a message of a file whose metadata.yaml announced compressed messages."""
    if bytes(raw[:4]) != ZSTD_MAGIC:  # a CDR message begins with 00, a ROS 1 image with its counter
        return raw
    return unpack('zstd', raw)
