"""A calibration in the formats of other programs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.ground import Ground
from autocalib_ros.lens.camera_info import FISHEYE_MODELS
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import calibration_from_json, read_json_object
from autocalib_ros.results.control_points import MapPlacement, to_lon_lat

AREA_GRID = (64, 36)
"""Columns and rows of pixels at which the road is sampled."""
REFERENCE_GRID = (4, 3)
"""Columns and rows of reference points for OTVision."""
UTM = re.compile(r'EPSG:32([67])(\d\d)')


@dataclass(frozen=True)
class RawHomography:
    """The 3x3 homography of raw pixels that fits the road best, which ignores the distortion of the lens."""

    matrix: np.ndarray
    """Takes pixels of the images as delivered to ground metres, shape (3, 3)."""
    median_m: float
    """Error of positions, median over the road."""
    high_m: float
    """Error of positions at 95 % of the road."""
    largest_m: float

    @property
    def description(self) -> str:
        """The errors in words."""
        return (
            f'a 3x3 homography of raw pixels, which ignores the distortion of the lens, is {self.median_m:.2g} m off '
            f'(median), {self.high_m:.2g} m at 95 % of the road and {self.largest_m:.2g} m at most'
        )


class ExportedCamera:
    """A calibration with the road that its camera sees."""

    def __init__(self, path: Path, range_m: float) -> None:
        """Read calibration.json or NAME.autocalib.json; InputError without a ground plane in metres."""
        if not 1.0 <= range_m <= 1000.0:
            raise UsageError(f'the range must lie between 1 and 1000 metres, got {range_m:g}')
        document = read_json_object(path)
        try:
            self.calibration: Calibration = calibration_from_json(document)
            self.ground = Ground.of(self.calibration)
        except InputError as error:
            raise InputError(f'{path}: {error}') from error
        self.name, self._range_m = path.stem, range_m
        self.size = (self.calibration.camera.width, self.calibration.camera.height)

    @cached_property
    def area(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) that show the road within the range, and their ground points (n, 2)."""
        grid = np.meshgrid(*(np.linspace(0, size - 1, count) for size, count in zip(self.size, AREA_GRID, strict=True)))
        pixels = np.stack(grid, axis=-1).reshape(-1, 2)
        found = self.ground.points(pixels)
        from_foot = np.hypot(*(found.points_m[:, :2] - self.ground.camera_m[:2]).T)
        near = found.valid & (from_foot <= self._range_m)
        if near.sum() < 2 * sum(AREA_GRID):
            raise UsageError(f'the camera hardly sees the road within {self._range_m:g} m of its foot: raise --range')
        return pixels[near], found.points_m[near, :2]

    @cached_property
    def raw(self) -> RawHomography:
        """The homography of raw pixels, and what it leaves."""
        pixels, points_m = self.area
        matrix, _ = cv2.findHomography(pixels, points_m)
        errors = np.hypot(*(apply_homography(matrix, pixels) - points_m).T)
        return RawHomography(matrix, *(float(np.quantile(errors, share)) for share in (0.5, 0.95, 1.0)))

    @property
    def rectified(self) -> np.ndarray:
        """Homography (3, 3) of pixels of the rectified image (image_rect) to ground metres, which is exact."""
        rotation, camera_m = self.ground.rotation, self.ground.camera_m
        to_camera = rotation.T @ np.column_stack([np.eye(3)[:, :2], -camera_m])
        matrix = np.linalg.inv(np.reshape(self.calibration.camera_info.p, (3, 4))[:, :3] @ to_camera)
        return np.asarray(matrix / matrix[2, 2])


