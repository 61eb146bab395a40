"""The lens as ROS knows it: the fields of sensor_msgs/CameraInfo and camera_info_manager's file."""

from __future__ import annotations

import os
import re
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from autocalib_ros.errors import AutocalibError, InputError, UsageError
from autocalib_ros.lens.camera import Camera, Lens
from autocalib_ros.lens.opencv_lens import (
    MAX_ERROR_PX,
    MAX_SLOPE_ANGLE_RAD,
    OpencvLens,
    nearest_camera,
    nearest_coefficients,
    seen_angle_rad,
)
from autocalib_ros.util.files import write_atomically

EQUIDISTANT_FLOOR = 1e-9
"""image_proc and image_geometry take an all-zero D for "no distortion" whatever the model is called."""
RECTIFIED_LIMIT_DEG = 80.0
"""A distortion-free image ends at this angle from the axis at the latest: at 90 it would be infinitely large, and
already here its border is magnified 33 times as much as its middle."""
MODELS = {'plumb_bob': (4, 5), 'rational_polynomial': (8,), 'equidistant': (0, 1, 2, 3, 4), 'fisheye': (0, 1, 2, 3, 4)}
"""The distortion models that are read, and how many coefficients each may have."""
MAX_BYTES = 1_000_000
"""No camera_info is nearly so long."""
MAX_NUMBER = 1e9
"""Beyond this nothing is meant in earnest, and powers of it would leave the numbers of a computer."""
Read = TypeVar('Read')
WHAT_TO_GIVE = 'give the file of camera_info_manager, or what `ros2 topic echo --once` prints of a CameraInfo'


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
    if not error_px <= MAX_ERROR_PX:
        raise _misfit(camera, model, error_px)
    rectified = rectified_matrix(camera, rectified_balance)
    return CameraInfo(
        width=camera.width, height=camera.height, distortion_model=model,
        k=[float(value) for value in camera.matrix.ravel()], d=coefficients,
        r=[float(value) for value in np.eye(3).ravel()],
        p=[float(value) for value in np.hstack([rectified, np.zeros((3, 1))]).ravel()], error_px=error_px)


def in_full_resolution(info: CameraInfo, readout: Readout) -> CameraInfo:
    """Return what was calibrated in the pixels of binned or cut-out images in those of the whole sensor.

    image_geometry goes back by subtracting the offset and dividing by the binning, and so is right in the image to the
    last digit. InputError where images of such a readout would have another size than those of the calibration.
    """
    doubt = readout_doubt(readout, (info.width, info.height))
    if doubt:
        raise InputError(f'{doubt}: its binning and region of interest are not theirs and are left out')
    return replace(info, width=readout.width, height=readout.height,
                   k=_unbinned(info.k, 3, readout.bins, readout.offset),
                   p=_unbinned(info.p, 4, readout.bins, readout.offset))


def readout_doubt(readout: Readout, image_size: tuple[int, int]) -> str:
    """Say why images of a size (width, height) are not of a readout, '' where they may be."""
    (across, down), (width, height) = readout.bins, image_size
    window = readout.window[0] or readout.width, readout.window[1] or readout.height
    # drivers round half a bin up or down
    if abs(width * across - window[0]) >= across or abs(height * down - window[1]) >= down:
        return (f"the driver's camera_info is of images of {window[0] // across}x{window[1] // down}, and these have"
                f' {width}x{height}')
    if readout.offset[0] + readout.window[0] > readout.width or readout.offset[1] + readout.window[1] > readout.height:
        return ("the region of interest in the driver's camera_info reaches beyond its"
                f' {readout.width}x{readout.height} pixels')
    return ''


def _unbinned(matrix: list[float], columns: int, binning: tuple[int, int], offset: tuple[int, int]) -> list[float]:
    """Return K or P for the whole sensor."""
    rows = np.array(matrix).reshape(3, columns) * np.array([[binning[0]], [binning[1]], [1]])
    rows[:2, 2] += offset
    return [float(value) for value in rows.ravel()]


def _coefficients(camera: Camera, model: str) -> tuple[list[float], float]:
    """Return D in a model, and by how many pixels it misses the lens at the most."""
    if model == 'equidistant':
        coefficients = [float(value) for value in camera.k]
        if not any(abs(value) >= EQUIDISTANT_FLOOR for value in coefficients):
            coefficients[0] = EQUIDISTANT_FLOOR
        return coefficients, 0.0
    fitted, error_px = nearest_coefficients(camera, rational=model == 'rational_polynomial')
    return list(fitted[:MODELS[model][-1]]), error_px


