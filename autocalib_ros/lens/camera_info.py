"""The fields of sensor_msgs/CameraInfo that describe a lens: distortion models, K, D, P, and the sensor readout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.lens.camera import Camera, Lens
from autocalib_ros.lens.opencv_lens import (
    MAX_MODEL_ERROR_PX,
    MAX_PINHOLE_ANGLE_RAD,
    fit_opencv_coefficients,
    max_visible_angle_rad,
)

EQUIDISTANT_K1_FLOOR = 1e-9
"""Minimum k1 of an equidistant D: image_proc and image_geometry take an all-zero D as "no distortion" in any model."""
RECTIFIED_LIMIT_DEG = 80.0
"""Maximum angle from the axis in a rectified image: at 90 degrees it would be infinitely large, and at 80 its border
is already magnified 33 times as much as its centre."""
DISTORTION_MODELS = {
    'plumb_bob': (4, 5),
    'rational_polynomial': (8,),
    'equidistant': (0, 1, 2, 3, 4),
    'fisheye': (0, 1, 2, 3, 4),
    'kannala_brandt': (0, 1, 2, 3, 4),
}
"""Distortion models that can be read, with the permitted numbers of coefficients."""
EXACT_MODELS = ('equidistant', 'kannala_brandt')
"""Names under which the lens is published as it is: that of ROS, and that of Foxglove."""
FISHEYE_MODELS = (*EXACT_MODELS, 'fisheye')
"""Names of the Kannala-Brandt lens of `Camera`."""


@dataclass(frozen=True)
class CameraInfo:
    """Fields of sensor_msgs/CameraInfo, as lists as in the message."""

    width: int
    height: int
    distortion_model: str
    k: list[float]
    d: list[float]
    r: list[float]
    p: list[float]
    error_px: float = 0.0
    """Maximum distance in pixels, over the whole image, between this and the lens it represents."""


@dataclass(frozen=True)
class Readout:
    """Part of the sensor that an image shows, in pixels of the full resolution (REP-104)."""

    width: int
    height: int
    """Full resolution of the sensor."""
    binning: tuple[int, int] = (1, 1)
    """Sensor pixels per image pixel, horizontally and vertically; 0 means 1."""
    offset: tuple[int, int] = (0, 0)
    """Top-left corner of the region of interest."""
    window: tuple[int, int] = (0, 0)
    """Size of the region of interest before binning; 0 means the full width or height."""

    @property
    def bins(self) -> tuple[int, int]:
        """Binning, at least 1."""
        return max(self.binning[0], 1), max(self.binning[1], 1)


class ModelMisfit(UsageError):
    """The requested distortion model cannot represent the lens."""

    def __init__(self, message: str, remedy: str) -> None:
        super().__init__(f'{message} {remedy}')
        self.message, self.remedy = message, remedy


def camera_info(camera: Camera, distortion_model: str = 'auto', rectified_balance: float = 0.0) -> CameraInfo:
    """Return the CameraInfo of a lens; K is the same in every distortion model, and R is the identity.

    'auto' is 'equidistant', which represents every Camera exactly; 'kannala_brandt' is another name of it;
    'rational_polynomial' and 'plumb_bob' are fitted
    to the visible field. ModelMisfit if the error of the fit exceeds `MAX_MODEL_ERROR_PX`.
    """
    model = 'equidistant' if distortion_model == 'auto' else distortion_model
    coefficients, error_px = _coefficients(camera, model)
    if not error_px <= MAX_MODEL_ERROR_PX:
        raise _model_misfit(camera, model, error_px)
    rectified = rectified_matrix(camera, rectified_balance, camera.pixel_aspect)
    return CameraInfo(
        width=camera.width,
        height=camera.height,
        distortion_model=model,
        k=[float(value) for value in camera.matrix.ravel()],
        d=coefficients,
        r=[float(value) for value in np.eye(3).ravel()],
        p=[float(value) for value in np.hstack([rectified, np.zeros((3, 1))]).ravel()],
        error_px=error_px,
    )


def to_full_resolution(info: CameraInfo, readout: Readout) -> CameraInfo:
    """Return a CameraInfo calibrated in cropped or binned images in pixels of the whole sensor.

    image_geometry reverses this exactly, by subtracting the offset and dividing by the binning. InputError if images
    of this readout would have another size than those of the calibration.
    """
    mismatch = check_readout(readout, (info.width, info.height))
    if mismatch:
        raise InputError(f'{mismatch}: its binning and region of interest are ignored')
    return replace(
        info,
        width=readout.width,
        height=readout.height,
        k=_to_full_resolution(info.k, 3, readout.bins, readout.offset),
        p=_to_full_resolution(info.p, 4, readout.bins, readout.offset),
    )


def check_readout(readout: Readout, image_size: tuple[int, int]) -> str:
    """Return why images of a size (width, height) do not come from this readout; '' if they may."""
    (across, down), (width, height) = readout.bins, image_size
    window = readout.window[0] or readout.width, readout.window[1] or readout.height
    # drivers round half a bin up or down
    if abs(width * across - window[0]) >= across or abs(height * down - window[1]) >= down:
        return (
            f"the driver's camera_info is for images of {window[0] // across}x{window[1] // down}, these have"
            f' {width}x{height}'
        )
    if readout.offset[0] + readout.window[0] > readout.width or readout.offset[1] + readout.window[1] > readout.height:
        return f"the region of interest in the driver's camera_info exceeds its {readout.width}x{readout.height} pixels"
    return ''


def _to_full_resolution(
    matrix: list[float], columns: int, binning: tuple[int, int], offset: tuple[int, int]
) -> list[float]:
    """Return K or P in pixels of the whole sensor."""
    rows = np.array(matrix).reshape(3, columns) * np.array([[binning[0]], [binning[1]], [1]])
    rows[:2, 2] += offset
    return [float(value) for value in rows.ravel()]


def _coefficients(camera: Camera, model: str) -> tuple[list[float], float]:
    """Return D in a distortion model, and its maximum error in pixels."""
    if model in EXACT_MODELS:
        coefficients = [float(value) for value in camera.k]
        if not any(abs(value) >= EQUIDISTANT_K1_FLOOR for value in coefficients):
            coefficients[0] = EQUIDISTANT_K1_FLOOR
        return coefficients, 0.0
    fitted, error_px = fit_opencv_coefficients(camera, rational=model == 'rational_polynomial')
    return list(fitted[: DISTORTION_MODELS[model][-1]]), error_px


def _model_misfit(camera: Camera, model: str, error_px: float) -> ModelMisfit:
    """Return the error for a model that cannot represent the lens, with a model that can."""
    angle_deg = float(np.degrees(max_visible_angle_rad(camera)))
    if np.isfinite(error_px):
        message = (
            f'{model} would be off by up to {error_px:.3g} px, as the lens sees {angle_deg:.0f} degrees from its'
            f' axis; {MAX_MODEL_ERROR_PX:g} px is the most that is allowed.'
        )
    else:
        message = (
            f'The lens sees {angle_deg:.1f} degrees from its axis, and {model} ends before'
            f' {np.degrees(MAX_PINHOLE_ANGLE_RAD):.0f}.'
        )
    others = 'equidistant, which is exact'
    if model == 'plumb_bob':
        rational_px = fit_opencv_coefficients(camera, rational=True)[1]
        if rational_px <= MAX_MODEL_ERROR_PX:
            others = f'rational_polynomial, which is off by {rational_px:.2g} px at the most, or {others}'
    return ModelMisfit(message, f'Set distortion_model to {others}.')


def rectified_matrix(camera: Lens, balance: float = 0.0, pixel_aspect: float = 1.0) -> np.ndarray:
    """Return K, shape (3, 3), of a distortion-free image of the same size, with pixels of an aspect.

    `balance` 0: only valid pixels, the largest axis-parallel rectangle about the axis inside the undistorted border.
    1: the whole field of view, the smallest rectangle around that border. Values between interpolate the matrix, as in
    OpenCV. Border points beyond `RECTIFIED_LIMIT_DEG` are clipped to it.
    """
    left, right, top, bottom = _normalised_borders(camera)
    filled = _matrix_for_rectangle(camera, left.max(), right.min(), top.max(), bottom.min(), max, pixel_aspect)
    whole = _matrix_for_rectangle(camera, left.min(), right.max(), top.min(), bottom.max(), min, pixel_aspect)
    return (1.0 - balance) * filled + balance * whole


def _normalised_borders(camera: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return normalised x of the left and right border's pixels and y of the top and bottom border's, each (n,)."""
    width, height = camera.width, camera.height
    across, down = np.linspace(0, width - 1, 257), np.linspace(0, height - 1, 257)
    limit = np.radians(RECTIFIED_LIMIT_DEG)

    def normalised(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        bearings, _ = camera.unproject(np.stack(np.broadcast_arrays(x, y), axis=-1))
        from_axis = np.hypot(bearings[:, 0], bearings[:, 1])
        theta = np.minimum(np.arctan2(from_axis, bearings[:, 2]), limit)
        return np.tan(theta)[:, None] * bearings[:, :2] / np.maximum(from_axis, 1e-12)[:, None]

    return (
        normalised(0.0, down)[:, 0],
        normalised(width - 1.0, down)[:, 0],
        normalised(across, 0.0)[:, 1],
        normalised(across, height - 1.0)[:, 1],
    )


def _matrix_for_rectangle(
    camera: Lens,
    left: float,
    right: float,
    top: float,
    bottom: float,
    choose: Callable[[float, float], float],
    aspect: float,
) -> np.ndarray:
    """Return K that centres a rectangle of normalised coordinates and fits one of its sides."""
    width, height = camera.width, camera.height
    focal = choose((width - 1) * aspect / max(right - left, 1e-6), (height - 1) / max(bottom - top, 1e-6))
    focal_x = focal / aspect
    return np.array(
        [
            [focal_x, 0, (width - 1) / 2 - focal_x * (right + left) / 2],
            [0, focal, (height - 1) / 2 - focal * (bottom + top) / 2],
            [0, 0, 1],
        ]
    )
