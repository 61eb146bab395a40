"""The document calibration.json, written and read to the last bit: what is read and written again is the same text."""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.errors import AutocalibError, InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import (
    COVARIANCE_PARAMETERS,
    GROUND_DISTANCES_M,
    Calibration,
    EvidenceSummary,
    PaperReport,
    Refusal,
    StandardDeviations,
)
from autocalib_ros.results.camera_move import CameraMove
from autocalib_ros.results.grades import GroundSigma, HelpfulMeasure
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import UNKNOWN_KIND, Statement, Value
from autocalib_ros.results.verification_table import VerificationRow
from autocalib_ros.util.documents import read_json
from autocalib_ros.util.files import write_atomically

ROTATION_TOLERANCE = 1e-6
"""How far the columns of a rotation may be from unit length and right angles."""


def read_json_object(path: Path) -> Mapping[str, Any]:
    """Return the document in a file; InputError where it is not there, too long, or no JSON object."""
    document = read_json(path, 'calibration')
    if not isinstance(document, Mapping):
        raise InputError(f'{path}: it holds no names with values')
    return document


def calibration_from_json(document: Mapping[str, Any]) -> Calibration:
    """Return the calibration of a document of calibration.json; InputError says what is wrong with it."""
    if document.get('version') not in READ_VERSIONS:
        versions = f'{READ_VERSIONS[0]} to {READ_VERSIONS[-1]}'
        raise InputError(f'its version is {reprlib.repr(document.get("version"))}; versions {versions} can be read')
    if document.get('state') != 'calibrated':
        raise InputError(
            f'its state is {reprlib.repr(document.get("state"))}: it holds no calibration{_refusal_text(document)}'
        )
    try:
        return _parse_calibration(document)
    except AutocalibError as error:
        raise InputError(str(error)) from error
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        raise InputError(f'it is no whole calibration.json ({type(error).__name__}: {error})') from error


def _refusal_text(document: Mapping[str, Any]) -> str:
    """Return the reason of a refusal in brackets, '' where none is given."""
    refusal = document.get('refusal')
    return (
        f' ({refusal["code"]}: {refusal["message"]})'
        if isinstance(refusal, Mapping) and {'code', 'message'} <= refusal.keys()
        else ''
    )


def _parse_calibration(document: Mapping[str, Any]) -> Calibration:
    width, height = _numbers(document['image_size'], int, 2)
    lens, evidence, paper = document['camera'], document['evidence'], document['paper']
    camera = Camera(
        width,
        height,
        _number(lens['focal_px']),
        _numbers(lens['principal_point_px'], _number, 2),
        _numbers(lens['k'], _number, 4),
        _number(lens.get('pixel_aspect', 1.0)),
        _number(lens.get('skew', 0.0)),
    )
    grade, pose, reason = str(document['grade']), document['ground_from_camera'], document['refusal']
    return Calibration(
        method=str(document['method']),
        grade=grade,
        assumptions=tuple(map(_parse_statement, document['assumptions'])),
        checks=tuple(map(_parse_statement, document['checks'])),
        verification=tuple(map(_parse_row, document.get('verification', ()))),
        camera=camera,
        ground=None if pose is None else _parse_ground(pose, metric=grade != 'unit_scale'),
        ground_refusal=None if reason is None else _parse_reason(reason),
        road_directions=_array(document['road_directions_in_camera']).reshape(-1, 3),
        stddev=_parse_stddev(document['stddev'], document.get('ground_sigma_rel')),
        paper=None if paper is None else _parse_paper(paper),
        evidence=EvidenceSummary(
            image_size=(width, height),
            seconds=_number(evidence['seconds']),
            frames=int(evidence['frames']),
            tracks=int(evidence['tracks']),
            segments=int(evidence['segments']),
            vehicles=int(evidence['vehicles']),
            coverage=_number(evidence['coverage']),
            people=int(evidence.get('people', 0)),
        ),
        newest_stamp_ns=int(document['newest_stamp_ns']),
        helpful=_parse_helpful(document.get('helpful_measure')),
        covariance=_parse_covariance(document.get('covariance')),
    )


def _parse_statement(entry: Any) -> Statement:
    """Return an assumption or a check; version 1 holds texts alone, some of which tell the source of the scale."""
    if isinstance(entry, str):
        return Statement(SCALE_OF_VERSION_1 if entry.startswith('scale by ') else UNKNOWN_KIND, entry)
    return Statement(str(entry['kind']), str(entry['text']), _parse_values(entry['values']))


def _parse_row(entry: Mapping[str, Any]) -> VerificationRow:
    value, passed = _optional_float(entry['value']), entry['passed']
    if not isinstance(passed, bool):
        raise InputError(f'true or false was expected for passed, got {reprlib.repr(passed)}')
    return VerificationRow(str(entry['check']), value, _number(entry['limit']), passed)


