"""Records of MCAP files, and size checks that run before MCAP or Zstandard data is decompressed.

The formats are specified at https://mcap.dev/spec and in RFC 8878 (Zstandard). MCAP also supports
LZ4, which expands data by a factor of at most 255.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct

from ..io.allowance import Allowance
from ..io.input_files import input_size, open_input

_MAGIC_BYTES = 8
_CHUNK = 0x06
_CHUNK_INDEX = 0x08
_METADATA = 0x0C
_RECORD = Struct("<BQ")  # record type and content length
_LENGTH_BYTES = 8  # size of the field that states the length of the compressed messages
# First and last time, decompressed size, checksum, length of the compression name.
_CHUNK_HEAD = Struct("<QQQII")
# First and last time, start and length of the chunk, length of the message offsets.
_INDEX_HEAD = Struct("<QQQQI")
_NAME_LENGTH = Struct("<I")
_SIZES = Struct("<QQ")  # compressed and decompressed size
_ZSTD = b"zstd"
_ADVICE = "record it with smaller chunks or without compression"

_FRAME = 0xFD2FB528
_SKIPPABLE_FRAMES = range(0x184D2A50, 0x184D2A60)
_BLOCK_HEADER_BYTES = 3
_BLOCK_BYTES = 128 << 10  # maximum decompressed size of a block
_RAW = 0
_REPEATED = 1


def check_chunks(path: Path) -> None:
    """Check that the chunks of an MCAP file do not decompress to an implausible size.

    Truncated chunks and files in other formats are not checked. The library that reads them reports
    such errors.

    Raises
    ------
    LidarError
        If a single chunk or all chunks together decompress to more than is allowed for a file of
        this size.
    OSError
        If the file cannot be read.
    """
    size = input_size(path)
    if size < _MAGIC_BYTES:
        return
    # Chunks and the index entries that refer to them are counted separately.
    totals = {kind: Allowance(size, _ADVICE, in_parts=True) for kind in (_CHUNK, _CHUNK_INDEX)}
    # The file is mapped because a bag may be large and only the headers are accessed.
    with open_input(path) as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        for kind, unpacked_bytes in _unpacked_sizes(data):
            Allowance(size, _ADVICE).reserve(unpacked_bytes)
            totals[kind].reserve(unpacked_bytes)


def read_metadata(path: Path) -> dict[str, dict[str, str]]:
    """Read the metadata records of an MCAP file.

    Truncated records are skipped.

    Returns
    -------
    dict
        Mapping from the name of each record to its content.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    records: dict[str, dict[str, str]] = {}
    if input_size(path) < _MAGIC_BYTES:
        return records
    with open_input(path) as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        for kind, start, stop in _records(data):
            if kind == _METADATA:
                name, *texts = _strings(data[start:stop])
                records[name] = dict(zip(texts[::2], texts[1::2], strict=False))
    return records


def _strings(content: bytes) -> Iterator[str]:
    """Yield the name of a metadata record, followed by alternating keys and values."""
    position = 0
    is_first = True
    while position + _NAME_LENGTH.size <= len(content):
        (length,) = _NAME_LENGTH.unpack_from(content, position)
        position += _NAME_LENGTH.size
        yield content[position : position + length].decode(errors="replace")
        position += length
        if is_first:
            position += _NAME_LENGTH.size  # skip the length of the map
            is_first = False


def check_packed(path: Path) -> None:
    """Check that a Zstandard file does not decompress to an implausible size on disk.

    Raises
    ------
    LidarError
        If the file decompresses to more than is allowed for a file of this size.
    OSError
        If the file cannot be read.
    """
    size = input_size(path)
    if not size:
        return
    with open_input(path) as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        unpacked_bytes = max_unpacked_bytes(data, 0, size)
    Allowance(size, _ADVICE, in_parts=True).reserve(unpacked_bytes)


def _records(data: mmap) -> Iterator[tuple[int, int, int]]:
    """Yield the type, content start and content stop of each complete record."""
    position = _MAGIC_BYTES
    while position + _RECORD.size <= len(data):
        kind, length = _RECORD.unpack_from(data, position)
        start = position + _RECORD.size
        position = start + length
        if position > len(data):
            return
        yield kind, start, position


def _unpacked_sizes(data: mmap) -> Iterator[tuple[int, int]]:
    """Yield the type and maximum decompressed size for each chunk record and chunk index record.

    Both are checked because they may disagree, and libraries find chunks through either of them.
    """
    for kind, start, stop in _records(data):
        try:
            if kind == _CHUNK:
                yield kind, _chunk_bytes(data, start, stop)
            elif kind == _CHUNK_INDEX:
                yield kind, _indexed_bytes(data, start)
        except struct.error:  # the record is too short
            continue


def _chunk_bytes(data: mmap, start: int, stop: int) -> int:
    """Return the maximum decompressed size of the chunk in a chunk record, in bytes."""
    *_, stated_bytes, _, name_length = _CHUNK_HEAD.unpack_from(data, start)
    name_start = start + _CHUNK_HEAD.size
    packed_start = name_start + name_length + _LENGTH_BYTES
    if data[name_start : name_start + name_length] != _ZSTD:
        return int(stated_bytes)
    return max(stated_bytes, max_unpacked_bytes(data, packed_start, stop))


def _indexed_bytes(data: mmap, start: int) -> int:
    """Return the maximum decompressed size of the chunk in a chunk index record, in bytes."""
    *_, chunk_start, _, offsets_length = _INDEX_HEAD.unpack_from(data, start)
    name_start = start + _INDEX_HEAD.size + offsets_length + _LENGTH_BYTES
    (name_length,) = _NAME_LENGTH.unpack_from(data, name_start)
    name_start += _NAME_LENGTH.size
    packed_length, stated_bytes = _SIZES.unpack_from(data, name_start + name_length)
    if data[name_start : name_start + name_length] != _ZSTD:
        return int(stated_bytes)
    packed_start = chunk_start + _RECORD.size + _CHUNK_HEAD.size + name_length + _LENGTH_BYTES
    packed_stop = min(packed_start + packed_length, len(data))
    return max(stated_bytes, max_unpacked_bytes(data, packed_start, packed_stop))


def max_unpacked_bytes(data: bytes | mmap, start: int, stop: int) -> int:
    """Return an upper bound on the decompressed size of Zstandard frames, in bytes.

    The frames are stored in `data` from `start` to `stop`.
    """
    total = 0
    position = start

    def number(length: int) -> int:
        """Decode the next `length` bytes as an unsigned integer."""
        return int.from_bytes(data[position : min(position + length, stop)], "little")

    while position + 8 <= stop:
        magic = number(4)
        if magic in _SKIPPABLE_FRAMES:
            position += 4
            position += 4 + number(4)
            continue
        if magic != _FRAME:
            break
        descriptor = data[position + 4]
        is_single = descriptor >> 5 & 1
        dictionary_bytes = (0, 1, 2, 4)[descriptor & 3]
        size_bytes = (is_single, 2, 4, 8)[descriptor >> 6]
        position += 5 + (1 - is_single) + dictionary_bytes + size_bytes
        is_last = False
        while not is_last and position + _BLOCK_HEADER_BYTES <= stop:
            header = number(_BLOCK_HEADER_BYTES)
            is_last = bool(header & 1)
            kind = header >> 1 & 3
            size = header >> 3
            total += size if kind in (_RAW, _REPEATED) else _BLOCK_BYTES
            position += _BLOCK_HEADER_BYTES + (1 if kind == _REPEATED else size)
        position += 4 * (descriptor >> 2 & 1)  # checksum
    return total
