"""Open a recording of any supported format."""

from __future__ import annotations

from pathlib import Path

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.sources import BAG_SUFFIXES, Source, TimeWindow


def open_source(
    path: str | Path, topic: str | None = None, start_s: float = 0.0, duration_s: float | None = None
) -> Source:
    """Open a rosbag2 folder, a single .mcap or .db3 file, a ROS 1 .bag or a video file.

    `start_s` and `duration_s` select a time window from the first image. Raise UsageError if the topic is ambiguous or
    missing, InputError if the file cannot be read.
    """
    path, window = Path(path), TimeWindow(start_s, duration_s)
    _check_readable(path)
    if path.is_dir() or path.suffix.lower() in BAG_SUFFIXES:
        from autocalib_ros.offline.recordings.bags import BagSource  # lazy import: videos do not need rosbags

        return BagSource(path, topic, window)
    if path.suffix == '.zstd':
        raise InputError(
            f'{path} is a compressed part of a recording: give the folder with its metadata.yaml, or decompress the'
            ' file first (zstd -d)'
        )
    if topic is not None:
        raise UsageError(f'{path} is a video and has no topics')
    from autocalib_ros.offline.recordings.videos import VideoSource

    return VideoSource(path, window)


def _check_readable(path: Path) -> None:
    try:
        if not path.exists():
            raise InputError(f'{path} does not exist')
        if path.is_dir():
            return
        if not path.is_file():
            raise InputError(f'{path} is neither a file nor a folder')
        with path.open('rb') as stream:
            if not stream.read(1):
                raise InputError(f'{path} is empty (0 bytes)')
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
