"""The calibration on disk: camera_info_manager's YAML, and a JSON file for what that cannot hold.

    NAME.yaml            the lens in the format of camera_info_manager
    NAME.autocalib.json  calibration.json with pose, standard deviations and evidence, and the content of NAME.yaml
    *.bak                the previous pair
    NAME.view.npz        small images of the calibrated view, to verify it at the next start; see `perception.view_file`
    NAME.history.jsonl   time, cause and numbers of each accepted version
    NAME.report.html     the report, with its figures in NAME.figures; never read back

Each file is replaced atomically, the JSON before the YAML. A crash between the two leaves a YAML that matches the
previous JSON. So the lens in the YAML identifies the JSON that belongs to it, and a YAML that matches neither was
written by another program. A checksum in the JSON covers all that is published from it.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import reprlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

from autocalib_ros.errors import AutocalibError, InputError, UsageError
from autocalib_ros.lens.camera_info import CameraInfo
from autocalib_ros.lens.camera_info_yaml import camera_info_yaml, read_camera_info_fields
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import calibration_from_json, read_json_object, to_json
from autocalib_ros.results.given_pixels import GivenPixels
from autocalib_ros.results.grades import rank_of
from autocalib_ros.util.files import keep_copy, remove_temporaries, write_atomically

DEFAULT_URL = 'file://${ROS_HOME}/camera_info/${NAME}.yaml'
STORED_LENS_TOLERANCE = 1e-6
"""Tolerance, relative and below 1 absolute, of equal lenses: a driver's camera_info_manager writes fewer digits."""

Content = TypeVar('Content')


@dataclass(frozen=True)
class StoredCalibration:
    """A calibration with the CameraInfo, name and frame that it was published with."""

    calibration: Calibration
    info: CameraInfo
    camera_name: str
    image_frame: str
    """frame_id of the images."""
    given_pixels: GivenPixels | None = None
    """Pixels that the user gave, where they are in the view of the calibration; None if the file is of before that."""


class StoreState(Enum):
    """State of the stored files."""

    EMPTY = 'empty'
    """There is no YAML."""
    INTACT = 'intact'
    """YAML and JSON belong together."""
    INTERRUPTED = 'interrupted'
    """A write ended between JSON and YAML; the previous JSON belongs to the YAML."""
    CORRUPT = 'corrupt'
    """A file cannot be read."""
    FOREIGN = 'foreign'
    """The YAML was written by another program."""


@dataclass(frozen=True)
class LoadResult:
    """State of the files, the calibration to use, and a warning for the log; '' for none."""

    state: StoreState
    stored: StoredCalibration | None = None
    note: str = ''


