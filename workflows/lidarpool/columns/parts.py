"""Parts: the columns of some consecutive scans as one file.

A part is a NumPy archive without compression (``numpy.load`` opens it): an array for each column,
rows in (scan, ray) order, and more: `.scans`, first scan and one past the last; of each scan
`.counts`, its rows, `.scan_hits`, its hits including those that were not kept, and `.samples`, ends
of some of its rays; and the hits of each triangle, `.triangles` and `.hits`. `x`, `y` and `z` are
whole multiples of the precision from the scene's local origin, so that they are rounded only once.
"""

from __future__ import annotations

import io
import re
import zipfile
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from lidarsim.base.archives import read_arrays, read_npy
from lidarsim.base.arrays import AnyArray, Floats, Integers, Ints, Ints32
from lidarsim.base.errors import LidarError
from lidarsim.base.input_files import open_input
from lidarsim.base.sampling import even_indices
from lidarsim.base.storage import Storage, target_of
from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudDisplay
from lidarsim.columns.part_columns import PartColumns, positions_of
from lidarsim.columns.table import AXES, SCAN, Column
from lidarsim.columns.waveforms import WAVEFORM

# Files of a run in the folder of its parts: its mark, then what it is.
_PART = re.compile(r"([0-9a-f]{16})-(\d{6,})-(\d{8,})-(\d{8,})\.npz", re.ASCII)
_OTHER = re.compile(r"([0-9a-f]{16})-(?:mark|probe-[0-9a-f]{8})", re.ASCII)
_AGAIN = "Resuming the run (--resume, in Python resume=True) casts its scans again."
_DATE = (1980, 1, 1, 0, 0, 0)  # the same columns give the same bytes


# A run deletes what it wrote, and nothing else: the names of its files begin with its mark, 16
# random digits, and an empty file in the folder of the parts says that they are this mark's.


def part_name(mark: str, job: int, first: int, stop: int) -> str:
    """Name of the part of these scans: who writes it a second time writes the same bytes."""
    return f"{mark}-{job:06d}-{first:08d}-{stop:08d}.npz"


def scans_of(name: str, mark: str) -> tuple[int, int, int] | None:
    """Job, first scan and end of the part of a run that has a name; None for other names."""
    found = _PART.fullmatch(name)
    if found is None or found[1] != mark:
        return None
    return int(found[2]), int(found[3]), int(found[4])


def probe_name(mark: str, driver: str) -> str:
    """Name of the file by which workers of a driver find out whether they see the folder."""
    return f"{mark}-probe-{driver}"


def mark_name(mark: str) -> str:
    """Name of the file that says whose parts are in a folder."""
    return f"{mark}-mark"


def own_files(storage: Storage, mark: str | None) -> list[str]:
    """Names of the files that a run may delete, those that killed writers left among them.

    `mark` is that of the run; None for each that the folder has. Without the mark in the folder
    there are none. Marks come last, so that what an interrupted removal has left stays known.
    """
    names = [*storage.sizes()]
    marks = {_mark_of(name) for name in names if name.endswith("-mark")} - {""}
    marks &= marks if mark is None else {mark}
    own = [name for name in names if _mark_of(target_of(name)) in marks]
    return sorted(own, key=lambda name: name.endswith("-mark"))


def _mark_of(name: str) -> str:
    """Mark in the name of a file of a run; empty for any other name."""
    found = _PART.fullmatch(name) or _OTHER.fullmatch(name)
    return found[1] if found else ""


def pack(part: PartColumns) -> bytearray:
    """Encode a part: the same content gives the same bytes."""
    arrays = {
        ".scans": np.array([part.first, part.stop], np.int64),
        ".counts": part.counts,
        ".triangles": part.triangles,
        ".hits": part.hits,
        ".scan_hits": part.scan_hits,
        ".samples": part.samples,
        **part.columns,
    }
    memory = io.BytesIO()
    # NumPy's savez stores the time of each file, and copies the content once more.
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name, array in arrays.items():
            head = io.BytesIO()
            array = np.ascontiguousarray(array)
            np.lib.format.write_array_header_1_0(
                head, np.lib.format.header_data_from_array_1_0(array)
            )
            with archive.open(zipfile.ZipInfo(f"{name}.npy", _DATE), "w", force_zip64=True) as file:
                file.write(head.getbuffer())
                file.write(array.data.cast("B") if array.size else b"")
    return memory.getbuffer()  # type: ignore[return-value]


def unpack(data: bytes) -> PartColumns:
    """Inverse of `pack`; every array's checksum is compared.

    LidarError if it is not a part, or damaged; the message is a clause.
    """
    try:
        arrays = read_arrays(data)
        first, stop = arrays.pop(".scans").tolist()
        named = ("counts", "triangles", "hits", "scan_hits", "samples")
        part = PartColumns(
            first, columns=arrays, **{name: arrays.pop(f".{name}") for name in named}
        )
        if (
            part.stop != stop
            or (part.counts < 0).any()
            or part.triangles.shape != part.hits.shape
            or part.scan_hits.shape != part.counts.shape
            or part.samples.shape[:1] + part.samples.shape[2:] != (len(part.counts), 3)
            or any(array.shape != (len(part),) for array in part.columns.values())
        ):
            raise ValueError("its arrays do not fit together")
    except Exception as error:  # zipfile, zlib, lzma and NumPy have a dozen kinds
        raise LidarError(f"it is damaged ({error})") from error
    return part


