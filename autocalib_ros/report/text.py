"""Text of a result for the report and the terminal: verdict, uncertainty, next step, tables and requirements."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera, field_of_view_deg
from autocalib_ros.results.calibration import GROUND_DISTANCES_M, Calibration, Refusal
from autocalib_ros.results.camera_move import CameraMove
from autocalib_ros.results.history import describe_version
from autocalib_ros.results.road_words import in_road_words
from autocalib_ros.results.statements import SCALE_KINDS

MAX_ROWS = 12
"""Most versions in the report; the file has all."""


@dataclass(frozen=True)
class TableRow:
    """Table row as text: name, value, standard deviation and note."""

    name: str
    value: str
    sigma: str = ''
    note: str = ''


def verdict(result: Calibration | Refusal) -> str:
    """Return the result in words with uncertainties, or the reason why something is missing, with its numbers."""
    told = [headline(result)]
    return ' '.join([*told, _measured(result)] if isinstance(result, Refusal) and _measured(result) else told)


def _measured(result: Refusal) -> str:
    """Return the numbers of a refusal whose headline has none; '' if the headline is its message."""
    return f'{_sentence(_capital(result.message))}' if in_road_words(result.code, result.values) else ''


def measured(result: Calibration | Refusal) -> str:
    """Return the numbers behind the headline of a refusal, '' without."""
    return _measured(result) if isinstance(result, Refusal) else ''


def headline(result: Calibration | Refusal) -> str:
    """Return the result in one sentence with uncertainties, or what a refusal means at the road."""
    if isinstance(result, Refusal):
        return f'Not calibrated: {_sentence(in_road_words(result.code, result.values) or result.message)}'
    focal = f'focal length {_with_sigma(result.camera.focal_px, result.stddev.focal_px, 1)} px'
    if result.ground is None:
        why = '' if result.ground_refusal is None else ' ' + _sentence(_capital(result.ground_refusal.message))
        return f'The lens is calibrated ({focal}); there is no ground plane.{why}'
    down, _ = tilt_and_roll_deg(result.ground.normal_in_camera)
    pose = f'the camera looks {_with_sigma(down, result.stddev.tilt_deg, 1)} degrees down'
    if result.ground.metric:
        return f'Calibrated{_lesser_grade(result)}: {focal}; {pose} from {result.ground.height_m:.2f} m above the road.'
    return f'Calibrated: {focal}; {pose}; lengths on the road are in camera heights, because the height was not given.'


def _lesser_grade(result: Calibration) -> str:
    """Return the grade of a calibration with a metric ground plane, and why it is not full; '' for grade full."""
    if result.grade == 'full':
        return ''
    sigma = result.stddev.ground
    uncertain = '' if sigma is None or sigma.grade == 'full' else f', {sigma}'
    why = ', but a check contradicts it' if contradictions(result) else uncertain or ', ground plane by assumption'
    return f' (grade {result.grade}{why})'


def contradictions(result: Calibration | Refusal) -> list[str]:
    """Return the failed checks that contradict a calibration, in words."""
    rows = () if result.candidate is None else result.candidate.verification
    return [f'{row.name}: {row.value_text}, {row.limit_text}' for row in rows if row.contradicts]


def remedy(result: Calibration | Refusal) -> str:
    """Return the remedy of the refusal as a sentence; '' if nothing is missing."""
    refusal = result if isinstance(result, Refusal) else result.ground_refusal
    return '' if refusal is None else _sentence(_capital(refusal.remedy))


def _capital(text: str) -> str:
    return text if '_' in text.partition(' ')[0] else text[:1].upper() + text[1:]  # names of options stay


def _with_sigma(value: float, sigma: float | None, digits: int) -> str:
    return f'{value:.{digits}f}' if sigma is None else f'{value:.{digits}f} ± {sigma:.{digits}f}'


def sentence(text: str) -> str:
    """Return a text as a sentence: with a capital and a full stop."""
    return _sentence(_capital(text))


def _sentence(text: str) -> str:
    text = text.strip()
    return text if not text or text[-1] in '.!?' else text + '.'


def number_rows(result: Calibration | Refusal, accepted_at_s: float | None = None) -> list[TableRow]:
    """Return the table rows of lens, ground plane, published method and evidence."""
    found = result.candidate
    rows = [] if found is None else [*_lens_rows(found), *_ground_rows(found), *_paper_rows(found)]
    return rows + _evidence_rows(result, accepted_at_s)


def _lens_rows(result: Calibration) -> list[TableRow]:
    camera, sigma = result.camera, result.stddev
    cx, cy = camera.principal_point_px
    point = '' if sigma.principal_point_px is None else '{:.2f}, {:.2f}'.format(*sigma.principal_point_px)
    across, down = field_of_view_deg(camera)
    coefficients = [
        TableRow(f'k{index}', f'{value:.5f}', _number(sigma.k1, 5) if index == 1 else '')
        for index, value in enumerate(camera.k, start=1)
    ]
    return [
        TableRow('focal length', f'{camera.focal_px:.2f} px', _number(sigma.focal_px, 2)),
        *_pixel_rows(camera),
        TableRow('principal point', f'{cx:.2f}, {cy:.2f} px', point),
        *[row for row, value in zip(coefficients, camera.k, strict=True) if value or row.name == 'k1'],
        TableRow('field of view', f'{across:.1f} x {down:.1f} degrees', note='between the centres of opposite borders'),
    ]


def _pixel_rows(camera: Camera) -> list[TableRow]:
    """Return the row of pixels that are not square."""
    if camera.pixel_aspect == 1.0:
        return []
    note = f'focal length {camera.focal_px:.2f} px down the image, {camera.matrix[0, 0]:.2f} px across it'
    return [TableRow('pixel aspect', f'{camera.pixel_aspect:.4f}', note=note)]


def _ground_rows(result: Calibration) -> list[TableRow]:
    if result.ground is None:
        return []
    down, roll = tilt_and_roll_deg(result.ground.normal_in_camera)
    height = f'{result.ground.height_m:.2f} m' if result.ground.metric else '1 (unit)'
    note = next((statement.text for statement in result.assumptions if statement.kind in SCALE_KINDS), '')
    return [
        TableRow('camera height', height, _number(result.stddev.height_m, 2), note),
        TableRow('tilt', f'{down:.2f} degrees', _number(result.stddev.tilt_deg, 2), 'below the horizontal'),
        TableRow('roll', f'{roll:.2f} degrees', _number(result.stddev.roll_deg, 2)),
        *[
            TableRow(f'road {distance:g} m ahead', 'position', f'{sigma:.2f} m', 'of the ground point of a pixel')
            for distance, sigma in zip(GROUND_DISTANCES_M, result.stddev.ground_point_m, strict=False)
            if sigma is not None
        ],
    ]


def _paper_rows(result: Calibration) -> list[TableRow]:
    if result.paper is None:
        return []
    before, after = result.paper.straightness_px2
    return [
        TableRow("the paper's focal length", f'{result.paper.focal_px:.1f} px', note='Jain & Saunier, for comparison'),
        TableRow(
            "the paper's polynomial",
            ', '.join(f'{value:.4f}' for value in result.paper.polynomial_k),
            note='k1, k2, k3 of x_u / x_d - 1; distorted to undistorted',
        ),
        TableRow('straightness', f'{before:.3g} before, {after:.3g} after, px²', note='mean squared line-fit error'),
    ]


def history_rows(history: Sequence[dict[str, Any]]) -> list[TableRow]:
    """Return a table row for each version of the calibration, the newest first."""
    return [TableRow(f'version of {entry["time"]}', describe_version(entry)) for entry in history[-MAX_ROWS:][::-1]]


def move_rows(moves: Sequence[CameraMove]) -> list[TableRow]:
    """Return a table row for each move of the camera."""
    return [TableRow(f'camera moved after {move.time_s:.1f} s', str(move)) for move in moves]


def file_rows(result: Calibration | Refusal, evidence: Evidence) -> list[TableRow]:
    """Return the table rows of the values in the output files, and of the method."""
    stillness = evidence.stillness
    rows = [
        TableRow('background motion', f'{evidence.drift_px:.2f} px', note='largest lasting displacement'),
        *([TableRow('sway', f'{stillness.sway_px:.1f} px', note='95 %, compensated')] if stillness.sway_px else []),
        *(
            [
                TableRow(
                    'still part used',
                    f'{stillness.start_s:.1f} to {stillness.end_s:.1f} s',
                    note=f'of {stillness.recorded_s:.1f} s; the view changed {len(stillness.changes)} times',
                )
            ]
            if stillness.changes
            else []
        ),
        TableRow('method', result.method),
    ]
    if not evidence.picture.fills_image:
        rows.insert(0, TableRow('picture', str(evidence.picture), note='the rest of the images is not used'))
    if isinstance(result, Refusal):
        return rows
    rows.append(TableRow('grade', result.grade))
    residuals = result.figures.residuals
    if len(residuals.distance_px):
        rows.append(
            TableRow('residual', f'{np.median(residuals.distance_px):.2f} px', note='median of all points used')
        )
    rows += [
        TableRow(f'direction of road {index}', _list(direction, 4), note='camera frame: x right, y down, z forward')
        for index, direction in enumerate(result.road_directions, start=1)
    ]
    info = result.camera_info
    rows += [
        TableRow('distortion_model', info.distortion_model),
        TableRow('camera_info K', _list(info.k, 2)),
        TableRow('camera_info D', _list(info.d, 6)),
        TableRow('camera_info P', _list(info.p, 2)),
    ]
    if result.ground is not None:
        rows += [
            TableRow('ground_from_camera', f'{_list(result.ground.rotation_xyzw, 6)}', note='quaternion x, y, z, w'),
            TableRow(
                'camera in the ground frame',
                f'{_list(result.ground.translation_m, 3)}' + (' m' if result.ground.metric else ''),
            ),
        ]
    paper = result.paper
    if paper is not None and paper.focal_from_vanishing_points_px is not None:
        rows.append(
            TableRow(
                "the paper's f_new",
                f'{paper.focal_from_vanishing_points_px:.1f} px',
                note='from its two vanishing points',
            )
        )
    if paper is not None and paper.translation_m is not None:
        rows.append(TableRow("the paper's t", _list(paper.translation_m, 3)))
    return rows


def _list(values: Iterable[float], digits: int) -> str:
    return ', '.join(f'{value:.{digits}f}' for value in values)


def _evidence_rows(result: Calibration | Refusal, accepted_at_s: float | None) -> list[TableRow]:
    evidence = result.evidence
    people = f' and {evidence.people} people' if evidence.people else ''
    rows = [
        TableRow('recording', f'{evidence.seconds:.1f} s, {evidence.frames} images'),
        TableRow(
            'traffic', f'{evidence.tracks} tracks of {evidence.vehicles} vehicles{people}, {evidence.segments} segments'
        ),
        TableRow('coverage', f'{100 * evidence.coverage:.0f} % of the image'),
    ]
    return rows + ([] if accepted_at_s is None else [TableRow('accepted after', f'{accepted_at_s:.1f} s')])


def _number(value: float | None, digits: int) -> str:
    return '' if value is None else f'{value:.{digits}f}'


def how_sure(result: Calibration | Refusal) -> str:
    """Return the uncertainty of the result, one standard deviation, as text; '' for a refusal without a candidate."""
    found = result.candidate
    if found is None:
        return ''
    sigma, parts = found.stddev, []
    if found.method == 'paper':
        return 'Unknown: the published method gives no uncertainty.'
    if sigma.focal_px == 0:
        parts.append('the lens is assumed exact')
    elif sigma.focal_px is not None:
        parts.append(f'focal length ± {100 * sigma.focal_px / found.camera.focal_px:.2g} %')
    if sigma.tilt_deg is not None and sigma.roll_deg is not None:
        parts.append(f'tilt ± {sigma.tilt_deg:.2f} and roll ± {sigma.roll_deg:.2f} degrees')
    if sigma.ground is not None:
        parts.append(str(sigma.ground))
    places = [
        f'± {sigma_m:.2f} m at {distance:g} m'
        for distance, sigma_m in zip(GROUND_DISTANCES_M, sigma.ground_point_m, strict=False)
        if sigma_m is not None
    ]
    parts += [f'position on the road {", ".join(places)}'] if places else []
    return _sentence(_capital('; '.join(parts))) + ' (One standard deviation: two thirds of results are closer.)'


def next_step(result: Calibration | Refusal) -> str:
    """Return the recommended next step."""
    if isinstance(result, Refusal) or remedy(result):
        return remedy(result)
    if result.method == 'paper':
        return 'Solve with method joint, which estimates uncertainties, and compare.'
    if result.grade == 'unit_scale':
        return 'Give the height of the camera above the road to get metres.'
    check = 'Check that the ground grid lies flat along the road markings'
    size = next((each.values for each in result.checks if each.kind == 'vehicle_size'), None)
    if size and any(row.kind == 'vehicle_size' and row.contradicts for row in result.verification):
        height = f'{size["usual_height_m"]:.3g} ± {size["usual_height_sigma_m"]:.2g} m'
        return (
            f'Check the camera height, or the length or speed from which it follows: at {height} the vehicles would be '
            'as large as usual.'
        )
    if contradictions(result):
        return f'{check}, and find out why the check failed before you rely on the result.'
    if result.helpful is not None:
        return f'{check}. What would help most: {result.helpful.text}.'
    if result.grade != 'full':
        return f'{check}; the ground plane depends on an assumption until crossing or turning traffic is observed.'
    return f'{check} and that the speeds are plausible for this road; then use the files.'
