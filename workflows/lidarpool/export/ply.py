"""Point clouds of any size as binary PLY, written completely or not at all."""

from __future__ import annotations

import shutil
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from lidarsim.base.arrays import AnyFloats, Records
from lidarsim.base.errors import LidarError
from lidarsim.base.validation import checked
from lidarsim.base.words import printable
from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.ply_format import AXES, as_file_type, header, layout, mapped_rows, row_type
from lidarsim.columns.table import AXES as POSITION
from lidarsim.columns.table import NORMAL, TABLE, check_names
from lidarsim.sweeps.sweeps import AS_FIRED, SWEEPS_FILE, Sweeps

from ..base.open3d_module import load_open3d
from . import reading

# Positions are stored in single precision if the error is below this part of the precision.
_ROUNDING_SHARE = 0.05


def write_ply(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write a cloud, in memory or on disk, to a binary PLY file through Open3D.

    About a million points are in memory at a time: Open3D writes the first chunk to a temporary
    file, whose rows and header show its layout, and the further chunks follow as such rows. The
    bytes are the same as if Open3D wrote all points at once, which would need memory for all.
    float64 positions are stored in single precision if the error is below a twentieth of the
    precision of the sweeps, else in double. Names of classes and materials are comments: `class 40
    road`, `material 0 Brick`. A comment says if points are not in the world frame.
    """
    check_names((*POSITION, *cloud.table))
    position_type = real_type(cloud.bounds, sweeps.precision_m)
    row = row_type(position_type, cloud.table)
    comments = f"comment {AS_FIRED}\n" if sweeps.coordinates == "sensor" else ""
    comments += "".join(f"comment class {n} {name}\n" for n, name in sweeps.classes.items())
    if any(column.name == "material" for column in cloud.table):
        names = enumerate(map(_comment, sweeps.materials))
        comments += "".join(f"comment material {n} {name}\n" for n, name in names)
    _check_room(path, header(row, len(cloud), comments), len(cloud), row.itemsize)
    with path.open("xb") as file:
        for chunk in cloud.chunks():
            if file.tell():
                file.write(_rows(chunk, row).data)
                continue
            piece = path.with_name(f".{path.name}.ply")  # by its ending Open3D chooses the format
            write_with_open3d(piece, chunk, position_type)
            start, row = _layout(piece, path, len(chunk))
            written = piece.read_bytes()
            vertex_line = b"element vertex %d\n" % len(chunk)
            all_points = f"{comments}element vertex {len(cloud)}\n".encode()
            file.write(written[:start].replace(vertex_line, all_points))
            file.write(memoryview(written)[start:])
            piece.unlink()
        if not file.tell():  # which Open3D refuses to write
            file.write(header(row, 0, comments))


@checked
def read_cloud(path: str | Path) -> Cloud:
    """Read a point cloud that a run or `save_cloud` wrote as .ply, with all its columns.

    A cloud from the folder of a result has sweeps, and can be saved in all formats.

    Raises
    ------
    LidarError
        If the file is missing, truncated, or not a binary PLY with x, y and z.
    """
    path = Path(path)
    rows = np.array(mapped_rows(path))
    positions = np.stack([rows[axis] for axis in "xyz"], axis=1)
    names = {column.in_files: column.name for column in TABLE.values()}
    columns = {names.get(name, name): rows[name] for name in rows.dtype.names or ()}
    columns = {name: values for name, values in columns.items() if name not in AXES}
    beside = path.with_name(SWEEPS_FILE)
    sweeps = partial(Sweeps.load, beside) if beside.exists() else None
    return Cloud(positions, columns, sweeps=sweeps)


def _comment(name: str) -> str:
    """Return a name for a comment, in ASCII."""
    return printable(name).encode("ascii", "backslashreplace").decode()


class Reader(reading.Reader):
    """Reads sweeps of a data set: all columns of each point."""

    def files(self, sweep: int) -> list[str]:
        """Return the name of the job's cloud."""
        return [self.entry.path_of("ply")]

    @cached_property
    def _cloud(self) -> CloudFile:
        return CloudFile(self.local(self.files(0)[0]))

    def read(self, sweep: int) -> reading.PointColumns:
        """Return the points of a sweep."""
        first, stop = (self._cloud.row_of(scan) for scan in self.sweeps.scans[sweep : sweep + 2])
        cloud = next(self._cloud.chunks(max(1, stop - first), first), None)
        if cloud is None or first == stop:
            kinds = {column.name: np.empty(0, column.dtype) for column in self._cloud.table}
            cloud = Cloud(np.empty((0, 3)), kinds)
        return self.inside(sweep, cloud)


def real_type(bounds: AnyFloats, precision_m: float) -> np.dtype[np.floating]:
    """Return the smallest type that is precise enough for positions between these bounds."""
    if bounds.dtype == np.float32:
        return bounds.dtype
    farthest = np.float32(np.abs(bounds).max(initial=0.0))
    enough = np.isfinite(farthest) and np.spacing(farthest) / 2 < _ROUNDING_SHARE * precision_m
    return np.dtype(np.float32 if enough else np.float64)


def _check_room(path: Path, head: bytes, count: int, row_bytes: int) -> None:
    """Check that the disk has room for a file of `count` points, and for a temporary chunk."""
    size = len(head) + count * row_bytes
    piece = min(count, CHUNK_POINTS) * row_bytes
    free = shutil.disk_usage(path.parent).free
    if free < size + piece:
        raise LidarError(
            f"{path} could not be written: it takes {size:,} bytes, and {piece:,} beside it "
            f"meanwhile; the disk has {free:,} bytes free. Make room, or write to another folder."
        )


def write_with_open3d(path: Path, cloud: Cloud, real: np.dtype[np.floating]) -> None:
    """Write a cloud with positions of a type; LidarError if Open3D reports an error."""
    o3d = load_open3d()  # here, because read_cloud does not need it
    points = o3d.t.geometry.PointCloud()
    points.point.positions = o3d.core.Tensor(np.ascontiguousarray(cloud.positions, real))
    # Open3D reads the axes of normals one after the other, and writes other columns in any order.
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
        raise LidarError(f"Open3D cannot write {path.parent}: {error}.") from error
    if not written:
        raise LidarError(f"Open3D cannot write to {path.parent}: check folder and disk.")


def _rows(cloud: Cloud, row: np.dtype[np.void]) -> Records:
    """Return the rows of a file, of the types and in the order of `row`."""
    rows = np.empty(len(cloud), row)
    for axis, values in zip(AXES, cloud.positions.T, strict=True):
        rows[axis] = values
    for column in cloud.table:
        rows[column.in_files] = as_file_type(column, cloud[column.name])
    return rows


def _layout(piece: Path, path: Path, count: int) -> tuple[int, np.dtype[np.void]]:
    """Return start and type of the rows of a written chunk.

    LidarError if rows are missing, because Open3D ignores a full disk.
    """
    try:
        start, stored_count, row = layout(piece)
        if stored_count != count:
            raise ValueError(f"{stored_count:,} of {count:,} points")
    except ValueError as error:
        free = shutil.disk_usage(path.parent).free
        raise LidarError(
            f"{path} could not be written ({error}); the disk has {free:,} bytes free. "
            "Make room, or write to another folder."
        ) from error
    return start, row
