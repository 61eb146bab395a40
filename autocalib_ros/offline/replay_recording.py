"""Calibrate from a recording with the same `AutoCalibrator` as the live node."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.sources import Source
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.frame_clock import ClockSummary
from autocalib_ros.report.scene import SolutionSnapshot, append_snapshot
from autocalib_ros.results.calibration import Calibration, Refusal

LOG = logging.getLogger(__name__)

SOLVE_AGAIN_GROWTH = 2.0
"""Growth of the recording after which an accepted calibration is solved again, for the convergence plot of the report.

With twice the evidence a standard deviation falls by a third."""
PROGRESS_EVERY_FRAMES = 15
"""Frames between progress updates."""


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """Result and evidence of a recording."""

    result: Calibration | Refusal
    evidence: Evidence
    accepted_at_s: float | None
    """Seconds of recording before the first accepted calibration; None without one."""
    background: np.ndarray | None
    """Background image without traffic, BGR uint8; None if unknown."""
    frames: int
    repeated: int = 0
    """How many of the frames repeat an earlier one, exactly or through a codec."""
    options: Options = field(default_factory=Options)
    moments: tuple[SolutionSnapshot, ...] = ()
    """Intermediate solutions and the last one, for the convergence plot of the report."""
    clock: ClockSummary = field(default_factory=ClockSummary)
    """What the frame clock made of the stamps."""


def replay(
    recording: Source | Path | str,
    options: Options,
    on_progress: Callable[[int, str], None] | None = None,
    lens: Camera | None = None,
    detector: VehicleDetector | None = None,
) -> ReplayResult:
    """Collect evidence from a recording, given as a path or an open source, and solve at its end.

    If the view changes (cuts, zooms, a camera that is turned), the longest part in which it stands still is solved.
    `on_progress` receives the number of frames and a short note, whose first word is the state: collecting, solving,
    calibrated or refused. With a known `lens` only the pose is estimated; UsageError if its aspect ratio differs from
    that of the images. `detector` is an open detector; None opens the one of the options. InputError without an image.
    """
    source = open_source(recording) if isinstance(recording, (str, Path)) else recording
    report_progress = on_progress or (lambda done, note: None)
    calibrator, accepted_at_s, count, note, scaled_lens = AutoCalibrator(options, detector), None, 0, '', None
    latest: Calibration | Refusal | None = None
    moments: tuple[SolutionSnapshot, ...] = ()
    next_solve_s, part_start_s = 0.0, 0.0
    for count, frame in enumerate(source.frames(), start=1):
        scaled_lens = _scaled_lens(lens, (frame.image.shape[1], frame.image.shape[0]))
        calibrator.add_image(frame.stamp_ns, frame.image)
        due = _as_recorded(calibrator.snapshot_if_due(), source)
        if due is not None and due.stillness.start_s != part_start_s:  # another still part of the recording
            part_start_s = due.stillness.start_s
            accepted_at_s, moments, latest, next_solve_s = None, (), None, 0.0
        if due is not None and due.seconds >= next_solve_s:
            report_progress(count, 'solving')
            tried = solve(due, options, lens=scaled_lens)
            moments = append_snapshot(moments, tried)
            if tried and accepted_at_s is None:  # a live node would have accepted it at this time
                accepted_at_s = due.seconds
            latest = tried if tried or accepted_at_s is None else latest
            next_solve_s = 0.0 if accepted_at_s is None else SOLVE_AGAIN_GROWTH * due.seconds
        if on_progress is not None and count % PROGRESS_EVERY_FRAMES == 1:
            note = _progress_note(calibrator, latest, accepted_at_s)
        report_progress(count, note)
    evidence = _as_recorded(calibrator.snapshot(longest_part=True), source)
    if evidence is None:
        raise InputError(f'{source.name} has no images')
    if evidence.stillness.start_s != part_start_s:
        accepted_at_s, moments = None, ()
    clock = calibrator.clock()
    if clock.is_uneven:
        LOG.warning('%s: uneven time stamps, regularised: %s', source.name, clock)
    report_progress(count, 'solving')
    result = solve(evidence, options, lens=scaled_lens)
    report_progress(count, 'calibrated' if result else 'refused')
    if result and accepted_at_s is None:
        accepted_at_s = evidence.seconds
    return ReplayResult(
        result=result,
        evidence=evidence,
        accepted_at_s=accepted_at_s,
        background=calibrator.background(longest_part=True),
        frames=count,
        repeated=calibrator.repeated,
        options=options,
        moments=append_snapshot(moments, result),
        clock=clock,
    )


def _as_recorded(evidence: Evidence | None, source: Source) -> Evidence | None:
    """Return evidence with the pixel aspect that its recording says."""
    return evidence and replace(evidence, pixel_aspect=source.pixel_aspect)


def _progress_note(
    calibrator: AutoCalibrator, latest: Calibration | Refusal | None, accepted_at_s: float | None
) -> str:
    """Return state, progress of the evidence, and the missing evidence or the last refusal."""
    if isinstance(latest, Calibration):
        return f'calibrated since {accepted_at_s:.0f} s: focal length {latest.camera.focal_px:.0f} px'
    progress = calibrator.progress()
    # the evidence is complete but the solution was refused: the refusal says what is missing
    return f'collecting {progress}' + (f': {latest.message}' if latest is not None and not progress.missing else '')


def solve_evidence(evidence: Evidence, options: Options, lens: Camera | None = None) -> ReplayResult:
    """Solve saved evidence; the result has no background image and no time of first acceptance."""
    return ReplayResult(
        result=solve(evidence, options, lens=_scaled_lens(lens, evidence.image_size)),
        evidence=evidence,
        accepted_at_s=None,
        background=None,
        frames=evidence.frames,
        options=options,
    )


def _scaled_lens(lens: Camera | None, image_size: tuple[int, int]) -> Camera | None:
    return None if lens is None else lens.scaled_to(*image_size)
