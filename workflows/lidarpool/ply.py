"""Point clouds as binary PLY: written whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .cloud import Cloud
from .errors import LidarpoolError

# Single precision positions are kept where they err by less than this part of the precision.
_ROUNDING_SHARE = 0.05

_MAGIC = "ply\nformat binary_little_endian 1.0\n"
_HEADER_LIMIT = 65_536
_CHUNK = 1_000_000  # rows compared at a time
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip


def write_cloud(
    path: str | Path,
    positions: ArrayLike,
    scan: ArrayLike,
    ring: ArrayLike,
    object_id: ArrayLike,
    *,
    precision_m: float = 0.01,
) -> int:
    """Write points to a binary PLY file through Open3D.

    The file is written under a temporary name in the same folder, read back and compared,
    flushed to the disk, and only then given its name: there is either the whole new file or
    what was there before. The same points give the same bytes.

    Parameters
    ----------
    path
        The file; its folder must exist.
    positions, scan, ring, object_id
        As in `Cloud`. float64 positions are stored in single precision where that errs by
        less than a twentieth of `precision_m`, else in double.
    precision_m
        What the positions were rounded to, in metres.

    Returns
    -------
    Size of the file in bytes.

    Raises
    ------
    LidarpoolError
        If it cannot be written whole; no temporary file is left.
    """
    path = Path(path)
    cloud = Cloud(
        _narrowed(np.asarray(positions), precision_m),
        np.asarray(scan),
        np.asarray(ring),
        np.asarray(object_id),
    )
    # The ending stays, since Open3D picks the format by it.
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.tmp.ply")
    try:
        _check_target(path, cloud)
        # Made first, with the permissions that the user's umask gives.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        try:
            if len(cloud):
                _write_open3d(temporary, cloud)
            else:
                temporary.write_bytes(_empty_file(cloud))
            size = _verify(temporary, path, cloud)
            _flush(temporary)
            temporary.replace(path)
            _flush(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise LidarpoolError(f"{path} cannot be written: {error.strerror or error}.") from error
    return size


def read_cloud(path: str | Path) -> Cloud:
    """Read a point cloud that `write_cloud` wrote.

    Raises
    ------
    LidarpoolError
        If the file is missing, cut, or not a binary PLY with x, y, z, scan, ring and object.
    """
    path = Path(path)
    try:
        start, count, dtype = _layout(path)
        rows = np.fromfile(path, dtype=dtype, count=count, offset=start)
    except OSError as error:
        raise LidarpoolError(f"{path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise LidarpoolError(f"{path} is not a point cloud of lidarpool: {error}.") from error
    positions = np.stack([rows[axis] for axis in "xyz"], axis=1)
    return Cloud(positions, rows["scan"], rows["ring"], rows["object"])


def _narrowed(positions: NDArray[np.generic], precision_m: float) -> NDArray[np.floating]:
    """Positions in the least precise type that is precise enough."""
    if positions.dtype == np.float32:
        return positions.astype(np.float32, copy=False)
    exact = positions.astype(np.float64, copy=False)
    farthest = np.float32(np.abs(exact).max(initial=0.0))
    if np.isfinite(farthest) and np.spacing(farthest) / 2 < _ROUNDING_SHARE * precision_m:
        return exact.astype(np.float32)
    return exact


def _check_target(path: Path, cloud: Cloud) -> None:
    """Ask before writing: the name, the folder, the room on the disk; OSError if it cannot."""
    if path.is_dir():
        raise LidarpoolError(f"{path} is a folder: give the name of a .ply file.")
    if path.suffix.lower() != ".ply":
        raise LidarpoolError(f"{path} must end in .ply, the format that is written.")
    if not path.parent.is_dir():
        raise LidarpoolError(f"The folder {path.parent} does not exist: make it first.")
    needed = len(_empty_file(cloud)) + len(cloud) * _dtype(cloud).itemsize
    free = shutil.disk_usage(path.parent).free
    if free < needed:
        raise LidarpoolError(
            f"{path} needs {needed:,} bytes and its disk has {free:,} free: make room, or write "
            "to another folder."
        )


def _dtype(cloud: Cloud) -> np.dtype[np.void]:
    """Row of the file that holds `cloud`, in the order in which Open3D writes."""
    real = "<f8" if cloud.positions.dtype == np.float64 else "<f4"
    return np.dtype(
        [(axis, real) for axis in "xyz"] + [("scan", "<i4"), ("ring", "<u2"), ("object", "<i4")]
    )


def _empty_file(cloud: Cloud) -> bytes:
    """File with the properties of `cloud` and no points, which Open3D refuses to write."""
    real = "double" if cloud.positions.dtype == np.float64 else "float"
    lines = [f"property {real} {axis}" for axis in "xyz"]
    lines += ["property int scan", "property uint16 ring", "property int object"]
    body = "\n".join(["comment Created by Open3D", "element vertex 0", *lines, "end_header\n"])
    return (_MAGIC + body).encode("ascii")


def _write_open3d(path: Path, cloud: Cloud) -> None:
    """Write `cloud` to `path`; whether it worked is for the reading back to say."""
    import open3d  # takes a second, and read_cloud needs none of it

    o3d: Any = open3d  # its stubs do not know which arguments its functions take
    points = o3d.t.geometry.PointCloud()
    points.point.positions = o3d.core.Tensor(np.ascontiguousarray(cloud.positions))
    for name in ("scan", "ring", "object"):
        column = np.ascontiguousarray(getattr(cloud, name))[:, None]
        points.point[name] = o3d.core.Tensor(column)
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    try:
        with quiet:
            written = o3d.t.io.write_point_cloud(str(path), points, write_ascii=False)
    except (RuntimeError, UnicodeError) as error:
        raise LidarpoolError(f"Open3D cannot write {path.parent}: {error}.") from error
    if not written:
        raise LidarpoolError(f"Open3D cannot write to {path.parent}: check folder and disk.")


def _verify(temporary: Path, path: Path, cloud: Cloud) -> int:
    """Read a written file back and compare it with `cloud`, bit by bit; returns its size.

    Open3D says True also when the disk was full and the file is cut.
    """
    try:
        start, count, dtype = _layout(temporary)
        if count != len(cloud):
            raise ValueError(f"{count:,} of {len(cloud):,} points")
    except ValueError as error:
        free = shutil.disk_usage(path.parent).free
        raise LidarpoolError(
            f"{path} could not be written whole ({error}); the disk has {free:,} bytes free. "
            "Make room, or write to another folder."
        ) from error
    columns = {axis: cloud.positions[:, i] for i, axis in enumerate("xyz")}
    columns |= {name: getattr(cloud, name) for name in ("scan", "ring", "object")}
    for first in range(0, count, _CHUNK):
        offset = start + first * dtype.itemsize
        rows = np.fromfile(temporary, dtype=dtype, count=min(_CHUNK, count - first), offset=offset)
        for name, column in columns.items():
            if rows[name].tobytes() != column[first : first + len(rows)].tobytes():
                raise LidarpoolError(
                    f"{path} came back from the disk with another {name}: try again."
                )
    return start + count * dtype.itemsize


def _layout(path: Path) -> tuple[int, int, np.dtype[np.void]]:
    """Find where the points of a PLY file begin, how many there are, and the type of a row.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is not a whole binary PLY file with our properties; the message is a clause.
    """
    with path.open("rb") as file:
        head, found, _ = file.read(_HEADER_LIMIT).partition(b"end_header\n")
    text = head.decode("ascii", errors="replace")
    if not found or not text.startswith(_MAGIC):
        raise ValueError("it has no header of a binary little-endian PLY file")
    count, dtype = _parse_header(text)
    start = len(head) + len(found)
    announced, size = start + count * dtype.itemsize, path.stat().st_size
    if size != announced:
        raise ValueError(f"{count:,} points in {announced:,} bytes announced, {size:,} bytes there")
    return start, count, dtype


def _parse_header(text: str) -> tuple[int, np.dtype[np.void]]:
    """Take number and type of the rows from a header; ValueError if they are not ours."""
    elements = [line.split() for line in text.splitlines() if line.startswith("element")]
    properties = [line.split() for line in text.splitlines() if line.startswith("property")]
    if len(elements) != 1 or elements[0][1] != "vertex" or not elements[0][-1].isdigit():
        raise ValueError("it holds more than points, or no points")
    if any(len(entry) != 3 or entry[1] not in _PLY_TYPES for entry in properties):
        raise ValueError("it has list properties or unknown types")
    dtype = np.dtype([(name, _PLY_TYPES[kind]) for _, kind, name in properties])
    missing = {"x", "y", "z", "scan", "ring", "object"} - set(dtype.names or ())
    if missing:
        raise ValueError(f"it lacks {', '.join(sorted(missing))}")
    return int(elements[0][-1]), dtype


def _flush(path: Path) -> None:
    """Wait until the file or folder is on the disk."""
    if os.name == "nt" and path.is_dir():
        return  # Windows has no handle of a folder to flush
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
