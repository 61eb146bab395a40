"""DOCSTRING."""

from __future__ import annotations

import os
import re
import reprlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from autocalib_ros.errors import AutocalibError, InputError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import EQUIDISTANT_FLOOR, MODELS, CameraInfo, camera_info
from autocalib_ros.lens.opencv_lens import OpencvLens, nearest_camera
from autocalib_ros.util.files import write_atomically

MAX_BYTES = 1_000_000
"""No camera_info is nearly so long."""
MAX_NUMBER = 1e9
"""Beyond this nothing is meant in earnest, and powers of it would leave the numbers of a computer."""
Read = TypeVar('Read')
WHAT_TO_GIVE = 'give the file of camera_info_manager, or what `ros2 topic echo --once` prints of a CameraInfo'


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
