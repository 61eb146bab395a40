"""Live streams as recordings: network cameras and camera devices, stamped by the time at which images come."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.listing import DEVICE
from autocalib_ros.offline.recordings.sources import Frame, StoredImage, TimeWindow
from autocalib_ros.offline.recordings.videos import VideoSource, require_usual_size

LOG = logging.getLogger(__name__)

TIMEOUT_S = 10.0
"""Longest time to wait for a connection or for the next image, seconds: cameras send a key frame every few seconds."""
RECONNECT_S = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Pauses before a stream is connected again, seconds; the last one is repeated."""
GIVE_UP_S = 300.0
"""Time without an image after which a stream is taken to have ended: cameras restart within five minutes."""
LATE_S = 1.0
"""Time after the end of the duration for which its last images are waited for, seconds: decoding takes a part of it."""
MAX_WAITING_BYTES = 400_000_000
"""Most bytes of images that wait to be processed: 10 s of 720p at 15 images a second."""
TIMED_SCHEMES = ('rtsp', 'rtsps', 'rtp', 'srt')
"""Streams that carry the times of their images; for others FFmpeg makes them up."""
WAITED = 0.5
"""Share of the interval between two images from which the reader has waited for the second: it did not lie in a buffer.
FFmpeg reads up to five seconds of a stream to know its codec, and then gives these images at once."""
MAX_BUFFERED = 300
"""Most images of such a beginning: five seconds at 60 a second. If none is waited for until then, stamps stay those of
receipt."""
SINGLE_IMAGES = 3
"""Connections in a row that give one image each, from which an address is known for one of snapshots."""


class StreamSource:
    """Images of a live stream, stamped in nanoseconds by the clock of this computer when they come.

    A thread reads the stream while images are processed; the connection is made again when it breaks.
    """

    topic = image_type = camera_frame = ''
    pixel_aspect = 0.0
    total: int | None = None
    is_live = True

    def __init__(self, address: str, window: TimeWindow, should_stop: Callable[[], bool] = lambda: False) -> None:
        if window.start_s > 0:
            raise UsageError('a live stream has no start to skip: leave out --start')
        self.name = public_name(address)
        self._address, self.window, self._should_stop = address, window, should_stop
        self.duration_s = window.duration_s

    def frames(self) -> Iterator[Frame]:
        """Yield images as they come, for the duration or until stopped; InputError if none comes."""
        reader = _Reader(self._address, self.name)
        thread = threading.Thread(target=reader.run, name='stream', daemon=True)
        thread.start()
        first_ns: int | None = None
        stop_ns = self.window.bounds_ns[1]
        try:
            while not self._should_stop():
                frame = reader.next_frame()
                if frame is None:
                    if reader.has_ended or _is_over(first_ns, stop_ns):
                        break
                    continue
                first_ns = frame.stamp_ns if first_ns is None else first_ns
                if stop_ns is not None and frame.stamp_ns - first_ns >= stop_ns:
                    break
                yield frame
        finally:
            reader.stop()
            thread.join(TIMEOUT_S)
        if reader.problem and (first_ns is None or reader.is_of_single_images):
            raise InputError(reader.problem)
        reader.tell()

    def stored(self) -> Iterator[StoredImage]:
        """Raise UsageError: a stream cannot be read twice."""
        raise UsageError(f'{self.name} is a live stream and cannot be written as a bag: record it first')


def _is_over(first_ns: int | None, stop_ns: int | None) -> bool:
    """Whether the duration has passed without an image behind it, as where a stream has ended."""
    return first_ns is not None and stop_ns is not None and time.time_ns() - first_ns >= stop_ns + round(1e9 * LATE_S)


@dataclass(frozen=True)
class _Received:
    """An image of the beginning of a connection."""

    stamp_ns: int
    """When it came."""
    waited_s: float
    """How long the reader had waited for it."""
    stream_s: float
    """Its time in the stream."""
    image: np.ndarray

    def was_waited_for(self, before: Sequence[_Received]) -> bool:
        """Whether it came when it was taken, and had not lain in a buffer."""
        # the first image has no interval, and FFmpeg often another time than the stream
        interval_s = self.stream_s - before[-1].stream_s if len(before) > 1 else 0.0
        return 0.0 < WAITED * interval_s <= self.waited_s


def dated_back(received: Sequence[_Received]) -> list[Frame]:
    """Return the images of the beginning of a connection with the times at which they were sent.

    The last one came when it was taken; those that had waited in a buffer are dated back by the times of the stream.
    One whose time there is not before that of the next is left out.
    """
    if not received or len(received) == MAX_BUFFERED:
        return [Frame(one.stamp_ns, one.image) for one in received]
    newest, frames = received[-1], [Frame(received[-1].stamp_ns, received[-1].image)]
    for one in reversed(received[:-1]):
        stamp_ns = newest.stamp_ns - round(1e9 * (newest.stream_s - one.stream_s))
        if stamp_ns < frames[-1].stamp_ns:
            frames.append(Frame(stamp_ns, one.image))
    return frames[::-1]