def _parse_reason(entry: Mapping[str, Any]) -> Reason:
    values = _parse_values(entry.get('values', {}))
    return Reason(str(entry['code']), str(entry['message']), str(entry['remedy']), values)


def _parse_values(values: Any) -> dict[str, Value]:
    """Return the numbers of a statement or a refusal; InputError if there is anything else among them."""
    if not isinstance(values, Mapping) or not all(isinstance(value, Value) for value in values.values()):
        raise InputError(f'numbers, texts or null were expected, got {reprlib.repr(values)}')
    return dict(values)


def _parse_ground(pose: Mapping[str, Any], *, metric: bool) -> GroundPlane:
    rotation = _array(pose['rotation']).reshape(3, 3)
    height = _numbers(pose['translation_m'], _number, 3)[2]
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError('its rotation is none: its rows are not of unit length at right angles')
    if not 0 < height < np.inf:
        raise InputError(f'its camera is {height:g} above the road')
    return GroundPlane(rotation, height, metric)


def _parse_stddev(sigma: Mapping[str, Any], ground: Mapping[str, Any] | None) -> StandardDeviations:
    point = sigma['principal_point_px']
    return StandardDeviations(
        **{name: _optional_float(sigma[name]) for name in ('focal_px', 'k1', 'k2', 'tilt_deg', 'roll_deg', 'height_m')},
        principal_point_px=None if point is None else _numbers(point, _number, 2),
        ground_point_m=tuple(_optional_float(value) for value in sigma['ground_point_m'].values()),
        ground=None if ground is None else GroundSigma(_number(ground['along']), _number(ground['across'])),
    )


def _parse_helpful(entry: Mapping[str, Any] | None) -> HelpfulMeasure | None:
    return None if entry is None else HelpfulMeasure(str(entry['kind']), _number(entry['expected_sigma_rel']))


def _parse_covariance(entry: Mapping[str, Any] | None) -> np.ndarray | None:
    if entry is None or entry['of'] != list(COVARIANCE_PARAMETERS):
        return None
    return _array(entry['matrix']).reshape(2 * (len(COVARIANCE_PARAMETERS),))


def _parse_paper(paper: Mapping[str, Any]) -> PaperReport:
    straightness, translation = paper['straightness_px2'], paper['translation_m']
    return PaperReport(
        focal_px=_number(paper['focal_px']),
        polynomial_k=_numbers(paper['polynomial_k'], _number, 3),
        straightness_px2=(_number(straightness['before']), _number(straightness['after'])),
        focal_from_vanishing_points_px=_optional_float(paper['focal_from_vanishing_points_px']),
        translation_m=None if translation is None else _numbers(translation, _number, 3),
    )


def _optional_float(value: Any) -> float | None:
    return None if value is None else _number(value)


