"""Data of a report as a picklable value."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import GroundPlane, tilt_and_roll_deg
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.camera_move import CameraMove

if TYPE_CHECKING:
    from autocalib_ros.estimation.road_sketch import RoadSketch

NOT_USED, REJECTED = -1, -2
MAX_SNAPSHOTS = 64
"""Most intermediate solutions in memory."""


@dataclass(frozen=True)
class SolutionSnapshot:
    """Result of one intermediate solution."""

    seconds: float
    """Recording time since the first image."""
    focal_px: float | None = None
    focal_sigma_px: float | None = None
    tilt_deg: float | None = None
    tilt_sigma_deg: float | None = None
    code: str = ''
    """Code of the refusal; '' for a calibration."""

    @classmethod
    def of(cls, result: Calibration | Refusal) -> SolutionSnapshot:
        """Summarise a result."""
        seconds = result.evidence.seconds
        if isinstance(result, Refusal):
            return cls(seconds, code=result.code)
        ground, sigma = result.ground, result.stddev
        tilt = None if ground is None else float(tilt_and_roll_deg(ground.normal_in_camera)[0])
        return cls(seconds, result.camera.focal_px, sigma.focal_px, tilt, sigma.tilt_deg)


def append_snapshot(
    moments: tuple[SolutionSnapshot, ...], result: Calibration | Refusal
) -> tuple[SolutionSnapshot, ...]:
    """Append a result; replace snapshots of the same or a later time, and drop every second one of `MAX_SNAPSHOTS`."""
    latest = SolutionSnapshot.of(result)
    kept = tuple(moment for moment in moments if moment.seconds < latest.seconds)
    return (*(kept if len(kept) < MAX_SNAPSHOTS else kept[::2]), latest)


@dataclass(frozen=True, kw_only=True)
class KnownTruth:
    """A number of the result beside its true value, as text."""

    name: str
    found: str
    true: str
    error: str
    sigmas: float | None
    """Error in standard deviations; None for a number that has none."""


@dataclass(frozen=True, kw_only=True)
class ReportScene:
    """Result with the data that its figures need."""

    result: Calibration | Refusal
    evidence: Evidence
    """Evidence of the result; any other evidence only shows where there was traffic."""
    background: np.ndarray | None
    """BGR or grey uint8 of the full size."""
    options: Options
    source: str
    """Name of the recording or the camera."""
    accepted_at_s: float | None = None
    moves: tuple[CameraMove, ...] = ()
    """Moves of the camera in the recording."""
    history: tuple[dict[str, Any], ...] = ()
    """Versions that a live node accepted, `history.version_entry`, oldest first."""
    moments: tuple[SolutionSnapshot, ...] = ()
    truth: tuple[KnownTruth, ...] = ()
    """The result beside the truth, where a simulation knows it."""
    folder: Path | None = None
    """Folder with `evidence.npz` of the result; None if it is not saved."""

    @cached_property
    def sketch(self) -> RoadSketch | None:
        """Roads through an assumed lens, where nothing was found; None with a calibration or without roads."""
        if self.calibration is not None:
            return None
        from autocalib_ros.estimation.road_sketch import sketch_roads  # lazy import: a live node draws elsewhere

        return sketch_roads(self.evidence, self.options)

    @property
    def calibration(self) -> Calibration | None:
        """The result if it is a calibration, else its candidate."""
        return self.result.candidate

    @property
    def calibrated(self) -> Calibration:
        """The calibration or candidate, for figures that are drawn only if there is one; ValueError otherwise."""
        if self.calibration is None:
            raise ValueError('the result is a refusal')
        return self.calibration

    @property
    def ground(self) -> GroundPlane:
        """The ground plane, for figures that are drawn only if there is one; ValueError otherwise."""
        if self.calibrated.ground is None:
            raise ValueError('the result has no ground plane')
        return self.calibrated.ground

    @property
    def has_ground(self) -> bool:
        """Whether there is a calibration, or a candidate, with a ground plane."""
        return self.calibration is not None and self.calibration.ground is not None

    @cached_property
    def labels(self) -> np.ndarray:
        """Road index of each track; -1 not used, -2 rejected; 0 for tracks kept by the published method."""
        count, labels = self.evidence.track_count, np.asarray(self.result.figures.track_labels)
        if len(labels) != count:
            return np.full(count, NOT_USED)
        if self.result.method == 'paper' and isinstance(self.result, Calibration):
            labels = np.full(count, NOT_USED)
            labels[self.result.figures.paper_tracks] = 0
        return labels

    @property
    def roads(self) -> range:
        """Road indices that occur in the labels."""
        return range(int(self.labels.max(initial=NOT_USED)) + 1)

    def road_name(self, label: int) -> str:
        """Return a legend text for a label."""
        if label in (NOT_USED, REJECTED):
            return 'not used' if label == NOT_USED else 'rejected'
        return 'kept by the published method' if self.result.method == 'paper' else f'road {label + 1}'

    @property
    def turning_px(self) -> np.ndarray:
        """Points of turning vehicles used in the solution, pixels (n, 2)."""
        found = self.result.figures.residuals
        return found.points_px[found.roads < 0]

    def groups(self) -> list[tuple[str, int, list[np.ndarray]]]:
        """Return name, label and tracks of each road; all tracks as not used if no track has a road."""
        if not self.roads:
            every = [track.points_px for track in self.evidence.tracks()]
            return [('all trajectories', NOT_USED, every)] if every else []
        return [(self.road_name(label), label, self.paths(label)) for label in self.roads]

    def paths(self, label: int) -> list[np.ndarray]:
        """Return the tracks with a label, pixels (n, 2) each."""
        return [self.evidence.track(int(index)).points_px for index in np.flatnonzero(self.labels == label)]
