"""One page over the reports of many cameras."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from urllib.parse import quote

from autocalib_ros.errors import AutocalibError, InputError
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.perception.image_file import read_image
from autocalib_ros.report.rendering import data_address, render_page
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import calibration_from_json, read_json_object
from autocalib_ros.util.files import write_atomically

RESULT, REPORT_PAGE = 'calibration.json', 'report.html'
THUMBNAILS = ('ground_grid', 'kept_tracks', 'all_tracks')
"""Figures of a report of which the first one that exists is shown."""
THUMBNAIL_PX = 320
MAX_PICTURES = 1000
"""Most cameras that are shown with a picture, each 15 kB; the page says so."""
ORDER = ('refused', 'unreadable', 'partial', 'calibrated')
"""What needs attention comes first."""
STATE_WORDS = {
    'refused': 'refused',
    'unreadable': 'unreadable',
    'partial': 'calibrated in part',
    'calibrated': 'calibrated',
}
"""What the states are called on the page."""
PARTIAL_WORDS = {'lens': 'lens only, no ground plane', 'unit_scale': 'calibrated, without a scale'}
"""What a camera of a lesser grade is called; of others the grade is told."""


@dataclass(frozen=True)
class CameraEntry:
    """One camera of the page."""

    name: str
    state: str
    """One of `ORDER`."""
    words: str
    """The state in words."""
    focal: str
    tilt: str
    height: str
    lengths: str
    note: str
    """What is wrong, or what would help."""
    when: str
    report: str
    """Address of its report relative to the page; '' without one."""
    figures: Path
    """Folder in which a picture may be."""


def write_index(folder: Path) -> tuple[Path, int]:
    """Write index.html over all calibration.json below a folder; return its path and the number of cameras.

    InputError if there is none, or if it cannot be written.
    """
    found = sorted(folder.rglob(RESULT))
    if not found:
        raise InputError(f'there is no {RESULT} in {folder} or below it')
    entries = sorted((_entry(path, folder) for path in found), key=lambda one: (ORDER.index(one.state), one.name))
    counts = [(STATE_WORDS[state], sum(one.state == state for one in entries)) for state in ORDER]
    page = render_page(
        'index.html.j2',
        title=count_of_cameras(len(entries)),
        entries=[(one, _thumbnail(one.figures) if index < MAX_PICTURES else '') for index, one in enumerate(entries)],
        counts=[(words, count) for words, count in counts if count],
        max_pictures=MAX_PICTURES if len(entries) > MAX_PICTURES else 0,
    )
    path = folder / 'index.html'
    write_atomically(path, page)
    return path, len(entries)


def count_of_cameras(count: int) -> str:
    """Return a number of cameras in words."""
    return f'{count} camera{"" if count == 1 else "s"}'


def _entry(path: Path, folder: Path) -> CameraEntry:
    name = str(path.parent.relative_to(folder)) if path.parent != folder else path.resolve().parent.name
    when = datetime.fromtimestamp(path.stat().st_mtime, timezone.utc).strftime('%Y-%m-%d %H:%M UTC')
    report = path.with_name(REPORT_PAGE)
    address = quote(os.path.relpath(report, folder)) if report.exists() else ''
    common: dict[str, Any] = {'name': name, 'when': when, 'report': address, 'figures': path.parent / 'figures'}
    nothing: dict[str, Any] = dict.fromkeys(('focal', 'tilt', 'height', 'lengths'), '')
    try:
        document = read_json_object(path)
        if document.get('state') == 'refused':
            return CameraEntry(
                **common, **nothing, state='refused', words='refused', note=str(document['refusal']['message'])
            )
        return CameraEntry(**common, **_numbers(calibration_from_json(document)))
    except (AutocalibError, LookupError, TypeError) as error:
        return CameraEntry(**common, **nothing, state='unreadable', words='unreadable', note=str(error))


def _numbers(result: Calibration) -> dict[str, Any]:
    sigma, ground = result.stddev, result.ground
    metric = ground is not None and ground.metric
    tilt_deg = None if ground is None else float(tilt_and_roll_deg(ground.normal_in_camera)[0])
    lengths = '' if sigma.ground is None else f'± {100 * sigma.ground.worst:.1f} %'
    return {
        'state': 'calibrated' if result.grade == 'full' else 'partial',
        'words': PARTIAL_WORDS.get(result.grade, f'calibrated, grade {result.grade}'),
        'focal': _with_sigma(result.camera.focal_px, sigma.focal_px, 'px', 0),
        'tilt': '' if tilt_deg is None else _with_sigma(tilt_deg, sigma.tilt_deg, '°', 1),
        'height': _with_sigma(ground.height_m, sigma.height_m, 'm', 2) if ground is not None and metric else '',
        'lengths': lengths,
        'note': _note(result),
    }


def _with_sigma(value: float, sigma: float | None, unit: str, digits: int) -> str:
    spread = f' ± {sigma:.{digits if sigma >= 10 else max(digits, 1)}f}' if sigma else ''
    return f'{value:.{digits}f}{spread}{"" if unit == "°" else " "}{unit}'


def _note(result: Calibration) -> str:
    """Return why there is no ground plane, else what would help."""
    if result.ground_refusal is not None:
        return result.ground_refusal.message
    return result.helpful.text if result.helpful else ''


def _thumbnail(figures: Path) -> str:
    """Return a small picture of a report as a data address; '' if it has none."""
    found = next((path for name in THUMBNAILS if (path := figures / f'{name}.png').exists()), None)
    if found is None:
        return ''
    try:
        picture = read_image(found)
    except InputError:
        return ''
    return data_address(picture, THUMBNAIL_PX)
