"""Calibrate from a recording with the same `AutoCalibrator` as the live node."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.gather_evidence import (
    GatheredEvidence,
    ReplayControl,
    gather_evidence,
    scaled,
)
from autocalib_ros.offline.join_recordings import JoinedEvidence
from autocalib_ros.offline.recordings.listing import recordings_of
from autocalib_ros.offline.recordings.open import open_source, open_sources
from autocalib_ros.offline.recordings.sources import Source
from autocalib_ros.offline.solution_trials import StartSolving
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.frame_clock import ClockSummary
from autocalib_ros.report.scene import SolutionSnapshot, append_snapshot
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.camera_move import CameraMove

LOG = logging.getLogger(__name__)

Recording: TypeAlias = Source | Path | str


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
    left_out: tuple[str, ...] = ()
    """Recordings that were not joined with the first one, and why."""
    moves: tuple[CameraMove, ...] = ()
    """Moves of the camera, in degrees through the lens of the result; not measured without one. The times are those
    of the recording in which each was."""
    displacements_px: tuple[float, ...] = ()
    """Root mean square displacement of the view of each further recording, which is undone."""


def replay(
    recording: Recording | Sequence[Recording],
    options: Options,
    on_progress: Callable[[int, str], None] | None = None,
    lens: Camera | None = None,
    detector: VehicleDetector | None = None,
    *,
    should_stop: Callable[[], bool] = lambda: False,
    on_checkpoint: Callable[[Evidence], None] | None = None,
    before: Evidence | None = None,
    start_solving: StartSolving | None = None,
    on_accepted: Callable[[Calibration, np.ndarray], None] | None = None,
    on_last_solution: Callable[[], None] = lambda: None,
) -> ReplayResult:
    """Collect evidence from a recording, given as a path or an open source, and solve at its end.

    If the view changes (cuts, zooms, a camera that is turned), the longest part in which it stands still is solved.
    Several recordings of one view are joined: each is registered to the first by its background, one of another view is
    left out and named. `before` is the evidence of an earlier run that they are added to.

    `on_progress` receives the number of frames and a short note, whose first word is the state: collecting, solving,
    calibrated or refused. Once `should_stop` returns true, what was seen so far is solved. `on_checkpoint` receives the
    evidence so far every two minutes of the recording, and all of it before the last solution. `on_accepted` receives
    the first calibration on the way, with the newest image. With a known `lens` only the pose is estimated; UsageError
    if its aspect ratio differs from that of the images. `detector` is an open detector; None opens the one of the
    options. `start_solving` solves the evidence on the way in the background, with the same result (see
    `solver_process.BackgroundSolver`). `on_last_solution` is called before the last solution, which takes seconds.
    InputError without an image.
    """
    sources = _opened(recording)
    control = ReplayControl(
        on_progress=on_progress,
        should_stop=should_stop,
        on_checkpoint=on_checkpoint,
        on_accepted=on_accepted,
        start_solving=start_solving,
    )
    joint = JoinedEvidence(options.gate, before)
    gathered, read = _gather_all(sources, options, control, joint, lens, detector)
    if not joint:
        raise InputError('no evidence: there is no recording to read')
    evidence, frames = joint.all(), sum(one.frames for one in gathered)
    if on_checkpoint is not None:
        on_checkpoint(evidence)
    control.report(read, 'solving')
    on_last_solution()
    result = solve(evidence, options, lens=scaled(lens, evidence.image_size))
    control.report(read, 'calibrated' if result else 'refused')
    trials = gathered[0].trials if len(gathered) == 1 and before is None else None
    if trials is not None:
        trials.finish()
    accepted_at_s = None if trials is None else trials.accepted_at_s
    if result and trials is not None and accepted_at_s is None:
        accepted_at_s = evidence.seconds
    camera = None if result.candidate is None else result.candidate.camera
    return ReplayResult(
        result=result,
        evidence=evidence,
        accepted_at_s=accepted_at_s,
        background=next((one.background for one in gathered if one.background is not None), None),
        frames=frames,
        repeated=sum(one.repeated for one in gathered),
        options=options,
        moments=append_snapshot(() if trials is None else trials.moments, result),
        clock=gathered[-1].clock if gathered else ClockSummary(),
        stopped=any(one.stopped for one in gathered),
        left_out=tuple(joint.left_out),
        moves=tuple(move for one in gathered for move in one.moves.moves(camera)),
        displacements_px=tuple(joint.displacements_px),
    )


def _opened(recording: Recording | Sequence[Recording]) -> list[Source]:
    """Return open sources for paths, patterns and sources."""
    if isinstance(recording, (str, Path)):
        return open_sources(recordings_of([recording]))
    listed: list[Recording] = list(recording) if isinstance(recording, (list, tuple)) else [recording]  # type: ignore[list-item]
    return [open_source(one) if isinstance(one, (str, Path)) else one for one in listed]


def _gather_all(
    sources: Sequence[Source],
    options: Options,
    control: ReplayControl,
    joint: JoinedEvidence,
    lens: Camera | None,
    detector: VehicleDetector | None,
) -> tuple[list[GatheredEvidence], int]:
    """Read the recordings one after the other and join their evidence.

    Return what those that fit gave, and how many images are done, those of recordings that are left out among them.
    """
    gathered: list[GatheredEvidence] = []
    # a live stream goes on while a solution takes its time
    alone = len(sources) == 1 and not joint and not sources[0].is_live
    store = control.on_checkpoint
    within = replace(control, on_checkpoint=None if store is None else lambda part: store(joint.with_part(part)))
    frames = 0
    for source in sources:
        try:
            found = gather_evidence(
                source, options, within, lens=lens, detector=detector, frames_before=frames, tries_solutions=alone
            )
        except InputError as error:
            if len(sources) == 1 and not joint:
                raise
            LOG.warning('left out: %s', error)
            frames += source.total or 0
            continue
        frames += found.frames
        if joint.add(found.evidence, source.name):
            gathered.append(found)
        if found.stopped:
            break
    return gathered, frames


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
