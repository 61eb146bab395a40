"""The robust method: from tracks to a lens and roads that have been doubted in every way we know."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.calibration import Reason
from autocalib_ros.camera import Camera
from autocalib_ros.config import GateOptions, JointOptions
from autocalib_ros.estimation.doubts import (
    crossing_deg,
    halves_doubt,
    is_road,
    lens_doubt,
    plane_doubt,
)
from autocalib_ros.estimation.great_circles import TrackSet, fit_circles, rays_of
from autocalib_ros.estimation.joint import (
    JointFit,
    Setting,
    cost_at_scale,
    initial_state,
    judged_with,
    noise_cost,
    road_support,
    solve_joint,
    with_bodies,
)
from autocalib_ros.estimation.lens_prior import PARAMETERS, LensPrior, known_lens, lens_priors
from autocalib_ros.estimation.straightness import focal_trials
from autocalib_ros.estimation.uncertainty import told_by_evidence
from autocalib_ros.estimation.vanishing_points import INLIER_PX, Directions, consensus_directions

TRIALS = 14
"""Focal lengths tried as starts: steps of about 17 %, within which the joint problem converges."""
STARTS = 3
VOTERS = 200
"""Tracks, evenly out of all, from which the starts are made and compared; the solution then uses every track."""
WELL_EXPLAINED, LOOSE = 0.5, 3.0
"""Below this share of explained tracks, agreement is looked for again with so many times wider limits."""
MIDDLE = 0.3
"""A radius in image diagonals at which two lenses of one field of view agree about best."""
MOST_ROADS = 4
APART_DEG = 15.0
"""Roads that differ by less are one road seen with errors."""
ON_ROAD_DEG = 1.0
"""A track whose direction in the plane is within this of a further road follows it."""
RIGHT_ANGLE_SIGMAS = 2.0
RIGHT_ANGLE_FLOOR_DEG = 1.0
"""Junctions are built to about a degree: a difference within it does not speak against 90 degrees."""
ASKED_FOR = 9.0
"""k2 is set free, or a rarer family of lenses chosen, when that makes the tracks so much more probable: twice the
logarithm, three sigmas."""


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
               generator: np.random.Generator, *, height_m: float = 0.0, lens: Camera | None = None) -> Roads | Reason:
    """Estimate lens and road directions from tracks; a reason instead when the lens cannot be trusted.

    A known `lens` is kept, and only the roads are found.
    """
    if len(tracks) < gate.min_tracks:
        return Reason('too_few_tracks', f'{len(tracks)} tracks of the {gate.min_tracks} needed are long enough',
                      'wait for more traffic, or record for longer')
    priors = [known_lens(lens)] if lens is not None else lens_priors(image_size, options)
    crossing = None if options.crossing_deg is None else float(np.radians(options.crossing_deg))
    voters = tracks.subset(np.unique(np.linspace(0, len(tracks) - 1, VOTERS).astype(int)))
    found = _agreed(voters, Setting(priors[0], options, height_m, crossing), generator)
    if found is None:
        return Reason('no_direction', f'{len(tracks)} tracks agree on no common direction',
                      'straight traffic is needed: wait for it, or turn the camera towards a straight road')
    best, contrast = found
    fit = solve_joint(best.state, tracks, best.problem.setting)
    support = road_support(fit, tracks)
    second = sorted(int(mask.sum()) for mask in support)[:-1]
    fit = _with_real_roads(fit, support, tracks, gate)
    fit = _in_likeliest_family(fit, priors[1:], voters, tracks)
    if noise_cost(fit, tracks, drifting=True) < noise_cost(fit, tracks, drifting=False):
        tracks = with_bodies(fit, tracks) if len(fit.state.angles_rad) > 1 else tracks
        fit = solve_joint(fit.state, tracks, replace(fit.problem.setting, drifting=True), refine=True)
    fit = _with_further_roads(fit, tracks, gate)
    fit, angle = _with_right_angle(fit, tracks, options)
    fit, held = _with_what_can_be_told(fit, tracks)
    doubt = lens_doubt(fit, contrast, tracks, gate)
    across = f'{min([gate.min_tracks_per_road, *(second or [0])])} of {gate.min_tracks_per_road} tracks'
    return doubt or _doubted(fit, angle, held, across, tracks, gate)


def _agreed(voters: TrackSet, setting: Setting, generator: np.random.Generator) -> tuple[JointFit, float] | None:
    """Solve from the directions on which the tracks agree at trial focal lengths; the most probable solution.

    And the contrast: how much better the best trial agreed than the middling one. None without any agreement.
    Where little is explained the agreement is looked for again less strictly: a lens that is neither centred nor
    equidistant bends long tracks by many pixels at every trial.
    """
    fits, scores = _from_trials(voters, setting, generator, INLIER_PX)
    if not fits:
        return None
    best = _most_probable(fits, voters)
    if best.explained().mean() < WELL_EXPLAINED:
        best = _most_probable([best, *_from_trials(voters, setting, generator, LOOSE * INLIER_PX)[0]], voters)
    return best, np.inf if setting.prior.focal_known else float(scores.max() / max(np.median(scores), 1e-9))


def _from_trials(voters: TrackSet, setting: Setting, generator: np.random.Generator,
                 inlier_px: float) -> tuple[list[JointFit], np.ndarray]:
    """Solutions from the trial focal lengths of best agreement, and the scores of all trials, shape (trials,)."""
    prior = setting.prior
    size = (prior.centre.width, prior.centre.height)
    trials = [prior.centre.focal_px] if prior.focal_known else focal_trials(voters, size, TRIALS)
    agreed = [consensus_directions(prior.start(trial), voters, generator, inlier_px=inlier_px) for trial in trials]
    starts = [initial_state(prior.start(trials[index]), agreed[index]) for index in _peaks(agreed)[:STARTS]]
    fits = [solve_joint(start, voters, setting) for start in starts]
    # two roads that fell together describe one road twice, and its errors the better for it
    return [fit for fit in fits if _apart(fit)] or fits, np.array([item.score for item in agreed])


def _apart(fit: JointFit) -> bool:
    turns = np.abs(np.sin(np.diff(fit.state.angles_rad)))
    return bool(turns.min(initial=1.0) > np.sin(np.radians(APART_DEG)))


def _in_likeliest_family(fit: JointFit, priors: list[LensPrior], voters: TrackSet, tracks: TrackSet) -> JointFit:
    """Solve for another family of lenses where that makes the tracks clearly more probable; one road cannot tell."""
    if len(fit.state.angles_rad) < 2 or not priors:
        return fit
    usual = solve_joint(fit.state, voters, fit.problem.setting, refine=True)
    best = _most_probable([usual, *(_in_family(usual, prior, voters) for prior in priors)], voters, ASKED_FOR)
    return fit if best is usual else solve_joint(best.state, tracks, best.problem.setting)


def _in_family(fit: JointFit, prior: LensPrior, voters: TrackSet) -> JointFit:
    """Solve for a lens of another family, from the one that images the middle of the field at the same place."""
    camera = fit.state.camera
    angle, _ = camera.angle(np.array(MIDDLE * np.hypot(camera.width, camera.height)))
    focal = camera.radius(angle) / replace(prior.centre, focal_px=1.0).radius(angle)
    start = replace(fit.state, camera=prior.start(float(focal)))
    return solve_joint(start, voters, replace(fit.problem.setting, prior=prior))


def _peaks(found: list[Directions]) -> list[int]:
    """Indices of trials whose score no neighbour beats, best first; trials without a direction never."""
    scores = np.array([item.score for item in found])
    padded = np.concatenate([[-np.inf], scores, [-np.inf]])
    peaks = np.flatnonzero((scores >= padded[:-2]) & (scores >= padded[2:]) & (scores > 0))
    return sorted((int(index) for index in peaks), key=lambda index: -scores[index])


def _most_probable(fits: list[JointFit], tracks: TrackSet, margin: float = 0.0) -> JointFit:
    """Choose the solution that makes the tracks most probable; the first unless it is beaten by a margin."""
    scale = min(fit.scale for fit in fits)
    costs = [cost_at_scale(fit, tracks, scale) + (margin if index else 0.0) for index, fit in enumerate(fits)]
    return fits[int(np.argmin(costs))]


def _with_real_roads(fit: JointFit, support: list[np.ndarray], tracks: TrackSet, gate: GateOptions) -> JointFit:
    """Solve again with the one road that explains most vehicles when a second has too little behind it."""
    if all(is_road(mask, tracks, gate) for mask in support) and _apart(fit):
        return fit
    explained = fit.explained()
    counts = [len(np.unique(tracks.vehicles[explained & (fit.labels == road)])) for road in range(len(support))]
    direction = fit.state.directions[int(np.argmax(counts))]
    setting = fit.problem.setting
    alone = initial_state(setting.prior.start(fit.state.camera.focal_px),
                          Directions(direction[None], np.zeros(0, int), 0.0))
    return solve_joint(alone, tracks, setting)


def _with_further_roads(fit: JointFit, tracks: TrackSet, gate: GateOptions) -> JointFit:
    """Add roads in the same plane as long as tracks that follow none agree on one."""
    while 2 <= len(fit.state.angles_rad) < MOST_ROADS:
        angle = _further_angle(fit, tracks)
        if angle is None:
            return fit
        wider = solve_joint(replace(fit.state, angles_rad=np.append(fit.state.angles_rad, angle)), tracks,
                            fit.problem.setting, refine=True)
        if not all(is_road(mask, tracks, gate) for mask in road_support(wider, tracks)):
            return fit
        fit = wider
    return fit


def _further_angle(fit: JointFit, tracks: TrackSet) -> float | None:
    """Angle in the plane on which most vehicles agree whose tracks follow no road yet, None where two do not."""
    rays = rays_of(fit.state.camera, tracks.pixels)
    normals, own, _ = fit_circles(rays, tracks.weights)
    left = (fit.labels < 0) & (own < 1.0)
    along = np.cross(normals[left], fit.state.rotation[:, 2]) @ fit.state.rotation
    angles = np.arctan2(along[:, 1], along[:, 0])
    turned = np.abs(np.sin(angles[:, None] - fit.state.angles_rad)).min(axis=1, initial=1.0)
    away = turned > np.sin(np.radians(APART_DEG))
    angles, vehicles = angles[away], tracks.vehicles[left][away]
    agree = np.abs(np.sin(angles[:, None] - angles)) < np.sin(np.radians(ON_ROAD_DEG))
    counts = np.array([len(np.unique(vehicles[row])) for row in agree])
    return float(angles[np.argmax(counts)]) if counts.max(initial=0) > 1 else None


def _with_right_angle(fit: JointFit, tracks: TrackSet, options: JointOptions) -> tuple[JointFit, str | None]:
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


def _with_what_can_be_told(fit: JointFit, tracks: TrackSet) -> tuple[JointFit, tuple[str, ...]]:
    """Measure how a vehicle's tracks correlate, set k2 free if asked for, hold what the evidence cannot tell."""
    setting = replace(fit.problem.setting, vehicle_correlation=fit.vehicle_correlation)
    fit = solve_joint(fit.state, tracks, setting, refine=True)
    if setting.prior.family == 'equidistant' and setting.prior.sigma[3] > 0 and len(fit.state.angles_rad) > 1:
        bent = solve_joint(fit.state, tracks, replace(setting, prior=setting.prior.with_k2()), refine=True)
        if cost_at_scale(bent, tracks, fit.scale) < cost_at_scale(fit, tracks, fit.scale) - ASKED_FOR:
            fit, setting = bent, bent.problem.setting
    held = _untold(fit)
    if not held:
        return fit, ()
    at_prior = setting.prior.start(fit.state.camera.focal_px)
    camera = fit.state.camera
    for name in held:
        camera = _restored(camera, at_prior, name)
    solved = solve_joint(replace(fit.state, camera=camera), tracks,
                         replace(setting, prior=setting.prior.holding(held)), refine=True)
    return judged_with(solved, tracks, setting), held


