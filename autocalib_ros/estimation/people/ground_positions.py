"""Positions of all tracked points on the road at multiples of the resampling interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import ground_points
from autocalib_ros.lens.camera import Camera

MAX_PERSON_DISTANCE_HEIGHTS = 8.0
"""Largest distance from the camera's foot, in camera heights, at which positions are accurate enough."""


@dataclass(frozen=True)
class GroundPositions:
    """Resampled tracks on the road, track after track."""

    positions_m: np.ndarray
    """Shape (n, 2)."""
    instants: np.ndarray
    """Time of each position in intervals, shape (n,)."""
    near: np.ndarray
    """Mask (n,) of the positions within `MAX_PERSON_DISTANCE_HEIGHTS`."""
    offsets: np.ndarray
    """First position of each track, with the end, shape (tracks + 1,)."""

    @property
    def tracks(self) -> np.ndarray:
        """Index of the track of each position, shape (n,)."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


def project_tracks(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> GroundPositions:
    """Project resampled tracks to the road below a camera, with ground normal (3,) and camera height in metres."""
    resampled = ResampledTracks(evidence)
    pixels, offsets = resampled.all_positions()
    positions_m = ground_points(camera, normal, height_m, pixels)
    instants = np.arange(len(positions_m)) + np.repeat(resampled.begin - offsets[:-1], np.diff(offsets))
    near = np.hypot(*positions_m.T) < MAX_PERSON_DISTANCE_HEIGHTS * height_m
    return GroundPositions(positions_m, instants, near, offsets)
