"""Gather the evidence of one recording, with the solutions that a live node would have tried on the way."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.evidence.read_recording import ReadRecording
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.move_log import MoveLog
from autocalib_ros.offline.recordings.prefetch import prefetched
from autocalib_ros.offline.recordings.sources import Source
from autocalib_ros.offline.solution_trials import SolutionTrials, StartSolving, solved_in_between
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.frame_clock import ClockSummary
from autocalib_ros.results.calibration import Calibration, Refusal

LOG = logging.getLogger(__name__)

NOTE_EVERY_S = 1.0
"""Real seconds between two notes of what is missing: each costs as much as an image, and is read by people."""
CHECKPOINT_EVERY_S = 120.0
"""Seconds of recording after which its evidence so far is stored: as much is lost at most, and storing takes a second
at the most."""


@dataclass(frozen=True, kw_only=True)
class ReplayControl:
    """What the program around a replay wants to know and may decide while a recording is read."""

    on_progress: Callable[[int, str], None] | None = None
    """Receives the number of frames and a short note, whose first word is the state."""
    should_stop: Callable[[], bool] = lambda: False
    """Asked after each image; true: what was seen so far is solved."""
    on_checkpoint: Callable[[Evidence], None] | None = None
    """Receives the evidence so far every `CHECKPOINT_EVERY_S` of recording, and before the last solution."""
    start_solving: StartSolving | None = None
    """Solves the evidence on the way while images are read; None solves it in between."""
    on_accepted: Callable[[Calibration, np.ndarray], None] | None = None
    """Receives the first calibration that is accepted while the recording is read, and the newest image."""
    clock: Callable[[], float] = time.monotonic
    """Real seconds, for the pace of the notes alone."""

    def report(self, frames: int, note: str) -> None:
        """Report progress."""
        if self.on_progress is not None:
            self.on_progress(frames, note)


@dataclass(frozen=True, kw_only=True)
class GatheredEvidence:
    """What one recording gave."""

    evidence: Evidence
    background: np.ndarray | None
    """Background image without traffic, BGR uint8; None if unknown."""
    frames: int
    repeated: int
    clock: ClockSummary
    trials: SolutionTrials
    """The solutions on the way, of which the last one may still be running."""
    stopped: bool
    """Whether `ReplayControl.should_stop` ended the reading."""
    moves: MoveLog
    """Moves of the camera."""


def gather_evidence(
    source: Source,
    options: Options,
    control: ReplayControl,
    *,
    lens: Camera | None = None,
    detector: VehicleDetector | None = None,
    frames_before: int = 0,
    tries_solutions: bool = True,
) -> GatheredEvidence:
    """Read a recording to its end, or until the control stops it. InputError without an image.

    If the view changes, the evidence is of the longest part in which it stands still. `frames_before` are added to the
    frames reported. A recording that is joined with others `tries_solutions` at the end only.
    """
    calibrator, moves = AutoCalibrator(options, detector), MoveLog()
    trials = SolutionTrials(options, control.start_solving or solved_in_between)
    notes = _Notes(control)
    count, stopped, shown, checkpoint_s, first_ns, seen_s = 0, False, False, CHECKPOINT_EVERY_S, 0, 0.0
    for count, frame in enumerate(prefetched(source.frames()), start=1):
        scaled_lens = scaled(lens, (frame.image.shape[1], frame.image.shape[0]))
        calibrator.add_image(frame.stamp_ns, frame.image)
        moves.add(frame.stamp_ns, frame.image, calibrator)
        first_ns = frame.stamp_ns if count == 1 else first_ns
        seen_s = (frame.stamp_ns - first_ns) * 1e-9
        due = calibrator.snapshot_if_due() if tries_solutions else None
        if due is not None:
            trials.begin_part(due.stillness.start_s)
            if trials.is_due(due.seconds, source.duration_s):
                control.report(frames_before + count, 'solving')
                trials.start(due.seconds, _completed(_as_recorded(due, source), calibrator), scaled_lens)
        trials.take_finished()
        if control.on_accepted is not None and not shown and isinstance(trials.latest, Calibration):
            shown = True
            control.on_accepted(trials.latest, frame.image)
        if control.on_checkpoint is not None and seen_s >= checkpoint_s:
            checkpoint_s = seen_s + CHECKPOINT_EVERY_S
            control.on_checkpoint(_longest_part(calibrator, source, source.window.start_s + seen_s))
        control.report(frames_before + count, notes.newest(calibrator, trials))
        if control.should_stop():
            stopped = True
            break
    if not count:
        raise InputError(f'{source.name} has no images')
    to_end = not stopped and source.window.duration_s is None
    evidence = _longest_part(calibrator, source, inf if to_end else source.window.start_s + seen_s)
    trials.begin_part(evidence.stillness.start_s)
    clock = calibrator.clock()
    if clock.is_uneven:
        LOG.warning('%s: uneven time stamps, regularised: %s', source.name, clock)
    return GatheredEvidence(
        evidence=evidence,
        background=calibrator.background(longest_part=True),
        frames=count,
        repeated=calibrator.repeated,
        clock=clock,
        trials=trials,
        stopped=stopped,
        moves=moves,
    )


def _longest_part(calibrator: AutoCalibrator, source: Source, read_s: float) -> Evidence:
    """Return the evidence so far of the longest still part, with its landmarks and what was read."""
    evidence = calibrator.snapshot(longest_part=True, landmarks=True)
    if evidence is None:
        raise InputError(f'{source.name} has no images')
    return replace(_as_recorded(evidence, source), recordings=(ReadRecording.of(source.name, read_s),))


def _completed(evidence: Evidence, calibrator: AutoCalibrator) -> Callable[[], Evidence]:
    """Return a function for another thread that adds the segments of the still scene as of now."""
    search = calibrator.search_for_segments()

    def complete() -> Evidence:
        lines, stripes = (evidence.still_lines_px, evidence.stripes_px) if search is None else search()
        return replace(evidence, still_lines_px=lines, stripes_px=stripes)

    return complete


def _as_recorded(evidence: Evidence, source: Source) -> Evidence:
    """Return evidence with the pixel aspect that its recording says."""
    return replace(evidence, pixel_aspect=source.pixel_aspect)


class _Notes:
    """Notes of what is missing, a new one every `NOTE_EVERY_S` and when a solution has ended."""

    def __init__(self, control: ReplayControl) -> None:
        self._control, self._note, self._due_s = control, '', -inf
        self._solved: Calibration | Refusal | None = None

    def newest(self, calibrator: AutoCalibrator, trials: SolutionTrials) -> str:
        """Return the newest note, '' if nobody reads it."""
        now_s = self._control.clock()
        if self._control.on_progress is not None and (now_s >= self._due_s or self._solved is not trials.latest):
            self._note, self._due_s = _progress_note(calibrator, trials), now_s + NOTE_EVERY_S
            self._solved = trials.latest
        return self._note


def _progress_note(calibrator: AutoCalibrator, trials: SolutionTrials) -> str:
    """Return state, progress of the evidence, and the missing evidence or the last refusal."""
    latest = trials.latest
    if isinstance(latest, Calibration):
        return f'calibrated since {trials.accepted_at_s:.0f} s: focal length {latest.camera.focal_px:.0f} px'
    progress = calibrator.progress()
    # the evidence is complete but the solution was refused: the refusal says what is missing
    return f'collecting {progress}' + (f': {latest.message}' if latest is not None and not progress.missing else '')


def scaled(lens: Camera | None, image_size: tuple[int, int]) -> Camera | None:
    """Return a lens for images of this size; UsageError if their aspect ratio differs."""
    return None if lens is None else lens.scaled_to(*image_size)