def _number(value: Any) -> float:
    """Return a finite number; ValueError for anything else: `float` takes the texts 'nan' and 'inf' too."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f'{reprlib.repr(value)} is no finite number')
    return float(value)


def _array(values: Any) -> np.ndarray:
    """Return finite numbers as an array of any shape; ValueError for anything else."""
    array = np.array(values)
    if array.size and (array.dtype.kind not in 'if' or not np.isfinite(array).all()):
        raise ValueError(f'{reprlib.repr(values)} are no finite numbers')
    return array.astype(float)


def _numbers(values: Any, kind: Callable[[Any], Any], count: int) -> tuple[Any, ...]:
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f'{reprlib.repr(values)} are not {count} numbers')
    return tuple(kind(value) for value in values)


JSON_VERSION = 3
READ_VERSIONS = (1, 2, 3)
"""Version 1 holds assumptions and checks as texts; versions 1 and 2 grade planes as full or assumed, without
`ground_sigma_rel`."""
SCALE_OF_VERSION_1 = 'scale_height'
"""Kind of the scale in a file of version 1: the text alone names its source."""


def to_json(
    result: Calibration | Refusal, *, accepted_at_s: float | None = None, moves: Sequence[CameraMove] = ()
) -> dict[str, Any]:
    """Return the document of calibration.json."""
    evidence = result.evidence
    document: dict[str, Any] = {
        'version': JSON_VERSION,
        'state': 'calibrated' if result else 'refused',
        'grade': None,
        'method': result.method,
        'assumptions': [],
        'checks': [],
        'verification': [],
        'refusal': None,
        'image_size': list(evidence.image_size),
        'camera': None,
        'camera_info': None,
        'ground_from_camera': None,
        'road_directions_in_camera': [],
        'ground_sigma_rel': None,
        'helpful_measure': None,
        'candidate': None,
        'stddev': None,
        'covariance': None,
        'paper': None,
        'newest_stamp_ns': None,
        'evidence': {
            'seconds': evidence.seconds,
            'frames': evidence.frames,
            'tracks': evidence.tracks,
            'segments': evidence.segments,
            'vehicles': evidence.vehicles,
            'people': evidence.people,
            'coverage': evidence.coverage,
            'accepted_at_s': accepted_at_s,
        },
        'moves': [_move_json(move) for move in moves],
    }
    if isinstance(result, Refusal):
        document['refusal'] = _refusal_json(result)
        document['candidate'] = None if result.candidate is None else _calibration_json(result.candidate)
    else:
        document.update(_calibration_json(result))
    return document


def _move_json(move: CameraMove) -> dict[str, Any]:
    """Return a move of the camera; null for what was not measured."""
    measured = move.is_measured
    return {
        'time_s': move.time_s,
        'kind': move.kind.value,
        **{name: getattr(move, name) if measured else None for name in ('pan_deg', 'tilt_deg', 'roll_deg', 'zoom')},
        'sigma_deg': None if move.sigma_deg is None else list(move.sigma_deg),
    }


def _statement_json(statement: Statement) -> dict[str, Any]:
    return {'kind': statement.kind, 'text': statement.text, 'values': dict(statement.values)}


def _row_json(row: VerificationRow) -> dict[str, Any]:
    return {'check': row.kind, 'value': row.value, 'limit': row.limit, 'passed': row.passed, 'text': str(row)}


def _refusal_json(refusal: Refusal | Reason) -> dict[str, Any]:
    return {
        'code': refusal.code,
        'message': refusal.message,
        'remedy': refusal.remedy,
        'values': dict(refusal.values),
    }


def _calibration_json(result: Calibration) -> dict[str, Any]:
    camera, info, sigma = result.camera, result.camera_info, result.stddev
    return {
        'grade': result.grade,
        'assumptions': [_statement_json(statement) for statement in result.assumptions],
        'checks': [_statement_json(statement) for statement in result.checks],
        'verification': [_row_json(row) for row in result.verification],
        'refusal': _refusal_json(result.ground_refusal) if result.ground_refusal else None,
        'camera': {
            'model': 'kannala_brandt',
            'focal_px': camera.focal_px,
            'principal_point_px': list(camera.principal_point_px),
            'k': list(camera.k),
            'pixel_aspect': camera.pixel_aspect,
            'skew': camera.skew,
        },
        'camera_info': {'distortion_model': info.distortion_model, 'k': info.k, 'd': info.d, 'r': info.r, 'p': info.p},
        'ground_from_camera': None
        if result.ground is None
        else {
            'translation_m': result.ground.translation_m.tolist(),
            'rotation_xyzw': result.ground.rotation_xyzw.tolist(),
            'rotation': np.asarray(result.ground.rotation).tolist(),
        },
        'newest_stamp_ns': result.newest_stamp_ns,
        'road_directions_in_camera': np.asarray(result.road_directions).tolist(),
        'ground_sigma_rel': None
        if sigma.ground is None
        else {'along': sigma.ground.along, 'across': sigma.ground.across},
        'helpful_measure': None
        if result.helpful is None
        else {
            'kind': result.helpful.kind,
            'text': result.helpful.text,
            'expected_sigma_rel': result.helpful.expected,
        },
        'stddev': {
            'focal_px': sigma.focal_px,
            'principal_point_px': None if sigma.principal_point_px is None else list(sigma.principal_point_px),
            'k1': sigma.k1,
            'tilt_deg': sigma.tilt_deg,
            'roll_deg': sigma.roll_deg,
            'height_m': sigma.height_m,
            'k2': sigma.k2,
            'ground_point_m': {
                f'{distance:g}': value
                for distance, value in zip(GROUND_DISTANCES_M, sigma.ground_point_m, strict=False)
            },
        },
        'covariance': None
        if result.covariance is None
        else {'of': list(COVARIANCE_PARAMETERS), 'matrix': result.covariance.tolist()},
        'paper': None
        if result.paper is None
        else {
            'focal_px': result.paper.focal_px,
            'polynomial_k': list(result.paper.polynomial_k),
            'straightness_px2': dict(zip(('before', 'after'), result.paper.straightness_px2, strict=True)),
            'focal_from_vanishing_points_px': result.paper.focal_from_vanishing_points_px,
            'translation_m': None if result.paper.translation_m is None else list(result.paper.translation_m),
        },
    }


def calibration_json(
    result: Calibration | Refusal, *, accepted_at_s: float | None = None, moves: Sequence[CameraMove] = ()
) -> str:
    """Return the text of calibration.json in full precision."""
    return json.dumps(to_json(result, accepted_at_s=accepted_at_s, moves=moves), indent=1, allow_nan=False)


def write_calibration_json(
    path: Path,
    result: Calibration | Refusal,
    *,
    accepted_at_s: float | None = None,
    moves: Sequence[CameraMove] = (),
) -> None:
    """Write calibration.json, atomically."""
    write_atomically(path, calibration_json(result, accepted_at_s=accepted_at_s, moves=moves) + '\n')
