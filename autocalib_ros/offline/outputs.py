"""Prepare the output folder before a run and write the output files after it."""

from __future__ import annotations

import os
from pathlib import Path

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.lens.camera_info_yaml import write_camera_info_yaml
from autocalib_ros.offline.recordings.sources import Source, camera_name
from autocalib_ros.offline.replay_recording import ReplayResult
from autocalib_ros.report.scene import ReportScene
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import write_calibration_json

CAMERA_INFO, CALIBRATION, EVIDENCE, REPORT = 'camera_info.yaml', 'calibration.json', 'evidence.npz', 'report.html'


def prepare_output_dir(out_dir: Path, bag: Path | None = None) -> None:
    """Create the output folder; raise UsageError if it is not writable or `bag` exists already."""
    if out_dir.exists() and not out_dir.is_dir():
        raise UsageError(f'{out_dir} is a file, not a folder')
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f'cannot create the folder {out_dir}: {error.strerror or error}') from error
    if not os.access(out_dir, os.W_OK):
        raise UsageError(f'cannot write into the folder {out_dir}')
    if bag is not None and bag.exists():
        raise UsageError(f'{bag} exists already and is not overwritten; remove it or choose another name')


def write_outputs(out_dir: Path, replayed: ReplayResult, source: Source) -> list[str]:
    """Write the result files and the evidence of a replay; return the names of the files."""
    names = write_result(out_dir, replayed, source.name, camera_name(source))
    replayed.evidence.save(out_dir / EVIDENCE)
    return [*names, EVIDENCE]


def write_result(out_dir: Path, replayed: ReplayResult, source_name: str, name_of_camera: str = 'camera') -> list[str]:
    """Write the result files and remove stale ones of an earlier run; return the names of the files."""
    from autocalib_ros.report.page import write_report  # imported late: it needs matplotlib

    result = replayed.result
    if isinstance(result, Calibration):
        write_camera_info_yaml(
            out_dir / CAMERA_INFO, result.camera, name_of_camera, result.distortion_model, result.rectified_balance
        )
    else:
        _remove(out_dir / CAMERA_INFO)
    write_calibration_json(out_dir / CALIBRATION, result, accepted_at_s=replayed.accepted_at_s)
    write_report(
        out_dir / REPORT,
        ReportScene(
            result=result,
            evidence=replayed.evidence,
            background=replayed.background,
            options=replayed.options,
            source=source_name,
            accepted_at_s=replayed.accepted_at_s,
            moments=replayed.moments,
        ),
    )
    return ([CAMERA_INFO] if result else []) + [CALIBRATION, REPORT]


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f'cannot remove {path} of an earlier run: {error.strerror or error}') from error
