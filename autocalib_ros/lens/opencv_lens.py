"""Lens models of OpenCV, and conversion between them and the Kannala-Brandt camera.

A bearing with normalised coordinates (x, y) = (X / Z, Y / Z) and r^2 = x^2 + y^2 is imaged at K (x', y', 1) with

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

in the model 'rational_polynomial' and, without k4 to k6, in 'plumb_bob'. Without distortion all are zero.
'equidistant' is the polynomial of camera.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera import Camera

MAX_MODEL_ERROR_PX = 0.5
"""Maximum error of a converted lens in pixels, the accuracy of a tracked point: more would bias the pose."""
MIN_FISHEYE_COVERAGE = 0.25
"""Minimum fraction of the image that a fisheye covers, as a disc in the middle."""
MIN_FIELD_OF_VIEW_DEG = 1.0
"""Minimum angle between image corners in degrees: less comes from wrong numbers, not from a camera."""
COMPARISON_GRID_SIDE = 41
"""Pixels along each side of the grid on which two lenses are compared, borders included."""
MAX_PINHOLE_ANGLE_RAD = np.radians(89.0)
"""Largest angle from the axis at which normalised coordinates, tan(theta), are used."""
RADIAL_TABLE_SIZE = 8192
"""Entries of the lookup table that inverts the radial distortion."""
TANGENTIAL_ITERATIONS = 20
"""Fixed-point iterations: tangential terms are small, and each iteration reduces the error by that factor."""
INVERSION_TOLERANCE_PX = 0.05
"""Maximum reprojection error in pixels for which an inversion counts as successful."""
RADIAL_FIT_SAMPLES = 400
"""Angles from the axis to the farthest corner for the fit of a model; four times as many validate it."""
MAX_LAWSON_ITERATIONS = 20
"""Reweighted fits (Lawson 1961): about a dozen bring the maximum error near to its minimum."""


@dataclass(frozen=True, kw_only=True)
class OpencvLens:
    """A lens as CameraInfo describes it."""

    width: int
    height: int
    matrix: np.ndarray
    """K, shape (3, 3), pixels."""
    equidistant: bool
    coefficients: tuple[float, ...]
    """k1 to k4 of an equidistant lens, otherwise k1, k2, p1, p2, k3, k4, k5, k6, as in D."""

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height."""
        return float(self.matrix[1, 1] / self.matrix[0, 0])

    @property
    def skew(self) -> float:
        """Cotangent of the angle between the pixel axes."""
        return float(self.matrix[0, 1] / self.matrix[0, 0])

    def grid(self) -> np.ndarray:
        """Return pixels evenly over the image, shape (n, 2)."""
        across, down = (
            np.linspace(0, self.width - 1, COMPARISON_GRID_SIDE),
            np.linspace(0, self.height - 1, COMPARISON_GRID_SIDE),
        )
        return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)

    def unproject_and_reproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return bearings (n, 3), their reprojection (n, 2), and whether that is at `pixels` (n, 2)."""
        ideal = np.linalg.solve(self.matrix, np.column_stack([pixels, np.ones(len(pixels))]).T).T[:, :2]
        if self.equidistant:
            bearings, valid = _unit_camera(self).unproject(ideal)
            return bearings, pixels, valid
        normalised = undistort(ideal, self.coefficients)
        imaged = distort(normalised, self.coefficients) @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        near = np.hypot(*(imaged - pixels).T) < INVERSION_TOLERANCE_PX
        return np.column_stack([normalised, np.ones(len(normalised))]), imaged, near


def fit_kannala_brandt(lens: OpencvLens) -> Camera:
    """Return the Kannala-Brandt camera closest to the lens over its image, with pixels of the same shape.

    An equidistant lens converts exactly, others by a fit. InputError if the lens leaves part of
    the image without a bearing, or if the error of the fit exceeds `MAX_MODEL_ERROR_PX`.
    """
    bearings, imaged, invertible = lens.unproject_and_reproject(lens.grid())
    _require_coverage(lens, float(invertible.mean()))
    _require_field_of_view(bearings[invertible])
    if lens.equidistant:
        return _camera(lens, lens.matrix[1, 1], lens.matrix[:2, 2], lens.coefficients)
    camera = _fit_camera(lens, bearings[invertible], imaged[invertible])
    pixels, valid = camera.project(bearings[invertible])
    error_px = np.where(valid, np.hypot(*(pixels - imaged[invertible]).T), np.inf).max()
    if not error_px <= MAX_MODEL_ERROR_PX:
        raise InputError(
            f'the nearest Kannala-Brandt lens differs from this one by up to {error_px:.2f} px, more than the'
            f' {MAX_MODEL_ERROR_PX:g} px that the pose allows; {_misfit_cause(lens)}, or leave the file out'
        )
    return camera


def _require_coverage(lens: OpencvLens, fraction: float) -> None:
    """Raise InputError unless enough of the image has a bearing; a fisheye may cover only a disc in the middle."""
    if fraction < (MIN_FISHEYE_COVERAGE if lens.equidistant else 1.0):
        raise InputError(
            f'its distortion is not invertible for {100 * (1 - fraction):.0f} % of the image;'
            ' recalibrate the camera with the pattern near the borders too, or with a fisheye model'
        )


def _require_field_of_view(bearings: np.ndarray) -> None:
    """Raise InputError if opposite corners have nearly the same bearing: the numbers are not those of a camera."""
    one, other = bearings[[0, -1]] / np.linalg.norm(bearings[[0, -1]], axis=1)[:, None]
    field_deg = np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))
    if field_deg < MIN_FIELD_OF_VIEW_DEG:
        raise InputError(
            f'its field of view is {field_deg:.1g} degrees from corner to corner, which is implausible;'
            ' recalibrate the camera, or leave the file out'
        )


def _misfit_cause(lens: OpencvLens) -> str:
    """Return what a Camera cannot represent, and how to calibrate without it."""
    if any(lens.coefficients[2:4]):
        return (
            'it has tangential distortion: recalibrate the camera without, by --zero-tangent-dist of camera_calibration'
        )
    return 'its field of view is too wide: recalibrate the camera with a fisheye model'


def _camera(lens: OpencvLens, focal_px: float, principal_point_px: np.ndarray, k: Sequence[float]) -> Camera:
    k1, k2, k3, k4 = (float(value) for value in k)
    cx, cy = (float(value) for value in principal_point_px)
    return Camera(lens.width, lens.height, float(focal_px), (cx, cy), (k1, k2, k3, k4), lens.pixel_aspect, lens.skew)


def _unit_camera(lens: OpencvLens) -> Camera:
    """Return the camera of an equidistant lens for normalised coordinates: focal length 1, principal point (0, 0)."""
    k1, k2, k3, k4 = (float(value) for value in lens.coefficients)
    return Camera(lens.width, lens.height, 1.0, (0.0, 0.0), (k1, k2, k3, k4))


def _fit_camera(lens: OpencvLens, bearings: np.ndarray, imaged: np.ndarray) -> Camera:
    """Solve for principal point, f and f k1 to f k4 by linear least squares: the pixels are linear in them.

    Pixels are in pixel heights from the first one, which is what `Camera.offsets` gives of a camera with its principal
    point there.
    """
    unit = Camera(lens.width, lens.height, 1.0, (0.0, 0.0), pixel_aspect=lens.pixel_aspect, skew=lens.skew)
    across = np.hypot(bearings[:, 0], bearings[:, 1])
    powers = np.arctan2(across, bearings[:, 2])[:, None] ** [1, 3, 5, 7, 9]
    outwards = bearings[:, :2] / np.maximum(across, 1e-12)[:, None]
    ones, zeros = np.ones(len(across)), np.zeros(len(across))
    rows = np.concatenate(
        [
            np.column_stack([ones, zeros, powers * outwards[:, :1]]),
            np.column_stack([zeros, ones, powers * outwards[:, 1:]]),
        ]
    )
    solution = np.linalg.lstsq(rows, unit.offsets(imaged).T.ravel(), rcond=None)[0]
    return _camera(lens, solution[2], unit.pixels_at(solution[:2]), solution[3:] / solution[2])


def fit_opencv_coefficients(camera: Camera, *, rational: bool) -> tuple[tuple[float, ...], float]:
    """Return k1, k2, p1, p2, k3 to k6 of the OpenCV lens closest to `camera`, with the same K, and its error.

    The error is the largest distance in pixels between the images of one bearing, over the whole image; infinite if
    the image shows bearings at `MAX_PINHOLE_ANGLE_RAD` from the axis or more. Without `rational`, k4 to k6 are 0.
    """
    field_rad = max_visible_angle_rad(camera)
    if not field_rad < MAX_PINHOLE_ANGLE_RAD:
        return (0.0,) * 8, np.inf
    normalised, radii = _radial_samples(camera, field_rad, RADIAL_FIT_SAMPLES)
    checked = _radial_samples(camera, field_rad, 4 * RADIAL_FIT_SAMPLES)
    weights, denominator = np.ones(RADIAL_FIT_SAMPLES), np.ones(RADIAL_FIT_SAMPLES)
    best: tuple[float, ...] = (0.0,) * 8
    least_px = np.inf
    for _ in range(MAX_LAWSON_ITERATIONS):
        coefficients = _radial_fit(normalised, radii, np.sqrt(weights) / denominator, rational=rational)
        error_px = camera.focal_px / min(camera.pixel_aspect, 1.0) * _radial_error(*checked, coefficients).max()
        if error_px < least_px:
            best, least_px = coefficients, float(error_px)
        denominator = _denominator(normalised * normalised, coefficients)
        # Lawson's weights turn the least-squares fit into a minimax fit
        weights = weights * _radial_error(normalised, radii, coefficients)
        if not np.isfinite(weights).all() or not weights.any():
            break
        weights = np.maximum(weights / weights.mean(), 1e-12)
    return best, least_px


def max_visible_angle_rad(camera: Camera) -> float:
    """Return the largest visible angle from the axis: of a corner, or of the edge of a fisheye's disc."""
    corners = np.array([(x, y) for x in (0, camera.width - 1) for y in (0, camera.height - 1)], float)
    return float(camera.angle(np.hypot(*camera.offsets(corners).T).max())[0])


