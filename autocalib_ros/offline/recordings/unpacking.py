"""Unpack chunks and messages of recordings up to a size: 1 MB of Zstandard can hold terabytes."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from functools import partial
from typing import Any

import lz4.frame  # type: ignore[import-untyped]  # comes with rosbags, as that for zstd
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from autocalib_ros.errors import InputError
from autocalib_ros.util.input_limits import MAX_CHUNK_BYTES


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


def limit_readers() -> None:
    """Let the readers of rosbags unpack within `MAX_CHUNK_BYTES`: they have no limit of their own."""
    for name in ('lz4', 'zstd'):
        storage_mcap.DECOMPRESSORS[name] = partial(_unpack_chunk, name)
    for name in ('lz4', 'bz2'):
        rosbag1_reader.decompressors[name] = partial(unpack, name)


def _unpack_chunk(compression: str, packed: bytes, size: int) -> bytes:
    """Return the content of a chunk that states its size."""
    return unpack(compression, packed, min(size, MAX_CHUNK_BYTES))
