"""Copies of MCAP files in which the content of some messages is replaced.

All other records keep their bytes, including publish times, sequence numbers, attachments and
metadata. Chunks without replaced messages are copied without decompressing them. The format is
specified at https://mcap.dev/spec.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct
from typing import IO, Any, NamedTuple
from zlib import crc32

from lidarsim.errors import CutShortError
from lidarsim.io.input_files import open_input

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = 0x02
_SCHEMA = 0x03
_CHANNEL = 0x04
_MESSAGE = 0x05
_CHUNK = 0x06
_MESSAGE_INDEX = 0x07
_CHUNK_INDEX = 0x08
_ATTACHMENT = 0x09
_ATTACHMENT_INDEX = 0x0A
_STATISTICS = 0x0B
_METADATA = 0x0C
_METADATA_INDEX = 0x0D
_SUMMARY_OFFSET = 0x0E
_DATA_END = 0x0F
_RECORD = Struct("<BQ")  # record type and content length
_MESSAGE_HEAD = Struct("<HIQQ")  # channel, sequence number, log time and publish time
_CHUNK_HEAD = Struct("<QQQI")  # first and last time, size, checksum
_ID = Struct("<H")
_LENGTH = Struct("<I")
_SIZE = Struct("<Q")
_ENTRY = Struct("<QQ")  # time and offset in a message index
_FOOTER_BODY = Struct("<QQI")
_STATISTICS_HEAD = Struct("<QHIIIIQQ")
_FOOTER_SIZE = _RECORD.size + _FOOTER_BODY.size + len(_MAGIC)
# Modules that compress with Zstandard. rosbags requires one of them, depending on its version.
_ZSTD_MODULES = ("compression.zstd", "backports.zstd", "zstandard")
_MAX_ID = 0xFFFF


class NewContent(NamedTuple):
    """New content of a message."""

    data: bytes
    added: bytes | None = None  # content of a message that follows it on the added topic


@dataclass(frozen=True)
class AddedTopic:
    """A topic that is added to the file."""

    topic: str
    type: str
    definition: str
    qos: str = ""


# Function that returns the new data of a message, given its topic, type, log time in nanoseconds
# and data, or None if the message is not replaced.
Replacement = Callable[[str, str, int, bytes], NewContent | None]


def copy_mcap(
    source: Path,
    target: Path,
    replaced_topic: str,
    replacement: Replacement,
    added: AddedTopic | None = None,
) -> None:
    """Copy an MCAP file, and replace messages of one topic.

    Parameters
    ----------
    source, target
        File to copy, and new file.
    replaced_topic
        Topic with the messages that are replaced.
    replacement
        Function that returns the new data of a message on this topic. See `Replacement`.
    added
        Topic for additional messages, or None.

    Raises
    ------
    ValueError
        If the file is damaged or uses an unknown compression.
    OSError
        If a file cannot be read or written.
    """
    with (
        open_input(source) as file,
        mmap(file.fileno(), 0, access=ACCESS_READ) as data,
        target.open("xb") as out,
    ):
        copy = _Copy(data, out, replaced_topic, replacement, added)
        copy.read_summary()
        copy.write()


def _record(kind: int, content: bytes | memoryview) -> bytes:
    return _RECORD.pack(kind, len(content)) + content


def _text(value: str | bytes) -> bytes:
    content = value.encode() if isinstance(value, str) else value
    return _LENGTH.pack(len(content)) + content


def _records(data: Any, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Yield the type, content start and content stop of each record.

    Raises CutShortError if a record is incomplete.
    """
    position = start
    while position < stop:
        if position + _RECORD.size > stop:
            raise CutShortError("its last record is incomplete")
        kind, length = _RECORD.unpack_from(data, position)
        begin = position + _RECORD.size
        position = begin + length
        if position > stop:
            raise CutShortError("its last record is incomplete")
        yield kind, begin, position


def _read_text(content: bytes, position: int) -> tuple[str, int]:
    """Return a text and the position behind it."""
    (length,) = _LENGTH.unpack_from(content, position)
    stop = position + _LENGTH.size + length
    return content[position + _LENGTH.size : stop].decode(errors="replace"), stop


