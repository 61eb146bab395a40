"""The roads of a solution: which are real, which more there are, and whether two cross at a right angle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions, JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust, road_support
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState, RoadDirections, initial_state
from autocalib_ros.estimation.observations.track_set import TrackSet, evenly_spaced
from autocalib_ros.estimation.straight.initialisation import MIN_ROAD_SEPARATION_DEG, roads_separated
from autocalib_ros.geometry.great_circles import fit_circles, unproject_rays
from autocalib_ros.results.statements import Statement, assumption, check

MAX_ROADS = 4
MAX_PROPOSAL_TRACKS = 40
"""Tracks, evenly out of those left, each two of which propose a direction."""
ROAD_INLIER_DEG = 1.0
"""A track whose direction in the plane is within this of a further road follows it."""
RIGHT_ANGLE_SIGMAS = 2.5
RIGHT_ANGLE_FLOOR_DEG = 2.0
"""Junctions are built to about a degree, and followed points drift by another across their vehicles' way: within that,
or so many standard deviations, 90 degrees stay more probable than any other angle (more than half of all junctions are
square; the others spread over tens of degrees)."""
MAX_NOISE_RATIO = 4.0
"""Tracks on roads may be off by so many times the variance that the vehicles' motion shows; beyond it the roads are
turns that look alike."""


def drop_unsupported_roads(
    fit: Adjustment, support: list[np.ndarray], tracks: TrackSet, gate: GateOptions
) -> Adjustment:
    """Solve again with the one road that explains most vehicles when a second has too little behind it."""
    if _all_supported(fit, support, tracks, gate):
        return fit
    inliers = fit.inliers()
    counts = [len(np.unique(tracks.vehicles[inliers & (fit.labels == road)])) for road in range(len(support))]
    direction = fit.state.directions[int(np.argmax(counts))]
    config = fit.problem.config
    alone = initial_state(
        config.prior.start(fit.state.camera.focal_px), RoadDirections(direction[None], np.zeros(0, int), 0.0)
    )
    return adjust(alone, tracks, config)


def _all_supported(fit: Adjustment, support: list[np.ndarray], tracks: TrackSet, gate: GateOptions) -> bool:
    """Whether each road of a solution has enough behind it, and none is another's echo."""
    return roads_separated(fit) and all(has_road_support(mask, tracks, gate) for mask in support)


def add_second_road(fit: Adjustment, tracks: TrackSet, gate: GateOptions) -> Adjustment:
    """Look for a second road where one alone is known: a direction on which vehicles agree that do not follow it."""
    if fit.plane_known or len(fit.state.angles_rad) != 1:
        return fit
    direction = _second_direction(fit, tracks)
    if direction is None:
        return fit
    first = fit.state.directions[0]
    both = initial_state(fit.state.camera, RoadDirections(np.stack([first, direction]), np.zeros(0, int), 0.0))
    wider = adjust(both, tracks, fit.problem.config, refine=True)
    return wider if _all_supported(wider, road_support(wider, tracks), tracks, gate) else fit


def _second_direction(fit: Adjustment, tracks: TrackSet) -> np.ndarray | None:
    """Direction (3,) on which most vehicles agree whose straight tracks follow no road, None where three do not."""
    normals, vehicles = _unexplained_circles(fit, tracks)
    some = evenly_spaced(len(normals), MAX_PROPOSAL_TRACKS)
    one, other = (some[index] for index in np.triu_indices(len(some), 1))
    meeting = np.cross(normals[one], normals[other])
    size = np.linalg.norm(meeting, axis=1)
    sure = (size > np.sin(np.radians(ROAD_INLIER_DEG))) & (vehicles[one] != vehicles[other])
    directions = meeting[sure] / size[sure, None]
    directions = directions[np.abs(directions @ fit.state.directions[0]) < np.cos(np.radians(MIN_ROAD_SEPARATION_DEG))]
    best = _most_supported(np.abs(directions @ normals.T), vehicles, 3)
    return None if best is None else directions[best]


def _unexplained_circles(fit: Adjustment, tracks: TrackSet) -> tuple[np.ndarray, np.ndarray]:
    """Circles' normals (n, 3) and vehicles (n,) of the straight tracks that follow no road."""
    normals, own, _ = fit_circles(unproject_rays(fit.state.camera, tracks.pixels), tracks.weights)
    left = (fit.labels < 0) & (own < 1.0)
    return normals[left], tracks.vehicles[left]


def _most_supported(sines: np.ndarray, vehicles: np.ndarray, least: int) -> int | None:
    """Index of the proposal with which most vehicles (n,) agree, by the sines (proposals, n) that their tracks are off.

    None where fewer than `least` do.
    """
    agree = sines < np.sin(np.radians(ROAD_INLIER_DEG))
    counts = np.array([len(np.unique(vehicles[row])) for row in agree])
    return int(np.argmax(counts)) if counts.max(initial=0) >= least else None


