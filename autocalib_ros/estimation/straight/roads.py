"""Roads of a solution: support, search for further roads, right-angle test, main road."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.config import GateOptions, JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust, road_support
from autocalib_ros.estimation.adjustment.parameters import (
    RIGHT_ANGLE_SIGMA_RAD,
    AdjustmentState,
    RoadDirections,
    initial_state,
)
from autocalib_ros.estimation.observations.track_set import TrackSet, evenly_spaced
from autocalib_ros.estimation.straight.initialisation import MIN_ROAD_SEPARATION_DEG, below_horizon, roads_separated
from autocalib_ros.geometry.great_circles import fit_circles, unproject_rays
from autocalib_ros.results.statements import Statement, assumption, check

MIN_VEHICLES_PER_ROAD = 4
"""Distinct vehicles that support a road; fewer may be the manoeuvre of one driver. Judgement."""
MAX_ROADS = 4
"""Roads of one solution."""
MAX_PROPOSAL_TRACKS = 40
"""Unexplained tracks, evenly spaced, each pair of which proposes a direction."""
ROAD_INLIER_DEG = 1.0
"""Angle in degrees between a track's direction and a further road within which the track supports it."""
SQUARE_FRACTION, SKEW_SPREAD_DEG = 0.6, 90.0
"""More than half of all junctions are square, the others cross at any angle."""
HEADING_DRIFT_DEG = 1.0
"""Standard deviation by which the drift of tracked points across the driving direction changes a measured crossing
angle."""
MIN_SQUARE_ODDS = 9.0
"""Odds for a right angle, from which on it is expected: one in ten would be skewed."""
MAX_NOISE_RATIO = 4.0
"""Largest ratio of the residual scale of tracks on roads to that of turning vehicles (both squared, whitened); above
it the further road consists of similar turns. Judgement."""


def drop_unsupported_roads(
    fit: Adjustment, support: list[np.ndarray], tracks: TrackSet, gate: GateOptions
) -> Adjustment:
    """Adjust with the best-supported road alone where a road of the solution lacks support."""
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
    """Return whether each road has its own support, and all lie apart in a plane below the horizon.

    Similar turns look like a road, but that is not in one plane with another.
    """
    supported = all(has_road_support(mask, tracks, gate) for mask in support)
    return supported and roads_separated(fit) and below_horizon(fit, tracks)


def add_second_road(fit: Adjustment, tracks: TrackSet, gate: GateOptions) -> Adjustment:
    """Add a second road to a solution of one road: the best-supported direction of unexplained straight tracks."""
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
    """Return the direction (3,) supported by most vehicles with unexplained straight tracks, None below three."""
    normals, vehicles = _unexplained_circles(fit, tracks)
    chosen = evenly_spaced(len(normals), MAX_PROPOSAL_TRACKS)
    one, other = (chosen[index] for index in np.triu_indices(len(chosen), 1))
    intersection = np.cross(normals[one], normals[other])
    size = np.linalg.norm(intersection, axis=1)
    well_defined = (size > np.sin(np.radians(ROAD_INLIER_DEG))) & (vehicles[one] != vehicles[other])
    directions = intersection[well_defined] / size[well_defined, None]
    directions = directions[np.abs(directions @ fit.state.directions[0]) < np.cos(np.radians(MIN_ROAD_SEPARATION_DEG))]
    best = _most_supported(np.abs(directions @ normals.T), vehicles, 3)
    return None if best is None else directions[best]


def _unexplained_circles(fit: Adjustment, tracks: TrackSet) -> tuple[np.ndarray, np.ndarray]:
    """Return circle normals (n, 3) and vehicles (n,) of straight tracks (within 1 px) that follow no road."""
    normals, own, _ = fit_circles(unproject_rays(fit.state.camera, tracks.pixels), tracks.weights)
    unexplained = (fit.labels < 0) & (own < 1.0)
    return normals[unexplained], tracks.vehicles[unexplained]


def _most_supported(sines: np.ndarray, vehicles: np.ndarray, min_vehicles: int) -> int | None:
    """Return the index of the proposal with the most inlier vehicles, None below `min_vehicles`.

    `sines` (proposals, n) are of the angles between proposals and tracks, `vehicles` (n,) of the tracks.
    """
    inliers = sines < np.sin(np.radians(ROAD_INLIER_DEG))
    counts = np.array([len(np.unique(vehicles[row])) for row in inliers])
    return int(np.argmax(counts)) if counts.max(initial=0) >= min_vehicles else None


def add_further_roads(fit: Adjustment, tracks: TrackSet, gate: GateOptions) -> Adjustment:
    """Add roads in a known plane while unexplained tracks support one, up to `MAX_ROADS`."""
    while fit.plane_known and len(fit.state.angles_rad) < MAX_ROADS:
        angle = _further_angle(fit, tracks)
        if angle is None:
            return fit
        wider = adjust(_add_road(fit.state, angle), tracks, fit.problem.config, refine=True)
        noisy = wider.problem.config.turning and wider.scale > MAX_NOISE_RATIO * max(1.0, *wider.scales[1:])
        if noisy or not _all_supported(wider, road_support(wider, tracks), tracks, gate):
            return fit
        fit = wider
    return fit


