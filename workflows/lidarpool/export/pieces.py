"""Formats of many files: ranges of their files are written by threads here, or by workers."""

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
# of a range at most: what a killed worker costs
RANGE_POINTS = 1_000_000
RANGE_PIECES = 100
_MARK = ".writing"  # a file in the folder while ranges are written


Data = bytes | memoryview
PieceRange = tuple[int, int]  # a range of pieces
# Points of a range, and what `Pieces.others` needs of its pieces.
WrittenRange = tuple[int, list[Any]]


@dataclass(frozen=True)
class Entry:
    """A job in a data set of many: its number and name make its files differ from others'.

    `values` are those that were varied, by name.
    """

    number: int
    name: str
    split: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)

    def place(self, format: str) -> str:  # noqa: A002
        """Name of its file or folder in data sets whose jobs are written in a format."""
        return row_of(format).of_job.format(number=self.number, name=self.name)


class Pieces:
    """The files of a cloud in a format of many: those of each piece, a sweep or other, and more.

    `folders` are those of the files of the pieces. With an `entry` they are a job's in a data set.
    """

    folders: Sequence[str] = ()
    compensated = False  # by request, where a format also holds points as they were fired

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        self.cloud = cloud
        self.sweeps = sweeps
        self.entry = entry

    def __len__(self) -> int:
        return len(self.sweeps)

    def read(self, first: int, stop: int) -> Iterator[Cloud]:
        """Yield the points of some pieces."""
        return self.sweeps.points(self.cloud, first, stop)

    def files(self, number: int, points: Cloud) -> tuple[Mapping[str, Data], Any]:
        """Return the files of a piece, and what `others` needs of it."""
        raise NotImplementedError

    def others(self, made: Sequence[Any]) -> Mapping[str, bytes]:
        """Return the files that are not of one piece."""
        return {}

    def summary(self, made: Sequence[Any]) -> dict[str, Any]:
        """Return what the data set's own files need of this job, as JSON holds it."""
        return {}

    def write(self, place: Storage, first: int, stop: int) -> WrittenRange:
        """Write the files of some pieces, one piece in memory at a time; OSError if that fails."""
        count = 0
        made = []
        for number, points in enumerate(self.read(first, stop), first):
            files, more = self.files(number, points)
            for name, data in files.items():
                place.write(name, data)
            count += len(points)
            made.append(more)
        return count, made

    def spans(self, parts: int = 1) -> list[PieceRange]:
        """Divide all pieces into ranges, at least so many if there are as many pieces."""
        count = len(self)
        by_points = RANGE_POINTS * count // max(1, len(self.cloud))
        size = max(1, min(RANGE_PIECES, by_points, count // parts))
        return [(first, min(first + size, count)) for first in range(0, count, size)]

    def finish(self, place: Storage, written: Iterable[WrittenRange]) -> list[Any]:
        """Write the files that are not of one piece; returns what was made of the pieces.

        LidarError if the cloud is not of these sweeps, or not in order; OSError.
        """
        counts, ranges = zip(*written, strict=True) if self else ((), ())
        if sum(counts) != len(self.cloud):
            raise LidarError(MIXED_UP)
        made = [more for one in ranges for more in one]
        for name, data in self.others(made).items():
            place.prepare(Path(name).parent)
            place.write(name, data)
        return made


@dataclass(frozen=True)
class RangeWriter:
    """Writes ranges of the pieces of a cloud, in any process that sees the folder `place`.

    The class `Pieces` of the `format` says what is in which file.
    """

    format: str
    cloud: CloudLike
    sweeps: Sweeps
    place: Storage
    compensated: bool = False
    _mark: bytes = field(default_factory=lambda: secrets.token_hex(8).encode())

    def __call__(self, span: PieceRange) -> WrittenRange | None:
        """Write the files of a range; OSError if that fails.

        Returns
        -------
        None if this process does not see the folder, lacks the format's package, or after `stop`.
        """
        try:
            pieces = self._pieces()
        except ImportError:
            return None
        if not self.place.sees(_MARK, self._mark):
            return None
        return pieces.write(self.place, *span)

    def _pieces(self) -> Pieces:
        pieces = pieces_of(self.format, self.cloud, self.sweeps)
        pieces.compensated = self.compensated
        return pieces

    @property
    def plugins(self) -> tuple[Plugin, ...]:
        """The plug-in of the format, which processes that write ranges need, or none."""
        plugin = row_of(self.format).plugin
        return () if plugin is None else (plugin,)

    def stop(self) -> None:
        """Let no further range be written."""
        self.place.remove([_MARK])

    def write(self, workers: RangeWorkers | None = None) -> None:
        """Write all files, in threads those that workers do not; OSError if that fails.

        Raises
        ------
        LidarError
            If the cloud is not of these sweeps, or not in order; or as `workers`.
        """
        pieces = self._pieces()
        for folder in ("", *pieces.folders):
            self.place.prepare(folder)
        spans = pieces.spans()
        self.place.write(_MARK, self._mark)
        made = workers(self, spans) if workers else {}
        left = [span for span in spans if span not in made]
        with ThreadPoolExecutor(THREADS, "write") as pool:  # ends when all its threads have
            made |= {span: it for span, it in zip(left, pool.map(self, left), strict=True) if it}
        self.stop()
        pieces.finish(self.place, (made.get(span, (0, [])) for span in spans))
        self.place.tidy()


def pieces_of(
    format: str,  # noqa: A002
    cloud: CloudLike,
    sweeps: Sweeps,
    entry: Entry | None = None,
) -> Pieces:
    """Return the pieces of a cloud in a format of many files, as a job's with an `entry`."""
    row = row_of(format)
    pieces: Pieces = row.provides(row.write)(cloud, sweeps, entry)
    return pieces


def as_data(array: AnyArray) -> Data:
    """Return the bytes of an array, without a copy of them."""
    return array.data.cast("B") if array.size else b""


# Writes ranges on workers; returns what was written of those whose workers see the folder.
RangeWorkers = Callable[[RangeWriter, Sequence[PieceRange]], dict[PieceRange, WrittenRange]]
