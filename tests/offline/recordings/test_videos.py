"""Video files: stamps, time windows, damaged files."""

from __future__ import annotations

import shutil
import subprocess
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.videos import _FrameClock, require_usual_size


@pytest.mark.parametrize('suffix', ['.mp4', '.avi', '.mkv'])
def test_a_video_gives_its_frames_and_times(tmp_path, write_video, suffix):
    source = open_source(write_video(tmp_path / f'clip{suffix}', count=30, fps=10))
    frames = list(source.frames())
    assert len(frames) == source.total == 30
    assert frames[0].image.shape == (48, 64, 3)
    # Matroska keeps times in whole milliseconds
    assert np.allclose([frame.stamp_ns * 1e-9 for frame in frames], np.arange(30) / 10, atol=1.1e-3)
    assert source.duration_s == pytest.approx(3.0, abs=0.2)


@pytest.mark.skipif(
    shutil.which('ffmpeg') is None, reason='no ffmpeg to write the aspect ratio: apt-get install ffmpeg'
)
@pytest.mark.parametrize(('ratio', 'expected'), [('64/45', 64 / 45), ('1/1', 0.0), ('10/11', 10 / 11)])
def test_a_video_says_the_shape_of_its_pixels(tmp_path, write_video, caplog, ratio, expected):
    plain, squeezed = write_video(tmp_path / 'plain.mp4'), tmp_path / 'squeezed.mp4'
    filters = ['-vf', f'setsar={ratio}', '-c:v', 'mpeg4']
    subprocess.run(['ffmpeg', '-v', 'error', '-i', plain, *filters, squeezed], check=True)
    assert open_source(plain).pixel_aspect == 0.0
    assert open_source(squeezed).pixel_aspect == pytest.approx(expected)
    # 1:1 stands in many files of squeezed pictures, so it is not told
    assert ('times as wide as high' in caplog.text) == (expected > 0)


def test_the_window_of_a_video_counts_from_its_first_frame(tmp_path, write_video):
    source = open_source(write_video(tmp_path / 'clip.mp4', count=30, fps=10), start_s=1.0, duration_s=0.5)
    assert [round(frame.stamp_ns * 1e-8) for frame in source.frames()] == [10, 11, 12, 13, 14]
    assert source.total == 5


def test_a_window_behind_the_end_of_a_video_is_an_error(tmp_path, write_video):
    source = open_source(write_video(tmp_path / 'clip.mp4', count=30, fps=10), start_s=60)
    with pytest.raises(InputError, match=r'no image 60 s after the start of .*clip.mp4, which lasts 3.0 s'):
        list(source.frames())


@pytest.mark.parametrize(
    'window', [{'start_s': -1.0}, {'start_s': float('nan')}, {'duration_s': 0.0}, {'duration_s': float('inf')}]
)
def test_a_senseless_window_is_wrong_usage(tmp_path, write_video, window):
    with pytest.raises(UsageError):
        open_source(write_video(tmp_path / 'clip.mp4'), **window)


def test_a_truncated_video_gives_what_it_has_and_says_so(tmp_path, write_video, caplog):
    path = write_video(tmp_path / 'clip.avi', count=60)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = list(open_source(path).frames())
    assert 5 < len(frames) < 50
    assert 'ended early' in caplog.text


def test_a_video_that_lost_its_index_is_one_clear_line(tmp_path, write_video):
    path = write_video(tmp_path / 'clip.mp4')
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r'clip.mp4 is not a readable video'):
        open_source(path)


def test_a_video_without_frames_is_one_clear_line(tmp_path, write_video):
    with pytest.raises(InputError, match=r'clip\.avi'):
        open_source(write_video(tmp_path / 'clip.avi', count=0))


def test_a_text_file_named_as_a_video_is_one_clear_line(tmp_path):
    path = tmp_path / 'text1.mp4'
    path.write_text('not a video\n' * 100)
    with pytest.raises(InputError, match=r'text1\.mp4 is not a readable video'):
        open_source(path)


def test_a_video_has_no_topics(tmp_path, write_video):
    with pytest.raises(UsageError, match='is a video'):
        open_source(write_video(tmp_path / 'clip.mp4'), topic='/image')


def test_a_packed_part_without_content_is_one_clear_line(tmp_path):
    path = tmp_path / 'bag_0.mcap.zstd'
    path.write_bytes(b'\x28\xb5\x2f\xfd')
    with pytest.raises(InputError, match=r'cannot read .*bag_0\.mcap\.zstd'):
        open_source(path)


def test_positions_that_stand_still_give_way_to_the_frame_rate():
    clock = _FrameClock(10.0)
    assert [clock.next_ns(0.0) for _ in range(3)] == [0, 100_000_000, 200_000_000]


def test_uneven_positions_are_kept():
    clock = _FrameClock(10.0)
    assert [clock.next_ns(ms) for ms in (40.0, 140.0, 340.0)] == [0, 100_000_000, 300_000_000]


needs_ffmpeg = pytest.mark.skipif(
    shutil.which('ffmpeg') is None, reason='no ffmpeg to convert videos: apt-get install ffmpeg'
)


def converted(source, target, *options):
    subprocess.run(['ffmpeg', '-v', 'error', '-i', source, *options, target], check=True)
    return target


@needs_ffmpeg
@pytest.mark.parametrize(('suffix', 'codec'), [('.h264', 'libx264'), ('.mjpeg', 'mjpeg')])
def test_a_raw_stream_has_no_times_unless_a_rate_is_given(tmp_path, write_video, caplog, suffix, codec):
    raw = converted(write_video(tmp_path / 'clip.avi', count=12), tmp_path / f'raw{suffix}', '-c:v', codec)
    assert list(open_source(raw).frames())[-1].stamp_ns == 11 * 40_000_000
    assert 'is a raw stream without times; 25 frames/s assumed, give the true rate with --rate' in caplog.text
    caplog.clear()
    assert list(open_source(raw, rate_hz=10.0).frames())[-1].stamp_ns == 1_100_000_000
    assert not caplog.records


@needs_ffmpeg
def test_a_rotation_in_the_file_is_applied_and_told(tmp_path, write_video, caplog):
    plain = converted(write_video(tmp_path / 'clip.avi', size=(64, 48)), tmp_path / 'plain.mp4', '-c:v', 'libx264')
    turned = converted(plain, tmp_path / 'turned.mov', '-c', 'copy', '-metadata:s:v:0', 'rotate=90')
    if next(iter(open_source(turned).frames())).image.shape[:2] != (64, 48):
        pytest.skip('this ffmpeg does not write a rotation so')
    assert 'is turned by' in caplog.text and 'as the file says' in caplog.text


def test_the_codec_is_named_where_nothing_can_be_decoded(tmp_path, write_video, monkeypatch):
    path = write_video(tmp_path / 'clip.mp4')
    monkeypatch.setattr('autocalib_ros.offline.recordings.videos.cv2.VideoCapture.grab', lambda _: False, raising=False)
    with pytest.raises(InputError, match='its codec is'):
        open_source(path)


@pytest.mark.parametrize(('width', 'height'), [(30000, 30000), (2**31 - 1, 1000)])
def test_a_video_of_absurd_size_is_refused_before_a_frame_is_decoded(width, height):
    sides = {cv2.CAP_PROP_FRAME_WIDTH: width, cv2.CAP_PROP_FRAME_HEIGHT: height}
    with pytest.raises(InputError, match=f'a.mp4 states images of {width}x{height} pixels, more than 100 million'):
        require_usual_size(SimpleNamespace(get=sides.get), 'a.mp4')
