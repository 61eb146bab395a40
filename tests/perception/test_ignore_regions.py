"""Regions that are never tracked and never shown."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy, paste

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.evidence.stillness import ViewChangeKind
from autocalib_ros.perception.ignore_regions import black_out, ignored_mask
from autocalib_ros.perception.images import ImageDecoder
from autocalib_ros.perception.masked_messages import mask_message, require_maskable
from autocalib_ros.perception.observer import Observer

pytestmark = pytest.mark.render

HEIGHT, WIDTH = 200, 400
UPPER = '-10 -10 405 -10 405 99.5 -10 99.5'
"""The upper half of the image and some more."""


def texture(seed: int, shape: tuple[int, int], sigma: float = 1.5) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), sigma)
    return np.clip(128 + 60 * noise / noise.std(), 0, 255)


ROAD, CAR = texture(0, (HEIGHT, WIDTH)) * 0.4 + 60, texture(1, (40, 60))


def scene(
    time_s: float, places: tuple[tuple[float, float], ...], speed: tuple[float, float] = (45.0, 0.0), shift: float = 0.0
) -> np.ndarray:
    """Cars (x, y) that drive over a road, which a camera that moved by `shift` sees elsewhere; grey uint8."""
    image = cv2.warpAffine(
        ROAD, np.array([[1.0, 0, shift], [0, 1.0, 0]]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
    )
    for x, y in places:
        paste(image, CAR, x + speed[0] * time_s + shift, y + speed[1] * time_s)
    return noisy(image, 1.5, int(1000 * time_s))


def watch(options: Options, places: tuple[tuple[float, float], ...], speed: tuple[float, float] = (45.0, 0.0)) -> tuple:
    """Return tracks, ends of segments and of edges, and who watched the cars."""
    observer, tracks, ends = Observer(options, (WIDTH, HEIGHT)), [], []
    for index in range(70):
        time_s = 0.1 * index
        seen = observer.observe(scene(max(0.0, time_s - 1.0), places if index > 10 else (), speed), time_s)
        tracks += seen.tracks
        ends += [lines.ends_px.reshape(-1, 2) for lines in (seen.segments, seen.edges) if lines is not None]
    return tracks + observer.unfinished(), np.concatenate(ends), observer


def test_a_vehicle_inside_a_region_leaves_no_trace() -> None:
    tracks, ends, _ = watch(Options(ignore_regions=UPPER), ((10.0, 20.0), (10.0, 140.0)))
    assert len(tracks) > 5 and len(ends) > 10
    assert min(track.points_px[:, 1].min() for track in tracks) > 100
    assert ends[:, 1].min() > 100
    both, _, _ = watch(Options(), ((10.0, 20.0), (10.0, 140.0)))
    assert min(track.points_px[:, 1].min() for track in both) < 60


def test_a_track_that_enters_a_region_ends() -> None:
    right = '250 0 400 0 400 200 250 200'
    tracks, _, _ = watch(Options(ignore_regions=right), ((150.0, 80.0),))
    assert len(tracks) > 3
    for track in tracks:
        assert track.points_px[:, 0].max() < 250
        # the drift is not that of the static border
        speed = np.diff(track.points_px[:, 0]) / np.diff(track.times_s)
        assert speed.min() > 30
    free, _, _ = watch(Options(), ((150.0, 80.0),))
    assert max(track.points_px[:, 0].max() for track in free) > 300


def test_the_border_of_a_region_does_not_hide_that_the_camera_moved() -> None:
    # the region covers the middle; its border has the strongest corners of all
    observer = Observer(Options(ignore_regions='60 40 340 40 340 160 60 160'), (WIDTH, HEIGHT))
    for index in range(40):
        observer.observe(scene(0.5 * index, (), shift=0.0 if index < 20 else 6.0), 0.5 * index)
    (change,) = observer.stillness(observer.view)[1].changes
    assert change.kind is ViewChangeKind.TURN and change.amount == pytest.approx(6.0, abs=0.5)


def test_a_shutter_is_detected_although_most_of_the_image_is_black() -> None:
    observer, tracks = Observer(Options(ignore_regions=UPPER), (WIDTH, HEIGHT)), []
    for index in range(40):
        image = scene(0.1 * index, ((10.0, 140.0),))
        if 20 <= index < 25:
            image = np.full_like(image, 120)
        tracks += observer.observe(image, 0.1 * index).tracks
    assert list(observer.views) == [0]
    assert not any(2.0 <= time < 2.5 for track in [*tracks, *observer.unfinished()] for time in track.times_s)


def test_the_background_is_black_there_and_nowhere_else() -> None:
    options = Options(ignore_regions='100 50 200 50 150 150')
    calibrator = AutoCalibrator(options)
    for index in range(25):
        calibrator.add_image(10**9 + index * 10**8, scene(0.1 * index, ()))
    background, mask = calibrator.background(), ignored_mask(options.ignored_polygons, (WIDTH, HEIGHT))
    assert not background[mask].any()
    assert np.median(background[~mask]) > 80
    assert mask[60, 150] and mask[50, 100] and not mask[60, 99] and not mask[152, 150]


def test_other_regions_are_ignored_from_the_next_image_on() -> None:
    calibrator = AutoCalibrator(Options(ignore_regions='100 50 200 50 150 150'))
    moved = Options(ignore_regions='100 50 200 50 150 150; 300 20 380 20 380 90 300 90').ignored_polygons
    for index in range(25):
        if index == 5:
            calibrator.ignore(moved)
        calibrator.add_image(10**9 + index * 10**8, scene(0.1 * index, ()))
    background = calibrator.background()
    assert not background[ignored_mask(moved, (WIDTH, HEIGHT))].any()
    evidence = calibrator.snapshot()
    assert evidence is not None
    middles = evidence.still_lines_px.reshape(-1, 2, 2).mean(axis=1)
    near = (middles > (290.0, 10.0)).all(axis=1) & (middles < (390.0, 100.0)).all(axis=1)
    assert not near.any()  # the border of a black region is no line of the scene
    # a clock that is set by a day begins anew, and regions do not
    calibrator.add_image(10**9 + 2 * 86_400 * 10**9, scene(0.0, ()))
    calibrator.add_image(10**9 + 2 * 86_400 * 10**9 + 10**8, scene(0.1, ()))
    assert not calibrator.background()[ignored_mask(moved, (WIDTH, HEIGHT))].any()


def test_blacking_out_leaves_the_image_given_alone() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    image.flags.writeable = False
    polygons = Options(ignore_regions='0 0 99 0 99 49 0 49; 300 100 399 100 399 199').ignored_polygons
    black = black_out(image, polygons)
    assert not black[:50, :100].any() and not black[100, 300:].any() and (black[60:100] == 90).all()
    assert (image == 90).all()
    assert black_out(image, ()) is image


@pytest.mark.parametrize(
    'text',
    ['1 2 3 4', '1 2 3 4 5', 'here', '0 0 1 1 nan 2', '0 0 9 0 9 9;; 0 0 9 0 9 9', '0 0 1 1 1e9 2', '0 0 9 0 9 9; 4 4'],
)
def test_a_wrong_text_is_wrong_usage(text) -> None:
    with pytest.raises(UsageError, match="'ignore_regions' is polygons of at least three pixels"):
        Options(ignore_regions=text)


@pytest.mark.parametrize('text', ['', ' ', '1 2 3 4 5 6', '1,2 3,4 5,6;', ' 1 2 3 4 5 6 ; 7 8 9 10 11 12 13 14 '])
def test_a_right_text_is_read(text) -> None:
    assert [len(polygon) for polygon in Options(ignore_regions=text).ignored_polygons] == {
        '': [],
        ' ': [],
        '1 2 3 4 5 6': [3],
        '1,2 3,4 5,6;': [3],
    }.get(text, [3, 4])


def test_a_polygon_outside_the_image_is_a_usage_error_at_the_first_image() -> None:
    calibrator = AutoCalibrator(Options(ignore_regions='0 0 9 0 9 9; 500 0 600 0 600 90'))
    with pytest.raises(UsageError, match="polygon 2 of 'ignore_regions' lies entirely outside the images of 400x200"):
        calibrator.add_image(1, np.zeros((HEIGHT, WIDTH), np.uint8))


# 16x12 images, of which columns 4 to 9 and rows 3 to 6 are black
SMALL = (((4.0, 3.0), (9.0, 3.0), (9.0, 6.0), (4.0, 6.0)),)
COLUMNS, ROWS = 16, 12


def message(encoding: str, row_bytes: int, rows: int, padding: int = 4, is_bigendian: int = 0) -> SimpleNamespace:
    """A message of noise, that of 16 bits well above zero."""
    data = np.random.default_rng(0).integers(60, 200, (rows, row_bytes + padding), np.uint8)
    data.flags.writeable = False
    return SimpleNamespace(
        encoding=encoding,
        width=COLUMNS,
        height=ROWS,
        step=row_bytes + padding,
        is_bigendian=is_bigendian,
        data=data.ravel(),
    )


KINDS = [
    ('mono8', 16, 12),
    ('bgr8', 48, 12),
    ('rgba8', 64, 12),
    ('8UC4', 64, 12),
    ('mono16', 32, 12),
    ('rgb16', 96, 12),
    ('bayer_rggb8', 16, 12),
    ('bayer_gbrg16', 32, 12),
    ('16SC1', 32, 12),
    ('yuv422', 32, 12),
    ('yuyv', 32, 12),
    ('nv21', 16, 18),
    ('nv12', 16, 18),
    ('nv24', 16, 36),
    ('yuv420', 16, 18),
]


@pytest.mark.parametrize('is_bigendian', [0, 1])
@pytest.mark.parametrize(('encoding', 'row_bytes', 'rows'), KINDS)
def test_images_of_every_encoding_are_black_there_and_nowhere_else(encoding, row_bytes, rows, is_bigendian) -> None:
    before = message(encoding, row_bytes, rows, is_bigendian=is_bigendian)
    after = SimpleNamespace(**{**vars(before), 'data': mask_message(before, SMALL)})
    assert before.data.min() >= 60 and len(after.data) == len(before.data)
    was, now = ImageDecoder().decode(before).astype(int), ImageDecoder().decode(after).astype(int)
    inside = np.zeros((ROWS, COLUMNS), bool)
    inside[3:7, 4:10] = True
    # interpolated colours reach a pixel, in halved chroma two, beyond the region and into it
    core, far = inside.copy(), ~(cv2.dilate(inside.astype(np.uint8), np.ones((5, 5))) > 0)
    if encoding.startswith('bayer'):
        core[:] = False
        core[4:6, 5:9] = True
    assert now[core].max() <= 8  # the darkest of the rest, stretched, may lie a little above the first percentile
    if encoding in (
        'mono8',
        'bgr8',
        'rgba8',
        '8UC4',
        'bayer_rggb8',
        'yuv422',
        'yuyv',
        'nv21',
        'nv12',
        'nv24',
        'yuv420',
    ):
        assert np.array_equal(now[far], was[far])


def test_temperatures_get_the_coldest_of_the_rest() -> None:
    kelvin = np.random.default_rng(0).uniform(280, 300, (ROWS, COLUMNS)).astype('<f4')
    kelvin[0, 0], kelvin[4, 5] = np.nan, 250.0
    msg = SimpleNamespace(
        encoding='32FC1',
        width=COLUMNS,
        height=ROWS,
        step=4 * COLUMNS,
        is_bigendian=0,
        data=kelvin.ravel().view(np.uint8),
    )
    after = mask_message(msg, SMALL).view('<f4').reshape(ROWS, COLUMNS)
    assert (after[3:7, 4:10] == np.nanmin(np.delete(kelvin, 4, axis=0))).all() or after[4, 5] >= 280
    assert np.isnan(after[0, 0]) and np.array_equal(after[8:], kelvin[8:])


@pytest.mark.parametrize(('kind', 'worst'), [('.jpg', 40), ('.png', 0)])
def test_compressed_images_are_compressed_again(kind, worst) -> None:
    picture = np.full((ROWS, COLUMNS, 3), 150, np.uint8)
    after = mask_message(SimpleNamespace(format='x', data=cv2.imencode(kind, picture)[1].ravel()), SMALL)
    image = ImageDecoder().decode(SimpleNamespace(format='x', data=after)).astype(int)
    assert image[3:7, 4:10].max() <= worst  # JPEG rings at the border of a block
    assert np.abs(image[10:] - 150).max() <= worst


def test_16_bits_stay_16_bits() -> None:
    counts = np.full((ROWS, COLUMNS), 6400, np.uint16)
    counts[1, 1] = 6000
    after = mask_message(SimpleNamespace(format='mono16; png', data=cv2.imencode('.png', counts)[1].ravel()), SMALL)
    image = cv2.imdecode(after, cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16 and (image[3:7, 4:10] == 6000).all() and image[9, 9] == 6400


def test_an_encoding_that_cannot_be_masked_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="'ignore_regions' cannot be made black in images of encoding 'h264'"):
        require_maskable(SimpleNamespace(encoding='h264'))
    with pytest.raises(UsageError, match='16UC1; compressedDepth'):
        require_maskable(SimpleNamespace(format='16UC1; compressedDepth png'))
    with pytest.raises(InputError, match='16 x 12 pixels has 100 bytes'):
        mask_message(SimpleNamespace(**{**vars(message('bgr8', 48, 12)), 'data': bytes(100)}), SMALL)


def test_an_impossible_image_size_is_an_input_error_before_memory_is_allocated() -> None:
    with pytest.raises(InputError, match='4294967295 x 4294967295 pixels has 768 bytes'):
        mask_message(
            SimpleNamespace(**{**vars(message('mono16', 32, 12, padding=32)), 'width': 2**32 - 1, 'height': 2**32 - 1}),
            SMALL,
        )
