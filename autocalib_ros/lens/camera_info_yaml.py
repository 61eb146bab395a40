"""Reading and writing of camera_info_manager's YAML, and reading of a CameraInfo printed by `ros2 topic echo`."""

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
from autocalib_ros.lens.camera_info import (
    DISTORTION_MODELS,
    EQUIDISTANT_K1_FLOOR,
    FISHEYE_MODELS,
    CameraInfo,
    camera_info,
)
from autocalib_ros.lens.opencv_lens import OpencvLens, fit_kannala_brandt
from autocalib_ros.util.documents import parse_yaml
from autocalib_ros.util.files import write_atomically
from autocalib_ros.util.input_limits import MAX_DOCUMENT_BYTES

INI_WORDS = (b'[image]', b'camera matrix')
"""What every camera_info in the INI format of Videre has."""
MAX_ABS_VALUE = 1e9
"""Maximum absolute value of a number: larger ones are errors, and their powers would overflow."""
Parsed = TypeVar('Parsed')
EXPECTED_INPUT = 'give the file of camera_info_manager, or the output of `ros2 topic echo --once` of a CameraInfo'


def write_camera_info_yaml(
    path: Path, camera: Camera, camera_name: str, distortion_model: str = 'auto', rectified_balance: float = 0.0
) -> None:
    """Write the file of camera_info_manager atomically; `camera_name` is reduced to letters, digits and _."""
    write_atomically(path, camera_info_yaml(camera_info(camera, distortion_model, rectified_balance), camera_name))


def sanitised_name(name: str) -> str:
    """Return a name with all but letters, digits and _ replaced, as camera_info_manager and frames need it."""
    return re.sub(r'[^A-Za-z0-9_]', '_', name)


def camera_info_yaml(info: CameraInfo, camera_name: str) -> str:
    """Return the text of camera_info_manager's file in full precision."""

    def matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
        return {'rows': rows, 'cols': cols, 'data': data}

    document = {
        'image_width': info.width,
        'image_height': info.height,
        'camera_name': sanitised_name(camera_name) or 'camera',
        'camera_matrix': matrix(3, 3, info.k),
        'distortion_model': info.distortion_model,
        'distortion_coefficients': matrix(1, len(info.d), info.d),
        'rectification_matrix': matrix(3, 3, info.r),
        'projection_matrix': matrix(3, 4, info.p),
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None)


def read_camera_info_fields(path: Path) -> CameraInfo:
    """Return the fields of camera_info_manager's file without conversion; InputError if it is invalid."""
    return _read(path, _parse_camera_info)


def _parse_camera_info(fields: Mapping[str, Any]) -> CameraInfo:
    model, sizes = _parse_model(fields)
    return CameraInfo(
        width=_parse_pixel_count(fields, 'image_width', 'width'),
        height=_parse_pixel_count(fields, 'image_height', 'height'),
        distortion_model=model,
        k=_parse_numbers(fields, (9,), 'camera_matrix', 'k'),
        d=_parse_numbers(fields, sizes, 'distortion_coefficients', 'd'),
        r=_parse_numbers(fields, (9,), 'rectification_matrix', 'r'),
        p=_parse_numbers(fields, (12,), 'projection_matrix', 'p'),
    )


def read_camera_info(path: Path | str) -> Camera:
    """Return the lens of camera_info_manager's YAML, or of a CameraInfo as `ros2 topic echo --once` prints it.

    'equidistant' is converted exactly, other models to the closest Kannala-Brandt lens. InputError names the fault,
    what was expected and the remedy.
    """
    return _read(path, lambda fields: fit_kannala_brandt(lens_from_fields(fields)))


def read_exact_lens(path: Path) -> tuple[OpencvLens, np.ndarray | None]:
    """Return the lens of such a file without conversion, and P R, shape (3, 3), which projects to its rectified image.

    P R is None if the file has none. InputError as of `read_camera_info`.
    """
    return _read(path, lambda fields: (lens_from_fields(fields), _rectified_projection(fields)))


def _rectified_projection(fields: Mapping[str, Any]) -> np.ndarray | None:
    if not fields.keys() & {'projection_matrix', 'p'}:
        return None
    projection = np.array(_parse_numbers(fields, (12,), 'projection_matrix', 'p')).reshape(3, 4)
    rectification = (
        np.array(_parse_numbers(fields, (9,), 'rectification_matrix', 'r')).reshape(3, 3)
        if fields.keys() & {'rectification_matrix', 'r'}
        else np.eye(3)
    )
    is_valid = projection[0, 0] > 0 and projection[1, 1] > 0 and abs(np.linalg.det(rectification)) > 0.5
    return projection[:, :3] @ rectification if is_valid else None


def _read(path: Path | str, parse: Callable[[Mapping[str, Any]], Parsed]) -> Parsed:
    """Return the fields of a file as parsed; InputError names the file."""
    try:
        return parse(_fields(Path(os.path.expanduser(path))))
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except AutocalibError as error:
        raise InputError(f'{path}: {error}') from error


