"""Which recordings evidence is from, and how far they were read."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class ReadRecording:
    """A recording that evidence is from."""

    name: str
    """File name, '#', and a key of its whole path: two files of one name differ, and no path is told."""
    read_s: float
    """Seconds from its first image up to which it was read; infinite if to its end."""

    @classmethod
    def of(cls, source_name: str, read_s: float) -> ReadRecording:
        """Return the entry of a recording by its path or address."""
        whole = source_name if '://' in source_name else str(Path(source_name).resolve())
        key = hashlib.sha256(whole.encode('utf-8', 'replace')).hexdigest()[:16]
        return cls(f'{Path(source_name).name}#{key}', read_s)


def recording_arrays(recordings: Sequence[ReadRecording]) -> dict[str, np.ndarray]:
    """Return recordings as arrays by name, for files."""
    return {
        'recording_names': np.array([recording.name for recording in recordings], str),
        'recording_read_s': np.array([recording.read_s for recording in recordings], float),
    }


def recordings_of_arrays(names: np.ndarray, read_s: np.ndarray) -> tuple[ReadRecording, ...]:
    """Read the arrays of `recording_arrays`; ValueError if they are none."""
    if names.shape != read_s.shape or names.dtype.kind != 'U' or np.isnan(read_s).any():
        raise ValueError('recording_names and recording_read_s do not fit each other')
    return tuple(ReadRecording(str(name), float(seconds)) for name, seconds in zip(names, read_s, strict=True))
