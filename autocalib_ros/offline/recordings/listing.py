"""What a path, a pattern or an address on the command line stands for: one recording, several, or a live stream."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from autocalib_ros.errors import InputError
from autocalib_ros.offline.recordings.sources import BAG_SUFFIXES

STILL_IMAGE_SUFFIXES = ('.jpg', '.jpeg', '.png', '.bmp', '.tif', '.tiff', '.webp', '.pgm', '.ppm', '.jp2')
VIDEO_SUFFIXES = (
    *('.mp4', '.m4v', '.mov', '.avi', '.mkv', '.webm', '.ts', '.mts', '.m2ts', '.mpg', '.mpeg', '.wmv', '.asf', '.flv'),
    *('.3gp', '.ogv', '.h264', '.264', '.h265', '.265', '.hevc', '.mjpg', '.mjpeg', '.y4m', '.dav'),
)
"""Suffixes of videos that are looked for in a folder; a file that is named is tried whatever its suffix."""
PART_SUFFIXES = ('.mcap', '.db3')
"""Of the files of a rosbag2."""
PACKED_SUFFIXES = ('.zstd', '.zst')
"""Of files packed as a whole by rosbag2, or by hand."""
ACTIVE_SUFFIX = '.active'
"""What ROS 1 appends to the name of a recording until it is closed."""
STREAM_SCHEMES = ('rtsp', 'rtsps', 'rtmp', 'http', 'https', 'udp', 'tcp', 'srt', 'rtp')
DEVICE = re.compile(r'/dev/video\d+')
COUNTER = re.compile(r'%0?\d*d')
"""A number in the names of images, as programs with printf write it."""


def is_stream(text: str) -> bool:
    """Return whether this is the address of a stream, or a camera device."""
    return (text.partition('://')[0].lower() in STREAM_SCHEMES and '://' in text) or bool(DEVICE.fullmatch(text))


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Return a key that sorts names by the numbers in them: image2 before image10."""
    parts = re.split(r'(\d+)', path.name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts]


def is_bag(path: Path) -> bool:
    """Return whether a path is named like a ROS recording, packed or not."""
    return bare(path).name.lower().removesuffix(ACTIVE_SUFFIX).endswith(BAG_SUFFIXES)


def bare(path: Path) -> Path:
    """Return a path without the suffix of packed files."""
    return path.with_suffix('') if path.suffix in PACKED_SUFFIXES else path


def recordings_of(arguments: Sequence[str | Path]) -> list[str | Path | list[Path]]:
    """Return the recordings that arguments stand for: paths, addresses of streams, and lists of images in order.

    A folder of clips and a pattern stand for each of them. InputError if there is nothing.
    """
    return [recording for argument in arguments for recording in _recordings(str(argument))]


def _recordings(text: str) -> list[str | Path | list[Path]]:
    if is_stream(text):
        return [text]
    path = Path(text)
    if path.is_dir():
        return _in_folder(path)
    if not path.exists() and (COUNTER.search(text) or glob.has_magic(text)):
        return _in_pattern(text)
    return [[path]] if path.suffix.lower() in STILL_IMAGE_SUFFIXES and path.is_file() else [path]


def _in_folder(folder: Path) -> list[str | Path | list[Path]]:
    """Return the recordings in a folder: itself as a rosbag2, or the images, clips and recordings in it."""
    try:
        inside = sorted((one for one in folder.iterdir() if not one.name.startswith('.')), key=natural_key)
    except OSError as error:
        raise InputError(f'cannot read {folder}: {error.strerror or error}') from error
    if any(one.name == 'metadata.yaml' or bare(one).suffix in PART_SUFFIXES for one in inside):
        return [folder]
    images = [one for one in inside if one.suffix.lower() in STILL_IMAGE_SUFFIXES]
    clips = [one for one in inside if _is_clip(one)]
    if images and clips:
        raise InputError(
            f"{folder} has both {len(images)} images and {len(clips)} clips: give a pattern, as '{folder}/*"
            f"{images[0].suffix}' or '{folder}/*{clips[0].suffix}'"
        )
    if images:
        return [images]
    if not clips:
        raise InputError(
            f'{folder} is not a recording: it has neither a metadata.yaml nor .mcap or .db3 files, and no videos or '
            f'images; it has {_few(inside)}'
        )
    return [*clips]


def _is_clip(path: Path) -> bool:
    if path.is_dir():
        return (path / 'metadata.yaml').exists()
    return path.suffix.lower() in VIDEO_SUFFIXES or path.name.removesuffix(ACTIVE_SUFFIX).endswith('.bag')


def _in_pattern(text: str) -> list[str | Path | list[Path]]:
    pattern = COUNTER.sub('*', text)
    found = sorted((Path(name) for name in glob.glob(pattern)), key=natural_key)
    if not found:
        raise InputError(f'no file fits {text}')
    images = [one for one in found if one.suffix.lower() in STILL_IMAGE_SUFFIXES]
    if images and len(images) < len(found):
        raise InputError(f'{text} fits {len(images)} images and {len(found) - len(images)} other files: give one kind')
    return [images] if images else [*found]


def _few(paths: Sequence[Path]) -> str:
    """Return the first names of a folder, for messages."""
    names = [one.name for one in paths[:4]]
    return (', '.join(names) + (', ...' if len(paths) > len(names) else '')) or 'nothing at all'
