"""Image files as a recording."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
from hostile_files import png_of
from PIL import Image

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.image_files import EXIF_IFD, EXIF_SUBSECOND, EXIF_TIME
from autocalib_ros.offline.recordings.open import open_source


@pytest.fixture
def images(tmp_path):
    """Return a function that writes grey images; `at` gives the time of each file in seconds, or its EXIF tags."""

    def write(count=4, at=lambda index: 1000 + 0.1 * index, tags=None, suffix='.jpg'):
        for index in range(count):
            path = tmp_path / f'image{index}{suffix}'
            exif = Image.Exif()
            if tags is not None:
                exif.get_ifd(EXIF_IFD).update(tags(index))
            Image.fromarray(np.full((24, 32), 10 * index + 5, np.uint8)).save(path, exif=exif)
            os.utime(path, (at(index), at(index)))
        return tmp_path

    return write


def since_first(source):
    stamps = [frame.stamp_ns for frame in source.frames()]
    return [round((stamp - stamps[0]) * 1e-6) for stamp in stamps]


@pytest.mark.parametrize('suffix', ['.jpg', '.png', '.tif'])
def test_a_folder_of_images_is_a_recording(images, suffix):
    source = open_source(images(12, suffix=suffix), rate_hz=5.0)
    assert source.total == 12 and source.duration_s == pytest.approx(2.2)
    assert np.allclose([frame.image.mean() for frame in source.frames()], [10 * i + 5 for i in range(12)], atol=2)
    assert since_first(source) == [200 * index for index in range(12)]


def test_files_tell_the_times_if_nothing_else_does(images, caplog):
    assert since_first(open_source(images())) == [0, 100, 200, 300]
    assert 'those of their files, 10 a second; --rate gives another' in caplog.text


def test_exif_tells_the_times(images):
    def tags(index):
        return {EXIF_TIME: f'2024:05:01 12:00:0{index // 4}', EXIF_SUBSECOND: f'{25 * (index % 4):02d}'}

    assert since_first(open_source(images(6, at=lambda _: 1000, tags=tags))) == [0, 250, 500, 750, 1000, 1250]


@pytest.mark.parametrize(
    'tags',
    [
        {EXIF_TIME: '2024:05:01 12:00:00', EXIF_SUBSECOND: '2e30'},
        {EXIF_TIME: '9000:05:01 12:00:00', EXIF_SUBSECOND: '25'},
        {EXIF_TIME: '2024:13:01 12:00:00'},
    ],
)
def test_absurd_exif_is_none(images, tags):
    assert len(since_first(open_source(images(6, at=lambda index: 1000 + 0.1 * index, tags=lambda _: tags)))) == 6


@pytest.mark.parametrize('at', [lambda _: 1000, lambda index: 1000 - index, lambda index: 60 * index])
def test_times_of_copies_are_none(images, at):
    with pytest.raises(UsageError, match='--rate'):
        open_source(images(at=at))


def test_images_that_cannot_be_used_are_left_out_and_told(images, caplog):
    folder = images(6)
    (folder / 'image2.jpg').write_text('no image')
    cv2.imwrite(str(folder / 'image4.jpg'), np.zeros((48, 64), np.uint8))
    assert since_first(open_source(folder, rate_hz=10.0)) == [0, 100, 300, 500]
    assert '2 of 6 images cannot be read or have another size than 32x24' in caplog.text


def test_the_window_of_images_counts_from_the_first(images):
    source = open_source(images(8), rate_hz=10.0, start_s=0.2, duration_s=0.3)
    assert [round(frame.image.mean()) for frame in source.frames()] == [25, 35, 45]


def test_one_image_is_no_recording(images):
    with pytest.raises(InputError, match='is one image: traffic needs a sequence'):
        open_source(images(1) / 'image0.jpg')


def test_nothing_readable_is_an_error(images):
    folder = images(3)
    for path in folder.iterdir():
        path.write_text('no image')
    with pytest.raises(InputError, match='none of the 3 images'):
        list(open_source(folder, rate_hz=10.0).frames())


@pytest.mark.parametrize('rate', [0.0, -1.0, float('nan')])
def test_a_rate_is_positive(images, rate):
    with pytest.raises(UsageError, match='the rate must be a positive number'):
        open_source(images(), rate_hz=rate)


def test_an_image_that_would_fill_the_memory_is_left_out_and_told(images, caplog):
    folder = images(4, suffix='.png')
    (folder / 'image1.png').write_bytes(png_of(30000, 30000))
    assert len(list(open_source(folder, rate_hz=5.0).frames())) == 3
    assert 'the first: image1.png (the picture has 30000x30000 pixels, more than 100 million' in caplog.text


def test_images_that_would_all_fill_the_memory_are_refused_with_the_first(images):
    folder = images(3, suffix='.png')
    for path in folder.iterdir():
        path.write_bytes(png_of(30000, 30000))
    with pytest.raises(InputError, match=r'none of the 3 images .*: image0.png \(the picture has 30000x30000'):
        list(open_source(folder, rate_hz=5.0).frames())