def apply_homography(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 2) after a homography (3, 3)."""
    ends = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return np.asarray(ends[:, :2] / ends[:, 2:])


def _homography(camera: ExportedCamera, _: MapPlacement | None) -> str:
    lines = [
        'Homography of pixels of the rectified image (image_rect, autocalib rectify) to metres on the road: exact.',
        f'For images as delivered {camera.raw.description}: undistort points first.',
        'np.loadtxt reads it; x, y = (H @ [u, v, 1])[:2] / (H @ [u, v, 1])[2]',
    ]
    return _matrix_text(camera.rectified, lines)


def _raw_homography(camera: ExportedCamera, _: MapPlacement | None) -> str:
    lines = [
        'Homography of pixels of the images as delivered to metres on the road.',
        f'Note: {camera.raw.description}.',
    ]
    return _matrix_text(camera.raw.matrix, lines)


def _matrix_text(matrix: np.ndarray, lines: list[str]) -> str:
    rows = (' '.join(f'{value:.12e}' for value in row) for row in matrix)
    return '\n'.join([*(f'# {line}' for line in lines), *rows]) + '\n'


def _view_transformer(camera: ExportedCamera, _: MapPlacement | None) -> str:
    pixels, _points = camera.area
    along, across = pixels.sum(axis=1), pixels[:, 0] - pixels[:, 1]
    corners = pixels[[along.argmin(), across.argmax(), along.argmax(), across.argmin()]]
    document = {
        'source': np.round(corners, 2).tolist(),
        'target': np.round(apply_homography(camera.raw.matrix, corners), 4).tolist(),
        'note': f'pixels of the images as delivered to metres; {camera.raw.description}',
    }
    return json.dumps(document, indent=1) + '\n'


def _opencv(camera: ExportedCamera, _: MapPlacement | None) -> str:
    info, ground = camera.calibration.camera_info, camera.ground
    storage = cv2.FileStorage('.yml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write('image_width', info.width)
    storage.write('image_height', info.height)
    is_fisheye = info.distortion_model in FISHEYE_MODELS
    storage.write('distortion_model', 'fisheye' if is_fisheye else info.distortion_model)
    storage.write('camera_matrix', np.reshape(info.k, (3, 3)))
    storage.write('distortion_coefficients', np.reshape(info.d, (1, -1)))
    storage.write('rotation_vector', cv2.Rodrigues(ground.rotation.T)[0])
    storage.write('translation_vector', -(ground.rotation.T @ ground.camera_m)[:, None])
    return str(storage.releaseAndGetString())


def _kalibr(camera: ExportedCamera, _: MapPlacement | None) -> str:
    info = camera.calibration.camera_info
    if info.distortion_model not in FISHEYE_MODELS:
        raise UsageError(f'Kalibr has no model {info.distortion_model}: calibrate with distortion_model:=equidistant')
    chain = {
        'cam0': {
            'camera_model': 'pinhole',
            'intrinsics': [float(info.k[index]) for index in (0, 4, 2, 5)],
            'distortion_model': 'equidistant',
            'distortion_coeffs': [float(value) for value in [*info.d, 0.0, 0.0, 0.0, 0.0][:4]],
            'resolution': [info.width, info.height],
            'rostopic': '/image_raw',
        }
    }
    return str(yaml.safe_dump(chain, sort_keys=False, default_flow_style=None))


def _otvision(camera: ExportedCamera, placement: MapPlacement | None) -> str:
    known = _placed(placement)
    code = UTM.fullmatch(known.crs)
    if code is None:
        raise UsageError(f"OTVision takes UTM, and the control points are in '{known.crs}': give them with lat and lon")
    pixels, points_m = camera.area
    chosen = _spread(pixels, REFERENCE_GRID)
    places = known.to_map(points_m[chosen])
    document = {
        str(number): {
            'x_px': round(float(pixels[index, 0]), 2),
            'y_px': round(float(pixels[index, 1]), 2),
            'hemisphere': 'N' if code[1] == '6' else 'S',
            'zone_utm': int(code[2]),
            'lon_utm': round(float(place[0]), 3),
            'lat_utm': round(float(place[1]), 3),
        }
        for number, (index, place) in enumerate(zip(chosen, places, strict=True), start=1)
    }
    return json.dumps(document, indent=4) + '\n'


def _spread(pixels: np.ndarray, grid: tuple[int, int]) -> list[int]:
    """Return indices of pixels (n, 2) nearest to the nodes of a grid over them."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    nodes = np.stack(np.meshgrid(*(np.linspace(low[i], high[i], grid[i]) for i in range(2))), axis=-1).reshape(-1, 2)
    return sorted({int(np.hypot(*(pixels - node).T).argmin()) for node in nodes})


def _geojson(camera: ExportedCamera, placement: MapPlacement | None) -> str:
    known = _placed(placement)
    _pixels, points_m = camera.area
    outline = cv2.convexHull(points_m.astype(np.float32))[:, 0].astype(float)
    foot = to_lon_lat(known.to_map(camera.ground.camera_m[None, :2]), known.crs)[0]
    ring = to_lon_lat(known.to_map(np.vstack([outline, outline[:1]])), known.crs)
    height_m = float(camera.ground.camera_m[2])
    features = [
        _feature('Point', np.round(foot, 8).tolist(), {'what': 'camera', 'height_m': round(height_m, 3)}),
        _feature('Polygon', [np.round(ring, 8).tolist()], {'what': 'road in view', 'name': camera.name}),
    ]
    return json.dumps({'type': 'FeatureCollection', 'features': features}, indent=1) + '\n'


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {'type': 'Feature', 'geometry': {'type': kind, 'coordinates': coordinates}, 'properties': properties}


def _placed(placement: MapPlacement | None) -> MapPlacement:
    if placement is None:
        raise UsageError('the place in a map is not known: calibrate with --control-points, or give --map map.json')
    return placement


EXPORT_FORMATS: dict[str, Callable[[ExportedCamera, MapPlacement | None], str]] = {
    'homography': _homography,
    'raw-homography': _raw_homography,
    'view-transformer': _view_transformer,
    'opencv': _opencv,
    'kalibr': _kalibr,
    'otrfpts': _otvision,
    'geojson': _geojson,
}
RAW_FORMATS = ('raw-homography', 'view-transformer')
"""Formats that are wrong by the distortion of the lens."""


def export(camera: ExportedCamera, kind: str, placement: MapPlacement | None, max_error_m: float) -> str:
    """Return a calibration in a format; UsageError if its 3x3 homography of raw pixels is worse than the limit."""
    if kind in RAW_FORMATS and camera.raw.high_m > max_error_m:
        raise UsageError(
            f'{camera.raw.description}; more than {max_error_m:g} m at 95 % is not exported. Undistort the images '
            'first (autocalib rectify, then --format homography), lower --range, or raise --max-error'
        )
    return EXPORT_FORMATS[kind](camera, placement)


def read_placement(path: Path) -> MapPlacement:
    """Read map.json; InputError if it is none."""
    document = read_json_object(path)
    try:
        return MapPlacement.from_document(document)
    except InputError as error:
        raise InputError(f'{path}: {error}') from error
