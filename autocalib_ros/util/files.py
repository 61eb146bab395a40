"""Atomic file operations."""

from __future__ import annotations

import contextlib
import glob
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from autocalib_ros.errors import InputError

READABLE, NOT_FOR_OTHERS, OWNER_ONLY = 0o666, 0o640, 0o600
"""Modes of files, from which the umask takes: of numbers, of what shows the street, of what shows it and nobody has to
look at."""


def write_atomically(path: Path, text: str, mode: int = READABLE) -> None:
    """Replace a file atomically, also across a power cut: readers see the old text or the new, never a part.

    The umask takes from `mode`.
    """
    write_bytes_atomically(path, text.encode('utf-8'), mode)


def write_picture_bytes(path: Path, content: bytes) -> None:
    """Write a file that shows the street, which other users cannot read. OSError if that fails."""
    create_for_picture(path)
    path.write_bytes(content)


def create_for_picture(path: Path) -> None:
    """Create an empty file that other users cannot read, for a library to write to; one that exists is replaced."""
    path.unlink(missing_ok=True)
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, NOT_FOR_OTHERS))


def write_bytes_atomically(path: Path, content: bytes, mode: int = READABLE) -> None:
    """Replace a file as `write_atomically` does; the umask takes from `mode`."""
    with replaced_atomically(path, mode) as stream:
        stream.write(content)


@contextlib.contextmanager
def replaced_atomically(path: Path, mode: int = READABLE) -> Iterator[BinaryIO]:
    """Yield a stream whose bytes replace a file atomically when the block ends without an exception.

    The folder is created. The umask takes from `mode`. InputError if that fails.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f'{_prefix(path)}{os.getpid()}{secrets.token_hex(4)}'
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        try:
            with os.fdopen(handle, 'wb') as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror or error}') from error


def keep_copy(path: Path, kept: Path) -> None:
    """Give a file a second name atomically, replacing what had that name; InputError if that fails.

    Replacing either file later leaves the other unchanged.
    """
    link = path.with_name(f'{_prefix(kept)}{os.getpid()}')
    try:
        link.unlink(missing_ok=True)
        os.link(path, link)
        os.replace(link, kept)
        return
    except OSError:
        pass  # file systems of memory cards may not support links
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'cannot keep {path} as {kept.name}: {error}') from error
    write_atomically(kept, text)


def remove_temporaries(path: Path) -> None:
    """Remove temporary files that killed writers of this file left behind."""
    for left in path.parent.glob(f'{glob.escape(_prefix(path))}*'):
        with contextlib.suppress(OSError):
            left.unlink()


def _prefix(path: Path) -> str:
    return f'.{path.name}~'


def _sync_folder(folder: Path) -> None:
    """Make a rename durable; file systems that cannot sync a folder are left to their own guarantees."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)
