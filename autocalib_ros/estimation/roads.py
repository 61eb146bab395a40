"""The robust method: from tracks to a lens and roads that have been doubted in every way we know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.calibration import Reason
from autocalib_ros.camera import Camera
from autocalib_ros.config import GateOptions, JointOptions
from autocalib_ros.estimation.great_circles import TrackSet, rays_of
from autocalib_ros.estimation.ground_plane import BELOW_HORIZON, tilt_and_roll_deg, upward
from autocalib_ros.estimation.joint import (
    MIN_TRACKS,
    JointFit,
    State,
    initial_state,
    road_support,
    solve_joint,
)
from autocalib_ros.estimation.straightness import focal_trials
from autocalib_ros.estimation.vanishing_points import Directions, consensus_directions

TRIALS = 16
"""Focal lengths tried as starts: steps of about 15 %, within which the joint problem converges."""
STARTS = 2
VOTERS = 250
"""Tracks, evenly out of all, from which the starts are made and compared; the solution then uses every track."""
MIN_VEHICLES = 4
"""Vehicles, distinct, that make a road; fewer may be one driver's whim."""
STRAIGHT_SHARE = 0.35
"""Share of vehicles that follow the roads; below it the traffic turns, and what it agrees on is a turn."""
RIGHT_ANGLE_SIGMAS = 2.0
RIGHT_ANGLE_FLOOR_DEG = 1.0
"""Junctions are built to about a degree: a difference within it does not speak against 90 degrees."""
MIN_CONTRAST = 1.3
"""Agreement at the best trial focal length over that at the median one: wrong lenses bend straight paths apart."""
LONGEST_FOCAL = 1.5
"""Focal length, in image diagonals, beyond which no lens curvature can be seen."""
PRIOR_SIGMAS = 3.5
HALVES_SIGMAS = 3.5
HALVES_FOCAL = 0.03
HALVES_DEG = 1.5
"""Two halves of the evidence may always differ by so much: it is within what the program promises."""

NOT_CROSS_CHECKED = 'not cross-checked in time: the earlier or the later half has too little traffic on a road'


@dataclass(frozen=True)
class Roads:
    """A lens and the roads, with the reason why there is no ground plane where there is none."""

    fit: JointFit
    support: list[np.ndarray]
    """Masks of the tracks (tracks,) that tell each road from the others."""
    assumptions: tuple[str, ...]
    checks: tuple[str, ...]
    no_plane: Reason | None


def find_roads(tracks: TrackSet, image_size: tuple[int, int], options: JointOptions, gate: GateOptions,
               generator: np.random.Generator) -> Roads | Reason:
    """Estimate lens and road directions from tracks; a reason instead when the lens cannot be trusted."""
    if len(tracks) < gate.min_tracks:
        return Reason('too_few_tracks', f'{len(tracks)} tracks of the {gate.min_tracks} needed are long enough',
                      'wait for more traffic, or record for longer')
    trials = focal_trials(tracks, image_size, TRIALS)
    voters = tracks.subset(np.unique(np.linspace(0, len(tracks) - 1, VOTERS).astype(int)))
    found = [consensus_directions(Camera.equidistant(*image_size, trial), voters, generator) for trial in trials]
    starts = _peaks(found)[:STARTS]
    if not starts:
        return Reason('no_direction', f'{len(tracks)} tracks agree on no common direction',
                      'straight traffic is needed: wait for it, or turn the camera towards a straight road')
    fits = [solve_joint(initial_state(Camera.equidistant(*image_size, trials[index]), found[index]), voters, options)
            for index in starts]
    fit = solve_joint(min(fits, key=lambda candidate: candidate.cost).state, tracks, options)
    support = road_support(fit, tracks)
    if not all(_is_road(mask, tracks, gate) for mask in support):
        fit = _strongest_alone(fit, support, tracks, options)
        support = road_support(fit, tracks)
    fit, angle = _with_right_angle(fit, tracks, options)
    scores = np.array([item.score for item in found])
    contrast = float(scores.max() / max(np.median(scores), 1e-9))
    doubt = _lens_doubt(fit, contrast, tracks, options, gate)
    return doubt or _doubted(fit, support, angle, tracks, options, gate)


def _peaks(found: list[Directions]) -> list[int]:
    """Indices of trials whose score no neighbour beats, best first; trials without a direction never."""
    scores = np.array([item.score for item in found])
    padded = np.concatenate([[-np.inf], scores, [-np.inf]])
    peaks = np.flatnonzero((scores >= padded[:-2]) & (scores >= padded[2:]) & (scores > 0))
    return sorted((int(index) for index in peaks), key=lambda index: -scores[index])


def _is_road(mask: np.ndarray, tracks: TrackSet, gate: GateOptions) -> bool:
    return mask.sum() >= gate.min_tracks_per_road and len(np.unique(tracks.vehicles[mask])) >= MIN_VEHICLES


