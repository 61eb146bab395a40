"""Unpack recordings, their chunks and messages up to a size: 1 MB of Zstandard can hold terabytes."""

from __future__ import annotations

import bz2
import errno
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]  # comes with rosbags, as that for zstd
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from autocalib_ros.errors import InputError
from autocalib_ros.util.input_limits import (
    ALWAYS_UNPACKED_BYTES,
    MAX_CHUNK_BYTES,
    MAX_PACKED_RATIO,
    MIN_FREE_BYTES,
)


def zstd_module() -> Any:
    """Return the module for Zstandard: of Python 3.14, or that which comes with rosbags."""
    try:
        from compression import zstd  # type: ignore[import-not-found]
    except ImportError:
        from backports import zstd
    return zstd


DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    'lz4': lz4.frame.LZ4FrameDecompressor,
    'bz2': bz2.BZ2Decompressor,
    'zstd': lambda: zstd_module().ZstdDecompressor(),
}


COPY_BYTES = 1 << 20
MAX_LZ4_RATIO = 256
"""No LZ4 frame unpacks to more bytes for each of its own: a byte adds 255 to the length of a match."""


def unpack(compression: str, packed: bytes | memoryview, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """Return unpacked data; InputError for another compression, cut data, or more than `limit` bytes."""
    if compression in ('', 'none'):
        return bytes(packed)
    if compression not in DECOMPRESSORS:
        raise InputError(f'compression {compression[:40]} is not supported')
    parts, room, rest = [], limit, bytes(packed)
    while rest:  # Zstandard and the others allow several frames, one after another
        frame = DECOMPRESSORS[compression]()
        # the module of LZ4 takes all the memory that it may need at once
        needed = min(room, MAX_LZ4_RATIO * len(rest)) if compression == 'lz4' else room
        parts.append(frame.decompress(rest, max_length=needed + 1))
        room -= len(parts[-1])
        if room < 0:
            raise InputError(f'a chunk or message unpacks to more than {limit} bytes')
        if not frame.eof:
            raise InputError('a chunk or message is cut')
        rest = frame.unused_data or b''
    return b''.join(parts)


def unpack_file(path: Path, copy: Path) -> str:
    """Unpack a file of Zstandard into a copy, as far as it goes; return why not further, '' if it is whole.

    InputError if it unpacks to absurdly much, or to more than the disk has room for. OSError if it cannot be written.
    """
    zstd = zstd_module()
    limit = max(MAX_PACKED_RATIO * path.stat().st_size, ALWAYS_UNPACKED_BYTES)
    written = 0
    with path.open('rb') as packed, copy.open('wb') as unpacked:
        try:
            with zstd.open(packed, 'rb') as stream:
                while part := stream.read(COPY_BYTES):
                    written += len(part)
                    if written > limit:
                        raise InputError(
                            f'{path} unpacks to more than {MAX_PACKED_RATIO} times its size: unpack it yourself if '
                            'that is right, and give the result'
                        )
                    require_room(copy.parent, len(part))
                    unpacked.write(part)
        except (EOFError, zstd.ZstdError) as error:
            return ' '.join(str(error).split())
        except InputError:
            copy.unlink()
            raise
    return ''


def require_room(folder: Path, size: int) -> None:
    """Raise OSError unless a disk has room for so many bytes and `MIN_FREE_BYTES` beside."""
    if shutil.disk_usage(folder).free < size + MIN_FREE_BYTES:
        raise OSError(errno.ENOSPC, f'{os.strerror(errno.ENOSPC)} ({MIN_FREE_BYTES // 10**9} GB are left free)')


def limit_readers() -> None:
    """Let the readers of rosbags unpack within `MAX_CHUNK_BYTES`: they have no limit of their own."""
    for name in ('lz4', 'zstd'):
        storage_mcap.DECOMPRESSORS[name] = partial(_unpack_chunk, name)
    for name in ('lz4', 'bz2'):
        rosbag1_reader.decompressors[name] = partial(unpack, name)


def _unpack_chunk(compression: str, packed: bytes, size: int) -> bytes:
    """Return the content of a chunk that states its size."""
    return unpack(compression, packed, min(size, MAX_CHUNK_BYTES))
