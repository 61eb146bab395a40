"""The files of a ROS recording, made readable: unpacked, with the write-ahead log of a killed recorder, or scanned."""

from __future__ import annotations

import logging
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from autocalib_ros.errors import AutocalibError, InputError
from autocalib_ros.offline.recordings.listing import ACTIVE_SUFFIX, PACKED_SUFFIXES, PART_SUFFIXES, bare
from autocalib_ros.offline.recordings.scanned_files import ScannedFile
from autocalib_ros.offline.recordings.unpacking import limit_readers, require_room, unpack_file
from autocalib_ros.util.documents import read_yaml
from autocalib_ros.util.input_limits import MAX_METADATA_BYTES

LOG = logging.getLogger(__name__)

limit_readers()
COLUMN_KINDS, COMPUTED = (
    "SELECT max(c.hidden) FROM sqlite_master AS m JOIN pragma_table_xinfo(m.name) AS c WHERE m.type = 'table'",
    2,
)
"""Asks what SQLite hides of the columns of all tables, and from which answer on values are computed."""
LOG_SUFFIXES = ('-wal', '-journal')
"""What SQLite keeps beside a database until it is closed."""


class BagPart:
    """One file of a recording; `path` is the file as it is given, `readable` itself or a copy to open."""

    def __init__(self, path: Path, readable: Path) -> None:
        self.path, self._readable = path, readable
        self._scanned: ScannedFile | None = None
        self._reader: Any = None

    @property
    def is_ros1(self) -> bool:
        """Whether it is a ROS 1 bag."""
        return self._readable.name.lower().removesuffix(ACTIVE_SUFFIX).endswith('.bag')

    @contextmanager
    def opened(self) -> Iterator[BagPart]:
        """Open the file in this block; InputError if nothing in it can be read.

        Files that rosbags cannot read, or would read without their order, are scanned.
        """
        reader = self._reader = self._open()
        try:
            yield self
        finally:
            reader.close()

    def _open(self) -> Any:
        error = None
        if self._readable.suffix == '.db3':
            _require_stored_values(self._readable)
        if self._scanned is None:
            try:
                reader: Any = Reader1(self._readable) if self.is_ros1 else Reader2(self._readable)
                reader.open()
                if self._readable.suffix != '.mcap' or reader.storage.chunks or not reader.message_count:
                    return reader
                reader.close()
            except Exception as wrong:  # readers of damaged files raise arbitrary exceptions
                error = wrong
        scanned = self._scan(error)
        scanned.open()
        return scanned

    def _scan(self, error: Exception | None = None) -> ScannedFile:
        """Return the scanned file, scanned once; InputError with `error`, that of the reader, if it is of no use."""
        if self._scanned is not None:
            return self._scanned
        try:
            scanned = ScannedFile(self._readable)
        except Exception as wrong:  # damaged records raise arbitrary exceptions
            raise InputError(f'cannot read {self.path}: {one_line(error or wrong)}') from wrong
        if not scanned.is_complete and scanned.end_time:
            LOG.warning('%s ended early, its recorder did not close it; complete records are used', self.path)
        if scanned.damaged_chunks:
            LOG.warning('%s: %d damaged chunks are left out', self.path, scanned.damaged_chunks)
        self._scanned = scanned
        return scanned

    @property
    def connections(self) -> list[Any]:
        """Connections with `topic`, `msgtype` and `msgcount`."""
        return list(self._reader.connections)

    @property
    def start_time(self) -> int:
        """Time of recording of the first message, nanoseconds."""
        return int(self._reader.start_time)

    @property
    def end_time(self) -> int:
        """Time after the last message, nanoseconds."""
        return int(self._reader.end_time)

    def messages(self, topic: str, msgtype: str, start: int | None, stop: int | None) -> Iterator[tuple[int, Any]]:
        """Yield time of recording and bytes of the messages of a topic, within [start, stop).

        Behind damage that the reader does not pass, the rest is scanned for.
        """
        last_ns = None
        try:
            for time_ns, raw in _messages(self._reader, topic, msgtype, start, stop):
                last_ns = time_ns
                yield time_ns, raw
            return
        except (AutocalibError, GeneratorExit):
            raise
        except Exception as error:  # decoders of damaged files raise arbitrary exceptions
            if self._readable.suffix == '.db3' or isinstance(self._reader, ScannedFile):
                raise
            scanned = self._scan(error)
        with self.opened():
            yield from _messages(scanned, topic, msgtype, start if last_ns is None else last_ns + 1, stop)


def _messages(reader: Any, topic: str, msgtype: str, start: int | None, stop: int | None) -> Iterator[tuple[int, Any]]:
    wanted = [one for one in reader.connections if (one.topic, one.msgtype) == (topic, msgtype)]
    if wanted:
        yield from ((time_ns, raw) for _, time_ns, raw in reader.messages(wanted, start, stop))


