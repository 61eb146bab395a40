"""The streaming front: images in, snapshots of the evidence out. The live node and the replay hold the same object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.estimation.observations.selection import drop_pedestrians
from autocalib_ros.estimation.verification.readiness import check_steady, drift_limit_px, outlook, requirements
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.perception.detector.detector import VehicleDetector, open_detector
from autocalib_ros.perception.observer import Observer

MAX_REORDERING_NS = 1_000_000_000
"""Images overtake each other by less than this on any transport; a longer step back is another recording."""
CLOCK_JUMP_NS = 24 * 3600 * 1_000_000_000
"""No camera pauses for longer than a day: a longer step forward means that the clock was set."""
FORGET_PERIOD_S = 10.0
"""Seconds of recording between two searches for old evidence; each costs milliseconds."""
TRAIL_FRAMES = 16
"""Images over which the trail of a tracked point is drawn: a second at 15 Hz."""


class ImageIntake(Enum):
    """What happened to an image; every value except `USED` and `LATE` restarts the evidence."""

    FIRST = 'the first image'
    USED = 'used'
    LATE = 'late: its time stamp is not newer than that of an earlier image'
    TIME_JUMPED = 'the time stamps jumped'
    RESIZED = 'the image size changed'


@dataclass(frozen=True)
class CalibrationProgress:
    """How complete the evidence is, for the person who installs the camera."""

    percent: float
    """0 to 100, by the requirement that is furthest from being met."""
    missing: tuple[str, ...]
    outlook: str = ''
    """For example 'about 6 min more at this rate'; '' if nothing can be predicted."""

    def __str__(self) -> str:
        missing = ', '.join([*filter(None, ['; '.join(self.missing), self.outlook])])
        return f'{self.percent:.0f} %' + (f': {missing}' if missing else '')


class _Stream:
    """Images of one size on one clock, with the evidence from them."""

    def __init__(
        self, options: Options, stamp_ns: int, size: tuple[int, int], detector: VehicleDetector | None
    ) -> None:
        options.scale.require_inside(*size)
        self.observer = Observer(options, size, detector)
        self.buffer = EvidenceBuffer(options.buffer)
        self.size, self.first_stamp_ns, self.newest_stamp_ns = size, stamp_ns, stamp_ns - 1
        self.frames = self.tracks_seen = 0
        self._next_forget_s, self._moved_s = FORGET_PERIOD_S, -np.inf

    @property
    def time_s(self) -> float:
        """Time of the newest image, seconds since the first."""
        return (self.newest_stamp_ns - self.first_stamp_ns) * 1e-9

    def add(self, stamp_ns: int, image: np.ndarray, options: Options) -> None:
        """Take one image and gather what it shows."""
        time_s = (stamp_ns - self.first_stamp_ns) * 1e-9
        observed = self.observer.observe(image, time_s)
        self.buffer.add(observed.tracks, observed.segments, observed.edges, observed.outlines)
        self.tracks_seen += len(observed.tracks)
        if time_s >= self._next_forget_s:
            self._forget(time_s, options)
        self.newest_stamp_ns = stamp_ns
        self.frames += 1

    def _forget(self, time_s: float, options: Options) -> None:
        """Drop old evidence that newer evidence replaces; all that is old if the camera moved, or may have moved.

        The camera counts as moved until no evidence from before the motion is left.
        """
        memory_s = options.buffer.seconds
        self._next_forget_s = time_s + FORGET_PERIOD_S
        if self.observer.drift_px > drift_limit_px(self.size[0], options.gate):
            self._moved_s = time_s
        self._moved_s = max(self._moved_s, self.observer.lost_s)
        self.observer.forget_view_before(self._moved_s)
        if time_s - self._moved_s <= memory_s:
            self.buffer.forget_before(time_s - memory_s)
        else:
            self.buffer.forget_replaced(time_s - memory_s)
        self.observer.compare_since(min(self.buffer.oldest_s, time_s - memory_s))

    def evidence(self) -> Evidence:
        """Freeze the evidence so far, without the lines of the background, which take longer to find."""
        return self.buffer.snapshot(
            image_size=self.size,
            first_stamp_ns=self.first_stamp_ns,
            newest_stamp_ns=self.newest_stamp_ns,
            frames=self.frames,
            drift_px=self.observer.drift_px,
            unfinished=self.observer.unfinished(),
        )


class AutoCalibrator:
    """Gathers evidence image by image; bounded in memory on an endless stream; not thread-safe.

    A `detector` that is already open is used; otherwise that of the options is opened. Raises UsageError if that fails.
    """

    def __init__(self, options: Options, detector: VehicleDetector | None = None) -> None:
        self._options = options
        self._detector = detector or open_detector(options.detector)
        self._stream: _Stream | None = None
        self._reset_schedule()

    def add_image(self, stamp_ns: int, image: np.ndarray) -> ImageIntake:
        """Take one image: grey (H, W) or BGR (H, W, 3), uint8; it is neither kept nor changed.

        An image whose stamp repeats, or steps back by less than `MAX_REORDERING_NS`, is late and left out. A stamp
        that steps back further (a clock that was set, a recording that starts again) or forward by `CLOCK_JUMP_NS`,
        or a new image size, restarts the evidence. Raises UsageError if a pixel of scale.distance_px lies outside the
        image, InputError for an array of another kind.
        """
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            raise InputError(f'an image is grey (H, W) or BGR (H, W, 3) in 8 bits, got {image.dtype} {image.shape}')
        size = (image.shape[1], image.shape[0])
        intake = self._intake(stamp_ns, size)
        if intake is ImageIntake.LATE:
            return intake
        if intake is not ImageIntake.USED or self._stream is None:
            self._stream = _Stream(self._options, stamp_ns, size, self._detector)
            self._reset_schedule()
        self._stream.add(stamp_ns, image, self._options)
        return intake

    def _intake(self, stamp_ns: int, size: tuple[int, int]) -> ImageIntake:
        if self._stream is None:
            return ImageIntake.FIRST
        if size != self._stream.size:
            return ImageIntake.RESIZED
        step_ns = stamp_ns - self._stream.newest_stamp_ns
        if not -MAX_REORDERING_NS < step_ns < CLOCK_JUMP_NS:
            return ImageIntake.TIME_JUMPED
        return ImageIntake.USED if step_ns > 0 else ImageIntake.LATE

    def change(self, options: Options) -> None:
        """Take other options, which may differ in what `config.is_reconfigurable` allows; a solution is due at once."""
        self._options = options
        self._reset_schedule()

    def _reset_schedule(self) -> None:
        self._due_s, self._due_tracks = self._options.first_solve_s, float(self._options.gate.min_tracks)

    def snapshot_if_due(self) -> Evidence | None:
        """Return a snapshot if a new solution is worth trying now, else None.

        Depends on the images and their stamps alone, so that a live run and a replay solve the same evidence.
        """
        stream = self._stream
        if stream is None or stream.time_s < self._due_s or stream.tracks_seen < self._due_tracks:
            return None
        tracks = max(stream.buffer.track_count, self._options.gate.min_tracks)
        self._due_tracks = stream.tracks_seen + (self._options.solve_growth - 1.0) * tracks
        self._due_s = stream.time_s + self._options.solve_interval_s
        return self.snapshot()

    def snapshot(self) -> Evidence | None:
        """Freeze the evidence so far; None before the first image."""
        if self._stream is None:
            return None
        return replace(self._stream.evidence(), still_lines_px=self._stream.observer.still_lines())

    def progress(self) -> CalibrationProgress:
        """Return how much of the evidence for a solution is there."""
        if self._stream is None:
            return CalibrationProgress(0.0, ('no image yet',))
        evidence, _ = drop_pedestrians(self._stream.evidence())
        needs = requirements(evidence, self._options.gate, self._options.first_solve_s)
        scarcest = min(need.fraction for need in needs)
        missing = tuple(need.description for need in needs if need.fraction < 1.0)
        moving = check_steady(evidence, self._options.gate)
        if moving:
            return CalibrationProgress(100.0 * scarcest, (moving.message, *missing))
        return CalibrationProgress(100.0 * scarcest, missing, outlook(evidence, scarcest))

    def followed(self, steps: int = TRAIL_FRAMES) -> np.ndarray:
        """Return the trails of the points that are tracked now, pixels (n, steps, 2), for display."""
        return np.zeros((0, steps, 2)) if self._stream is None else self._stream.observer.followed(steps)

    def background(self) -> np.ndarray | None:
        """Return the road without its traffic, BGR uint8 of the full size, for display."""
        return None if self._stream is None else self._stream.observer.background()
