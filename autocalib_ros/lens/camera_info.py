"""The lens as ROS knows it: the fields of sensor_msgs/CameraInfo and camera_info_manager's file."""

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
"""image_proc and image_geometry take an all-zero D for "no distortion" whatever the model is called."""
RECTIFIED_LIMIT_DEG = 80.0
"""A distortion-free image ends at this angle from the axis at the latest: at 90 it would be infinitely large, and
already here its border is magnified 33 times as much as its middle."""
DISTORTION_MODELS = {
    'plumb_bob': (4, 5),
    'rational_polynomial': (8,),
    'equidistant': (0, 1, 2, 3, 4),
    'fisheye': (0, 1, 2, 3, 4),
}
"""The distortion models that are read, and how many coefficients each may have."""


@dataclass(frozen=True)
class CameraInfo:
    """The fields of sensor_msgs/CameraInfo that a lens decides; lists as the message wants them."""

    width: int
    height: int
    distortion_model: str
    k: list[float]
    d: list[float]
    r: list[float]
    p: list[float]
    error_px: float = 0.0
    """Largest distance in pixels, over the whole image, between this and the lens that it says."""


@dataclass(frozen=True)
class Readout:
    """Which pixels of the sensor an image shows, in pixels of the full resolution (REP-104)."""

    width: int
    height: int
    """Full resolution of the sensor."""
    binning: tuple[int, int] = (1, 1)
    """Pixels across and down that make one of the image; 0 is 1."""
    offset: tuple[int, int] = (0, 0)
    window: tuple[int, int] = (0, 0)
    """Region of interest: where it begins, and its size before binning; 0 is all."""

    @property
    def bins(self) -> tuple[int, int]:
        """The binning, at least 1."""
        return max(self.binning[0], 1), max(self.binning[1], 1)


class ModelMisfit(UsageError):
    """A distortion model was asked for that cannot say the lens."""

    def __init__(self, message: str, remedy: str) -> None:
        super().__init__(f'{message} {remedy}')
        self.message, self.remedy = message, remedy


def camera_info(camera: Camera, distortion_model: str = 'auto', rectified_balance: float = 0.0) -> CameraInfo:
    """Return the CameraInfo of a lens; K is the same in every distortion model, and R identity.

    'auto' is 'equidistant', which says every lens of this program exactly; 'rational_polynomial' and 'plumb_bob' are
    fitted to what the image shows. Raises ModelMisfit where such a fit misses by more than MAX_ERROR_PX.
    """
    model = 'equidistant' if distortion_model == 'auto' else distortion_model
    coefficients, error_px = _coefficients(camera, model)
    if not error_px <= MAX_MODEL_ERROR_PX:
        raise _model_misfit(camera, model, error_px)
    rectified = rectified_matrix(camera, rectified_balance)
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
    """Return what was calibrated in the pixels of binned or cut-out images in those of the whole sensor.

    image_geometry goes back by subtracting the offset and dividing by the binning, and so is right in the image to the
    last digit. InputError where images of such a readout would have another size than those of the calibration.
    """
    mismatch = check_readout(readout, (info.width, info.height))
    if mismatch:
        raise InputError(f'{mismatch}: its binning and region of interest are not theirs and are left out')
    return replace(
        info,
        width=readout.width,
        height=readout.height,
        k=_to_full_resolution(info.k, 3, readout.bins, readout.offset),
        p=_to_full_resolution(info.p, 4, readout.bins, readout.offset),
    )


def check_readout(readout: Readout, image_size: tuple[int, int]) -> str:
    """Say why images of a size (width, height) are not of a readout, '' where they may be."""
    (across, down), (width, height) = readout.bins, image_size
    window = readout.window[0] or readout.width, readout.window[1] or readout.height
    # drivers round half a bin up or down
    if abs(width * across - window[0]) >= across or abs(height * down - window[1]) >= down:
        return (
            f"the driver's camera_info is of images of {window[0] // across}x{window[1] // down}, and these have"
            f' {width}x{height}'
        )
    if readout.offset[0] + readout.window[0] > readout.width or readout.offset[1] + readout.window[1] > readout.height:
        return (
            "the region of interest in the driver's camera_info reaches beyond its"
            f' {readout.width}x{readout.height} pixels'
        )
    return ''


def _to_full_resolution(
    matrix: list[float], columns: int, binning: tuple[int, int], offset: tuple[int, int]
) -> list[float]:
    """Return K or P for the whole sensor."""
    rows = np.array(matrix).reshape(3, columns) * np.array([[binning[0]], [binning[1]], [1]])
    rows[:2, 2] += offset
    return [float(value) for value in rows.ravel()]


def _coefficients(camera: Camera, model: str) -> tuple[list[float], float]:
    """Return D in a model, and by how many pixels it misses the lens at the most."""
    if model == 'equidistant':
        coefficients = [float(value) for value in camera.k]
        if not any(abs(value) >= EQUIDISTANT_K1_FLOOR for value in coefficients):
            coefficients[0] = EQUIDISTANT_K1_FLOOR
        return coefficients, 0.0
    fitted, error_px = fit_opencv_coefficients(camera, rational=model == 'rational_polynomial')
    return list(fitted[: DISTORTION_MODELS[model][-1]]), error_px


def _model_misfit(camera: Camera, model: str, error_px: float) -> ModelMisfit:
    """Say how far a model is from the lens, and which model to choose."""
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


def rectified_matrix(camera: Lens, balance: float = 0.0) -> np.ndarray:
    """Return the K, shape (3, 3), of a distortion-free image of equal size.

    At `balance` 0 the lens fills it wholly: the largest axis-parallel rectangle about the axis inside the undistorted
    border decides. At 1 it holds all that the lens shows: the smallest one around that border. Between them the matrix
    is interpolated, as OpenCV does. Border points beyond RECTIFIED_LIMIT_DEG are brought in to it.
    """
    left, right, top, bottom = _normalised_borders(camera)
    filled = _matrix_for_rectangle(camera, left.max(), right.min(), top.max(), bottom.min(), max)
    whole = _matrix_for_rectangle(camera, left.min(), right.max(), top.min(), bottom.max(), min)
    return (1.0 - balance) * filled + balance * whole


def _normalised_borders(camera: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the slopes x of the left and right border's pixels and y of the upper and lower border's, each (n,)."""
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
    camera: Lens, left: float, right: float, top: float, bottom: float, choose: Callable[[float, float], float]
) -> np.ndarray:
    """Return the K with square pixels that shows a rectangle of slopes in its middle, one of its sides exactly."""
    width, height = camera.width, camera.height
    focal = choose((width - 1) / max(right - left, 1e-6), (height - 1) / max(bottom - top, 1e-6))
    return np.array(
        [
            [focal, 0, (width - 1) / 2 - focal * (right + left) / 2],
            [0, focal, (height - 1) / 2 - focal * (bottom + top) / 2],
            [0, 0, 1],
        ]
    )