def _untold(fit: JointFit) -> tuple[str, ...]:
    """Names of the lens's parameters that the evidence alone leaves wider than their prior."""
    prior = fit.problem.setting.prior
    _, known = fit.problem.prior_gradient(fit.state.camera)
    left = told_by_evidence(fit.information, known)
    names = [PARAMETERS[parameter] for parameter in prior.free]
    return tuple(name for name, sigma, is_known in zip(names, left, known, strict=False) if is_known and sigma > 1.0)


def _restored(camera: Camera, prior: Camera, name: str) -> Camera:
    """Return the camera with one parameter at the prior's value."""
    (cx, cy), (k1, k2, *rest) = camera.principal_point_px, camera.k
    values = {
        'focal length': {'focal_px': prior.focal_px},
        'principal point x': {'principal_point_px': (prior.principal_point_px[0], cy)},
        'principal point y': {'principal_point_px': (cx, prior.principal_point_px[1])},
        'k1': {'k': (prior.k[0], k2, *rest)}, 'k2': {'k': (k1, prior.k[1], *rest)}}
    return replace(camera, **values[name])


def _doubted(fit: JointFit, angle: str | None, held: tuple[str, ...], across: str, tracks: TrackSet,
             gate: GateOptions) -> Roads | Reason:
    """Return the roads, or why the halves of the evidence disagree; doubts about the plane only take it away.

    `across` counts the tracks on a second road for the one who waits for them.
    """
    halves = halves_doubt(fit, tracks, gate)
    if isinstance(halves, Reason):
        return halves
    support = road_support(fit, tracks)
    assumptions = lens_assumptions(fit, held)
    if angle is None:
        tracks_seen = int(fit.explained().sum())
        return Roads(fit, support, assumptions, (halves,), Reason(
            'one_direction', f'too little traffic across the main road yet: {across}; {tracks_seen} follow one road, '
            'and rotation about it is free', 'wait for traffic across the main road'))
    checks = () if fit.crossing_held else (angle,)
    return Roads(fit, support, (*assumptions, angle) if fit.crossing_held else assumptions, (*checks, halves),
                 plane_doubt(fit, tracks, gate))


def lens_assumptions(fit: JointFit, held: tuple[str, ...]) -> tuple[str, ...]:
    """Say in words what was taken for granted of the lens."""
    prior = fit.problem.setting.prior
    if prior.family == 'known':
        return ('the lens is as given: only the pose was solved',)
    words = {'equidistant': 'lens near equidistant: k1 = 0', 'distortion_free': 'lens free of distortion: k1 = 1/3',
             'kannala_brandt': 'lens between equidistant and free of distortion: k1 = 1/6'}
    told = [f'{words[prior.family]} +- {prior.sigma[3]:.3g}']
    point = prior.sigma[1]
    told.append('principal point at the image centre' + (f' +- {point:.0f} px' if point > 0 else ''))
    if prior.focal_known:
        sigma = prior.sigma[0] * prior.centre.focal_px
        spread = f' +- {sigma:g} px' if sigma > 0 else ''
        told.append(f'focal length {prior.centre.focal_px:g} px{spread} (given)')
    return (*told, *(f'{name} held there: the traffic cannot determine it' for name in held))
