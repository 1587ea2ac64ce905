"""Read parts in blocks of rows, reusing the same memory for each block.

Each column of a part is stored contiguously, so the columns of one row are far apart in the file.
If a whole part were read at once, its data would not fit in the CPU caches: it would be written to
main memory and then read again for the checksums, the cloud and the statistics. The operating
system would also have to allocate and free a large buffer for each part. A block with a limited
number of rows stays in the cache of one core.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from io import BufferedReader
from typing import NamedTuple

import numpy as np

from lidarsim.columns.table import SCAN, Column
from lidarsim.errors import LidarError
from lidarsim.io.archives import StoredArray, locate_arrays
from lidarsim.io.checksum import crc32
from lidarsim.io.input_files import open_input
from lidarsim.io.storage import Storage
from lidarsim.numerics.arrays import AnyArray, Bytes, Ints

from .block_loops import write_scans
from .parts import reading_part

_ALIGNMENT = 64  # bytes, the size of a cache line


class BlockMemory:
    """Memory for the columns of one block of rows. It is reused for each block.

    Parameters
    ----------
    columns
        Columns of a part, and `scan` if scan numbers are required.
    max_rows
        Maximum number of rows in a block.

    Attributes
    ----------
    data
        Bytes of all columns. Each column is contiguous. Shape (bytes,).
    starts
        {column name: byte offset in `data`}. Offsets are multiples of 64.
    """

    data: Bytes
    starts: Mapping[str, int]

    def __init__(self, columns: Sequence[Column], max_rows: int) -> None:
        self.max_rows = max_rows
        starts = {}
        size = 0
        for column in columns:
            starts[column.name] = size
            column_bytes = max_rows * np.dtype(column.dtype).itemsize
            size += -(-column_bytes // _ALIGNMENT) * _ALIGNMENT
        self.starts = starts
        self.data = np.zeros(size, np.uint8)
        self._columns = {
            column.name: np.frombuffer(self.data, column.dtype, max_rows, starts[column.name])
            for column in columns
        }

    def columns(self, rows: int) -> dict[str, AnyArray]:
        """Return views of all columns, limited to the first `rows` rows, as {name: array}.

        The views are overwritten when the next block is read.
        """
        return {name: values[:rows] for name, values in self._columns.items()}


def read_blocks(
    storage: Storage, name: str, row_count: int, memory: BlockMemory
) -> Iterator[dict[str, AnyArray]]:
    """Read the blocks of a part into `memory` one by one, and yield the columns of each block.

    Checksums are compared after the last block. Discard any results computed from the blocks unless
    the iterator finishes without an error.

    Raises
    ------
    LidarError
        If the part is missing, unreadable or damaged, if its columns do not match those of
        `memory`, or if it does not have `row_count` rows.
    """
    with ExitStack() as stack:
        with reading_part(storage, name):
            file = _open(storage, name)
            stack.callback(file.close)
            part = _OpenPart(file, row_count, memory)
        for first in range(0, row_count, memory.max_rows):
            with reading_part(storage, name):
                columns = part.read(first, min(first + memory.max_rows, row_count))
            yield columns
        with reading_part(storage, name):
            part.check()


def _open(storage: Storage, name: str) -> BufferedReader | io.BytesIO:
    """Open a part in a local folder, or load a part from a remote storage into memory."""
    return open_input(storage.local(name)) if storage.is_local else io.BytesIO(storage.read(name))


class _Scans(NamedTuple):
    first: int  # number of the first scan
    row_ends: Ints  # number of rows up to and including each scan, shape (scans,)


class _OpenPart:
    """Part file that is open for reading.

    The constructor and the methods raise LidarError if the part is damaged. The message is a
    clause, which `reading_part` completes to a sentence.
    """

    def __init__(
        self, file: BufferedReader | io.BytesIO, row_count: int, memory: BlockMemory
    ) -> None:
        self._file = file
        self._memory = memory
        try:
            arrays = locate_arrays(file)
            self._arrays = {name: arrays[name] for name in memory.starts if name != SCAN.name}
        except Exception as error:  # zipfile and NumPy raise many types of errors
            raise LidarError(f"it is damaged ({error})") from error
        self._crcs = {name: array.head_crc for name, array in self._arrays.items()}
        columns = memory.columns(0)
        if any(
            array.shape != (row_count,) or array.dtype != columns[name].dtype
            for name, array in self._arrays.items()
        ):
            raise LidarError("it is damaged (its arrays do not have matching shapes)")
        self._scans = None
        if SCAN.name in memory.starts:
            self._scans = self._read_scans(arrays, row_count)

    def _read_scans(self, arrays: Mapping[str, StoredArray], row_count: int) -> _Scans:
        try:
            first, stop = self._read_small(arrays[".scans"]).tolist()
            counts = self._read_small(arrays[".counts"])
        except (LookupError, ValueError) as error:
            raise LidarError(f"it is damaged ({error})") from error
        row_ends = np.cumsum(counts)
        if (counts < 0).any() or len(counts) != stop - first or row_ends[-1] != row_count:
            raise LidarError("it is damaged (its arrays do not have matching shapes)")
        return _Scans(first, row_ends)

    def _read_small(self, array: StoredArray) -> AnyArray:
        """Read an entire array and verify its checksum."""
        values = np.zeros(array.shape, array.dtype)
        data = values.reshape(-1).view(np.uint8).data
        self._fill(data, array.offset)
        if crc32(data, array.head_crc) != array.crc:
            raise LidarError("it is damaged (its checksums do not match)")
        return values

    def read(self, first: int, stop: int) -> dict[str, AnyArray]:
        """Read the rows from `first` to `stop` into `memory`, and return their columns."""
        columns = self._memory.columns(stop - first)
        for name, array in self._arrays.items():
            data = columns[name].view(np.uint8).data
            self._fill(data, array.offset + first * array.dtype.itemsize)
            self._crcs[name] = crc32(data, self._crcs[name])
        if self._scans is not None:
            write_scans(self._scans.row_ends, self._scans.first, first, columns[SCAN.name])
        return columns

    def check(self) -> None:
        for name, array in self._arrays.items():
            if self._crcs[name] != array.crc:
                raise LidarError(f"it is damaged (the checksum of {name}.npy is wrong)")

    def _fill(self, data: memoryview, offset: int) -> None:
        """Fill `data` with bytes of the file, starting at `offset`."""
        self._file.seek(offset)
        # Memory mapping would not be faster, and a disk error would kill the process.
        while data and (count := self._file.readinto(data)):
            data = data[count:]
        if data:
            raise LidarError("it is damaged (truncated)")
