"""Live streams, from servers on the loopback."""

from __future__ import annotations

import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from mjpeg_server import mjpeg_server

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.recordings import live_streams
from autocalib_ros.offline.recordings.live_streams import public_name
from autocalib_ros.offline.recordings.open import open_source

RTSP_SERVER = Path(__file__).parents[2] / 'tools' / 'rtsp_server.py'
PYTHONS = ('/usr/bin/python3', 'python3')
"""Those that may have GStreamer's bindings: they come from the system's packages."""


def shades(count):
    return [np.full((48, 64, 3), 2 * index % 256, np.uint8) for index in range(count)]


def test_a_stream_is_read_for_its_duration_with_the_times_of_receipt():
    began_ns = time.time_ns()
    with mjpeg_server(shades(60), fps=100.0) as address:
        source = open_source(address, duration_s=0.3)
        frames = list(source.frames())
    stamps = np.array([frame.stamp_ns for frame in frames])
    assert began_ns < stamps[0] and stamps[-1] < time.time_ns()
    assert (np.diff(stamps) > 0).all() and stamps[-1] - stamps[0] < 300_000_000
    levels = [frame.image.mean() for frame in frames]
    assert len(levels) > 5 and np.allclose(np.diff(levels), 2, atol=2)


def test_a_source_says_whether_it_is_live(tmp_path, write_video):
    with mjpeg_server(shades(4), fps=100.0) as address:
        assert open_source(address).is_live
    assert open_source('rtsp://127.0.0.1:9/live').is_live
    assert not open_source(write_video(tmp_path / 'drive.avi')).is_live


def test_the_duration_passes_without_images_too():
    with mjpeg_server(shades(40), fps=100.0) as address:
        began = time.monotonic()
        frames = list(open_source(address, duration_s=1.5).frames())
    assert frames and time.monotonic() - began < live_streams.TIMEOUT_S


def test_a_dropped_connection_is_made_again(monkeypatch, caplog):
    monkeypatch.setattr(live_streams, 'RECONNECT_S', (0.01,))
    monkeypatch.setattr(live_streams, 'GIVE_UP_S', 0.1)
    with mjpeg_server(shades(40), fps=200.0, drop_after=15) as address:
        levels = [round(frame.image.mean()) for frame in open_source(address).frames()]
    assert levels == sorted(levels) and levels[-1] >= 76 and len(levels) > 30
    assert 'the connection broke after' in caplog.text and 'connections' in caplog.records[-1].message


def test_a_stop_ends_a_stream_that_shows_nothing():
    with mjpeg_server(shades(200), fps=100.0) as address:
        seen = []
        for frame in open_source(address, should_stop=lambda: len(seen) >= 5).frames():
            seen.append(frame)  # noqa: PERF402  the stop looks at it
    assert len(seen) == 5


def test_single_images_are_no_stream(monkeypatch):
    monkeypatch.setattr(live_streams, 'RECONNECT_S', (0.0,))
    with mjpeg_server(shades(60), is_snapshot=True) as address:
        source = live_streams.StreamSource(address, live_streams.TimeWindow())
        with pytest.raises(InputError, match='gives one image at a time: give the address of its video stream'):
            list(source.frames())


def test_nobody_there_is_one_clear_line():
    with pytest.raises(InputError, match=r'http://127.0.0.1:9/video cannot be opened: check address'):
        open_source('http://user:secret@127.0.0.1:9/video?token=secret')
    with pytest.raises(InputError, match=r'rtsp://127.0.0.1:9/live cannot be opened'):
        list(open_source('rtsp://user:secret@127.0.0.1:9/live').frames())


@pytest.mark.parametrize(
    ('address', 'name'),
    [
        ('rtsp://admin:secret@10.0.0.2:554/live?key=1', 'rtsp://10.0.0.2:554/live'),
        ('http://cam/video.mjpg', 'http://cam/video.mjpg'),
        ('/dev/video0', '/dev/video0'),
    ],
)
def test_the_name_of_a_stream_holds_no_password(address, name):
    assert public_name(address) == name


@pytest.mark.parametrize(
    ('address', 'more', 'error', 'message'),
    [
        ('/dev/video98', {}, InputError, '/dev/video98 does not exist; camera devices of this computer'),
        ('rtsp://', {}, UsageError, 'names no host'),
        ('rtsp://cam/live', {'start_s': 5.0}, UsageError, 'no start to skip'),
        ('rtsp://cam/live', {'topic': '/image'}, UsageError, 'no topics'),
        ('rtsp://cam/live', {'rate_hz': 5.0}, UsageError, 'leave out --rate'),
    ],
)
def test_what_no_stream_can_do_is_said(address, more, error, message):
    with pytest.raises(error, match=message):
        open_source(address, **more)


def received(*rows):
    return [
        live_streams._Received(round(1e9 * came_s), waited_s, stream_s, np.zeros((2, 2, 3), np.uint8))
        for came_s, waited_s, stream_s in rows
    ]


def test_images_that_lay_in_a_buffer_at_the_beginning_are_dated_back():
    # three at once, the first with another time than the stream, and then one that was waited for
    burst = received((50.0, 0.3, 0.0), (50.001, 0.001, -0.2), (50.002, 0.001, -0.1), (50.08, 0.078, 0.0))
    assert [one.was_waited_for(burst[:index]) for index, one in enumerate(burst)] == [False, False, False, True]
    stamps_s = [1e-9 * frame.stamp_ns for frame in live_streams.dated_back(burst)]
    assert stamps_s == pytest.approx([49.88, 49.98, 50.08])


def test_images_are_not_dated_back_where_the_stream_has_no_times(monkeypatch):
    monkeypatch.setattr(live_streams, 'MAX_BUFFERED', 3)
    burst = received((50.0, 0.1, 0.0), (50.1, 0.1, 0.0), (50.2, 0.1, 0.0))
    assert not any(one.was_waited_for(burst[:index]) for index, one in enumerate(burst))
    assert [frame.stamp_ns for frame in live_streams.dated_back(burst)] == [one.stamp_ns for one in burst]
    assert live_streams.dated_back([]) == []


def has_gstreamer(python: str) -> bool:
    code = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"
    found = shutil.which(python)
    return found is not None and not subprocess.run([found, '-c', code], capture_output=True, check=False).returncode


@pytest.mark.dds
def test_an_rtsp_server_is_read():
    python = next(filter(has_gstreamer, PYTHONS), None)
    if python is None:
        pytest.skip('no GStreamer RTSP server: apt-get install gir1.2-gst-rtsp-server-1.0 python3-gi')
    caps = 'video/x-raw,format=I420,width=160,height=120,framerate=30/1'
    pipeline = f'videotestsrc is-live=true ! {caps} ! jpegenc ! rtpjpegpay name=pay0'
    server = subprocess.Popen(
        [python, str(RTSP_SERVER), pipeline], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        frames = list(open_source(server.stdout.readline().strip(), duration_s=2.0).frames())
    finally:
        server.communicate()
    assert frames[0].image.shape == (120, 160, 3)
    # none is lost, and those that FFmpeg had read to know the codec have the times at which they were sent
    intervals_s = 1e-9 * np.diff([frame.stamp_ns for frame in frames])
    assert 57 <= len(frames) <= 63 and np.median(intervals_s) == pytest.approx(1 / 30, rel=0.05)
    assert (intervals_s > 0.25 / 30).mean() > 0.9  # a busy machine takes some of them late
