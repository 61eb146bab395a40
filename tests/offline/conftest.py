"""Fixtures: tiny recordings written with rosbags and OpenCV, and hand-built results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from shared_backdrops import share_backdrops

from autocalib_ros.offline.replay_recording import ReplayResult
from synthetic_results import full_result, grey_road, junction_evidence, lens_result, refusal

WIDTH, HEIGHT = 32, 24
SECOND = 1_000_000_000
TYPES = get_typestore(Stores.ROS2_JAZZY)
TYPES1 = get_typestore(Stores.ROS1_NOETIC)


@pytest.fixture(scope='module')
def shared_backdrops() -> Iterator[None]:
    """Paint the static scene once for the simulations of a module that show the same one."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        share_backdrops(monkeypatch)
        yield


def picture(index: int) -> np.ndarray:
    """Return a grey image whose brightness encodes its index."""
    return np.full((HEIGHT, WIDTH), (10 * index + 5) % 256, np.uint8)


def header(stamp_ns: int, frame_id: str = 'cam1_optical', types: Any = TYPES) -> Any:
    """Return a std_msgs/Header of ROS 2 or ROS 1."""
    stamp = types.types['builtin_interfaces/msg/Time'](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    more = {'seq': 0} if types is TYPES1 else {}
    return types.types['std_msgs/msg/Header'](stamp=stamp, frame_id=frame_id, **more)


def raw_image(index: int, stamp_ns: int, types: Any = TYPES, **changes: Any) -> Any:
    """Return a mono8 sensor_msgs/Image."""
    fields = {
        'header': header(stamp_ns, types=types),
        'height': HEIGHT,
        'width': WIDTH,
        'encoding': 'mono8',
        'is_bigendian': 0,
        'step': WIDTH,
        'data': picture(index).ravel(),
    }
    return types.types['sensor_msgs/msg/Image'](**{**fields, **changes})


def jpeg_image(index: int, stamp_ns: int) -> Any:
    """Return a sensor_msgs/CompressedImage."""
    data = cv2.imencode('.jpg', picture(index))[1].ravel()
    return TYPES.types['sensor_msgs/msg/CompressedImage'](header=header(stamp_ns), format='jpeg', data=data)


@pytest.fixture
def write_bag() -> Callable[..., Path]:
    """Return a function that writes a rosbag2 folder of (topic, recorded_ns, message)."""

    def write(
        path: Path,
        messages: list[tuple[str, int, Any]],
        *,
        mcap: bool = False,
        compression: str = 'NONE',
        topics: tuple[tuple[str, str], ...] = (),
    ) -> Path:
        writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3)
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        with writer:
            wanted = dict.fromkeys([*topics, *((topic, message.__msgtype__) for topic, _, message in messages)])
            connections = {topic: writer.add_connection(topic, kind, typestore=TYPES) for topic, kind in wanted}
            for topic, recorded_ns, message in messages:
                writer.write(connections[topic], recorded_ns, TYPES.serialize_cdr(message, message.__msgtype__))
        return path

    return write


@pytest.fixture
def write_bag1() -> Callable[..., Path]:
    """Return a function that writes a ROS 1 bag of (topic, recorded_ns, message)."""

    def write(path: Path, messages: list[tuple[str, int, Any]]) -> Path:
        with Writer1(path) as writer:
            kinds = dict.fromkeys((topic, message.__msgtype__) for topic, _, message in messages)
            connections = {topic: writer.add_connection(topic, kind, typestore=TYPES1) for topic, kind in kinds}
            for topic, recorded_ns, message in messages:
                writer.write(connections[topic], recorded_ns, TYPES1.serialize_ros1(message, message.__msgtype__))
        return path

    return write


@pytest.fixture
def images() -> Callable[..., list[tuple[str, int, Any]]]:
    """Return a function that gives images at 10 Hz, recorded 5 ms after their stamps."""

    def make(
        count: int = 8,
        topic: str = '/cam1/image_raw',
        make_one: Callable[..., Any] = raw_image,
        begin_ns: int = 100 * SECOND,
        **changes: Any,
    ) -> list[tuple[str, int, Any]]:
        stamps = [begin_ns + index * SECOND // 10 for index in range(count)]
        return [(topic, stamp + 5_000_000, make_one(index, stamp, **changes)) for index, stamp in enumerate(stamps)]

    return make


@pytest.fixture
def write_video() -> Callable[..., Path]:
    """Return a function that writes a small video of `count` frames."""

    def write(path: Path, count: int = 30, fps: float = 10.0, size: tuple[int, int] = (64, 48)) -> Path:
        code = {'.mp4': 'mp4v', '.avi': 'MJPG', '.mkv': 'MJPG'}[path.suffix]
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), fps, size)
        noise = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
        for index in range(count):
            writer.write(np.roll(noise, index, axis=1))
        writer.release()
        return path

    return write


@pytest.fixture
def ros1_image() -> Callable[..., Any]:
    """Return the maker of mono8 images of ROS 1."""
    return lambda index, stamp_ns: raw_image(index, stamp_ns, TYPES1)


@pytest.fixture
def jpeg() -> Callable[..., Any]:
    """Return the maker of JPEG images."""
    return jpeg_image


@pytest.fixture
def a_header_at() -> Callable[[int], Any]:
    """Return the maker of headers with a given stamp."""
    return header


@pytest.fixture
def a_header() -> Any:
    """Return a message that is no image."""
    return header(SECOND)


@pytest.fixture
def full() -> ReplayResult:
    """Return a calibrated replay with everything that a report can show."""
    evidence = junction_evidence()
    return ReplayResult(
        result=full_result(evidence), evidence=evidence, accepted_at_s=30.0, background=grey_road(), frames=600
    )


@pytest.fixture
def refused(full: ReplayResult) -> ReplayResult:
    """Return a refused replay."""
    return replace(full, result=refusal(full.evidence), accepted_at_s=None)


@pytest.fixture
def lens_only(full: ReplayResult) -> ReplayResult:
    """Return a replay that gave a lens and no ground plane."""
    return replace(full, result=lens_result(full.result))


@pytest.fixture
def jazzy() -> Any:
    """Return the message types of Jazzy."""
    return TYPES


@pytest.fixture
def noetic() -> Any:
    """Return the message types of Noetic."""
    return TYPES1