def _misfit(camera: Camera, model: str, error_px: float) -> ModelMisfit:
    """Say how far a model is from the lens, and which model to choose."""
    angle_deg = float(np.degrees(seen_angle_rad(camera)))
    if np.isfinite(error_px):
        message = (f'{model} would be off by up to {error_px:.3g} px, as the lens sees {angle_deg:.0f} degrees from its'
                   f' axis; {MAX_ERROR_PX:g} px is the most that is allowed.')
    else:
        message = (f'The lens sees {angle_deg:.1f} degrees from its axis, and {model} ends before'
                   f' {np.degrees(MAX_SLOPE_ANGLE_RAD):.0f}.')
    others = 'equidistant, which is exact'
    if model == 'plumb_bob':
        rational_px = nearest_coefficients(camera, rational=True)[1]
        if rational_px <= MAX_ERROR_PX:
            others = f'rational_polynomial, which is off by {rational_px:.2g} px at the most, or {others}'
    return ModelMisfit(message, f'Set distortion_model to {others}.')


def rectified_matrix(camera: Lens, balance: float = 0.0) -> np.ndarray:
    """Return the K, shape (3, 3), of a distortion-free image of equal size.

    At `balance` 0 the lens fills it wholly: the largest axis-parallel rectangle about the axis inside the undistorted
    border decides. At 1 it holds all that the lens shows: the smallest one around that border. Between them the matrix
    is interpolated, as OpenCV does. Border points beyond RECTIFIED_LIMIT_DEG are brought in to it.
    """
    left, right, top, bottom = _undistorted_borders(camera)
    filled = _view(camera, left.max(), right.min(), top.max(), bottom.min(), max)
    whole = _view(camera, left.min(), right.max(), top.min(), bottom.max(), min)
    return (1.0 - balance) * filled + balance * whole


def _undistorted_borders(camera: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the slopes x of the left and right border's pixels and y of the upper and lower border's, each (n,)."""
    width, height = camera.width, camera.height
    across, down = np.linspace(0, width - 1, 257), np.linspace(0, height - 1, 257)
    limit = np.radians(RECTIFIED_LIMIT_DEG)

    def slopes(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        bearings, _ = camera.unproject(np.stack(np.broadcast_arrays(x, y), axis=-1))
        from_axis = np.hypot(bearings[:, 0], bearings[:, 1])
        theta = np.minimum(np.arctan2(from_axis, bearings[:, 2]), limit)
        return np.tan(theta)[:, None] * bearings[:, :2] / np.maximum(from_axis, 1e-12)[:, None]

    return (slopes(0.0, down)[:, 0], slopes(width - 1.0, down)[:, 0],
            slopes(across, 0.0)[:, 1], slopes(across, height - 1.0)[:, 1])


def _view(camera: Lens, left: float, right: float, top: float, bottom: float,
          choose: Callable[[float, float], float]) -> np.ndarray:
    """Return the K with square pixels that shows a rectangle of slopes in its middle, one of its sides exactly."""
    width, height = camera.width, camera.height
    focal = choose((width - 1) / max(right - left, 1e-6), (height - 1) / max(bottom - top, 1e-6))
    return np.array([[focal, 0, (width - 1) / 2 - focal * (right + left) / 2],
                     [0, focal, (height - 1) / 2 - focal * (bottom + top) / 2], [0, 0, 1]])


def write_camera_info_yaml(path: Path, camera: Camera, camera_name: str, distortion_model: str = 'auto',
                           rectified_balance: float = 0.0) -> None:
    """Write the file of camera_info_manager, atomically; `camera_name` is reduced to letters, digits and _."""
    write_atomically(path, camera_info_yaml(camera_info(camera, distortion_model, rectified_balance), camera_name))


def plain_name(name: str) -> str:
    """Return a name in letters, digits and _, as camera_info_manager and frames want it."""
    return re.sub(r'[^A-Za-z0-9_]', '_', name)


def camera_info_yaml(info: CameraInfo, camera_name: str) -> str:
    """Return the text of camera_info_manager's file in full precision."""
    def matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
        return {'rows': rows, 'cols': cols, 'data': data}

    document = {
        'image_width': info.width, 'image_height': info.height,
        'camera_name': plain_name(camera_name) or 'camera',
        'camera_matrix': matrix(3, 3, info.k), 'distortion_model': info.distortion_model,
        'distortion_coefficients': matrix(1, len(info.d), info.d),
        'rectification_matrix': matrix(3, 3, info.r), 'projection_matrix': matrix(3, 4, info.p)}
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None)


