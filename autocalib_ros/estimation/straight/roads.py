"""The roads of a solution: which are real, which more there are, and whether two cross at a right angle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions, JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import JointFit, road_support, solve_joint
from autocalib_ros.estimation.adjustment.parameters import Directions, State, initial_state
from autocalib_ros.estimation.observations.track_set import TrackSet, evenly
from autocalib_ros.estimation.straight.initialisation import APART_DEG, apart
from autocalib_ros.geometry.great_circles import fit_circles, rays_of

MOST_ROADS = 4
VOTERS = 40
"""Tracks, evenly out of those left, each two of which propose a direction."""
ON_ROAD_DEG = 1.0
"""A track whose direction in the plane is within this of a further road follows it."""
RIGHT_ANGLE_SIGMAS = 2.5
RIGHT_ANGLE_FLOOR_DEG = 2.0
"""Junctions are built to about a degree, and followed points drift by another across their vehicles' way: within that,
or so many standard deviations, 90 degrees stay more probable than any other angle (more than half of all junctions are
square; the others spread over tens of degrees)."""
NOISIER = 4.0
"""Tracks on roads may be off by so many times the variance that the vehicles' motion shows; beyond it the roads are
turns that look alike."""


def with_real_roads(fit: JointFit, support: list[np.ndarray], tracks: TrackSet, gate: GateOptions) -> JointFit:
    """Solve again with the one road that explains most vehicles when a second has too little behind it."""
    if _all_real(fit, support, tracks, gate):
        return fit
    explained = fit.explained()
    counts = [len(np.unique(tracks.vehicles[explained & (fit.labels == road)])) for road in range(len(support))]
    direction = fit.state.directions[int(np.argmax(counts))]
    setting = fit.problem.setting
    alone = initial_state(setting.prior.start(fit.state.camera.focal_px),
                          Directions(direction[None], np.zeros(0, int), 0.0))
    return solve_joint(alone, tracks, setting)


def _all_real(fit: JointFit, support: list[np.ndarray], tracks: TrackSet, gate: GateOptions) -> bool:
    """Whether each road of a solution has enough behind it, and none is another's echo."""
    return apart(fit) and all(is_road(mask, tracks, gate) for mask in support)


def with_second_road(fit: JointFit, tracks: TrackSet, gate: GateOptions) -> JointFit:
    """Look for a second road where one alone is known: a direction on which vehicles agree that do not follow it."""
    if fit.plane_known or len(fit.state.angles_rad) != 1:
        return fit
    direction = _second_direction(fit, tracks)
    if direction is None:
        return fit
    first = fit.state.directions[0]
    both = initial_state(fit.state.camera, Directions(np.stack([first, direction]), np.zeros(0, int), 0.0))
    wider = solve_joint(both, tracks, fit.problem.setting, refine=True)
    return wider if _all_real(wider, road_support(wider, tracks), tracks, gate) else fit


def _second_direction(fit: JointFit, tracks: TrackSet) -> np.ndarray | None:
    """Direction (3,) on which most vehicles agree whose straight tracks follow no road, None where three do not."""
    normals, vehicles = _left(fit, tracks)
    some = evenly(len(normals), VOTERS)
    one, other = (some[index] for index in np.triu_indices(len(some), 1))
    meeting = np.cross(normals[one], normals[other])
    size = np.linalg.norm(meeting, axis=1)
    sure = (size > np.sin(np.radians(ON_ROAD_DEG))) & (vehicles[one] != vehicles[other])
    directions = meeting[sure] / size[sure, None]
    directions = directions[np.abs(directions @ fit.state.directions[0]) < np.cos(np.radians(APART_DEG))]
    best = _most_agreed(np.abs(directions @ normals.T), vehicles, 3)
    return None if best is None else directions[best]


def _left(fit: JointFit, tracks: TrackSet) -> tuple[np.ndarray, np.ndarray]:
    """Circles' normals (n, 3) and vehicles (n,) of the straight tracks that follow no road."""
    normals, own, _ = fit_circles(rays_of(fit.state.camera, tracks.pixels), tracks.weights)
    left = (fit.labels < 0) & (own < 1.0)
    return normals[left], tracks.vehicles[left]


def _most_agreed(sines: np.ndarray, vehicles: np.ndarray, least: int) -> int | None:
    """Index of the proposal with which most vehicles (n,) agree, by the sines (proposals, n) that their tracks are off.

    None where fewer than `least` do.
    """
    agree = sines < np.sin(np.radians(ON_ROAD_DEG))
    counts = np.array([len(np.unique(vehicles[row])) for row in agree])
    return int(np.argmax(counts)) if counts.max(initial=0) >= least else None


