"""Silhouettes that show a whole body, and the headings of the bodies on the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.observations.two_frame_windows import RESAMPLING_INTERVAL_S
from autocalib_ros.estimation.people.ground_positions import project_tracks
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera

MOTION_CELL = 1.0 / 320
"""Pixel size of the motion mask, as a fraction of the image width."""
MIN_CLEARANCE_CELLS = 2.0
"""Silhouettes closer to each other or to the border, in pixels of the motion mask, may be parts of one body."""
HEADING_WINDOW_S = 0.5
"""The heading of a silhouette is that of its tracked points within this time."""
MIN_HEADING_SPEED_M_S = 1.0
"""Slower objects have no reliable heading. Judgement."""


def are_whole(evidence: Evidence) -> np.ndarray:
    """Mask (outlines,) of the silhouettes that show a whole body: clear of others and of the border, in one piece."""
    cell_px = MOTION_CELL * evidence.image_size[0]
    apart = evidence.outlines_px[:, -1] >= MIN_CLEARANCE_CELLS * cell_px
    return apart & ~_are_fragmented(evidence.outline_vehicles, evidence.outline_times_s)


def _are_fragmented(vehicles: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Mask (n,) of the silhouettes whose vehicle has others at the same time: they are parts of it."""
    _, groups, counts = np.unique(np.column_stack([vehicles, times]), axis=0, return_inverse=True, return_counts=True)
    return counts[groups.ravel()] > 1


@dataclass(frozen=True)
class RoadDisplacements:
    """Displacements on the road of tracked points, each within one resampling interval."""

    displacements_m: np.ndarray
    """Shape (n, 2)."""
    times_s: np.ndarray
    """Shape (n,)."""
    vehicles: np.ndarray
    """Vehicle of each, shape (n,)."""

    @classmethod
    def of(cls, evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> RoadDisplacements:
        """Measure the displacements of all tracked points below a camera, with ground normal (3,)."""
        ground = project_tracks(evidence, camera, normal, height_m)
        tracks, near = ground.tracks, ground.near
        first = np.flatnonzero((tracks[1:] == tracks[:-1]) & near[1:] & near[:-1])
        return cls(
            ground.positions_m[first + 1] - ground.positions_m[first],
            (ground.instants[first] + 0.5) * RESAMPLING_INTERVAL_S,
            evidence.track_vehicles[tracks[first]],
        )

    def of_vehicle(self, vehicle: int) -> RoadDisplacements:
        """Return those of one vehicle."""
        own = self.vehicles == vehicle
        return RoadDisplacements(self.displacements_m[own], self.times_s[own], self.vehicles[own])

    def headings_at(self, times: np.ndarray) -> np.ndarray:
        """Return the heading (n,) of one vehicle at times (n,), in radians; nan where it hardly moves."""
        headings = np.full(len(times), np.nan)
        for row, time_s in enumerate(times):
            around = np.abs(self.times_s - time_s) < HEADING_WINDOW_S
            if around.any():
                x, y = np.median(self.displacements_m[around], axis=0)
                moves = np.hypot(x, y) > MIN_HEADING_SPEED_M_S * RESAMPLING_INTERVAL_S
                headings[row] = np.arctan2(y, x) if moves else np.nan
        return headings