def resolve_url(url: str, camera_name: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Return the file of a URL of camera_info_manager; UsageError if it names none.

    '' means `DEFAULT_URL`. `${NAME}` is the camera's name, `${ROS_HOME}` that of the environment or ~/.ros.
    """
    home = environment.get('ROS_HOME') or os.path.join(environment.get('HOME') or os.path.expanduser('~'), '.ros')
    known = {'NAME': camera_name, 'ROS_HOME': home}

    def value(match: re.Match[str]) -> str:
        if match[1] not in known:
            raise UsageError(f"'camera_info_url' contains {match[0]}: only ${{NAME}} and ${{ROS_HOME}} are replaced")
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
    """Return the share folder of a package in the ament index, also of pip packages outside AMENT_PREFIX_PATH."""
    prefixes = [*filter(None, environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep)), sys.prefix]
    for prefix in map(Path, prefixes):
        if (prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / package).is_file():
            return prefix / 'share' / package
    raise UsageError(
        f"'camera_info_url' names the package '{package}', which is in no ament index: source its "
        'workspace, or write file:///FOLDER/FILE.yaml'
    )


class Store:
    """The files of one camera; reads and writes them, and keeps no state."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.json_path = path.with_name(f'{path.stem}.autocalib.json')
        self.views = path.with_name(f'{path.stem}.view.npz')
        self.history = path.with_name(f'{path.stem}.history.jsonl')
        self.report = path.with_name(f'{path.stem}.report.html')
        self.figures = path.with_name(f'{path.stem}.figures')

    def remove_leftovers(self) -> None:
        """Remove temporary files of a killed writer; not to be called during a write."""
        for path in (self.path, self.json_path, self.views, self.history):
            remove_temporaries(path)
            remove_temporaries(_backup(path))

    def save(self, stored: StoredCalibration, *, replace_foreign: bool = False) -> None:
        """Write both files; InputError if that fails or the YAML was written by another program.

        The previous pair is kept as .bak. `replace_foreign` keeps a YAML of another program as .orig.
        """
        found = self.load()
        if found.state is StoreState.FOREIGN:
            self._back_up_foreign(replace_foreign)
        if found.state is StoreState.INTACT:
            for path in (self.json_path, self.path):
                keep_copy(path, _backup(path))
        write_atomically(self.json_path, stored_json(stored))
        write_atomically(self.path, camera_info_yaml(stored.info, stored.camera_name))

    def load(self) -> LoadResult:
        """Return the stored calibration; an unusable file is reported in the result, not raised."""
        lens = _try_read(self.path, read_camera_info_fields)
        current, before = (_try_read(path, _read_stored_json) for path in (self.json_path, _backup(self.json_path)))
        if lens is None:
            return LoadResult(
                StoreState.EMPTY,
                None,
                '' if current is None else f'{self.path} is missing next to {self.json_path.name}; nothing is restored',
            )
        intact = _if_consistent(lens, current)
        if intact is not None:
            return LoadResult(StoreState.INTACT, intact)
        previous = _if_consistent(lens, before)
        if previous is not None:
            return LoadResult(
                StoreState.INTERRUPTED,
                previous,
                f'{self.path} and {self.json_path.name} are inconsistent (interrupted write); using the previous '
                'calibration',
            )
        fault = next((item for item in (lens, current) if isinstance(item, InputError)), None)
        if current is None or fault is None:
            why = f' ({lens})' if isinstance(lens, InputError) else ''
            return LoadResult(
                StoreState.FOREIGN,
                None,
                f'{self.path} was not written by this node, or changed since{why}: not restored. Set '
                'camera_info_file to use its lens',
            )
        previous = _if_consistent(_try_read(_backup(self.path), read_camera_info_fields), before)
        if previous is not None:
            return LoadResult(
                StoreState.CORRUPT, previous, f'{fault}; using the previous pair, {_backup(self.path).name}'
            )
        return LoadResult(StoreState.CORRUPT, None, f'{fault}; nothing is restored')

    def _back_up_foreign(self, allowed: bool) -> None:
        """Keep a YAML of another program as .orig; InputError if that is not allowed or possible."""
        aside = self.path.with_name(self.path.name + '.orig')
        if not allowed:
            raise InputError(
                f'{self.path} was not written by this node, or changed since, and is not overwritten: call '
                f'~/save to replace it and keep it as {aside.name}, or set camera_info_url'
            )
        if aside.exists():
            raise InputError(
                f'{self.path} was not written by this node, or changed since, and {aside.name} exists '
                'already: move one of them away'
            )
        keep_copy(self.path, aside)


def stored_json(stored: StoredCalibration) -> str:
    """Return the text of the JSON file: calibration.json, and the content of the YAML."""
    kept: dict[str, Any] = {
        'camera_name': stored.camera_name,
        'image_frame': stored.image_frame,
        'camera_info': asdict(stored.info),
    }
    if stored.given_pixels is not None:
        kept['given_pixels'] = stored.given_pixels.document()
    document = {**to_json(stored.calibration), 'stored': kept}
    return json.dumps({**document, 'checksum': document_checksum(document)}, indent=1, allow_nan=False) + '\n'


def document_checksum(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of all names and values of a document but its own checksum."""
    rest = {name: value for name, value in document.items() if name != 'checksum'}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def calibration_checksum(calibration: Calibration) -> str:
    """Return what identifies a calibration: the SHA-256 of its calibration.json."""
    return document_checksum(to_json(calibration))


def _backup(path: Path) -> Path:
    return path.with_name(path.name + '.bak')


def _try_read(path: Path, read: Callable[[Path], Content]) -> Content | InputError | None:
    """Return the content of a file, the InputError if it is unusable, None if it does not exist."""
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
    whole = read_json_object(path)
    if 'checksum' in whole and whole['checksum'] != document_checksum(whole):
        raise InputError(
            f'{path}: it was changed by another program, by hand or by a fault of the disk: its checksum differs'
        )
    try:
        kept = whole['stored']
        stored = StoredCalibration(
            calibration_from_json(whole),
            CameraInfo(**kept['camera_info']),
            str(kept['camera_name']),
            str(kept['image_frame']),
            GivenPixels.from_document(kept['given_pixels']) if 'given_pixels' in kept else None,
        )
        _require_plausible(stored)
        return stored
    except AutocalibError as error:
        raise InputError(f'{path}: {error}') from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f'{path}: it was not written by this node ({type(error).__name__}: {error})') from error


def _require_plausible(stored: StoredCalibration) -> None:
    """Raise InputError for a calibration that this node cannot have written: files without a checksum may hold any."""
    calibration, sigma = stored.calibration, stored.calibration.stddev
    if not _same_lens(stored.info, calibration.camera_info):
        raise InputError('its camera is not that of its camera_info')
    deviations = [sigma.focal_px, sigma.k1, sigma.k2, sigma.tilt_deg, sigma.roll_deg, sigma.height_m]
    if any(value is not None and not 0 <= value < math.inf for value in deviations):
        raise InputError('a standard deviation is negative, or no number')
    if calibration.newest_stamp_ns < 0 or rank_of(calibration.grade) < 0:
        raise InputError(f'its stamp or its grade {reprlib.repr(calibration.grade)} is none')
    if not stored.image_frame.isprintable():
        raise InputError(f'its frame {reprlib.repr(stored.image_frame)} has characters that cannot be printed')
    ground = calibration.ground
    if ground is not None and ground.normal_in_camera[1] >= 0 and ground.normal_in_camera[2] >= 0:
        raise InputError('its camera sees the road above its horizon: the picture is upside down')


def _if_consistent(
    lens: CameraInfo | InputError | None, stored: StoredCalibration | InputError | None
) -> StoredCalibration | None:
    """Return the stored calibration if the lens of the YAML is the one it was published with, else None."""
    if not isinstance(lens, CameraInfo) or not isinstance(stored, StoredCalibration):
        return None
    return stored if _same_lens(lens, stored.info) else None


def _same_lens(lens: CameraInfo, ours: CameraInfo) -> bool:
    """Whether two CameraInfo are equal to within what other programs round them to."""
    if (lens.width, lens.height, lens.distortion_model) != (ours.width, ours.height, ours.distortion_model):
        return False
    try:
        return all(
            math.isclose(a, b, rel_tol=STORED_LENS_TOLERANCE, abs_tol=STORED_LENS_TOLERANCE)
            for a, b in zip((*lens.k, *lens.d, *lens.r, *lens.p), (*ours.k, *ours.d, *ours.r, *ours.p), strict=True)
        )
    except (TypeError, ValueError, OverflowError):  # another number of coefficients, or not numbers
        return False
