"""Test of a given lens by the traffic.

A file of another resolution, mode, zoom or camera bends straight paths and tilts the plane, while nothing else shows
it. So parameters of the given lens are released, a few at a time, and have to stay where they are; and where the given
lens does not give everything, the traffic alone has to agree with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.linalg import norm

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.lens_prior import LOOSE_PRINCIPAL_POINT_SIGMA_FRACTION
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.given_curve import (
    FOCAL_AND_K1,
    LENS_TOLERANCE,
    compare_curve,
    curve_contradiction,
    steps_with_curve,
)
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.released_lens import ReleasedLens, released_lens, step_with_focal_length
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import check
from autocalib_ros.results.verification_table import VerificationRow, verified

CONTRADICTION_SIGMAS, DOUBT_SIGMAS = 3.0, 2.0
"""A lens that differs by more standard deviations from what the traffic asks for is refused (0.3 % of right ones), or
believed less (5 %)."""
MAX_UNSEEN = 0.01
"""Share of the tracked points, some of which are wrong, that may lie where the lens images nothing."""
TRAFFIC_RADIUS_QUANTILE = 0.75
"""Quantile of the distances of tracked points from the principal point at which the angles of two lenses are compared:
lens curvature shows in the outer half of the traffic, and few points lie farther out."""
MAX_TESTING_SIGMA = 0.033
"""Largest standard deviation of the focal length by the traffic that tests a lens: one that is 10 % off, as of another
mode or camera, is then noticed at three of them."""


def check_view(lens: Camera, points_px: np.ndarray) -> Reason | None:
    """Refuse a lens whose principal point lies outside the image, or that does not image what was tracked (n, 2)."""
    (x, y), width, height = lens.principal_point_px, lens.width, lens.height
    if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
        return reason('given_lens', 'outside', x_px=x, y_px=y, width=width, height=height)
    unseen = 1.0 - float(lens.unproject(points_px)[1].mean()) if len(points_px) else 0.0
    if unseen <= MAX_UNSEEN:
        return None
    radius_px = float(lens.radius(np.array([lens.max_angle_rad]))[0])
    return reason('given_lens', 'unseen', radius_px=radius_px, unseen=unseen, limit=MAX_UNSEEN)


def verify_given_lens(
    lens: Camera, found: Solution | Reason, tracks: TrackSet, solve_free: Callable[[], Solution | Reason]
) -> Solution | Reason:
    """Return what was found with a given lens, or a refusal if the traffic contradicts the lens.

    `solve_free` solves without the given lens.
    """
    if isinstance(found, Solution):
        tested = _test_by_release(lens, found, tracks)
        if isinstance(tested, Reason):
            return _in_words_of(tested, lens, solve_free(), tracks)
        release, row = tested
        if row is not None:
            found = found.compared(row)
        found = found.compared(verified('given_lens_sigma', release.fit.focal_sigma, MAX_TESTING_SIGMA))
        curve = released_lens(lens, found, tracks, FOCAL_AND_K1)
        compared = compare_curve(lens, curve)
        if isinstance(compared, Reason):
            return _in_words_of(compared, lens, solve_free(), tracks)
        step, *spread = steps_with_curve(found, curve)
        for each in (max(step, step_with_focal_length(found, release), key=norm), *spread):
            found = found.covering(each)
        if compared is not None:
            found = found.compared(compared)
        if found.full:
            return found if row is None or row.passed else _doubted(found, release)
    free = solve_free()
    if isinstance(free, Reason):
        return found
    contradiction = _contradiction_of_angles(lens, free, tracks)
    if contradiction is None and isinstance(found, Reason) and _points_differ(lens, free):
        contradiction = _point_contradiction(lens, free.fit)
    return contradiction or found


def _test_by_release(
    lens: Camera, found: Solution, tracks: TrackSet
) -> Reason | tuple[ReleasedLens, VerificationRow | None]:
    """Return why the traffic contradicts the lens, else the release of its focal length and the comparison of both.

    The comparison fails where the lens is doubtful; None if the traffic gives no focal length.
    """
    loose = LOOSE_PRINCIPAL_POINT_SIGMA_FRACTION * lens.width
    focal = released_lens(lens, found, tracks, [np.inf, 0.0, 0.0, 0.0, 0.0, 0.0])
    off, sigmas = focal.focal_change
    if abs(off) > LENS_TOLERANCE and sigmas > CONTRADICTION_SIGMAS:
        sigma_px = focal.fit.focal_sigma * focal.camera.focal_px
        return _focal_contradiction(lens, focal.camera.focal_px, sigma_px)
    row = None
    if sigmas > 0:
        row = verified('given_lens', abs(off), max(DOUBT_SIGMAS * abs(off) / sigmas, LENS_TOLERANCE))
    point = released_lens(lens, found, tracks, [0.0, loose, loose * lens.pixel_aspect, 0.0, 0.0, 0.0])
    change, sigmas = point.change(lambda camera: np.array(camera.principal_point_px))
    if np.hypot(*change) > LENS_TOLERANCE * lens.width and sigmas > CONTRADICTION_SIGMAS:
        return _point_contradiction(lens, point.fit)
    shape = released_lens(lens, found, tracks, [0.0, 0.0, 0.0, 0.0, 0.0, np.inf])
    change, sigmas = shape.change(lambda camera: np.array([np.log(camera.pixel_aspect)]))
    if abs(change[0]) > LENS_TOLERANCE and sigmas > CONTRADICTION_SIGMAS:
        numbers = {'aspect': lens.pixel_aspect, 'traffic_aspect': shape.camera.pixel_aspect}
        sigma = abs(change[0]) / sigmas * shape.camera.pixel_aspect
        return reason('given_lens', 'pixel_aspect', **numbers, sigma=sigma)
    return focal, row


def _focal_contradiction(lens: Camera, traffic_px: float, sigma_px: float) -> Reason:
    return reason('given_lens', given_px=lens.focal_px, traffic_px=traffic_px, sigma_px=sigma_px)


def _in_words_of(contradiction: Reason, lens: Camera, free: Solution | Reason, tracks: TrackSet) -> Reason:
    """Return a contradiction with the numbers of the traffic without the lens, which are not tied to it."""
    if isinstance(free, Reason):
        return contradiction
    camera = free.fit.state.camera
    if abs(np.log(lens.focal_px / camera.focal_px)) > LENS_TOLERANCE:
        if contradiction.values.get('cause') == 'focal_and_k1':
            return curve_contradiction(lens, free.fit)
        return _focal_contradiction(lens, camera.focal_px, free.fit.focal_sigma * camera.focal_px)
    if np.hypot(*np.subtract(lens.principal_point_px, camera.principal_point_px)) > LENS_TOLERANCE * lens.width:
        return _point_contradiction(lens, free.fit)
    return _contradiction_of_angles(lens, free, tracks) or contradiction


def _point_contradiction(lens: Camera, fit: Adjustment) -> Reason:
    (x, y), (traffic_x, traffic_y) = lens.principal_point_px, fit.state.camera.principal_point_px
    spread_px = fit.sigma(lambda state: np.array(state.camera.principal_point_px))
    return reason(
        'given_lens',
        'principal_point',
        x_px=x,
        y_px=y,
        traffic_x_px=traffic_x,
        traffic_y_px=traffic_y,
        sigma_px=np.hypot(*spread_px),
    )


def _points_differ(lens: Camera, free: Solution) -> bool:
    """Whether the principal point of the lens contradicts that of the traffic without it."""
    x_sigma, y_sigma = free.fit.sigma(lambda state: np.array(state.camera.principal_point_px))
    distance = np.hypot(*np.subtract(lens.principal_point_px, free.fit.state.camera.principal_point_px))
    return bool(distance > max(CONTRADICTION_SIGMAS * np.hypot(x_sigma, y_sigma), LENS_TOLERANCE * lens.width))


def _contradiction_of_angles(lens: Camera, free: Solution, tracks: TrackSet) -> Reason | None:
    """Compare the angles from the axis, at the radius of the traffic, of the given lens and of the traffic's own."""
    radius = np.quantile(
        np.hypot(*lens.offsets(tracks.pixels.reshape(-1, 2)).T), TRAFFIC_RADIUS_QUANTILE, keepdims=True
    )

    def log_angle(state: AdjustmentState) -> np.ndarray:
        return np.log(np.maximum(state.camera.angle(radius)[0], 1e-9))

    given, measured = lens.angle(radius)[0], free.fit.state.camera.angle(radius)[0]
    change, sigma = abs(float(np.log(given / measured)[0])), float(free.fit.sigma(log_angle)[0])
    if not change > max(CONTRADICTION_SIGMAS * sigma, LENS_TOLERANCE):
        return None
    focal_px = free.fit.state.camera.focal_px
    if abs(np.log(lens.focal_px / focal_px)) > LENS_TOLERANCE:
        return _focal_contradiction(lens, focal_px, free.fit.focal_sigma * focal_px)
    return reason(
        'given_lens',
        'angle',
        radius_px=radius[0],
        given_deg=np.degrees(given[0]),
        traffic_deg=np.degrees(measured[0]),
        sigma_deg=np.degrees(measured[0] * sigma),
    )


def _doubted(found: Solution, doubt: ReleasedLens) -> Solution:
    """Lower the grade of a solution, and say why."""
    focal_px = doubt.camera.focal_px
    statement = check(
        'given_lens', given_px=doubt.given.focal_px, traffic_px=focal_px, sigma_px=doubt.fit.focal_sigma * focal_px
    )
    return replace(found, reduced=True, checks=(*found.checks, statement))