def _strongest_alone(fit: JointFit, support: list[np.ndarray], tracks: TrackSet, options: JointOptions) -> JointFit:
    """Solve again with the one road that explains most vehicles, from an equidistant lens."""
    explained = fit.explained()
    counts = [len(np.unique(tracks.vehicles[explained & (fit.labels == road)])) for road in range(len(support))]
    direction = fit.state.directions[int(np.argmax(counts))]
    camera = Camera.equidistant(fit.state.camera.width, fit.state.camera.height, fit.state.camera.focal_px)
    alone = initial_state(camera, Directions(direction[None], np.zeros(0, int), 0.0))
    return solve_joint(alone, tracks, options)


def _with_right_angle(fit: JointFit, tracks: TrackSet, options: JointOptions) -> tuple[JointFit, str | None]:
    """Hold two roads at 90 degrees where the evidence does not speak against it, or where that is asserted."""
    if len(fit.state.angles_rad) != 2:
        return fit, None
    angle = crossing_deg(fit.state)
    if options.road_angle == 'free':
        return fit, f'roads cross at {angle:.1f} degrees (measured)'
    sigma = float(fit.sigma(lambda state: np.array([crossing_deg(state)]))[0])
    if options.road_angle == 'perpendicular':
        return solve_joint(fit.state, tracks, options, perpendicular=True), 'roads cross at 90 degrees (asserted)'
    if abs(90.0 - angle) <= max(RIGHT_ANGLE_SIGMAS * sigma, RIGHT_ANGLE_FLOOR_DEG):
        text = f'roads cross at 90 degrees (tested: {angle:.1f} +- {sigma:.1f})'
        return solve_joint(fit.state, tracks, options, perpendicular=True), text
    return fit, f'roads cross at {angle:.1f} +- {sigma:.1f} degrees (measured)'


def crossing_deg(state: State) -> float:
    """Angle at which the first two roads cross, 0 to 90 degrees."""
    return float(np.degrees(np.arccos(np.clip(abs(np.cos(state.angles_rad[1])), 0.0, 1.0))))


def normal_of(state: State, tracks: TrackSet) -> tuple[np.ndarray, float]:
    """Upward ground normal (3,) in the camera frame, and the share of tracked points below the horizon."""
    seen = tracks.pixels[tracks.weights > 0]
    return upward(state.rotation[:, 2], rays_of(state.camera, seen).bearings)


def _doubted(fit: JointFit, support: list[np.ndarray], angle: str | None, tracks: TrackSet, options: JointOptions,
             gate: GateOptions) -> Roads | Reason:
    """Return the roads, or why the halves of the evidence disagree; doubts about the plane only take it away."""
    camera = fit.state.camera
    assumptions = [f'lens near equidistant: k1 = 0 +- {options.k1_sigma:g}',
                   'principal point at the image centre +- '
                   f'{options.principal_point_sigma * camera.width:.0f} px']
    halves = _halves_doubt(fit, tracks, options, gate)
    if isinstance(halves, Reason):
        return halves
    if angle is None:
        tracks_seen = int(fit.explained().sum())
        assumptions += ['k1 and the principal point held there: one road cannot determine them']
        return Roads(fit, support, tuple(assumptions), (halves,), Reason(
            'one_direction', f'all {tracks_seen} tracks that agree follow one road: rotation about it is free',
            'wait for traffic across the main road'))
    checks = [] if fit.problem.perpendicular else [angle]
    assumptions += [angle] if fit.problem.perpendicular else []
    return Roads(fit, support, tuple(assumptions), (*checks, halves), _plane_doubt(fit, tracks, gate))


