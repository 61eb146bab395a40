"""Go on from the evidence of an earlier run: what it was read from is not read again."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from pathlib import Path

from autocalib_ros.errors import UsageError
from autocalib_ros.evidence.read_recording import ReadRecording
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.recordings.sources import Source, TimeWindow

AFTER_READ_S = 1e-6
"""Seconds after the newest image that was read from which reading goes on: images have whole nanoseconds."""


def read_evidence_to_resume(path: Path) -> Evidence | None:
    """Return the evidence of an earlier run, None without one; UsageError if nothing can be added to it."""
    if not path.exists():
        return None
    evidence = Evidence.load(path)
    if not evidence.recordings or not len(evidence.landmarks):
        raise UsageError(
            f'{path} does not say what it was read from, or has no landmarks of the background (an earlier version, '
            'too few images, or too dark): run without --resume'
        )
    return evidence


def sources_to_read(sources: Sequence[Source], evidence: Evidence) -> list[Source]:
    """Return what of the sources was not read yet; one that was read in part begins where that ended."""
    read_s: dict[str, float] = {}
    for recording in evidence.recordings:
        read_s[recording.name] = max(recording.read_s, read_s.get(recording.name, 0.0))
    left: list[Source] = []
    for source in sources:
        until_s = 0.0 if source.is_live else read_s.get(ReadRecording.of(source.name, 0.0).name, 0.0)
        if 0.0 < until_s < inf:
            source.window, source.total = TimeWindow(until_s + AFTER_READ_S), None
        if until_s < inf:
            left.append(source)
    return left
