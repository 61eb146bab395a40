"""Decode sensor_msgs images to grey (H, W) or BGR (H, W, 3) uint8, without cv_bridge.

Messages are read by attribute, so those of rclpy (data is an array.array) and of rosbags (data is a read-only ndarray)
both work. An image that needs no conversion is returned as a view of the message data.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.perception.intensity_normalisation import IntensityNormaliser
from autocalib_ros.util.picture_size import check_picture, require_pixels

LOG = logging.getLogger(__name__)

COLOUR_CODES: dict[str, int | None] = {
    'rgb': cv2.COLOR_RGB2BGR,
    'bgr': None,
    'rgba': cv2.COLOR_RGBA2BGR,
    'bgra': cv2.COLOR_BGRA2BGR,
    'mono': None,
    # OpenCV names a Bayer pattern by the second and third pixel of its second row, ROS by the first ones
    'bayer_rggb': cv2.COLOR_BayerBG2BGR,
    'bayer_bggr': cv2.COLOR_BayerRG2BGR,
    'bayer_gbrg': cv2.COLOR_BayerGR2BGR,
    'bayer_grbg': cv2.COLOR_BayerGB2BGR,
}
CHANNELS = {'rgb': 3, 'bgr': 3, 'rgba': 4, 'bgra': 4}
PACKED_ENCODINGS = {
    **{f'{order}{bits}': (order, bits) for order in COLOUR_CODES for bits in (8, 16)},
    '8UC1': ('mono', 8),
    '8UC3': ('bgr', 8),
    '8UC4': ('bgra', 8),
    '16UC1': ('mono', 16),
    '16UC3': ('bgr', 16),
    '16SC1': ('mono', 16),
    '32FC1': ('mono', 32),
}
"""Encoding to channel order and bits per channel; more than 8 bits are stretched to 8.

