"""Multi-file formats: ranges of their files are written by threads or by workers of a cluster."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim.base.arrays import AnyArray
from lidarsim.base.errors import LidarError
from lidarsim.base.plugins import Plugin
from lidarsim.base.storage import Storage
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.sweeps.sweeps import MIXED_UP, Sweeps

from .cloud_format import CloudFormat
from .format_table import format_named, row_of

if TYPE_CHECKING:
    from .writing import ExportSpec

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


class MultiFileFormat(CloudFormat):
    """A cloud in a format with many files: files of each piece, often a sweep, and shared files.

    `folders` are the folders of the files of the pieces.
    """

    folders: Sequence[str] = ()
    compensated = False  # the option of `ExportSpec`

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

    def write(
        self, path: Path, spec: ExportSpec, workers: RangeWorkers | None = None
    ) -> float | None:
        """Write all files to a new folder, as `write_to`."""
        self.write_to(Storage(str(path), durable=False), spec, workers)
        return None

    def write_to(
        self, storage: Storage, spec: ExportSpec, workers: RangeWorkers | None = None
    ) -> None:
        """Write all files, in threads the ranges that workers have not written.

        Raises OSError on failure.

        Raises
        ------
        LidarError
            If the cloud is not of these sweeps, or not in order; or as `workers`.
        """
        writer = RangeWriter(spec.format, self.cloud, self.sweeps, storage, spec.compensated)
        for folder in ("", *self.folders):
            storage.prepare(folder)
        spans = self.spans()
        writer.start()
        written = workers(writer, spans) if workers else {}
        remaining = [span for span in spans if span not in written]
        with ThreadPoolExecutor(THREADS, "write") as pool:  # waits for its threads
            results = zip(remaining, pool.map(writer, remaining), strict=True)
            written |= {span: result for span, result in results if result}
        writer.stop()
        self.finish(storage, (written.get(span, (0, [])) for span in spans))
        storage.tidy()

    def write_range(self, storage: Storage, first: int, stop: int) -> WrittenRange:
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
    """Writes ranges of a cloud in a multi-file format, in any process that sees `storage`."""

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
            output = format_named(self.format)(self.cloud, self.sweeps)
        except ImportError:
            return None
        if not self.storage.sees(_MARK, self._mark):
            return None
        assert isinstance(output, MultiFileFormat)
        output.compensated = self.compensated
        return output.write_range(self.storage, *span)

    @property
    def plugins(self) -> tuple[Plugin, ...]:
        """The plug-in of the format, which processes that write ranges need, or an empty tuple."""
        plugin = row_of(self.format).plugin
        return () if plugin is None else (plugin,)

    def start(self) -> None:
        """Allow ranges to be written."""
        self.storage.write(_MARK, self._mark)

    def stop(self) -> None:
        """Prevent further ranges from being written."""
        self.storage.remove([_MARK])


def as_data(array: AnyArray) -> Data:
    """Return the bytes of an array without a copy."""
    return array.data.cast("B") if array.size else b""


# Writes ranges on workers; returns the results of ranges whose workers see the folder.
RangeWorkers = Callable[[RangeWriter, Sequence[PieceRange]], dict[PieceRange, WrittenRange]]
