"""Ground truth of a simulated recording, in the format of truth.json."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from autocalib_ros.offline.simulate.cyclist_actors import Cyclist
from autocalib_ros.offline.simulate.ground_surface import PAVEMENT_WIDTH_M, edge_distance
from autocalib_ros.offline.simulate.lens import CameraPose
from autocalib_ros.offline.simulate.pedestrian_actors import Pedestrian
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.offline.simulate.vehicle_models import Vehicle

_StateAt = Callable[[float], tuple[float, float, float, float] | None]
"""The state (x, y, heading, speed) of a road user at a time in seconds; None while absent."""

TRACK_RATE_HZ = 5
_TRACK_RANGE_M = 60.0
_GROUND_POINTS = 48
_GROUND_RANGE_M = 45.0
_OCCLUSION_MARGIN_M = 0.5  # a point is occluded by static geometry nearer to the camera by more than this


def truth_of(simulation: Simulation) -> dict[str, Any]:
    """Return lens, camera, road directions, ground points and tracks of all road users."""
    options = simulation.options
    truth = {
        'case': 'simulated',
        'scene': _scene(simulation),
        'width': options.width_px,
        'height': options.height_px,
        'fps': options.rate_hz,
        'duration_s': options.frame_count / options.rate_hz,
        'mode': 'night' if options.night else 'thermal' if options.thermal else 'day',
        'pixel_convention': 'OpenCV: centre of the top-left pixel is (0,0)',
        'lens': _lens(simulation),
        'camera': _camera(simulation.pose),
        'world': 'X,Y on the ground (z=0), Z up, metres; camera optical frame x right, y down, z forward',
        'road_directions': [[*direction, 0.0] for direction in simulation.network.directions().round(9).tolist()],
        'ground_points': _ground_points(simulation, bumped=False),
        'vehicles': _vehicles(simulation),
        'people': _pedestrians_and_cyclists(simulation),
        'options': asdict(options),
    }
    if options.bump_at_s is not None:
        truth['bump'] = {
            't': options.bump_at_s,
            'camera': _camera(simulation.bumped_pose()),
            'ground_points': _ground_points(simulation, bumped=True),
        }
    if options.zoom_at_s is not None:
        truth['zoom'] = {'t': options.zoom_at_s, 'factor': options.zoom}
    return truth


def _scene(simulation: Simulation) -> str:
    options = simulation.options
    return 'one_way' if options.one_way and options.scene in ('junction', 'road') else options.scene


def _lens(simulation: Simulation) -> dict[str, Any]:
    cx, cy = simulation.lens.centre_px
    return {
        'model': 'kannala_brandt',
        'f': simulation.lens.focal_px,
        'k': list(simulation.lens.k),
        'cx': cx,
        'cy': cy,
        'note': 'r=f*(theta+k1 theta^3+k2 theta^5+k3 theta^7+k4 theta^9)',
    }


def _camera(pose: CameraPose) -> dict[str, Any]:
    """Return a pose as JSON; angles as in the options."""
    rotation = pose.world_from_camera
    return {
        'R_world_from_camera': rotation.round(9).tolist(),
        'position': pose.position_m.round(6).tolist(),
        'height': float(pose.position_m[2]),
        'yaw_deg': _rounded_degrees(np.arctan2(rotation[1, 2], rotation[0, 2])),
        'pitch_down_deg': _rounded_degrees(np.arcsin(-rotation[2, 2])),
        'roll_deg': _rounded_degrees(np.arctan2(-rotation[2, 0], -rotation[2, 1])),
    }


def _rounded_degrees(angle: float) -> float:
    return round(float(np.degrees(angle)), 6)


def _project_visible(
    simulation: Simulation, pose: CameraPose, bumped: bool, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project world points (n, 3): return pixels (n, 2) and a visibility mask (n,)."""
    camera = pose.to_camera(points)
    pixels, visible = simulation.lens.project(camera)
    limit = np.array([simulation.options.width_px - 1, simulation.options.height_px - 1])
    visible &= ((pixels >= 0) & (pixels <= limit)).all(1)
    index = np.flatnonzero(visible)
    behind = simulation.renderer().background_distance_m(bumped, pixels[index])
    visible[index] = behind > np.linalg.norm(camera[index], axis=1) - _OCCLUSION_MARGIN_M
    return pixels, visible


