"""Write the point cloud of a survey to a file while the survey is running.

Parts are appended as soon as they are committed, so most of the cloud has been written when the
last scan is finished.
"""

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

from lidarfiles.clouds.ply import PlyAppender, position_dtype
from lidarfiles.clouds.ply_rows import PlyRowEncoder
from lidarfiles.parts.part_blocks import BlockMemory, read_blocks
from lidarfiles.parts.parts import StoredCloud
from lidarfiles.processes.processors import processor_count
from lidarsim.columns.table import AXES
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Ints
from lidarsim.scene.scene import Scene
from lidarsim.sweeps.sweeps import Sweeps

from ..run.pipeline.stage_messages import Receipt
from ..run.store.stored_job import StoredJob
from .cloud_counts import CloudCounts

_MAX_THREADS = 4  # maximum number of writer threads; each holds a block of rows in memory
# Number of bytes written between two flushes. These flushes are an optimization, since the complete
# file is flushed before it is moved into place. They keep the final flush short, so that no single
# flush delays the flushes of parts.
_FLUSH_BYTES = 1 << 25
# Rows per block. Blocks of a quarter of this size fit in the L2 cache, but were not faster, because
# they require four times as many system calls.
_BLOCK_ROWS = 1 << 16
_POLL_INTERVAL_S = 0.05


class _PartWriter:
    """Writer that adds parts to a file one at a time, and computes statistics of their points.

    Each thread has a separate instance.
    """

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
        self._memory = BlockMemory((*AXES, *points.table), _BLOCK_ROWS)  # reused for each part
        self._row_encoder: PlyRowEncoder | None = None  # created when the file has its layout

    def write(self, name: str, row_count: int, cell_box: Ints, offset: int = 0) -> None:
        """Write the points of a part block by block.

        `offset` is the byte offset of the first row. It is 0 for the first part, which determines
        the layout of the file. Raise LidarError if the part is unusable, or OSError if the disk is
        full.
        """
        is_first = not offset
        self.counts.widen(cell_box)
        for columns in read_blocks(self._points.storage, name, row_count, self._memory):
            self.counts.add_points(columns)
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
            if is_first:  # the offset of the first part is only known once the layout is known
                offset = self._file.extend(rows_in_block)
            self._file.write_rows(rows, offset)
            offset += len(rows)


