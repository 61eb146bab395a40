"""Revalidation: reconciles the published calibration with a new solution.

A calibration stored by an earlier run is published at once, as not verified, until the traffic of this run gives a
solution of its own. The two are compared in units of their stated standard deviations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from autocalib_ros.comparison import AGREEMENT_SIGMAS, EQUAL_RTOL, SAME_LENS_TOLERANCE_PX, max_lens_difference_px
from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.verification.scale import Scale, known_scale
from autocalib_ros.geometry.ground_plane import GroundPlane, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, StandardDeviations
from autocalib_ros.results.grades import rank_of
from autocalib_ros.results.statements import SCALE_KINDS


class CalibrationState(Enum):
    """State of the published calibration."""

    NONE = 'none'
    """Nothing is published."""
    RESTORED = 'restored'
    """Stored by an earlier run, not yet verified."""
    VERIFIED = 'verified'
    """From evidence that is gone, of an earlier run or before a time jump, and confirmed by present traffic."""
    MENDED = 'mended'
    """Turned with the camera by what the picture shows, not yet verified by traffic."""
    DEGRADED = 'degraded'
    """Solved in this run, and contradicted by the newest traffic; the next solution decides."""
    CALIBRATED = 'calibrated'
    """Solved from the present evidence."""


@dataclass(frozen=True)
class Decision:
    """The calibration to publish after a new solution, and why."""

    state: CalibrationState
    calibration: Calibration
    text: str = ''
    """For the log; '' if there is nothing to report but the solution itself."""
    contradicted: bool = False
    """Whether the previous calibration was wrong for this camera in all its parts."""


def reconcile(state: CalibrationState, before: Calibration | None, fresh: Calibration) -> Decision:
    """Decide between the published calibration and a new solution.

    A calibration of this run is replaced by a newer one that is at least as precise, unless that lost the ground plane;
    a less precise one that contradicts it degrades it, and a second one in a row replaces it. One of an earlier run is
    confirmed if lens and plane agree, and stays until a solution is at least as precise; it is replaced if either
    disagrees. A solution without a plane confirms the lens only and leaves the state unchanged.
    """
    if before is None or state is CalibrationState.NONE:
        return Decision(CalibrationState.CALIBRATED, fresh)
    if state in (CalibrationState.CALIBRATED, CalibrationState.DEGRADED):
        # the latched plane would remain with a lens that it does not belong to
        if before.ground is not None and fresh.ground is None:
            return Decision(state, before, 'keeping the previous calibration: the new one has no ground plane')
        return _reconcile_own(state, before, fresh)
    origin = 'mended' if state is CalibrationState.MENDED else 'stored'
    differences = [*_lens_differences(before, fresh), *_plane_differences(before, fresh)]
    if differences:
        found = ', '.join(filter(None, differences))
        text = (
            f'{origin} calibration is inconsistent with current traffic; replaced: {found}'
            if found
            else f'{origin} calibration replaced: it cannot be checked without standard deviations'
        )
        return Decision(CalibrationState.CALIBRATED, fresh, text, contradicted=True)
    if before.ground is not None and fresh.ground is None:
        why = f': {fresh.ground_refusal.message}' if fresh.ground_refusal else ''
        return Decision(state, before, f'current traffic confirms the {origin} lens; ground plane not verified{why}')
    if _at_least_as_precise(fresh, before):
        return Decision(
            CalibrationState.CALIBRATED,
            fresh,
            f'{origin} calibration confirmed, and replaced by one that is at least as precise',
        )
    text = f'current traffic agrees with the {origin} calibration; keeping it (smaller uncertainty)'
    return Decision(CalibrationState.VERIFIED, before, '' if state is CalibrationState.VERIFIED else text)


def _reconcile_own(state: CalibrationState, before: Calibration, fresh: Calibration) -> Decision:
    """Decide between a calibration of this run and a newer solution."""
    found = ', '.join(filter(None, [*_lens_differences(before, fresh), *_plane_differences(before, fresh)]))
    if _at_least_as_precise(fresh, before):
        text = f'calibration replaced by one that is at least as precise and differs: {found}' if found else ''
        return Decision(CalibrationState.CALIBRATED, fresh, text)
    if not found:
        return Decision(CalibrationState.CALIBRATED, before)
    if state is CalibrationState.CALIBRATED:
        return Decision(
            CalibrationState.DEGRADED,
            before,
            f'the newest traffic contradicts the calibration: {found}; the next solution decides',
        )
    text = f'calibration replaced: the traffic contradicted it twice in a row: {found}'
    return Decision(CalibrationState.CALIBRATED, fresh, text)


def _lens_differences(before: Calibration, fresh: Calibration) -> list[str | None]:
    """Return a text for each significant difference; None for one without standard deviations."""
    if max_lens_difference_px(before.camera, fresh.camera) <= SAME_LENS_TOLERANCE_PX:
        return []
    return _differences(_lens_estimates(before), _lens_estimates(fresh))


def _plane_differences(before: Calibration, fresh: Calibration) -> list[str | None]:
    if before.ground is None or fresh.ground is None:
        return []
    if before.ground.metric != fresh.ground.metric:
        return ['the ground plane is in metres' if fresh.ground.metric else 'the ground plane is not in metres']
    return _differences(_plane_estimates(before.ground, before.stddev), _plane_estimates(fresh.ground, fresh.stddev))


@dataclass(frozen=True)
class _Estimate:
    name: str
    value: float
    sigma: float | None
    unit: str = ''


def _lens_estimates(result: Calibration) -> list[_Estimate]:
    camera, sigma = result.camera, result.stddev
    point = sigma.principal_point_px or (None, None)
    return [
        _Estimate('focal length', camera.focal_px, sigma.focal_px, ' px'),
        _Estimate('principal point x', camera.principal_point_px[0], point[0], ' px'),
        _Estimate('principal point y', camera.principal_point_px[1], point[1], ' px'),
        _Estimate('k1', camera.k[0], sigma.k1),
        _Estimate('k2', camera.k[1], sigma.k2),
    ]


def _plane_estimates(ground: GroundPlane, sigma: StandardDeviations) -> list[_Estimate]:
    tilt, roll = tilt_and_roll_deg(ground.normal_in_camera)
    # a given height without standard deviation is exact
    return [
        _Estimate('tilt', float(tilt), sigma.tilt_deg, ' deg'),
        _Estimate('roll', float(roll), sigma.roll_deg, ' deg'),
        _Estimate('height', ground.height_m, sigma.height_m or 0.0, ' m'),
    ]


def _differences(before: list[_Estimate], fresh: list[_Estimate]) -> list[str | None]:
    found: list[str | None] = []
    for old, new in zip(before, fresh, strict=True):
        difference = abs(new.value - old.value)
        if difference <= EQUAL_RTOL * abs(old.value):
            continue
        if old.sigma is None or new.sigma is None:
            found.append(None)
        elif difference > AGREEMENT_SIGMAS * math.hypot(old.sigma, new.sigma):
            found.append(
                f'{old.name} before {old.value:.4g} ± {old.sigma:.2g}{old.unit}, new {new.value:.4g} ± '
                f'{new.sigma:.2g}{new.unit}'
            )
    return found


def _at_least_as_precise(fresh: Calibration, before: Calibration) -> bool:
    """Whether grade and precision of a solution are at least those of the other, or it alone has a ground plane."""
    if before.ground is None and fresh.ground is not None:
        return True
    sigmas = [(fresh.stddev.focal_px, before.stddev.focal_px)]
    if before.ground is not None:
        sigmas += [(fresh.stddev.tilt_deg, before.stddev.tilt_deg), (fresh.stddev.roll_deg, before.stddev.roll_deg)]
    return rank_of(fresh.grade) >= rank_of(before.grade) and all(
        _sigma_or_inf(new) <= _sigma_or_inf(old) for new, old in sigmas
    )


def _sigma_or_inf(sigma: float | None) -> float:
    return math.inf if sigma is None else sigma


def with_current_options(kept: Calibration, options: Options, lens: Camera | None) -> Calibration:
    """Return a stored calibration under the present options; UsageError if it does not fit them.

    The plane takes the scale that is given now, if that needs no traffic; otherwise it keeps its own. A lens given
    now must be the stored one.
    """
    if (kept.distortion_model, kept.rectified_balance) != (options.distortion_model, options.rectified_balance):
        kept = replace(kept, distortion_model=options.distortion_model, rectified_balance=options.rectified_balance)
    size = kept.evidence.image_size
    if lens is not None and max_lens_difference_px(lens.scaled_to(*size), kept.camera) > SAME_LENS_TOLERANCE_PX:
        raise UsageError("its lens differs from that of 'camera_info_file'")
    given_now = options.camera_height > 0 or options.scale.known_distances
    if kept.ground is None or not given_now:
        return kept
    options.scale.require_inside(*size)
    scale = known_scale(options, kept.camera, kept.ground.normal_in_camera)
    if not isinstance(scale, Scale):
        return replace(
            kept,
            grade='lens',
            ground=None,
            ground_refusal=scale,
            covariance=None,
            stddev=replace(kept.stddev, tilt_deg=None, roll_deg=None, height_m=None, ground_point_m=(), ground=None),
        )
    return _scaled(kept, kept.ground, scale)


def _scaled(kept: Calibration, ground: GroundPlane, scale: Scale) -> Calibration:
    height = scale.height(kept.camera, ground.normal_in_camera)
    if ground.metric and abs(height - ground.height_m) <= EQUAL_RTOL * height:
        return kept
    others = tuple(statement for statement in kept.assumptions if statement.kind not in SCALE_KINDS)
    return replace(
        kept,
        # lengths are as certain as the new scale allows, which is not computed without the evidence
        grade=kept.grade if ground.metric else 'fair',
        ground=replace(ground, height_m=height, metric=True),
        assumptions=(*others, *scale.assumption(height)),
        covariance=None,
        # the accuracy at fixed distances is unknown after rescaling
        stddev=replace(kept.stddev, height_m=scale.sigma or None, ground_point_m=(), ground=None),
    )