def read_camera_info_fields(path: Path) -> CameraInfo:
    """Read camera_info_manager's file as it stands, whatever lens it tells of; InputError where it is none."""
    return _read(path, _as_it_stands)


def _as_it_stands(fields: Mapping[str, Any]) -> CameraInfo:
    model, sizes = _model(fields)
    return CameraInfo(
        width=_pixels(fields, 'image_width', 'width'), height=_pixels(fields, 'image_height', 'height'),
        distortion_model=model, k=_numbers(fields, (9,), 'camera_matrix', 'k'),
        d=_numbers(fields, sizes, 'distortion_coefficients', 'd'),
        r=_numbers(fields, (9,), 'rectification_matrix', 'r'), p=_numbers(fields, (12,), 'projection_matrix', 'p'))


def read_camera_info(path: Path) -> Camera:
    """Read the lens from the YAML of camera_info_manager, or of a CameraInfo as `ros2 topic echo --once` prints it.

    'equidistant' is taken as it stands, other models as the nearest Kannala-Brandt lens. Raises InputError that says
    what is wrong with the file, what was expected and what to do.
    """
    return _read(path, lambda fields: nearest_camera(lens_of_fields(fields)))


def read_exact_lens(path: Path) -> tuple[OpencvLens, np.ndarray | None]:
    """Read from the same files the lens as it stands, and P R, shape (3, 3), which images its rectified picture.

    The latter is None where the file does not tell it. InputError as of `read_camera_info`.
    """
    return _read(path, lambda fields: (lens_of_fields(fields), _rectified(fields)))


def _rectified(fields: Mapping[str, Any]) -> np.ndarray | None:
    if not fields.keys() & {'projection_matrix', 'p'}:
        return None
    projection = np.array(_numbers(fields, (12,), 'projection_matrix', 'p')).reshape(3, 4)
    turn = (np.array(_numbers(fields, (9,), 'rectification_matrix', 'r')).reshape(3, 3)
            if fields.keys() & {'rectification_matrix', 'r'} else np.eye(3))
    told = projection[0, 0] > 0 and projection[1, 1] > 0 and abs(np.linalg.det(turn)) > 0.5
    return projection[:, :3] @ turn if told else None


def _read(path: Path, make: Callable[[Mapping[str, Any]], Read]) -> Read:
    """Return what is made of the fields of a file; InputError names the file."""
    try:
        return make(_fields(Path(os.path.expanduser(path))))
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except AutocalibError as error:
        raise InputError(f'{path}: {error}') from error


def _fields(path: Path) -> Mapping[str, Any]:
    """Return the first YAML document of a file, keys in lower case: ROS 1 prints K, D, R, P."""
    with path.open('rb') as stream:
        text = stream.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise InputError(f'it is longer than {MAX_BYTES} bytes, so it is no camera_info; {WHAT_TO_GIVE}')
    try:
        document = next(yaml.safe_load_all(text), None)
    except Exception as error:  # tags and numbers that YAML cannot make sense of leave PyYAML as errors of any kind
        said = ' '.join(str(error).split())[:200]
        raise InputError(f'it is not YAML ({said or type(error).__name__}); {WHAT_TO_GIVE}') from error
    if not isinstance(document, Mapping):
        raise InputError(f'it holds no names with values; {WHAT_TO_GIVE}')
    return {str(key).lower(): value for key, value in document.items() if isinstance(key, str)}


