"""A simulated recording: every frame is a function of the options and its index alone."""

from __future__ import annotations

import math

import numpy as np

from autocalib_ros.offline.simulate import cyclist_actors as cyclists
from autocalib_ros.offline.simulate import pedestrian_actors as people
from autocalib_ros.offline.simulate.lens import CameraPose, look_rotation, rotation_from_vector
from autocalib_ros.offline.simulate.microbolometer import shutter_closed_since
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.render import Renderer, SceneState
from autocalib_ros.offline.simulate.scenes import build_network
from autocalib_ros.offline.simulate.traffic_flow import simulate_traffic
from autocalib_ros.offline.simulate.vehicle_models import Vehicle, VehicleState

_START_NS = 1_700_000_000_000_000_000
_BUMP_AXIS = np.array([0.80, 0.50, 0.33])


class Simulation:
    """The world, its traffic and the camera; pictures are drawn on demand."""

    def __init__(self, options: SimulationOptions) -> None:
        self.options = options
        self.lens = options.lens
        self.network = build_network(options)
        self.traffic = simulate_traffic(self.network, options)
        self.people = people.spawn_pedestrians(self.network, self.traffic.green_phases, options)
        self.cyclists = cyclists.spawn_cyclists(self.network, options)
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
        """Return a frame: BGR (h, w, 3) uint8, or for a thermal camera (h, w) uint16."""
        return self.renderer().frame(self.scene(self._shown_index(index)))

    def renderer(self) -> Renderer:
        """Return what draws the pictures; made when first needed."""
        if self._renderer is None:
            self._renderer = Renderer(self.options, self.network, self.pose, self.bumped_pose())
        return self._renderer

    def scene(self, index: int) -> SceneState:
        """Return everything that a frame shows."""
        time_s = self.time_s(index)
        walking = ((person, person.place(time_s)) for person in self.people)
        return SceneState(
            index,
            time_s,
            self.is_bumped(time_s),
            self.shake(index) if self.options.shake_px else None,
            self.states(time_s),
            [(person, place) for person, place in walking if place is not None],
            [(cyclist, cyclist.place(time_s)) for cyclist in self.cyclists],
            shutter_closed_since(self.options, time_s) is not None,
        )

    def _shown_index(self, index: int) -> int:
        """Return the frame whose picture is sent: while a shutter freezes the picture, the last before it closed."""
        closed_s = shutter_closed_since(self.options, self.time_s(index))
        if closed_s is None or self.options.shutter_shows == 'flat':
            return index
        return math.ceil(closed_s * self.options.rate_hz - 1e-9) - 1

    def stamp_ns(self, index: int) -> int:
        """Return the time stamp of a frame in nanoseconds."""
        return _START_NS + round(index * 1e9 / self.options.rate_hz)

    def time_s(self, index: int) -> float:
        """Return the time of a frame since the first one."""
        return index / self.options.rate_hz

    def bumped_pose(self) -> CameraPose:
        """Return the pose of the camera after it was knocked askew."""
        axis = _BUMP_AXIS / np.linalg.norm(_BUMP_AXIS)
        return self.pose.rotated(rotation_from_vector(axis * math.radians(self.options.bump_deg)))

    def resting_pose(self, time_s: float) -> CameraPose:
        """Return the pose at a time without the shake."""
        return self.bumped_pose() if self.is_bumped(time_s) else self.pose

    def is_bumped(self, time_s: float) -> bool:
        """Tell whether the camera has been knocked askew by then."""
        return self.options.bump_at_s is not None and time_s >= self.options.bump_at_s

    def shake(self, index: int) -> np.ndarray:
        """Return the rotation (3, 3) that shakes the camera in a frame."""
        return rotation_from_vector(self._shake_rad[index])

    def states(self, time_s: float) -> list[tuple[Vehicle, VehicleState]]:
        """Return all vehicles under way at a time."""
        found = ((vehicle, vehicle.state(time_s)) for vehicle in self.traffic.vehicles)
        return [(vehicle, state) for vehicle, state in found if state is not None]


def _shake(options: SimulationOptions) -> np.ndarray:
    """Return rotation vectors (frames, 3): a random walk that is drawn back to rest."""
    rng = np.random.default_rng([options.seed, 8])
    kept = math.exp(-1.0 / (0.3 * options.rate_hz))
    fresh = math.sqrt(1 - kept * kept)
    steps = rng.standard_normal((options.frame_count, 3)) * fresh
    walk = np.zeros_like(steps)
    for i in range(1, len(walk)):
        walk[i] = kept * walk[i - 1] + steps[i]
    return walk * (options.shake_px / options.focal_px) * (1.0, 1.0, 0.5)
