"""The robust method: from traffic to a lens and a ground plane that have been doubted in every way we know."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.config import GateOptions, JointOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import (
    UNMODELLED_FOCAL,
    JointFit,
    road_support,
    solve_joint,
    with_bodies,
)
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior, known_lens, lens_priors
from autocalib_ros.estimation.adjustment.model_selection import noise_cost
from autocalib_ros.estimation.adjustment.noise_model import USUAL_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import Setting
from autocalib_ros.estimation.markings.markings_solution import NO_MARKINGS, fit_to_markings, sharpened, with_lens_known
from autocalib_ros.estimation.observations.track_set import TrackSet, evenly
from autocalib_ros.estimation.observations.two_frame_windows import Instants, Windows, find_windows
from autocalib_ros.estimation.people.pedestrians import people
from autocalib_ros.estimation.straight.initialisation import agreed, in_likeliest_family
from autocalib_ros.estimation.straight.roads import (
    main_road,
    with_further_roads,
    with_real_roads,
    with_right_angle,
    with_second_road,
)
from autocalib_ros.estimation.turning.lane_changes import by_lane_changes
from autocalib_ros.estimation.turning.turning_traffic import (
    from_turning,
    one_centre_doubt,
    over_lives,
    with_lives_apart,
    with_sliding,
    with_turning,
)
from autocalib_ros.estimation.vehicle_edges.transverse_edges import SquareVehicles, square_vehicles
from autocalib_ros.estimation.verification.consistency import differences
from autocalib_ros.estimation.verification.gates import halves_doubt, lens_doubt, plane_doubt, traffic_doubt
from autocalib_ros.estimation.verification.ground_normal import AGREE_SIGMAS, LevelCamera, Plane, agreement
from autocalib_ros.estimation.verification.identifiability import (
    lens_assumptions,
    with_k2_if_asked_for,
    with_what_can_be_told,
)
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import undirected_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Reason

NEARLY_LEVEL_DEG = 5.0
"""Roll up to which walking can be told from driving as if there were none."""
AGREE_DEG = 1.5
"""Two planes that differ by less agree: it is within what the program promises."""
CONFIRMS_DEG = 4.5
"""Traffic that tells the plane, or its road, no better confirms nothing: standard deviation, degrees."""
VOTERS = 200
"""Tracks, evenly out of all, from which the starts are made and compared; the solution then uses every track."""


@dataclass(frozen=True)
class Solution:
    """A lens, the plane and its roads, with the reason why there is no ground plane where there is none."""

    fit: JointFit
    plane: Plane
    along: np.ndarray
    """Unit vector (3,), camera frame, along the road of most vehicles."""
    flow: TrackSet
    """Tracks that follow that road straight; none where no road is straight."""
    assumptions: tuple[str, ...]
    checks: tuple[str, ...]
    no_plane: Reason | None
    reduced: bool = False
    """Whether the plane rests on less than roads that cross or vehicles that turn, though `plane` assumes nothing."""
    by_lines: bool = False
    """Whether lens and plane are those of the lines on the road."""

    @property
    def assumed(self) -> bool:
        """Whether the plane rests on what is named among the assumptions."""
        return self.plane.assumed is not None or self.reduced

    @property
    def full(self) -> bool:
        """Whether roads that cross or vehicles that turn give all of it."""
        return self.no_plane is None and not self.assumed


@dataclass(frozen=True)
class _Traffic:
    """What every stage of a solution is given."""

    tracks: TrackSet
    windows: Windows
    instants: Instants
    priors: list[LensPrior]
    gate: GateOptions
    evidence: Evidence
    generator: np.random.Generator

    @property
    def voters(self) -> TrackSet:
        return self.tracks.subset(evenly(len(self.tracks), VOTERS))


def find_solution(evidence: Evidence, tracks: TrackSet, options: JointOptions, gate: GateOptions,
                  generator: np.random.Generator, *, height_m: float = 0.0,
                  lens: Camera | None = None) -> Solution | Reason:
    """Estimate lens, plane and roads from evidence and the tracks chosen of it; a reason when they cannot be trusted.

    Straight traffic is tried first, with what turns to complete it; where that gives no plane, or one that rests on
    an assumption, the traffic that turns alone, and then the lines on the road. A known `lens` is kept, and only the
    pose is found.
    """
    if len(tracks) < gate.min_tracks:
        return Reason('too_few_tracks', f'{len(tracks)} tracks of the {gate.min_tracks} needed are long enough',
                      'wait for more traffic, or record for longer')
    priors = [known_lens(lens)] if lens is not None else lens_priors(evidence.image_size, options)
    crossing = None if options.crossing_deg is None else float(np.radians(options.crossing_deg))
    instants = Instants(evidence)
    traffic = _Traffic(tracks, find_windows(evidence, instants), instants, priors, gate, evidence, generator)
    setting = Setting(priors[0], options, height_m, crossing)
    found = _from_traffic(traffic, setting)
    if not options.road_markings:
        return found
    if isinstance(found, Solution) and found.full:
        return _sharpened(found, traffic)
    painted = _from_markings(traffic, setting)
    if _tells_more(painted, found):
        return painted
    told_more = isinstance(painted, Reason) and painted.code != NO_MARKINGS
    return _also(found, painted.message) if told_more else found


def _also(found: Solution | Reason, words: str) -> Solution | Reason:
    """Add to what is missing, if anything, what else was tried."""
    if isinstance(found, Reason):
        return replace(found, message=f'{found.message}; {words}')
    return replace(found, no_plane=found.no_plane and replace(found.no_plane,
                                                              message=f'{found.no_plane.message}; {words}'))


def _from_traffic(traffic: _Traffic, setting: Setting) -> Solution | Reason:
    """Solve from straight traffic; where that leaves anything open, from the traffic that turns."""
    straight = _from_straight(traffic, setting)
    if isinstance(straight, Solution) and straight.full:
        return straight
    turned = from_turning(traffic.tracks, traffic.windows, setting)
    if turned is None:
        return straight
    fit, tracks = _with_noise(with_further_roads(turned, traffic.tracks, traffic.gate), traffic)
    turning = _completed(fit, tracks, '', traffic, turned=True)
    return turning if _tells_more(turning, straight) else straight


def _tells_more(other: Solution | Reason, found: Solution | Reason) -> bool:
    """Whether another solution says more than the one that was found before."""
    if isinstance(other, Reason) or isinstance(found, Reason):
        return isinstance(other, Solution)
    if other.no_plane or found.no_plane:
        return other.no_plane is None
    return other.plane.worst_sigma_deg < found.plane.worst_sigma_deg


def _from_markings(traffic: _Traffic, setting: Setting) -> Solution | Reason:
    """Solve from the lines on the road; what the traffic tells, seen by the lens found, has to agree."""
    priors = [_for_lines(prior, setting.options) for prior in traffic.priors]
    painted = fit_to_markings(traffic.evidence, traffic.tracks, priors, setting, traffic.gate)
    if isinstance(painted, Reason):
        return painted
    fit, assumed = painted
    known = known_lens(fit.state.camera)
    straight = _from_straight(replace(traffic, priors=[known]), replace(setting, prior=known))
    turned = from_turning(traffic.tracks, traffic.windows, replace(setting, prior=known))
    checks = agreed_by(fit, [*([] if isinstance(straight, Reason) else [straight.plane]),
                             *([] if turned is None else [Plane.of(turned, traffic.tracks)])])
    if isinstance(checks, Reason):
        return checks
    along, flow = main_road(fit, traffic.tracks)
    plane = Plane.of(fit, traffic.tracks)
    return Solution(fit, plane, along, flow, (*lens_assumptions(fit, ()), assumed), checks,
                    plane_doubt(plane, traffic.gate, assumed=True), reduced=True, by_lines=True)


def _for_lines(prior: LensPrior, options: JointOptions) -> LensPrior:
    """Return the prior for lines on the road, which tell the principal point, unless that is asserted."""
    return prior if options.principal_point_sigma_px >= 0 else prior.loosened()


def _sharpened(found: Solution, traffic: _Traffic) -> Solution:
    """Return a solution with the lens and plane of the lines on the road, where both agree and the lines are surer."""
    setting = found.fit.problem.setting
    prior = _for_lines(setting.prior, setting.options)
    painted = sharpened(found.fit, traffic.evidence, traffic.tracks, prior, traffic.gate)
    if isinstance(painted, Reason):
        return found
    fit, assumed = painted
    apart = differences(found.fit, fit)
    words = (f'lines on the road give a focal length {apart.focal:.1%} and a ground normal {apart.normal_deg:.1f} '
             'degrees from those of the traffic')
    plane = Plane.of(fit, traffic.tracks)
    if apart.beyond(AGREE_SIGMAS) or plane_doubt(plane, traffic.gate):
        return replace(found, checks=(*found.checks, f'{words}: not used'))
    one, other = ((max(solved.focal_sigma, UNMODELLED_FOCAL), told.worst_sigma_deg)
                  for solved, told in ((fit, plane), (found.fit, found.plane)))
    if one[0] * one[1] > other[0] * other[1]:
        return replace(found, checks=(*found.checks, words))
    along, flow = main_road(fit, traffic.tracks)
    return replace(found, fit=fit, plane=plane, along=along, flow=flow, checks=(*found.checks, words),
                   assumptions=(*lens_assumptions(fit, ()), assumed), by_lines=True)


def agreed_by(painted: JointFit, told: list[Plane]) -> tuple[str, ...] | Reason:
    """Say how the lines on the road agree with planes that the traffic tells, seen by the lens of the lines.

    Each that is known well enough has to agree, and one has to be.
    """
    painted, checks, best_deg = with_lens_known(painted), [], np.inf
    for plane in told:
        apart_deg, own_deg, other_deg, what = _apart(painted, plane)
        best_deg, sigma_deg = min(best_deg, own_deg), float(np.hypot(own_deg, other_deg))
        words = f'{what} are {apart_deg:.1f} degrees apart, {sigma_deg:.1f} were expected'
        if own_deg <= CONFIRMS_DEG and apart_deg > max(AGREE_SIGMAS * sigma_deg, AGREE_DEG):
            return Reason('markings_contradicted', words,
                          'wait for more traffic; if the markings are askew, set joint.road_markings to false')
        if own_deg <= CONFIRMS_DEG:
            checks.append(words)
    seen = f'tells the plane to {best_deg:.0f} degrees' if best_deg < 90.0 else 'tells nothing'
    return tuple(checks) if checks else Reason(
        'markings_unconfirmed', 'lines on the road give lens and plane, but nothing confirms them: with that lens the '
        f'traffic {seen}, {CONFIRMS_DEG:g} are needed', 'wait for more traffic, straight or turning')


def _apart(painted: JointFit, told: Plane) -> tuple[float, float, float, str]:
    """Angle of what the traffic tells from the lines, its own standard deviation, that of the lines, and its name."""
    if told.fit.plane_known:
        angle = undirected_deg(painted.state.rotation[:, 2], told.normal(told.fit.state))
        return (angle, told.worst_sigma_deg, Plane(painted, 1.0).worst_sigma_deg,
                'ground normals of the traffic and of the lines')
    road = told.fit.state.directions[0]
    angle = min(undirected_deg(axis, road) for axis in painted.state.directions)
    own, other = (float(np.degrees(np.linalg.norm(fit.sigma(lambda state: state.directions[0]))))
                  for fit in (told.fit, painted))
    return angle, own, other, 'the road of the traffic and the lines along it'


def _from_straight(traffic: _Traffic, setting: Setting) -> Solution | Reason:
    """Solve from the directions on which straight tracks agree."""
    tracks, gate = traffic.tracks, traffic.gate
    found = agreed(traffic.voters, setting, traffic.generator)
    if found is None:
        return Reason('no_direction', f'{len(tracks)} tracks agree on no common direction',
                      'straight traffic is needed: wait for it, or turn the camera towards a straight road')
    best, contrast = found
    fit = solve_joint(best.state, tracks, best.problem.setting)
    support = road_support(fit, tracks)
    second = sorted(int(mask.sum()) for mask in support)[:-1]
    across = f'{min([gate.min_tracks_per_road, *(second or [0])])} of {gate.min_tracks_per_road} tracks'
    fit, tracks = _with_noise(with_real_roads(fit, support, tracks, gate), traffic)
    fit = with_further_roads(with_second_road(fit, tracks, gate), tracks, gate)
    return traffic_doubt(fit, contrast, tracks) or _completed(fit, tracks, across, traffic)


def _with_noise(fit: JointFit, traffic: _Traffic) -> tuple[JointFit, TrackSet]:
    """Choose the family of the lens, and whether points drift; then tracks of one body are known as such."""
    tracks = traffic.tracks
    fit = in_likeliest_family(fit, traffic.priors[1:], traffic.voters, tracks)
    if noise_cost(fit, tracks, drifting=True) < noise_cost(fit, tracks, drifting=False):
        tracks = with_bodies(fit, tracks) if fit.plane_known else tracks
        fit = solve_joint(fit.state, tracks, replace(fit.problem.setting, drifting=True), refine=True)
    return fit, tracks


def _completed(fit: JointFit, tracks: TrackSet, across: str, traffic: _Traffic, *,
               turned: bool = False) -> Solution | Reason:
    """Refine a solution with all that the traffic tells, and doubt it.

    `across` counts the tracks on a second road for the one who waits for them; `turned` is a solution that started
    from traffic that turns.
    """
    gate, options = traffic.gate, fit.problem.setting.options
    if fit.plane_known:
        fit = with_turning(fit, tracks, traffic.windows) or fit
    fit = with_further_roads(fit, tracks, gate)
    fit, angle = with_right_angle(fit, tracks, options)
    fit = with_k2_if_asked_for(fit, tracks)
    fit, by_lives = over_lives(fit, tracks, traffic.windows, traffic.instants)
    fit, held = with_what_can_be_told(fit, tracks)
    doubt = _lens_doubt(fit, tracks, traffic, turned=turned) or (
        one_centre_doubt(fit, traffic.windows) if len(fit.state.angles_rad) < 2 else None)
    if doubt:
        return doubt
    halves = halves_doubt(fit, tracks, gate)
    if isinstance(halves, Reason):
        return halves
    fit = with_lives_apart(with_sliding(fit, traffic.windows), by_lives)
    along, flow = main_road(fit, tracks)
    assumptions = lens_assumptions(fit, held)
    if fit.plane_known:
        checks = (*_angle_and_turning(fit, angle), halves)
        plane = Plane.of(fit, tracks)
        return Solution(fit, plane, along, flow, (*assumptions, angle) if fit.crossing_held and angle else assumptions,
                        checks, plane_doubt(plane, gate))
    return _with_lane_changes(_about_one_road(fit, tracks, traffic, assumptions, halves, across), tracks, traffic)


def _about_one_road(fit: JointFit, tracks: TrackSet, traffic: _Traffic, assumptions: tuple[str, ...], halves: str,
                    across: str) -> Solution:
    """Complete a solution of one road, about which the plane is free, by what may be assumed."""
    gate, options = traffic.gate, fit.problem.setting.options
    along, flow = main_road(fit, tracks)
    assumed, checks = _assumed(fit, tracks, traffic)
    plane, checks = Plane.of(fit, tracks, None if isinstance(assumed, Reason) else assumed), (halves, *checks)
    if not isinstance(assumed, Reason | None):
        assumptions = (*assumptions, f'ground plane by one road and {assumed.words}')
        return Solution(fit, plane, along, flow, assumptions, checks, plane_doubt(plane, gate))
    return Solution(fit, plane, along, flow, assumptions, checks, assumed or Reason(
        'one_direction', f'too little traffic across the main road yet: {across}; {int(fit.explained().sum())} '
        'follow one road, and rotation about it is free'
        + (': edges of vehicles do not tell it either' if options.transverse_edges else ''),
        'wait for traffic across the main road, or that turns; or allow joint.roll_prior_deg'))


def _with_lane_changes(found: Solution, tracks: TrackSet, traffic: _Traffic) -> Solution:
    """Return a solution of one road with the plane that vehicles tell which leave their lanes, where they tell more."""
    changing = by_lane_changes(found.fit, tracks, traffic.windows)
    if changing is None:
        return found
    fit, vehicles = changing
    plane, road = Plane.of(fit, tracks), fit.state.directions[0]
    if plane_doubt(plane, traffic.gate):
        return found
    normal = plane.normal(fit.state)
    about_deg = float(np.degrees(fit.sigma(lambda state: np.array([np.cross(normal, state.rotation[:, 2]) @ road]))[0]))
    words, checks = f'{vehicles} vehicles that change lanes: +- {about_deg:.1f} degrees about the road', found.checks
    if found.no_plane is None:
        apart_deg = undirected_deg(normal, found.plane.normal(found.fit.state))
        sigma_deg = float(np.hypot(plane.worst_sigma_deg, found.plane.worst_sigma_deg))
        if apart_deg > max(AGREE_SIGMAS * sigma_deg, AGREE_DEG):
            return replace(found, no_plane=Reason(
                'plane_uncertain', f'{found.plane.assumed.words}, and {words}, are {apart_deg:.1f} degrees apart',
                'wait for more traffic, above all across the road or turning'))
        checks = (*checks, f'{words}, {apart_deg:.1f} degrees from what is assumed')
        if found.plane.worst_sigma_deg <= plane.worst_sigma_deg:
            return replace(found, checks=checks)
    along, flow = main_road(fit, tracks)
    return Solution(fit, plane, along, flow, (*lens_assumptions(fit, ()), f'ground plane by one road and {words}'),
                    checks, None, reduced=True)


def _lens_doubt(fit: JointFit, tracks: TrackSet, traffic: _Traffic, *, turned: bool) -> Reason | None:
    """Doubt the lens; where too few seem to keep to the road, without those who walk beside and over it."""
    evidence, gate = traffic.evidence, traffic.gate
    doubt = lens_doubt(fit, tracks, evidence, gate, turned=turned)
    if doubt is None or doubt.code != 'turning_traffic':
        return doubt
    return lens_doubt(fit, tracks, evidence, gate, turned=turned, driving=_driving(fit, tracks, evidence))


def _driving(fit: JointFit, tracks: TrackSet, evidence: Evidence) -> np.ndarray:
    """Mask (tracks,) of those not of people; where one road leaves the plane open, a level camera is plane enough."""
    level = None if fit.plane_known else LevelCamera(NEARLY_LEVEL_DEG)
    if level is not None and not level.tells(fit.state):
        return np.ones(len(tracks), bool)
    camera, normal = Plane.of(fit, tracks, level).here
    told = people(evidence, camera, normal, fit.problem.setting.height_m or USUAL_HEIGHT_M)
    return ~np.isin(evidence.track_vehicles[tracks.indices], told)


def _assumed(fit: JointFit, tracks: TrackSet,
             traffic: _Traffic) -> tuple[LevelCamera | SquareVehicles | Reason | None, tuple[str, ...]]:
    """What one may assume of the direction across a lone road, a reason where that contradicts itself; and checks."""
    options = fit.problem.setting.options
    level = LevelCamera(options.roll_prior_deg) if options.roll_prior_deg > 0 else None
    square = square_vehicles(traffic.evidence, fit, tracks, traffic.generator) if options.transverse_edges else None
    if level is None or square is None:
        return level or square, ()
    joined, apart_deg = agreement(level, square, fit.state)
    if joined is None:
        return Reason(
            'plane_uncertain', f'edges of vehicles and a level camera disagree by {apart_deg:.1f} degrees about the '
            'road', 'set joint.roll_prior_deg to 0 to trust the edges, or to what the camera may be rolled'), ()
    return joined, ((f'edges of vehicles and a level camera differ by {apart_deg:.1f} degrees about the road',)
                    if apart_deg >= 0 else ())


def _angle_and_turning(fit: JointFit, angle: str | None) -> tuple[str, ...]:
    bodies = len(np.unique(fit.problem.owners[fit.problem.kind > 0]))
    turning = (f'{bodies} vehicles that turn move as rigid bodies in the plane',) if bodies else ()
    return turning if angle is None or fit.crossing_held else (angle, *turning)
