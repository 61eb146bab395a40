"""The streaming front: images in, snapshots of the evidence out. The live node and the replay hold the same object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from autocalib_ros.config import Options, Polygons
from autocalib_ros.errors import InputError
from autocalib_ros.estimation.observations.selection import drop_pedestrians
from autocalib_ros.estimation.verification.readiness import check_steady, outlook, requirements
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.solution_schedule import SolutionSchedule
from autocalib_ros.evidence.stillness import ViewChange
from autocalib_ros.perception.detector.detector import VehicleDetector, open_detector
from autocalib_ros.perception.frame_clock import ClockSummary
from autocalib_ros.perception.image_stream import ImageStream
from autocalib_ros.perception.image_timing import ImageTiming
from autocalib_ros.perception.size_change import SizeChange
from autocalib_ros.perception.view_watch import KnownView

TRAIL_FRAMES = 16
"""Images over which the trail of a tracked point is drawn: a second at 15 Hz."""


class ImageIntake(Enum):
    """What happened to an image; `FIRST`, `TIME_JUMPED` and `RESIZED` restart the evidence."""

    FIRST = 'the first image'
    USED = 'used, or held until the next images tell its time'
    LATE = 'late: its time stamp is not newer than that of an earlier image'
    TIME_JUMPED = 'the time stamps jumped'
    ODD_SIZE = 'skipped: its size is another one than before, and has not lasted yet'
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


class AutoCalibrator:
    """Gathers evidence image by image; bounded in memory on an endless stream; not thread-safe.

    A `detector` that is already open is used; otherwise that of the options is opened. Raises UsageError if that fails.
    """

    def __init__(self, options: Options, detector: VehicleDetector | None = None) -> None:
        self._options = options
        self._detector = detector or open_detector(options.detector)
        self._stream: ImageStream | None = None
        self.ignored = options.ignored_polygons
        """Polygons that are ignored, in pixels of the full image."""
        self._timing = ImageTiming(self._follows)
        self._size_change = SizeChange()
        self._schedule = SolutionSchedule(options)

    def add_image(self, stamp_ns: int, image: np.ndarray) -> ImageIntake:
        """Take one image: grey (H, W) or BGR (H, W, 3), uint8; it is neither kept nor changed.

        `perception.frame_clock` gives each image its time: one odd stamp is one image, a clock that is set goes on
        with the evidence. A recording that starts again, a clock set by a day or more, or a new image size that lasts
        restarts the evidence. Raises UsageError if a pixel of scale.distance_px lies outside the image, InputError for
        an array of another kind.
        """
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            raise InputError(f'an image is grey (H, W) or BGR (H, W, 3) in 8 bits, got {image.dtype} {image.shape}')
        size, frames = (image.shape[1], image.shape[0]), 0 if self._stream is None else self._stream.frames
        resized = self._stream is not None and size != self._stream.size
        if resized and not self._size_change.has_lasted(size, stamp_ns):
            return ImageIntake.ODD_SIZE
        self._size_change = SizeChange()
        if resized:
            self._timing = ImageTiming(self._follows)
        taken = self._timing.add(stamp_ns, image)
        if resized or taken.restarted:
            self._stream = None
        for ready in taken.ready:
            if self._stream is None:
                self._stream = ImageStream(self._options, ready.time_ns, size, self._detector)
                self._schedule = SolutionSchedule(self._options)
                self.ignore(self.ignored)
            self._stream.add(ready, self._timing.offset_ns, self._options)
        if resized:
            return ImageIntake.RESIZED
        if taken.restarted and frames > 1:
            return ImageIntake.TIME_JUMPED
        return ImageIntake.LATE if taken.is_late else ImageIntake.USED if frames else ImageIntake.FIRST

    def _follows(self, image: np.ndarray) -> bool:
        """Return whether an image shows the traffic one step after the last one."""
        return self._stream is not None and self._stream.observer.follows(image)

    def clock(self) -> ClockSummary:
        """Return what the frame clock made of the stamps since the image size changed last."""
        return self._timing.summary()

    def change(self, options: Options) -> None:
        """Take other options, which may differ in what `config.is_reconfigurable` allows; a solution is due at once."""
        self._options = options
        self._schedule = SolutionSchedule(options)

    def ignore(self, polygons: Polygons) -> None:
        """Ignore other regions from the next image on, as where the camera has turned."""
        self.ignored = polygons
        if self._stream is not None and polygons != self._stream.observer.ignored:
            self._stream.observer.ignore(polygons)

    def snapshot_if_due(self) -> Evidence | None:
        """Return a snapshot without segments of the still scene if a new solution is worth trying now, else None.

        Depends on the images and their stamps alone, so that a live run and a replay solve the same evidence.
        """
        stream = self._stream
        if stream is None or not self._schedule.is_due(stream.part, stream.time_s):
            return None
        return self.snapshot(with_segments=False)

    def accepted(self, tracks: int) -> None:
        """Record that evidence of this many tracks gave a calibration, which `SolutionSchedule.accepted` explains."""
        if self._stream is not None:
            self._schedule.accepted(self._stream.part, tracks)

    def snapshot(
        self, *, longest_part: bool = False, landmarks: bool = False, with_segments: bool = True
    ) -> Evidence | None:
        """Freeze the evidence so far; None before the first image.

        Evidence is of the present view of the camera, or of the one that was still for the longest time; `landmarks`
        says whether it holds those of the background, by which evidence of other recordings can be joined. Segments of
        the still scene take longest to find: `with_segments` adds them later, `search_for_segments` in another thread.
        """
        stream = self._stream
        if stream is None:
            return None
        view = stream.longest_view() if longest_part else stream.observer.view
        evidence = stream.evidence(view)
        if with_segments:
            evidence = self._with_segments(evidence, stream, view)
        return evidence.with_landmarks(stream.observer.landmarks(view)) if landmarks else evidence

    def with_segments(self, evidence: Evidence) -> Evidence:
        """Return a `snapshot` of the present view with the segments of the still scene, if it came without."""
        stream = self._stream
        return evidence if stream is None else self._with_segments(evidence, stream, stream.observer.view)

    @staticmethod
    def _with_segments(evidence: Evidence, stream: ImageStream, view: int) -> Evidence:
        lines, stripes = stream.observer.still_segments(view)
        return replace(evidence, still_lines_px=lines, stripes_px=stripes)

    def search_for_segments(self) -> Callable[[], tuple[np.ndarray, np.ndarray]] | None:
        """Return a function for another thread: the lines and bars of `snapshot` as of now; None before an image."""
        return None if self._stream is None else self._stream.observer.search_for_segments()

    def known_view(self) -> KnownView | None:
        """Return a small image of the present view, in the pose of `snapshot`, for registration; None before one."""
        return None if self._stream is None else self._stream.observer.known_view(self._stream.observer.view)

    def leave_view(self, moved_ns: int) -> None:
        """Begin evidence of another view, if the present one began before the stamp at which the camera moved."""
        if self._stream is not None:
            self._stream.leave_view(moved_ns)

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

    @property
    def newest_change(self) -> tuple[ViewChange, int] | None:
        """The newest change of the view, in image terms, and the number of the present view; None without a change."""
        change = None if self._stream is None else self._stream.observer.newest_change
        return None if change is None or self._stream is None else (change, self._stream.observer.view)

    @property
    def repeated(self) -> int:
        """Number of images of the stream so far that repeat an earlier one."""
        return 0 if self._stream is None else self._stream.observer.repeated

    def followed(self, steps: int = TRAIL_FRAMES) -> np.ndarray:
        """Return the trails of the points that are tracked now, pixels (n, steps, 2), for display."""
        return np.zeros((0, steps, 2)) if self._stream is None else self._stream.observer.followed(steps)

    def background(self, *, longest_part: bool = False) -> np.ndarray | None:
        """Return the road without its traffic, BGR uint8 of the full size, for display; of the view of `snapshot`."""
        stream = self._stream
        return None if stream is None else stream.observer.background(stream.longest_view() if longest_part else None)
