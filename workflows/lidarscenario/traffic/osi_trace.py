"""Messages of ASAM OSI traces.

A binary trace (.osi) is a series of messages, each preceded by its length. With `--osi_compress`,
esmini compresses the whole trace with gzip and keeps the name, so compression is recognized by the
content of the file.
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Iterator
from importlib import import_module
from io import BufferedIOBase
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lidarsim.columns.mcap_chunks import check_chunks
from lidarsim.environment.extras import reading
from lidarsim.errors import CutShortError, LidarError, message_of
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import input_size, open_input

OSI_SUFFIXES = (".osi", ".osi.gz", ".mcap")
# An uncompressed trace starts with these bytes only if the length of its first message is 559,903
# plus a multiple of 16 MiB.
_GZIP = b"\x1f\x8b\x08"
_PIECE_BYTES = 2**20
_ADVICE = "Decompress it with gunzip first"
# A decoded message takes 9 to 15 times its encoded size in memory, and up to 215 times if all its
# objects are empty. Since messages compress to 30 to 45 %, one that is more than ten times as large
# as the file is assumed to contain empty objects.
_DECODED_TIMES = 16
_EMPTY_DECODED_TIMES = 215
_MAX_RATIO = 10
# Factor for the total size of all messages, which limits the time for decoding them. Traces from
# esmini decompress to about 3 times their size.
_TOTAL_TIMES = 4
# Bytes that are counted for each message in addition, because an empty message takes as long as
# decoding about this many bytes.
_MESSAGE_BYTES = 100
_LENGTH = struct.Struct("<I")


def iter_ground_truth(path: Path) -> Iterator[Any]:
    """Yield the ground truth of each message in a trace.

    SensorView messages without ground truth are skipped.

    Raises
    ------
    LidarError
        If the file cannot be read, if it is truncated, if it decompresses to far more than its
        size, or if the type of the messages is unknown or not supported. Complete messages before
        the end of a truncated file are yielded first.
    """
    osi: Any = import_module("betterosi")
    is_mcap = path.suffix.lower() == ".mcap"
    truths = _iter_mcap(osi, path) if is_mcap else _iter_binary(osi, path)
    while True:
        with reading(str(path)):
            truth = next(truths, None)
        if truth is None:
            return
        yield truth


def _iter_mcap(osi: Any, path: Path) -> Iterator[Any]:
    """Yield the ground truth of each message in an MCAP trace."""
    _check_content(path)
    check_chunks(path)
    yield from osi.read(str(path), return_ground_truth=True)


def _iter_binary(osi: Any, path: Path) -> Iterator[Any]:
    """Yield the ground truth of each message in a binary trace.

    Raise LidarError if the type of the messages is unknown or not supported, or ValueError if the
    file is invalid.
    """
    _check_content(path)
    kind = _type_from_name(osi, path)
    for number, data in enumerate(_iter_messages(path), 1):
        if kind is None:
            kind = _type_from_content(osi, data)
        try:
            message = getattr(osi, kind).from_binary(data)
        except ValueError as error:
            reason = message_of(error).rstrip(".")
            raise ValueError(
                f"its message {number:,} is not a valid {kind} message ({reason})"
            ) from error
        truth = message.global_ground_truth if kind == "SensorView" else message
        if truth is not None:
            yield truth


def _check_content(path: Path) -> None:
    if not input_size(path):
        raise LidarError("it is empty.")


def _iter_messages(path: Path) -> Iterator[bytes]:
    """Yield the encoded messages of a binary trace, which may be compressed with gzip.

    Raise ValueError if the file is truncated or not a trace, or LidarError if a compressed file
    decompresses to far more than its size.
    """
    count = 0
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        is_packed = file.peek(len(_GZIP)).startswith(_GZIP)
        stream: BufferedIOBase = gzip.GzipFile(fileobj=file) if is_packed else file
        total = Allowance(size, _ADVICE, in_parts=True)
        try:
            while header := stream.read(_LENGTH.size):
                if len(header) < _LENGTH.size:
                    raise _short_read(count)
                (length,) = _LENGTH.unpack(header)
                if is_packed:
                    data = _read_packed(stream, length, size)
                else:
                    data = file.read(min(length, size))  # allocates memory for the argument
                if len(data) < length:
                    raise _short_read(count)
                if is_packed:
                    total.reserve(_TOTAL_TIMES * (length + _MESSAGE_BYTES))
                count += 1
                yield data
        except EOFError as error:
            raise CutShortError(
                f"its gzip stream ends in message {count + 1:,}. Run the simulation again, or end "
                "the survey earlier"
            ) from error
        except (zlib.error, gzip.BadGzipFile) as error:
            raise ValueError(f"its gzip data is corrupt after message {count:,}") from error


def _read_packed(stream: BufferedIOBase, length: int, size: int) -> bytes:
    """Read a message of a compressed trace, or less if the trace is shorter.

    Raise LidarError if the message is too large for a file of this size. Since the length is
    arbitrary if the file is not a trace, that is only an error if the file contains the data.
    """
    allowance = Allowance(size, _ADVICE)
    times = _DECODED_TIMES if length <= _MAX_RATIO * size else _EMPTY_DECODED_TIMES
    if allowance.fits(times * length):
        return stream.read(length)
    remaining = allowance.limit // times
    while piece := stream.read(min(remaining, _PIECE_BYTES)):
        remaining -= len(piece)
    if not remaining:
        allowance.check(times * length)
    return b""


def _short_read(count: int) -> ValueError:
    """Return the error for a trace that ends after `count` messages and a part of another."""
    if count:
        return CutShortError(f"it ends in message {count + 1:,}")
    return ValueError(
        "its first message is longer than the file, so it is truncated or is not an OSI trace"
    )


def _type_from_name(osi: Any, path: Path) -> str | None:
    """Return the message type that is part of a trace's file name, or None if there is none.

    Raise LidarError if messages of this type contain no ground truth.
    """
    name = path.with_suffix("") if path.suffix.lower() == ".gz" else path
    kind: str | None = osi.io.osi_message_type_from_filename(name)
    if kind in (None, "GroundTruth", "SensorView"):
        return kind
    raise LidarError(
        f"its name indicates messages of type {kind}, but only GroundTruth and SensorView are "
        "supported."
    )


def _type_from_content(osi: Any, data: bytes) -> str:
    """Return the type of a message, given its content.

    Raise LidarError if the type cannot be determined. betterosi determines types only for files.
    """
    with TemporaryDirectory() as folder:
        file = Path(folder, "message.osi")
        file.write_bytes(_LENGTH.pack(len(data)) + data)
        try:
            messages = osi.read(str(file), return_ground_truth=True, return_sensor_view=True)
            return type(next(messages)).__name__
        except (ValueError, StopIteration) as error:
            raise LidarError(
                "the type of its first message (GroundTruth or SensorView) cannot be determined. "
                "Specify the type in the file name, as in town_gt.osi or town_sv.osi."
            ) from error
