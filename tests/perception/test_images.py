"""Every encoding against a reference made here by hand."""

from __future__ import annotations

import array
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hostile_files import jpeg_of, png_of

from autocalib_ros.errors import InputError
from autocalib_ros.perception.images import ImageDecoder

HEIGHT, WIDTH = 12, 16


def scene() -> np.ndarray:
    """Return a BGR picture of smooth colours."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([40 + 10 * x, 60 + 12 * y, 200 - 5 * x - 3 * y], axis=-1).astype(np.uint8)


def message(
    encoding: str,
    rows: np.ndarray,
    *,
    padding: int = 0,
    width: int = WIDTH,
    height: int = HEIGHT,
    is_bigendian: int = 0,
    as_array: bool = False,
) -> SimpleNamespace:
    """Return a message of rows (n, bytes), each followed by `padding` bytes."""
    rows = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), -1)
    step = rows.shape[1] + padding
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=77).ravel()
    data.flags.writeable = False
    return SimpleNamespace(
        encoding=encoding,
        width=width,
        height=height,
        step=step,
        is_bigendian=is_bigendian,
        data=array.array('B', data.tobytes()) if as_array else data,
    )


def decoded(msg: SimpleNamespace) -> np.ndarray:
    image = ImageDecoder().decode(msg)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    return image


@pytest.mark.parametrize('as_array', [False, True])
@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize(
    ('encoding', 'order'),
    [
        ('bgr8', [0, 1, 2]),
        ('rgb8', [2, 1, 0]),
        ('8UC3', [0, 1, 2]),
        ('bgra8', [0, 1, 2, 0]),
        ('rgba8', [2, 1, 0, 0]),
        ('8UC4', [0, 1, 2, 0]),
        ('BGR8', [0, 1, 2]),
    ],
)
def test_colours_are_put_in_order(encoding, order, padding, as_array):
    image = decoded(message(encoding, scene()[:, :, order], padding=padding, as_array=as_array))
    assert np.array_equal(image, scene())


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
def test_grey_stays_grey(encoding, padding):
    assert np.array_equal(decoded(message(encoding, scene()[:, :, 0], padding=padding)), scene()[:, :, 0])


@pytest.mark.parametrize(('encoding', 'rows'), [('mono8', scene()[:, :, 0]), ('bgr8', scene())])
def test_images_without_conversion_are_not_copied(encoding, rows):
    msg = message(encoding, rows)
    assert np.shares_memory(ImageDecoder().decode(msg), msg.data)


@pytest.mark.parametrize('is_bigendian', [0, 1])
@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
def test_16_bit_grey_fills_the_range(encoding, padding, is_bigendian):
    grey = np.linspace(300, 4000, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)  # a 12-bit camera
    rows = grey.astype('>u2' if is_bigendian else '<u2')
    image = decoded(message(encoding, rows, padding=padding, is_bigendian=is_bigendian))
    low, high = np.percentile(grey.astype(int), [1, 99])
    # rounding to a grey level
    assert np.abs(image - np.clip((grey - low) / (high - low) * 255, 0, 255)).max() <= 1


@pytest.mark.parametrize('is_bigendian', [0, 1])
@pytest.mark.parametrize(
    ('encoding', 'order'),
    [
        ('bgr16', [0, 1, 2]),
        ('rgb16', [2, 1, 0]),
        ('16UC3', [0, 1, 2]),
        ('bgra16', [0, 1, 2, 0]),
        ('rgba16', [2, 1, 0, 0]),
    ],
)
def test_16_bit_colours_keep_their_proportion(encoding, order, is_bigendian):
    wide = scene().astype(int) * 257
    low, high = np.percentile(wide, [1, 99])
    rows = wide[:, :, order].astype('>u2' if is_bigendian else '<u2')
    image = decoded(message(encoding, rows, is_bigendian=is_bigendian))
    assert np.abs(image - np.clip((wide - low) / (high - low) * 255, 0, 255)).max() <= 1


@pytest.mark.parametrize('is_bigendian', [0, 1])
@pytest.mark.parametrize('padding', [0, 6])
def test_signed_counts_fill_the_range(padding, is_bigendian):
    grey = np.linspace(-300, 900, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)  # tenths of a degree Celsius
    image = decoded(
        message('16SC1', grey.astype('>i2' if is_bigendian else '<i2'), padding=padding, is_bigendian=is_bigendian)
    )
    low, high = np.percentile(grey.astype(int), [1, 99])
    assert np.abs(image - np.clip((grey - low) / (high - low) * 255, 0, 255)).max() <= 1


@pytest.mark.parametrize('is_bigendian', [0, 1])
@pytest.mark.parametrize('padding', [0, 4])
def test_temperatures_fill_the_range_and_nan_is_black(padding, is_bigendian):
    kelvin = np.linspace(283.0, 310.0, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    low, high = np.percentile(kelvin, [1, 99])
    holes = kelvin.copy()
    holes[3, 5:8] = np.nan, np.nan, -np.inf
    image = decoded(
        message('32FC1', holes.astype('>f4' if is_bigendian else '<f4'), padding=padding, is_bigendian=is_bigendian)
    )
    assert (image[3, 5:8] == 0).all()
    there = np.isfinite(holes)
    # the holes move the percentiles by a pixel or two
    assert np.abs(image - np.clip((kelvin - low) / (high - low) * 255, 0, 255))[there].max() <= 4


def test_temperatures_that_are_none_at_all_give_a_black_picture():
    assert not decoded(message('32FC1', np.full((HEIGHT, WIDTH), np.nan, '<f4'))).any()


def stamped(msg: SimpleNamespace, time_s: float) -> SimpleNamespace:
    msg.header = SimpleNamespace(stamp=SimpleNamespace(sec=100 + int(time_s), nanosec=round(time_s % 1 * 1e9)))
    return msg


@pytest.mark.parametrize('interval_s', [0.05, 0.4])
def test_the_stretch_follows_time_and_not_the_number_of_images(interval_s):
    decoder, rng = ImageDecoder(), np.random.default_rng(0)
    grey = rng.integers(1000, 2000, (HEIGHT, WIDTH))
    hot = grey.copy()
    hot[:3, :5] = 4000  # a lorry with its exhaust, 8 % of the image
    before = decoder.decode(stamped(message('mono16', grey.astype('<u2')), 0.0)).astype(int)
    noise = iter(range(10**6))
    shift = {}
    for time_s in np.arange(interval_s, 60.0, interval_s):
        image = decoder.decode(stamped(message('mono16', (hot + next(noise) % 2).astype('<u2')), time_s))
        shift[round(time_s, 2)] = np.abs(image[4:].astype(int) - before[4:]).max()
    # 255 levels held 1000 counts and will hold 3000: two eases of 20 s make 2.6 % of that way in 5 s, 80 % in a minute
    assert shift[5.2 if interval_s == 0.4 else 5.0] == pytest.approx(13, abs=4)
    assert 90 < shift[59.6 if interval_s == 0.4 else 59.95] < 170


def test_a_common_offset_of_all_pixels_changes_no_grey_level():
    decoder, rng = ImageDecoder(), np.random.default_rng(0)
    grey = rng.integers(1000, 2000, (HEIGHT, WIDTH))
    before = decoder.decode(message('mono16', grey.astype('<u2'))).astype(int)
    for offset in (3, 5, 400, -300):
        after = decoder.decode(message('mono16', (grey + offset).astype('<u2'))).astype(int)
        assert np.abs(after - before).max() <= 1


def test_one_flash_leaves_the_stretch_as_it_was():
    decoder, rng = ImageDecoder(), np.random.default_rng(0)
    grey = rng.integers(1000, 2000, (HEIGHT, WIDTH)).astype('<u2')
    before = decoder.decode(message('mono16', grey)).astype(int)
    decoder.decode(message('mono16', grey * 20))
    after = decoder.decode(message('mono16', grey)).astype(int)
    assert np.abs(after - before).max() < 8


def test_a_scene_that_has_left_the_limits_gets_new_ones():
    decoder, rng = ImageDecoder(), np.random.default_rng(0)
    grey = rng.integers(1000, 2000, (HEIGHT, WIDTH))
    decoder.decode(stamped(message('mono16', grey.astype('<u2')), 0.0))
    for index in range(30):  # the sun comes out over a 12-bit camera
        image = decoder.decode(stamped(message('mono16', (3 * grey + index % 2).astype('<u2')), 0.1 + 0.1 * index))
    assert (image == 255).mean() < 0.03 and (image == 0).mean() < 0.03


def test_a_dark_start_does_not_fix_the_stretch():
    decoder = ImageDecoder()
    decoder.decode(message('mono16', np.zeros((HEIGHT, WIDTH), '<u2')))
    grey = np.linspace(300, 4000, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype('<u2')
    assert np.ptp(decoder.decode(message('mono16', grey))) > 240


def mosaic(pattern: str, colour: dict[str, int]) -> np.ndarray:
    """Return a Bayer mosaic of one colour, its first two rows beginning with the pattern's letters."""
    cell = np.array([colour[letter] for letter in pattern]).reshape(2, 2)
    return np.tile(cell, (HEIGHT // 2, WIDTH // 2))


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_patterns_are_named_as_ros_names_them(pattern):
    image = decoded(message(f'bayer_{pattern}8', mosaic(pattern, {'r': 200, 'g': 120, 'b': 40}).astype(np.uint8)))
    assert (image == [40, 120, 200]).all()


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_16_bit_bayer_is_stretched_and_then_coloured(pattern):
    rows = mosaic(pattern, {'r': 40000, 'g': 20000, 'b': 0}).astype('<u2')
    image = decoded(message(f'bayer_{pattern}16', rows))
    assert np.abs(image.astype(int) - [0, 128, 255]).max() <= 1


def yuv_of_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Y, U, V (ITU-R BT.601, limited range) of a grey-blue picture whose colour is the same everywhere."""
    y = (30 + 10 * np.mgrid[:HEIGHT, :WIDTH][1]).astype(np.uint8)
    return y, np.full_like(y, 150), np.full_like(y, 110)


def bgr_of(y: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    y, u, v = 1.164 * (y.astype(float) - 16), u.astype(float) - 128, v.astype(float) - 128
    return np.clip(np.stack([y + 2.018 * u, y - 0.813 * v - 0.391 * u, y + 1.596 * v], axis=-1), 0, 255)


@pytest.mark.parametrize('padding', [0, 4])
@pytest.mark.parametrize(
    ('encoding', 'layout'), [('yuv422', 'uyvy'), ('uyvy', 'uyvy'), ('yuv422_yuy2', 'yuyv'), ('yuyv', 'yuyv')]
)
def test_yuv422_in_both_orders(encoding, layout, padding):
    y, u, v = yuv_of_scene()
    planes = {'y': iter((y[:, 0::2], y[:, 1::2])), 'u': iter((u[:, ::2],)), 'v': iter((v[:, ::2],))}
    rows = np.stack([next(planes[letter]) for letter in layout], axis=-1).reshape(HEIGHT, -1)
    image = decoded(message(encoding, rows, padding=padding))
    # OpenCV computes in integers
    assert np.abs(image - bgr_of(y, u, v)).max() <= 2


@pytest.mark.parametrize('padding', [0, 4])
def test_nv21(padding):
    y, u, v = yuv_of_scene()
    chroma = np.stack([v[::2, ::2], u[::2, ::2]], axis=-1).reshape(HEIGHT // 2, WIDTH)
    image = decoded(message('nv21', np.concatenate([y, chroma]), padding=padding))
    assert np.abs(image - bgr_of(y, u, v)).max() <= 2


@pytest.mark.parametrize('name', ['nv12', 'NV12'])
@pytest.mark.parametrize('padding', [0, 4])
def test_nv12(padding, name):
    y, u, v = yuv_of_scene()
    chroma = np.stack([u[::2, ::2], v[::2, ::2]], axis=-1).reshape(HEIGHT // 2, WIDTH)
    image = decoded(message(name, np.concatenate([y, chroma]), padding=padding))
    assert np.abs(image - bgr_of(y, u, v)).max() <= 2


@pytest.mark.parametrize('padding', [0, 4])
def test_yuv420(padding):
    y, u, v = yuv_of_scene()
    u[:, WIDTH // 2 :] += 30  # a mix-up of planes would put the change elsewhere
    v[HEIGHT // 2 :] += 30
    half = np.pad(np.concatenate([u[::2, ::2], v[::2, ::2]]), ((0, 0), (0, padding // 2)))
    msg = message('yuv420', np.concatenate([np.pad(y, ((0, 0), (0, padding))).ravel(), half.ravel()])[None])
    msg.step = WIDTH + padding
    assert np.abs(decoded(msg) - bgr_of(y, u, v)).max() <= 2


def test_nv24():
    y, u, v = yuv_of_scene()
    data = np.concatenate([y.ravel(), np.stack([u, v], axis=-1).ravel()])
    image = decoded(message('nv24', data.reshape(3 * HEIGHT, WIDTH)))
    assert np.abs(image - bgr_of(y, u, v)).max() <= 2


def test_nv21_whose_step_counts_all_planes():
    y, u, v = yuv_of_scene()
    chroma = np.stack([v[::2, ::2], u[::2, ::2]], axis=-1).reshape(HEIGHT // 2, WIDTH)
    msg = message('nv21', np.concatenate([y, chroma]))
    msg.step = 2 * WIDTH
    assert np.abs(decoded(msg) - bgr_of(y, u, v)).max() <= 2


def compressed(data: bytes, said: str) -> SimpleNamespace:
    return SimpleNamespace(format=said, data=array.array('B', data))


def test_jpeg_is_recognised_by_content_not_by_format():
    data = cv2.imencode('.jpg', scene(), [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    image = decoded(compressed(data, 'rgb8; png compressed'))
    # chroma is halved by JPEG
    assert np.abs(image.astype(int) - scene()).mean() < 4


@pytest.mark.parametrize('step', [0, WIDTH, 3])
def test_a_wrong_step_is_no_hindrance_where_the_data_are_complete(step):
    msg = message('bgr8', scene())
    msg.step = step
    assert np.array_equal(ImageDecoder().decode(msg), scene())


def test_an_odd_width_of_pairs_of_pixels_is_refused_in_words():
    msg = message('bgr8', scene())
    vars(msg).update(encoding='yuv422_yuy2', width=15)
    with pytest.raises(InputError, match="'yuv422_yuy2' needs an even width, found 15"):
        ImageDecoder().decode(msg)


def test_tiff_is_exact():
    data = cv2.imencode('.tiff', scene())[1].tobytes()
    assert np.array_equal(decoded(compressed(data, 'bgr8; tiff compressed bgr8')), scene())


@pytest.mark.parametrize('padding', [0, 10, 8192])
def test_padding_behind_a_jpeg_is_no_truncation(padding):
    assert decoded(compressed(JPEG + bytes(padding), 'jpeg')).shape == scene().shape


def test_a_truncated_jpeg_with_a_thumbnail_is_truncated():
    with_thumbnail = JPEG[:2] + b'\xff\xe1' + (len(JPEG) + 2).to_bytes(2, 'big') + JPEG + JPEG[2:]
    assert decoded(compressed(with_thumbnail, 'jpeg')).shape == scene().shape
    with pytest.raises(InputError, match='is a JPEG truncated'):
        ImageDecoder().decode(compressed(with_thumbnail[:-20], 'jpeg'))


def test_png_is_exact_and_grey_stays_grey():
    data = cv2.imencode('.png', scene()[:, :, 0])[1].tobytes()
    assert np.array_equal(decoded(compressed(data, 'jpeg')), scene()[:, :, 0])


def test_16_bit_png_is_stretched():
    grey = np.linspace(300, 4000, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)
    assert np.ptp(decoded(compressed(cv2.imencode('.png', grey)[1].tobytes(), 'mono16; png compressed'))) > 250


def test_a_compressed_bayer_mosaic_is_coloured():
    rows = mosaic('rggb', {'r': 200, 'g': 120, 'b': 40}).astype(np.uint8)
    image = decoded(compressed(cv2.imencode('.png', rows)[1].tobytes(), 'bayer_rggb8; png compressed '))
    assert (image == [40, 120, 200]).all()


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'encoding': '32FC2'}, "image encoding '32FC2' is not supported"),
        ({'encoding': ''}, "image encoding '' is not supported"),
        ({'data': b'\0' * 100}, r"'bgr8' needs 576 bytes \(12 rows of 48\), found 100"),
        ({'data': b''}, r"'bgr8' needs 576 bytes \(12 rows of 48\), found 0"),
        ({'step': 16, 'data': b'\0' * 575}, 'needs rows of 48 bytes, but its step is 16'),
        ({'width': 0}, "'bgr8' has no pixels: 0 x 12"),
        ({'height': 0}, "'bgr8' has no pixels: 16 x 0"),
        ({'width': 20_000, 'height': 20_000}, '20000x20000 pixels, more than 100 million'),
    ],
)
def test_a_broken_image_is_refused_with_the_reason(change, reason):
    msg = message('bgr8', scene())
    vars(msg).update(change)
    with pytest.raises(InputError, match=reason):
        ImageDecoder().decode(msg)


@pytest.mark.parametrize('encoding', ['nv12', 'nv21', 'nv24', 'yuv420', 'yuv422'])
def test_a_short_planar_image_is_refused_with_the_lengths(encoding):
    with pytest.raises(InputError, match=f"'{encoding}'.*(needs|step)"):
        ImageDecoder().decode(message(encoding, scene()[:, :, 0]))


JPEG = cv2.imencode('.jpg', scene())[1].tobytes()


@pytest.mark.parametrize(
    ('data', 'said', 'reason'),
    [
        (JPEG, '16UC1; compressedDepth png', 'holds depths'),
        (JPEG[: len(JPEG) // 2], 'jpeg', 'is a JPEG truncated after'),
        (b'GIF89a' + bytes(20), 'jpeg', 'no JPEG, PNG, TIFF or WebP, it begins with 47 49 46'),
        (b'', 'jpeg', 'it begins with nothing'),
        (b'\x89PNG\r\n\x1a\n' + bytes(50), 'png', 'cannot be decoded'),
        (b'\0\0\0\x01\x67\x42', 'h264', 'is a packet of H.264 or H.265 video'),
        (cv2.imencode('.tiff', np.ones((4, 4), np.float32))[1].tobytes(), 'tiff', 'holds float32'),
    ],
)
def test_a_broken_compressed_image_is_refused_with_the_reason(data, said, reason):
    with pytest.raises(InputError, match=reason):
        ImageDecoder().decode(compressed(data, said))


def test_an_encoding_without_colours_is_warned_of_once(caplog):
    decoder = ImageDecoder()
    for _ in range(3):
        decoder.decode(message('8UC3', scene()))
    assert [record.message for record in caplog.records] == [
        "image encoding '8UC3' has no channel order; interpreted as bgr8"
    ]


@pytest.mark.parametrize('bomb', [png_of(30000, 30000), jpeg_of(20000, 20000)])
def test_a_compressed_image_that_would_fill_the_memory_is_not_decoded(bomb):
    with pytest.raises(InputError, match=r'cannot be decoded: the picture has \d+x\d+ pixels, more than 100 million'):
        ImageDecoder().decode(compressed(bomb, 'png'))
