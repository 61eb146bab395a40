"""Sizes of pictures by their headers."""

import struct

import cv2
import numpy as np
import pytest
from hostile_files import jpeg_of, png_of

from autocalib_ros.errors import InputError
from autocalib_ros.util.input_limits import MAX_IMAGE_PIXELS
from autocalib_ros.util.picture_size import check_picture, picture_size, read_picture_bytes

PICTURE = np.random.default_rng(0).integers(0, 255, (37, 53, 3), np.uint8)


def webp(kind: bytes, content: bytes) -> bytes:
    return b'RIFF' + bytes(4) + b'WEBP' + kind + bytes(4) + content + bytes(8)


@pytest.mark.parametrize('suffix', ['.jpg', '.png', '.tiff', '.webp', '.bmp', '.ppm', '.pgm'])
def test_the_size_is_that_of_the_decoded_picture(suffix):
    data = cv2.imencode(suffix, PICTURE[..., 0] if suffix == '.pgm' else PICTURE)[1]
    assert picture_size(data.data) == (53, 37) == cv2.imdecode(data, cv2.IMREAD_COLOR).shape[1::-1]


def test_the_size_of_each_kind_of_webp():
    lossless = cv2.imencode('.webp', PICTURE, [cv2.IMWRITE_WEBP_QUALITY, 101])[1]
    assert picture_size(lossless.data) == (53, 37)
    assert picture_size(webp(b'VP8X', bytes(4) + b'\x0f\x27\0' + b'\x1f\x4e\0')) == (10000, 20000)
    assert picture_size(webp(b'VP8 ', bytes(6) + struct.pack('<HH', 16383, 9))) == (16383, 9)


@pytest.mark.parametrize('bomb', [png_of(30000, 30000), jpeg_of(60000, 60000), png_of(2**31 - 1, 2**31 - 1)])
def test_pictures_that_fill_the_memory_are_refused(bomb, tmp_path):
    width, height = picture_size(bomb)
    with pytest.raises(InputError, match=f'{width}x{height} pixels, more than 100 million: it is not decoded'):
        check_picture(bomb)
    (tmp_path / 'bomb').write_bytes(bomb)
    with pytest.raises(InputError, match='not decoded'):
        read_picture_bytes(tmp_path / 'bomb')


def test_the_limit_itself_is_allowed():
    check_picture(png_of(MAX_IMAGE_PIXELS // 10_000, 10_000))


@pytest.mark.parametrize('data', [b'', b'GIF89a', b'\xff\xd8', b'\xff\xd8\xff\xe0\0\x03J', b'\x89PNG\r\n\x1a\n', b'P6'])
def test_damaged_headers_are_told(data):
    with pytest.raises(InputError, match=r'no known format|is damaged') as told:
        picture_size(data)
    assert '\n' not in str(told.value)
