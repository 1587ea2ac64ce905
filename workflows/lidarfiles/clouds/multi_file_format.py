"""Base class for formats with many files.

Threads or workers can write the files in parallel.
"""

from __future__ import annotations

import io
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.environment.plugins import Plugin
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.numerics.arrays import AnyArray
from lidarsim.sweeps.sweeps import MIXED_UP, Sweeps

from .cloud_format import CloudFormat
from .format_options import FormatOptions
from .format_table import format_row, load_format

# NumPy, pyarrow and disk I/O hold the GIL for at most 6 % of the time.
THREADS = min(4, os.cpu_count() or 1)
# Maximum size of a range. If a worker is killed, its whole range must be written again.
RANGE_POINTS = 1_000_000
RANGE_PIECES = 100
_MARK = ".writing"  # file that exists only while ranges are being written


FileContent = bytes | memoryview
PieceRange = tuple[int, int]  # first piece, and the end of the range (exclusive)
# Number of points in a range, and the details of its pieces.
WrittenRange = tuple[int, list[Any]]


class MultiFileFormat(CloudFormat):
    """A cloud in a format with many files.

    The cloud is divided into pieces, which are usually sweeps. Each piece has its own files, and
    further files are shared by all pieces.
    """

    folders: Sequence[str] = ()  # folders that contain the files of the pieces
    compensated = False  # option of `FormatOptions`

    def __len__(self) -> int:
        return len(self.sweeps)

    def read(self, first: int, stop: int) -> Iterator[Cloud]:
        """Yield the points of the pieces from `first` to `stop` (exclusive)."""
        return self.sweeps.points(self.cloud, first, stop)

    def files(self, number: int, points: Cloud) -> tuple[Mapping[str, FileContent], Any]:
        """Return the files of a piece, keyed by name, and details for `shared_files`.

        The type of the details depends on the format.
        """
        raise NotImplementedError

    def shared_files(self, details: Sequence[Any]) -> Mapping[str, bytes]:
        """Return the files that all pieces share, keyed by name.

        `details` contains the details that `files` returned for each piece.
        """
        return {}

    def summary(self, details: Sequence[Any]) -> dict[str, Any]:
        """Return a JSON-serializable summary of this job for the data set manifest."""
        return {}

    def write(
        self, path: Path, spec: FormatOptions, workers: RangeWorkers | None = None
    ) -> float | None:
        """Write all files to a new folder.

        The method `write_to` describes how they are written.
        """
        self.write_to(Storage(str(path), durable=False), spec, workers)
        return None

    def write_to(
        self, storage: Storage, spec: FormatOptions, workers: RangeWorkers | None = None
    ) -> None:
        """Write all files.

        Ranges that workers do not write are written by threads.

        Raises
        ------
        LidarError
            If the points are not in order or do not belong to the sweeps, or if raised by
            `workers`.
        OSError
            If a file cannot be written.
        """
        writer = RangeWriter(spec.format, self.cloud, self.sweeps, storage, spec.compensated)
        for folder in ("", *self.folders):
            storage.prepare(folder)
        spans = self.spans()
        writer.start()
        written = workers(writer, spans) if workers else {}
        remaining = [span for span in spans if span not in written]
        with ThreadPoolExecutor(THREADS, "write") as pool:  # exiting waits for the threads
            results = zip(remaining, pool.map(writer, remaining), strict=True)
            written |= {span: result for span, result in results if result}
        writer.stop()
        self.finish(storage, (written.get(span, (0, [])) for span in spans))
        storage.remove_unfinished()

    def write_range(self, storage: Storage, first: int, stop: int) -> WrittenRange:
        """Write the files of a range of pieces, holding one piece in memory at a time.

        Raises OSError if a file cannot be written.
        """
        count = 0
        details = []
        for number, points in enumerate(self.read(first, stop), first):
            files, detail = self.files(number, points)
            for name, data in files.items():
                storage.write(name, data)
            count += len(points)
            details.append(detail)
        return count, details

    def spans(self, min_spans: int = 1) -> list[PieceRange]:
        """Divide the pieces into at least `min_spans` ranges if there are enough pieces."""
        count = len(self)
        by_points = RANGE_POINTS * count // max(1, len(self.cloud))
        size = max(1, min(RANGE_PIECES, by_points, count // min_spans))
        return [(first, min(first + size, count)) for first in range(0, count, size)]

    def finish(self, storage: Storage, written: Iterable[WrittenRange]) -> list[Any]:
        """Write the shared files and return the details of all pieces.

        Raises LidarError if the points are not in order or do not belong to the sweeps, and OSError
        if a file cannot be written.
        """
        counts, ranges = zip(*written, strict=True) if self else ((), ())
        if sum(counts) != len(self.cloud):
            raise LidarError(MIXED_UP)
        details = [detail for details_of_range in ranges for detail in details_of_range]
        for name, data in self.shared_files(details).items():
            storage.prepare(Path(name).parent)
            storage.write(name, data)
        return details


@dataclass(frozen=True)
class RangeWriter:
    """Callable that writes the files of one range of a cloud.

    Any process with access to `storage` can call it.
    """

    format: str
    cloud: CloudLike
    sweeps: Sweeps
    storage: Storage
    compensated: bool = False
    _mark: bytes = field(default_factory=lambda: secrets.token_hex(8).encode())

    def __call__(self, span: PieceRange) -> WrittenRange | None:
        """Write the files of a range.

        Returns None without writing if this process cannot access the folder, if a package that the
        format requires is missing, or after `stop`. Raises OSError if a file cannot be written.
        """
        try:
            output = load_format(self.format)(self.cloud, self.sweeps)
        except ImportError:
            return None
        if not self.storage.has_content(_MARK, self._mark):
            return None
        assert isinstance(output, MultiFileFormat)
        output.compensated = self.compensated
        return output.write_range(self.storage, *span)

    @property
    def plugins(self) -> tuple[Plugin, ...]:
        """Plug-in that provides the format.

        Workers require it. The tuple is empty if no plug-in provides the format.
        """
        plugin = format_row(self.format).plugin
        return () if plugin is None else (plugin,)

    def start(self) -> None:
        """Write the mark file, which allows ranges to be written."""
        self.storage.write(_MARK, self._mark)

    def stop(self) -> None:
        """Prevent further ranges from being written."""
        self.storage.remove([_MARK])


def as_bytes(array: AnyArray) -> FileContent:
    """Return the bytes of an array without copying them."""
    return array.data.cast("B") if array.size else b""


def as_npy(array: AnyArray) -> bytes:
    """Return the content of an NPY file with an array."""
    file = io.BytesIO()
    np.lib.format.write_array(file, np.ascontiguousarray(array), (1, 0), allow_pickle=False)
    return file.getvalue()


# Function that writes ranges on workers, and returns the results for those that were written.
RangeWorkers = Callable[[RangeWriter, Sequence[PieceRange]], dict[PieceRange, WrittenRange]]
