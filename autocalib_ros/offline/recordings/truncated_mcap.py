"""Read an .mcap file without its footer, as a killed recorder leaves it.

Readers refuse such a file. Here its complete records are presented together with a footer without index, so that a
reader scans them; nothing is written or copied. A record is an opcode (1 byte), a length (8 bytes, little-endian) and
its content; https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any, BinaryIO

MAGIC = b'\x89MCAP0\r\n'
FOOTER = b'\x02' + struct.pack('<QQQI', 20, 0, 0, 0) + MAGIC
"""Footer record without summary section and checksum, and the closing magic bytes."""
DATA_END = 0x0F
RECORD_HEAD = struct.Struct('<BQ')


def is_truncated(path: Path) -> bool:
    """Return whether the file is a truncated .mcap; False for files that are not .mcap."""
    if path.suffix != '.mcap':
        return False
    with path.open('rb') as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return False
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(size - len(MAGIC), 0))
        return size < 2 * len(MAGIC) or stream.read() != MAGIC


def readable_path(path: Path) -> Any:
    """Return the path, or for a truncated .mcap a substitute whose `open` gives the complete records and a footer."""
    if not is_truncated(path):
        return path
    with path.open('rb') as stream:
        return _TruncatedMcapPath(path, _count_complete_bytes(stream, stream.seek(0, io.SEEK_END)))


def _count_complete_bytes(stream: BinaryIO, size: int) -> int:
    """Return the end of the last complete record of the data section in bytes."""
    position = len(MAGIC)
    while position + RECORD_HEAD.size <= size:
        stream.seek(position)
        opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        if opcode in (0, DATA_END) or position + RECORD_HEAD.size + length > size:
            break
        position += RECORD_HEAD.size + length
    return position


class _TruncatedMcapPath:
    """Substitute for the path of a truncated file, with the methods that rosbags uses."""

    def __init__(self, path: Path, complete_bytes: int) -> None:
        self._path, self._complete_bytes = path, complete_bytes
        self.suffix, self.stem = path.suffix, path.stem

    def __str__(self) -> str:
        return str(self._path)

    def exists(self) -> bool:
        """Return True."""
        return True

    def is_dir(self) -> bool:
        """Return False: it is a file."""
        return False

    def open(self, *_: Any, **__: Any) -> BinaryIO:
        """Open the complete records, followed by the footer, for reading."""
        return io.BufferedReader(_StreamWithFooter(self._path.open('rb', buffering=0), self._complete_bytes))


class _StreamWithFooter(io.RawIOBase):
    """The first `complete_bytes` bytes of a file, then FOOTER."""

    def __init__(self, stream: Any, complete_bytes: int) -> None:
        super().__init__()
        self._stream, self._complete_bytes, self._position = stream, complete_bytes, 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a position and return it."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._complete_bytes + len(FOOTER)}[whence]
        self._position = max(base + offset, 0)
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer from the file or from the footer."""
        if self._position < self._complete_bytes:
            self._stream.seek(self._position)
            data = self._stream.read(min(len(buffer), self._complete_bytes - self._position))
        else:
            behind = self._position - self._complete_bytes
            data = FOOTER[behind : behind + len(buffer)]
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
        super().close()
