"""A simulated recording: each frame depends only on the options and its index."""

from __future__ import annotations

import math

import numpy as np

from autocalib_ros.offline.simulate.cyclist_actors import spawn_cyclists
from autocalib_ros.offline.simulate.lens import CameraPose, look_rotation, rotation_from_vector
from autocalib_ros.offline.simulate.microbolometer import shutter_closed_since
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.pedestrian_actors import spawn_pedestrians
from autocalib_ros.offline.simulate.render import Renderer, SceneState
from autocalib_ros.offline.simulate.scenes import build_network
from autocalib_ros.offline.simulate.traffic_flow import simulate_traffic
from autocalib_ros.offline.simulate.vehicle_models import Vehicle, VehicleState

_START_NS = 1_700_000_000_000_000_000
_BUMP_AXIS = np.array([0.80, 0.50, 0.33])


class Simulation:
    """World, traffic and camera of one recording; frames are rendered on demand."""

    def __init__(self, options: SimulationOptions) -> None:
        self.options = options
        self.lens = options.lens
        self.network = build_network(options)
        self.traffic = simulate_traffic(self.network, options)
        self.pedestrians = spawn_pedestrians(self.network, self.traffic.green_phases, options)
        self.cyclists = spawn_cyclists(self.network, options)
        x, y = options.position_m or self.network.viewpoint_m
        yaw = self.network.view_yaw_deg if options.yaw_deg is None else options.yaw_deg
        self.pose = CameraPose(
            look_rotation(yaw, options.pitch_deg, options.roll_deg),
            np.array([x, y, options.camera_height_m]),
        )
        self.yaw_deg = float(yaw)
        self._shake_rad = _shake(options)
        self._renderer: Renderer | None = None

    def frame(self, index: int) -> np.ndarray:
        """Render a frame: BGR (h, w, 3) uint8, or (h, w) uint16 of a thermal camera."""
        return self.renderer().frame(self.scene(self._shown_index(index)))

    def renderer(self) -> Renderer:
        """Return the renderer, created on first use."""
        if self._renderer is None:
            self._renderer = Renderer(self.options, self.network, self.pose, self.bumped_pose())
        return self._renderer

    def scene(self, index: int) -> SceneState:
        """Return the state of the scene at a frame."""
        time_s = self.time_s(index)
        walking = ((pedestrian, pedestrian.state(time_s)) for pedestrian in self.pedestrians)
        return SceneState(
            index,
            time_s,
            self.is_bumped(time_s),
            self.shake(index) if self.options.shake_px else None,
            self.states(time_s),
            [(pedestrian, state) for pedestrian, state in walking if state is not None],
            [(cyclist, cyclist.state(time_s)) for cyclist in self.cyclists],
            shutter_closed_since(self.options, time_s) is not None,
        )

    def _shown_index(self, index: int) -> int:
        """Return the index of the frame that is sent: during a frozen image, the last one before the shutter closed."""
        closed_s = shutter_closed_since(self.options, self.time_s(index))
        if closed_s is None or self.options.shutter_shows == 'flat':
            return index
        return math.ceil(closed_s * self.options.rate_hz - 1e-9) - 1

    def stamp_ns(self, index: int) -> int:
        """Return the time stamp of a frame in ns."""
        return _START_NS + round(index * 1e9 / self.options.rate_hz)

    def time_s(self, index: int) -> float:
        """Return the time of a frame in seconds from the first one."""
        return index / self.options.rate_hz

    def bumped_pose(self) -> CameraPose:
        """Return the camera pose after the bump."""
        axis = _BUMP_AXIS / np.linalg.norm(_BUMP_AXIS)
        return self.pose.rotated(rotation_from_vector(axis * math.radians(self.options.bump_deg)))

    def is_bumped(self, time_s: float) -> bool:
        """Whether the camera has been bumped by this time."""
        return self.options.bump_at_s is not None and time_s >= self.options.bump_at_s

    def shake(self, index: int) -> np.ndarray:
        """Return the rotation (3, 3) of the camera shake in a frame."""
        return rotation_from_vector(self._shake_rad[index])

    def states(self, time_s: float) -> list[tuple[Vehicle, VehicleState]]:
        """Return the vehicles on the road at a time, with their states."""
        found = ((vehicle, vehicle.state(time_s)) for vehicle in self.traffic.vehicles)
        return [(vehicle, state) for vehicle, state in found if state is not None]


def _shake(options: SimulationOptions) -> np.ndarray:
    """Return rotation vectors (frames, 3): an Ornstein-Uhlenbeck process with a time constant of 0.3 s."""
    rng = np.random.default_rng([options.seed, 8])
    decay = math.exp(-1.0 / (0.3 * options.rate_hz))
    innovations = rng.standard_normal((options.frame_count, 3)) * math.sqrt(1 - decay * decay)
    process = np.zeros_like(innovations)
    for i in range(1, len(process)):
        process[i] = decay * process[i - 1] + innovations[i]
    return process * (options.shake_px / options.focal_px) * (1.0, 1.0, 0.5)
