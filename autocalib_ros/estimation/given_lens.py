"""Test of a given lens by the traffic.

A file of another resolution, mode, zoom or camera bends straight paths and tilts the plane, while nothing else shows
it. So parameters of the given lens are released, a few at a time, and have to stay where they are; and where the given
lens does not give everything, the traffic alone has to agree with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import LOOSE_PRINCIPAL_POINT_SIGMA_FRACTION, LensPrior
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.solution import Solution, same_change
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import check
from autocalib_ros.results.verification_table import VerificationRow, verified

CONTRADICTION_SIGMAS, DOUBT_SIGMAS = 3.0, 2.0
"""A lens that differs by more standard deviations from what the traffic asks for is refused (0.3 % of right ones), or
believed less (5 %)."""
LENS_TOLERANCE = 0.03
"""Difference that is always allowed, in log focal length, log pixel aspect, and widths of the image for the principal
point: the promised accuracy, as between two halves of the traffic."""
TRAFFIC_RADIUS_QUANTILE = 0.75
"""Quantile of the distances of tracked points from the principal point at which the angles of two lenses are compared:
lens curvature shows in the outer half of the traffic, and few points lie farther out."""
MAX_TESTING_SIGMA = 0.033
"""Largest standard deviation of the focal length by the traffic that tests a lens: one that is 10 % off, as of another
mode or camera, is then noticed at three of them."""


@dataclass(frozen=True)
class _Release:
    """The solution with some parameters of the given lens free."""

    given: Camera
    fit: Adjustment

    @property
    def camera(self) -> Camera:
        """The lens that the traffic asks for."""
        return self.fit.state.camera

    def change(self, function: Callable[[Camera], np.ndarray]) -> tuple[np.ndarray, float]:
        """Return the change (n,) of a function of the lens, and its length in standard deviations."""
        change = function(self.camera) - function(self.given)
        covariance = self.fit.covariance_of(lambda state: function(state.camera))
        if not np.isfinite(covariance).all():
            return change, 0.0
        # the smallest eigenvalues of a singular covariance are of a direction that is not free
        return change, float(np.sqrt(max(change @ np.linalg.pinv(covariance, rcond=1e-9) @ change, 0.0)))

    @cached_property
    def focal_change(self) -> tuple[float, float]:
        """Change of the log focal length, and its absolute value in standard deviations."""
        change, sigmas = self.change(lambda camera: np.array([np.log(camera.focal_px)]))
        return float(change[0]), sigmas


def check_principal_point(lens: Camera) -> Reason | None:
    """Refuse a lens whose principal point lies outside the image."""
    (x, y), width, height = lens.principal_point_px, lens.width, lens.height
    if -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5:
        return None
    return reason('given_lens', 'outside', x_px=x, y_px=y, width=width, height=height)


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
        found = _covering_difference(found, release)
        if found.full:
            return found if row is None or row.passed else _doubted(found, release)
    free = solve_free()
    if isinstance(free, Reason):
        return found
    contradiction = _contradiction_of_angles(lens, free, tracks)
    if contradiction is None and isinstance(found, Reason) and _points_differ(lens, free):
        contradiction = _point_contradiction(lens, free.fit)
    return contradiction or found


def _covering_difference(found: Solution, release: _Release) -> Solution:
    """Let the covariance of the plane cover that with the focal length of the traffic.

    A difference within the tolerance may be a fault of either, and the plane turns with it. What exceeds the error of
    the traffic is taken for the error of the lens (moment estimator of DerSimonian and Laird 1986, for one difference).
    """
    _, sigmas = release.focal_change
    if sigmas <= 1.0:
        return found
    turned = replace(release.fit.state, camera=release.given)
    step = same_change(found.fit, (found.of_traffic or found.fit).state, turned)
    return found.covering(np.sqrt(1.0 - 1.0 / sigmas**2) * step)


def _test_by_release(
    lens: Camera, found: Solution, tracks: TrackSet
) -> Reason | tuple[_Release, VerificationRow | None]:
    """Return why the traffic contradicts the lens, else the release of its focal length and the comparison of both.

    The comparison fails where the lens is doubtful; None if the traffic gives no focal length.
    """
    loose = LOOSE_PRINCIPAL_POINT_SIGMA_FRACTION * lens.width
    focal = _released(lens, found, tracks, [np.inf, 0.0, 0.0, 0.0, 0.0, 0.0])
    off, sigmas = focal.focal_change
    if abs(off) > LENS_TOLERANCE and sigmas > CONTRADICTION_SIGMAS:
        sigma_px = focal.fit.focal_sigma * focal.camera.focal_px
        return _focal_contradiction(lens, focal.camera.focal_px, sigma_px)
    row = None
    if sigmas > 0:
        row = verified('given_lens', abs(off), max(DOUBT_SIGMAS * abs(off) / sigmas, LENS_TOLERANCE))
    point = _released(lens, found, tracks, [0.0, loose, loose * lens.pixel_aspect, 0.0, 0.0, 0.0])
    change, sigmas = point.change(lambda camera: np.array(camera.principal_point_px))
    if np.hypot(*change) > LENS_TOLERANCE * lens.width and sigmas > CONTRADICTION_SIGMAS:
        return _point_contradiction(lens, point.fit)
    shape = _released(lens, found, tracks, [0.0, 0.0, 0.0, 0.0, 0.0, np.inf])
    change, sigmas = shape.change(lambda camera: np.array([np.log(camera.pixel_aspect)]))
    if abs(change[0]) > LENS_TOLERANCE and sigmas > CONTRADICTION_SIGMAS:
        numbers = {'aspect': lens.pixel_aspect, 'traffic_aspect': shape.camera.pixel_aspect}
        sigma = abs(change[0]) / sigmas * shape.camera.pixel_aspect
        return reason('given_lens', 'pixel_aspect', **numbers, sigma=sigma)
    return focal, row


def _released(lens: Camera, found: Solution, tracks: TrackSet, sigma: list[float]) -> _Release:
    """Adjust with parameters of the given lens free; `sigma` is of the `LENS_PARAMETERS`."""
    fit = found.of_traffic or found.fit
    config = replace(fit.problem.config, prior=LensPrior('known', lens, np.array(sigma)))
    return _Release(lens, adjust(fit.state, tracks, config, refine=True, warm_start=fit.problem.warm_start))


def _focal_contradiction(lens: Camera, traffic_px: float, sigma_px: float) -> Reason:
    return reason('given_lens', given_px=lens.focal_px, traffic_px=traffic_px, sigma_px=sigma_px)


def _in_words_of(contradiction: Reason, lens: Camera, free: Solution | Reason, tracks: TrackSet) -> Reason:
    """Return a contradiction with the numbers of the traffic without the lens, which are not tied to it."""
    if isinstance(free, Reason):
        return contradiction
    camera = free.fit.state.camera
    if abs(np.log(lens.focal_px / camera.focal_px)) > LENS_TOLERANCE:
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


def _doubted(found: Solution, doubt: _Release) -> Solution:
    """Lower the grade of a solution, and say why."""
    focal_px = doubt.camera.focal_px
    statement = check(
        'given_lens', given_px=doubt.given.focal_px, traffic_px=focal_px, sigma_px=doubt.fit.focal_sigma * focal_px
    )
    return replace(found, reduced=True, checks=(*found.checks, statement))
