"""Black out `ignore_regions` in image messages without changing their encoding, for recordings that contain images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from autocalib_ros.config import Polygons
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.perception.ignore_regions import ignored_mask
from autocalib_ros.perception.images import (
    CHANNELS,
    NUMBER_FORMATS,
    PACKED_ENCODINGS,
    PLANAR_ENCODINGS,
    YUV422_ENCODINGS,
    PlanarMessage,
    canonical_encoding,
    decompress,
    image_rows,
)

BLACK_LUMA, NO_CHROMA = 16, 128
"""Black in limited-range YUV."""
MASKED_JPEG_QUALITY = 95
"""Quality of re-encoded JPEG images."""


def require_maskable(message: Any) -> None:
    """Raise UsageError unless `mask_message` supports the encoding of a sensor_msgs Image or CompressedImage."""
    if hasattr(message, 'encoding'):
        encoding = canonical_encoding(message.encoding)
        known, kind = (
            encoding in PACKED_ENCODINGS or encoding in YUV422_ENCODINGS or encoding in PLANAR_ENCODINGS,
            f"encoding '{encoding}'",
        )
    else:
        known, kind = 'compressedDepth' not in str(message.format), f"format '{message.format}'"
    if not known:
        raise UsageError(
            f"'ignore_regions' cannot be made black in images of {kind}: write the bag without images, or "
            'remove the option'
        )


def mask_message(message: Any, polygons: Polygons) -> np.ndarray:
    """Return the data (n,) uint8 of an Image or CompressedImage with the polygons blacked out; `message` is unchanged.

    InputError if the image is invalid. Pixels of more than 8 bits get the darkest value outside the polygons: zero
    among counts of 6000 would ruin the contrast of a percentile stretch downstream.
    """
    if not hasattr(message, 'encoding'):
        return _mask_compressed(message, polygons)
    data, pixels = np.frombuffer(message.data, np.uint8).copy(), message.width * message.height
    if not 0 < pixels <= len(data):
        raise InputError(
            f"image of encoding '{message.encoding}' and {message.width} x {message.height} pixels has "
            f'{len(data)} bytes'
        )
    mask, encoding = ignored_mask(polygons, (message.width, message.height)), canonical_encoding(message.encoding)
    if encoding in PACKED_ENCODINGS:
        _mask_packed(_MessageCopy(message, data), mask, encoding)
    elif encoding in YUV422_ENCODINGS:
        _mask_yuv422(
            image_rows(_MessageCopy(message, data), 2 * message.width, 1),
            mask,
            luma_first=YUV422_ENCODINGS[encoding] == cv2.COLOR_YUV2BGR_YUY2,
        )
    else:
        _mask_planar(_MessageCopy(message, data), mask, encoding)
    return data


class _MessageCopy:
    """Header fields of an image message with replaced data."""

    def __init__(self, message: Any, data: np.ndarray) -> None:
        self.encoding, self.width, self.height = message.encoding, message.width, message.height
        self.step, self.is_bigendian, self.data = message.step, message.is_bigendian, data


def _mask_packed(message: Any, mask: np.ndarray, encoding: str) -> None:
    order, bits = PACKED_ENCODINGS[encoding]
    channels = CHANNELS.get(order, 1)
    rows = image_rows(message, message.width * channels * bits // 8, 1)
    numbers = NUMBER_FORMATS.get(encoding, f'u{bits // 8}')
    values = np.ascontiguousarray(rows).view(('>' if message.is_bigendian else '<') + numbers)
    rows[:] = _with_dark_mask(values.reshape(*mask.shape, channels), mask).reshape(len(rows), -1).view(np.uint8)


def _with_dark_mask(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return a copy of values (h, w, channels) whose colours, the first three channels, are dark in the mask (h, w)."""
    dark, rest = values.copy(), values[~mask][:, :3]
    rest = rest[np.isfinite(rest)] if values.dtype.kind == 'f' else rest
    dark[mask, :3] = rest.min() if values.dtype.itemsize > 1 and rest.size else 0
    return dark


def _mask_yuv422(rows: np.ndarray, mask: np.ndarray, *, luma_first: bool) -> None:
    """Black out rows of 4:2:2 data in place; two pixels share a chroma value, so both become grey."""
    pairs = mask.copy()
    even = mask.shape[1] // 2 * 2
    pairs[:, :even] = np.repeat(mask[:, :even:2] | mask[:, 1:even:2], 2, axis=1)
    luma, chroma = (rows[:, 0::2], rows[:, 1::2]) if luma_first else (rows[:, 1::2], rows[:, 0::2])
    luma[mask], chroma[pairs] = BLACK_LUMA, NO_CHROMA


def _mask_planar(message: Any, mask: np.ndarray, encoding: str) -> None:
    planes = 3 if encoding == 'nv24' else 1.5
    message = PlanarMessage(message, planes)
    height, width, step = message.height, message.width, message.step
    image_rows(message, width, planes)[:height][mask] = BLACK_LUMA
    chroma = message.data[step * height : int(step * height * planes)]
    if encoding == 'nv24':
        chroma.reshape(height, 2 * step)[:, : 2 * width][np.repeat(mask, 2, axis=1)] = NO_CHROMA
        return
    if height % 2 or width % 2 or step % 2:
        raise InputError(
            f"image of encoding '{message.encoding}' needs an even size and step, found {width} x {height} and {step}"
        )
    half = mask[::2, ::2] | mask[1::2, ::2] | mask[::2, 1::2] | mask[1::2, 1::2]
    if encoding == 'yuv420':
        chroma.reshape(height, step // 2)[:, : width // 2][np.concatenate([half, half])] = NO_CHROMA
    else:
        chroma.reshape(height // 2, step)[:, :width][np.repeat(half, 2, axis=1)] = NO_CHROMA


def _mask_compressed(message: Any, polygons: Polygons) -> np.ndarray:
    data = np.frombuffer(message.data, np.uint8)
    try:
        image = decompress(data, str(message.format))
    except cv2.error as error:  # an image size too large for memory
        raise InputError(
            f"compressed image of format '{message.format}', {len(data)} bytes, cannot be decoded"
        ) from error
    mask = ignored_mask(polygons, image.shape[1::-1])
    dark = _with_dark_mask(image.reshape(*mask.shape, -1), mask).reshape(image.shape)
    if data[0] == 0xFF:
        return cv2.imencode('.jpg', dark, [cv2.IMWRITE_JPEG_QUALITY, MASKED_JPEG_QUALITY])[1].ravel()
    return cv2.imencode('.png', dark, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel()
