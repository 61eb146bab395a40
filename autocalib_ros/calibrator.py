"""The method on one page: images in, a calibration or a refusal out. Live and replayed alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.estimation.observations.selection import drop_pedestrians
from autocalib_ros.estimation.verification.readiness import (
    check_steady,
    drift_limit_px,
    outlook,
    requirements,
)
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.perception.detector.detector import VehicleDetector, open_detector
from autocalib_ros.perception.observer import Observer

MAX_REORDERING_NS = 1_000_000_000
"""Images overtake each other by less than this on any transport; a longer step back is another time."""
CLOCK_JUMP_NS = 24 * 3600 * 1_000_000_000
"""No camera pauses for longer than a day: a longer step forward is a clock that was set."""
FORGET_PERIOD_S = 10.0
"""Seconds of recording between two looks for evidence that is old; each costs milliseconds."""
TRAIL_FRAMES = 16
"""Images through which the way of a point is shown: a second at 15 Hz."""


class ImageIntake(Enum):
    """What became of an image; all but `USED` and `LATE` begin the evidence anew."""

    FIRST = 'the first image'
    USED = 'used'
    LATE = 'late: its time stamp is not newer than that of an image before'
    TIME_JUMPED = 'the time stamps stepped'
    RESIZED = 'the image size changed'


@dataclass(frozen=True)
class CalibrationProgress:
    """How far the evidence has come: 0 to 100, what is missing and how long it will take, in an installer's words."""

    percent: float
    missing: tuple[str, ...]
    outlook: str = ''
    """'about 6 min more at this rate' say; '' where nothing can be foreseen."""

    def __str__(self) -> str:
        missing = ', '.join([*filter(None, ['; '.join(self.missing), self.outlook])])
        return f'{self.percent:.0f} %' + (f': {missing}' if missing else '')


