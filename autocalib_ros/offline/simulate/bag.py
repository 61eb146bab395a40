"""Write a simulated recording as a rosbag2 folder with truth.json in it."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.truth import truth_of
from autocalib_ros.util.child_process import usable_processors

TRUTH_FILE_NAME = 'truth.json'
_BAG_VERSION: Literal[9] = 9
_LATENCY_NS = 5_000_000  # a recorder receives an image shortly after its stamp
_BATCH_FRAMES = 64
_JPEG_QUALITY = 92


def write_bag(
    path: Path | str,
    options: SimulationOptions,
    *,
    workers: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Simulate a recording into a new bag folder with truth.json in it; return the folder.

    workers: number of rendering processes (default: one per core); the result does not depend on it.
    overwrite: replace an existing bag.  progress: called with (frames done, total frames).
    """
    if workers is not None and workers < 1:
        raise UsageError(f'workers is {workers}: choose 1 or more')
    _prepare_target(Path(path), overwrite)
    return write_simulation(Path(path), Simulation(options), workers=workers, progress=progress)


def write_simulation(
    path: Path,
    simulation: Simulation,
    *,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    truth: Mapping[str, Any] | None = None,
    on_image: Callable[[bytes], None] | None = None,
) -> Path:
    """Write a simulation into a new bag folder, see `write_bag`; return the folder.

    truth: that of the simulation if it is known already.  on_image: receives each serialised image once it is written;
    what it raises ends the writing and removes the bag.
    """
    options = simulation.options
    try:
        with _writer(path, options) as writer:
            _write_messages(writer, simulation, workers or usable_processors(), progress, on_image)
        text = json.dumps(truth or truth_of(simulation), indent=1)
        (path / TRUTH_FILE_NAME).write_text(text, encoding='utf-8')
    except BaseException as error:
        shutil.rmtree(path, ignore_errors=True)  # leave no incomplete bag behind
        if isinstance(error, (OSError, WriterError)):
            raise InputError(f'cannot write {path}: {error}') from error
        raise
    return path


def _prepare_target(path: Path, overwrite: bool) -> None:
    """Make the path available: remove an empty folder, or an existing bag if overwrite is set."""
    if not path.exists():
        return
    if path.is_dir() and not any(path.iterdir()):
        path.rmdir()
        return
    if not overwrite:
        raise UsageError(f'{path} already exists: choose another name, or use --overwrite to replace the bag')
    if not (path / 'metadata.yaml').is_file():
        raise UsageError(
            f'{path} is not a bag (it has no metadata.yaml), so it is not overwritten: '
            'remove it manually or choose another name'
        )
    shutil.rmtree(path)


def _writer(path: Path, options: SimulationOptions) -> Writer:
    """Return a bag writer for the storage format of the options."""
    plugin = StoragePlugin.MCAP if options.storage == 'mcap' else StoragePlugin.SQLITE3
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = Writer(path, version=_BAG_VERSION, storage_plugin=plugin)
    if options.zstd:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    return writer


def _write_messages(
    writer: Writer,
    simulation: Simulation,
    workers: int,
    progress: Callable[[int, int], None] | None,
    on_image: Callable[[bytes], None] | None,
) -> None:
    options, store = simulation.options, _typestore()
    kind = 'CompressedImage' if options.compressed else 'Image'
    topic = options.topic + '/compressed' * options.compressed
    images = writer.add_connection(topic, f'sensor_msgs/msg/{kind}', typestore=store)
    infos = writer.add_connection(options.truth_topic, 'sensor_msgs/msg/CameraInfo', typestore=store)
    with _rendered_images(simulation, min(workers, options.frame_count)) as messages:
        for index, message in enumerate(messages):
            recorded_ns = simulation.stamp_ns(index) + _LATENCY_NS
            writer.write(images, recorded_ns, message)
            writer.write(infos, recorded_ns, _camera_info(simulation, index))
            if on_image is not None:
                on_image(message)
            if progress is not None:
                progress(index + 1, options.frame_count)


