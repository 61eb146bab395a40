"""State of the bundle adjustment and its local parameterisation: lens, ground plane and road directions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.motion.rigid_bodies import TrackletBundle
from autocalib_ros.estimation.observations.two_frame_windows import TwoFrameWindows, no_windows
from autocalib_ros.geometry.great_circles import Rays
from autocalib_ros.geometry.small_matrices import rotation_matrix
from autocalib_ros.lens.camera import Camera

RIGHT_ANGLE_SIGMA_RAD = np.radians(1.0)
"""Standard deviation of the angle between two roads, or two directions of lane markings, from a right angle: junctions
are built to about that."""
MIN_SINE_TO_X_AXIS = 0.2
"""Smallest sine of the angle between a road and the camera's x axis for which zero roll constrains the ground plane.
Judgement."""


@dataclass(frozen=True)
class AdjustmentState:
    """Lens and road directions: road j is `rotation` times (cos, sin, 0) of `angles_rad[j]`; the first angle is 0."""

    camera: Camera
    rotation: np.ndarray
    """camera_from_plane, shape (3, 3). The third column is the ground normal, unless one road alone is known."""
    angles_rad: np.ndarray
    """Angle of each road in the plane, shape (roads,)."""

    @property
    def in_plane(self) -> np.ndarray:
        """Unit vectors of the roads in the plane frame, shape (roads, 3)."""
        return np.column_stack([np.cos(self.angles_rad), np.sin(self.angles_rad), np.zeros(len(self.angles_rad))])

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors of the roads in the camera frame, shape (roads, 3)."""
        return self.in_plane @ self.rotation.T


@dataclass(frozen=True)
class AdjustmentConfig:
    """Configuration of an adjustment: prior, options, noise model and turning vehicles."""

    prior: LensPrior
    options: JointOptions
    height_m: float = 0.0
    """Camera height in metres, 0: unknown. It only sets the weight of near against far points."""
    crossing_rad: float | None = None
    """Angle of the second road to the first that is given or assumed, None: free."""
    crossing_sigma_rad: float = 0.0
    """Its standard deviation, 0: exact."""
    drifting: bool = False
    """Whether tracked points drift. A single track then hardly shows a slight turn, so the tracks of one body are
    weighted together."""
    vehicle_correlation: float = 0.3
    """Correlation, 0 to 1, of the errors of one vehicle's tracks: judgement, until a fit has measured it."""
    windows: TwoFrameWindows = field(default_factory=no_windows)
    """Turning vehicles, each between two instants."""
    bundle: TrackletBundle | None = None
    """Turning vehicles, each over its tracklet."""

    @property
    def turning(self) -> bool:
        """Whether turning vehicles are part of the problem."""
        return len(self.windows) > 0 or self.bundle is not None


