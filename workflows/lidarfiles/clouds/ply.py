"""Read and write point clouds of any size as binary PLY files."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import AXES, as_file_type, header, layout, map_rows, row_type
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import AXES as POSITION
from lidarsim.columns.table import NORMAL, TABLE, Column, check_names
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input
from lidarsim.numerics.arrays import AnyArray, AnyFloats
from lidarsim.scene.files.stated_system import StatedSystem
from lidarsim.sweeps.instruments import TRAJECTORY_FILE
from lidarsim.sweeps.sweeps import AS_FIRED, SWEEPS_FILE, Sweeps
from lidarsim.words import printable

from ..open3d_access.open3d_module import load_open3d
from .cloud_format import CloudFormat
from .format_options import FormatOptions
from .job_reader import JobReader, PointColumns
from .recording import PointCloud, Recording, sweep_from_columns
from .recording_ref import RecordingRef
from .results import open_cloud

# Positions are stored as float32 if the error is below this fraction of the precision.
_ROUNDING_SHARE = 0.05
FILE = "cloud.ply"  # file name in a result
# Number of points that are written by Open3D, which takes five times as long per point.
FIRST_POINTS = 65_536
_BLOCK_BYTES = 1 << 23  # number of bytes that are moved at a time


class PLY(CloudFormat):
    """A binary PLY file in the layout of Open3D.

    About one million points are held in memory at a time. Positions are stored as float32 if the
    rounding error is below 5 % of the precision of the sweeps, and otherwise as float64.

    Comments contain the names of classes and materials (`class 40 road`, `material 0 Brick`), the
    coordinate system of the world frame (`crs: EPSG:25832`), and a note if points are not in the
    world frame.
    """

    title = "PLY"
    job_path = "jobs/{name}/cloud.ply"
    for_scenes = True

    def write(self, path: Path, spec: FormatOptions) -> None:
        """Write the file."""
        cloud = self.cloud
        position_type = position_dtype(cloud.bounds, self.sweeps.precision_m)
        with PlyAppender(path, cloud.table, position_type, self.sweeps, len(cloud)) as file:
            file.check_disk_space(len(cloud))
            for chunk in cloud.chunks():
                file.append(len(chunk), chunk.by_name.items())
            file.finish()

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Read the points of a sweep in a data set with all columns."""
        name = cls.path_of_job(job.entry)
        file = job.get_or_compute("cloud", lambda: CloudFile(job.local(name)))
        first, stop = (file.row_of(scan) for scan in job.sweeps.scans[sweep : sweep + 2])
        cloud = next(file.chunks(max(1, stop - first), first), None)
        if cloud is None or first == stop:
            kinds = {column.name: np.empty(0, column.dtype) for column in file.table}
            cloud = Cloud(np.empty((0, 3)), kinds)
        return job.in_sensor(sweep, cloud)

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording | PointCloud:
        """Open a .ply file or a result folder, whose cloud has sweeps."""
        path = ref.path / FILE if ref.path.is_dir() else ref.path
        if ref.as_stored:
            return _ForeignCloud(ref, path)
        try:
            cloud = CloudFile(path)
        except LidarError:  # a text file, or a file from another program
            return _ForeignCloud(ref, path)
        return _open_own(ref, path, cloud)


