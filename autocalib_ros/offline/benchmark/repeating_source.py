"""A recording with repeated images, made while it is read."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from autocalib_ros.offline.recordings.sources import Frame, Source, StoredImage
from autocalib_ros.offline.simulate.repeat_faults import CODECS, RepeatFault


class RepeatingSource:
    """A recording some of whose images are repeated; everything else is that of the recording."""

    is_live = False

    def __init__(self, source: Source, fault: RepeatFault, seed: int = 0) -> None:
        self._source, self._fault = source, fault
        self._stamps_ns = np.array([stored.stamp_ns for stored in source.stored()], np.int64)
        self.order = fault.order(len(self._stamps_ns), np.random.default_rng(seed))
        self.name, self.topic, self.image_type = source.name, source.topic, source.image_type
        self.camera_frame, self.duration_s = source.camera_frame, source.duration_s
        self.pixel_aspect, self.window = source.pixel_aspect, source.window
        self.total: int | None = len(self.order)

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of the stream, with even stamps."""
        frames, shown, code = self._source.frames(), -1, CODECS[self._fault.codec]()
        image = np.zeros((0, 0), np.uint8)
        for number, index in enumerate(self.order.tolist()):
            while shown < index:
                image, shown = next(frames).image, shown + 1
            yield Frame(self._stamp_ns(number), code(image, index))

    def stored(self) -> Iterator[StoredImage]:
        """Yield the stamps of the stream."""
        return (
            StoredImage(self._stamp_ns(number), self._stamp_ns(number), self.camera_frame)
            for number in range(len(self.order))
        )

    def _stamp_ns(self, number: int) -> int:
        """Return the stamp of an image of the stream: those of the recording, interpolated."""
        since_ns = self._stamps_ns - self._stamps_ns[0]
        step_ns = since_ns[-1] // max(1, len(since_ns) - 1)
        known = np.append(since_ns, since_ns[-1] + step_ns)
        place = number / self._fault.rate
        return int(self._stamps_ns[0]) + round(float(np.interp(place, np.arange(len(known)), known)))
