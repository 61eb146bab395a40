"""What is solved for: lens, ground plane and roads; and the steps by which a solution moves."""

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
from autocalib_ros.lens.camera import Camera

MIN_SINE_TO_X_AXIS = 0.2
"""Sine of the angle to the camera's x axis below which a road does not tell the plane of a camera without roll."""


@dataclass(frozen=True)
class AdjustmentState:
    """Lens and roads: road j runs along `rotation` applied to (cos, sin, 0) of `angles_rad[j]`; the first is 0."""

    camera: Camera
    rotation: np.ndarray
    """camera_from_plane, shape (3, 3): its third column is the ground normal, unless one road alone is known."""
    angles_rad: np.ndarray
    """Shape (roads,)."""

    @property
    def in_plane(self) -> np.ndarray:
        """The roads' unit vectors in the frame of their plane, shape (roads, 3)."""
        return np.column_stack([np.cos(self.angles_rad), np.sin(self.angles_rad), np.zeros(len(self.angles_rad))])

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors in the camera frame, shape (roads, 3)."""
        return self.in_plane @ self.rotation.T


@dataclass(frozen=True)
class AdjustmentConfig:
    """What a solution is given besides tracks and a start."""

    prior: LensPrior
    options: JointOptions
    height_m: float = 0.0
    """Height of the camera, 0 unknown: it weighs near against far, no more."""
    crossing_rad: float | None = None
    """Angle of the second road to the first where that is held."""
    drifting: bool = False
    """Whether tracked points drift; then one track hardly tells a slight turn, and those of one body are judged
    together."""
    vehicle_correlation: float = 0.3
    """How much the errors of one vehicle's tracks correlate, 0 to 1: a guess until a fit has measured it."""
    windows: TwoFrameWindows = field(default_factory=no_windows)
    """Vehicles that turn, each between two instants."""
    bundle: TrackletBundle | None = None
    """The same, each over its life."""

    @property
    def turning(self) -> bool:
        """Whether vehicles that turn are part of the problem."""
        return len(self.windows) > 0 or self.bundle is not None


@dataclass(frozen=True)
class Parameterisation:
    """The parameters, as steps from a base: free ones of the lens in their units, turns of the plane, road angles."""

    base: AdjustmentState
    config: AdjustmentConfig

    @property
    def lens(self) -> int:
        """Number of free parameters of the lens; they come first."""
        return len(self.config.prior.free)

    @cached_property
    def axes(self) -> np.ndarray:
        """Axes (turns, 3), in the frame of the plane, about which the evidence can tell a turn of it."""
        roads, every = len(self.base.angles_rad), np.eye(3)
        if roads == 0:
            return every[:2]  # headings in the plane mean nothing
        return every if roads > 1 or self.config.turning else every[1:]  # one road turns freely about itself

    @cached_property
    def free_angles(self) -> tuple[int, ...]:
        """Roads whose angle is free: the first is the frame, the second may be held."""
        fixed = self.config.crossing_rad is not None and len(self.base.angles_rad) > 1
        return tuple(range(2 if fixed else 1, len(self.base.angles_rad)))

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

    def step_to(self, state: AdjustmentState) -> np.ndarray:
        """Return the step (parameters,) from the base to a state near it, as far as the parameters reach."""
        turn = Rotation.from_matrix(self.base.rotation.T @ state.rotation).as_rotvec()
        angles = np.angle(np.exp(1j * (state.angles_rad - self.base.angles_rad)))
        return np.concatenate(
            [self.config.prior.step(self.base.camera, state.camera), self.axes @ turn, angles[list(self.free_angles)]]
        )

    def camera(self, step: np.ndarray) -> Camera:
        """Return the lens at a step (lens,) of its own parameters."""
        return self.config.prior.moved(self.base.camera, step)

    def turned(self, step: np.ndarray) -> np.ndarray:
        """Return the rotation matrix of a step (turns,) about the axes."""
        return Rotation.from_rotvec(step @ self.axes).as_matrix()

    def prior_gradient(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (parameters,) and information (parameters,) of the prior at a camera."""
        gradient, information = np.zeros(self.size), np.zeros(self.size)
        gradient[: self.lens] = self.config.prior.deviations(camera)
        information[: self.lens] = self.config.prior.information
        return gradient, information


def upward_normal(state: AdjustmentState, config: AdjustmentConfig, rays: Rays) -> np.ndarray:
    """Normal (3,) of the plane away from the traffic; where one road is all that is known, of an unrolled camera."""
    normal = state.rotation[:, 2]
    if len(state.angles_rad) == 1 and not config.turning:
        normal = level_normal(state.directions[0])
    above = np.count_nonzero(rays.bearings @ normal > 0)
    return -normal if above > 0.5 * rays.bearings[..., 0].size else normal


def level_normal(along: np.ndarray) -> np.ndarray:
    """Normal (3,), up or down, of the plane of a road (3,) under a camera that is not rolled.

    Such a plane contains the camera's x axis and the road; a road along that axis leaves the one across the image.
    """
    level = np.cross(along, [1.0, 0.0, 0.0])
    image_up = along[1] * along - [0.0, 1.0, 0.0]
    normal = level if np.linalg.norm(level) > MIN_SINE_TO_X_AXIS else image_up
    return normal / max(np.linalg.norm(normal), 1e-9)


def initial_state(camera: Camera, found: RoadDirections) -> AdjustmentState:
    """Build the state of directions found by consensus: the first is x, the plane is that of the first two."""
    first = found.directions[0]
    second = found.directions[1] if len(found.directions) > 1 else np.roll(first, 1)
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    rotation = np.column_stack([first, np.cross(normal, first), normal])
    inplane = found.directions @ rotation
    return AdjustmentState(camera, rotation, np.arctan2(inplane[:, 1], inplane[:, 0]))


def with_crossing_angle(state: AdjustmentState, crossing_rad: float | None) -> AdjustmentState:
    """Return the state with its second road at an angle to the first, on the side where it is."""
    if crossing_rad is None or len(state.angles_rad) < 2:
        return state
    angles = state.angles_rad.copy()
    sides = np.array([crossing_rad, crossing_rad - np.pi, -crossing_rad, np.pi - crossing_rad])
    angles[1] = sides[np.argmin(np.abs(np.angle(np.exp(1j * (sides - angles[1])))))]
    return replace(state, angles_rad=angles)


@dataclass(frozen=True)
class RoadDirections:
    """Road directions found by consensus."""

    directions: np.ndarray
    """Unit vectors in the camera frame, shape (n, 3)."""
    labels: np.ndarray
    """Direction of each track, -2 for none, shape (tracks,)."""
    score: float
    """Summed support: how many nats of coincidence the directions explain."""
