"""Calibrate from a recording with the same `AutoCalibrator` as the live node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.gather_evidence import ReplayControl, gather_evidence, scaled
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.sources import Source
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.frame_clock import ClockSummary
from autocalib_ros.report.scene import SolutionSnapshot, append_snapshot
from autocalib_ros.results.calibration import Calibration, Refusal


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
    stopped: bool = False
    """Whether the reading was stopped before the end of the recording."""


def replay(
    recording: Source | Path | str,
    options: Options,
    on_progress: Callable[[int, str], None] | None = None,
    lens: Camera | None = None,
    detector: VehicleDetector | None = None,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    on_checkpoint: Callable[[Evidence], None] | None = None,
) -> ReplayResult:
    """Collect evidence from a recording, given as a path or an open source, and solve at its end.

    If the view changes (cuts, zooms, a camera that is turned), the longest part in which it stands still is solved.
    `on_progress` receives the number of frames and a short note, whose first word is the state: collecting, solving,
    calibrated or refused. Once `should_stop` returns true, what was seen so far is solved. `on_checkpoint` receives the
    evidence so far every two minutes of the recording, and all of it before the last solution. With a known `lens` only
    the pose is estimated; UsageError if its aspect ratio differs from that of the images. `detector` is an open
    detector; None opens the one of the options. InputError without an image.
    """
    source = open_source(recording) if isinstance(recording, (str, Path)) else recording
    control = ReplayControl(on_progress=on_progress, should_stop=should_stop, on_checkpoint=on_checkpoint)
    gathered = gather_evidence(source, options, control, lens=lens, detector=detector)
    evidence = gathered.evidence
    if on_checkpoint is not None:
        on_checkpoint(evidence)
    control.report(gathered.frames, 'solving')
    result = solve(evidence, options, lens=scaled(lens, evidence.image_size))
    control.report(gathered.frames, 'calibrated' if result else 'refused')
    accepted_at_s = gathered.accepted_at_s
    return ReplayResult(
        result=result,
        evidence=evidence,
        accepted_at_s=evidence.seconds if result and accepted_at_s is None else accepted_at_s,
        background=gathered.background,
        frames=gathered.frames,
        repeated=gathered.repeated,
        options=options,
        moments=append_snapshot(gathered.moments, result),
        clock=gathered.clock,
        stopped=gathered.stopped,
    )


def solve_evidence(evidence: Evidence, options: Options, lens: Camera | None = None) -> ReplayResult:
    """Solve saved evidence; the result has no background image and no time of first acceptance."""
    return ReplayResult(
        result=solve(evidence, options, lens=scaled(lens, evidence.image_size)),
        evidence=evidence,
        accepted_at_s=None,
        background=None,
        frames=evidence.frames,
        options=options,
    )
