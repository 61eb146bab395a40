"""Read images from video files with OpenCV."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from autocalib_ros.errors import InputError
from autocalib_ros.offline.recordings.sources import Frame, StoredImage, TimeWindow, no_image_error
from autocalib_ros.util.input_limits import MAX_IMAGE_PIXELS

LOG = logging.getLogger(__name__)

PLAUSIBLE_FPS = (0.01, 1000.0)
FALLBACK_FPS = 25.0
PLAUSIBLE_PIXEL_ASPECT = (0.2, 5.0)
"""Width of a pixel over its height; the usual squeezes lie between 1/2 and 2, and other values come from damage."""
CODECS = {'av01': 'AV1', 'hev1': 'H.265', 'hvc1': 'H.265', 'vvc1': 'H.266', 'drmi': 'encrypted', 'encv': 'encrypted'}
"""Names of codecs that builds of OpenCV may lack."""
RAW_SUFFIXES = ('.h264', '.264', '.h265', '.265', '.hevc', '.mjpg', '.mjpeg')
"""Videos without a container have no times; FFmpeg says 25 frames/s of them."""
MIN_DECODED_FRACTION = 0.95
"""Fraction of the frames declared in the header below which a video counts as truncated; some containers estimate
their number only."""


class VideoSource:
    """Images of a video file, stamped in nanoseconds since its first frame."""

    topic = image_type = camera_frame = ''
    is_live = False

    def __init__(
        self, path: Path | str, window: TimeWindow, rate_hz: float | None = None, name: str | None = None
    ) -> None:
        """`rate_hz` replaces the times of the file; `name` is that for messages, by default the path."""
        self.name = str(path) if name is None else name
        self._path, self.window, self._rate_hz = path, window, rate_hz
        with self._capture() as capture:
            fps, declared_frames = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
            require_usual_size(capture, self.name)
            if not capture.grab():
                remedy = (
                    'Download it first: not every server lets parts of a file be read'
                    if '://' in str(path)
                    else 'Convert it, for example: ffmpeg -i IN -c:v libx264 -crf 16 OUT.mp4'
                )
                raise InputError(
                    f'{self.name} has no frame that can be decoded; its codec is {_codec(capture)}. {remedy}'
                )
            self.pixel_aspect = _pixel_aspect(capture)
            turned_deg = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        if turned_deg:
            LOG.warning(
                '%s is turned by %d degrees, as the file says; images of the live camera may come unturned',
                *(self.name, turned_deg),
            )
        if self.pixel_aspect:
            LOG.warning(
                '%s says that its pixels are %.4g times as wide as high, which is used', self.name, self.pixel_aspect
            )
        fps = self._plausible_rate(fps)
        self._fps = fps
        self._declared_frames = int(declared_frames) if 0 < declared_frames < 1e9 else None
        self.duration_s = self.total = None
        if self._declared_frames:
            self.duration_s = window.overlap_s(self._declared_frames / fps)
            self.total = round(self.duration_s * fps)

    def _plausible_rate(self, fps: float) -> float:
        """Return the rate that is given, that of the file, or an assumed one with a warning."""
        if self._rate_hz is not None:
            return self._rate_hz
        if not PLAUSIBLE_FPS[0] <= fps <= PLAUSIBLE_FPS[1]:
            LOG.warning('%s has no valid frame rate; %g frames/s assumed, see --rate', self.name, FALLBACK_FPS)
            return FALLBACK_FPS
        if Path(self._path).suffix.lower() in RAW_SUFFIXES:
            LOG.warning(
                '%s is a raw stream without times; %g frames/s assumed, give the true rate with --rate', self.name, fps
            )
        return fps

    def frames(self) -> Iterator[Frame]:
        """Yield the decoded frames of the window; InputError without a frame."""
        for stamp_ns, capture in self._stamped():
            decoded, image = capture.retrieve()
            if decoded and image is not None:
                yield Frame(stamp_ns, image)

    def stored(self) -> Iterator[StoredImage]:
        """Yield the stamps of the window; a video has no messages."""
        return (StoredImage(stamp_ns, stamp_ns, '') for stamp_ns, _ in self._stamped())

    def _stamped(self) -> Iterator[tuple[int, cv2.VideoCapture]]:
        """Yield the stamp of each frame of the window, and the capture to retrieve the frame from."""
        start_ns, stop_ns = self.window.bounds_ns
        clock, yielded = _FrameClock(self._fps, self._rate_hz is not None), 0
        with self._capture() as capture:
            while capture.grab():
                stamp_ns = clock.next_ns(capture.get(cv2.CAP_PROP_POS_MSEC))
                if stop_ns is not None and stamp_ns >= stop_ns:
                    break
                if stamp_ns >= start_ns:
                    yielded += 1
                    yield stamp_ns, capture
            else:
                self._warn_if_truncated(clock.ticks)
        if not yielded:
            raise no_image_error(self.name, self.window, clock.ticks / self._fps)

    def _warn_if_truncated(self, frames: int) -> None:
        if frames and self._declared_frames and frames < MIN_DECODED_FRACTION * self._declared_frames - 2:
            LOG.warning('%s ended early: %d of %d frames could be read', self.name, frames, self._declared_frames)

    @contextmanager
    def _capture(self) -> Iterator[cv2.VideoCapture]:
        capture = cv2.VideoCapture(str(self._path))
        try:
            if not capture.isOpened():
                raise InputError(f'{self.name} is not a readable video: damaged, truncated or unsupported')
            yield capture
        finally:
            capture.release()


def require_usual_size(capture: cv2.VideoCapture, name: str) -> None:
    """Raise InputError if a video or stream states images of more than `MAX_IMAGE_PIXELS`."""
    width, height = (round(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > MAX_IMAGE_PIXELS:
        raise InputError(
            f'{name} states images of {width}x{height} pixels, more than {MAX_IMAGE_PIXELS // 1_000_000} million: its '
            'header is damaged, or the images have to be made smaller'
        )


def _codec(capture: cv2.VideoCapture) -> str:
    """Return the name of the codec of a video."""
    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    name = ''.join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24)).strip('\0 ').lower()
    return f'{name} ({CODECS[name]})' if name in CODECS else (name if name.isprintable() and name else 'unknown')


def _pixel_aspect(capture: cv2.VideoCapture) -> float:
    """Return the sample aspect ratio that a video says; 0 if it says none.

    1:1 counts as none: many recorders write it into files of squeezed pictures.
    """
    across, down = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    if not (across > 0 and down > 0) or across == down:
        return 0.0
    aspect = across / down
    return aspect if PLAUSIBLE_PIXEL_ASPECT[0] <= aspect <= PLAUSIBLE_PIXEL_ASPECT[1] else 0.0


class _FrameClock:
    """Stamps of frames: presentation times if they increase, else multiples of the frame interval."""

    def __init__(self, fps: float, is_even: bool = False) -> None:
        """`is_even` says that only the frame interval counts."""
        self._step_ns, self._is_even = 1e9 / fps, is_even
        self._offset_ms: float | None = None
        self._previous_ns = 0
        self.ticks = 0

    def next_ns(self, position_ms: float) -> int:
        """Return the stamp of the next frame; stamps increase strictly."""
        if self._is_even:
            stamp_ns = round(self.ticks * self._step_ns)
        elif self._offset_ms is None:
            self._offset_ms, stamp_ns = position_ms, 0
        else:
            stamp_ns = round((position_ms - self._offset_ms) * 1e6)
            if not stamp_ns > self._previous_ns:
                stamp_ns = self._previous_ns + round(self._step_ns)
        self._previous_ns = stamp_ns
        self.ticks += 1
        return stamp_ns