def _lens_doubt(fit: JointFit, contrast: float, tracks: TrackSet, options: JointOptions,
                gate: GateOptions) -> Reason | None:
    camera, share = fit.state.camera, tracks.share_of_vehicle
    straight = float((share * fit.explained()).sum() / share.sum())
    if straight < STRAIGHT_SHARE:
        return Reason(
            'turning_traffic', f'only {straight:.0%} of the vehicles follow the best straight roads, '
            f'{STRAIGHT_SHARE:.0%} are needed: the traffic turns, or the road bends',
            'wait for straight traffic, or turn the camera towards a straight road')
    if contrast < MIN_CONTRAST:
        return Reason(
            'no_agreement', f'the traffic singles out no focal length: the best agrees {contrast:.2f} times as well as '
            f'the middling one, {MIN_CONTRAST:g} is needed',
            'wait for straight traffic, above all near the borders of the image; the traffic may be turning, or the '
            'lens may have no distortion')
    _, below = normal_of(fit.state, tracks)
    if len(fit.state.angles_rad) > 1 and below < BELOW_HORIZON:
        return Reason(
            'horizon', f'{1 - below:.0%} of the tracked points lie above the horizon that the roads imply',
            'the directions found do not belong to one plane: wait for more straight traffic on both roads')
    sigma = float(fit.sigma(lambda state: np.array([np.log(state.camera.focal_px)]))[0])
    diagonals = camera.focal_px / np.hypot(camera.width, camera.height)
    if diagonals > LONGEST_FOCAL or not sigma <= gate.max_sigma_focal_rel:
        return Reason(
            'too_little_curvature', f'straight traffic shows too little lens curvature: focal length '
            f'{camera.focal_px:.0f} px +- {min(sigma, 9.99):.0%}, {gate.max_sigma_focal_rel:.0%} is needed',
            'wait for traffic nearer the borders of the image; a lens without distortion needs its focal length given')
    k1_sigmas = abs(camera.k[0]) / max(options.k1_sigma, 1e-9)
    if k1_sigmas > PRIOR_SIGMAS:
        return Reason(
            'lens_model', f'the lens is not close to equidistant: k1 = {camera.k[0]:.3f}, {k1_sigmas:.1f} sigmas off',
            'widen joint.k1_sigma if the lens is known to differ')
    return None


def _plane_doubt(fit: JointFit, tracks: TrackSet, gate: GateOptions) -> Reason | None:
    normal, _ = normal_of(fit.state, tracks)
    sigma = fit.sigma(lambda state: tilt_and_roll_deg(_same_side(state.rotation[:, 2], normal)))
    if not sigma.max() <= gate.max_sigma_tilt_deg:
        return Reason(
            'plane_uncertain', f'the ground normal is known to {min(sigma.max(), 90.0):.1f} degrees, '
            f'{gate.max_sigma_tilt_deg:g} are needed', 'wait for more traffic on the quieter road')
    return None


def _same_side(normal: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return normal if normal @ reference > 0 else -normal


def _halves_doubt(fit: JointFit, tracks: TrackSet, options: JointOptions, gate: GateOptions) -> Reason | str:
    """Solve the earlier and the later half of the vehicles; they have to agree within what they know."""
    halves = [tracks.subset(mask) for mask in _time_halves(tracks)]
    if min(map(len, halves)) < MIN_TRACKS:
        return NOT_CROSS_CHECKED
    angle_held = fit.problem.perpendicular
    fits = [solve_joint(fit.state, half, options, perpendicular=angle_held) for half in halves]
    masks = [road_support(part, half) for part, half in zip(fits, halves, strict=True)]
    if min(mask.sum() for pair in masks for mask in pair) < gate.min_tracks_per_road // 2:
        return NOT_CROSS_CHECKED
    (focal, focal_sigma), (turn, turn_sigma) = _difference(*fits)
    if len(fit.state.angles_rad) < 2:
        turn = 0.0  # one road leaves the normal free
    if focal > max(HALVES_SIGMAS * focal_sigma, HALVES_FOCAL) or turn > max(HALVES_SIGMAS * turn_sigma, HALVES_DEG):
        return Reason(
            'halves_disagree', f'the earlier and the later half of the traffic disagree: focal length by {focal:.1%}, '
            f'ground normal by {turn:.1f} degrees', 'record for longer; check that the camera is firmly fixed')
    normal = f' and {turn:.1f} degrees in the ground normal' if len(fit.state.angles_rad) > 1 else ''
    return f'the earlier and the later half of the traffic differ by {focal:.1%} in focal length{normal}'


def _time_halves(tracks: TrackSet) -> tuple[np.ndarray, np.ndarray]:
    """Split the tracks by their vehicles' mean time, so that no vehicle is in both halves."""
    vehicles, inverse = np.unique(tracks.vehicles, return_inverse=True)
    mean = np.bincount(inverse, tracks.times_s) / np.bincount(inverse)
    early = (mean <= np.median(mean))[inverse]
    return early, ~early


def _difference(first: JointFit, second: JointFit) -> tuple[tuple[float, float], tuple[float, float]]:
    """Differences of relative focal length and of the normal in degrees, each with its standard deviation."""
    normals = [fit.state.rotation[:, 2] for fit in (first, second)]
    cosine = abs(float(normals[0] @ normals[1]))
    sigmas = [fit.sigma(lambda state, at=normal: np.array([
        np.log(state.camera.focal_px), *np.degrees(np.cross(at, state.rotation[:, 2]))]))
        for fit, normal in zip((first, second), normals, strict=True)]
    focal = abs(float(np.log(first.state.camera.focal_px / second.state.camera.focal_px)))
    total = np.hypot(*sigmas)
    return (focal, float(total[0])), (float(np.degrees(np.arccos(min(cosine, 1.0)))),
                                      float(np.linalg.norm(total[1:])))
