"""What paths, patterns and addresses stand for."""

from __future__ import annotations

import pytest

from autocalib_ros.errors import InputError
from autocalib_ros.offline.recordings.listing import is_stream, recordings_of
from autocalib_ros.offline.recordings.open import open_source


@pytest.fixture
def folder(tmp_path):
    """Return a function that makes empty files in a folder and returns it."""

    def make(*names: str):
        for name in names:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        return tmp_path

    return make


def names(recordings):
    return [[one.name for one in each] if isinstance(each, list) else each.name for each in recordings]


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('rtsp://10.0.0.2/live', True),
        ('HTTP://cam/video.mjpg', True),
        ('/dev/video0', True),
        ('/dev/video', False),
        ('clip.mp4', False),
        ('C://clip.mp4', False),
    ],
)
def test_streams_are_told_from_files(text, expected):
    assert is_stream(text) is expected


def test_an_address_stays_as_it_is():
    assert recordings_of(['rtsp://user:word@10.0.0.2//live']) == ['rtsp://user:word@10.0.0.2//live']


def test_a_folder_of_clips_stands_for_each_in_the_order_of_their_numbers(folder):
    made = folder('cam_10.mp4', 'cam_9.MP4', 'notes.txt', '.hidden.mp4', 'day/metadata.yaml', 'old.bag')
    assert names(recordings_of([made])) == ['cam_9.MP4', 'cam_10.mp4', 'day', 'old.bag']


def test_images_of_a_folder_or_a_pattern_are_one_recording(folder):
    made = folder('b2.jpg', 'b10.jpg', 'b1.jpg', 'mask.png')
    assert names(recordings_of([f'{made}/b*.jpg'])) == [['b1.jpg', 'b2.jpg', 'b10.jpg']]
    assert names(recordings_of([f'{made}/b%02d.jpg'])) == [['b1.jpg', 'b2.jpg', 'b10.jpg']]
    assert names(recordings_of([made])) == [['b1.jpg', 'b2.jpg', 'b10.jpg', 'mask.png']]


def test_a_folder_with_a_bag_is_the_bag(folder):
    made = folder('metadata.yaml', 'bag_0.mcap', 'preview.mp4')
    assert recordings_of([made]) == [made]


def test_several_arguments_are_several_recordings(folder):
    made = folder('a.mp4', 'b.mp4')
    assert names(recordings_of([made / 'b.mp4', made / 'a.mp4'])) == ['b.mp4', 'a.mp4']


@pytest.mark.parametrize(
    ('made', 'asked', 'message'),
    [
        (['a.jpg', 'b.mp4'], '', 'both 1 images and 1 clips: give a pattern'),
        (['a.txt', 'b.csv'], '', 'no videos or images; it has a.txt, b.csv'),
        ([], '', 'it has nothing at all'),
        (['a.txt'], '/*.jpg', r'no file fits .*\*.jpg'),
        (['a.jpg', 'a.txt'], '/a*', 'fits 1 images and 1 other files'),
    ],
)
def test_what_is_no_recording_is_one_clear_line(folder, made, asked, message):
    with pytest.raises(InputError, match=message):
        recordings_of([f'{folder(*made)}{asked}'])


@pytest.mark.parametrize(
    ('name', 'message'),
    [
        ('clips.zip', 'unpack it, and give the folder'),
        ('evidence.npz', 'autocalib evidence solves'),
        ('calibration.json', 'give the recording that it was calibrated from'),
        ('metadata.yaml', 'give the folder of the rosbag2'),
    ],
)
def test_a_file_of_another_kind_is_answered_with_what_to_do(tmp_path, name, message):
    (tmp_path / name).write_text('words')
    with pytest.raises(InputError, match=message):
        open_source(tmp_path / name)


@pytest.mark.parametrize(
    ('text', 'message'),
    [('0', '0 does not exist: a camera device is /dev/video0'), ('rtsp:/cam', 'addresses begin with rtsp://')],
)
def test_what_does_not_exist_is_answered_with_what_was_meant(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        open_source(text)