class AutoCalibrator:
    """Gathers evidence frame by frame; bounded in memory on an endless stream; not thread-safe.

    A `detector` that is open already is used; else that of the options is opened, UsageError where that fails.
    """

    def __init__(self, options: Options, detector: VehicleDetector | None = None) -> None:
        self._options = options
        self._detector = detector or open_detector(options.detector)
        self._observer: Observer | None = None

    def add_image(self, stamp_ns: int, image: np.ndarray) -> ImageIntake:
        """Take one image: grey (H, W) or BGR (H, W, 3), uint8; it is not kept nor changed.

        An image whose stamp repeats or steps back by less than `MAX_REORDERING_NS` is late and left out; a stamp that
        steps back further (a clock that was set, a recording that begins again) or forward by `CLOCK_JUMP_NS`, or a new
        image size starts the evidence anew. UsageError where a pixel of scale.distance_px lies outside the image.
        """
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            raise InputError(f'an image is grey (H, W) or BGR (H, W, 3) in 8 bits, got {image.dtype} {image.shape}')
        size = (image.shape[1], image.shape[0])
        frame_status = self._frame_status(stamp_ns, size)
        if frame_status is ImageIntake.LATE:
            return frame_status
        if frame_status is not ImageIntake.USED:
            self._restart(stamp_ns, size)
        time_s = (stamp_ns - self._first_stamp_ns) * 1e-9
        observed = self._observer.observe(image, time_s)
        for track in observed.tracks:
            self._buffer.add_track(track)
        self._tracks_seen += len(observed.tracks)
        if observed.segments is not None:
            self._buffer.add_segments(observed.segments)
        if observed.edges is not None:
            self._buffer.add_edges(observed.edges)
        if observed.outlines is not None:
            self._buffer.add_outlines(observed.outlines)
        if time_s >= self._forget_s:
            self._forget(time_s)
        self._newest_stamp_ns = stamp_ns
        self._frames += 1
        return frame_status

    def _frame_status(self, stamp_ns: int, size: tuple[int, int]) -> ImageIntake:
        if self._observer is None:
            return ImageIntake.FIRST
        if size != self._size:
            return ImageIntake.RESIZED
        step_ns = stamp_ns - self._newest_stamp_ns
        if not -MAX_REORDERING_NS < step_ns < CLOCK_JUMP_NS:
            return ImageIntake.TIME_JUMPED
        return ImageIntake.USED if step_ns > 0 else ImageIntake.LATE

    def change(self, options: Options) -> None:
        """Take other options, which may differ in what `config.is_reconfigurable` says; a solution is due at once."""
        self._options = options
        if self._observer is not None:
            self._reset_schedule()

    def _forget(self, time_s: float) -> None:
        """Drop old evidence that newer replaces, and all that is old once the camera has, or may have, moved.

        It counts as moved until nothing is held any more from before.
        """
        self._forget_s = time_s + FORGET_PERIOD_S
        memory_s = self._options.buffer.seconds
        if self._observer.drift_px > drift_limit_px(self._size[0], self._options.gate):
            self._moved_s = time_s
        self._moved_s = max(self._moved_s, self._observer.lost_s)
        self._observer.forget_view_before(self._moved_s)
        if time_s - self._moved_s <= memory_s:
            self._buffer.forget_before(time_s - memory_s)
        else:
            self._buffer.forget_replaced(time_s - memory_s)
        self._observer.compare_since(min(self._buffer.oldest_s, time_s - memory_s))

    def _restart(self, stamp_ns: int, size: tuple[int, int]) -> None:
        self._options.scale.require_inside(*size)
        self._observer = Observer(self._options, size, self._detector)
        self._buffer = EvidenceBuffer(self._options.buffer)
        self._size, self._first_stamp_ns, self._newest_stamp_ns = size, stamp_ns, stamp_ns - 1
        self._frames = 0
        self._tracks_seen = 0
        self._forget_s, self._moved_s = FORGET_PERIOD_S, -np.inf
        self._reset_schedule()

    def _reset_schedule(self) -> None:
        self._due_s, self._due_tracks = self._options.first_solve_s, float(self._options.gate.min_tracks)

    def snapshot_if_due(self) -> Evidence | None:
        """Return a snapshot when a new solution is worth trying now, else None.

        Depends on the images and their stamps alone, so that a live run and a replay solve the same evidence.
        """
        if self._observer is None:
            return None
        time_s = (self._newest_stamp_ns - self._first_stamp_ns) * 1e-9
        if time_s < self._due_s or self._tracks_seen < self._due_tracks:
            return None
        track_count = max(self._buffer.track_count, self._options.gate.min_tracks)
        self._due_tracks = self._tracks_seen + (self._options.solve_growth - 1.0) * track_count
        self._due_s = time_s + self._options.solve_interval_s
        return self.snapshot()

    def snapshot(self) -> Evidence | None:
        """Freeze the evidence so far; None before the first image."""
        evidence = self._buffered_evidence()
        return evidence and replace(evidence, still_lines_px=self._observer.still_lines())

    def _buffered_evidence(self) -> Evidence | None:
        """Freeze what the buffer holds."""
        if self._observer is None:
            return None
        return self._buffer.snapshot(
            image_size=self._size,
            first_stamp_ns=self._first_stamp_ns,
            newest_stamp_ns=self._newest_stamp_ns,
            frames=self._frames,
            drift_px=self._observer.drift_px,
            unfinished=self._observer.unfinished(),
        )

    def progress(self) -> CalibrationProgress:
        """Say how much of the evidence that a solution needs is there."""
        evidence, gate = self._buffered_evidence(), self._options.gate
        if evidence is None:
            return CalibrationProgress(0.0, ('no image yet',))
        evidence, _ = drop_pedestrians(evidence)
        needs = requirements(evidence, gate, self._options.first_solve_s)
        scarcest = min(need.fraction for need in needs)
        missing = [need.description for need in needs if need.fraction < 1.0]
        moving = check_steady(evidence, gate)
        if moving:
            return CalibrationProgress(100.0 * scarcest, (moving.message, *missing))
        return CalibrationProgress(100.0 * scarcest, tuple(missing), outlook(evidence, scarcest))

    def followed(self, steps: int = TRAIL_FRAMES) -> np.ndarray:
        """Return where the points followed now were in the last images, pixels (n, steps, 2), for people to look at."""
        return np.zeros((0, steps, 2)) if self._observer is None else self._observer.followed(steps)

    def background(self) -> np.ndarray | None:
        """Return the road without its traffic, BGR uint8 of the full size, for people to look at."""
        return None if self._observer is None else self._observer.background()
