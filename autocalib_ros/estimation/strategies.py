"""The strategies of the estimator: straight traffic, turning traffic, and lane markings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust, road_support
from autocalib_ros.estimation.adjustment.lens_prior import PRINCIPAL_POINT_SIGMA_FRACTION, LensPrior, known_lens
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig
from autocalib_ros.estimation.markings.markings_solution import (
    condition_on_lens,
    fit_to_markings,
    refine_with_markings,
)
from autocalib_ros.estimation.one_road import PLANE_TOLERANCE_DEG, CrossTraffic
from autocalib_ros.estimation.refinement import refine_and_verify, select_noise_model
from autocalib_ros.estimation.single_road.road_solution import SingleRoad, solve_single_road
from autocalib_ros.estimation.solution import SHARP_FOCAL_SIGMA, Observations, Solution, append_reason, is_better
from autocalib_ros.estimation.solution_rows import MAX_PRINCIPAL_POINT_SIGMAS
from autocalib_ros.estimation.straight.initialisation import solve_from_consensus
from autocalib_ros.estimation.straight.roads import (
    add_further_roads,
    add_second_road,
    drop_unsupported_roads,
    main_road,
)
from autocalib_ros.estimation.turning.turning_traffic import fit_turning_traffic
from autocalib_ros.estimation.verification.gates import check_below_horizon, check_plane, check_straight_traffic
from autocalib_ros.estimation.verification.ground_normal import AGREEMENT_SIGMAS, PlaneEstimate
from autocalib_ros.estimation.verification.identifiability import lens_assumptions
from autocalib_ros.geometry.ground_plane import unsigned_angle_deg
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, assumption, check
from autocalib_ros.results.verification_table import VerificationRow, verified

MAX_CONFIRMING_SIGMA_DEG = 4.5
"""Traffic whose plane, or whose road, is less certain than this (one sigma) does not confirm lane markings."""


MAX_NEAR_FOCAL_SIGMA = 0.1
"""Relative standard deviation of the focal length of the traffic above which lane markings are not combined with it:
their search about it spans some 20 % to either side, two standard deviations."""
MIN_BOTH_RIGHT = 0.5
"""Probability that traffic and lane markings are both right, below which they contradict each other and the grade is
lowered."""


def estimate_from_straight_traffic(observations: Observations, config: AdjustmentConfig) -> Solution | Reason:
    """Estimate from the vanishing points of straight tracks: multi-start, adjustment, refinement, verification."""
    tracks, gate = observations.tracks, observations.gate
    subsample = observations.subsample
    initial = solve_from_consensus(subsample, config, observations.generator)
    if initial is None:
        return reason('no_direction', tracks=len(tracks))
    fit, contrast = initial
    if len(subsample) < len(tracks):
        fit = adjust(fit.state, tracks, fit.problem.config)
    support = road_support(fit, tracks)
    second = sorted(int(mask.sum()) for mask in support)[:-1]
    crossing = CrossTraffic(min([gate.min_tracks_per_road, *(second or [0])]), gate.min_tracks_per_road)
    fit, tracks = select_noise_model(drop_unsupported_roads(fit, support, tracks, gate), observations)
    fit = add_further_roads(add_second_road(fit, tracks, gate), tracks, gate)
    return check_straight_traffic(fit, contrast, tracks) or refine_and_verify(
        fit, tracks, observations, crossing=crossing
    )


def estimate_from_turning_traffic(observations: Observations, config: AdjustmentConfig) -> Solution | Reason | None:
    """Estimate from vehicles that turn; None if too few do."""
    turned = fit_turning_traffic(observations.tracks, observations.windows, config)
    if turned is None:
        return None
    fit, tracks = select_noise_model(add_further_roads(turned, observations.tracks, observations.gate), observations)
    return refine_and_verify(fit, tracks, observations, turned=True)


def estimate_from_single_road(observations: Observations, config: AdjustmentConfig) -> Solution | Reason:
    """Estimate from one straight road, its vehicles and scenery, and wide priors of field of view and roll."""
    tracks, prior = observations.tracks, config.prior
    if len(prior.free):
        aspect_sigma = float(np.hypot(prior.sigma[5], observations.unmeasured_aspect_sigma))
        prior = prior.with_pixel_aspect(prior.centre.pixel_aspect, aspect_sigma)

    def solve_under(lens: LensPrior) -> SingleRoad | Reason:
        setting = replace(config, prior=lens)
        return solve_single_road(observations.evidence, tracks, setting, observations.gate, observations.generator)

    found = solve_under(prior)
    if isinstance(found, Reason):
        return found
    if prior.focal_known and len(prior.free) and prior.sigma[0] > 0:
        found = found.compared_with_given(solve_under(prior.with_unknown_focal()), tracks)
    fit, plane = found.fit, PlaneEstimate.of(found.fit, tracks)
    above = check_below_horizon(plane.fraction_below_horizon)
    if above:
        return above
    return Solution(
        fit,
        plane,
        fit.state.directions[0],
        tracks.subset(fit.inliers() & (fit.labels == 0)),
        found.assumptions,
        found.checks,
        None,
        reduced=True,
        single_road=True,
        comparisons=found.rows,
    )


def with_single_road(found: Solution | Reason, single: Solution | Reason) -> Solution | Reason:
    """Return a solution of a single road, or what was found if that is more certain by other traffic than straight one.

    Straight traffic on one road shows how much the lens curves, and no focal length but for an assumed lens family: a
    solution by that assumption stands and falls with that of the wider family. Lane markings that take a told focal
    length for granted are replaced, too: a single road doubts it. Where both have a plane they are compared.
    """
    if isinstance(single, Reason):
        assumed = isinstance(found, Solution) and not found.fit.plane_known and len(found.fit.problem.config.prior.free)
        return single if assumed else append_reason(found, single, asks_less=True)
    if isinstance(found, Reason) or found.plane_refusal or found.rests_on_told_focal:
        return single
    difference_deg = unsigned_angle_deg(found.plane.normal(found.fit.state), single.plane.normal(single.fit.state))
    limit_deg = AGREEMENT_SIGMAS * float(np.hypot(found.plane.worst_sigma_deg, single.plane.worst_sigma_deg))
    better = single if not found.fit.plane_known or is_better(single, found) else found
    return better.compared(verified('single_road', difference_deg, limit_deg))


def estimate_from_lane_markings(observations: Observations, config: AdjustmentConfig) -> Solution | Reason:
    """Estimate from lane markings; the traffic, seen through the lens that they give, has to confirm the plane."""
    priors = [_prior_for_markings(prior) for prior in observations.priors]
    if config.options.principal_point_sigma_px < 0:
        # distortion shows the principal point; without it, it trades against focal length and tilt
        priors += [prior.with_loose_principal_point() for prior in priors if prior.family == 'equidistant']
    found = fit_to_markings(observations.evidence, observations.tracks, priors, config, observations.gate)
    if isinstance(found, Reason):
        return found
    fit = found.fit
    verification = verify_with_traffic(fit, _planes_of_traffic(fit, observations, config))
    if isinstance(verification, Reason):
        return verification
    checks, rows = verification
    along, flow = main_road(fit, observations.tracks)
    plane = PlaneEstimate.of(fit, observations.tracks)
    return Solution(
        fit,
        plane,
        along,
        flow,
        (*lens_assumptions(fit, ()), found.assumption),
        checks,
        check_plane(plane, observations.gate),
        reduced=True,
        from_markings=True,
        with_free_aspect=found.with_free_aspect,
        comparisons=rows,
    )


def _planes_of_traffic(fit: Adjustment, observations: Observations, config: AdjustmentConfig) -> list[PlaneEstimate]:
    """Planes that straight and turning traffic give through a lens that is taken as known."""
    known = known_lens(fit.state.camera)
    straight = estimate_from_straight_traffic(replace(observations, priors=[known]), replace(config, prior=known))
    turned = fit_turning_traffic(observations.tracks, observations.windows, replace(config, prior=known))
    planes = [] if isinstance(straight, Reason) else [straight.plane]
    return planes if turned is None else [*planes, PlaneEstimate.of(turned, observations.tracks)]


def sharpen_with_lane_markings(found: Solution, observations: Observations) -> Solution:
    """Return the solution combined with the lane markings; with a lower grade where they contradict each other."""
    combined = _combined_with_lane_markings(found, observations)
    return found if isinstance(combined, Reason) else combined


def complete_with_lane_markings(traffic: Solution, observations: Observations) -> Solution | Reason:
    """Complete a solution that is too uncertain by traffic alone with lane markings; a reason if they fail."""
    if not traffic.fit.focal_sigma <= MAX_NEAR_FOCAL_SIGMA:
        return traffic.lens_refusal or traffic
    combined = _combined_with_lane_markings(traffic, observations)
    if isinstance(combined, Reason):
        return combined
    uncertain = not combined.fit.focal_sigma <= observations.gate.max_sigma_focal_rel
    if traffic.lens_refusal and (uncertain or not combined.from_markings):
        return traffic.lens_refusal
    return replace(combined, lens_refusal=None, reduced=True)


def _combined_with_lane_markings(found: Solution, observations: Observations) -> Solution | Reason:
    traffic = found.fit
    sharper = refine_with_markings(
        traffic, observations.evidence, observations.tracks, traffic.problem.config.prior, observations.gate
    )
    if isinstance(sharper, Reason):
        return sharper
    focal = abs(float(np.log(traffic.state.camera.focal_px / sharper.markings.camera.focal_px)))
    normal_deg = unsigned_angle_deg(traffic.state.rotation[:, 2], sharper.markings.rotation[:, 2])
    row = verified('lane_markings', sharper.both_right, MIN_BOTH_RIGHT)
    found, contradicted = found.compared(row), not row.passed
    compared = check('lane_markings', focal=focal, normal_deg=normal_deg, used=not contradicted)
    plane = PlaneEstimate.of(sharper.fit, observations.tracks)
    if contradicted and not sharper.fit.focal_sigma <= SHARP_FOCAL_SIGMA:
        # lane markings that could not give the lens themselves lower the grade, but do not replace the traffic
        return replace(found, checks=(*found.checks, compared), reduced=True)
    along, flow = main_road(sharper.fit, observations.tracks)
    return replace(
        found,
        fit=sharper.fit,
        plane=plane,
        along=along,
        flow=flow,
        checks=(*found.checks, compared),
        assumptions=(*found.assumptions, sharper.assumption),
        plane_refusal=check_plane(plane, observations.gate),
        reduced=contradicted,
        from_markings=not contradicted,
        of_traffic=traffic,
    )


def _prior_for_markings(prior: LensPrior) -> LensPrior:
    """Return the prior for lane markings, with k2 free unless an option fixes the lens."""
    return prior.with_free_k2() if prior.sigma[3] > 0 and prior.sigma[4] <= 0 else prior


def verify_with_traffic(
    by_markings: Adjustment, planes: Iterable[PlaneEstimate]
) -> tuple[tuple[Statement, ...], tuple[VerificationRow, ...]] | Reason:
    """Check lane markings against planes from the traffic, seen through the lens of the markings.

    Each plane that is certain enough has to agree, and at least one has to be. Returns the comparisons in words, and as
    rows of the verification table.
    """
    by_markings, checks, rows, best_deg = condition_on_lens(by_markings), [], [], np.inf
    for plane in planes:
        difference_deg, own_deg, other_deg, what = _difference_from(by_markings, plane)
        best_deg, sigma_deg = min(best_deg, own_deg), float(np.hypot(own_deg, other_deg))
        if own_deg > MAX_CONFIRMING_SIGMA_DEG:
            continue
        row = verified(
            f'markings_and_traffic_{what}', difference_deg, max(AGREEMENT_SIGMAS * sigma_deg, PLANE_TOLERANCE_DEG)
        )
        if not row.passed:
            cause = 'road' if what == 'road' else ''
            return reason('markings_contradicted', cause, difference_deg=difference_deg, sigma_deg=sigma_deg)
        rows.append(row)
        checks.append(check(f'markings_and_traffic_{what}', difference_deg=difference_deg, sigma_deg=sigma_deg))
    if checks:
        return tuple(checks), tuple(rows)
    if best_deg >= 90.0:
        return reason('markings_unconfirmed', 'no_traffic')
    return reason('markings_unconfirmed', sigma_deg=best_deg, limit_deg=MAX_CONFIRMING_SIGMA_DEG)


def _difference_from(by_markings: Adjustment, plane: PlaneEstimate) -> tuple[float, float, float, str]:
    """Angle between traffic and markings, sigma of the traffic, sigma of the markings (degrees), and what differs."""
    if plane.fit.plane_known:
        angle = unsigned_angle_deg(by_markings.state.rotation[:, 2], plane.normal(plane.fit.state))
        return angle, plane.worst_sigma_deg, PlaneEstimate(by_markings, 1.0).worst_sigma_deg, 'normal'
    road = plane.fit.state.directions[0]
    angle = min(unsigned_angle_deg(axis, road) for axis in by_markings.state.directions)
    own, other = (
        float(np.degrees(np.linalg.norm(fit.sigma(lambda state: state.directions[0]))))
        for fit in (plane.fit, by_markings)
    )
    return angle, own, other, 'road'


def with_cut_picture(loose: Solution | Reason, centred: Solution | Reason) -> Solution | Reason:
    """Return the solution of a picture that was cut off, and say so; the centred one, which covers it, if that failed.

    Either has the grade of an assumption: by what the picture was cut off is taken from the traffic alone. Where a
    centred picture was refused, the traffic has to put the optical axis off its centre for sure.
    """
    if isinstance(loose, Reason) or not loose.by_traffic:
        return centred if isinstance(centred, Reason) else replace(centred, reduced=True)
    camera, prior = loose.fit.state.camera, loose.fit.problem.config.prior
    away = np.subtract(camera.principal_point_px, prior.centre.principal_point_px)
    sigmas = loose.fit.sigma(lambda state: np.array(state.camera.principal_point_px))
    expected = np.hypot(sigmas, PRINCIPAL_POINT_SIGMA_FRACTION * camera.width)
    if isinstance(centred, Reason) and not (np.abs(away) > MAX_PRINCIPAL_POINT_SIGMAS * expected).any():
        return centred
    statement = assumption(
        'cut_picture', right_px=away[0], down_px=away[1], sigma_px=sigmas[0], sigma_down_px=sigmas[1]
    )
    return replace(loose, reduced=True, assumptions=(*loose.assumptions, statement))