class PlyAppender:
    """A binary PLY file to which points are appended.

    The file is complete after `finish`. The bytes are the same as if Open3D wrote all points at
    once, but without holding all points in memory. Open3D writes the first points to a temporary
    file. Its header and rows determine the layout in which further points are appended.

    After the first points, several threads can write rows at the same time. One thread reserves
    space with `extend`, in the order of the points, and any thread can then write the rows at the
    returned offset.

    Parameters
    ----------
    path
        Path of the file, which must not exist.
    table
        Columns in addition to the positions.
    position_type
        Type of the positions, float32 or float64 (see `position_dtype`).
    sweeps
        Sweeps to which the points belong, which determine the comments.
    expected_count
        Expected number of points. If the actual number has more or fewer digits, `finish` moves all
        rows, because the length of the header changes.
    """

    def __init__(
        self,
        path: Path,
        table: Sequence[Column],
        position_type: np.dtype[np.floating],
        sweeps: Sweeps,
        expected_count: int,
    ) -> None:
        check_names((*POSITION, *table))
        self.position_type = position_type
        self.row = row_type(position_type, table)
        self.count = 0  # number of points in the file
        self._path = path
        self._columns = {column.name: column for column in table}
        self._expected_count = expected_count
        self._comments = _comments(table, sweeps)
        self._start = 0  # offset of the first row in bytes, or 0 if there are no rows
        self._head_parts = (b"", b"")  # header before and after the line with the number of points
        self._file = path.open("x+b", buffering=0)

    def __enter__(self) -> PlyAppender:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self._start + self.count * self.row.itemsize

    @property
    def has_layout(self) -> bool:
        """Whether points have been written. The first points determine the row type `row`."""
        return bool(self._start)

    def check_disk_space(self, count: int) -> None:
        """Raise LidarError unless the disk has enough space for `count` points.

        The first points are temporarily stored twice.
        """
        size = len(header(self.row, count, self._comments)) + count * self.row.itemsize
        piece = min(count, FIRST_POINTS) * self.row.itemsize
        free = shutil.disk_usage(self._path.parent).free
        if free < size + piece:
            raise LidarError(
                f"{self._path} cannot be written: it requires {size:,} bytes and temporarily "
                f"another {piece:,} bytes, but only {free:,} bytes are free on the disk. Free "
                "some space, or write to another folder."
            )

    def append(self, count: int, columns: Iterable[tuple[str, AnyArray]]) -> None:
        """Append points.

        Parameters
        ----------
        count
            Number of points.
        columns
            Name and values of each axis and column. Positions must be float32 or float64.

        Raises
        ------
        LidarError
            If Open3D cannot write the points, or if a value is out of range for its type in the
            file.
        OSError
            If the disk is full, or if the file cannot be written for another reason.
        """
        first = 0
        if not self._start and count:
            columns = [*columns]
            first = min(count, FIRST_POINTS)
            self._write_first({name: values[:first] for name, values in columns})
        if first < count:
            rows = np.empty(count - first, self.row)
            for name, values in columns:
                column = self._columns.get(name)
                if column is None:
                    rows[name] = values[first:]
                else:
                    rows[column.in_files] = as_file_type(column, values[first:])
            self._write(rows.data.cast("B"))
        self.count += count

    def extend(self, count: int) -> int:
        """Reserve space for `count` rows and return their offset in bytes.

        The rows must be written with `write_rows`. The file must already contain the first points.
        """
        offset = self.size
        self.count += count
        return offset

    def write_rows(self, rows: memoryview, offset: int) -> None:
        """Write rows at an offset in bytes.

        Raises OSError if the disk is full, or if the file cannot be written for another reason.
        """
        _write_at(self._file.fileno(), rows, offset)

    def flush(self) -> None:
        """Flush the points to the disk."""
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write the header with the final number of points."""
        if not self._start:  # Open3D refuses to write a file without points
            self._write(header(self.row, 0, self._comments))
            return
        head = self._header(self.count)
        if len(head) != self._start:
            _move_bytes(self._file.fileno(), self._start, self.size, len(head))
            self._start = len(head)
        os.pwrite(self._file.fileno(), head, 0)

    def _header(self, count: int) -> bytes:
        before, after = self._head_parts
        return b"%s%selement vertex %d\n%s" % (before, self._comments.encode(), count, after)

    def _write_first(self, columns: Mapping[str, AnyArray]) -> None:
        """Let Open3D write the first points, and copy its header and rows to the file."""
        positions = np.stack([columns[axis] for axis in AXES], axis=1)
        others = {name: columns[name] for name in self._columns}
        cloud = Cloud(positions, others, tuple(self._columns.values()))
        # Open3D selects the format by the file extension.
        piece = self._path.with_name(f".{self._path.name}.ply")
        write_with_open3d(piece, cloud, self.position_type)
        start, self.row = _layout(piece, self._path, len(cloud))
        written = piece.read_bytes()
        piece.unlink()
        before, _, after = written[:start].partition(b"element vertex %d\n" % len(cloud))
        self._head_parts = before, after
        head = self._header(self._expected_count)
        self._write(head + written[start:])
        self._start = len(head)

    def _write(self, data: bytes | memoryview) -> None:
        view = memoryview(data)
        while view:  # Linux writes at most 2 GiB in one call
            view = view[self._file.write(view) :]


def _comments(table: Sequence[Column], sweeps: Sweeps) -> str:
    """Return the comment lines that lidarpool adds to the header of Open3D."""
    comments = f"comment {AS_FIRED}\n" if sweeps.coordinates == "sensor" else ""
    if sweeps.epsg is not None and sweeps.coordinates == "world":
        comments += f"comment crs: EPSG:{sweeps.epsg}\n"
    comments += "".join(f"comment class {n} {name}\n" for n, name in sweeps.classes.items())
    if any(column.name == "material" for column in table):
        names = enumerate(map(_comment, sweeps.materials))
        comments += "".join(f"comment material {n} {name}\n" for n, name in names)
    return comments


def _write_at(file: int, data: memoryview, offset: int) -> None:
    while data:  # Linux writes at most 2 GiB in one call
        count = os.pwrite(file, data, offset)
        data = data[count:]
        offset += count


def _move_bytes(file: int, start: int, stop: int, new_start: int) -> None:
    """Move a range of bytes to `new_start` and truncate the file after them.

    The range is from `start` to `stop`.
    """
    offsets = range(start, stop, _BLOCK_BYTES)
    distance = new_start - start
    for offset in reversed(offsets) if distance > 0 else offsets:
        block = memoryview(os.pread(file, min(_BLOCK_BYTES, stop - offset), offset))
        _write_at(file, block, offset + distance)
    os.ftruncate(file, stop + distance)


def read_cloud(path: str | Path) -> Cloud:
    """Read a .ply point cloud written by a run or by `save_cloud`, with all its columns.

    A cloud that is read from a result folder can be saved in all formats, because `cloud.sweeps()`
    returns its sweeps. To read single sweeps with their poses and boxes, use `lidarpool.sweeps`.

    Returns
    -------
    Cloud
        The points in memory.

    Raises
    ------
    LidarError
        If the file is missing, truncated, or not a binary PLY file with x, y and z.
    """
    path = Path(path)
    rows = np.array(map_rows(path))
    positions = np.stack([rows[axis] for axis in "xyz"], axis=1)
    names = {column.in_files: column.name for column in TABLE.values()}
    columns = {names.get(name, name): rows[name] for name in rows.dtype.names or ()}
    columns = {name: values for name, values in columns.items() if name not in AXES}
    beside = path.with_name(SWEEPS_FILE)

    def load_sweeps() -> Sweeps:
        """Return the survey's sweeps, which are stored next to the cloud."""
        return Sweeps.load(beside)

    return Cloud(positions, columns, sweeps=load_sweeps if beside.exists() else None)


