"""Atomic file operations."""

from __future__ import annotations

import contextlib
import glob
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from autocalib_ros.errors import InputError


def write_atomically(path: Path, text: str) -> None:
    """Replace a file atomically, also across a power cut: readers see the old text or the new, never a part."""
    write_bytes_atomically(path, text.encode('utf-8'))


def write_bytes_atomically(path: Path, content: bytes, mode: int = 0o644) -> None:
    """Replace a file as `write_atomically` does."""
    with replaced_atomically(path, mode) as stream:
        stream.write(content)


@contextlib.contextmanager
def replaced_atomically(path: Path, mode: int = 0o644) -> Iterator[BinaryIO]:
    """Yield a stream whose bytes replace a file atomically when the block ends without an exception.

    The folder is created. InputError if that fails.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=_prefix(path))
        try:
            with os.fdopen(handle, 'wb') as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.chmod(temporary, mode)
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
