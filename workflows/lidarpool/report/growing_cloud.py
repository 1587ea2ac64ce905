"""The cloud of a survey as a file that grows by committed parts, while further scans are cast."""

from __future__ import annotations

import errno
import os
import shutil
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import numpy as np

from lidarsim.columns.table import AXES
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Ints
from lidarsim.scene.scene import Scene
from lidarsim.sweeps.sweeps import Sweeps

from ..clouds.ply import PlyAppender, position_dtype
from ..clouds.ply_rows import PlyRowEncoder
from ..columns.part_blocks import BlockMemory, read_blocks
from ..columns.parts import StoredCloud
from ..processes.processors import processor_count
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


class _PartWriter:
    """Writes parts to a file, one at a time, and counts their points. Each thread has its own."""

    def __init__(self, file: PlyAppender, points: StoredCloud, scene: Scene) -> None:
        self.counts = CloudCounts(
            points.table,
            len(scene.object_names),
            len(scene.material_names),
            points.precision_m,
            points.origin,
        )
        self._file = file
        self._points = points
        self._memory = BlockMemory((*AXES, *points.table), _BLOCK_ROWS)  # used again for each part
        self._row_encoder: PlyRowEncoder | None = None  # once the file has its layout

    def write(self, name: str, row_count: int, cell_box: Ints, offset: int = 0) -> None:
        """Write the points of a part block by block.

        `offset` of the first row in the file is 0 for the first part, which gives the file its
        layout. LidarError if the part cannot be used, OSError if the disk is full.
        """
        is_first = not offset
        self.counts.widen(cell_box)
        for columns in read_blocks(self._points.storage, name, row_count, self._memory):
            self.counts.add(columns)
            self.counts.add_positions([columns[axis.name] for axis in AXES])
            rows_in_block = len(columns[AXES[0].name])
            if not self._file.has_layout:
                positions = self._points.positions_of(columns)
                values = ((column.name, columns[column.name]) for column in self._points.table)
                self._file.append(rows_in_block, chain(positions, values))
                continue
            if self._row_encoder is None:
                self._row_encoder = PlyRowEncoder(
                    self._file.row,
                    self._points.table,
                    self._memory,
                    self._points.precision_m,
                    self._points.origin,
                )
            rows = self._row_encoder.encode(columns)
            if is_first:  # the number of first points is known by now
                offset = self._file.extend(rows_in_block)
            self._file.write_rows(rows, offset)
            offset += len(rows)