def _radial_samples(camera: Camera, field_rad: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return normalised radii r = tan(theta) up to the edge of the field and their image radii in focal lengths."""
    theta = np.linspace(0.0, field_rad, steps + 1)[1:]
    return np.tan(theta), camera.radius(theta) / camera.focal_px


def _radial_fit(normalised: np.ndarray, radii: np.ndarray, weights: np.ndarray, *, rational: bool) -> tuple[float, ...]:
    """Fit r (1 + k1 r^2 + ...) = radius (1 + k4 r^2 + ...), linear in the coefficients, to samples (n,)."""
    unit = normalised[-1]  # scaled: radii of a wide lens to the seventh power would exhaust double precision
    exponents = np.array([2, 4, 6])
    powers = (normalised[:, None] / unit) ** exponents
    columns = np.hstack([normalised[:, None] * powers, *([-radii[:, None] * powers] if rational else [])])
    solution = np.linalg.lstsq(columns * weights[:, None], (radii - normalised) * weights, rcond=None)[0]
    scaled = solution.reshape(-1, 3) / unit**exponents
    k1, k2, k3, *others = (float(value) for value in scaled.ravel())
    return (k1, k2, 0.0, 0.0, k3, *(others or (0.0,) * 3))


def _radial_error(normalised: np.ndarray, radii: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Return the error of each radius in focal lengths; infinite if the model has a pole in the field."""
    r2 = normalised * normalised
    if not (_denominator(r2, coefficients) > 0).all():
        return np.full_like(normalised, np.inf)
    return np.abs(normalised * _radial(r2, coefficients) - radii)


def distort(normalised: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Return the distorted x', y' of normalised coordinates x, y, shape (n, 2)."""
    return normalised * _radial(np.sum(normalised * normalised, axis=1), coefficients)[:, None] + _tangential(
        normalised, coefficients
    )


def undistort(ideal: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Return the inverse of `distort`; not defined beyond the radius where the model stops being monotonic."""
    radius, imaged = invertible_radii(coefficients)
    normalised = np.zeros_like(ideal)
    for _ in range(TANGENTIAL_ITERATIONS):
        target = ideal - _tangential(normalised, coefficients)
        length = np.hypot(*target.T)
        normalised = target * (np.interp(length, imaged, radius) / np.maximum(length, 1e-12))[:, None]
    return normalised


def invertible_radii(coefficients: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return normalised radii (n,) and their distorted radii (n,) over the range where the model is monotonic."""
    radius = np.tan(np.linspace(0.0, MAX_PINHOLE_ANGLE_RAD, RADIAL_TABLE_SIZE))
    imaged = radius * _radial(radius * radius, coefficients)
    folds = np.flatnonzero(~(np.diff(imaged) > 0))
    last = folds[0] + 1 if len(folds) else RADIAL_TABLE_SIZE
    return radius[:last], imaged[:last]


def distortion_jacobian(
    normalised: np.ndarray, coefficients: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return dx'/dx, dx'/dy = dy'/dx and dy'/dy of `distort` at normalised coordinates (n, 2), each (n,)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = normalised.T
    r2 = x * x + y * y
    radial, below = _radial(r2, coefficients), _denominator(r2, coefficients)
    growth = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
    return (
        radial + growth * x * x + 2 * p1 * y + 6 * p2 * x,
        growth * x * y + 2 * p1 * x + 2 * p2 * y,
        radial + growth * y * y + 6 * p1 * y + 2 * p2 * x,
    )


def _radial(r2: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    k1, k2, _, _, k3, *_ = coefficients
    with np.errstate(divide='ignore', invalid='ignore'):
        return (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / _denominator(r2, coefficients)


def _denominator(r2: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    k4, k5, k6 = coefficients[5:]
    return 1 + r2 * (k4 + r2 * (k5 + r2 * k6))


def _tangential(normalised: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    p1, p2 = coefficients[2:4]
    x, y = normalised.T
    r2 = x * x + y * y
    return np.column_stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])
