"""What a report is about, as a value: it may go to another process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.results.calibration import Calibration, Refusal

NOT_USED, REJECTED = -1, -2
MAX_SNAPSHOTS = 64


@dataclass(frozen=True)
class SolutionSnapshot:
    """What a solution said when it was tried."""

    seconds: float
    """Of recording, since its first image."""
    focal_px: float | None = None
    focal_sigma_px: float | None = None
    tilt_deg: float | None = None
    tilt_sigma_deg: float | None = None
    code: str = ''
    """Of the refusal, '' for a calibration."""

    @classmethod
    def of(cls, result: Calibration | Refusal) -> SolutionSnapshot:
        """Take down what a result says."""
        seconds = result.evidence.seconds
        if isinstance(result, Refusal):
            return cls(seconds, code=result.code)
        ground, sigma = result.ground, result.stddev
        tilt = None if ground is None else float(tilt_and_roll_deg(ground.normal_in_camera)[0])
        return cls(seconds, result.camera.focal_px, sigma.focal_px, tilt, sigma.tilt_deg)


def append_snapshot(
    moments: tuple[SolutionSnapshot, ...], result: Calibration | Refusal
) -> tuple[SolutionSnapshot, ...]:
    """Add a result to those before; of many every second one goes, and of two at one time the older."""
    latest = SolutionSnapshot.of(result)
    kept = tuple(moment for moment in moments if moment.seconds < latest.seconds)
    return (*(kept if len(kept) < MAX_SNAPSHOTS else kept[::2]), latest)


@dataclass(frozen=True, kw_only=True)
class ReportScene:
    """What a report is about."""

    result: Calibration | Refusal
    evidence: Evidence
    """That the result rests on; any other shows where traffic was seen."""
    background: np.ndarray | None
    """BGR or grey uint8 of the full size."""
    options: Options
    source: str
    """Name of the recording or of the camera."""
    accepted_at_s: float | None = None
    moments: tuple[SolutionSnapshot, ...] = ()

    @property
    def calibration(self) -> Calibration | None:
        """The result where it is a calibration."""
        return self.result if isinstance(self.result, Calibration) else None

    @cached_property
    def labels(self) -> np.ndarray:
        """For each track -1 not used, -2 rejected, else its road direction; 0 of what the published method keeps."""
        count, labels = self.evidence.track_count, np.asarray(self.result.figures.track_labels)
        if len(labels) != count:
            return np.full(count, NOT_USED)
        if self.result.method == 'paper' and isinstance(self.result, Calibration):
            labels = np.full(count, NOT_USED)
            labels[self.result.figures.paper_tracks] = 0
        return labels

    @property
    def roads(self) -> range:
        """Labels of the roads that tracks follow."""
        return range(int(self.labels.max(initial=NOT_USED)) + 1)

    def road_name(self, label: int) -> str:
        """Name what tracks of a label are for a person."""
        if label in (NOT_USED, REJECTED):
            return 'not used' if label == NOT_USED else 'rejected'
        return 'kept by the published method' if self.result.method == 'paper' else f'road {label + 1}'

    @property
    def turning_px(self) -> np.ndarray:
        """Points of vehicles that turn which the solution rests on, pixels (n, 2)."""
        found = self.result.figures.residuals
        return found.points_px[found.roads < 0]

    def groups(self) -> list[tuple[str, int, list[np.ndarray]]]:
        """Name, label and tracks of what follows each road; all as not used where none is known to follow any."""
        if not self.roads:
            every = [track.points_px for track in self.evidence.tracks()]
            return [('all trajectories', NOT_USED, every)] if every else []
        return [(self.road_name(label), label, self.paths(label)) for label in self.roads]

    def paths(self, label: int) -> list[np.ndarray]:
        """Return the tracks of a label, pixels (n, 2) each."""
        return [self.evidence.track(index).points_px for index in np.flatnonzero(self.labels == label)]
