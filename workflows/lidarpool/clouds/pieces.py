"""Multi-file formats: ranges of their files are written by threads or by workers of a cluster."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidarsim.base.arrays import AnyArray
from lidarsim.base.errors import LidarError
from lidarsim.base.plugins import Plugin
from lidarsim.base.storage import Storage
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.sweeps.sweeps import MIXED_UP, Sweeps

from .format_table import row_of

# NumPy, pyarrow and system calls for the disk hold Python's lock at most 6 % of the time.
THREADS = min(4, os.cpu_count() or 1)
# Largest range, which a killed worker loses.
RANGE_POINTS = 1_000_000
RANGE_PIECES = 100
_MARK = ".writing"  # file in the folder while ranges are written


Data = bytes | memoryview
PieceRange = tuple[int, int]  # a range of pieces
# Number of points of a range, and the details of its pieces.
WrittenRange = tuple[int, list[Any]]


@dataclass(frozen=True)
class Entry:
    """A job in a data set.

    Number and name distinguish its files from files of further jobs.

    `values` are the varied values, by name.
    """

    number: int
    name: str
    split: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)

    def path_of(self, format: str) -> str:  # noqa: A002
        """Return the path of the job's file or folder in data sets of a format."""
        return row_of(format).of_job.format(number=self.number, name=self.name)


class Pieces:
    """Output of a multi-file format: files of each piece, often a sweep, and shared files.

    `folders` are the folders of the files of the pieces. With an `entry` the files belong to a job
    in a data set.
    """

    folders: Sequence[str] = ()
    compensated = False  # requested where a format also holds points as they were fired

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        self.cloud = cloud
        self.sweeps = sweeps
        self.entry = entry

    def __len__(self) -> int:
        return len(self.sweeps)

    def read(self, first: int, stop: int) -> Iterator[Cloud]:
        """Yield the points of pieces from `first` to `stop`."""
        return self.sweeps.points(self.cloud, first, stop)

    def files(self, number: int, points: Cloud) -> tuple[Mapping[str, Data], Any]:
        """Return the files of a piece, and its details for `shared_files`."""
        raise NotImplementedError

    def shared_files(self, details: Sequence[Any]) -> Mapping[str, bytes]:
        """Return the files that all pieces share, from the details of the pieces."""
        return {}

    def summary(self, details: Sequence[Any]) -> dict[str, Any]:
        """Return a summary of this job for the data set's own files, as plain data for JSON."""
        return {}

    def write(self, storage: Storage, first: int, stop: int) -> WrittenRange:
        """Write the files of pieces, a piece in memory at a time.

        Raises OSError on failure.
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
        """Divide all pieces into ranges, at least `min_spans` if there are as many pieces."""
        count = len(self)
        by_points = RANGE_POINTS * count // max(1, len(self.cloud))
        size = max(1, min(RANGE_PIECES, by_points, count // min_spans))
        return [(first, min(first + size, count)) for first in range(0, count, size)]

    def finish(self, storage: Storage, written: Iterable[WrittenRange]) -> list[Any]:
        """Write the shared files, and return the details of all pieces.

        LidarError if the cloud is not of these sweeps, or not in order; OSError.
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
    """Writes ranges of the pieces of a cloud, in any process that sees the folder `storage`.

    The class `Pieces` of the `format` defines the content of each file.
    """

    format: str
    cloud: CloudLike
    sweeps: Sweeps
    storage: Storage
    compensated: bool = False
    _mark: bytes = field(default_factory=lambda: secrets.token_hex(8).encode())

    def __call__(self, span: PieceRange) -> WrittenRange | None:
        """Write the files of a range.

        Raises OSError on failure.

        Returns
        -------
        None if this process does not see the folder, lacks the format's package, or after `stop`.
        """
        try:
            pieces = self._pieces()
        except ImportError:
            return None
        if not self.storage.sees(_MARK, self._mark):
            return None
        return pieces.write(self.storage, *span)

    def _pieces(self) -> Pieces:
        pieces = pieces_of(self.format, self.cloud, self.sweeps)
        pieces.compensated = self.compensated
        return pieces

    @property
    def plugins(self) -> tuple[Plugin, ...]:
        """The plug-in of the format, which processes that write ranges need, or an empty tuple."""
        plugin = row_of(self.format).plugin
        return () if plugin is None else (plugin,)

    def stop(self) -> None:
        """Prevent further ranges from being written."""
        self.storage.remove([_MARK])

    def write(self, workers: RangeWorkers | None = None) -> None:
        """Write all files, in threads the ranges that workers have not written.

        Raises OSError on failure.

        Raises
        ------
        LidarError
            If the cloud is not of these sweeps, or not in order; or as `workers`.
        """
        pieces = self._pieces()
        for folder in ("", *pieces.folders):
            self.storage.prepare(folder)
        spans = pieces.spans()
        self.storage.write(_MARK, self._mark)
        written = workers(self, spans) if workers else {}
        remaining = [span for span in spans if span not in written]
        with ThreadPoolExecutor(THREADS, "write") as pool:  # waits for its threads
            results = zip(remaining, pool.map(self, remaining), strict=True)
            written |= {span: result for span, result in results if result}
        self.stop()
        pieces.finish(self.storage, (written.get(span, (0, [])) for span in spans))
        self.storage.tidy()


def pieces_of(
    format: str,  # noqa: A002
    cloud: CloudLike,
    sweeps: Sweeps,
    entry: Entry | None = None,
) -> Pieces:
    """Return the pieces of a cloud in a multi-file format, of a job with an `entry`."""
    row = row_of(format)
    pieces: Pieces = row.provides(row.write)(cloud, sweeps, entry)
    return pieces


def as_data(array: AnyArray) -> Data:
    """Return the bytes of an array without a copy."""
    return array.data.cast("B") if array.size else b""


# Writes ranges on workers; returns the results of ranges whose workers see the folder.
RangeWorkers = Callable[[RangeWriter, Sequence[PieceRange]], dict[PieceRange, WrittenRange]]
