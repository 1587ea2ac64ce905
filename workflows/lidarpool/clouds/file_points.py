"""Points of a cloud's file as they are there: for scenes, with the places of the scanners."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lidarsim.base.allowance import bytes_of, memory
from lidarsim.base.arrays import AnyArray, Floats
from lidarsim.base.errors import LidarError
from lidarsim.scene.files.cloud_scan import CloudScan
from lidarsim.scene.files.noise_points import NOISE_CLASSES, LeftOut
from lidarsim.scene.files.stated_system import StatedSystem

MIN_POINTS = 12  # least points of a scene: a surfel lies in the plane of as many
POINT_BYTES = 700  # peak memory per point while surfels are computed and written
NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
ORIGINS = (("origin_x", "origin_y", "origin_z"),)
# Names of columns in files of various programs; the first name that a file has is read.
INTENSITIES = ("intensity", "scalar_Intensity", "scalar_intensity", "reflectivity", "i")
COLORS = (("red", "green", "blue"), ("colorRed", "colorGreen", "colorBlue"))

Columns = dict[str, AnyArray]  # {name in the file: (n,)}
Vectors = tuple[str, str, str]


@dataclass
class FilePoints:
    """Points in the units of a file, its further columns, and what was read and has no use."""

    positions: Floats  # (n, 3)
    columns: Columns
    scanners: Floats | None = None  # (n, 3): NaN where unknown
    ignored: list[str] = field(default_factory=list)
    system: StatedSystem | None = None  # system that the file states
    in_meters: bool = False  # whether the format has true meters, whatever the system says
    units_m: tuple[float, float, float] | None = None  # units of x, y and z, if a header names them
    noise_classes: tuple[int, ...] = NOISE_CLASSES
    left_out: LeftOut = field(default_factory=LeftOut)  # withheld points and noise
    no_returns: int = 0  # points at zero that are left out
    notes: list[str] = field(default_factory=list)  # clauses that follow the name of the file


def from_columns(columns: Columns) -> FilePoints:
    """Return the content of columns that include x, y and z.

    Raises ValueError if an axis is missing.
    """
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its vertex coordinates are incomplete ({', '.join(missing)} missing)")
    positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    return FilePoints(positions, columns)


def of_scans(scans: Sequence[CloudScan]) -> FilePoints:
    """Return the points of scans, joined in the frame of the file.

    Raises LidarError beyond the memory.
    """
    check_count(sum(len(scan.positions) for scan in scans))
    return replace(joined([_placed(scan) for scan in scans]), units_m=scans[0].units_m)


def _placed(scan: CloudScan) -> FilePoints:
    """Return a scan in the frame of the file, without the pulses that had no return.

    These pulses are points at zero. Fewer than `MIN_POINTS` points at zero remain.
    """
    positions = scan.positions
    columns = scan.columns
    scanner = np.full(3, np.nan) if scan.scanner is None else scan.scanner
    # Drivers write zeros for pulses without a return; a few points at zero may be points.
    is_return = positions.any(axis=1)
    no_returns = int(len(positions) - is_return.sum())
    if no_returns < MIN_POINTS:
        no_returns = 0
    else:
        positions = positions[is_return]
        columns = {name: values[is_return] for name, values in columns.items()}
    if scan.pose is not None:
        rotation = scan.pose[:3, :3]
        offset = scan.pose[:3, 3]
        positions = positions @ rotation.T + offset
        columns |= _rotated(columns, NORMALS, rotation, np.zeros(3))
        columns |= _rotated(columns, ORIGINS, rotation, offset)
    if all(name in columns for name in ORIGINS[0]):
        scanner = np.full(3, np.nan)  # an origin for each ray is more exact
    return FilePoints(
        positions,
        columns,
        np.tile(scanner, (len(positions), 1)),
        list(scan.unread),
        no_returns=no_returns,
        notes=list(scan.notes),
    )


def _rotated(
    columns: Columns, names: Iterable[Vectors], rotation: Floats, offset: Floats
) -> Columns:
    """Return columns of vectors, rotated and moved by an offset."""
    rotated: Columns = {}
    for axes in names:
        if all(name in columns for name in axes):
            vectors = np.stack([columns[name] for name in axes], axis=1).astype(np.float64)
            rotated |= zip(axes, (vectors @ rotation.T + offset).T, strict=True)
    return rotated


def joined(scans: Sequence[FilePoints]) -> FilePoints:
    """Return the content of scans in the frame of one file.

    A quantity that only some scans have is NaN in the others.
    """
    columns_of_scans = [scan.columns for scan in scans]
    if len(scans) > 1:
        columns_of_scans = [_measured(scan.columns) for scan in scans]
    names = dict.fromkeys(name for columns in columns_of_scans for name in columns)
    counts = [len(scan.positions) for scan in scans]
    joined_columns = {}
    for name in names:
        parts = [
            columns.get(name, np.full(count, np.nan))
            for columns, count in zip(columns_of_scans, counts, strict=True)
            if count
        ]
        joined_columns[name] = np.concatenate(parts) if parts else np.zeros(0)
    positions = np.concatenate([scan.positions for scan in scans])
    scanners = np.concatenate([scan.scanners for scan in scans if scan.scanners is not None])
    has_scanner = np.isfinite(scanners).any()
    return FilePoints(
        positions,
        joined_columns,
        scanners if has_scanner else None,
        list(dict.fromkeys(name for scan in scans for name in scan.ignored)),
        no_returns=sum(scan.no_returns for scan in scans),
        notes=list(dict.fromkeys(note for scan in scans for note in scan.notes)),
    )


def _measured(columns: Columns) -> Columns:
    """Return the columns of a scan without intensities and colors that are zero throughout.

    Some programs write zeros for quantities that a scan does not have.
    """
    missing: list[str] = []
    for names in (*((name,) for name in INTENSITIES), *COLORS):
        if {*names} <= columns.keys() and not any(columns[name].any() for name in names):
            missing += names
    return {name: values for name, values in columns.items() if name not in missing}


def check_count(count: int) -> None:
    """Raise LidarError if points would exceed the memory."""
    if (size := count * POINT_BYTES) > memory():
        raise LidarError(
            f"it has {count:,} points, which require {bytes_of(size)} of memory. Downsample "
            "it first."
        )
