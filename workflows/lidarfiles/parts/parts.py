"""Parts, which are files that store the columns of consecutive scans.

A part is an uncompressed NumPy archive, which ``numpy.load`` can open. It contains one array per
column, with rows ordered by scan and ray, and these additional arrays:

- `.scans`: the first scan, and the last scan plus one
- `.counts`: number of rows of each scan
- `.scan_hits`: number of hits of each scan, including hits that were removed by thinning
- `.samples`: end points of sample rays
- `.triangles`: hit counters (see `Scene.counters`) that are not zero
- `.hits`: number of hits of each of these counters
- `.actor_rays`: visibility records of actors in the scans (`ACTOR_RAYS`), as bytes

`x`, `y` and `z` are integer multiples of the precision, relative to the scene's local origin, so
coordinates are rounded only once.
"""

from __future__ import annotations

import re
import zipfile
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from lidarsim.columns.actor_rays import ACTOR_RAYS
from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudDisplay
from lidarsim.columns.part_columns import PartColumns, cell_positions
from lidarsim.columns.table import AXES, SCAN, Column
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.errors import LidarError
from lidarsim.io.archives import Piece, archive_pieces, read_arrays, read_npy
from lidarsim.io.input_files import open_input
from lidarsim.io.storage import Storage, final_name
from lidarsim.numerics.arrays import AnyArray, Floats, Integers, Ints, Ints32, Records
from lidarsim.numerics.even_samples import even_indices

# Names of a run's files in the folder of parts. Each name starts with the mark of the run.
_PART = re.compile(r"([0-9a-f]{16})-(\d{6,})-(\d{8,})-(\d{8,})\.npz", re.ASCII)
_OTHER = re.compile(r"([0-9a-f]{16})-(?:mark|probe-[0-9a-f]{8})", re.ASCII)
_AGAIN = "Resume the run with `--resume` (`resume=True` in Python) to cast its scans again."


# A run deletes only files that it wrote. The names of these files start with the mark of the run
# (16 random hexadecimal digits), and a mark file in the folder of parts records this mark.


def part_name(mark: str, job: int, first: int, stop: int) -> str:
    """Return the file name of the part with the scans from `first` to `stop` of a job.

    If a task is repeated, it overwrites its part with the same bytes.
    """
    return f"{mark}-{job:06d}-{first:08d}-{stop:08d}.npz"


def parse_part_name(name: str, mark: str) -> tuple[int, int, int] | None:
    """Parse the file name of a part, and return its job number, first scan and stop scan.

    Return None if the file does not belong to the run with this mark.
    """
    match = _PART.fullmatch(name)
    if match is None or match[1] != mark:
        return None
    return int(match[2]), int(match[3]), int(match[4])


def probe_name(mark: str, driver: str) -> str:
    """Return the name of the file with which a driver tests access to the folder by workers."""
    return f"{mark}-probe-{driver}"


def mark_name(mark: str) -> str:
    """Return the name of the mark file, which identifies the run that owns the folder of parts."""
    return f"{mark}-mark"


def deletable_files(storage: Storage, mark: str | None) -> list[str]:
    """Return the names of the files that a run may delete, including incompletely written files.

    Only files whose name starts with the mark of the run are returned, and only if the folder
    contains the mark file. If `mark` is None, the files of all marks in the folder are returned.
    Mark files come last, so that the remaining files can still be identified if the removal is
    interrupted.
    """
    names = [*storage.sizes()]
    marks = {_mark_of(name) for name in names if name.endswith("-mark")} - {""}
    marks &= marks if mark is None else {mark}
    names_with_mark = [name for name in names if _mark_of(final_name(name)) in marks]
    return sorted(names_with_mark, key=lambda name: name.endswith("-mark"))


def _mark_of(name: str) -> str:
    """Return the mark of the run that wrote a file, as stated in the file name.

    Returns an empty string if the file does not belong to a run.
    """
    match = _PART.fullmatch(name) or _OTHER.fullmatch(name)
    return match[1] if match else ""


def pack(part: PartColumns) -> list[Piece]:
    """Encode a part as pieces that `Storage.write` accepts.

    Encoding is deterministic. The pieces are views of the columns, which are not copied.
    """
    return archive_pieces(
        {
            ".scans": np.array([part.first, part.stop], np.int64),
            ".counts": part.counts,
            ".triangles": part.triangles,
            ".hits": part.hits,
            ".scan_hits": part.scan_hits,
            ".samples": part.samples,
            ".actor_rays": part.actor_rays.view(np.uint8),
            **part.columns,
        }
    )