def _comment(name: str) -> str:
    """Convert a name to printable ASCII for use in a comment."""
    return printable(name).encode("ascii", "backslashreplace").decode()


def position_dtype(bounds: AnyFloats, precision_m: float) -> np.dtype[np.floating]:
    """Return the smallest floating-point type that is precise enough for positions.

    Parameters
    ----------
    bounds
        Minimum and maximum of the positions. If they are float32, so are the positions.
    precision_m
        Precision of the positions in meters.
    """
    if bounds.dtype == np.float32:
        return bounds.dtype
    farthest = np.float32(np.abs(bounds).max(initial=0.0))
    enough = np.spacing(farthest) / 2 < _ROUNDING_SHARE * precision_m
    return np.dtype(np.float32 if enough else np.float64)


def write_with_open3d(path: Path, cloud: Cloud, real: np.dtype[np.floating]) -> None:
    """Write a cloud with Open3D, converting its positions to the type `real`.

    Raises LidarError if Open3D reports an error.
    """
    o3d = load_open3d()
    points = o3d.t.geometry.PointCloud()
    points.point.positions = o3d.core.Tensor(np.ascontiguousarray(cloud.positions, real))
    # Open3D only supports consecutive normals. The order of other columns is arbitrary.
    normals = NORMAL if {*NORMAL} <= {*cloud.columns} else ()
    if normals:
        points.point.normals = o3d.core.Tensor(np.stack([cloud[n] for n in normals], axis=1))
    for column in cloud.table:
        if column.name in normals:
            continue
        values = np.ascontiguousarray(as_file_type(column, cloud[column.name]))
        points.point[column.in_files] = o3d.core.Tensor(values[:, None])
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    try:
        with quiet:
            written = o3d.t.io.write_point_cloud(str(path), points, write_ascii=False)
    except (RuntimeError, UnicodeError) as error:
        raise LidarError(f"Open3D cannot write to {path.parent}: {error}.") from error
    if not written:
        raise LidarError(
            f"Open3D cannot write to {path.parent}. Check the folder's permissions and the free "
            "disk space."
        )


