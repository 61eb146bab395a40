"""The calibration kept on disk: camera_info_manager's file for all, and beside it what that cannot hold.

    NAME.yaml            the lens as camera_info_manager reads it
    NAME.autocalib.json  calibration.json with the pose, the deviations, the evidence, and what NAME.yaml says
    *.bak                the pair before
    NAME.report.html     for people, with its figures in NAME.figures; nothing reads them

Each file is replaced in one step, the JSON before the YAML. Whoever is killed between the two leaves a YAML that
says what the JSON before says; so the lens in the YAML tells which of the two JSONs belongs to it, and a YAML that
belongs to neither comes from another hand.
"""

from __future__ import annotations

import json
import math
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import TypeVar

from autocalib_ros.errors import AutocalibError, InputError, UsageError
from autocalib_ros.lens.camera_info import CameraInfo
from autocalib_ros.lens.camera_info_yaml import camera_info_yaml, read_camera_info_fields
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import calibration_from_json, read_json, to_json
from autocalib_ros.util.files import keep_copy, remove_temporaries, write_atomically

DEFAULT_URL = 'file://${ROS_HOME}/camera_info/${NAME}.yaml'
STORED_LENS_TOLERANCE = 1e-6
"""A driver's camera_info_manager, told the same lens, writes it with fewer digits: relative, and absolute below 1."""

Content = TypeVar('Content')


@dataclass(frozen=True)
class StoredCalibration:
    """A calibration with what it was published as."""

    calibration: Calibration
    info: CameraInfo
    camera_name: str
    image_frame: str
    """The frame_id of the images."""


class StoreState(Enum):
    """What stands at the place of a stored calibration."""

    EMPTY = 'nothing'
    INTACT = 'whole'
    INTERRUPTED = 'cut off'
    CORRUPT = 'broken'
    FOREIGN = 'foreign'


@dataclass(frozen=True)
class LoadResult:
    """What was found, the calibration that can be used of it, and what a person has to be told; '' is nothing."""

    kind: StoreState
    stored: StoredCalibration | None = None
    note: str = ''


def resolve_url(url: str, camera_name: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Return the file that a URL of camera_info_manager names; UsageError where it names none.

    '' is `DEFAULT_URL`. `${NAME}` is the camera's name, `${ROS_HOME}` the environment's or ~/.ros.
    """
    home = environment.get('ROS_HOME') or os.path.join(environment.get('HOME') or os.path.expanduser('~'), '.ros')
    known = {'NAME': camera_name, 'ROS_HOME': home}

    def value(match: re.Match[str]) -> str:
        if match[1] not in known:
            raise UsageError(f"'camera_info_url' holds {match[0]}: only ${{NAME}} and ${{ROS_HOME}} are replaced")
        return known[match[1]]

    resolved = re.sub(r'\$\{(\w*)\}', value, url or DEFAULT_URL)
    scheme, _, rest = resolved.partition('://')
    package, _, inside = rest.partition('/')
    if scheme.lower() == 'file' and rest.startswith('/') and not rest.endswith('/'):
        return Path(rest)
    if scheme.lower() == 'package' and package and inside and not inside.endswith('/'):
        return _share_folder(package, environment) / inside
    raise UsageError(
        f"'camera_info_url' is {url!r}, which names no file: write file:///FOLDER/FILE.yaml, "
        'package://PACKAGE/FILE.yaml, or nothing for ' + DEFAULT_URL
    )


def _share_folder(package: str, environment: Mapping[str, str]) -> Path:
    """Return the share folder of a package by the ament index; pip's packages are not in AMENT_PREFIX_PATH."""
    prefixes = [*filter(None, environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep)), sys.prefix]
    for prefix in map(Path, prefixes):
        if (prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / package).is_file():
            return prefix / 'share' / package
    raise UsageError(
        f"'camera_info_url' names the package '{package}', which no ament index knows: source its "
        'workspace, or write file:///FOLDER/FILE.yaml'
    )