def read_part(storage: Storage, name: str) -> PartColumns:
    """Read a part; LidarError if it is missing, cannot be read or is damaged."""
    try:
        return unpack(storage.read(name))
    except LidarError as error:
        raise LidarError(
            f"The part {storage.path(name)} cannot be used: {error}. {_AGAIN}"
        ) from error
    except OSError as error:
        raise LidarError(
            f"The part {storage.path(name)} cannot be read: {error.strerror or error}. {_AGAIN}"
        ) from error


def read_tally(storage: Storage, name: str) -> tuple[Ints32, Ints]:
    """Read the hits of each triangle of a part, and nothing else; errors as of `read_part`."""
    if not storage.is_local:
        part = read_part(storage, name)
        return part.triangles, part.hits
    try:
        with open_input(storage.local(name)) as file, zipfile.ZipFile(file) as archive:
            triangles = read_npy(archive.read(".triangles.npy"), "triangles")
            return triangles, read_npy(archive.read(".hits.npy"), "hits")
    except Exception as error:  # as above
        raise LidarError(
            f"The part {storage.path(name)} cannot be used ({error}). {_AGAIN}"
        ) from error


@dataclass(eq=False, repr=False)
class StoredCloud(CloudDisplay):
    """The points of parts in (scan, ray) order, read in pieces; a `CloudLike`."""

    storage: Storage  # of the parts
    names: Sequence[str]  # of the parts, in scan order
    firsts: Sequence[int]  # their first scans
    rows: Sequence[int]  # their numbers of points
    columns: Sequence[Column]  # of a part
    cells: Ints | None  # lowest and highest, (2, 3); None without points
    precision_m: float  # size of the cells that positions were rounded to
    origin: Floats  # world position of the scene's local origin, (3,), metres
    keeper: Any = None  # kept alive while the parts can be read
    sweeps: Callable[[], Any] | None = None  # returns the sweeps of the survey for `save_cloud`
    tell: Callable[[int], object] = abs  # is called with the number of points that were read

    def __getstate__(self) -> dict[str, Any]:
        # Both hold the scene, and nobody hears of other processes.
        return self.__dict__ | {"keeper": None, "sweeps": None, "tell": abs}

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> AnyArray:
        return self.load().__array__(dtype)

    def __len__(self) -> int:
        return sum(self.rows)

    @property
    def bounds(self) -> Floats:
        """Lowest and highest coordinates, (2, 3), metres; zeros where there are no points."""
        if self.cells is None:
            return np.zeros((2, 3))
        return positions_of(self.cells, self.precision_m, self.origin)

    @property
    def table(self) -> tuple[Column, ...]:
        """The columns beside the positions, in the order of files."""
        rest = [c for c in self.columns if c not in AXES and c.name != WAVEFORM]
        return (SCAN, *rest)

    @property
    def recorded(self) -> bool:
        """Whether its points have waveforms."""
        return any(column.name == WAVEFORM for column in self.columns)

    def cloud_of(self, part: PartColumns, rows: Integers | slice = slice(None)) -> Cloud:
        """Points of a part, or some of them."""
        return part.cloud(self.table, self.precision_m, self.origin, rows, self.sweeps)

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Read the cloud in order, from row `first` on, so many points at a time.

        LidarError if a part cannot be read.
        """
        held: list[Cloud] = []
        count = 0
        for name, rows in zip(self.names, self.rows, strict=True):
            if rows <= first:
                first -= rows
                continue
            cloud = self.cloud_of(read_part(self.storage, name), slice(first, None))
            first = 0
            self.tell(len(cloud))
            while count + len(cloud) >= points:
                cut = points - count
                yield Cloud.joined([*held, cloud[:cut]])
                cloud = cloud[cut:]
                held = []
                count = 0
            if len(cloud):
                held.append(cloud)
                count += len(cloud)
        if held:
            yield Cloud.joined(held)

    def row_of(self, scan: int) -> int:
        """Row of the first point of a scan."""
        at = bisect_right(self.firsts, scan) - 1
        row = sum(self.rows[: max(0, at)])
        if at < 0 or scan == self.firsts[at]:
            return row
        counts = read_part(self.storage, self.names[at]).counts
        return row + int(counts[: scan - self.firsts[at]].sum())

    def sample(self, most: int, parts: int) -> Cloud:
        """Read at most so many evenly spaced points, of at most so many parts."""
        filled = [i for i, rows in enumerate(self.rows) if rows]
        opened = [filled[i] for i in even_indices(len(filled), parts)]
        total = sum(self.rows[i] for i in opened)
        picked = even_indices(total, most)
        clouds = []
        before = 0
        for i in opened:
            inside = picked[(picked >= before) & (picked < before + self.rows[i])] - before
            before += self.rows[i]
            clouds.append(self.cloud_of(read_part(self.storage, self.names[i]), inside))
        return Cloud.joined(clouds) if clouds else self.load()

    def load(self) -> Cloud:
        """Read the whole cloud into memory."""
        parts = list(self.chunks())
        if parts:
            return Cloud.joined(parts)
        rest = (column for column in self.columns if column not in AXES)
        columns = {column.name: np.zeros(0, column.dtype) for column in (SCAN, *rest)}
        return Cloud(np.zeros((0, 3)), columns, self.table, self.sweeps)
