"""File format of evidence: one compressed .npz with the arrays of `Evidence` by name and a small header."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.util.files import replaced_atomically
from autocalib_ros.util.input_limits import MAX_EVIDENCE_BYTES
from autocalib_ros.util.packed_arrays import packed_arrays

FORMAT = 1
"""Version of the layout; other versions are refused."""
LOAD_ERRORS = (
    OSError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    EOFError,
    OverflowError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""Exceptions that NumPy and zipfile raise for files that are damaged, encrypted or of another type."""


def write_evidence_file(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    *,
    image_size: tuple[int, int],
    stamps_ns: tuple[int, int],
    frames: int,
    drift_px: float,
) -> None:
    """Write arrays by name and the header atomically; create the folder. InputError if that fails.

    `stamps_ns` are those of the first and the newest image.
    """
    columns: dict[str, Any] = dict(arrays)
    with replaced_atomically(path) as stream:
        np.savez_compressed(
            stream,
            format=FORMAT,
            image_size=image_size,
            drift_px=drift_px,
            frames=frames,
            stamps_ns=np.array(stamps_ns, np.int64),
            **columns,
        )


@contextmanager
def evidence_file(path: Path, required: Iterable[str], optional: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Read a file and yield the fields of `Evidence` by name; optional arrays that it lacks are left out.

    Errors while reading, or while the caller builds and checks the evidence inside the block, become InputError.
    """
    path = Path(path)
    try:
        with packed_arrays(path, MAX_EVIDENCE_BYTES) as data:
            if int(data['format']) != FORMAT:
                raise InputError(f'{path} holds evidence of format {int(data["format"])}, not {FORMAT}')
            first, newest = (int(stamp) for stamp in data['stamps_ns'])
            width, height = (int(value) for value in data['image_size'])
            yield {
                'image_size': (width, height),
                'first_stamp_ns': first,
                'newest_stamp_ns': newest,
                'frames': int(data['frames']),
                'drift_px': float(data['drift_px']),
                **{name: data[name] for name in required},
                **{name: data[name] for name in optional if name in data},
            }
    except LOAD_ERRORS as error:
        reason = ' '.join(str(error).split())
        raise InputError(f'{path} is not a file of saved evidence (.npz): {reason}') from error
