"""Control points: pixels on the road whose places in a map are known, and where the ground frame lies in that map."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.util.documents import parse_json, read_text

LOCAL = 'local'
"""Name of a map that is just metres."""
PIXEL_COLUMNS = ('u_px', 'v_px')
PLACE_COLUMNS = ('x_m', 'y_m')
GEOGRAPHIC_COLUMNS = ('lat', 'lon')
OTVISION_SUFFIX = '.otrfpts'
MAX_CONTROL_POINTS = 1000
PYPROJ_MISSING = (
    'latitudes and longitudes need pyproj: pip install pyproj, or give metres (x_m and y_m, UTM for example)'
)
EXPECTED_FILE = (
    f'expected a CSV file with a line of names, {", ".join(PIXEL_COLUMNS)} and either {", ".join(PLACE_COLUMNS)} '
    f'(metres, UTM for example) or {", ".join(GEOGRAPHIC_COLUMNS)} (WGS84), or reference points of OTVision '
    f'({OTVISION_SUFFIX})'
)


@dataclass(frozen=True)
class ControlPoints:
    """Points on the road in pixels and in a map."""

    names: tuple[str, ...]
    pixels: np.ndarray
    """Pixels of the full image, shape (n, 2)."""
    places_m: np.ndarray
    """East and north in the map, metres, shape (n, 2)."""
    crs: str = LOCAL
    """The map: an EPSG code such as 'EPSG:32632' for UTM zone 32 north, or 'local'."""

    def distances(self) -> list[tuple[int, int, float]]:
        """Return pairs of points with their distance in metres: the n - 1 longest that join all points.

        Their errors are as independent as distances between points can be; all pairs would count each point often.
        """
        gaps = np.hypot(*(self.places_m[:, None] - self.places_m).transpose(2, 0, 1))
        longest, joined_to = gaps[0].copy(), np.zeros(len(gaps), int)  # from each point to those that are joined
        longest[0], pairs = -np.inf, []
        for _ in range(len(gaps) - 1):
            other = int(longest.argmax())
            pairs.append((int(joined_to[other]), other, float(longest[other])))
            longer = (gaps[other] > longest) & np.isfinite(longest)
            longest[longer], joined_to[longer] = gaps[other, longer], other
            longest[other] = -np.inf
        return pairs


@dataclass(frozen=True)
class MapPlacement:
    """Where the ground frame lies in a map: place = translation + scale * R(heading) * ground."""

    crs: str
    heading_deg: float
    """Direction of the ground's x axis, counter-clockwise from east."""
    translation_m: tuple[float, float]
    """East and north of the ground's origin, the foot of the camera."""
    scale: float
    """Metres of the map for one of the ground; 1 if the scale of the calibration is right."""
    residuals_m: tuple[float, ...]
    """Distance of each control point from its place."""
    left_out_m: tuple[float, ...]
    """The same where each point is left out of the fit in its turn; empty for two points."""

    def to_map(self, points_m: np.ndarray) -> np.ndarray:
        """Return east and north (n, 2) of ground points (n, 2), with the scale of the calibration."""
        turned = _turn(points_m[:, :2], math.radians(self.heading_deg))
        return turned + self.translation_m

    def document(self, points: ControlPoints) -> dict[str, Any]:
        """Return the placement for map.json."""
        return {
            'crs': self.crs,
            'heading_deg': self.heading_deg,
            'translation_m': list(self.translation_m),
            'scale': self.scale,
            'points': [
                {
                    'name': name,
                    'pixel': points.pixels[index].tolist(),
                    'place_m': points.places_m[index].tolist(),
                    'residual_m': self.residuals_m[index],
                    'left_out_m': self.left_out_m[index] if self.left_out_m else None,
                }
                for index, name in enumerate(points.names)
            ],
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> MapPlacement:
        """Read map.json; InputError if it is none."""
        try:
            east_m, north_m = (float(value) for value in document['translation_m'])
            points = document['points']
            left_out = [point['left_out_m'] for point in points]
            found = cls(
                str(document['crs']),
                float(document['heading_deg']),
                (east_m, north_m),
                float(document['scale']),
                tuple(float(point['residual_m']) for point in points),
                tuple(float(value) for value in left_out if value is not None),
            )
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(f'it is no map.json of --control-points ({error})') from error
        if not np.isfinite([found.heading_deg, east_m, north_m, found.scale]).all():
            raise InputError('it is no map.json of --control-points: a number is not finite')
        return found


def place_in_map(ground_m: np.ndarray, points: ControlPoints) -> MapPlacement:
    """Return where the ground frame lies, from control points (n, 2) on the ground, at least two.

    Heading and translation are those of least squares with the scale of the calibration; `scale` is fitted beside them
    and tells how well that scale agrees. UsageError for fewer than two points on the road.
    """
    on_road = np.isfinite(ground_m).all(axis=1)
    if not on_road.all():
        named = ', '.join(points.names[index] for index in np.flatnonzero(~on_road))
        raise UsageError(f'control points {named} lie above the horizon: check their pixels')
    heading, translation, scale = _fitted(ground_m, points.places_m)
    residuals = np.hypot(*(_turn(ground_m, heading) + translation - points.places_m).T)
    return MapPlacement(
        points.crs,
        math.degrees(heading),
        (float(translation[0]), float(translation[1])),
        scale,
        tuple(residuals.tolist()),
        tuple(_left_out(ground_m, points.places_m)) if len(ground_m) > 2 else (),
    )


def _left_out(ground_m: np.ndarray, places_m: np.ndarray) -> list[float]:
    errors = []
    for index in range(len(ground_m)):
        others = np.arange(len(ground_m)) != index
        heading, translation, _ = _fitted(ground_m[others], places_m[others])
        errors.append(float(np.hypot(*(_turn(ground_m[index][None], heading)[0] + translation - places_m[index]))))
    return errors


def _fitted(ground_m: np.ndarray, places_m: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Return heading in radians, translation and scale of least squares."""
    one, other = (points[:, 0] + 1j * points[:, 1] for points in (ground_m, places_m))
    arms, aims = one - one.mean(), other - other.mean()
    turn = np.vdot(arms, aims)
    scale = float(abs(turn) / max(float(np.vdot(arms, arms).real), 1e-12))
    heading = float(np.angle(turn))
    shift = other.mean() - np.exp(1j * heading) * one.mean()
    return heading, np.array([shift.real, shift.imag]), scale


def _turn(points_m: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    return points_m @ np.array([[cosine, sine], [-sine, cosine]])


def read_control_points(path: Path) -> ControlPoints:
    """Read a CSV file or OTVision's reference points; InputError says what is wrong and what was expected."""
    text = read_text(path, f'file of control points; {EXPECTED_FILE}')
    try:
        points = _read_otvision(text) if path.suffix == OTVISION_SUFFIX else _read_csv(text)
    except (InputError, LookupError, TypeError, ValueError, AttributeError, csv.Error) as error:
        raise InputError(f'{path}: {error or type(error).__name__}; {EXPECTED_FILE}') from error
    if not 2 <= len(points.pixels) <= MAX_CONTROL_POINTS:
        raise InputError(f'{path} has {len(points.pixels)} control points, 2 to {MAX_CONTROL_POINTS} are needed')
    if not (np.isfinite(points.pixels).all() and np.isfinite(points.places_m).all()):
        raise InputError(f'{path} holds numbers that are not finite')
    if not np.ptp(points.places_m, axis=0).any():
        raise InputError(f'{path}: all control points have one place in the map')
    return points


def _read_csv(text: str) -> ControlPoints:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith('#')]
    delimiter = ';' if lines and ';' in lines[0] else ','
    rows = list(csv.DictReader(lines, delimiter=delimiter, skipinitialspace=True))
    if not rows:
        raise ValueError('it has no points')
    columns = {name.strip() for name in rows[0] if name}
    if not columns.issuperset(PIXEL_COLUMNS) or not (
        columns.issuperset(PLACE_COLUMNS) or columns.issuperset(GEOGRAPHIC_COLUMNS)
    ):
        raise ValueError(f'its columns are {", ".join(sorted(columns))}')
    names = tuple((row.get('name') or str(number)).strip() for number, row in enumerate(rows, start=1))
    pixels = _numbers(rows, PIXEL_COLUMNS)
    if columns.issuperset(PLACE_COLUMNS):
        crs = {(row.get('crs') or LOCAL).strip() for row in rows}
        if len(crs) > 1:
            raise ValueError(f'its points are of several maps: {", ".join(sorted(crs))}')
        return ControlPoints(names, pixels, _numbers(rows, PLACE_COLUMNS), crs.pop())
    places, code = to_utm(_numbers(rows, GEOGRAPHIC_COLUMNS))
    return ControlPoints(names, pixels, places, code)


def _numbers(rows: Sequence[Mapping[str, str]], columns: Sequence[str]) -> np.ndarray:
    return np.array([[float(row[name]) for name in columns] for row in rows])


def _read_otvision(text: str) -> ControlPoints:
    document = parse_json(text)
    points = list(document.values())
    zones = {(int(point['zone_utm']), str(point['hemisphere']).upper()) for point in points}
    if len(zones) != 1:
        raise ValueError(f'its points are in {len(zones)} UTM zones')
    zone, hemisphere = zones.pop()
    return ControlPoints(
        tuple(document),
        np.array([[float(point['x_px']), float(point['y_px'])] for point in points]),
        np.array([[float(point['lon_utm']), float(point['lat_utm'])] for point in points]),
        utm_code(zone, hemisphere),
    )


def utm_code(zone: int, hemisphere: str) -> str:
    """Return the EPSG code of a UTM zone on WGS84; ValueError for another zone or hemisphere."""
    if not 1 <= zone <= 60 or hemisphere not in ('N', 'S'):
        raise ValueError(f'there is no UTM zone {zone} {hemisphere}')
    return f'EPSG:{(32600 if hemisphere == "N" else 32700) + zone}'


def to_utm(lat_lon: np.ndarray) -> tuple[np.ndarray, str]:
    """Return east and north (n, 2) of WGS84 latitudes and longitudes (n, 2), and the EPSG code of their UTM zone."""
    lat, lon = lat_lon.mean(axis=0)
    if not (np.abs(lat_lon[:, 0]) <= 84).all() or not (np.abs(lat_lon[:, 1]) <= 180).all():
        raise ValueError('a latitude or longitude lies outside of UTM: up to 84 and 180 degrees')
    zone = min(int((lon + 180) // 6) + 1, 60)
    code = utm_code(zone, 'N' if lat >= 0 else 'S')
    return np.column_stack(_transformer('EPSG:4326', code).transform(lat_lon[:, 0], lat_lon[:, 1])), code


def to_lon_lat(places_m: np.ndarray, crs: str) -> np.ndarray:
    """Return WGS84 longitudes and latitudes (n, 2) of places (n, 2) in a map; UsageError for a local one."""
    if crs == LOCAL:
        raise UsageError('the control points are in local metres: longitudes and latitudes need UTM or WGS84 places')
    lat, lon = _transformer(crs, 'EPSG:4326').transform(places_m[:, 0], places_m[:, 1])
    return np.column_stack([lon, lat])


def _transformer(source: str, target: str) -> Any:
    try:
        from pyproj import Transformer
        from pyproj.exceptions import CRSError
    except ImportError as error:
        raise UsageError(PYPROJ_MISSING) from error
    try:
        return Transformer.from_crs(source, target)
    except CRSError as error:
        raise UsageError(f"'{source}' is no map that pyproj knows: give an EPSG code such as EPSG:32632") from error
