"""History of accepted calibrations: one line of JSON each, the newest last, in a small file beside the stored one."""

from __future__ import annotations

import json
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.util.documents import parse_json, read_text
from autocalib_ros.util.files import write_atomically

MAX_VERSIONS = 200
"""Most versions in the file: years of a camera that is bumped now and then, and less than 100 kB."""


def version_entry(result: Calibration, cause: str, time_s: float) -> dict[str, Any]:
    """Return what the history keeps of a version accepted at a time, in seconds since 1970."""
    sigma, ground = result.stddev, result.ground
    tilt, roll = (None, None) if ground is None else map(float, tilt_and_roll_deg(ground.normal_in_camera))
    return {
        'time': datetime.fromtimestamp(time_s, tz=timezone.utc).isoformat(timespec='seconds'),
        'stamp_s': result.newest_stamp_ns * 1e-9,
        'cause': cause,
        'grade': result.grade,
        'focal_px': result.camera.focal_px,
        'focal_sigma_px': sigma.focal_px,
        'tilt_deg': tilt,
        'tilt_sigma_deg': sigma.tilt_deg,
        'roll_deg': roll,
        'roll_sigma_deg': sigma.roll_deg,
        'height_m': ground.height_m if ground is not None and ground.metric else None,
        'height_sigma_m': sigma.height_m,
        'tracks': result.evidence.tracks,
    }


def read_history(path: Path) -> list[dict[str, Any]]:
    """Return the versions in a file, oldest first; none without one. Lines that are no version are left out."""
    if not path.exists():
        return []
    text = read_text(path, 'history')
    return [entry for line in text.splitlines() if (entry := _parsed(line)) is not None]


def append_version(path: Path, entry: dict[str, Any]) -> None:
    """Append a version; the oldest ones beyond `MAX_VERSIONS` are dropped. InputError if that fails."""
    kept = [*read_history(path), entry][-MAX_VERSIONS:]
    write_atomically(path, ''.join(f'{json.dumps(each, allow_nan=False)}\n' for each in kept))


def describe_version(entry: dict[str, Any]) -> str:
    """Return cause and numbers of a version as one line."""
    numbers = [f'grade {entry.get("grade")}']
    for name, unit in (('focal', 'px'), ('tilt', 'deg'), ('roll', 'deg'), ('height', 'm')):
        value, sigma = entry.get(f'{name}_{unit}'), entry.get(f'{name}_sigma_{unit}')
        if isinstance(value, (int, float)):
            spread = f' ± {sigma:.2g}' if isinstance(sigma, (int, float)) else ''
            numbers.append(f'{name} {value:.4g}{spread} {unit}')
    return f'{entry.get("cause", "")}: {", ".join(numbers)}'


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        entry = parse_json(line)
    except InputError:
        return None
    return entry if isinstance(entry, dict) and isinstance(entry.get('time'), str) else None