class _Reader:
    """Reads a stream in a thread into a bounded queue."""

    def __init__(self, address: str, name: str) -> None:
        self._address, self._name = address, name
        self._waiting: queue.Queue[Frame] = queue.Queue()
        self._bytes = self._dropped = self._connections = 0
        self._stop = threading.Event()
        self._is_timed = urlsplit(address).scheme in TIMED_SCHEMES
        self._newest_ns = 0
        self.has_ended = self.is_of_single_images = False
        self.problem = ''

    def run(self) -> None:
        """Read until stopped, or until the stream does not come back."""
        singles, last_s, tries = 0, time.monotonic(), 0
        while not self._stop.is_set():
            count = self._read_connection()
            if count:
                last_s, tries = time.monotonic(), 0
            singles = singles + 1 if count == 1 else 0
            if singles >= SINGLE_IMAGES:
                self.problem = f'{self._name} gives one image at a time: give the address of its video stream'
                self.is_of_single_images = True
                break
            if not self._connections or time.monotonic() - last_s > GIVE_UP_S:
                break  # it was never there, or is gone for good
            self._stop.wait(RECONNECT_S[min(tries, len(RECONNECT_S) - 1)])
            tries += 1
        self.has_ended = True

    def _read_connection(self) -> int:
        """Connect, and read until the stream breaks; return the number of images."""
        capture, count = _capture(self._address), 0
        try:
            if not capture.isOpened():
                self.problem = self.problem or f'{self._name} cannot be opened: {_hint(self._address)}'
                return 0
            try:
                require_usual_size(capture, self._name)
            except InputError as error:
                self.problem = str(error)
                return 0
            beginning: list[_Received] | None = [] if self._is_timed else None
            while not self._stop.is_set():
                began_s = time.monotonic()
                if not capture.grab():
                    break
                stamp_ns, waited_s = time.time_ns(), time.monotonic() - began_s
                decoded, image = capture.retrieve()
                if not decoded or image is None:
                    continue
                count += 1
                if beginning is None:
                    self._put(Frame(stamp_ns, image))
                    continue
                beginning.append(_Received(stamp_ns, waited_s, 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC), image))
                if beginning[-1].was_waited_for(beginning[:-1]) or len(beginning) == MAX_BUFFERED:
                    self._put_beginning(beginning)
                    beginning = None
            self._put_beginning(beginning or [])
        finally:
            capture.release()
        self._connections += bool(count)
        if count:
            self.problem = ''
            if not self._stop.is_set():
                LOG.warning('%s: the connection broke after %d images; connecting again', self._name, count)
        else:
            self.problem = self.problem or f'{self._name} gives no image that can be decoded'
        return count

    def _put_beginning(self, received: list[_Received]) -> None:
        for frame in dated_back(received):
            self._put(frame)

    def _put(self, frame: Frame) -> None:
        if frame.stamp_ns <= self._newest_ns:
            return  # a connection made anew began with images that were there already
        self._newest_ns = frame.stamp_ns
        if self._bytes + frame.image.nbytes > MAX_WAITING_BYTES:
            self._dropped += 1
            return
        self._bytes += frame.image.nbytes
        self._waiting.put(frame)

    def next_frame(self) -> Frame | None:
        """Return the next image; None if none came within a fifth of a second."""
        try:
            frame = self._waiting.get(timeout=0.2)
        except queue.Empty:
            return None
        self._bytes -= frame.image.nbytes
        return frame

    def stop(self) -> None:
        """End the thread at its next image."""
        self._stop.set()

    def tell(self) -> None:
        """Log what was lost."""
        if self._dropped:
            LOG.warning(
                '%s: %d images came faster than they were processed, and were dropped', self._name, self._dropped
            )
        if self._connections > 1:
            LOG.warning('%s: read in %d connections', self._name, self._connections)


def open_stream(address: str, window: TimeWindow, should_stop: Callable[[], bool]) -> StreamSource | VideoSource:
    """Open an address: as a video if it is a file of known length, else as a live stream; InputError without one."""
    if DEVICE.fullmatch(address):
        _require_device(Path(address))
        return StreamSource(address, window, should_stop)
    if not urlsplit(address).hostname:
        raise UsageError(f"{public_name(address)} names no host: an address is like 'rtsp://user:password@host/path'")
    if urlsplit(address).scheme in ('http', 'https'):
        capture = _capture(address)
        try:
            if not capture.isOpened():
                raise InputError(f'{public_name(address)} cannot be opened: {_hint(address)}')
            is_file = capture.get(cv2.CAP_PROP_FRAME_COUNT) > 1
        finally:
            capture.release()
        if is_file:
            return VideoSource(address, window, name=public_name(address))
    return StreamSource(address, window, should_stop)


def _capture(address: str) -> cv2.VideoCapture:
    if DEVICE.fullmatch(address):
        return cv2.VideoCapture(address, cv2.CAP_V4L2)
    milliseconds = round(1000 * TIMEOUT_S)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, milliseconds, cv2.CAP_PROP_READ_TIMEOUT_MSEC, milliseconds]
    return cv2.VideoCapture(address, cv2.CAP_FFMPEG, limits)


def _require_device(device: Path) -> None:
    if not device.exists():
        there = ', '.join(sorted(str(one) for one in Path('/dev').glob('video*'))) or 'none'
        raise InputError(f'{device} does not exist; camera devices of this computer: {there}')
    if not os.access(device, os.R_OK | os.W_OK):
        raise InputError(
            f'{device} may not be opened: add your user to the group of the device (sudo usermod -aG video)'
        )


def _hint(address: str) -> str:
    if DEVICE.fullmatch(address):
        return 'another program may use the camera'
    return (
        'check address, port, user and password: it is that of the video itself, not of a page that shows it; ffplay '
        'or VLC should play it'
    )


def public_name(address: str) -> str:
    """Return an address without user, password and query: it appears in results and reports."""
    if DEVICE.fullmatch(address):
        return address
    parts = urlsplit(address)
    host = parts.hostname or ''
    port = ''
    with contextlib.suppress(ValueError):  # not a number: the error about the address tells
        port = f':{parts.port}' if parts.port else ''
    return f'{parts.scheme}://{host}{port}{parts.path}'