def _layout(piece: Path, path: Path, count: int) -> tuple[int, np.dtype[np.void]]:
    """Return the offset of the first row and the row type in a file written by Open3D.

    Raises LidarError if rows are missing, because Open3D does not report a full disk.
    """
    try:
        start, stored_count, row = layout(piece)
        if stored_count != count:
            raise ValueError(f"only {stored_count:,} of {count:,} points were written")
    except ValueError as error:
        free = shutil.disk_usage(path.parent).free
        raise LidarError(
            f"{path} cannot be written: {error}. The disk has {free:,} bytes of free space. "
            "Free some space, or write to another folder."
        ) from error
    return start, row


# -- reading ---------------------------------------------------------------------------------


class _ForeignCloud(PointCloud):
    """A .ply text file, or a .ply file from another program.

    Positions are in the units of the coordinate system that the file declares.
    """

    def __init__(self, ref: RecordingRef, path: Path) -> None:
        # Imported late, because results of this package need no reader for other programs' files.
        from lidarsim.scene.files.polygon_files import ply_comments

        super().__init__(ref.info())
        self._path = path
        with reading(ref.name):
            system = StatedSystem.from_comments(ply_comments(read_input(path)))
            is_checked = system is not None and not ref.as_stored
            positions = self.load(0).points if is_checked else np.zeros((0, 3))
            meters, notes = ref.stated_meters(system, positions)
        epsg = ref.epsg_in_meters(system, meters)
        self.info = ref.info(meters=meters, system=system, epsg=epsg, notes=notes)

    def __len__(self) -> int:
        return 1

    def load(self, number: int) -> Sweep:
        from lidarsim.scene.files.polygon_files import read_ply_columns

        return sweep_from_columns(read_ply_columns(read_input(self._path)))


def _open_own(ref: RecordingRef, path: Path, cloud: CloudFile) -> Recording | PointCloud:
    """Open a .ply file written by lidarpool, with sweeps if it belongs to a result."""
    meters = ref.chosen_meters()
    sweeps_path = path.with_name(SWEEPS_FILE)
    if not sweeps_path.exists():
        return open_cloud(ref.info(meters=meters), cloud, None, ref.sensor)
    try:
        report = json.loads(read_input(path.with_name("report.json")))
        keep_every = int(report["parameters"]["keep_every"])
    except (OSError, ValueError, TypeError, LookupError, LidarError):
        keep_every = 1
    note = (
        f"{ref.name} contains only one in every {keep_every} hits, so its gaps do not "
        "represent lost returns. To compare lost returns, run the survey with `keep_every: 1`"
    )
    is_thinned = keep_every > 1
    return open_cloud(
        ref.info(meters=meters, thinned=is_thinned, notes=(note,) if is_thinned else ()),
        cloud,
        partial(Sweeps.load, sweeps_path),
        ref.sensor,
        has_measured_poses=path.with_name(TRAJECTORY_FILE).exists(),
    )
