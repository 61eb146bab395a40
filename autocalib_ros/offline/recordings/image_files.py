"""Image files as a recording: their times come from a rate, from EXIF, or from the files."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.sources import Frame, StoredImage, TimeWindow, no_image_error
from autocalib_ros.util.picture_size import read_picture_bytes

LOG = logging.getLogger(__name__)

LONGEST_INTERVAL_S = 1.0
"""Longest usual interval between images, seconds: vehicles have to be followed from one image to the next, and cross a
junction within a few seconds."""
SHORTEST_INTERVAL_S = 1e-3
"""Shortest usual interval; files that were copied or unpacked have such times."""
EXIF_IFD, EXIF_TIME, EXIF_SUBSECOND = 0x8769, 0x9003, 0x9291
"""Tags of EXIF 2.3: where the photographic data are, DateTimeOriginal, SubSecTimeOriginal."""
MAX_STAMP_NS = 2**63
"""Stamps are nanoseconds in 64 bits, which end in the year 2262."""
EXIF_ORIENTATION, UPRIGHT = 0x0112, 1


class ImageFilesSource:
    """Image files in the order given, as BGR or grey, turned as their EXIF says: as videos are, and told."""

    topic = image_type = camera_frame = ''
    pixel_aspect = 0.0
    is_live = False

    def __init__(self, paths: Sequence[Path], window: TimeWindow, rate_hz: float | None) -> None:
        if len(paths) < 2:
            raise InputError(f'{paths[0]} is one image: traffic needs a sequence of them, give its folder or a pattern')
        self.name = f'{paths[0].parent / "*"}{paths[0].suffix}'
        self._paths, self.window = list(paths), window
        self._stamps_ns, how = _stamps(self._paths, rate_hz)
        LOG.info('%s: times of the images by %s', self.name, how)
        if _orientation(self._paths[0]) > UPRIGHT:
            LOG.warning(
                '%s: images are turned as their EXIF says; those of the live camera may come unturned', self.name
            )
        self._length_s = (self._stamps_ns[-1] - self._stamps_ns[0]) * 1e-9
        self.total: int | None = len(self._chosen)
        self.duration_s: float | None = window.overlap_s(self._length_s)

    @property
    def _chosen(self) -> list[int]:
        """Indices of the images of the window."""
        start_ns, stop_ns = self.window.bounds_ns
        since_ns = (stamp - self._stamps_ns[0] for stamp in self._stamps_ns)
        return [index for index, at in enumerate(since_ns) if at >= start_ns and (stop_ns is None or at < stop_ns)]

    def frames(self) -> Iterator[Frame]:
        """Yield the images of the window; unreadable ones and those of another size are left out and told."""
        size: tuple[int, ...] | None = None
        left_out: list[str] = []
        chosen = self._chosen
        for index in chosen:
            try:
                image = _read(self._paths[index])
                if size is not None and image.shape[:2] != size:
                    raise InputError(f'it has {image.shape[1]}x{image.shape[0]} pixels')
            except InputError as error:
                left_out.append(f'{self._paths[index].name} ({error})')
                continue
            size = (image.shape[0], image.shape[1])
            yield Frame(self._stamps_ns[index], image)
        if size is None:
            raise (
                InputError(f'none of the {len(left_out)} images of {self.name} can be read; the first: {left_out[0]}')
                if left_out
                else no_image_error(self.name, self.window, self._length_s)
            )
        if left_out:
            LOG.warning(
                '%d of %d images cannot be read or have another size than %dx%d, and are left out; the first: %s',
                *(len(left_out), len(chosen), size[1], size[0], left_out[0]),
            )

    def stored(self) -> Iterator[StoredImage]:
        """Yield the stamps of the window."""
        return (StoredImage(self._stamps_ns[index], self._stamps_ns[index], '') for index in self._chosen)


def _read(path: Path) -> np.ndarray:
    """Return an image as grey or BGR uint8; InputError if it cannot be read."""
    try:
        image = cv2.imdecode(read_picture_bytes(path), cv2.IMREAD_ANYCOLOR)
    except cv2.error as error:
        raise InputError('it is damaged') from error
    if image is None or image.ndim not in (2, 3):
        raise InputError('it is damaged, or of a format that OpenCV cannot read')
    return image


def _stamps(paths: list[Path], rate_hz: float | None) -> tuple[list[int], str]:
    """Return the stamps of images in nanoseconds, and where they are from; UsageError if nothing tells them."""
    if rate_hz is not None:
        return [round(index * 1e9 / rate_hz) for index in range(len(paths))], f'the rate of {rate_hz:g} Hz'
    by_exif = _exif_stamps(paths)
    if by_exif is not None and _is_plausible(by_exif):
        return by_exif, 'EXIF'
    by_files = [os.stat(path).st_mtime_ns for path in paths]
    if _is_plausible(by_files):
        LOG.warning(
            'the times of the images are those of their files, %.4g a second; --rate gives another rate',
            (len(paths) - 1) / ((by_files[-1] - by_files[0]) * 1e-9),
        )
        return by_files, 'the files'
    raise UsageError(
        f'neither EXIF nor the files tell when the images of {paths[0].parent} were taken (copies have the time of the '
        'copy): give the images per second with --rate'
    )


def _is_plausible(stamps_ns: list[int]) -> bool:
    """Whether stamps rise from image to image, at intervals of video."""
    intervals_s = np.diff(np.array(stamps_ns, np.int64)) * 1e-9
    return bool((intervals_s > 0).all() and SHORTEST_INTERVAL_S <= np.median(intervals_s) <= LONGEST_INTERVAL_S)


def _orientation(path: Path) -> int:
    """Return the orientation in EXIF, `UPRIGHT` without one."""
    orientation = _exif(path)[0]
    return orientation if isinstance(orientation, int) else UPRIGHT


def _exif_stamps(paths: list[Path]) -> list[int] | None:
    """Return the EXIF times of exposure of images, None if one has none that a stamp of 64 bits holds."""
    stamps = []
    for path in paths:
        tags = _exif(path)[1]
        try:
            taken = datetime.strptime(str(tags[EXIF_TIME]), '%Y:%m:%d %H:%M:%S').replace(tzinfo=timezone.utc)
        except (KeyError, ValueError):
            return None
        digits = str(tags.get(EXIF_SUBSECOND, '')).strip() or '0'
        if not (digits.isascii() and digits.isdecimal()):
            return None
        stamps.append(round(taken.timestamp()) * 10**9 + round(float(f'0.{digits}') * 1e9))
        if abs(stamps[-1]) >= MAX_STAMP_NS:
            return None
    return stamps


def _exif(path: Path) -> tuple[Any, dict[int, Any]]:
    """Return orientation and photographic data in the EXIF of an image; none if it cannot be read."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of large images, which are refused when they are read
            with Image.open(path) as image:
                tags = image.getexif()
                return tags.get(EXIF_ORIENTATION), dict(tags.get_ifd(EXIF_IFD))
    except Exception:  # damaged files raise arbitrary exceptions
        return None, {}