def add_further_roads(fit: Adjustment, tracks: TrackSet, gate: GateOptions) -> Adjustment:
    """Add roads in a known plane as long as tracks that follow none agree on one."""
    while fit.plane_known and len(fit.state.angles_rad) < MAX_ROADS:
        angle = _further_angle(fit, tracks)
        if angle is None:
            return fit
        wider = adjust(_add_road(fit.state, angle), tracks, fit.problem.config, refine=True)
        turns = wider.problem.config.turning and wider.scale > MAX_NOISE_RATIO * max(1.0, *wider.scales[1:])
        if turns or not _all_supported(wider, road_support(wider, tracks), tracks, gate):
            return fit
        fit = wider
    return fit


def _add_road(state: AdjustmentState, angle: float) -> AdjustmentState:
    """Return the state with one road more; the first defines the x axis of the plane."""
    if len(state.angles_rad):
        return replace(state, angles_rad=np.append(state.angles_rad, angle))
    turned = state.rotation @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return replace(state, rotation=turned, angles_rad=np.zeros(1))


def _further_angle(fit: Adjustment, tracks: TrackSet) -> float | None:
    """Angle in the plane on which most vehicles agree whose tracks follow no road yet, None where two do not."""
    normals, vehicles = _unexplained_circles(fit, tracks)
    angles = _angles_in_plane(fit.state, normals)
    turned = np.abs(np.sin(angles[:, None] - fit.state.angles_rad)).min(axis=1, initial=1.0)
    away = turned > np.sin(np.radians(MIN_ROAD_SEPARATION_DEG))
    angles, vehicles = angles[away], vehicles[away]
    best = _most_supported(np.abs(np.sin(angles[:, None] - angles)), vehicles, 2)
    return None if best is None else float(angles[best])


def _angles_in_plane(state: AdjustmentState, normals: np.ndarray) -> np.ndarray:
    """Angle (n,), in the frame of the plane, of the ways on it whose great circles have these normals (n, 3)."""
    along = np.cross(normals, state.rotation[:, 2]) @ state.rotation
    return np.arctan2(along[:, 1], along[:, 0])


def fix_right_angle(fit: Adjustment, tracks: TrackSet, options: JointOptions) -> tuple[Adjustment, Statement | None]:
    """Fix two roads at 90 degrees unless the evidence contradicts it, or at the given angle; and the angle."""
    if len(fit.state.angles_rad) < 2:
        return fit, None
    angle, config = crossing_deg(fit.state), fit.problem.config
    if config.crossing_rad is not None:
        return fit, assumption('crossing_angle', angle_deg=options.crossing_deg, sigma_deg=None, source='given')
    sigma = float(fit.sigma(lambda state: np.array([crossing_deg(state)]))[0])
    if options.road_angle == 'free' or abs(90.0 - angle) > max(RIGHT_ANGLE_SIGMAS * sigma, RIGHT_ANGLE_FLOOR_DEG):
        return fit, check('crossing_angle', angle_deg=angle, sigma_deg=min(sigma, 90.0), source='measured')
    squared = adjust(fit.state, tracks, replace(config, crossing_rad=np.pi / 2))
    return squared, assumption('crossing_angle', angle_deg=angle, sigma_deg=sigma, source='fixed')


def main_road(fit: Adjustment, tracks: TrackSet) -> tuple[np.ndarray, TrackSet]:
    """Unit vector (3,), camera frame, along which most vehicles drive, and the tracks that follow that road straight.

    The busiest road; where there is none the middling heading, and no tracks.
    """
    support = road_support(fit, tracks)
    if support:
        busiest = max(range(len(support)), key=lambda road: len(np.unique(tracks.vehicles[support[road]])))
        return fit.state.directions[busiest], tracks.subset(support[busiest])
    rays = unproject_rays(fit.state.camera, tracks.pixels)
    normals, _, _ = fit_circles(rays, tracks.weights)
    # headings to and fro are one: doubled angles make them so
    twice = np.exp(2j * _angles_in_plane(fit.state, normals)) * tracks.vehicle_weight
    angle = 0.5 * np.angle(twice.sum())
    along = fit.state.rotation @ np.array([np.cos(angle), np.sin(angle), 0.0])
    return along, tracks.subset(np.zeros(0, int))


MIN_VEHICLES_PER_ROAD = 4
"""Vehicles, distinct, that make a road; fewer may be one driver's whim."""


def has_road_support(mask: np.ndarray, tracks: TrackSet, gate: GateOptions) -> bool:
    """Tell whether enough tracks of enough vehicles support a direction."""
    return mask.sum() >= gate.min_tracks_per_road and len(np.unique(tracks.vehicles[mask])) >= MIN_VEHICLES_PER_ROAD


def crossing_deg(state: AdjustmentState) -> float:
    """Angle at which the first two roads cross, 0 to 90 degrees."""
    return float(np.degrees(np.arccos(np.clip(abs(np.cos(state.angles_rad[1])), 0.0, 1.0))))
