"""A file of checksummed records that only grows, and what is left of one after a crash.

Each record is a head (magic, kind, length of the payload, `durable`, CRC-32 of all that) and
its payload. `durable` says how much of the file had been synced when the record was written:
that much cannot have been lost by a crash or a power cut. So what is wrong tells by where it
is. Bad bytes before the `durable` of a later record are damage; bad bytes behind all of them
are a write that was cut off, which a disk may also leave out of order or as zeros.
"""

from __future__ import annotations

import errno
import os
import struct
import sys
import time
import weakref
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

if sys.platform != "win32":
    import fcntl

MAGIC = b"\x93LPR"
_HEAD = struct.Struct("<4sIQQ")
_CRC = struct.Struct("<I")
HEAD_BYTES = _HEAD.size + _CRC.size

MARK = 0  # a record with nothing in it but the `durable` of its head

SYNC_EVERY_S = 1.0
SYNC_SHARE = 20  # a disk on which a sync takes long is synced so many times less often

_WINDOW = 1 << 20  # bytes looked through at a time
_LARGE = 16 << 20  # bytes of a payload that is not believed in before it was looked through

Buffer = bytes | bytearray | memoryview


class DamagedFileError(ValueError):
    """A file of records holds bad bytes where there were good ones; the message is a clause."""


@dataclass(frozen=True)
class Record:
    """One record of a file: what kind, where its payload begins, the payload."""

    kind: int
    offset: int
    payload: bytearray