@dataclass
class _Copy:
    """State of a copy."""

    data: Any
    out: IO[bytes]
    topic: str
    replacement: Replacement
    added: AddedTopic | None
    _schemas: dict[int, bytes] = field(default_factory=dict)
    _channels: dict[int, bytes] = field(default_factory=dict)
    _has_summary: bool = False
    # ID of the schema and the channel of the added topic. None before the first of its messages.
    _added_id: int | None = None
    _chunks: list[bytes] = field(default_factory=list)
    _attachments: list[bytes] = field(default_factory=list)
    _metadata: list[bytes] = field(default_factory=list)
    _counts: Counter[int] = field(default_factory=Counter)  # {channel: messages}
    _first_ns: int | None = None  # first log time
    _last_ns: int = 0  # last log time

    def read_summary(self) -> None:
        """Read the channels that the summary lists, so that not all chunks are decompressed."""
        size = len(self.data)
        if size < len(_MAGIC) + _FOOTER_SIZE:
            raise CutShortError("it has no footer")
        start, *_ = _FOOTER_BODY.unpack_from(self.data, size - _FOOTER_SIZE + _RECORD.size)
        if not start:
            return
        for kind, begin, stop in _records(self.data, start, size - len(_MAGIC)):
            self._define(kind, self.data[begin:stop])
        self._has_summary = bool(self._channels)

    def _define(self, kind: int, content: bytes) -> None:
        """Remember a schema or a channel."""
        if kind not in (_SCHEMA, _CHANNEL):
            return
        (number,) = _ID.unpack_from(content)
        if number == self._added_id:  # the summary is missing or incomplete
            raise ValueError(f"it has the channel {number}, which its summary does not list")
        (self._schemas if kind == _SCHEMA else self._channels)[number] = content

    def _name_of(self, channel: int) -> tuple[str, str]:
        """Return the topic and the type of a channel."""
        if channel not in self._channels:
            raise ValueError(f"its channel {channel} is not defined")
        content = self._channels[channel]
        (schema,) = _ID.unpack_from(content, _ID.size)
        topic, _ = _read_text(content, 2 * _ID.size)
        kind = _read_text(self._schemas[schema], _ID.size)[0] if schema in self._schemas else ""
        return topic, kind

    def write(self) -> None:
        """Copy all records, followed by a new summary."""
        self.out.write(_MAGIC)
        records = list(self._data_records())
        position = 0
        while position < len(records):
            kind, begin, stop = records[position]
            position += 1
            if kind == _CHUNK:
                indices = []
                while position < len(records) and records[position][0] == _MESSAGE_INDEX:
                    indices.append(records[position][1:])
                    position += 1
                self._copy_chunk(begin, stop, indices)
            elif kind == _MESSAGE:
                messages = _Messages()
                self._copy_message(self.data[begin:stop], messages)
                self.out.write(messages.content)
                self._count(messages)
            elif kind != _MESSAGE_INDEX:
                self._copy_record(kind, self.data[begin:stop])
        self._write_summary()

    def _data_records(self) -> Iterator[tuple[int, int, int]]:
        for kind, begin, stop in _records(self.data, len(_MAGIC), len(self.data) - len(_MAGIC)):
            if kind in (_DATA_END, _FOOTER):
                return
            yield kind, begin, stop

    def _copy_record(self, kind: int, content: bytes) -> None:
        """Copy a record other than a message or a chunk, and index it."""
        self._define(kind, content)
        start = self.out.tell()
        record = _record(kind, content)
        self.out.write(record)
        place = _ENTRY.pack(start, len(record))
        if kind == _METADATA:
            name, _ = _read_text(content, 0)
            self._metadata.append(place + _text(name))
        elif kind == _ATTACHMENT:
            times = content[: 2 * _SIZE.size]
            name, position = _read_text(content, 2 * _SIZE.size)
            media_type, position = _read_text(content, position)
            size = content[position : position + _SIZE.size]
            self._attachments.append(place + times + size + _text(name) + _text(media_type))

    def _copy_chunk(self, begin: int, stop: int, indices: list[tuple[int, int]]) -> None:
        """Copy a chunk with its message indices, and replace its messages."""
        chunk = _Chunk.from_bytes(self.data[begin:stop])
        contents = [self.data[first:last] for first, last in indices]
        channels = {_ID.unpack_from(content)[0] for content in contents}
        if self._has_summary and contents and all(self._is_kept(c) for c in channels):
            self._write_chunk(chunk, contents)
            return
        messages = _Messages()
        plain = chunk.decompress()
        for kind, first, last in _records(plain, 0, len(plain)):
            content = plain[first:last]
            if kind == _MESSAGE:
                self._copy_message(content, messages)
            else:
                self._define(kind, content)
                messages.content += _record(kind, content)
        if contents and messages.content == plain:
            self._write_chunk(chunk, contents)
            return
        self._write_chunk(chunk.with_content(messages), messages.indices())

    def _is_kept(self, channel: int) -> bool:
        return self._name_of(channel)[0] != self.topic

    def _copy_message(self, content: bytes, messages: _Messages) -> None:
        """Add a message to `messages`, and replace its content if it is on the chosen topic."""
        channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(content)
        topic, kind = self._name_of(channel)
        data = content[_MESSAGE_HEAD.size :]
        new = self.replacement(topic, kind, log_time, data) if topic == self.topic else None
        messages.add(channel, sequence, log_time, publish_time, data if new is None else new.data)
        if new is None or new.added is None or self.added is None:
            return
        if self._added_id is None:
            self._added_id = self._add_topic(self.added, messages)
        messages.add(self._added_id, sequence, log_time, publish_time, new.added)

    def _add_topic(self, added: AddedTopic, messages: _Messages) -> int:
        """Define the added topic, and return the unused ID of its schema and its channel."""
        used = self._schemas.keys() | self._channels.keys()
        number = next(number for number in range(_MAX_ID, 0, -1) if number not in used)
        self._schemas[number] = _ID.pack(number) + b"".join(
            map(_text, (added.type, "ros2msg", added.definition))
        )
        qos = _text("offered_qos_profiles") + _text(added.qos)
        self._channels[number] = (
            2 * _ID.pack(number) + _text(added.topic) + _text("cdr") + _text(qos)
        )
        messages.content += _record(_SCHEMA, self._schemas[number])
        messages.content += _record(_CHANNEL, self._channels[number])
        return number

    def _write_chunk(self, chunk: _Chunk, indices: list[bytes]) -> None:
        """Write a chunk and its message indices."""
        start = self.out.tell()
        record = _record(_CHUNK, chunk.encode())
        self.out.write(record)
        offsets = b""
        index_start = self.out.tell()
        for content in indices:
            (channel,) = _ID.unpack_from(content)
            offsets += _ID.pack(channel) + _SIZE.pack(self.out.tell())
            self.out.write(_record(_MESSAGE_INDEX, content))
            self._counts[channel] += (len(content) - _ID.size - _LENGTH.size) // _ENTRY.size
        if indices:
            self._extend_times(chunk.first_ns, chunk.last_ns)
        self._chunks.append(
            _ENTRY.pack(chunk.first_ns, chunk.last_ns)
            + _ENTRY.pack(start, len(record))
            + _text(offsets)
            + _SIZE.pack(self.out.tell() - index_start)
            + _text(chunk.compression)
            + _ENTRY.pack(len(chunk.packed), chunk.size)
        )

    def _count(self, messages: _Messages) -> None:
        """Count messages outside of chunks, of which each channel has one."""
        for channel, entries in messages.entries.items():
            self._counts[channel] += len(entries)
            self._extend_times(entries[0][0], entries[0][0])

    def _extend_times(self, first_ns: int, last_ns: int) -> None:
        self._first_ns = first_ns if self._first_ns is None else min(self._first_ns, first_ns)
        self._last_ns = max(self._last_ns, last_ns)

    def _write_summary(self) -> None:
        """Write the summary and the footer."""
        self.out.write(_record(_DATA_END, _LENGTH.pack(0)))
        start = self.out.tell()
        statistics = _STATISTICS_HEAD.pack(
            sum(self._counts.values()),
            len(self._schemas),
            len(self._channels),
            len(self._attachments),
            len(self._metadata),
            len(self._chunks),
            self._first_ns or 0,
            self._last_ns,
        )
        counts = b"".join(_ID.pack(c) + _SIZE.pack(n) for c, n in sorted(self._counts.items()))
        groups = {
            _SCHEMA: list(self._schemas.values()),
            _CHANNEL: list(self._channels.values()),
            _STATISTICS: [statistics + _text(counts)],
            _CHUNK_INDEX: self._chunks,
            _ATTACHMENT_INDEX: self._attachments,
            _METADATA_INDEX: self._metadata,
        }
        offsets = []
        for kind, contents in groups.items():
            group_start = self.out.tell()
            for content in contents:
                self.out.write(_record(kind, content))
            if contents:
                place = _ENTRY.pack(group_start, self.out.tell() - group_start)
                offsets.append(bytes([kind]) + place)
        offset_start = self.out.tell()
        for content in offsets:
            self.out.write(_record(_SUMMARY_OFFSET, content))
        self.out.write(_record(_FOOTER, _FOOTER_BODY.pack(start, offset_start, 0)))
        self.out.write(_MAGIC)


