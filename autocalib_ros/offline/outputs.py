"""Prepare the output folder before a run and write the output files after it."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from autocalib_ros.errors import AutocalibError, InputError, UsageError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera_info_yaml import write_camera_info_yaml
from autocalib_ros.offline.ground_truth import beside_truth
from autocalib_ros.offline.recordings.sources import Source, camera_name
from autocalib_ros.offline.replay_recording import ReplayResult
from autocalib_ros.report.figure_process import FigureProcess
from autocalib_ros.report.scene import ReportScene
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import read_json_object, write_calibration_json

LOG = logging.getLogger(__name__)

ACCEPTED_STATE = 'calibrated'
"""`state` of a calibration.json with a calibration."""
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


class EvidenceFile:
    """`evidence.npz` of an output folder, written again and again while a recording is read.

    Evidence of an earlier calibration that was accepted is kept as .bak, unless the new result is accepted too.
    """

    def __init__(self, out_dir: Path) -> None:
        self._path, self._backup = out_dir / EVIDENCE, _backup_of(out_dir / EVIDENCE)
        self._written: Evidence | None = None
        self._has_moved = False
        calibration = out_dir / CALIBRATION
        self._is_of_accepted = self._path.exists() and is_accepted(calibration)
        if self._is_of_accepted and self._backup.exists():
            # evidence newer than the calibration is what a killed run left: the backup is the accepted one already
            self._is_of_accepted = self._path.stat().st_mtime <= calibration.stat().st_mtime

    def write(self, evidence: Evidence) -> None:
        """Replace the file; InputError if that fails."""
        if self._is_of_accepted:
            try:
                self._path.replace(self._backup)
            except OSError as error:
                raise InputError(f'cannot keep {self._path}: {error.strerror or error}') from error
            self._is_of_accepted, self._has_moved = False, True
        if evidence is not self._written:
            evidence.save(self._path)
            self._written = evidence

    def drop_backup(self) -> None:
        """Remove the backup of this run: the new result was accepted too."""
        if self._has_moved:
            _remove(self._backup)


def write_outputs(
    out_dir: Path,
    replayed: ReplayResult,
    sources: Source | Sequence[Source],
    evidence_file: EvidenceFile | None = None,
    truth: Mapping[str, Any] | None = None,
    process: FigureProcess | None = None,
) -> list[str]:
    """Write the result files and the evidence of a replay; return the names of the files.

    The report compares the result with the `truth` of a simulation, if it is given; a second `process` draws with it.
    """
    listed = list(sources) if isinstance(sources, Sequence) else [sources]
    first, more = listed[0], len(listed) - 1
    file = evidence_file or EvidenceFile(out_dir)
    file.write(replayed.evidence)
    name = f'{first.name} and {more} more' if more else first.name
    names = write_result(out_dir, replayed, name, camera_name(first), truth, process)
    if replayed.result:
        file.drop_backup()
    return [*names, EVIDENCE]


def is_accepted(calibration: Path) -> bool:
    """Return whether a calibration.json holds an accepted calibration; False if it cannot be read."""
    try:
        return read_json_object(calibration).get('state') == ACCEPTED_STATE
    except AutocalibError:
        return False


def _backup_of(path: Path) -> Path:
    return path.with_name(f'{path.name}.bak')


def _keep_accepted(out_dir: Path) -> None:
    """Keep the files of an earlier calibration that was accepted as .bak, and say so."""
    if not is_accepted(out_dir / CALIBRATION):
        return
    present = [name for name in (CALIBRATION, CAMERA_INFO, REPORT) if (out_dir / name).exists()]
    try:
        for name in present:
            (out_dir / name).replace(_backup_of(out_dir / name))
    except OSError as error:
        raise InputError(f'cannot keep the calibration in {out_dir}: {error.strerror or error}') from error
    LOG.warning(
        'the earlier calibration in %s was accepted and is kept: %s',
        out_dir,
        ', '.join(_backup_of(Path(name)).name for name in present),
    )


def write_result(
    out_dir: Path,
    replayed: ReplayResult,
    source_name: str,
    name_of_camera: str = 'camera',
    truth: Mapping[str, Any] | None = None,
    process: FigureProcess | None = None,
) -> list[str]:
    """Write the result files and remove stale ones of an earlier run; return the names of the files.

    A refusal does not replace an earlier calibration that was accepted: its files are kept as .bak.
    """
    from autocalib_ros.report.page import write_report  # imported late: it needs matplotlib

    result = replayed.result
    if not result:
        _keep_accepted(out_dir)
    if isinstance(result, Calibration):
        write_camera_info_yaml(
            out_dir / CAMERA_INFO, result.camera, name_of_camera, result.distortion_model, result.rectified_balance
        )
    else:
        _remove(out_dir / CAMERA_INFO)
    write_calibration_json(out_dir / CALIBRATION, result, accepted_at_s=replayed.accepted_at_s, moves=replayed.moves)
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
            moves=replayed.moves,
            truth=() if truth is None or result.candidate is None else beside_truth(result.candidate, truth),
            folder=out_dir if (out_dir / EVIDENCE).exists() else None,
        ),
        process=process,
    )
    return ([CAMERA_INFO] if result else []) + [CALIBRATION, REPORT]


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f'cannot remove {path} of an earlier run: {error.strerror or error}') from error
