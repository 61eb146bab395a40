"""The ground normal of a solution: from its roads and turning vehicles, or from one road and an assumption."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.parameters import MIN_SINE_TO_X_AXIS, AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.vehicle_edges.transverse_edges import TransverseDirection
from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.geometry.ground_plane import orient_upward, tilt_and_roll_deg
from autocalib_ros.geometry.robust_kernels import wrap_undirected
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.statements import Statement, assumption

STEP_RAD = 1e-5
"""Step of the numerical derivative by the assumption, radians."""
AGREEMENT_SIGMAS = 3.0
"""Two estimates that differ by more combined standard deviations contradict each other (0.3 % of consistent pairs)."""


def orient_above_traffic(normal: np.ndarray, camera: Camera, tracks: TrackSet) -> tuple[np.ndarray, float]:
    """Orient a plane normal (3,) away from the traffic; and the fraction of tracked points below the horizon."""
    return orient_upward(normal, unproject_rays(camera, tracks.pixels[tracks.weights > 0]).bearings)


@dataclass(frozen=True)
class LevelCamera:
    """Direction across the road for a camera without roll."""

    sigma_deg: float

    @property
    def step_sigma_rad(self) -> float:
        """Standard deviation of the roll."""
        return float(np.radians(self.sigma_deg))

    def across(self, _: AdjustmentState, step_rad: float = 0.0) -> np.ndarray:
        """Direction (3,) in the plane: the horizontal of the image, rolled by a step."""
        return np.array([np.cos(step_rad), np.sin(step_rad), 0.0])

    def constrains_plane(self, state: AdjustmentState) -> bool:
        """Whether the road is far enough from the horizontal of the image for the roll to determine the plane."""
        along = state.directions[0]
        return float(np.hypot(along[1], along[2])) > MIN_SINE_TO_X_AXIS

    @property
    def assumption(self) -> Statement:
        """The assumption as a statement."""
        return assumption('level_camera', sigma_deg=self.sigma_deg)


def combine_assumptions(
    level: LevelCamera, square: TransverseDirection, state: AdjustmentState
) -> tuple[TransverseDirection | None, float, float]:
    """Combine two assumptions weighted by inverse variance; their difference, and its limit, in degrees.

    None instead of the combination if they contradict each other. The difference is a rotation about the road, nan if
    the roll does not determine the plane.
    """
    if not level.constrains_plane(state):
        return square, np.nan, np.nan
    along = state.directions[0]
    across = square.across(state)
    up = np.cross(along, across)

    def turn(roll_rad: float) -> float:
        in_plane = level.across(state, roll_rad)
        return float(wrap_undirected(np.arctan2(in_plane @ up, in_plane @ across)))

    sigma = level.step_sigma_rad * abs(turn(STEP_RAD) - turn(-STEP_RAD)) / (2 * STEP_RAD)
    both = float(np.hypot(sigma, square.step_sigma_rad))
    joined = replace(
        square,
        turn_rad=turn(0.0) * (square.step_sigma_rad / both) ** 2,
        step_sigma_rad=square.step_sigma_rad * sigma / both,
        level_sigma_deg=level.sigma_deg,
    )
    difference, limit = abs(turn(0.0)), AGREEMENT_SIGMAS * both
    return joined if difference <= limit else None, float(np.degrees(difference)), float(np.degrees(limit))


@dataclass(frozen=True)
class PlaneEstimate:
    """The upward ground normal as a function of a state, with its uncertainty."""

    fit: Adjustment
    side: float
    """1 or -1: the side of the state's plane that is up."""
    assumed: LevelCamera | TransverseDirection | None = None
    """Assumption on the direction across the road, if the traffic does not determine it."""
    fraction_below_horizon: float = 1.0
    """Fraction of the tracked points below the horizon."""

    @classmethod
    def of(
        cls, fit: Adjustment, tracks: TrackSet, assumed: LevelCamera | TransverseDirection | None = None
    ) -> PlaneEstimate:
        """Return the plane of a solution, oriented so that the traffic is below the horizon."""
        plane = cls(fit, 1.0, assumed)
        normal = plane.normal(fit.state)
        up, fraction_below_horizon = orient_above_traffic(normal, fit.state.camera, tracks)
        return replace(plane, side=float(np.sign(normal @ up)), fraction_below_horizon=fraction_below_horizon)

    def normal(self, state: AdjustmentState, step_rad: float = 0.0) -> np.ndarray:
        """Return the upward normal (3,) in the camera frame at a state, with the assumption changed by a step."""
        if self.assumed is None:
            return self.side * state.rotation[:, 2]
        normal = np.cross(state.directions[0], self.assumed.across(state, step_rad))
        return self.side * normal / max(float(np.linalg.norm(normal)), 1e-9)

    @property
    def lens_and_normal(self) -> tuple[Camera, np.ndarray]:
        """Lens, and upward normal (3,), of the solution."""
        return self.fit.state.camera, self.normal(self.fit.state)

    def sigma(self, function: Callable[[Camera, np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the standard deviations of a function of lens and normal, in the shape of its result."""
        of_fit = self.fit.sigma(lambda state: function(state.camera, self.normal(state)))
        return of_fit if self.assumed is None else np.hypot(of_fit, self._change_by_assumption(function, self.assumed))

    def covariance(self, function: Callable[[Camera, np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the covariance (n, n) of a function of lens and normal with n results."""
        of_fit = self.fit.covariance_of(lambda state: function(state.camera, self.normal(state)))
        if self.assumed is None:
            return of_fit
        change = self._change_by_assumption(function, self.assumed)
        return of_fit + np.outer(change, change)

    def _change_by_assumption(
        self, function: Callable[[Camera, np.ndarray], np.ndarray], assumed: LevelCamera | TransverseDirection
    ) -> np.ndarray:
        """Change (n,) of the results of a function by one standard deviation of the assumption."""
        state, sigma_rad = self.fit.state, assumed.step_sigma_rad
        ends = [np.atleast_1d(function(state.camera, self.normal(state, step))) for step in (-STEP_RAD, STEP_RAD)]
        return sigma_rad * (ends[1] - ends[0]) / (2 * STEP_RAD)

    @property
    def worst_sigma_deg(self) -> float:
        """The larger of the standard deviations of tilt and roll, degrees."""
        return float(self.sigma(lambda _, normal: tilt_and_roll_deg(normal)).max())