def unpack(data: bytes) -> PartColumns:
    """Decode a part, verifying the checksum of each array.

    Raises LidarError if the data is not a part or is damaged. The message is a clause, which
    `reading_part` completes to a sentence.
    """
    try:
        arrays = read_arrays(data)
        first, stop = arrays.pop(".scans").tolist()
        named = ("counts", "triangles", "hits", "scan_hits", "samples")
        actor_rays = arrays.pop(".actor_rays").view(ACTOR_RAYS)
        part = PartColumns(
            first,
            columns=arrays,
            actor_rays=actor_rays,
            **{name: arrays.pop(f".{name}") for name in named},
        )
        if (
            part.stop != stop
            or (part.counts < 0).any()
            or part.triangles.shape != part.hits.shape
            or part.scan_hits.shape != part.counts.shape
            or part.samples.shape[:1] + part.samples.shape[2:] != (len(part.counts), 3)
            or part.actor_rays.ndim != 1
            or any(array.shape != (len(part),) for array in part.columns.values())
        ):
            raise ValueError("its arrays do not have matching shapes")
    except Exception as error:  # zipfile, zlib, lzma and NumPy raise a dozen types of errors
        raise LidarError(f"it is damaged ({error})") from error
    return part


def read_part(storage: Storage, name: str) -> PartColumns:
    """Read a part and verify its checksums.

    Raises LidarError if the part is missing, unreadable or damaged.
    """
    with reading_part(storage, name):
        return unpack(storage.read(name))


@contextmanager
def reading_part(storage: Storage, name: str) -> Iterator[None]:
    """Convert errors in the body to a LidarError that names the part and suggests a solution.

    The message of a LidarError that the body raises must be a clause.
    """
    try:
        yield
    except LidarError as error:
        raise LidarError(
            f"The part {storage.path(name)} cannot be used: {error}. {_AGAIN}"
        ) from error
    except OSError as error:
        raise LidarError(
            f"The part {storage.path(name)} cannot be read: {error.strerror or error}. {_AGAIN}"
        ) from error


def read_hit_counts(storage: Storage, name: str) -> tuple[Ints32, Ints]:
    """Read the hit counts of a part without reading its columns.

    Returns the indices of the hit counters that are not zero, and the number of hits of each
    counter. Both arrays have shape (k,). Raises the same errors as `read_part`.
    """
    if not storage.is_local:
        part = read_part(storage, name)
        return part.triangles, part.hits
    counters, hits = _read_arrays(storage, name, "triangles", "hits")
    return counters, hits


def read_actor_rays(storage: Storage, name: str) -> Records:
    """Read the actor visibility records of a part without reading its columns.

    Returns records of type `ACTOR_RAYS`. Raises the same errors as `read_part`.
    """
    if not storage.is_local:
        return read_part(storage, name).actor_rays
    (data,) = _read_arrays(storage, name, "actor_rays")
    return data.view(ACTOR_RAYS)


def _read_arrays(storage: Storage, name: str, *arrays: str) -> list[AnyArray]:
    """Read some arrays of a part in a local folder."""
    try:
        with open_input(storage.local(name)) as file, zipfile.ZipFile(file) as archive:
            return [read_npy(archive.read(f".{array}.npy"), array) for array in arrays]
    except Exception as error:  # zipfile and NumPy raise many types of errors
        raise LidarError(
            f"The part {storage.path(name)} cannot be used ({error}). {_AGAIN}"
        ) from error


def _ignore_progress(points: int) -> None:
    """Ignore the progress."""


