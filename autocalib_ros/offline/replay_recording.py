"""A recording through the same AutoCalibrator that the live node holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
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
from autocalib_ros.report.scene import SolutionSnapshot, append_snapshot
from autocalib_ros.results.calibration import Calibration, Refusal

SOLVE_AGAIN_GROWTH = 2.0
"""Once accepted, a solution on the way is tried again when the recording has grown by this factor: by then a standard
deviation has fallen by a third. Only the report has use for it."""
PROGRESS_EVERY_FRAMES = 15
"""Frames between two questions for the progress: it is for people, who read slowly."""


@dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """What a recording gave."""

    result: Calibration | Refusal
    evidence: Evidence
    accepted_at_s: float | None
    """Seconds of recording until the first accepted calibration."""
    background: np.ndarray | None
    """The road without its traffic, BGR uint8."""
    frames: int
    options: Options = field(default_factory=Options)
    moments: tuple[SolutionSnapshot, ...] = ()
    """What the solutions on the way said, and the last."""


def replay(
    recording: Source | Path | str,
    options: Options,
    on_progress: Callable[[int, str], None] | None = None,
    lens: Camera | None = None,
    detector: VehicleDetector | None = None,
) -> ReplayResult:
    """Go through a recording, a path or an open one, and solve at its end.

    `on_progress` gets the number of frames done and a short note.

    The first word of the note is the state: collecting, solving, calibrated or refused. With a known `lens` only the
    pose is solved; UsageError at the first image that is not of its shape. A `detector` that is open already is used,
    else that of the options is opened.
    """
    source = open_source(recording) if isinstance(recording, (str, Path)) else recording
    report_progress = on_progress or (lambda done, note: None)
    calibrator, accepted_at_s, count, note, scaled_lens = AutoCalibrator(options, detector), None, 0, '', None
    latest: Calibration | Refusal | None = None
    moments: tuple[SolutionSnapshot, ...] = ()
    next_solve_s = 0.0
    for count, frame in enumerate(source.frames(), start=1):
        scaled_lens = _scaled_lens(lens, (frame.image.shape[1], frame.image.shape[0]))
        calibrator.add_image(frame.stamp_ns, frame.image)
        due = calibrator.snapshot_if_due()
        if due is not None and due.seconds >= next_solve_s:
            report_progress(count, 'solving')
            tried = solve(due, options, lens=scaled_lens)
            moments = append_snapshot(moments, tried)
            if tried and accepted_at_s is None:  # a live run would have been accepted then
                accepted_at_s = due.seconds
            latest = tried if tried or accepted_at_s is None else latest
            next_solve_s = 0.0 if accepted_at_s is None else SOLVE_AGAIN_GROWTH * due.seconds
        if on_progress is not None and count % PROGRESS_EVERY_FRAMES == 1:
            note = _progress_note(calibrator, latest, accepted_at_s)
        report_progress(count, note)
    evidence = calibrator.snapshot()
    if evidence is None:
        raise InputError(f'{source.name} gives no image')
    report_progress(count, 'solving')
    result = solve(evidence, options, lens=scaled_lens)
    report_progress(count, 'calibrated' if result else 'refused')
    if result and accepted_at_s is None:
        accepted_at_s = evidence.seconds
    return ReplayResult(
        result=result,
        evidence=evidence,
        accepted_at_s=accepted_at_s,
        background=calibrator.background(),
        frames=count,
        options=options,
        moments=append_snapshot(moments, result),
    )


def _progress_note(
    calibrator: AutoCalibrator, latest: Calibration | Refusal | None, accepted_at_s: float | None
) -> str:
    """Say the state, how far the evidence has come, and what is missing."""
    if isinstance(latest, Calibration):
        return f'calibrated since {accepted_at_s:.0f} s: focal length {latest.camera.focal_px:.0f} px'
    progress = calibrator.progress()
    # all that a first solution needs is there, and yet it was refused: then that is what is missing
    refused = latest is not None and not progress.missing
    return f'collecting {progress}' + (f': {latest.message}' if refused else '')


def solve_evidence(evidence: Evidence, options: Options, lens: Camera | None = None) -> ReplayResult:
    """Solve saved evidence; it does not tell when it would first have been accepted, and has no picture."""
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