class RecordFile:
    """An open file of records, locked against other runs.

    Parameters
    ----------
    path
        The file; made if it is not there.

    Raises
    ------
    BlockingIOError
        If another process has it open.
    OSError
        If it cannot be opened or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: BinaryIO = os.fdopen(
            os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666),
            "r+b",
            buffering=0,
        )
        self.close = weakref.finalize(self, self._file.close)  # and unlock it
        try:
            _lock(self._file.fileno())
        except BaseException:
            self.close()
            raise
        self.end = os.fstat(self._file.fileno()).st_size
        self._durable = 0
        self._ragged = False  # whether there are bytes after `end`
        self._synced_at = time.monotonic()
        self._sync_wait = SYNC_EVERY_S

    def records(self) -> Iterator[Record]:
        """Read all records from the start; after the last, `end` is where a crash cut the file.

        Raises
        ------
        DamagedFileError
            If bytes are bad that had been synced.
        OSError
            If it cannot be read.
        """
        size, at = self.end, 0
        while record := self._record_at(at, size):
            yield record
            at = record.offset + len(record.payload)
        if at < size and (later := self._find_later(at, size)) is not None:
            raise DamagedFileError(
                f"the record at byte {at:,} is damaged, and there are whole ones after it, "
                f"at byte {later:,}"
            )
        self.end, self._ragged = at, at < size

    def check(self) -> None:
        """Read all records once more, and change nothing.

        Raises
        ------
        DamagedFileError, OSError
            If one is not there as it was written: somebody else has written to the file, or
            cut it.
        """
        at = 0
        while at < self.end:
            record = self._record_at(at, self.end)
            if record is None:
                raise DamagedFileError(f"the record at byte {at:,} is damaged")
            at = record.offset + len(record.payload)

    def clear(self) -> None:
        """Drop all that is in the file; OSError if that cannot be done."""
        self._file.truncate(0)
        self.end = self._durable = 0
        self._ragged = False

    def append(self, kind: int, *pieces: Buffer) -> int:
        """Write a record, its payload given in pieces; returns where the payload begins.

        What a crash has left behind the last whole record is cut off.

        Raises
        ------
        OSError
            If the disk is full or fails; the file is as it was before.
        """
        views = [memoryview(piece).cast("B") for piece in pieces]
        head = _HEAD.pack(MAGIC, kind, sum(map(len, views)), self._durable)
        crc = zlib.crc32(head)
        for view in views:
            crc = zlib.crc32(view, crc)
        at = self.end
        try:
            if self._ragged:
                self._file.truncate(at)
                self._ragged = False
            self._file.seek(at)
            for piece in (memoryview(head + _CRC.pack(crc)), *views):
                _write_all(self._file, piece)
                at += len(piece)
        except BaseException:
            self._file.truncate(self.end)
            raise
        begin, self.end = self.end + HEAD_BYTES, at
        return begin

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill `buffer` from byte `offset` on.

        Raises
        ------
        OSError
            If the file ends before.
        """
        read_into(self._file, offset, buffer)

    def sync(self) -> None:
        """Wait until all records are on the disk."""
        if self._durable == self.end:
            return
        begun = time.monotonic()
        os.fsync(self._file.fileno())
        self._synced_at = time.monotonic()
        self._sync_wait = max(SYNC_EVERY_S, SYNC_SHARE * (self._synced_at - begun))
        self._durable = self.end

    def sync_if_due(self) -> None:
        """Sync once a second, or where that takes long, a twentieth of the time."""
        if time.monotonic() - self._synced_at >= self._sync_wait:
            self.sync()

    def mark(self) -> None:
        """Sync, and write down that everything up to here is on the disk."""
        if self._durable != self.end:
            self.sync()
            self.append(MARK)
            self._durable = self.end  # of no use to sync this one as well

    def is_at(self, path: Path) -> bool:
        """Whether this file, and no other, is to be found there."""
        try:
            return os.path.samestat(os.fstat(self._file.fileno()), path.stat())
        except (OSError, ValueError):  # the latter: it is closed
            return False

    def unlock(self) -> None:
        """Let others open it: nothing more will be written."""
        if sys.platform != "win32":
            with suppress(OSError):  # a disk without locks, see `_lock`
                fcntl.flock(self._file.fileno(), fcntl.LOCK_UN)

    def _record_at(self, at: int, size: int) -> Record | None:
        """Record that begins at a byte; None if there is no whole one."""
        if size - at < HEAD_BYTES:
            return None
        head = bytearray(HEAD_BYTES)
        self.read_into(at, memoryview(head))
        magic, kind, length, _ = _HEAD.unpack_from(head)
        if magic != MAGIC or length > size - at - HEAD_BYTES:
            return None
        begin, crc = at + HEAD_BYTES, zlib.crc32(memoryview(head)[: _HEAD.size])
        (expected,) = _CRC.unpack_from(head, _HEAD.size)
        # A length that is damaged may be that of all the rest of the file.
        if length > _LARGE and self._checksum(begin, length, crc) != expected:
            return None
        payload = bytearray(length)
        self.read_into(begin, memoryview(payload))
        return Record(kind, begin, payload) if zlib.crc32(payload, crc) == expected else None

    def _checksum(self, at: int, length: int, crc: int) -> int:
        """Continue a checksum over so many bytes of the file, of which few are in memory."""
        window = memoryview(bytearray(_WINDOW))
        while length:
            view = window[: min(_WINDOW, length)]
            self.read_into(at, view)
            crc = zlib.crc32(view, crc)
            at, length = at + len(view), length - len(view)
        return crc

    def _find_later(self, bad: int, size: int) -> int | None:
        """Whole record after byte `bad` that was written when `bad` had been synced."""
        window = bytearray(_WINDOW)
        at = bad + 1
        while at < size:
            view = memoryview(window)[: min(_WINDOW, size - at)]
            self.read_into(at, view)
            found = bytes(view).find(MAGIC)
            if found < 0:
                at += max(1, len(view) - len(MAGIC) + 1)
                continue
            at += found
            if self._record_at(at, size) and self._durable_at(at) > bad:
                return at
            at += 1
        return None

    def _durable_at(self, at: int) -> int:
        head = bytearray(_HEAD.size)
        self.read_into(at, memoryview(head))
        return int(_HEAD.unpack(head)[3])


def read_into(file: Any, offset: int, buffer: memoryview) -> None:
    """Fill `buffer` from byte `offset` of an unbuffered file; OSError if that ends before."""
    file.seek(offset)
    done = 0
    while done < len(buffer):
        count = file.readinto(buffer[done:])
        if not count:
            raise OSError(f"the file ends at byte {offset + done:,}, before its records do")
        done += count


def _write_all(file: Any, view: memoryview) -> None:
    """Write all of `view`; a full disk takes a part of it and says so at the next write."""
    while len(view):
        view = view[file.write(view) :]


def _lock(handle: int) -> None:
    if sys.platform == "win32":  # does not let two open a file for writing and delete it
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a network disk without locks
            raise