def _fields(path: Path) -> Mapping[str, Any]:
    """Return the first YAML document of a file, keys in lower case: ROS 1 prints K, D, R, P."""
    with path.open('rb') as stream:
        text = stream.read(MAX_DOCUMENT_BYTES + 1)
    if len(text) > MAX_DOCUMENT_BYTES:
        raise InputError(f'it is longer than {MAX_DOCUMENT_BYTES} bytes, so it is no camera_info; {EXPECTED_INPUT}')
    if all(word in text for word in INI_WORDS):
        raise InputError(
            'it is of the INI format (ost.txt): give the ost.yaml that camera_calibration wrote beside it, or convert '
            'it by "ros2 run camera_calibration_parsers convert FILE.ini FILE.yaml"'
        )
    try:
        document = parse_yaml(text, first=True)
    except InputError as error:
        raise InputError(f'it {error}; {EXPECTED_INPUT}') from error
    if not isinstance(document, Mapping):
        raise InputError(f'it holds no names with values; {EXPECTED_INPUT}')
    return {str(key).lower(): value for key, value in document.items() if isinstance(key, str)}


def lens_from_fields(fields: Mapping[str, Any]) -> OpencvLens:
    """Return the lens of the fields of a CameraInfo, matrices as lists; InputError if they are invalid."""
    width, height = (
        _parse_pixel_count(fields, 'image_width', 'width'),
        _parse_pixel_count(fields, 'image_height', 'height'),
    )
    model, sizes = _parse_model(fields)
    matrix = np.array(_parse_numbers(fields, (9,), 'camera_matrix', 'k')).reshape(3, 3)
    _require_calibrated(matrix)
    _require_full_frame(fields, width, height)
    given = _parse_numbers(fields, sizes, 'distortion_coefficients', 'd')
    equidistant = model in FISHEYE_MODELS
    coefficients = (*given, *[0.0] * ((4 if equidistant else 8) - len(given)))
    if coefficients == (EQUIDISTANT_K1_FLOOR, 0.0, 0.0, 0.0):
        coefficients = (0.0,) * 4  # `camera_info` adds this floor
    return OpencvLens(width=width, height=height, matrix=matrix, equidistant=equidistant, coefficients=coefficients)


def _first_field(fields: Mapping[str, Any], *names: str) -> Any:
    """Return the value of the first of these names that is present."""
    for name in names:
        if name in fields:
            return fields[name]
    raise InputError(f"it has no '{names[0]}' (nor '{names[1]}'); {EXPECTED_INPUT}")


def _parse_model(fields: Mapping[str, Any]) -> tuple[str, tuple[int, ...]]:
    given = _first_field(fields, 'distortion_model', 'camera_model')
    name = given.strip().lower() if isinstance(given, str) else ''
    if name not in DISTORTION_MODELS:
        raise InputError(
            f'its distortion model is {_abbreviated(given)}, supported are {", ".join(DISTORTION_MODELS)};'
            ' recalibrate the camera with one of these, or leave the file out'
        )
    return name, DISTORTION_MODELS[name]


def _parse_pixel_count(fields: Mapping[str, Any], *names: str) -> int:
    value = _parse_number(_first_field(fields, *names), names[0])
    if not (1 <= value <= MAX_ABS_VALUE and value == int(value)):
        raise InputError(f"its '{names[0]}' is {value:g}, not a number of pixels; {EXPECTED_INPUT}")
    return int(value)


def _parse_numbers(fields: Mapping[str, Any], sizes: tuple[int, ...], *names: str) -> list[float]:
    """Return the numbers of a matrix, given as rows, cols and data or as a plain list."""
    value = _first_field(fields, *names)
    if isinstance(value, Mapping):
        value = value.get('data')
    if not isinstance(value, list):
        raise InputError(f"its '{names[0]}' is not a list of numbers; {EXPECTED_INPUT}")
    if len(value) not in sizes:
        expected = ' or '.join(map(str, sizes)) if len(sizes) < 3 else f'at most {sizes[-1]}'
        raise InputError(f"its '{names[0]}' has {len(value)} numbers, expected {expected}; {EXPECTED_INPUT}")
    return [_parse_number(item, names[0]) for item in value]


def _parse_number(value: Any, name: str) -> float:
    """Return a finite number; YAML parses `1e-05`, without a point, as text."""
    try:
        number = float(value) if isinstance(value, (int, float, str)) and not isinstance(value, bool) else None
    except (ValueError, OverflowError):
        number = None
    if number is None or not abs(number) <= MAX_ABS_VALUE:
        raise InputError(f"its '{name}' contains {_abbreviated(value)}, not a finite number; {EXPECTED_INPUT}")
    return number


def _abbreviated(value: Any) -> str:
    """Return a value for a message; of a list or mapping, which may be huge, only its type."""
    return f'a {type(value).__name__}' if isinstance(value, (list, Mapping)) else reprlib.repr(value)


def _require_calibrated(matrix: np.ndarray) -> None:
    if matrix[0, 0] == 0 or matrix[1, 1] == 0:
        raise InputError(
            'its camera is not calibrated, the focal length is 0: calibrate the camera, or leave the file out'
        )
    if min(matrix[0, 0], matrix[1, 1]) < 1 or matrix[1, 0] != 0 or matrix[2].tolist() != [0, 0, 1]:
        raise InputError(
            f"its 'camera_matrix' is not of the form fx s cx, 0 fy cy, 0 0 1 with fx and fy in pixels; {EXPECTED_INPUT}"
        )


def _require_full_frame(fields: Mapping[str, Any], width: int, height: int) -> None:
    """Raise InputError at a region of interest: the offset of its images in the full frame is unknown."""
    region = fields.get('roi')
    if not isinstance(region, Mapping) or not region.get('width') or not region.get('height'):
        return
    if (region['width'], region['height']) != (width, height):
        raise InputError(
            'its camera sends only a region of interest (roi);'
            ' give a calibration of the size of the images, without roi'
        )