@dataclass(eq=False, repr=False)
class StoredCloud(CloudDisplay):
    """Point cloud that is stored in the parts of a run and read in chunks.

    Points are ordered by scan and ray.
    """

    storage: Storage  # storage of the parts
    names: Sequence[str]  # names of the parts, in scan order
    firsts: Sequence[int]  # first scan of each part
    rows: Sequence[int]  # number of points of each part
    columns: Sequence[Column]  # columns of a part
    cells: Ints | None  # lowest and highest cells, shape (2, 3); None if there are no points
    precision_m: float  # size of the cells that positions were rounded to
    origin: Floats  # scene origin in world coordinates, shape (3,), meters
    keeper: Any = None  # object that deletes the parts when it is garbage-collected
    sweeps: Callable[[], Any] | None = None  # returns the sweeps of the survey for `save_cloud`
    report: Callable[[int], object] = _ignore_progress  # called with the number of points read

    def __getstate__(self) -> dict[str, Any]:
        # The keeper and the sweeps refer to the scene, which is too large to pickle. Progress is
        # not reported across processes.
        return self.__dict__ | {"keeper": None, "sweeps": None, "report": _ignore_progress}

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> AnyArray:
        return self.load().__array__(dtype)

    def __len__(self) -> int:
        return sum(self.rows)

    @property
    def bounds(self) -> Floats:
        """Minimum and maximum coordinates in meters, or zeros for an empty cloud.

        The array has shape (2, 3).
        """
        if self.cells is None:
            return np.zeros((2, 3))
        return cell_positions(self.cells, self.precision_m, self.origin)

    @property
    def table(self) -> tuple[Column, ...]:
        """All columns except the positions, in the order in which they are written to files."""
        columns = [c for c in self.columns if c not in AXES and c.name != WAVEFORM]
        return (SCAN, *columns)

    @property
    def has_waveforms(self) -> bool:
        """Whether the cloud contains waveforms."""
        return any(column.name == WAVEFORM for column in self.columns)

    def cloud_of(self, part: PartColumns, row_selection: Integers | slice = slice(None)) -> Cloud:
        """Return the points of a part as a cloud, or only the selected rows."""
        return part.cloud(self.table, self.precision_m, self.origin, row_selection, self.sweeps)

    def positions_of(self, columns: Mapping[str, AnyArray]) -> Iterator[tuple[str, Floats]]:
        """Yield the world coordinates of points along each axis, with the name of the axis."""
        for i, axis in enumerate(AXES):
            yield axis.name, cell_positions(columns[axis.name], self.precision_m, self.origin[i])

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield the points in order, starting at row `first`, in chunks of `points` points.

        The last chunk may be smaller. Raises LidarError if a part cannot be read.
        """
        pending: list[Cloud] = []
        count = 0
        for name, rows in zip(self.names, self.rows, strict=True):
            if rows <= first:
                first -= rows
                continue
            cloud = self.cloud_of(read_part(self.storage, name), slice(first, None))
            first = 0
            self.report(len(cloud))
            while count + len(cloud) >= points:
                cut = points - count
                yield Cloud.concatenate([*pending, cloud[:cut]])
                cloud = cloud[cut:]
                pending = []
                count = 0
            if len(cloud):
                pending.append(cloud)
                count += len(cloud)
        if pending:
            yield Cloud.concatenate(pending)

    def row_of(self, scan: int) -> int:
        """Return the row index of the first point of a scan."""
        index = bisect_right(self.firsts, scan) - 1
        row = sum(self.rows[: max(0, index)])
        if index < 0 or scan == self.firsts[index]:
            return row
        counts = read_part(self.storage, self.names[index]).counts
        return row + int(counts[: scan - self.firsts[index]].sum())

    def sample(self, max_points: int, max_parts: int) -> Cloud:
        """Read at most `max_points` evenly spaced points from at most `max_parts` parts."""
        filled = [i for i, rows in enumerate(self.rows) if rows]
        opened = [filled[i] for i in even_indices(len(filled), max_parts)]
        total = sum(self.rows[i] for i in opened)
        picked = even_indices(total, max_points)
        clouds = []
        start = 0
        for i in opened:
            inside = picked[(picked >= start) & (picked < start + self.rows[i])] - start
            start += self.rows[i]
            clouds.append(self.cloud_of(read_part(self.storage, self.names[i]), inside))
        return Cloud.concatenate(clouds) if clouds else self.load()

    def load(self) -> Cloud:
        """Read all points into memory."""
        parts = list(self.chunks())
        if parts:
            return Cloud.concatenate(parts)
        columns_of_parts = (column for column in self.columns if column not in AXES)
        columns = {column.name: np.zeros(0, column.dtype) for column in (SCAN, *columns_of_parts)}
        return Cloud(np.zeros((0, 3)), columns, self.table, self.sweeps)