def with_further_roads(fit: JointFit, tracks: TrackSet, gate: GateOptions) -> JointFit:
    """Add roads in a known plane as long as tracks that follow none agree on one."""
    while fit.plane_known and len(fit.state.angles_rad) < MOST_ROADS:
        angle = _further_angle(fit, tracks)
        if angle is None:
            return fit
        wider = solve_joint(_with_road(fit.state, angle), tracks, fit.problem.setting, refine=True)
        turns = wider.problem.setting.turning and wider.scale > NOISIER * max(1.0, *wider.scales[1:])
        if turns or not _all_real(wider, road_support(wider, tracks), tracks, gate):
            return fit
        fit = wider
    return fit


def _with_road(state: State, angle: float) -> State:
    """Return the state with one road more; the first defines the x axis of the plane."""
    if len(state.angles_rad):
        return replace(state, angles_rad=np.append(state.angles_rad, angle))
    turned = state.rotation @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return replace(state, rotation=turned, angles_rad=np.zeros(1))


def _further_angle(fit: JointFit, tracks: TrackSet) -> float | None:
    """Angle in the plane on which most vehicles agree whose tracks follow no road yet, None where two do not."""
    normals, vehicles = _left(fit, tracks)
    angles = _angles_in_plane(fit.state, normals)
    turned = np.abs(np.sin(angles[:, None] - fit.state.angles_rad)).min(axis=1, initial=1.0)
    away = turned > np.sin(np.radians(APART_DEG))
    angles, vehicles = angles[away], vehicles[away]
    best = _most_agreed(np.abs(np.sin(angles[:, None] - angles)), vehicles, 2)
    return None if best is None else float(angles[best])


def _angles_in_plane(state: State, normals: np.ndarray) -> np.ndarray:
    """Angle (n,), in the frame of the plane, of the ways on it whose great circles have these normals (n, 3)."""
    along = np.cross(normals, state.rotation[:, 2]) @ state.rotation
    return np.arctan2(along[:, 1], along[:, 0])


def with_right_angle(fit: JointFit, tracks: TrackSet, options: JointOptions) -> tuple[JointFit, str | None]:
    """Hold two roads at 90 degrees where the evidence does not speak against it, or at what is asserted."""
    if len(fit.state.angles_rad) < 2:
        return fit, None
    angle, setting = crossing_deg(fit.state), fit.problem.setting
    if setting.crossing_rad is not None:
        return fit, f'roads cross at {options.crossing_deg:g} degrees (asserted)'
    sigma = float(fit.sigma(lambda state: np.array([crossing_deg(state)]))[0])
    measured = f'roads cross at {angle:.1f} +- {min(sigma, 90.0):.1f} degrees (measured)'
    if options.road_angle == 'free' or abs(90.0 - angle) > max(RIGHT_ANGLE_SIGMAS * sigma, RIGHT_ANGLE_FLOOR_DEG):
        return fit, measured
    squared = solve_joint(fit.state, tracks, replace(setting, crossing_rad=np.pi / 2))
    return squared, f'roads cross at 90 degrees (tested: {angle:.1f} +- {sigma:.1f})'


def main_road(fit: JointFit, tracks: TrackSet) -> tuple[np.ndarray, TrackSet]:
    """Unit vector (3,), camera frame, along which most vehicles drive, and the tracks that follow that road straight.

    The busiest road; where there is none the middling heading, and no tracks.
    """
    support = road_support(fit, tracks)
    if support:
        busiest = max(range(len(support)), key=lambda road: len(np.unique(tracks.vehicles[support[road]])))
        return fit.state.directions[busiest], tracks.subset(support[busiest])
    rays = rays_of(fit.state.camera, tracks.pixels)
    normals, _, _ = fit_circles(rays, tracks.weights)
    # headings to and fro are one: doubled angles make them so
    twice = np.exp(2j * _angles_in_plane(fit.state, normals)) * tracks.share_of_vehicle
    angle = 0.5 * np.angle(twice.sum())
    along = fit.state.rotation @ np.array([np.cos(angle), np.sin(angle), 0.0])
    return along, tracks.subset(np.zeros(0, int))


MIN_VEHICLES = 4
"""Vehicles, distinct, that make a road; fewer may be one driver's whim."""


def is_road(mask: np.ndarray, tracks: TrackSet, gate: GateOptions) -> bool:
    """Tell whether enough tracks of enough vehicles support a direction."""
    return mask.sum() >= gate.min_tracks_per_road and len(np.unique(tracks.vehicles[mask])) >= MIN_VEHICLES


def crossing_deg(state: State) -> float:
    """Angle at which the first two roads cross, 0 to 90 degrees."""
    return float(np.degrees(np.arccos(np.clip(abs(np.cos(state.angles_rad[1])), 0.0, 1.0))))
