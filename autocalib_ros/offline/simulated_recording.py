"""A recording that is read while it is simulated and written."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore

from autocalib_ros.errors import UsageError
from autocalib_ros.offline.recordings.sources import Frame, StoredImage, TimeWindow
from autocalib_ros.offline.simulate.bag import write_simulation
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.truth import truth_of
from autocalib_ros.perception.images import ImageDecoder

MAX_WAITING = 64
"""Most images that wait to be read; then the simulation waits: 720p in JPEG has 0.2 MB each."""


class _Stopped(Exception):
    """Nobody reads the recording any more."""


class SimulatedRecording:
    """Compressed images of a simulation, read while they are rendered and written into a new bag.

    If the reading stops early, the unfinished bag is removed.
    """

    image_type = 'sensor_msgs/msg/CompressedImage'
    pixel_aspect = 0.0
    is_live = False

    def __init__(self, bag: Path, simulation: Simulation) -> None:
        options = simulation.options
        if not options.compressed or options.thermal:
            raise UsageError('a recording is read while it is simulated if its images are compressed colour images')
        self.name, self.window = str(bag), TimeWindow()
        self.topic, self.camera_frame = f'{options.topic}/compressed', options.frame_id
        self.total: int | None = options.frame_count
        self.duration_s: float | None = options.frame_count / options.rate_hz
        self.truth: dict[str, Any] = truth_of(simulation)
        self._bag, self._simulation = bag, simulation
        self._waiting: queue.Queue[bytes | BaseException] = queue.Queue(MAX_WAITING)
        self._stop = threading.Event()

    def frames(self) -> Iterator[Frame]:
        """Yield the images as they are rendered; whatever ends the simulation is raised."""
        decoder, store = ImageDecoder(), get_typestore(Stores.ROS2_JAZZY)
        thread = threading.Thread(target=self._write, name='simulation', daemon=True)
        thread.start()
        try:
            for index in range(self._simulation.options.frame_count):
                message = self._waiting.get()
                if not isinstance(message, bytes):
                    raise message
                image = decoder.decode(store.deserialize_cdr(message, self.image_type))
                yield Frame(self._simulation.stamp_ns(index), image)
            thread.join()  # the truth is written last
        finally:
            self._stop.set()
            thread.join()

    def stored(self) -> Iterator[StoredImage]:
        """Raise UsageError: what is not written yet cannot be copied."""
        raise UsageError(f'{self.name} is being simulated: open the bag once it is written')

    def _write(self) -> None:
        try:
            write_simulation(self._bag, self._simulation, truth=self.truth, on_image=self._hand_over)
        except _Stopped:
            return
        except BaseException as error:
            with contextlib.suppress(_Stopped):
                self._hand_over(error)

    def _hand_over(self, item: bytes | BaseException) -> None:
        """Wait until there is room for an image, or for what ended the simulation."""
        while not self._stop.is_set():
            with contextlib.suppress(queue.Full):
                self._waiting.put(item, timeout=0.2)
                return
        raise _Stopped
