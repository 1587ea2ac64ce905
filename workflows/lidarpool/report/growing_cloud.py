"""The cloud of a survey as a file that grows by committed parts, while further scans are cast."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import NamedTuple

import numpy as np

from lidarsim.base.errors import LidarError
from lidarsim.columns.table import AXES
from lidarsim.scene.scene import Scene
from lidarsim.sweeps.sweeps import Sweeps

from ..clouds.ply import GrowingPly, real_type
from ..columns.parts import StoredCloud, read_part
from ..run.pipeline.stage_messages import Receipt
from ..run.store.job_under_way import JobUnderWay
from .cloud_counts import CloudCounts

# Bytes appended between two flushes: the last flush is short, and no flush delays the flushes of
# parts.
_FLUSH_BYTES = 1 << 25
# Rows in memory at a time. Of a whole part, each axis in float64 took memory from the system, and
# gave it back: four times the processor time.
_BLOCK_ROWS = 1 << 16
_LOOK_EVERY_S = 0.05


class _Part(NamedTuple):
    """A committed part of a job."""

    first: int  # number of its first scan
    stop: int  # number of the scan after its last scan
    name: str  # name in the storage of the parts
    point_count: int
    cell_box: tuple[int, ...]  # lowest and highest cell as six numbers; empty without points


class CloudWriter:
    """Writes the points of parts to a PLY file, and counts the points in the same pass.

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
    from_above
        Whether the points are counted as seen from above, too, which takes as long as the rest.
    """

    def __init__(
        self,
        path: Path,
        points: StoredCloud,
        sweeps: Sweeps,
        scene: Scene,
        position_type: np.dtype[np.floating],
        expected_count: int,
        *,
        from_above: bool,
    ) -> None:
        self.counts = CloudCounts(
            points.table,
            len(scene.all_names),
            len(scene.material_names),
            points.precision_m,
            points.origin,
            from_above=from_above,
        )
        self.file = GrowingPly(path, points.table, position_type, sweeps, expected_count)
        self._points = points
        self._flushed_bytes = 0

    def append(self, name: str) -> int:
        """Append the points of a part, and return their number.

        LidarError if the part cannot be used, OSError if the disk is full.
        """
        part = read_part(self._points.storage, name)
        cell_box = part.cell_box
        if cell_box is not None:
            columns = self._points.columns_of(part)
            self.counts.add(columns)
            self.counts.widen(cell_box)
            for first in range(0, len(part), _BLOCK_ROWS):
                rows = slice(first, min(first + _BLOCK_ROWS, len(part)))
                self.counts.add_positions([part.columns[axis.name][rows] for axis in AXES])
                values = ((name, values[rows]) for name, values in columns.items())
                positions = self._points.positions_of(part, rows)
                self.file.append(rows.stop - first, chain(positions, values))
        return len(part)

    def flush(self) -> None:
        """Flush the file to the disk if many points were appended since the last flush."""
        if self.file.size - self._flushed_bytes > _FLUSH_BYTES:
            self._flushed_bytes = self.file.size
            self.file.flush()

    def finish(self) -> CloudCounts:
        """Complete the file, and return the counts of its points."""
        self.file.finish()
        return self.counts


def write_cloud(
    path: Path, points: StoredCloud, sweeps: Sweeps, scene: Scene, *, from_above: bool
) -> CloudCounts:
    """Write all points to a PLY file, which must not exist, and return their counts.

    `from_above` is as in `CloudWriter`.

    Raises
    ------
    LidarError
        If the disk lacks room, or a part cannot be used.
    OSError
        If the file cannot be written.
    """
    position_type = real_type(points.bounds, points.precision_m)
    count = len(points)
    writer = CloudWriter(path, points, sweeps, scene, position_type, count, from_above=from_above)
    with writer.file:
        writer.file.check_room(count)
        for name, rows in zip(points.names, points.rows, strict=True):
            if rows:
                points.tell(writer.append(name))
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
    from_above
        As in `CloudWriter`.
    """

    def __init__(self, path: Path, job: JobUnderWay, *, from_above: bool) -> None:
        self._path = path
        self._job = job
        self._from_above = from_above
        self._sweeps = Sweeps.from_survey(job.survey, job.scene)
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
            points.tell(self._appended_rows - told_count)
            told_count = self._appended_rows
        writer = self._writer
        # On a network disk without locks, another run may have removed the file.
        is_usable = self._is_complete and self._path.exists()
        if writer is None or not is_usable or writer.file.count != len(points):
            self._discard()
            return None
        with writer.file:
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
            self._appended_rows += self._writer.append(appended.name)
            self._writer.flush()

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
            self._job.scene,
            position_type,
            expected_count,
            from_above=self._from_above,
        )

    def _check_room(self, part: _Part) -> None:
        """Raise OSError unless the disk has room for a part here and for the parts to come.

        Else the disk would be full before all scans are stored.
        """
        row_bytes = 0 if self._writer is None else self._writer.file.row.itemsize
        scans_left = len(self._job.scans) - self._committed_scans
        bytes_left = self._committed_bytes * scans_left // self._committed_scans
        free_bytes = shutil.disk_usage(self._path.parent).free
        if free_bytes < part.point_count * row_bytes + bytes_left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))

    def _discard(self) -> None:
        """Remove the file."""
        if self._writer is not None:
            self._writer.file.close()
            self._writer = None
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
