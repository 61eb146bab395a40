"""Read `.npz` files of unknown origin: what they unpack to is added up before anything is unpacked."""

from __future__ import annotations

import tokenize
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.errors import InputError


@contextmanager
def packed_arrays(path: Path, limit: int) -> Iterator[Any]:
    """Open a file as `np.load` does, without pickles.

    InputError if its arrays have more than `limit` bytes. Damaged files raise what NumPy and zipfile raise.
    """
    with path.open('rb') as stream:
        with zipfile.ZipFile(stream) as archive:
            stated = sum(item.file_size for item in archive.infolist())
            if stated <= limit:  # then what the members say that they hold may still be more
                stated = sum(_array_bytes(archive, item) for item in archive.infolist())
        if stated > limit:
            raise InputError(f'{path} unpacks to {stated / 1e6:.0f} MB; at most {limit / 1e6:.0f} MB are read')
        stream.seek(0)
        with np.load(stream, allow_pickle=False) as arrays:
            yield arrays


def _array_bytes(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> int:
    """Return the bytes of an array by its header: NumPy takes them before it reads the first one."""
    with archive.open(item) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        try:
            shape, _, kind = read(member)
        except (SyntaxError, tokenize.TokenError) as error:  # NumPy reads the header as an expression
            raise ValueError(f'the header of {item.filename} is damaged') from error
    size = kind.itemsize
    for side in shape:
        if side < 0:
            raise ValueError(f'{item.filename} has a negative size')
        size *= side
    return size