@contextmanager
def _rendered_images(simulation: Simulation, workers: int) -> Iterator[Iterator[bytes]]:
    """Yield the serialised images in order, rendered here or by worker processes."""
    count = simulation.options.frame_count
    if workers == 1:
        yield (_image(simulation, index) for index in range(count))
        return
    # Spawn, not fork: OpenCV and BLAS have threads. The backdrop is rendered once and sent to the workers.
    simulation.renderer().prepare()
    context = multiprocessing.get_context('spawn')
    with context.Pool(workers, _start_worker, (simulation,)) as pool:
        yield _in_batches(pool, count)


def _in_batches(pool: Any, count: int) -> Iterator[bytes]:
    """Yield images in order, one batch at a time: with a slow disk, more would fill the memory."""
    for start in range(0, count, _BATCH_FRAMES):
        yield from pool.imap(_render_in_worker, range(start, min(start + _BATCH_FRAMES, count)))


_worker_simulation: Simulation | None = None


def _start_worker(simulation: Simulation) -> None:
    global _worker_simulation
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the program decides
    _worker_simulation = simulation


def _render_in_worker(index: int) -> bytes:
    if _worker_simulation is None:
        raise RuntimeError('worker process without a simulation')
    return _image(_worker_simulation, index)


@lru_cache(maxsize=1)
def _typestore() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def _header(simulation: Simulation, index: int) -> Any:
    types = _typestore().types
    seconds, nanoseconds = divmod(simulation.stamp_ns(index), 1_000_000_000)
    stamp = types['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
    return types['std_msgs/msg/Header'](stamp=stamp, frame_id=simulation.options.frame_id)


def _image(simulation: Simulation, index: int) -> bytes:
    """Render a frame and return it as a serialised message."""
    frame, options = simulation.frame(index), simulation.options
    encoding = 'mono16' if options.thermal else 'bgr8'
    store, header = _typestore(), _header(simulation, index)
    if options.compressed:
        name, fields = 'CompressedImage', _compressed(frame, encoding)
    else:
        name = 'Image'
        fields = {
            'height': frame.shape[0],
            'width': frame.shape[1],
            'encoding': encoding,
            'is_bigendian': 0,
            'step': frame.strides[0],
            'data': np.ascontiguousarray(frame).reshape(-1).view(np.uint8),
        }
    name = f'sensor_msgs/msg/{name}'
    return bytes(store.serialize_cdr(store.types[name](header=header, **fields), name))


def _compressed(frame: np.ndarray, encoding: str) -> dict[str, Any]:
    """Compress an image as image_transport does: JPEG, or PNG for 16 bits."""
    if encoding == 'mono16':
        _, data = cv2.imencode('.png', frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return {'format': 'mono16; png compressed ', 'data': data.reshape(-1)}
    _, data = cv2.imencode('.jpg', frame, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return {'format': 'bgr8; jpeg compressed bgr8', 'data': data.reshape(-1)}


def _camera_info(simulation: Simulation, index: int) -> bytes | memoryview:
    """Return the true CameraInfo of a frame as a serialised message."""
    store, options, lens = _typestore(), simulation.options, simulation.lens
    (cx, cy), f = lens.centre_px, lens.focal_px
    name = 'sensor_msgs/msg/CameraInfo'
    roi = store.types['sensor_msgs/msg/RegionOfInterest'](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    # Consumers interpret all-zero coefficients of this model as "no distortion".
    d = [k or 1e-9 if i == 0 else k for i, k in enumerate(lens.k)]
    message = store.types[name](
        header=_header(simulation, index),
        height=options.height_px,
        width=options.width_px,
        distortion_model='equidistant',
        d=np.array(d),
        k=np.array([f, 0, cx, 0, f, cy, 0, 0, 1.0]),
        r=np.eye(3).reshape(-1),
        p=np.array([f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1.0, 0]),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )
    return store.serialize_cdr(message, name)