def lens_of_fields(fields: Mapping[str, Any]) -> OpencvLens:
    """Return the lens of a CameraInfo given by the names of its fields, lists as lists; InputError where it is none."""
    width, height = _pixels(fields, 'image_width', 'width'), _pixels(fields, 'image_height', 'height')
    model, sizes = _model(fields)
    matrix = np.array(_numbers(fields, (9,), 'camera_matrix', 'k')).reshape(3, 3)
    _require_calibrated(matrix)
    _require_whole(fields, width, height)
    given = _numbers(fields, sizes, 'distortion_coefficients', 'd')
    equidistant = model in ('equidistant', 'fisheye')
    coefficients = (*given, *[0.0] * ((4 if equidistant else 8) - len(given)))
    if coefficients == (EQUIDISTANT_FLOOR, 0.0, 0.0, 0.0):
        coefficients = (0.0,) * 4  # the floor that `camera_info` puts in
    return OpencvLens(width=width, height=height, matrix=matrix, equidistant=equidistant, coefficients=coefficients)


def _found(fields: Mapping[str, Any], *names: str) -> Any:
    """Return the value under the first of the names that is there."""
    for name in names:
        if name in fields:
            return fields[name]
    raise InputError(f"it has no '{names[0]}' (nor '{names[1]}'); {WHAT_TO_GIVE}")


def _model(fields: Mapping[str, Any]) -> tuple[str, tuple[int, ...]]:
    given = _found(fields, 'distortion_model', 'camera_model')
    name = given.strip().lower() if isinstance(given, str) else ''
    if name not in MODELS:
        raise InputError(f"its distortion model is {_shown(given)}, and only {', '.join(MODELS)} are read;"
                         ' calibrate the camera anew with one of these, or leave the file out')
    return name, MODELS[name]


def _pixels(fields: Mapping[str, Any], *names: str) -> int:
    value = _number(_found(fields, *names), names[0])
    if not (1 <= value <= MAX_NUMBER and value == int(value)):
        raise InputError(f"its '{names[0]}' is {value:g}, not a number of pixels; {WHAT_TO_GIVE}")
    return int(value)


def _numbers(fields: Mapping[str, Any], sizes: tuple[int, ...], *names: str) -> list[float]:
    """Return a matrix of camera_info_manager, which has rows, cols and data, or a plain list."""
    value = _found(fields, *names)
    if isinstance(value, Mapping):
        value = value.get('data')
    if not isinstance(value, list):
        raise InputError(f"its '{names[0]}' holds no list of numbers; {WHAT_TO_GIVE}")
    if len(value) not in sizes:
        expected = ' or '.join(map(str, sizes)) if len(sizes) < 3 else f'{sizes[-1]} at the most'
        raise InputError(f"its '{names[0]}' holds {len(value)} numbers, expected {expected}; {WHAT_TO_GIVE}")
    return [_number(item, names[0]) for item in value]


def _number(value: Any, name: str) -> float:
    """Return a number; YAML takes `1e-05`, without a point, for text."""
    try:
        number = float(value) if isinstance(value, (int, float, str)) and not isinstance(value, bool) else None
    except (ValueError, OverflowError):
        number = None
    if number is None or not abs(number) <= MAX_NUMBER:
        raise InputError(f"its '{name}' holds {_shown(value)}, not a finite number; {WHAT_TO_GIVE}")
    return number


def _shown(value: Any) -> str:
    """Return a value for a message; of what a hostile file has folded together no more than its kind."""
    return f'a {type(value).__name__}' if isinstance(value, (list, Mapping)) else reprlib.repr(value)


def _require_calibrated(matrix: np.ndarray) -> None:
    if matrix[0, 0] == 0 or matrix[1, 1] == 0:
        raise InputError('it is of a camera that is not calibrated, its focal length is 0:'
                         ' calibrate the camera, or leave the file out')
    if min(matrix[0, 0], matrix[1, 1]) < 1 or matrix[1, 0] != 0 or matrix[2].tolist() != [0, 0, 1]:
        raise InputError("its 'camera_matrix' is not of the form fx s cx, 0 fy cy, 0 0 1 with fx and fy in pixels;"
                         f' {WHAT_TO_GIVE}')


def _require_whole(fields: Mapping[str, Any], width: int, height: int) -> None:
    """Refuse a region of interest: its images are cut out, and nothing in them tells from where."""
    region = fields.get('roi')
    if not isinstance(region, Mapping) or not region.get('width') or not region.get('height'):
        return
    if (region['width'], region['height']) != (width, height):
        raise InputError('it is of a camera that sends only a region of interest (roi);'
                         ' give a calibration of the size of the images, without roi')
