"""The cloud of a survey as a file that grows by committed parts, while further scans are cast."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import NamedTuple

import numpy as np

from lidarsim.base.arrays import AnyArray, Ints
from lidarsim.base.errors import LidarError
from lidarsim.columns.table import AXES
from lidarsim.scene.scene import Scene
from lidarsim.sweeps.sweeps import Sweeps

from ..base.processors import processors
from ..clouds.ply import GrowingPly, real_type
from ..clouds.ply_rows import RowMaker
from ..columns.part_blocks import BlockMemory, read_blocks
from ..columns.parts import StoredCloud
from ..run.pipeline.stage_messages import Receipt
from ..run.store.stored_job import StoredJob
from .cloud_counts import CloudCounts

_MAX_THREADS = 4  # that write parts; each has a block of rows in memory
# Bytes written between two flushes. No result relies on these flushes, since the complete file is
# flushed before it is moved into place: they keep that flush short, and no flush delays the flushes
# of parts.
_FLUSH_BYTES = 1 << 25
# Rows of a block. Blocks of a quarter of this size stay in the second cache of a core, and took as
# long: there are four times as many system calls.
_BLOCK_ROWS = 1 << 16
_LOOK_EVERY_S = 0.05


class _Part(NamedTuple):
    """A committed part of a job."""

    first: int  # number of its first scan
    stop: int  # number of the scan after its last scan
    name: str  # name in the storage of the parts
    point_count: int
    cell_box: tuple[int, ...]  # lowest and highest cell as six numbers; empty without points


class _RowsOfPart(NamedTuple):
    """A part that is written to a file."""

    name: str
    row_count: int
    cell_box: Ints  # lowest and highest cells of its points or of more points, (2, 3)
    offset: int = 0  # of its first row in the file, bytes; 0 for the first part
    is_flushed: bool = False  # True if the file is flushed after the part


class _PartWriter:
    """Writes parts to a file, one at a time, in memory that is used again, and counts their points.

    Each thread has its own.

    Parameters
    ----------
    file
        The file.
    points
        Points of the survey.
    counts
        Counts of the points.
    """

    def __init__(self, file: GrowingPly, points: StoredCloud, counts: CloudCounts) -> None:
        self.counts = counts
        self._file = file
        self._points = points
        self._memory = BlockMemory((*AXES, *points.table), _BLOCK_ROWS)
        self._row_maker: RowMaker | None = None  # once the file has its layout

    def write(self, part: _RowsOfPart) -> None:
        """Write the points of a part block by block; the first part of a file gives it its layout.

        LidarError if the part cannot be used, OSError if the disk is full.
        """
        self.counts.widen(part.cell_box)
        offset = part.offset
        for columns in read_blocks(self._points.storage, part.name, part.row_count, self._memory):
            self.counts.add(columns)
            self.counts.add_positions([columns[axis.name] for axis in AXES])
            if not self._file.has_layout:
                self._write_first(columns)
                continue
            rows = self._rows_of(columns)
            if not part.offset:  # the number of first points is known by now
                offset = self._file.extend(len(columns[AXES[0].name]))
            self._file.write_rows(rows, offset)
            offset += len(rows)
        if part.is_flushed:
            self._file.flush()

    def _write_first(self, columns: Mapping[str, AnyArray]) -> None:
        """Write the first points of a file."""
        positions = self._points.positions_of(columns)
        values = ((column.name, columns[column.name]) for column in self._points.table)
        self._file.append(len(columns[AXES[0].name]), chain(positions, values))

    def _rows_of(self, columns: Mapping[str, AnyArray]) -> memoryview:
        """Return the rows of a block."""
        if self._row_maker is None:
            self._row_maker = RowMaker(
                self._file.row,
                self._points.table,
                self._memory,
                self._points.precision_m,
                self._points.origin,
            )
        return self._row_maker.make(columns)


class CloudWriter:
    """Writes the points of parts to a PLY file, and counts the points in the same pass.

    Parts are appended in scan order, so that the offset of a part is known. Several threads write
    them, a part each. An error of a thread is raised by the next call.

    Parameters
    ----------
    path
        The file, which must not exist.
    points
        Points of the survey; further parts may be appended.
    sweeps, scene
        Sweeps and scene of the survey.
    position_type
        Type of positions in the file (`real_type`).
    expected_count
        Expected number of points (`GrowingPly`).
    """

    def __init__(
        self,
        path: Path,
        points: StoredCloud,
        sweeps: Sweeps,
        scene: Scene,
        position_type: np.dtype[np.floating],
        expected_count: int,
    ) -> None:
        self.file = GrowingPly(path, points.table, position_type, sweeps, expected_count)
        self._flushed_bytes = 0  # size of the file at the last flush
        self.threads = min(processors(), _MAX_THREADS)
        self._idle = SimpleQueue[_PartWriter]()
        for _ in range(self.threads):
            counts = CloudCounts(
                points.table,
                len(scene.object_names),
                len(scene.material_names),
                points.precision_m,
                points.origin,
            )
            self._idle.put(_PartWriter(self.file, points, counts))
        self._executor = ThreadPoolExecutor(self.threads, "write cloud")
        self._errors: list[BaseException] = []

    def __enter__(self) -> CloudWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def append(self, name: str, row_count: int, cell_box: Ints) -> None:
        """Append the points of a part; wait while as many parts as there are threads are written.

        Parameters
        ----------
        name
            The part.
        row_count
            Number of its points, at least 1.
        cell_box
            Lowest and highest cells of its points or of more points, (2, 3).

        Raises
        ------
        LidarError
            If a part cannot be used.
        OSError
            If the disk is full, or the file cannot be written for another reason.
        """
        part_writer = self._idle.get()  # bounds the parts in memory
        part = _RowsOfPart(name, row_count, cell_box)
        if self.file.has_layout and not self._errors:
            part = part._replace(
                offset=self.file.extend(row_count), is_flushed=self._is_flush_due()
            )
            self._executor.submit(self._write, part_writer, part)
        else:
            self._write(part_writer, part)
        self._raise_error()

    def _is_flush_due(self) -> bool:
        """Return True once for each `_FLUSH_BYTES` of the file."""
        is_due = self.file.size - self._flushed_bytes > _FLUSH_BYTES
        if is_due:
            self._flushed_bytes = self.file.size
        return is_due

    def _write(self, part_writer: _PartWriter, part: _RowsOfPart) -> None:
        """Write a part, unless there was an error, and note an error."""
        try:
            if not self._errors:
                part_writer.write(part)
        except BaseException as error:  # raised by the thread that appends parts
            self._errors.append(error)
        finally:
            self._idle.put(part_writer)

    def _raise_error(self) -> None:
        """Raise the first error of a thread."""
        if self._errors:
            raise self._errors[0]

    def wait(self) -> list[_PartWriter]:
        """Wait until no thread writes, and return the writers of all threads.

        Raises the errors of `append`.
        """
        part_writers = [self._idle.get() for _ in range(self.threads)]
        for part_writer in part_writers:
            self._idle.put(part_writer)
        self._raise_error()
        return part_writers

    def finish(self) -> CloudCounts:
        """Complete the file, and return the counts of its points.

        Raises the errors of `append`.
        """
        first, *others = self.wait()
        self.file.finish()
        for part_writer in others:
            first.counts.merge(part_writer.counts)
        if first.counts.point_count != self.file.count:
            raise LidarError(
                f"only {first.counts.point_count:,} of {self.file.count:,} points belong to an "
                "object of the scene or to no object, so the parts belong to a different scene."
            )
        return first.counts

    def close(self) -> None:
        """Wait until no thread writes, and close the file."""
        self._executor.shutdown(cancel_futures=True)
        self.file.close()


def write_cloud(path: Path, points: StoredCloud, sweeps: Sweeps, scene: Scene) -> CloudCounts:
    """Write all points to a PLY file, which must not exist, and return their counts.

    Raises
    ------
    LidarError
        If the disk lacks room, or a part cannot be used.
    OSError
        If the file cannot be written.
    """
    position_type = real_type(points.bounds, points.precision_m)
    count = len(points)
    with CloudWriter(path, points, sweeps, scene, position_type, count) as writer:
        writer.file.check_room(count)
        for name, rows in zip(points.names, points.rows, strict=True):
            if rows:
                assert points.cells is not None, "of points"
                writer.append(name, rows, points.cells)
                points.report(rows)
        return writer.finish()


class GrowingCloud:
    """Appends the committed parts of a job, in scan order, to a PLY file in a thread.

    The file is temporary until `finish`. If the file cannot be written, such as on a full disk, it
    is removed and the run goes on; in the end, `write_cloud` writes the cloud, or says the error.

    Parameters
    ----------
    path
        The file, which must not exist.
    job
        The job. Parts of an earlier run are appended first.
    """

    def __init__(self, path: Path, job: StoredJob) -> None:
        self._path = path
        self._job = job
        self._sweeps = Sweeps.from_survey(job.job.survey, job.job.scene)
        # With the cells of appended parts; only their bounds are used.
        self._points = replace(job.points(), cells=None)
        self._next_scan = job.scans.start  # first scan of the next part
        self._waiting: dict[int, _Part] = {}  # {first scan: part}, for earlier parts
        self._appended: list[_Part] = []
        self._appended_rows = 0
        self._writer: CloudWriter | None = None
        self._is_complete = False  # True once all parts that were added are appended
        self._is_stopped = False
        self._committed_scans = 0
        self._committed_bytes = 0
        self._queue = SimpleQueue[list[_Part] | None]()  # None ends the thread
        self._thread = Thread(target=self._run, name="grow cloud", daemon=True)

    def __enter__(self) -> GrowingCloud:
        self.add(self._job.parts.ordered)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the thread, and remove the file unless it is finished."""
        self._is_stopped = True
        self._queue.put(None)
        if self._thread.ident is not None:
            self._thread.join()
        self._discard()

    def add(self, receipts: Sequence[Receipt]) -> None:
        """Append committed parts once all earlier scans are appended, and return at once."""
        if not receipts:
            return
        self._committed_scans += sum(part.stop - part.first for part in receipts)
        self._committed_bytes += sum(part.size for part in receipts)
        self._queue.put(
            [_Part(p.first, p.stop, p.name, p.point_count, p.cell_box) for p in receipts]
        )
        if self._thread.ident is None:
            self._thread.start()

    def finish(self, path: Path, points: StoredCloud) -> CloudCounts | None:
        """Move the file to a path once it has all `points`, and return their counts.

        None if the file failed, or was never begun.

        Raises
        ------
        OSError
            If the file cannot be completed.
        """
        self._queue.put(None)
        told_count = 0
        while self._thread.is_alive():
            self._thread.join(_LOOK_EVERY_S)
            points.report(self._appended_rows - told_count)
            told_count = self._appended_rows
        writer = self._writer
        # On a network disk without locks, another run may have removed the file.
        is_usable = self._is_complete and self._path.exists()
        if writer is None or not is_usable or writer.file.count != len(points):
            self._discard()
            return None
        with writer:
            counts = writer.finish()
        self._path.replace(path)
        self._writer = None
        return counts

    def _run(self) -> None:
        """Append parts until the end of the queue, or until the file fails."""
        try:
            # Errors are met again, and shown, when `write_cloud` writes all points.
            with suppress(LidarError, OSError):
                while (parts := self._queue.get()) is not None:
                    self._waiting |= {part.first: part for part in parts}
                    self._append_waiting()
                if self._writer is not None:
                    self._writer.wait()  # errors of its threads are errors of the file, too
                self._is_complete = True
        finally:
            if not self._is_complete:
                self._discard()

    def _append_waiting(self) -> None:
        """Append the parts that are next in scan order."""
        while not self._is_stopped and (part := self._waiting.pop(self._next_scan, None)):
            self._next_scan = part.stop
            if part.point_count:
                self._append(part)

    def _append(self, part: _Part) -> None:
        """Append a part with points.

        If the positions need another type, the file is begun anew.
        """
        self._check_room(part)
        cells = np.array(part.cell_box, np.int64).reshape(2, 3)
        if self._points.cells is not None:
            earlier = self._points.cells
            cells = np.stack([np.minimum(cells[0], earlier[0]), np.maximum(cells[1], earlier[1])])
        self._points = replace(self._points, cells=cells)
        position_type = real_type(self._points.bounds, self._points.precision_m)
        self._appended.append(part)
        parts = [part]
        if self._writer is None or self._writer.file.position_type != position_type:
            self._discard()
            self._appended_rows = 0
            parts = self._appended
            self._writer = self._new_writer(position_type)
        for appended in parts:
            self._writer.append(appended.name, appended.point_count, cells)
            self._appended_rows += appended.point_count

    def _new_writer(self, position_type: np.dtype[np.floating]) -> CloudWriter:
        """Return the writer of a new file.

        Its number of points is estimated from the parts.
        """
        rows = sum(part.point_count for part in self._appended)
        scans = self._next_scan - self._job.scans.start
        expected_count = rows * len(self._job.scans) // scans
        return CloudWriter(
            self._path,
            self._points,
            self._sweeps,
            self._job.job.scene,
            position_type,
            expected_count,
        )

    def _check_room(self, part: _Part) -> None:
        """Raise OSError unless the disk has room for a part here and for the parts to come.

        Else the disk would be full before all scans are stored.
        """
        rows_bytes = 0
        if self._writer is not None:  # as many parts as there are threads may not be written yet
            rows_bytes = part.point_count * self._writer.file.row.itemsize * self._writer.threads
        scans_left = len(self._job.scans) - self._committed_scans
        bytes_left = self._committed_bytes * scans_left // self._committed_scans
        free_bytes = shutil.disk_usage(self._path.parent).free
        if free_bytes < rows_bytes + bytes_left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))

    def _discard(self) -> None:
        """Remove the file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
