"""Open a recording of any supported format."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.listing import STREAM_SCHEMES, is_bag, is_stream, recordings_of
from autocalib_ros.offline.recordings.sources import Source, TimeWindow

LOG = logging.getLogger(__name__)

UNPACK = 'unpack it, and give the folder'
TRACKS = 'it may hold evidence or tracks, which autocalib evidence solves'
INSTEAD = {
    **dict.fromkeys(('.zip', '.tar', '.gz', '.tgz', '.xz', '.bz2', '.7z', '.rar'), UNPACK),
    **dict.fromkeys(('.npz', '.csv', '.txt'), TRACKS),
    '.json': 'give the recording that it was calibrated from',
    '.yaml': 'give the folder of the rosbag2; parameters go to --params-file, a lens to --camera-info',
    '.pcap': 'record the stream of the camera itself, for example with its rtsp:// address',
    '.m3u8': 'give its http:// address',
}
"""What to do with files that are often given instead of recordings, by suffix."""


def open_sources(
    recordings: Sequence[str | Path | list[Path]],
    topic: str | None = None,
    start_s: float = 0.0,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> list[Source]:
    """Open recordings as `listing.recordings_of` gives them; of several, those that cannot be read are left out, told.

    InputError if none can be read.
    """
    common = (topic, start_s, duration_s, rate_hz, should_stop)
    if len(recordings) == 1:
        return [open_source(recordings[0], *common)]
    sources = [source for recording in recordings if (source := _try_open(recording, *common)) is not None]
    if not sources:
        raise InputError(f'none of the {len(recordings)} recordings can be read')
    return sources


def _try_open(recording: str | Path | list[Path], *common: Any) -> Source | None:
    try:
        return open_source(recording, *common)
    except InputError as error:
        LOG.warning('left out: %s', error)
        return None


def open_source(
    path: str | Path | list[Path],
    topic: str | None = None,
    start_s: float = 0.0,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Source:
    """Open a rosbag2 folder, a single .mcap or .db3 file, a ROS 1 .bag, a video, images or a live stream.

    A list of paths, a folder or a pattern of images is a sequence of images. `start_s` and `duration_s` select a time
    window from the first image. `rate_hz` gives the images per second of images and of videos without times.
    `should_stop` is asked while a live stream is read. Raise UsageError if the topic is ambiguous or missing,
    InputError if the file cannot be read.
    """
    window = TimeWindow(start_s, duration_s)
    if rate_hz is not None and not (math.isfinite(rate_hz) and rate_hz > 0):
        raise UsageError(f'the rate must be a positive number of images per second, got {rate_hz}')
    if not isinstance(path, list):
        found = recordings_of([path])
        if len(found) > 1:
            raise InputError(f'{path} has {len(found)} recordings, {found[0]} and others: open them one by one')
        path = found[0]
    if isinstance(path, list):
        return _open_images(path, topic, window, rate_hz)
    if is_stream(str(path)):
        from autocalib_ros.offline.recordings.live_streams import open_stream

        _refuse(topic, 'a stream has no topics')
        _refuse(rate_hz, 'images of a stream are timed when they come: leave out --rate')
        return open_stream(str(path), window, should_stop)
    return _open_file(Path(path), topic, window, rate_hz)


def _open_images(paths: list[Path], topic: str | None, window: TimeWindow, rate_hz: float | None) -> Source:
    from autocalib_ros.offline.recordings.image_files import ImageFilesSource

    _refuse(topic, 'images have no topics')
    return ImageFilesSource(paths, window, rate_hz)


def _open_file(path: Path, topic: str | None, window: TimeWindow, rate_hz: float | None) -> Source:
    _check_readable(path)
    instead = INSTEAD.get(path.suffix.lower()) if path.is_file() else None
    if instead is not None:
        raise InputError(f'{path} is no recording: {instead}')
    if path.is_dir() or is_bag(path):
        from autocalib_ros.offline.recordings.bags import BagSource  # lazy import: videos do not need rosbags

        _refuse(rate_hz, f'{path} has time stamps: --rate is for images and videos')
        return BagSource(path, topic, window)
    _refuse(topic, f'{path} is a video and has no topics')
    from autocalib_ros.offline.recordings.videos import VideoSource

    return VideoSource(path, window, rate_hz)


def _refuse(given: object, message: str) -> None:
    """Raise UsageError with a message if an argument is given that does not fit."""
    if given is not None:
        raise UsageError(message)


def _meant_instead(text: str) -> str:
    """Return what was probably meant by a path that does not exist; '' if nothing is near."""
    if text.isdigit():
        return f': a camera device is /dev/video{text}'
    scheme, colon, _ = text.partition(':')
    if colon and scheme.isalpha() and len(scheme) > 1:
        return f': addresses begin with {", ".join(f"{one}://" for one in STREAM_SCHEMES[:5])}'
    return ''


def _check_readable(path: Path) -> None:
    try:
        if not path.exists():
            raise InputError(f'{path} does not exist{_meant_instead(str(path))}')
        if path.is_dir():
            return
        if not path.is_file():
            raise InputError(f'{path} is neither a file nor a folder')
        with path.open('rb') as stream:
            if not stream.read(1) and not Path(f'{path}-wal').exists():
                raise InputError(f'{path} is empty (0 bytes)')
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