def find_parts(path: Path, temporary: Callable[[], Path]) -> list[BagPart]:
    """Return the files of a recording that hold anything; `temporary` gives a folder for copies.

    metadata.yaml is only asked which files there should be: its counts, types and settings are often wrong after a
    crash or a conversion, and the files hold them too. InputError if there is no file.
    """
    if not path.is_dir():
        return [_prepared(path, temporary)]
    found = sorted(one for one in path.iterdir() if bare(one).suffix in PART_SUFFIXES)
    listed = _listed_names(path)
    missing = [name for name in listed if not (path / name).exists() and not (path / bare(Path(name)).name).exists()]
    if missing:
        LOG.warning('%s: files of the recording are missing: %s', path, ', '.join(missing))
    empty = [one for one in found if not one.stat().st_size and not _log_of(one)]
    if empty and len(empty) < len(found):
        LOG.warning('%s: files without any byte are left out: %s', path, ', '.join(one.name for one in empty))
        found = [one for one in found if one not in empty]
    if not found:
        raise InputError(
            f'{path} has no .mcap or .db3 file'
            + (f'; metadata.yaml lists {", ".join(listed)}' if listed else ', and its metadata.yaml lists none')
        )
    if not listed and len({bare(one).suffix for one in found}) > 1:
        raise InputError(f'{path} has no metadata.yaml but both .mcap and .db3 files: give one file')
    return [_prepared(one, temporary) for one in found]


def _listed_names(folder: Path) -> list[str]:
    """Return the names of the files in metadata.yaml; none if it says nothing that can be read."""
    try:
        document = read_yaml(folder / 'metadata.yaml', 'metadata.yaml', MAX_METADATA_BYTES)
        return [Path(str(name)).name for name in document['rosbag2_bagfile_information']['relative_file_paths']]
    except (InputError, LookupError, TypeError, ValueError):
        return []


def _log_of(path: Path) -> str:
    """Return the suffix of a log that SQLite left beside a database, '' if there is none with content."""
    if path.suffix != '.db3':
        return ''
    logs = (suffix for suffix in LOG_SUFFIXES if Path(f'{path}{suffix}').exists())
    return next((suffix for suffix in logs if Path(f'{path}{suffix}').stat().st_size), '')


def _prepared(path: Path, temporary: Callable[[], Path]) -> BagPart:
    """Return a file as a part, with a copy where it cannot be read as it is."""
    try:
        if path.suffix in PACKED_SUFFIXES:
            return BagPart(path, _unpacked(path, temporary() / bare(path).name))
        if _log_of(path):
            return BagPart(path, _with_log(path, temporary() / path.name))
    except OSError as error:
        raise InputError(
            f'{path} needs a copy to be read, which cannot be written: {error.strerror or error}; TMPDIR chooses '
            'another folder for it'
        ) from error
    return BagPart(path, path)


def _unpacked(path: Path, copy: Path) -> Path:
    """Unpack a file into a copy, as far as it goes."""
    damage = unpack_file(path, copy)
    if damage:
        LOG.warning('%s is damaged; what could be unpacked is used: %s', path, damage)
    return copy


def _with_log(path: Path, copy: Path) -> Path:
    """Copy a database with its log, and let SQLite merge them: readers of rosbags leave the log out."""
    for suffix in ('', *LOG_SUFFIXES):
        if Path(f'{path}{suffix}').exists():
            require_room(copy.parent, Path(f'{path}{suffix}').stat().st_size)
            shutil.copyfile(f'{path}{suffix}', f'{copy}{suffix}')
    try:
        with closing(sqlite3.connect(copy)) as database:
            database.execute('SELECT count(*) FROM sqlite_master').fetchone()  # rolls a journal back
            database.execute('PRAGMA wal_checkpoint(TRUNCATE)')
            database.execute('PRAGMA journal_mode=DELETE')
    except sqlite3.Error as error:
        raise InputError(f'cannot read {path} with its log: {one_line(error)}') from error
    LOG.warning('%s was not closed by its recorder: the messages in its log are read too', path)
    return copy


def _require_stored_values(path: Path) -> None:
    """Raise InputError for a database that computes values: a row of 20 bytes could give gigabytes."""
    with (
        suppress(sqlite3.Error, UnicodeDecodeError),  # the latter where a damaged name is in the message of an error
        closing(sqlite3.connect(f'{path.absolute().as_uri()}?mode=ro&immutable=1', uri=True)) as database,
    ):
        (hidden,) = database.execute(COLUMN_KINDS).fetchone()
        if (hidden or 0) >= COMPUTED:
            raise InputError(f'{path} has columns that are computed, which no recorder writes')


def one_line(error: Exception) -> str:
    """Return the text of an exception of a library on one line."""
    text = ' '.join(str(error).split()).rstrip('.').replace('; please report issue', '')
    if 'disk image is malformed' in text:
        text += " (a damaged SQLite file: 'sqlite3 FILE .recover' may save a part)"
    return text or f'it is damaged ({type(error).__name__})'


@contextmanager
def open_parts(parts: list[BagPart]) -> Iterator[list[BagPart]]:
    """Open the parts that can be read, in order of time; InputError if none of them can be."""
    with ExitStack() as stack:
        opened = [part for part in parts if _opens(part, stack, is_alone=len(parts) == 1)]
        if not opened:
            raise InputError(f'none of the {len(parts)} files can be read')
        yield sorted(opened, key=lambda part: part.start_time)


def _opens(part: BagPart, stack: ExitStack, *, is_alone: bool) -> bool:
    """Open a part; return whether it can be read; InputError if not and it is alone."""
    try:
        stack.enter_context(part.opened())
    except InputError as error:
        if is_alone:
            raise
        LOG.warning('left out: %s', error)
        return False
    return True
