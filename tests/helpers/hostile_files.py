"""Small files that would fill the memory of whoever unpacks them."""

import io
import struct
import zipfile
import zlib

import cv2
import numpy as np


def png_of(width: int, height: int) -> bytes:
    """Return a PNG whose header states a size, with the pixels of a smaller one."""
    data = cv2.imencode('.png', np.zeros((8, 8), np.uint8))[1].tobytes()
    header = b'IHDR' + struct.pack('>II', width, height) + data[24:29]
    return data[:12] + header + struct.pack('>I', zlib.crc32(header)) + data[33:]


def jpeg_of(width: int, height: int) -> bytes:
    """Return a JPEG whose header states a size of at most 65535, with the pixels of a smaller one."""
    data = bytearray(cv2.imencode('.jpg', np.zeros((8, 8), np.uint8))[1].tobytes())
    start = data.index(b'\xff\xc0') + 5
    data[start : start + 4] = struct.pack('>HH', height, width)
    return bytes(data)


def npy_of(shape: tuple[int, ...], content: bytes = b'') -> bytes:
    """Return an array file of floats whose header states a shape."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {'descr': '<f8', 'fortran_order': False, 'shape': shape})
    return stream.getvalue() + content


def zip_of(members: dict[str, bytes]) -> bytes:
    """Return a packed archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()
