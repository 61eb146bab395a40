"""The ground plane of a solution: from its roads and turning vehicles, or from one road and an assumption."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from autocalib_ros.camera import Camera
from autocalib_ros.estimation.great_circles import TrackSet, rays_of
from autocalib_ros.estimation.ground_plane import upward
from autocalib_ros.estimation.joint import JointFit
from autocalib_ros.estimation.state import ALONG_X, State

STEP_RAD = 1e-5


def above_traffic(normal: np.ndarray, camera: Camera, tracks: TrackSet) -> tuple[np.ndarray, float]:
    """Turn a plane normal (3,) away from the traffic; and the share of the tracked points below the horizon."""
    return upward(normal, rays_of(camera, tracks.pixels[tracks.weights > 0]).bearings)


@dataclass(frozen=True)
class Plane:
    """The upward ground normal as a function of a state, and how sure it is."""

    fit: JointFit
    side: float
    """1 or -1: which side of the state's plane is up."""
    roll_sigma_deg: float | None = None
    """Where the roll of the camera is assumed to be zero, its standard deviation."""

    @classmethod
    def of(cls, fit: JointFit, tracks: TrackSet, roll_sigma_deg: float | None = None) -> Plane:
        """Return the plane of a solution, the side of the traffic below."""
        plane = cls(fit, 1.0, roll_sigma_deg)
        normal = plane.normal(fit.state)
        up, _ = above_traffic(normal, fit.state.camera, tracks)
        return cls(fit, float(np.sign(normal @ up)), roll_sigma_deg)

    def normal(self, state: State, roll_rad: float = 0.0) -> np.ndarray:
        """Upward normal (3,) in the camera frame at a state; `roll_rad` counts where the roll is assumed."""
        if self.roll_sigma_deg is None:
            return self.side * state.rotation[:, 2]
        # the plane holds the road and what is level in the image
        normal = np.cross(state.directions[0], [np.cos(roll_rad), np.sin(roll_rad), 0.0])
        return self.side * normal / max(float(np.linalg.norm(normal)), 1e-9)

    @property
    def here(self) -> tuple[Camera, np.ndarray]:
        """Lens and upward normal (3,) of the solution."""
        return self.fit.state.camera, self.normal(self.fit.state)

    @property
    def told_by_roll(self) -> bool:
        """Whether the road leads across the level, so that the roll tells the plane."""
        along = self.fit.state.directions[0]
        return float(np.hypot(along[1], along[2])) > ALONG_X

    def sigma(self, function: Callable[[Camera, np.ndarray], np.ndarray]) -> np.ndarray:
        """Standard deviations of a function of lens and normal, shape of its result; with those of the assumption."""
        told = self.fit.sigma(lambda state: function(state.camera, self.normal(state)))
        if self.roll_sigma_deg is None:
            return told
        state = self.fit.state
        ends = [np.atleast_1d(function(state.camera, self.normal(state, step))) for step in (-STEP_RAD, STEP_RAD)]
        return np.hypot(told, np.radians(self.roll_sigma_deg) * (ends[1] - ends[0]) / (2 * STEP_RAD))