def _ground_points(simulation: Simulation, bumped: bool) -> dict[str, Any]:
    """Return visible ground points on the road and the pavements around the camera."""
    pose = simulation.bumped_pose() if bumped else simulation.pose
    rng = np.random.default_rng([simulation.options.seed, 9])
    radius = _GROUND_RANGE_M * np.sqrt(rng.uniform(0.01, 1.0, 4000))
    angle = rng.uniform(0, 2 * np.pi, 4000)
    xy = pose.position_m[:2] + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    xy = xy[edge_distance(simulation.network, xy) < PAVEMENT_WIDTH_M].round(2)
    pixels, visible = _project_visible(simulation, pose, bumped, np.pad(xy, ((0, 0), (0, 1))))
    rows = np.concatenate([xy, pixels.round(4)], 1)[visible][:_GROUND_POINTS]
    return {'columns': ['X', 'Y', 'u', 'v'], 'rows': rows.tolist()}


_TRACK_COLUMNS = ['t', 'X', 'Y', 'heading_rad', 'speed_mps', 'u', 'v']


def _vehicles(simulation: Simulation) -> dict[str, Any]:
    tracks = []
    for vehicle in simulation.traffic.vehicles:
        rows = _track_rows(simulation, _vehicle_state(vehicle))
        if rows:
            tracks.append({'id': f'v{vehicle.number}', 'type': vehicle.kind, 'rows': rows})
    return {
        'columns': _TRACK_COLUMNS,
        'note': f'ground-plane centre of the vehicle footprint, {TRACK_RATE_HZ} Hz, only while in '
        f'view, within {_TRACK_RANGE_M:.0f} m and not hidden by static objects (may be hidden '
        'by other vehicles); shake of the camera not included',
        'tracks': tracks,
    }


def _pedestrians_and_cyclists(simulation: Simulation) -> dict[str, Any]:
    """Return the tracks of pedestrians and cyclists; a track has a gap where its path restarts."""
    pedestrians = [_pedestrian_state(pedestrian) for pedestrian in simulation.pedestrians]
    cyclists = [_cyclist_state(cyclist) for cyclist in simulation.cyclists]
    tracks = []
    for kind, states in (('pedestrian', pedestrians), ('cyclist', cyclists)):
        for number, state in enumerate(states, 1):
            if rows := _track_rows(simulation, state):
                tracks.append({'id': f'{kind[0]}{number}', 'type': kind, 'rows': rows})
    return {'columns': _TRACK_COLUMNS, 'tracks': tracks}


def _vehicle_state(vehicle: Vehicle) -> _StateAt:
    def state_at(time_s: float) -> tuple[float, float, float, float] | None:
        state = vehicle.state(time_s)
        return None if state is None else (state.x, state.y, state.heading, state.speed_mps)

    return state_at


def _pedestrian_state(pedestrian: Pedestrian) -> _StateAt:
    def state_at(time_s: float) -> tuple[float, float, float, float] | None:
        state = pedestrian.state(time_s)
        return None if state is None else (state.x, state.y, pedestrian.heading, pedestrian.speed_mps)

    return state_at


def _cyclist_state(cyclist: Cyclist) -> _StateAt:
    def state_at(time_s: float) -> tuple[float, float, float, float]:
        state = cyclist.state(time_s)
        return state.x, state.y, state.heading, cyclist.speed_mps

    return state_at


def _track_rows(simulation: Simulation, state_at: _StateAt) -> list[list[float]]:
    """Sample a road user at TRACK_RATE_HZ; return its rows while it is visible."""
    duration = simulation.options.frame_count / simulation.options.rate_hz
    times = np.arange(int(np.ceil(duration * TRACK_RATE_HZ - 1e-9))) / TRACK_RATE_HZ
    found = [(t, state) for t in times.tolist() if (state := state_at(t)) is not None]
    rows: list[list[float]] = []
    for bumped in (False, True):
        part = [(t, *state) for t, state in found if simulation.is_bumped(t) == bumped]
        if not part:
            continue
        values = np.array(part)
        pose = simulation.bumped_pose() if bumped else simulation.pose
        centres = np.pad(values[:, 1:3], ((0, 0), (0, 1)))
        pixels, visible = _project_visible(simulation, pose, bumped, centres)
        visible &= np.hypot(*(centres - pose.position_m)[:, :2].T) <= _TRACK_RANGE_M
        kept = np.concatenate([values.round(4), pixels.round(3)], 1)[visible]
        rows += kept.tolist()
    return rows