Data of 10, 12 or 14 bits come in 16, left- or right-aligned. The Allied Vision driver calls its Bayer images of 10 and
12 bits 16SC1; thermal drivers send temperatures as 32FC1 or 16SC1, with or without NaN. Bit-packed formats (Mono10p,
BayerRG12Packed) are unpacked by their drivers.
"""
NUMBER_FORMATS = {'16SC1': 'i2', '32FC1': 'f4'}
"""NumPy type of encodings that are not unsigned integers."""
YUV422_ENCODINGS = {
    'yuv422': cv2.COLOR_YUV2BGR_UYVY,
    'uyvy': cv2.COLOR_YUV2BGR_UYVY,
    'yuv422_yuy2': cv2.COLOR_YUV2BGR_YUY2,
    'yuyv': cv2.COLOR_YUV2BGR_YUY2,
}
ASSUMED_ENCODINGS = {'8UC1': 'mono8', '8UC3': 'bgr8', '8UC4': 'bgra8', '16UC3': 'bgr16'}
"""Encodings without a channel order, and the interpretation assumed for them."""
BT601 = np.array(
    [
        [1.164, 2.018, 0.0, -16 * 1.164 - 128 * 2.018],
        [1.164, -0.391, -0.813, -16 * 1.164 + 128 * (0.391 + 0.813)],
        [1.164, 0.0, 1.596, -16 * 1.164 - 128 * 1.596],
    ]
)
"""ITU-R BT.601, limited range: B, G, R from Y, U, V, 1."""
CONTAINERS = (b'\xff\xd8\xff', b'\x89PNG\r\n\x1a\n', b'II*\0', b'MM\0*', b'RIFF')
"""First bytes of JPEG, PNG, TIFF of either byte order, and WebP."""
VIDEO_STARTS = (b'\0\0\0\x01', b'\0\0\x01')
"""First bytes of a packet of H.264 or H.265."""
SCAN_START, JPEG_END = b'\xff\xda', b'\xff\xd9'


class ImageDecoder:
    """Decodes the images of one stream; its only state is the intensity range of images of more than 8 bits."""

    def __init__(self) -> None:
        self._normaliser = IntensityNormaliser()
        self._warned: set[str] = set()

    def decode(self, message: Any) -> np.ndarray:
        """Return a sensor_msgs Image or CompressedImage as grey or BGR uint8; the message is unchanged.

        The result may be a read-only view of the message. InputError if it cannot be decoded.
        """
        try:
            if hasattr(message, 'encoding'):
                return self._raw(message)
            return self._compressed(message)
        except cv2.error as error:
            what = getattr(message, 'encoding', '') or getattr(message, 'format', '')
            raise InputError(f"image of encoding '{what}' cannot be converted: {_first_line(error)}") from error

    def _raw(self, message: Any) -> np.ndarray:
        encoding = canonical_encoding(message.encoding)
        if message.width < 1 or message.height < 1:
            raise InputError(f"image of encoding '{encoding}' has no pixels: {message.width} x {message.height}")
        require_pixels(int(message.width), int(message.height))
        if encoding in ASSUMED_ENCODINGS:
            self._warn_once(encoding)
        if encoding in PACKED_ENCODINGS:
            return self._packed(message, encoding)
        if encoding in YUV422_ENCODINGS:
            if message.width % 2:
                raise InputError(f"image of encoding '{encoding}' needs an even width, found {message.width}")
            pixels = image_rows(message, 2 * message.width, 1).reshape(message.height, message.width, 2)
            return cv2.cvtColor(np.ascontiguousarray(pixels), YUV422_ENCODINGS[encoding])
        if encoding in PLANAR_ENCODINGS:
            return PLANAR_ENCODINGS[encoding](message)
        raise InputError(f"image encoding '{encoding}' is not supported")

    def _packed(self, message: Any, encoding: str) -> np.ndarray:
        order, bits = PACKED_ENCODINGS[encoding]
        channels = CHANNELS.get(order, 1)
        rows = image_rows(message, message.width * channels * bits // 8, 1)
        if bits > 8:
            numbers = NUMBER_FORMATS.get(encoding, f'u{bits // 8}')
            rows = np.ascontiguousarray(rows).view(('>' if message.is_bigendian else '<') + numbers)
            rows = self._normaliser.to_8_bit(rows, message.encoding, _stamp_s(message))
        pixels = rows.reshape(message.height, message.width, channels) if channels > 1 else rows
        code: int | None = COLOUR_CODES[order]
        pixels = np.ascontiguousarray(pixels)
        return pixels if code is None else cv2.cvtColor(pixels, code)

    def _compressed(self, message: Any) -> np.ndarray:
        stated_format = str(message.format)
        if 'compressedDepth' in stated_format:
            raise InputError(f"compressed image of format '{stated_format}' holds depths, not intensities")
        image = decompress(np.frombuffer(message.data, np.uint8), stated_format)
        if image.dtype == np.uint16:
            image = self._normaliser.to_8_bit(image, stated_format, _stamp_s(message))
        # image_transport compresses a raw Bayer mosaic as grey and names the pattern in the format
        pattern = stated_format.split(';')[0].rstrip('168')
        if image.ndim == 2 and pattern.startswith('bayer_') and pattern in COLOUR_CODES:
            code = COLOUR_CODES[pattern]
            return image if code is None else cv2.cvtColor(image, code)
        return image

    def _warn_once(self, encoding: str) -> None:
        if encoding not in self._warned:
            self._warned.add(encoding)
            LOG.warning(
                "image encoding '%s' has no channel order; interpreted as %s", encoding, ASSUMED_ENCODINGS[encoding]
            )


def image_rows(message: Any, row_bytes: int, planes: float) -> np.ndarray:
    """Return the image rows without padding as a view of shape (rows, row_bytes); InputError if data are missing.

    `planes` is the number of rows divided by the image height.
    """
    data, rows, step = np.frombuffer(message.data, np.uint8), int(message.height * planes), message.step
    if step < row_bytes and len(data) == rows * row_bytes:
        step = row_bytes  # drivers give 0, the width or the bytes of a pixel; the length tells that nothing is missing
    if step < row_bytes:
        raise InputError(
            f"image of encoding '{message.encoding}' and width {message.width} needs rows of {row_bytes}"
            f' bytes, but its step is {message.step}'
        )
    expected = step * rows
    if len(data) < expected:
        raise InputError(
            f"image of encoding '{message.encoding}' needs {expected} bytes ({rows} rows of {step}), found {len(data)}"
        )
    return data[:expected].reshape(rows, step)[:, :row_bytes]


def canonical_encoding(encoding: str) -> str:
    """Return the canonical name of an encoding: some drivers write NV12 or YUV420 in capitals."""
    lower = encoding.lower()
    return (
        lower
        if encoding not in PACKED_ENCODINGS
        and (lower in YUV422_ENCODINGS or lower in PLANAR_ENCODINGS or lower in PACKED_ENCODINGS)
        else encoding
    )


def _nv21(message: Any) -> np.ndarray:
    """Decode a Y plane at full size followed by interleaved V and U at half height and width."""
    rows = image_rows(PlanarMessage(message, 1.5), message.width, 1.5)
    return cv2.cvtColor(np.ascontiguousarray(rows), cv2.COLOR_YUV2BGR_NV21)


def _nv12(message: Any) -> np.ndarray:
    """Decode a Y plane followed by interleaved U and V; published by Isaac ROS and drivers of D-Robotics boards."""
    rows = image_rows(PlanarMessage(message, 1.5), message.width, 1.5)
    return cv2.cvtColor(np.ascontiguousarray(rows), cv2.COLOR_YUV2BGR_NV12)


def _yuv420(message: Any) -> np.ndarray:
    """Decode a Y plane at full size followed by U and V planes at half height and width, with half the step.

    Published by the robotics SDK of TI and by nodes around libcamera-vid.
    """
    message = PlanarMessage(message, 1.5)
    height, width, step = message.height, message.width, message.step
    if height % 2 or width % 2 or step % 2:
        raise InputError(
            f"image of encoding '{message.encoding}' needs an even size and step, found {width} x {height} and {step}"
        )
    rows = image_rows(message, width, 1.5)
    chroma = np.frombuffer(message.data, np.uint8)[step * height : step * height * 3 // 2].reshape(height, step // 2)
    half = np.ascontiguousarray(chroma[:, : width // 2]).reshape(height // 2, width)
    return cv2.cvtColor(np.concatenate([rows[:height], half]), cv2.COLOR_YUV2BGR_I420)


def _nv24(message: Any) -> np.ndarray:
    """Decode Y at full size followed by interleaved U and V at full size; OpenCV has no conversion for it."""
    message = PlanarMessage(message, 3)
    height, width, step = message.height, message.width, message.step
    image_rows(message, width, 3)
    data = np.frombuffer(message.data, np.uint8)
    luma = data[: step * height].reshape(height, step)[:, :width, None]
    chroma = data[step * height : 3 * step * height].reshape(height, 2 * step)[:, : 2 * width].reshape(height, width, 2)
    return cv2.transform(np.concatenate([luma, chroma], axis=2), BT601)


PLANAR_ENCODINGS: dict[str, Callable[[Any], np.ndarray]] = {
    'nv12': _nv12,
    'nv21': _nv21,
    'nv24': _nv24,
    'yuv420': _yuv420,
}


class PlanarMessage:
    """View of a planar message whose step is that of the luma plane.

    Drivers disagree on `step`: bytes of a luma row, or bytes of all planes per pixel row. The data length decides.
    """

    def __init__(self, message: Any, planes: float) -> None:
        self.encoding, self.data = message.encoding, message.data
        self.width, self.height = message.width, message.height
        tight = len(message.data) == int(message.width * message.height * planes)
        self.step = message.width if tight else message.step


def decompress(data: np.ndarray, stated_format: str) -> np.ndarray:
    """Decode a JPEG, PNG, TIFF or WebP, bytes (n,), with the format stated in its message.

    InputError or cv2.error if it is invalid.
    """
    _check_container(data, stated_format)
    try:
        check_picture(data.data)
    except InputError as error:
        raise InputError(
            f"compressed image of format '{stated_format}', {len(data)} bytes, cannot be decoded: {error}"
        ) from error
    # keep the pixels as the sensor delivered them: applying the EXIF orientation would change the camera geometry
    image = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError(f"compressed image of format '{stated_format}', {len(data)} bytes, cannot be decoded")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"compressed image of format '{stated_format}' holds {image.dtype}, not intensities")
    return image


def _check_container(data: np.ndarray, stated_format: str) -> None:
    """Check the signature: `format` is often wrong, and OpenCV fills the missing part of a truncated JPEG with grey."""
    head = data[:8].tobytes()
    if head.startswith(VIDEO_STARTS):
        raise InputError(
            f"compressed image of format '{stated_format}' is a packet of H.264 or H.265 video, which needs those "
            'before it: decode the stream to images first'
        )
    if not head.startswith(CONTAINERS):
        begin = head.hex(' ') or 'nothing'
        raise InputError(
            f"compressed image of format '{stated_format}' is no JPEG, PNG, TIFF or WebP, it begins with {begin}"
        )
    if head.startswith(CONTAINERS[0]):
        whole = data.tobytes()
        # cameras pad their buffers; a thumbnail in front has its own end, so that the last scan counts
        if whole.rfind(JPEG_END) <= whole.rfind(SCAN_START):
            raise InputError(
                f"compressed image of format '{stated_format}' is a JPEG truncated after {len(data)} bytes"
            )


def _stamp_s(message: Any) -> float | None:
    """Return the stamp of a message in seconds; None if it has none."""
    stamp = getattr(getattr(message, 'header', None), 'stamp', None)
    return None if stamp is None else stamp.sec + 1e-9 * stamp.nanosec


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ['unknown reason'])[0]