def _add_road(state: AdjustmentState, angle: float) -> AdjustmentState:
    """Return the state with one more road; the first road defines the x axis of the plane."""
    if len(state.angles_rad):
        return replace(state, angles_rad=np.append(state.angles_rad, angle))
    turned = state.rotation @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return replace(state, rotation=turned, angles_rad=np.zeros(1))


def _further_angle(fit: Adjustment, tracks: TrackSet) -> float | None:
    """Return the angle in the plane supported by most vehicles with unexplained tracks, None below two."""
    normals, vehicles = _unexplained_circles(fit, tracks)
    angles = _angles_in_plane(fit.state, normals)
    sines = np.abs(np.sin(angles[:, None] - fit.state.angles_rad)).min(axis=1, initial=1.0)
    separated = sines > np.sin(np.radians(MIN_ROAD_SEPARATION_DEG))
    angles, vehicles = angles[separated], vehicles[separated]
    best = _most_supported(np.abs(np.sin(angles[:, None] - angles)), vehicles, 2)
    return None if best is None else float(angles[best])


def _angles_in_plane(state: AdjustmentState, normals: np.ndarray) -> np.ndarray:
    """Return the angles (n,), in the plane frame, of the lines on the plane with great circle normals (n, 3)."""
    along = np.cross(normals, state.rotation[:, 2]) @ state.rotation
    return np.arctan2(along[:, 1], along[:, 0])


def expect_right_angle(fit: Adjustment, tracks: TrackSet, options: JointOptions) -> tuple[Adjustment, Statement | None]:
    """Expect the first two roads at 90 degrees, to `RIGHT_ANGLE_SIGMA_RAD`, if the measured angle makes it likely.

    Returns the solution and the angle as an assumption or a check, None with fewer than two roads. An angle given by
    an option is exact; with `road_angle` 'free' none is expected.
    """
    if len(fit.state.angles_rad) < 2:
        return fit, None
    angle, config = crossing_deg(fit.state), fit.problem.config
    if config.crossing_rad is not None:
        return fit, assumption('crossing_angle', angle_deg=options.crossing_deg, sigma_deg=None, source='given')
    sigma = float(fit.sigma(lambda state: np.array([crossing_deg(state)]))[0])
    if options.road_angle == 'free' or _square_odds(angle, sigma) < MIN_SQUARE_ODDS:
        return fit, check('crossing_angle', angle_deg=angle, sigma_deg=min(sigma, 90.0), source='measured')
    squared = adjust(
        fit.state, tracks, replace(config, crossing_rad=np.pi / 2, crossing_sigma_rad=RIGHT_ANGLE_SIGMA_RAD)
    )
    return squared, assumption('crossing_angle', angle_deg=angle, sigma_deg=sigma, source='expected')


def _square_odds(angle_deg: float, sigma_deg: float) -> float:
    """Return the odds of a right angle against any other for a measured crossing angle."""
    spread = float(np.sqrt(sigma_deg**2 + HEADING_DRIFT_DEG**2 + np.degrees(RIGHT_ANGLE_SIGMA_RAD) ** 2))
    density = np.exp(-0.5 * ((90.0 - angle_deg) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    return float(SQUARE_FRACTION * density / ((1.0 - SQUARE_FRACTION) / SKEW_SPREAD_DEG))


def main_road(fit: Adjustment, tracks: TrackSet) -> tuple[np.ndarray, TrackSet]:
    """Return the unit vector (3,), camera frame, along the road of most vehicles, and the tracks that support it.

    Without a supported road: the circular mean heading, and no tracks.
    """
    support = road_support(fit, tracks)
    if support:
        busiest = max(range(len(support)), key=lambda road: len(np.unique(tracks.vehicles[support[road]])))
        return fit.state.directions[busiest], tracks.subset(support[busiest])
    rays = unproject_rays(fit.state.camera, tracks.pixels)
    normals, _, _ = fit_circles(rays, tracks.weights)
    # opposite headings are one undirected heading: average doubled angles
    doubled = np.exp(2j * _angles_in_plane(fit.state, normals)) * tracks.vehicle_weight
    angle = 0.5 * np.angle(doubled.sum())
    along = fit.state.rotation @ np.array([np.cos(angle), np.sin(angle), 0.0])
    return along, tracks.subset(np.zeros(0, int))


def has_road_support(mask: np.ndarray, tracks: TrackSet, gate: GateOptions) -> bool:
    """Return whether the tracks of a mask (tracks,) are enough tracks of enough vehicles for a road."""
    enough = mask.sum() >= gate.min_tracks_per_road
    return bool(enough and len(np.unique(tracks.vehicles[mask])) >= MIN_VEHICLES_PER_ROAD)


def crossing_deg(state: AdjustmentState) -> float:
    """Return the angle at which the first two roads cross, 0 to 90 degrees."""
    return float(np.degrees(np.arccos(np.clip(abs(np.cos(state.angles_rad[1])), 0.0, 1.0))))
