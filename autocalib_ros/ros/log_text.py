"""Results and states as one line of text, for the log and the responses of services."""

from __future__ import annotations

import math

from autocalib_ros.calibrator import CalibrationProgress
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera_info import EXACT_MODELS
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.verification_table import summarise_verification


def describe(result: Calibration | Refusal) -> str:
    """Return a result as one line."""
    return describe_refusal(result) if isinstance(result, Refusal) else describe_calibration(result)


def describe_refusal(refusal: Refusal) -> str:
    """Return code, reason and remedy of a refusal as one line."""
    return _one_line(f'refused ({refusal.code}): {refusal.message} Remedy: {refusal.remedy}')


def describe_calibration(result: Calibration) -> str:
    """Return focal length, tilt, height, grade, assumptions and verification as one line."""
    assumptions = '; '.join(map(str, result.assumptions)) or 'none'
    numbers = ', '.join(describe_numbers(result))
    verification = summarise_verification(result.verification)
    checked = f'; {verification}' if verification else ''
    return _one_line(f'calibrated, grade {result.grade}: {numbers}; assumptions: {assumptions}{checked}')


def describe_briefly(result: Calibration) -> str:
    """Return grade, focal length, tilt and height as one line."""
    return _one_line(f'calibrated, grade {result.grade}: {", ".join(describe_numbers(result))}')


def describe_numbers(result: Calibration) -> list[str]:
    """Return focal length, tilt and height with their sigma, or why there is no ground plane."""
    sigma = result.stddev
    parts = [f'focal length {result.camera.focal_px:.2f} px{_sigma_text(sigma.focal_px)}']
    if result.ground is not None:
        unit = 'm' if result.ground.metric else '(units of the camera height)'
        parts += [
            f'tilt {tilt_deg(result.ground):.2f} deg{_sigma_text(sigma.tilt_deg)}',
            f'height {result.ground.height_m:g} {unit}{_sigma_text(sigma.height_m)}',
        ]
    elif result.ground_refusal is not None:
        parts.append(f'no ground plane ({result.ground_refusal.code}): {result.ground_refusal.message}')
    info = result.camera_info
    if info.distortion_model not in EXACT_MODELS:
        parts.append(f'camera_info {info.distortion_model}, error at most {info.error_px:.2g} px')
    return parts


def describe_progress(progress: CalibrationProgress | None) -> str:
    """Return progress, missing evidence and expected time as one line."""
    return 'collecting' if progress is None else _one_line(f'collecting: {progress}')


def tilt_deg(ground: GroundPlane) -> float:
    """Return the angle of the optical axis below the horizon in degrees."""
    return math.degrees(math.asin(max(-1.0, min(1.0, -float(ground.normal_in_camera[2])))))


def _sigma_text(value: float | None) -> str:
    return '' if value is None else f' (sigma {value:.3g})'


def _one_line(text: str) -> str:
    return ' '.join(text.split())
