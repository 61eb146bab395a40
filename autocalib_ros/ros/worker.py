"""Perception and solver threads between the image callback and the published calibration.

    image callback -> image queue -> perception thread -> newest snapshot -> solver thread -> listener

Neither the executor nor the perception thread waits for a solution. The image queue holds a few images, because a
lost image costs tracks while a late one costs nothing; when it is full the oldest image is dropped and counted. Only
the newest snapshot waits for the solver. Snapshots are solved in order, so a result is never followed by one from
older evidence.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from autocalib_ros.calibrator import AutoCalibrator, CalibrationProgress, ImageIntake
from autocalib_ros.config import Options, Polygons
from autocalib_ros.errors import AutocalibError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.stillness import ViewChange
from autocalib_ros.lens.camera import Camera
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.frame_clock import ClockSummary
from autocalib_ros.perception.view_watch import KnownView, ViewReport, ViewWatch
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.camera_move import MoveKind
from autocalib_ros.ros.solver_activity import SolverActivity
from autocalib_ros.solver_process import SolverTimedOut

IMAGE_QUEUE_SIZE = 8
"""Images waiting for the perception thread: bridges half a second at 15 Hz, 22 MB at 1280x720."""
REST_FACTOR = 4.0
"""Pause after a solution, in units of its duration: solving takes at most a fifth of a core."""
MAX_REFUSED_PERCENT = 99.0
"""Upper limit of the progress while the last solution was refused."""
PROGRESS_PERIOD_S = 1.0
"""Real seconds between two progress updates."""
Result = Calibration | Refusal
CalibratorFactory = Callable[[Options, VehicleDetector | None], AutoCalibrator]


class Solve(Protocol):
    """Solver of a snapshot; with a known lens it estimates the pose only."""

    def __call__(self, evidence: Evidence, options: Options, /, *, lens: Camera | None) -> Result:
        """Return a calibration or a refusal."""


class Viewer(Protocol):
    """Draws what the threads do. Called from these threads, so its methods must return at once."""

    def image_used(self, message: Any, image: np.ndarray, followed: Callable[[], np.ndarray]) -> None:
        """Take an image that became evidence; `followed` returns the recent positions of the tracked points."""

    def solution_found(self, result: Result, evidence: Evidence) -> None:
        """Take the result of a snapshot."""


class Listener(Protocol):
    """Receives the results of the threads; called from these threads."""

    def image_accepted(self, width: int, height: int) -> None:
        """Take the size of a decoded image."""

    def on_evidence_reset(self, why: str, stamp_ns: int) -> None:
        """Note that all evidence before an image of this stamp was dropped."""

    def image_unreadable(self, error: AutocalibError) -> None:
        """Take the error of an image that could not be used."""

    def solved(self, result: Result) -> None:
        """Take the result of a snapshot."""

    def failed(self, error: Exception) -> None:
        """Take a fault of the program; both threads keep running."""

    def view_changed(self, report: ViewReport, stamp_ns: int) -> Calibration | None:
        """Take what the newest image says about the view; return the calibration if it was mended by its move."""

    def picture_moved(self, change: ViewChange, view: int, stamp_ns: int) -> None:
        """Take a change of the view that no calibration measures, in image terms, and the number of the present view.

        The first view of a stream has the number 0, and again when it is back.
        """


@dataclass
class Counters:
    """Number of images so far, by outcome."""

    received: int = 0
    dropped: int = 0
    unreadable: int = 0
    late: int = 0
    """Skipped: the time stamp was not newer than that of an earlier image."""
    odd_size: int = 0
    """Skipped: the size was not that of the images before, and did not last."""
    used: int = 0
    repeated: int = 0
    """Of the used ones, repeats of an earlier image, which show nothing new."""

    def __str__(self) -> str:
        return (
            f'images received {self.received}, used {self.used}, dropped {self.dropped}, '
            f'unreadable {self.unreadable}, late {self.late}, repeated {self.repeated}'
        )


@dataclass
class _Job:
    evidence: Evidence
    generation: int
    """Generation of the evidence: the number of resets before it was collected."""
    view: KnownView | None = None
    """Image of the view that the evidence is from."""
    search_for_segments: Callable[[], tuple[np.ndarray, np.ndarray]] | None = None
    """Gives lines and bars of the still scene; runs in the solver thread, so that the images do not wait for it."""
    waiting: list[Future] = field(default_factory=list)
    """Futures of service calls, resolved with the result of this snapshot or of a newer one that replaced it."""


class CalibrationWorker:
    """Owns the calibrator and the two threads; `offer` and `solve_now` are thread-safe.

    Each reset starts a new generation of evidence; snapshots and results of an older generation are dropped.
    `stop_solving` aborts a running solution when the worker is closed.
    """

    def __init__(
        self,
        options: Options,
        *,
        idle_solve_s: float,
        decode: Callable[[Any], np.ndarray],
        solve: Solve,
        listener: Listener,
        viewer: Viewer | None = None,
        lens: Camera | None = None,
        detector: VehicleDetector | None = None,
        stop_solving: Callable[[], None] = lambda: None,
        calibrator: CalibratorFactory = AutoCalibrator,
    ) -> None:
        self._stop_solving, self._new_calibrator = stop_solving, calibrator
        self._options, self._idle_solve_s, self._lens, self._detector = options, idle_solve_s, lens, detector
        self._decode, self._solve, self._listener, self._viewer = decode, solve, listener, viewer
        self._calibrator = calibrator(options, detector)
        self._changed = threading.Condition()
        self._images: deque[tuple[int, Any]] = deque(maxlen=IMAGE_QUEUE_SIZE)
        self._requests: list[Future] = []
        self._snapshot_requests: list[Future] = []
        self._job: _Job | None = None
        self._running: _Job | None = None
        self._closed = self._changing = False
        self._generation, self._calibrator_generation = 0, 0
        self._listener_lock = threading.Lock()
        self._unsolved_images = 0
        self._last_arrival = self._rest_until = time.monotonic()
        self._progress_at = -PROGRESS_PERIOD_S
        self.counters = Counters()
        self.progress: CalibrationProgress | None = None
        self.clock = ClockSummary()
        """What the frame clock made of the stamps so far."""
        self.reported_evidence: Evidence | None = None
        """Evidence of the result that the listener is handling; None otherwise."""
        self._refused = ''
        self.solver = SolverActivity()
        self._accepted_tracks, self._is_in_doubt = 0, False
        self._watch = ViewWatch()
        self._watch_steps: list[Callable[[], None]] = []
        self._left_ns = 0
        self.view = ViewReport()
        """What the newest image says about the view of the calibration."""
        self.known: tuple[Calibration | None, tuple[KnownView, ...]] = (None, ())
        """The calibration whose view is watched, with images of that view for the next start."""
        self._watched: Calibration | None = None
        self._ignored = options.ignored_polygons
        self._newest_change: tuple[ViewChange, int] | None = None
        self.solved_view: KnownView | None = None
        """View of the result that the listener is handling; None otherwise."""
        self._threads = [
            threading.Thread(target=run, name=name, daemon=True)
            for run, name in ((self._run_perception, 'perception'), (self._run_solver, 'solver'))
        ]
        for thread in self._threads:
            thread.start()

    def offer(self, stamp_ns: int, message: Any) -> None:
        """Queue an image for the perception thread; a full queue drops its oldest image."""
        with self._changed:
            self.counters.received += 1
            self.counters.dropped += len(self._images) == IMAGE_QUEUE_SIZE
            self._images.append((stamp_ns, message))
            self._last_arrival = time.monotonic()
            self._changed.notify_all()

    def solve_now(self) -> Future:
        """Request a solution of the evidence so far; the future holds None if there is none yet."""
        future: Future = Future()
        with self._changed:
            if self._closed:
                future.set_result(None)
            else:
                self._requests.append(future)
                self._changed.notify_all()
        return future

    def request_snapshot(self) -> Future:
        """Request evidence and background image without solving; the future holds (None, None) before any image."""
        future: Future = Future()
        with self._changed:
            if self._closed:
                future.set_result((None, None))
            else:
                self._snapshot_requests.append(future)
                self._changed.notify_all()
        return future

    def reset(self) -> None:
        """Drop all evidence; once this returns, the listener gets no result that rests on it.

        The listener must not call this: it holds the same lock. A running solution is not interrupted; its result is
        dropped, and its callers get None.
        """
        with self._listener_lock, self._changed:
            self._generation += 1
            self._images.clear()
            self._unsolved_images = 0
            waiting = self._drop_waiting()
            self.progress, self._refused = None, ''
            self._changed.notify_all()
        self._resolve(waiting, None)

    def change(self, options: Options, idle_solve_s: float) -> None:
        """Use other options from the next solution on; only those of `config.is_reconfigurable` may differ."""
        with self._changed:
            self._options, self._idle_solve_s, self._changing = options, idle_solve_s, True
            self._changed.notify_all()

    @property
    def options(self) -> Options:
        """Options of the next solution."""
        return self._options

    def watch_stored(self, calibration: Calibration, views: Sequence[KnownView]) -> None:
        """Watch the view of a calibration of an earlier run."""
        self._at_next_image(lambda: self._watch.begin(views, calibration.camera), calibration)

    def watch_solved(self, calibration: Calibration) -> None:
        """Watch the view of a new calibration; to be called by the listener as it takes that."""
        view = self.solved_view
        if view is None:
            self.watch_stored(calibration, ())
        else:
            self._at_next_image(lambda: self._watch.succeed(view, calibration.camera), calibration)

    def doubt(self) -> None:
        """Ask for another solution soon; to be called by the listener as it takes one that contradicts."""
        self._is_in_doubt = True

    def ignore(self, polygons: Polygons) -> None:
        """Ignore other regions from the next image on, in pixels of the full image."""
        self._ignored = polygons

    def watch_nothing(self) -> None:
        """Watch no view any more: there is no calibration."""
        self._at_next_image(self._watch.end, None)

    def _at_next_image(self, step: Callable[[], None], calibration: Calibration | None) -> None:
        def watch() -> None:
            step()
            self._watched = calibration

        with self._changed:
            self._watch_steps.append(watch)

    def close(self, timeout_s: float) -> bool:
        """Stop both threads; return whether they ended in time, since not every solver can be interrupted."""
        with self._changed:
            self._closed = True
            waiting = self._drop_waiting()
            snapshot_requests, self._snapshot_requests = self._snapshot_requests, []
            self._changed.notify_all()
        self._resolve(waiting, None)
        self._resolve(snapshot_requests, (None, None))
        self._stop_solving()
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        return not any(thread.is_alive() for thread in self._threads)

    def _drop_waiting(self) -> list[Future]:
        """Drop requests and waiting snapshot; return their futures and those of the running solution."""
        waiting = self._requests
        for job in (self._job, self._running):
            waiting += job.waiting if job else []
        self._requests, self._job = [], None
        return waiting

    def _run_perception(self) -> None:
        """Run the perception thread, the only one that uses the calibrator."""
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._closed or self._images or self._requests or self._snapshot_requests or self._changing,
                    self._until_idle(),
                )
                if self._closed:
                    return
                generation = self._generation
                changing, self._changing = self._changing, False
                snapshot_requests, self._snapshot_requests = self._snapshot_requests, []
                image = self._images.popleft() if self._images else None
                requests: list[Future] = []
                # a request covers all images so far, but does not wait for a queue that never empties
                if len(self._images) in (0, IMAGE_QUEUE_SIZE - 1):
                    requests, self._requests = self._requests, []
            if generation != self._calibrator_generation:
                self._calibrator, self._calibrator_generation = (
                    self._new_calibrator(self._options, self._detector),
                    generation,
                )
            if changing:
                self._calibrator.change(self._options)
                self._unsolved_images += 1  # solve again even if no further image arrives
            if image is not None:
                self._process_image(*image)
            if snapshot_requests:
                self._resolve(
                    snapshot_requests,
                    self._guarded(lambda: (self._calibrator.snapshot(), self._calibrator.background())) or (None, None),
                )
            if requests or (image is None and self._until_idle() == 0.0):
                self._submit(self._guarded(partial(self._calibrator.snapshot, with_segments=False)), requests)

    def _until_idle(self) -> float | None:
        """Return the seconds until the stream counts as idle; None if all images are solved."""
        if not self._unsolved_images:
            return None
        return max(0.0, self._last_arrival + self._idle_solve_s - time.monotonic())

    def _process_image(self, stamp_ns: int, message: Any) -> None:
        """Add one image to the evidence; submit a snapshot if one is due."""
        try:
            image = self._decode(message)
            height, width = image.shape[:2]
            self._lens_for((width, height))  # skips an image whose shape is not that of the lens
            self._calibrator.ignore(self._ignored)
            repeated = self._calibrator.repeated
            intake = self._calibrator.add_image(stamp_ns, image)
            self.counters.repeated += max(0, self._calibrator.repeated - repeated)
        except AutocalibError as error:
            self.counters.unreadable += 1
            self._listener.image_unreadable(error)
            return
        except Exception as error:  # an unattended camera has to survive a bad frame
            self._listener.failed(error)
            return
        if intake in (ImageIntake.LATE, ImageIntake.ODD_SIZE):
            self.counters.late += intake is ImageIntake.LATE
            self.counters.odd_size += intake is ImageIntake.ODD_SIZE
            return
        if intake in (ImageIntake.TIME_JUMPED, ImageIntake.RESIZED):
            self._refused = ''
            self._listener.on_evidence_reset(intake.value, stamp_ns)
        self.counters.used += 1
        with self._changed:
            self._unsolved_images += self._generation == self._calibrator_generation
        self._listener.image_accepted(width, height)
        self._guarded(partial(self._watch_view, stamp_ns, image))
        self._guarded(partial(self._tell_unmeasured, stamp_ns))
        if self._viewer is not None:
            self._guarded(partial(self._viewer.image_used, message, image, self._calibrator.followed))
        accepted, self._accepted_tracks = self._accepted_tracks, 0
        if accepted:
            self._calibrator.accepted(accepted)
        evidence = self._guarded(self._calibrator.snapshot_if_due)
        if evidence is not None:
            self._submit(evidence, [])
        if time.monotonic() >= self._progress_at + PROGRESS_PERIOD_S:
            self._progress_at = time.monotonic()
            progress = self._add_refusal(self._guarded(self._calibrator.progress))
            self.clock = self._calibrator.clock()
            with self._changed:
                self.progress = progress if self._generation == self._calibrator_generation else None

    def _watch_view(self, stamp_ns: int, image: np.ndarray) -> None:
        """Show an image to the watch; tell the listener when the view is another, or the picture says nothing."""
        with self._changed:
            steps, self._watch_steps = self._watch_steps, []
        for step in steps:
            step()
        time_s = stamp_ns * 1e-9
        if stamp_ns < self._left_ns:  # the clock was set back
            self._left_ns = 0
        if self._watch.size not in (None, image.shape[1::-1]) or not (steps or self._watch.is_due(time_s)):
            return
        self._watch.ignore(self._ignored)
        before, report = self.view, self._watch.update(image, time_s)
        self.view = report
        if (report.condition, report.move, report.fault) != (before.condition, before.move, before.fault):
            mended = self._listener.view_changed(report, stamp_ns)
            move = report.move
            if move is not None and (move.is_measured or move.kind is MoveKind.OTHER_VIEW):
                self._left_ns = round(move.time_s * 1e9)
                self._calibrator.leave_view(self._left_ns)
                if mended is not None:
                    self._watch.ignore(self._ignored)  # the listener may have turned them with the camera
                    self._watch.rebase(move)
                    self._watched, self.view = mended, self._watch.report
        self.known = (self._watched, self._watch.views)

    def _tell_unmeasured(self, stamp_ns: int) -> None:
        """Tell a change of the view that the perception found, where no view of a calibration is watched."""
        newest = self._calibrator.newest_change
        if newest is not None and newest != self._newest_change and not self._watch.report.is_watched:
            self._listener.picture_moved(*newest, stamp_ns)
        self._newest_change = newest

    def _submit(self, evidence: Evidence | None, requests: list[Future]) -> None:
        """Hand a snapshot to the solver thread; it replaces a waiting one and takes over its callers."""
        with self._changed:
            self._unsolved_images = 0
            if evidence is not None and not self._closed and self._generation == self._calibrator_generation:
                waiting = self._job.waiting if self._job else []
                view = self._guarded(self._calibrator.known_view)
                search = self._guarded(self._calibrator.search_for_segments)
                self._job = _Job(evidence, self._generation, view, search, [*waiting, *requests])
                self._changed.notify_all()
                return
        self._resolve(requests, None)

    def _run_solver(self) -> None:
        """Run the solver thread."""
        while True:
            job = self._next_job()
            if job is None:
                return
            began = time.monotonic()
            if job.search_for_segments is not None:
                segments = self._guarded(job.search_for_segments)
                if segments is not None:
                    job.evidence = replace(job.evidence, still_lines_px=segments[0], stripes_px=segments[1])
            result = self._guarded(partial(self._solved, job.evidence))
            if result is not None:
                self.reported_evidence, self.solved_view = job.evidence, job.view
                result = self._notify(result, job)
                self.reported_evidence = self.solved_view = None
            self._rest_until = time.monotonic() + REST_FACTOR * (time.monotonic() - began)
            self._resolve(job.waiting, result)

    def _next_job(self) -> _Job | None:
        """Wait for a snapshot, and for the end of the pause unless a caller waits; return None when closed."""
        with self._changed:
            while not self._closed:
                job = self._job
                rest_s = 0.0 if job is None or job.waiting else self._rest_until - time.monotonic()
                if job is not None and rest_s <= 0.0:
                    self._running, self._job = job, None
                    return job
                self._changed.wait(None if job is None else rest_s)
        return None

    def _solved(self, evidence: Evidence) -> Result:
        self.solver.begin()
        try:
            result = self._solve(evidence, self._options, lens=self._lens_for(evidence.image_size))
        except Exception as error:
            self.solver.fail(error, timed_out=isinstance(error, SolverTimedOut))
            raise
        self.solver.end()
        return result

    def _notify(self, result: Result, job: _Job) -> Result | None:
        """Pass a result to listener and viewer; return None if a reset or a move of the camera made it obsolete."""
        with self._listener_lock:
            if job.generation != self._generation or job.evidence.first_stamp_ns < self._left_ns:
                return None
            self._refused = result.message if isinstance(result, Refusal) else ''
            self._is_in_doubt = False
            self._guarded(partial(self._listener.solved, result))
            if isinstance(result, Calibration) and not self._is_in_doubt:
                self._accepted_tracks = job.evidence.track_count
            if self._viewer is not None:
                self._guarded(partial(self._viewer.solution_found, result, job.evidence))
            return result

    def _add_refusal(self, progress: CalibrationProgress | None) -> CalibrationProgress | None:
        """Append the reason of the last refusal: evidence can pass the readiness check and still be refused."""
        if progress is None or not self._refused:
            return progress
        return replace(
            progress,
            percent=min(progress.percent, MAX_REFUSED_PERCENT),
            missing=tuple(dict.fromkeys((*progress.missing, self._refused))),
        )

    def _lens_for(self, image_size: tuple[int, int]) -> Camera | None:
        """Return the known lens scaled to images of that size; UsageError if their shape differs."""
        return None if self._lens is None else self._lens.scaled_to(*image_size)

    def _resolve(self, futures: list[Future], result: Any) -> None:
        """Set the result of futures; `close` may have resolved some before."""
        with self._changed:
            for future in futures:
                if not future.done():
                    future.set_result(result)

    def _guarded(self, step: Callable[[], Any]) -> Any:
        """Return the result of `step`, or None if it raises: an exception would end the thread without a trace."""
        try:
            return step()
        except Exception as error:  # reported with its traceback by the listener
            if not self._closed:  # an aborted solution at shutdown is no fault
                self._listener.failed(error)
            return None
