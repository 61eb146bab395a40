"""One stream of images, with the evidence of its still parts."""

from __future__ import annotations

from autocalib_ros.config import Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.still_parts import StillPart, StillParts
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.image_timing import ReadyImage
from autocalib_ros.perception.observer import FrameObservations, Observer

FORGET_PERIOD_S = 10.0
"""Seconds of recording between two searches for old evidence; each costs milliseconds."""


class ImageStream:
    """Images of one size on one clock, with the evidence from them."""

    def __init__(self, options: Options, time_ns: int, size: tuple[int, int], detector: VehicleDetector | None) -> None:
        options.scale.require_inside(*size)
        self.observer = Observer(options, size, detector)
        self._parts = StillParts(options.buffer)
        self.size, self._first_ns, self._newest_ns = size, time_ns, time_ns - 1
        self.frames = self._offset_ns = 0
        self._next_forget_s, self._gate = FORGET_PERIOD_S, options.gate

    @property
    def time_s(self) -> float:
        """Time of the newest image, seconds since the first."""
        return (self._newest_ns - self._first_ns) * 1e-9

    @property
    def part(self) -> StillPart:
        """Evidence of the present still view of the camera."""
        return self._parts.part(self.observer.view, self.time_s)

    def add(self, ready: ReadyImage, offset_ns: int, options: Options) -> None:
        """Take one image and gather what it shows; `offset_ns` added to its time is that by the camera's clock."""
        time_s = (ready.time_ns - self._first_ns) * 1e-9
        if options.gate != self._gate:
            self._gate = options.gate
            self.observer.change_gate(options.gate)
        observed = self.observer.observe(ready.image, time_s, ready.lost)
        part = self.take(observed, time_s)
        self._newest_ns, self._offset_ns = ready.time_ns, offset_ns
        part.newest_s = time_s
        part.frames += 1
        self.frames += 1
        if observed.view != self.observer.view:
            self._parts.keep_only(self.observer.views)
        if time_s >= self._next_forget_s:  # old evidence that newer evidence replaces
            self._next_forget_s = time_s + FORGET_PERIOD_S
            part.buffer.forget_replaced(time_s - options.buffer.seconds)

    def take(self, observed: FrameObservations, time_s: float) -> StillPart:
        """Keep observations, and return the evidence of their view; times are seconds since the first image."""
        part = self._parts.part(observed.view, time_s)
        part.buffer.add(observed.tracks, observed.segments, observed.edges, observed.outlines)
        part.tracks_seen += len(observed.tracks)
        return part

    def evidence(self, view: int | None = None) -> Evidence:
        """Freeze the evidence of a view, the present one for None, without its lines, which take longer to find."""
        present = view is None or view == self.observer.view
        view = self.observer.view if view is None else view
        part = self._parts.part(view, self.time_s)
        drift_px, stillness = self.observer.stillness(view)
        first_ns, end_s = self._first_ns + self._offset_ns, part.newest_s if present else stillness.end_s
        return part.buffer.snapshot(
            image_size=self.size,
            first_stamp_ns=first_ns,
            newest_stamp_ns=first_ns + round(max(end_s, part.start_s) * 1e9),
            frames=part.frames,
            drift_px=drift_px,
            unfinished=self.observer.unfinished() if present else [],
            picture=self.observer.picture(view),
            stillness=stillness,
        ).since(part.start_s)

    def leave_view(self, moved_ns: int) -> None:
        """Begin another still view if the present one began before a time in nanoseconds, when the camera moved."""
        part = self.part
        if self._first_ns + self._offset_ns + round(part.start_s * 1e9) < moved_ns:
            self.observer.leave_view()

    def longest_view(self) -> int:
        """Return the number of the view that was seen and still for the longest time."""
        still_s = self.observer.views
        return max(still_s, key=still_s.__getitem__)