class CloudWriter:
    """Writer of a PLY file that computes statistics of the points in the same pass.

    Parts are appended in scan order, so the file offset of each part is known in advance and
    several threads can write parts concurrently. An error in a thread is raised by a later call.

    Parameters
    ----------
    path
        The file, which must not exist.
    points
        Points of the survey. Parts that are not included yet can be appended.
    sweeps, scene
        Sweeps and scene of the survey.
    position_type
        Data type of the positions in the file (see `position_dtype`).
    expected_count
        Expected number of points (see `PlyAppender`).
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
        self._being_written = deque[Future[None]]()  # one per part, limited to one per thread

    def __enter__(self) -> CloudWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def append(self, name: str, row_count: int, cell_box: Ints) -> None:
        """Append the points of a part to the file.

        If all threads are busy, wait until one of them has finished.

        Parameters
        ----------
        name
            Name of the part.
        row_count
            Number of points in the part, at least 1.
        cell_box
            Lowest and highest cells of a box that contains the points. Shape (2, 3).

        Raises
        ------
        LidarError
            If a part is unusable.
        OSError
            If the disk is full, or the file cannot be written for another reason.
        """
        if not self.file.has_layout:
            self._write(name, row_count, cell_box)
            return
        if len(self._being_written) == self.threads:  # limits the memory use
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
        """Wait until all parts have been written, and raise the same errors as `append`."""
        while self._being_written:
            self._being_written.popleft().result()

    def finish(self) -> CloudCounts:
        """Complete the file, and return the statistics of its points.

        Raises
        ------
        LidarError
            If a part is unusable or contains points on objects that the scene does not have.
        OSError
            If the file cannot be written.
        """
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
        """Wait for all threads, and close the file."""
        self._executor.shutdown(cancel_futures=True)
        self.file.close()


def write_cloud(path: Path, points: StoredCloud, sweeps: Sweeps, scene: Scene) -> CloudCounts:
    """Write all points to a new PLY file, and return statistics of the points.

    Raises
    ------
    LidarError
        If there is not enough disk space, or if a part is unusable.
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
    """PLY file to which a background thread appends the committed parts of a job.

    Parts are appended in scan order. The file is temporary until `finish` is called. If the file
    cannot be written, for example because the disk is full, it is removed and the run continues. In
    this case, `write_cloud` must be called at the end of the run. It writes the cloud or raises the
    error.

    Parameters
    ----------
    path
        The temporary file, which must not exist.
    job
        The job. Parts that a previous run has committed are appended first.
    """

    def __init__(self, path: Path, job: StoredJob) -> None:
        self._path = path
        self._job = job
        self._sweeps = Sweeps.from_survey(job.job.survey, job.job.scene)
        # Only the bounds of these points are used. Their cells are those of the appended parts.
        self._points = replace(job.points(), cells=None)
        self._next_scan = job.scans.start  # first scan of the next part
        self._appended: list[Receipt] = []
        self._appended_rows = 0
        self._appended_bytes = 0  # total size of the appended parts
        self._writer: CloudWriter | None = None
        self._is_complete = False  # set when all queued parts have been appended
        self._is_stopped = False
        self._queue = SimpleQueue[Receipt | None]()  # parts in scan order; None ends the thread
        self._thread = Thread(target=self._run, name="grow cloud", daemon=True)

    def __enter__(self) -> GrowingCloud:
        self._thread.start()
        self.append_committed()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the thread, and remove the file unless `finish` has moved it to its path."""
        self._is_stopped = True
        self._queue.put(None)
        self._thread.join()
        self._discard()

    def append_committed(self, _: Sequence[Receipt] = ()) -> None:
        """Queue the committed parts that follow in scan order, without waiting for the thread."""
        parts = self._job.parts
        with suppress(KeyError):  # the next scan is not committed yet
            while True:
                part = parts.part_of(self._next_scan)
                self._next_scan = part.stop
                if part.point_count:
                    self._queue.put(part)

    def finish(self, path: Path, points: StoredCloud) -> CloudCounts | None:
        """Wait for the thread, move the file to `path`, and return the statistics of its points.

        Return None if the file is missing or does not contain all `points`, for example because it
        could not be written.

        Raises
        ------
        OSError
            If the file cannot be completed.
        """
        self._queue.put(None)
        reported_count = 0
        while self._thread.is_alive():
            self._thread.join(_POLL_INTERVAL_S)
            points.report(self._appended_rows - reported_count)
            reported_count = self._appended_rows
        writer = self._writer
        # On a network file system without locks, another run may have removed the file.
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
        """Append parts until the queue ends or writing fails."""
        try:
            # Errors can be ignored, because `write_cloud` will encounter and report them.
            with suppress(LidarError, OSError):
                while (part := self._queue.get()) is not None and not self._is_stopped:
                    self._append(part)
                if self._writer is not None:
                    self._writer.wait()  # also raises the errors of the writer's threads
                self._is_complete = True
        finally:
            if not self._is_complete:
                self._discard()

    def _append(self, part: Receipt) -> None:
        """Append a part, or rewrite the file if its positions require another data type."""
        self._appended.append(part)
        self._check_disk_space(part)
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

    def _check_disk_space(self, part: Receipt) -> None:
        """Raise OSError if the disk space is insufficient for this part and all remaining parts.

        Without this check, the growing file could fill the disk before all scans are stored.
        """
        rows_bytes = 0
        if self._writer is not None:  # each thread may still have a part to write
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
