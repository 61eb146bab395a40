"""A result in a person's words: for the terminal and for the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.calibration import GROUND_DISTANCES_M, Calibration, Refusal
from autocalib_ros.camera import Camera
from autocalib_ros.estimation.ground_plane import tilt_and_roll_deg


@dataclass(frozen=True)
class Row:
    """One number with its name, its standard deviation and what it means; all as text."""

    name: str
    value: str
    sigma: str = ''
    note: str = ''


def verdict(result: Calibration | Refusal) -> str:
    """Say what came out and how sure it is, and where something is missing, why."""
    if isinstance(result, Refusal):
        return f'Not calibrated: {_sentence(result.message)}'
    focal = f'focal length {_with_sigma(result.camera.focal_px, result.stddev.focal_px, 1)} px'
    if result.ground is None:
        why = '' if result.ground_refusal is None else ' ' + _sentence(_capital(result.ground_refusal.message))
        return f'The lens is calibrated ({focal}); there is no ground plane.{why}'
    down, _ = tilt_and_roll_deg(result.ground.normal_in_camera)
    pose = f'the camera looks {_with_sigma(down, result.stddev.tilt_deg, 1)} degrees down'
    if result.ground.metric:
        return f'Calibrated: {focal}; {pose} from {result.ground.height_m:.2f} m above the road.'
    return f"Calibrated: {focal}; {pose}; lengths on the road are in units of the camera's height, which was not given."


def remedy(result: Calibration | Refusal) -> str:
    """Say what would help, '' where nothing is missing."""
    refusal = result if isinstance(result, Refusal) else result.ground_refusal
    return '' if refusal is None else _sentence(_capital(refusal.remedy))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _with_sigma(value: float, sigma: float | None, digits: int) -> str:
    return f'{value:.{digits}f}' if sigma is None else f'{value:.{digits}f} ± {sigma:.{digits}f}'


def _sentence(text: str) -> str:
    text = text.strip()
    return text if not text or text[-1] in '.!?' else text + '.'


def number_rows(result: Calibration | Refusal, accepted_at_s: float | None = None) -> list[Row]:
    """List what is known: the lens, the ground plane, the evidence."""
    rows = [] if isinstance(result, Refusal) else [*_lens_rows(result), *_ground_rows(result), *_paper_rows(result)]
    return rows + _evidence_rows(result, accepted_at_s)


def _lens_rows(result: Calibration) -> list[Row]:
    camera, sigma = result.camera, result.stddev
    cx, cy = camera.principal_point_px
    point = '' if sigma.principal_point_px is None else '{:.2f}, {:.2f}'.format(*sigma.principal_point_px)
    across, down = field_of_view_deg(camera)
    coefficients = [Row(f'k{index}', f'{value:.5f}', _number(sigma.k1, 5) if index == 1 else '')
                    for index, value in enumerate(camera.k, start=1)]
    return [Row('focal length', f'{camera.focal_px:.2f} px', _number(sigma.focal_px, 2)),
            Row('principal point', f'{cx:.2f}, {cy:.2f} px', point),
            *[row for row, value in zip(coefficients, camera.k, strict=True) if value or row.name == 'k1'],
            Row('field of view', f'{across:.1f} x {down:.1f} degrees', note='between the middles of opposite borders')]


def _ground_rows(result: Calibration) -> list[Row]:
    if result.ground is None:
        return []
    down, roll = tilt_and_roll_deg(result.ground.normal_in_camera)
    height = f'{result.ground.height_m:.2f} m' if result.ground.metric else '1 (unit)'
    note = next((text for text in result.assumptions if text.startswith('scale by ')), '')
    return [Row('camera height', height, _number(result.stddev.height_m, 2), note),
            Row('looks down by', f'{down:.2f} degrees', _number(result.stddev.tilt_deg, 2)),
            Row('rolled by', f'{roll:.2f} degrees', _number(result.stddev.roll_deg, 2)),
            *[Row(f'road {distance:g} m ahead', 'on the road', f'{sigma:.2f} m', 'of where a pixel meets it')
              for distance, sigma in zip(GROUND_DISTANCES_M, result.stddev.ground_point_m, strict=False)
              if sigma is not None]]


def _paper_rows(result: Calibration) -> list[Row]:
    if result.paper is None:
        return []
    before, after = result.paper.straightness_px2
    return [Row("the paper's focal length", f'{result.paper.focal_px:.1f} px', note='Jain & Saunier, for comparison'),
            Row("the paper's polynomial", ', '.join(f'{value:.4f}' for value in result.paper.polynomial_k),
                note='k1, k2, k3 of x_u / x_d - 1; distorted to undistorted'),
            Row('straightness', f'{before:.3g} before, {after:.3g} after, px²', note='mean squared line-fit error')]


def _evidence_rows(result: Calibration | Refusal, accepted_at_s: float | None) -> list[Row]:
    evidence = result.evidence
    people = f' and {evidence.people} people' if evidence.people else ''
    rows = [Row('recording', f'{evidence.seconds:.1f} s, {evidence.frames} images'),
            Row('traffic', f'{evidence.tracks} tracks of {evidence.vehicles} vehicles{people}, '
                           f'{evidence.segments} segments'),
            Row('coverage', f'{100 * evidence.coverage:.0f} % of the image')]
    return rows + ([] if accepted_at_s is None else [Row('accepted after', f'{accepted_at_s:.1f} s')])


def field_of_view_deg(camera: Camera) -> tuple[float, float]:
    """Return the angles between the middles of the left and right, and of the top and bottom border."""
    cx, cy = camera.principal_point_px
    right, bottom = camera.width - 1, camera.height - 1
    bearings, _ = camera.unproject(np.array([[0, cy], [right, cy], [cx, 0], [cx, bottom]], float))
    cosines = np.clip([bearings[0] @ bearings[1], bearings[2] @ bearings[3]], -1, 1)
    across, down = np.degrees(np.arccos(cosines))
    return float(across), float(down)


def _number(value: float | None, digits: int) -> str:
    return '' if value is None else f'{value:.{digits}f}'