@dataclass(frozen=True)
class Parameterisation:
    """Local parameterisation: steps from a base state.

    Order: free lens parameters in units of the prior, rotations of the plane (rad), free road angles (rad).
    """

    base: AdjustmentState
    config: AdjustmentConfig

    @property
    def lens(self) -> int:
        """Number of free lens parameters."""
        return len(self.config.prior.free)

    @cached_property
    def axes(self) -> np.ndarray:
        """Axes (rotations, 3), in the plane frame, about which a rotation of the plane is observable."""
        roads, every = len(self.base.angles_rad), np.eye(3)
        if roads == 0:
            return every[:2]  # without roads, the heading in the plane is arbitrary
        return every if roads > 1 or self.config.turning else every[1:]  # rotation about a lone road is unobservable

    @cached_property
    def tilts(self) -> np.ndarray:
        """Indices (n,) of the parameters that tilt the plane: rotations about axes in it."""
        return self.lens + np.flatnonzero(np.abs(self.axes[:, :2]).sum(axis=1) > 0.5)

    @property
    def crossing_known(self) -> bool:
        """Whether the angle of the second road to the first is given or assumed."""
        return self.config.crossing_rad is not None and len(self.base.angles_rad) > 1

    @cached_property
    def free_angles(self) -> tuple[int, ...]:
        """Indices of roads with a free angle: the first defines the frame, the second may be fixed."""
        exact = self.crossing_known and self.config.crossing_sigma_rad <= 0
        return tuple(range(2 if exact else 1, len(self.base.angles_rad)))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.lens + len(self.axes) + len(self.free_angles)

    def state(self, step: np.ndarray) -> AdjustmentState:
        """Return the state at a step (parameters,) from the base."""
        turns = self.lens + len(self.axes)
        angles = self.base.angles_rad.copy()
        angles[list(self.free_angles)] += step[turns:]
        return AdjustmentState(
            self.camera(step[: self.lens]), self.base.rotation @ self.turned(step[self.lens : turns]), angles
        )

    def probed(self, step: np.ndarray) -> AdjustmentState:
        """Return `state` of a step that is asked for again and again, as those of numerical derivatives."""
        key = step.tobytes()
        if key not in self._probes:
            self._probes[key] = self.state(step)
        return self._probes[key]

    @cached_property
    def _probes(self) -> dict[bytes, AdjustmentState]:
        """States of `probed` by the bytes of their steps."""
        return {}

    def step_to(self, state: AdjustmentState) -> np.ndarray:
        """Return the step (parameters,) from the base to a nearby state, projected on the free parameters."""
        turn = Rotation.from_matrix(self.base.rotation.T @ state.rotation).as_rotvec()
        angles = np.angle(np.exp(1j * (state.angles_rad - self.base.angles_rad)))
        return np.concatenate(
            [self.config.prior.step(self.base.camera, state.camera), self.axes @ turn, angles[list(self.free_angles)]]
        )

    def camera(self, step: np.ndarray) -> Camera:
        """Return the camera at a step (lens,) of the free lens parameters."""
        return self.config.prior.moved(self.base.camera, step)

    def turned(self, step: np.ndarray) -> np.ndarray:
        """Return the rotation matrix (3, 3) of a step (rotations,) about the axes."""
        return rotation_matrix(step @ self.axes)

    def prior_gradient(self, state: AdjustmentState) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient and diagonal information of the prior at a state, (parameters,) each."""
        gradient, information = np.zeros(self.size), np.zeros(self.size)
        gradient[: self.lens] = self.config.prior.deviations(state.camera)
        information[: self.lens] = self.config.prior.information
        if self._crossing_uncertain:
            crossing, sigma = self.lens + len(self.axes), self.config.crossing_sigma_rad
            gradient[crossing] = self._crossing_deviation_rad(state) / sigma**2
            information[crossing] = sigma**-2
        return gradient, information

    def prior_cost(self, state: AdjustmentState) -> float:
        """Return twice the negative log density of the prior at a state, up to a constant."""
        deviations = self.config.prior.deviations(state.camera)
        crossing = (
            self._crossing_deviation_rad(state) / self.config.crossing_sigma_rad if self._crossing_uncertain else 0.0
        )
        return float(deviations @ deviations) + crossing**2

    @property
    def _crossing_uncertain(self) -> bool:
        return self.crossing_known and self.config.crossing_sigma_rad > 0

    def _crossing_deviation_rad(self, state: AdjustmentState) -> float:
        """Return how far the second road is from its expected angle to the first, on the nearest side."""
        expected = with_crossing_angle(state, self.config.crossing_rad).angles_rad[1]
        return float(np.angle(np.exp(1j * (state.angles_rad[1] - expected))))


def upward_normal(state: AdjustmentState, config: AdjustmentConfig, rays: Rays) -> np.ndarray:
    """Return the ground normal (3,) away from the traffic.

    With one road and no turning vehicles the normal is that of a camera without roll.
    """
    normal = state.rotation[:, 2]
    if len(state.angles_rad) == 1 and not config.turning:
        normal = level_normal(state.directions[0])
    above = np.count_nonzero(rays.bearings @ normal > 0)
    return -normal if above > 0.5 * rays.bearings[..., 0].size else normal


def level_normal(along: np.ndarray) -> np.ndarray:
    """Return the normal (3,), of either sign, of the plane of a road (3,) under a camera without roll.

    The plane contains the camera's x axis and the road. For a road along the x axis it is perpendicular to the image's
    y axis instead.
    """
    level = np.array([0.0, along[2], -along[1]])  # cross product of the road and the x axis
    image_up = along[1] * along - [0.0, 1.0, 0.0]
    normal = level if np.linalg.norm(level) > MIN_SINE_TO_X_AXIS else image_up
    return normal / max(np.linalg.norm(normal), 1e-9)


def initial_state(camera: Camera, found: RoadDirections) -> AdjustmentState:
    """Build the state of consensus directions: the first is the x axis, the first two span the plane."""
    first = found.directions[0]
    second = found.directions[1] if len(found.directions) > 1 else np.roll(first, 1)
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    rotation = np.column_stack([first, np.cross(normal, first), normal])
    inplane = found.directions @ rotation
    return AdjustmentState(camera, rotation, np.arctan2(inplane[:, 1], inplane[:, 0]))


def with_crossing_angle(state: AdjustmentState, crossing_rad: float | None) -> AdjustmentState:
    """Return the state with the second road at a fixed angle to the first, on the side nearest to its own angle."""
    if crossing_rad is None or len(state.angles_rad) < 2:
        return state
    angles = state.angles_rad.copy()
    sides = np.array([crossing_rad, crossing_rad - np.pi, -crossing_rad, np.pi - crossing_rad])
    angles[1] = sides[np.argmin(np.abs(np.angle(np.exp(1j * (sides - angles[1])))))]
    return replace(state, angles_rad=angles)


@dataclass(frozen=True)
class RoadDirections:
    """Road directions from consensus of tracks."""

    directions: np.ndarray
    """Unit vectors in the camera frame, shape (n, 3)."""
    labels: np.ndarray
    """Direction of each track, -2 for none, shape (tracks,)."""
    score: float
    """Summed support in nats: negative log probability of the inliers under random directions."""