class CloudWriter:
    """Writes the points of parts to a PLY file, and counts the points in the same pass.

    Parts are appended in scan order, so that the offset of a part is known. Several threads write
    them, a part each. An error of a thread is raised by a later call.

    Parameters
    ----------
    path
        The file, which must not exist.
    points
        Points of the survey; further parts may be appended.
    sweeps, scene
        Sweeps and scene of the survey.
    position_type
        Type of positions in the file (`position_dtype`).
    expected_count
        Expected number of points (`PlyAppender`).
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
        self.file = PlyAppender(path, points.table, position_type, sweeps, expected_count)
        self._flushed_bytes = 0  # size of the file at the last flush
        self.threads = min(processor_count(), _MAX_THREADS)
        self._part_writers = [_PartWriter(self.file, points, scene) for _ in range(self.threads)]
        self._idle = SimpleQueue[_PartWriter]()
        for part_writer in self._part_writers:
            self._idle.put(part_writer)
        self._executor = ThreadPoolExecutor(self.threads, "write cloud")
        self._being_written = deque[Future[None]]()  # one for each part, at most one per thread

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
        if not self.file.has_layout:
            self._write(name, row_count, cell_box)
            return
        if len(self._being_written) == self.threads:  # bounds the parts in memory
            self._being_written.popleft().result()
        offset = self.file.extend(row_count)
        is_flushed = self.file.size - self._flushed_bytes > _FLUSH_BYTES
        if is_flushed:
            self._flushed_bytes = self.file.size
        self._being_written.append(
            self._executor.submit(self._write, name, row_count, cell_box, offset, is_flushed)
        )

    def _write(
        self, name: str, row_count: int, cell_box: Ints, offset: int = 0, is_flushed: bool = False
    ) -> None:
        part_writer = self._idle.get()
        try:
            part_writer.write(name, row_count, cell_box, offset)
            if is_flushed:
                self.file.flush()
        finally:
            self._idle.put(part_writer)

    def wait(self) -> None:
        """Wait until no thread writes, or raise the errors of `append`."""
        while self._being_written:
            self._being_written.popleft().result()

    def finish(self) -> CloudCounts:
        """Complete the file and return the counts of its points, or raise errors of `append`."""
        self.wait()
        self.file.finish()
        counts, *others = (part_writer.counts for part_writer in self._part_writers)
        for other in others:
            counts.merge(other)
        if counts.point_count != self.file.count:
            raise LidarError(
                f"only {counts.point_count:,} of {self.file.count:,} points belong to an "
                "object of the scene or to no object, so the parts belong to a different scene."
            )
        return counts

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
    position_type = position_dtype(points.bounds, points.precision_m)
    count = len(points)
    with CloudWriter(path, points, sweeps, scene, position_type, count) as writer:
        writer.file.check_disk_space(count)
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
        self._next_scan = job.scans.start  # first scan of the next part to be appended
        self._appended: list[Receipt] = []
        self._appended_rows = 0
        self._appended_bytes = 0  # of their files
        self._writer: CloudWriter | None = None
        self._is_complete = False  # True once all parts that were added are appended
        self._is_stopped = False
        self._queue = SimpleQueue[Receipt | None]()  # parts in scan order; None ends the thread
        self._thread = Thread(target=self._run, name="grow cloud", daemon=True)

    def __enter__(self) -> GrowingCloud:
        self._thread.start()
        self.add()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the thread, and remove the file unless it is finished."""
        self._is_stopped = True
        self._queue.put(None)
        self._thread.join()
        self._discard()

    def add(self, _: Sequence[Receipt] = ()) -> None:
        """Append the committed parts that are next in scan order, and return at once."""
        parts = self._job.parts
        with suppress(KeyError):  # the next scan is not committed yet
            while True:
                part = parts.part_of(self._next_scan)
                self._next_scan = part.stop
                if part.point_count:
                    self._queue.put(part)

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
                while (part := self._queue.get()) is not None and not self._is_stopped:
                    self._append(part)
                if self._writer is not None:
                    self._writer.wait()  # errors of its threads are errors of the file, too
                self._is_complete = True
        finally:
            if not self._is_complete:
                self._discard()

    def _append(self, part: Receipt) -> None:
        """Append a part with points, or begin anew if the positions need another type."""
        self._appended.append(part)
        self._check_room(part)
        cells = np.array(part.cell_box, np.int64).reshape(2, 3)
        if self._points.cells is not None:
            earlier = self._points.cells
            cells = np.stack([np.minimum(cells[0], earlier[0]), np.maximum(cells[1], earlier[1])])
        self._points = replace(self._points, cells=cells)
        position_type = position_dtype(self._points.bounds, self._points.precision_m)
        parts = [part]
        if self._writer is None or self._writer.file.position_type != position_type:
            self._discard()
            self._appended_rows = 0
            parts = self._appended
            rows = sum(part.point_count for part in parts)
            expected_count = rows * len(self._job.scans) // (part.stop - self._job.scans.start)
            self._writer = CloudWriter(
                self._path,
                self._points,
                self._sweeps,
                self._job.job.scene,
                position_type,
                expected_count,
            )
        for appended in parts:
            self._writer.append(appended.name, appended.point_count, cells)
            self._appended_rows += appended.point_count

    def _check_room(self, part: Receipt) -> None:
        """Raise OSError unless the disk has room for a part here and for the parts to come.

        Else the disk would be full before all scans are stored.
        """
        rows_bytes = 0
        if self._writer is not None:  # as many parts as there are threads may not be written yet
            rows_bytes = part.point_count * self._writer.file.row.itemsize * self._writer.threads
        self._appended_bytes += part.size
        appended_scans = part.stop - self._job.scans.start
        bytes_left = self._appended_bytes * self._job.committed.missing_count // appended_scans
        free_bytes = shutil.disk_usage(self._path.parent).free
        if free_bytes < rows_bytes + bytes_left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))

    def _discard(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
