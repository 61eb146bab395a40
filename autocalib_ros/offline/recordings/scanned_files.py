"""Read recordings without their index: of killed recorders, merged out of order, or with channels of other formats.

The whole file is gone through once. Records that are complete are used, damaged chunks are left out and counted, and
messages come in the order of time. https://mcap.dev/spec, https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, NamedTuple

from autocalib_ros.errors import InputError
from autocalib_ros.offline.recordings.unpacking import unpack
from autocalib_ros.util.input_limits import MAX_CHUNK_BYTES

MCAP_MAGIC, ROSBAG1_MAGIC = b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n'
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
"""Opcodes of MCAP records."""
MESSAGE1, CHUNK1, CONNECTION1 = 0x02, 0x05, 0x07
"""Operations of records of ROS 1."""
MCAP_RECORD, MCAP_MESSAGE, MCAP_CHUNK = struct.Struct('<BQ'), struct.Struct('<HIQQ'), struct.Struct('<QQQI')
CHUNKS_IN_MEMORY = 4
"""Chunks that are kept unpacked: messages of two merged recordings alternate between as many."""


@dataclass(frozen=True)
class ScannedConnection:
    """A channel of a recording, with the names of rosbags."""

    id: int
    topic: str
    msgtype: str
    """As `sensor_msgs/msg/Image`, also for ROS 1."""
    is_ros1: bool
    """Whether its messages are serialised as by ROS 1."""
    msgcount: int = 0


class _Place(NamedTuple):
    """Where a message is: its time, connection, chunk (-1 for the file itself), position and bytes."""

    time_ns: int
    connection: int
    chunk: int
    position: int
    size: int


class _Record(NamedTuple):
    opcode: int
    fields: Mapping[bytes, bytes]
    """Of the header of ROS 1, by name; none for MCAP."""
    position: int
    """Of the content."""
    size: int


class ScannedFile:
    """A recording that was gone through once, with the interface of the readers of rosbags."""

    def __init__(self, path: Path) -> None:
        """InputError if it is neither an MCAP file nor a ROS 1 bag."""
        self._path = path
        with path.open('rb') as stream:
            self._format = _format_of(stream, path)
            self.damaged_chunks = 0
            self._places: list[_Place] = []
            self._connections: dict[int, ScannedConnection] = {}
            self._chunks: dict[int, _Record] = {}
            size = stream.seek(0, io.SEEK_END)
            self.is_complete = self._scan(stream, self._format.begin, size, -1)
        self._stream: BinaryIO | None = None
        self._unpacked = lru_cache(CHUNKS_IN_MEMORY)(self._unpack)
        counts = Counter(place.connection for place in self._places)
        self.connections = [replace(one, msgcount=counts[one.id]) for one in self._connections.values()]
        self._places.sort(key=lambda place: place.time_ns)
        self.start_time = self._places[0].time_ns if self._places else 2**63 - 1
        self.end_time = self._places[-1].time_ns + 1 if self._places else 0

    def open(self) -> None:
        """Open the file for `messages`."""
        self._stream = self._path.open('rb')

    def close(self) -> None:
        """Close it, and drop the chunks in memory."""
        if self._stream is not None:
            self._stream.close()
        self._stream = None
        self._unpacked.cache_clear()

    def messages(
        self, connections: Collection[ScannedConnection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[ScannedConnection, int, bytes]]:
        """Yield connection, time of recording and bytes of messages in order of time, within [start, stop)."""
        wanted = {one.id: one for one in connections}
        for place in self._places:
            early = start is not None and place.time_ns < start
            if place.connection not in wanted or early or (stop is not None and place.time_ns >= stop):
                continue
            if self._stream is None:
                raise ValueError('the file is not open')
            stream: BinaryIO = self._stream if place.chunk < 0 else io.BytesIO(self._unpacked(place.chunk))
            stream.seek(place.position)
            yield wanted[place.connection], place.time_ns, stream.read(place.size)

    def _unpack(self, position: int) -> bytes:
        """Return the content of the chunk whose content begins at a position of the open file."""
        if self._stream is None:
            raise ValueError('the file is not open')
        return self._content(self._stream, self._chunks[position])

    def _content(self, stream: BinaryIO, chunk: _Record) -> bytes:
        stream.seek(chunk.position)
        return self._format.unpacked(stream, chunk)

    def _scan(self, stream: BinaryIO, begin: int, end: int, chunk: int) -> bool:
        """Note the messages between two positions; return whether all records are complete."""
        position = begin
        while position < end:
            record = self._format.record(stream, position, end)
            if record is None:
                return False
            if record.opcode == DATA_END and isinstance(self._format, _McapFormat):
                return chunk >= 0 or _ends_well(stream)
            if chunk >= 0:
                self._note(stream, record, chunk)
            else:
                self._note_or_count(stream, record)
            position = record.position + record.size
        return isinstance(self._format, _Rosbag1Format) or chunk >= 0

    def _note_or_count(self, stream: BinaryIO, record: _Record) -> None:
        """Note a record of the file itself; a damaged one is left out and counted."""
        try:
            self._note(stream, record, -1)
        except Exception:  # damaged records raise arbitrary exceptions
            self.damaged_chunks += 1

    def _note(self, stream: BinaryIO, record: _Record, chunk: int) -> None:
        stream.seek(record.position)
        kind = self._format.kind(record)
        if kind == 'chunk' and chunk < 0:
            self._note_chunk(stream, record)
        elif kind == 'message':
            connection, time_ns, offset = self._format.message(stream, record)
            self._places.append(_Place(time_ns, connection, chunk, record.position + offset, record.size - offset))
        elif kind == 'connection':
            found = self._format.connection(stream.read(record.size), record)
            if found is not None:
                self._connections.setdefault(found.id, found)

    def _note_chunk(self, stream: BinaryIO, record: _Record) -> None:
        before = len(self._places)
        self._chunks[record.position] = record
        try:
            content = self._content(stream, record)
            if self._scan(io.BytesIO(content), 0, len(content), record.position):
                return
        except Exception:  # decoders of damaged chunks raise arbitrary exceptions
            del self._places[before:]
        self.damaged_chunks += 1


def _format_of(stream: BinaryIO, path: Path) -> _McapFormat | _Rosbag1Format:
    magic = stream.read(len(ROSBAG1_MAGIC))
    if magic.startswith(MCAP_MAGIC):
        return _McapFormat(len(MCAP_MAGIC))
    if magic == ROSBAG1_MAGIC:
        return _Rosbag1Format(len(ROSBAG1_MAGIC))
    raise InputError(f'{path} is no recording, whatever its name says')


def _ends_well(stream: BinaryIO) -> bool:
    """Whether a file ends as a recorder of MCAP closes it."""
    stream.seek(-len(MCAP_MAGIC), io.SEEK_END)
    return stream.read() == MCAP_MAGIC


class _McapFormat:
    """Records of MCAP: an opcode, a length in 8 bytes, and the content."""

    def __init__(self, begin: int) -> None:
        self.begin = begin
        self._schemas: dict[int, str] = {}

    @staticmethod
    def record(stream: BinaryIO, position: int, end: int) -> _Record | None:
        """Return the record at a position; None if it is not complete."""
        stream.seek(position)
        head = stream.read(MCAP_RECORD.size)
        if len(head) < MCAP_RECORD.size:
            return None
        opcode, size = MCAP_RECORD.unpack(head)
        begin = position + MCAP_RECORD.size
        return None if opcode == 0 or begin + size > end else _Record(opcode, {}, begin, size)

    @staticmethod
    def kind(record: _Record) -> str:
        """Return what a record is."""
        return {SCHEMA: 'connection', CHANNEL: 'connection', MESSAGE: 'message', CHUNK: 'chunk'}.get(record.opcode, '')

    @staticmethod
    def message(stream: BinaryIO, _: _Record) -> tuple[int, int, int]:
        """Return connection and time of a message, and the length of its head."""
        channel, _sequence, time_ns, _published = MCAP_MESSAGE.unpack(stream.read(MCAP_MESSAGE.size))
        return channel, time_ns, MCAP_MESSAGE.size

    def connection(self, content: bytes, record: _Record) -> ScannedConnection | None:
        """Note a schema, or return a channel."""
        stream = io.BytesIO(content)
        (key,) = struct.unpack('<H', stream.read(2))
        if record.opcode == SCHEMA:
            self._schemas[key] = _text(stream)
            return None
        (schema,) = struct.unpack('<H', stream.read(2))
        topic, encoding = _text(stream), _text(stream)
        kind = self._schemas.get(schema, 'no schema')
        if encoding not in ('cdr', 'ros1'):
            return ScannedConnection(key, topic, f'{kind} in {encoding or "no encoding"}', False)
        return ScannedConnection(key, topic, _ros2_name(kind), encoding == 'ros1')

    @staticmethod
    def unpacked(stream: BinaryIO, _: _Record) -> bytes:
        """Return the records of a chunk at whose content the stream is."""
        _, _, size, _ = MCAP_CHUNK.unpack(stream.read(MCAP_CHUNK.size))
        compression = _text(stream)
        (packed,) = struct.unpack('<Q', stream.read(8))
        return _decompress(compression, stream.read(packed), size)


class _Rosbag1Format:
    """Records of ROS 1: a header of named fields and data, each after its length in 4 bytes."""

    def __init__(self, begin: int) -> None:
        self.begin = begin

    @staticmethod
    def record(stream: BinaryIO, position: int, end: int) -> _Record | None:
        """Return the record at a position; None if it is not complete."""
        stream.seek(position)
        head = _sized(stream, end)
        length = stream.read(4)
        if head is None or len(length) < 4:
            return None
        begin, (size,) = stream.tell(), struct.unpack('<I', length)
        fields = _fields(head)
        return None if begin + size > end else _Record(fields.get(b'op', b'\0')[0], fields, begin, size)

    @staticmethod
    def kind(record: _Record) -> str:
        """Return what a record is."""
        return {CONNECTION1: 'connection', MESSAGE1: 'message', CHUNK1: 'chunk'}.get(record.opcode, '')

    @staticmethod
    def message(_: BinaryIO, record: _Record) -> tuple[int, int, int]:
        """Return connection and time of a message; its data have no head."""
        seconds, nanoseconds = struct.unpack('<II', record.fields[b'time'])
        return struct.unpack('<I', record.fields[b'conn'])[0], seconds * 10**9 + nanoseconds, 0

    @staticmethod
    def connection(content: bytes, record: _Record) -> ScannedConnection:
        """Return a connection."""
        (key,) = struct.unpack('<I', record.fields[b'conn'])
        kind = _fields(content).get(b'type', b'').decode('utf-8', 'replace')
        return ScannedConnection(key, record.fields[b'topic'].decode('utf-8', 'replace'), _ros2_name(kind), True)

    @staticmethod
    def unpacked(stream: BinaryIO, record: _Record) -> bytes:
        """Return the records of a chunk at whose content the stream is."""
        return _decompress(record.fields[b'compression'].decode(), stream.read(record.size), None)


def _decompress(compression: str, packed: bytes, size: int | None) -> bytes:
    """Return unpacked data; InputError for another compression or another size than stated."""
    data = unpack(compression, packed, MAX_CHUNK_BYTES if size is None else min(size, MAX_CHUNK_BYTES))
    if size is not None and len(data) != size:
        raise InputError('a chunk has another size than it states')
    return data


def _ros2_name(kind: str) -> str:
    """Return the name of a message type as ROS 2 writes it."""
    package, _, name = kind.partition('/')
    return f'{package}/msg/{name}' if name and '/' not in name else kind


def _text(stream: BinaryIO) -> str:
    (size,) = struct.unpack('<I', stream.read(4))
    return stream.read(size).decode('utf-8', 'replace')


def _sized(stream: BinaryIO, end: int) -> bytes | None:
    """Return bytes after their length; None if they are not complete."""
    length = stream.read(4)
    if len(length) < 4:
        return None
    (size,) = struct.unpack('<I', length)
    return stream.read(size) if stream.tell() + size <= end else None


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields name=value of a header of ROS 1."""
    fields, stream = {}, io.BytesIO(header)
    while (field := _sized(stream, len(header))) is not None:
        name, _, value = field.partition(b'=')
        fields[name] = value
    return fields
