"""The size of an encoded picture by its header, so that none is decoded that would fill the memory.

A PNG of 100 kB can hold 30000 x 30000 pixels. Pillow reads the headers: OpenCV has no function for that.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.util.input_limits import MAX_IMAGE_PIXELS

PLUGINS = (
    (b'\xff\xd8', 'JpegImagePlugin', 'JpegImageFile'),
    (b'\x89PNG', 'PngImagePlugin', 'PngImageFile'),
    (b'II*\0', 'TiffImagePlugin', 'TiffImageFile'),
    (b'MM\0*', 'TiffImagePlugin', 'TiffImageFile'),
    (b'BM', 'BmpImagePlugin', 'BmpImageFile'),
    (b'P', 'PpmImagePlugin', 'PpmImageFile'),
    (b'\xff\x4f\xff\x51', 'Jpeg2KImagePlugin', 'Jpeg2KImageFile'),
    (b'\0\0\0\x0cjP', 'Jpeg2KImagePlugin', 'Jpeg2KImageFile'),
)
"""First bytes of pictures, and what of Pillow reads their headers. `Image.open` would warn of large ones itself."""
WEBP_SIDES = {b'VP8 ': (26, 2, 0x3FFF, 0), b'VP8L': (21, 0, 0x3FFF, 1), b'VP8X': (24, 3, 0xFFFFFF, 1)}
"""Of each kind of WebP: position of the sides, bytes of one (0: packed in 14 bits), their bits, and what to add.
Pillow would reserve the memory of the picture at once."""


def check_picture(data: bytes | memoryview, limit: int = MAX_IMAGE_PIXELS) -> None:
    """Raise InputError if an encoded picture has more than `limit` pixels, or a header that cannot be read."""
    require_pixels(*picture_size(data), limit)


def require_pixels(width: int, height: int, limit: int = MAX_IMAGE_PIXELS) -> None:
    """Raise InputError for a picture of more than `limit` pixels."""
    if width * height > limit:
        raise InputError(
            f'the picture has {width}x{height} pixels, more than {limit // 1_000_000} million: it is not decoded'
        )


def read_picture_bytes(path: Path) -> np.ndarray:
    """Return the bytes of an encoded picture, uint8; InputError as of `check_picture`, or if it cannot be read."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    check_picture(data.data)
    return data


def picture_size(data: bytes | memoryview) -> tuple[int, int]:
    """Return width and height in pixels that the header of a picture states; InputError if it states none."""
    head = bytes(data[:32])
    try:
        if head[:4] == b'RIFF' and head[8:12] == b'WEBP':
            return _webp_size(head)
        plugin = next((names for start, *names in PLUGINS if head.startswith(start)), None)
        if plugin is None:
            raise InputError('it is of no known format of pictures')
        return _pillow_size(data, *plugin)
    except InputError:
        raise
    except Exception as error:  # damaged headers raise arbitrary exceptions
        raise InputError(f'the header of the picture is damaged ({" ".join(str(error).split())[:100]})') from error


def _pillow_size(data: bytes | memoryview, module: str, name: str) -> tuple[int, int]:
    from importlib import import_module

    kind: Any = getattr(import_module(f'PIL.{module}'), name)
    with kind(io.BytesIO(data)) as picture:
        width, height = picture.size
    return int(width), int(height)


def _webp_size(head: bytes) -> tuple[int, int]:
    position, bytes_each, mask, extra = WEBP_SIDES[head[12:16]]
    if bytes_each:
        sides = [head[position + side * bytes_each :][:bytes_each] for side in (0, 1)]
        width, height = (int.from_bytes(side, 'little') for side in sides)
    else:
        packed = int.from_bytes(head[position : position + 4], 'little')
        width, height = packed, packed >> 14
    return (width & mask) + extra, (height & mask) + extra