class Store:
    """The files of one camera; it holds no file open, and no calibration."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.json_path = path.with_name(f'{path.stem}.autocalib.json')
        self.report = path.with_name(f'{path.stem}.report.html')
        self.figures = path.with_name(f'{path.stem}.figures')

    def remove_leftovers(self) -> None:
        """Remove what a writer left that was killed; not to be called while another writes."""
        for path in (self.path, self.json_path):
            remove_temporaries(path)
            remove_temporaries(_backup(path))

    def save(self, stored: StoredCalibration, *, replace_foreign: bool = False) -> None:
        """Write both files; InputError where they cannot be written or the YAML is somebody else's.

        A pair that belongs together is kept as .bak. `replace_foreign` keeps somebody else's YAML as .orig.
        """
        found = self.load()
        if found.kind is StoreState.FOREIGN:
            self._back_up_foreign(replace_foreign)
        if found.kind is StoreState.INTACT:
            for path in (self.json_path, self.path):
                keep_copy(path, _backup(path))
        write_atomically(self.json_path, stored_json(stored))
        write_atomically(self.path, camera_info_yaml(stored.info, stored.camera_name))

    def load(self) -> LoadResult:
        """Return what is kept; a file that cannot be used is told, never raised."""
        lens = _try_read(self.path, read_camera_info_fields)
        current, before = (_try_read(path, _read_stored_json) for path in (self.json_path, _backup(self.json_path)))
        if lens is None:
            return LoadResult(
                StoreState.EMPTY,
                None,
                '' if current is None else f'{self.path} is missing beside {self.json_path.name}: nothing is restored',
            )
        if _is_consistent(lens, current):
            return LoadResult(StoreState.INTACT, current)
        if _is_consistent(lens, before):
            return LoadResult(
                StoreState.INTERRUPTED,
                before,
                f'{self.path} and {self.json_path.name} do not belong together, a write '
                'was cut off: the calibration before is taken',
            )
        fault = next((item for item in (lens, current) if isinstance(item, InputError)), None)
        if current is None or fault is None:
            why = f' ({lens})' if isinstance(lens, InputError) else ''
            return LoadResult(
                StoreState.FOREIGN,
                None,
                f'{self.path} was not written by this node, or changed since{why}: it is '
                'not published. Give it as camera_info_file to use its lens',
            )
        if _is_consistent(_try_read(_backup(self.path), read_camera_info_fields), before):
            return LoadResult(
                StoreState.CORRUPT, before, f'{fault}: the pair before, {_backup(self.path).name}, is taken'
            )
        return LoadResult(StoreState.CORRUPT, None, f'{fault}: nothing is restored')

    def _back_up_foreign(self, allowed: bool) -> None:
        """Keep somebody else's YAML, or raise InputError."""
        aside = self.path.with_name(self.path.name + '.orig')
        if not allowed:
            raise InputError(
                f'{self.path} was not written by this node, or changed since, and is left alone: call '
                f'~/save to replace it and keep it as {aside.name}, or set camera_info_url'
            )
        if aside.exists():
            raise InputError(
                f'{self.path} was not written by this node, or changed since, and {aside.name} is there '
                'already: move one of them away'
            )
        keep_copy(self.path, aside)


def stored_json(stored: StoredCalibration) -> str:
    """Return the text of the file beside the YAML: calibration.json, and what that is not told."""
    kept = {'camera_name': stored.camera_name, 'image_frame': stored.image_frame, 'camera_info': asdict(stored.info)}
    return json.dumps({**to_json(stored.calibration), 'stored': kept}, indent=1, allow_nan=False) + '\n'


def _backup(path: Path) -> Path:
    return path.with_name(path.name + '.bak')


def _try_read(path: Path, read: Callable[[Path], Content]) -> Content | InputError | None:
    """Return what a file holds, the InputError where it cannot be used, None where there is no file."""
    try:
        path.stat()
        return read(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        return InputError(f'cannot read {path}: {error.strerror or error}')
    except InputError as error:
        return error


def _read_stored_json(path: Path) -> StoredCalibration:
    whole = read_json(path)
    try:
        kept = whole['stored']
        return StoredCalibration(
            calibration_from_json(whole),
            CameraInfo(**kept['camera_info']),
            str(kept['camera_name']),
            str(kept['image_frame']),
        )
    except AutocalibError as error:
        raise InputError(f'{path}: {error}') from error
    except (KeyError, TypeError) as error:
        raise InputError(f'{path}: it was not written by this node ({type(error).__name__}: {error})') from error


def _is_consistent(lens: CameraInfo | InputError | None, stored: StoredCalibration | InputError | None) -> bool:
    """Say whether a YAML says the lens that a stored calibration was published as."""
    if not isinstance(lens, CameraInfo) or not isinstance(stored, StoredCalibration):
        return False
    ours = stored.info
    if (lens.width, lens.height, lens.distortion_model) != (ours.width, ours.height, ours.distortion_model):
        return False
    try:
        return all(
            math.isclose(a, b, rel_tol=STORED_LENS_TOLERANCE, abs_tol=STORED_LENS_TOLERANCE)
            for a, b in zip((*lens.k, *lens.d, *lens.r, *lens.p), (*ours.k, *ours.d, *ours.r, *ours.p), strict=True)
        )
    except (TypeError, ValueError):  # other numbers of coefficients, or of another kind
        return False