@dataclass
class _Messages:
    """Records of a chunk, with the positions of its messages."""

    content: bytearray = field(default_factory=bytearray)
    # {channel: [(log time, position)]}
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(
        self, channel: int, sequence: int, log_time: int, publish_time: int, data: bytes
    ) -> None:
        """Add a message."""
        self.entries.setdefault(channel, []).append((log_time, len(self.content)))
        head = _MESSAGE_HEAD.pack(channel, sequence, log_time, publish_time)
        self.content += _record(_MESSAGE, head + data)

    def indices(self) -> list[bytes]:
        """Return the content of the message indices."""
        return [
            _ID.pack(channel) + _text(b"".join(_ENTRY.pack(*entry) for entry in entries))
            for channel, entries in self.entries.items()
        ]


class _Chunk(NamedTuple):
    """Content of a chunk record."""

    first_ns: int
    last_ns: int
    size: int  # decompressed size in bytes
    checksum: int  # of the decompressed records, or 0
    compression: str
    packed: bytes

    @classmethod
    def from_bytes(cls, content: bytes) -> _Chunk:
        first_ns, last_ns, size, checksum = _CHUNK_HEAD.unpack_from(content)
        compression, position = _read_text(content, _CHUNK_HEAD.size)
        (length,) = _SIZE.unpack_from(content, position)
        begin = position + _SIZE.size
        packed = content[begin : begin + length]
        if len(packed) < length:
            raise CutShortError("a chunk is incomplete")
        return cls(first_ns, last_ns, size, checksum, compression, packed)

    def encode(self) -> bytes:
        """Return the content of the record."""
        head = _CHUNK_HEAD.pack(self.first_ns, self.last_ns, self.size, self.checksum)
        return head + _text(self.compression) + _SIZE.pack(len(self.packed)) + self.packed

    def decompress(self) -> bytes:
        """Return the records of the chunk. Raises ValueError if they are damaged."""
        plain = _codec(self.compression).decompress(self.packed)
        if len(plain) != self.size or (self.checksum and crc32(plain) != self.checksum):
            raise ValueError("a chunk is damaged, because its size or its checksum is wrong")
        return plain

    def with_content(self, messages: _Messages) -> _Chunk:
        """Return a chunk with other records and the same compression."""
        plain = bytes(messages.content)
        times = [time for entries in messages.entries.values() for time, _ in entries]
        return _Chunk(
            min(times, default=self.first_ns),
            max(times, default=self.last_ns),
            len(plain),
            crc32(plain),
            self.compression,
            _codec(self.compression).compress(plain),
        )


class _Codec(NamedTuple):
    """Functions that compress and decompress the records of a chunk."""

    compress: Callable[[bytes], bytes]
    decompress: Callable[[bytes], bytes]


def _codec(compression: str) -> _Codec:
    """Return the functions for a compression. Raises ValueError if it is unknown."""
    if not compression:
        return _Codec(bytes, bytes)
    if compression == "lz4":
        lz4 = import_module("lz4.frame")
        return _Codec(lz4.compress, lz4.decompress)
    if compression == "zstd":
        for name in _ZSTD_MODULES:
            with suppress(ModuleNotFoundError):
                zstd = import_module(name)
                return _Codec(zstd.compress, zstd.decompress)
    raise ValueError(f"its chunks have the unknown compression {compression!r}")
