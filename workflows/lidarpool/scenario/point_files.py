"""Point clouds in files: positions, where they were seen from, classes, intensities and colours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.base.allowance import Allowance, bytes_of, memory
from lidarsim.base.arrays import AnyArray, Bytes, Floats, Indices, Ints
from lidarsim.base.errors import LidarError, explained, prefixed, unreadable
from lidarsim.base.extras import need
from lidarsim.base.input_files import check_input, input_size, read_input
from lidarsim.base.words import plural, printable
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.scene.files.cloud_scan import CloudScan, with_usual_names
from lidarsim.scene.files.e57_system import e57_system
from lidarsim.scene.files.las import las_system, noise_classes, open_las
from lidarsim.scene.files.mesh_formats import advice_on
from lidarsim.scene.files.noise_points import NOISE_CLASSES, LeftOut, usable_points
from lidarsim.scene.files.polygon_files import ply_comments, read_ply_columns
from lidarsim.scene.files.stated_system import (
    Reprojection,
    StatedSystem,
    check_metric_format,
    stated_metres,
)
from lidarsim.scene.scene_instances import MAX_COORDINATE_M
from lidarsim.scene.transform import affine

MIN_POINTS = 12  # of a scene: a surfel lies in the plane of as many
POINT_BYTES = 700  # peak memory per point while surfels are computed and written
_SAMPLE = 1000  # points that tell whether another system has true metres there
_E57_BYTES = 24  # of the coordinates of a point, at least
# Names of columns in files of various programs; the first name that a file has is read.
_CLASSES = (
    "class", "classification", "scalar_Classification", "scalar_classification", "label",
    "scalar_Label", "scalar_label",
)  # fmt: skip
_INTENSITIES = ("intensity", "scalar_Intensity", "scalar_intensity", "reflectivity", "i")
_COLOURS = (("red", "green", "blue"), ("colorRed", "colorGreen", "colorBlue"))
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_ORIGINS = (("origin_x", "origin_y", "origin_z"),)

Columns = dict[str, AnyArray]  # {name in the file: (n,)}
Vectors = tuple[str, str, str]


@dataclass(frozen=True, eq=False)
class ScannedPoints:
    """Points of a file, in metres, and the quantities that surfels keep; None for those without.

    Attributes
    ----------
    positions
        float64 (n, 3), finite, metres.
    outward
        float64 (n, 3): direction to the scanner, or the normal of the file; zero if unknown.
    classes
        int64 (n,).
    intensities
        float64 (n,), in the scale of the file.
    colours
        uint8 (n, 3), sRGB.
    """

    positions: Floats
    outward: Floats | None = None
    classes: Ints | None = None
    intensities: Floats | None = None
    colours: Bytes | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def take(self, rows: Indices) -> ScannedPoints:
        """Return selected points."""
        return ScannedPoints(
            self.positions[rows],
            None if self.outward is None else self.outward[rows],
            None if self.classes is None else self.classes[rows],
            None if self.intensities is None else self.intensities[rows],
            None if self.colours is None else self.colours[rows],
        )


@dataclass
class _FileContent:
    """Points in the units of a file, its further columns, and what was read and has no use."""

    positions: Floats  # (n, 3)
    columns: Columns
    scanners: Floats | None = None  # (n, 3): NaN where unknown
    ignored: list[str] = field(default_factory=list)
    system: StatedSystem | None = None  # that the file states
    in_metres: bool = False  # whether the format has true metres, whatever the system says
    units_m: tuple[float, float, float] | None = None  # of x, y and z, if a header names them
    noise_classes: tuple[int, ...] = NOISE_CLASSES
    left_out: LeftOut = field(default_factory=LeftOut)  # withheld points and noise
    no_returns: int = 0  # points at zero that are left out


def read_points(
    path: Path,
    unit: str | None,
    tell: Callable[[str], None],
    *,
    epsg: int | None = None,
    keep_noise: bool = False,
) -> ScannedPoints:
    """Return the finite points of a file, in true metres.

    Parameters
    ----------
    path
        A file of `SUFFIXES`.
    unit
        Unit of x, y and z, in place of metres or of the units that a .las or .laz states.
    tell
        Called with lines on converted units, on points that are left out, and on the columns that
        are left out.
    epsg
        Code of the system that points are brought to; by default coordinates are kept.
    keep_noise
        Whether points are kept that the file withholds or classifies as noise.

    Raises
    ------
    LidarError
        If the file cannot be read, is too large, has fewer than `MIN_POINTS` points, or lengths
        that are not true; see `stated_metres` and `Reprojection`.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        if advice := advice_on(path):
            raise LidarError(f"{path} is not read: {advice}.")
        raise LidarError(
            f"{path} has the ending {path.suffix or '(none)'}; point clouds are read from "
            f"{' '.join(SUFFIXES)}."
        )
    try:
        with explained(f"{path} cannot be read"), prefixed(path):
            if not check_input(path):
                raise LidarError("it is empty (0 bytes).")
            content = _READERS[suffix](path)
            if not keep_noise:
                content = _without_noise(path, content, tell)
            points = _scanned_points(content, _to_metres(path, content, unit, epsg, tell))
    except LidarError:
        raise
    except Exception as error:  # readers raise whatever they stumble over
        raise LidarError(unreadable(path, error)) from error
    _check_points(path, points, content.left_out)
    if content.no_returns:
        tell(
            f"{path}: {content.no_returns:,} points at zero are left out, as pulses without a "
            "return"
        )
    if names := _left_out(content):
        tell(f"{path}: not kept, because surfels have no room for them: {', '.join(names)}")
    return points


def _check_points(path: Path, points: ScannedPoints, left_out: LeftOut) -> None:
    """Raise LidarError if there are too few points, or a point is farther than any on Earth."""
    if len(points) < MIN_POINTS and (note := left_out.note()):
        raise LidarError(
            f"{path} has {plural(len(points), 'point')} to use, and at least {MIN_POINTS} are "
            f"needed: {note}."
        )
    if len(points) < MIN_POINTS:
        raise LidarError(
            f"{path} has {plural(len(points), 'point')}, and at least {MIN_POINTS} are needed."
        )
    if (reach := np.abs(points.positions).max()) > MAX_COORDINATE_M:
        raise LidarError(
            f"{path} reaches {reach:.3g} m from zero, farther than anything on Earth: it is "
            "broken, or in another unit (--unit, in Python unit=)."
        )


def _without_noise(path: Path, content: _FileContent, tell: Callable[[str], None]) -> _FileContent:
    """Return content without withheld points and noise; call `tell` with their number."""
    usable, left_out = usable_points(content.columns, content.noise_classes)
    if usable is None:
        return content
    tell(f"{path}: {left_out.note()}")
    return replace(
        content,
        positions=content.positions[usable],
        columns={name: values[usable] for name, values in content.columns.items()},
        scanners=None if content.scanners is None else content.scanners[usable],
        left_out=left_out,
    )


def _to_metres(
    path: Path,
    content: _FileContent,
    unit: str | None,
    epsg: int | None,
    tell: Callable[[str], None],
) -> Callable[[Floats], Floats]:
    """Return a function from positions (n, 3) of a file to true metres; tells what it does."""
    finite = content.positions[np.isfinite(content.positions).all(axis=1)]
    if epsg is not None:
        if unit is not None:
            raise LidarError("epsg takes the units of the file's system: leave out unit.")
        reprojection = Reprojection(content.system, epsg)
        reprojection.check(finite[:: len(finite) // _SAMPLE + 1])
        notes = reprojection.notes
        convert = reprojection.apply
    else:
        if content.in_metres and unit is None:
            notes = check_metric_format(content.system, finite)
            metres = (1.0, 1.0, 1.0)
        elif content.units_m is not None and unit is None:
            metres = content.units_m
            lengths = ", ".join(f"{length:g}" for length in metres)
            notes = [f"was converted to metres: its header names units of {lengths} m"]
        else:
            metres, notes = stated_metres(content.system, finite, unit)
        convert = partial(np.multiply, metres)
    for note in notes:
        tell(f"{path} {note}")
    return convert


def _scanned_points(content: _FileContent, to_metres: Callable[[Floats], Floats]) -> ScannedPoints:
    """Return the finite points of a file's content in metres, with the columns that are kept."""
    columns = content.columns
    positions = to_metres(content.positions)
    colours = _first_vectors(columns, _COLOURS)
    outward = _first_vectors(columns, _NORMALS)
    scanners = content.scanners
    if scanners is None:
        scanners = _first_vectors(columns, _ORIGINS)
    if scanners is not None:
        try:
            outward = to_metres(scanners) - positions
        except LidarError:  # an E57 may have a pose of zeros, which has no place in some systems
            outward = None
            content.ignored.append("positions of scanners without a place in that system")
    classes = _first(columns, _CLASSES)
    intensities = _first(columns, _INTENSITIES)
    points = ScannedPoints(
        positions,
        None if outward is None else np.nan_to_num(outward.astype(np.float64)),
        None if classes is None else _as_integers(classes),
        None if intensities is None else np.nan_to_num(intensities.astype(np.float64)),
        None if colours is None else _as_srgb_bytes(colours),
    )
    # Depth cameras write NaN for pixels without a return.
    finite = np.isfinite(positions).all(axis=1)
    return points if finite.all() else points.take(np.flatnonzero(finite))


def _first(columns: Columns, names: Iterable[str]) -> AnyArray | None:
    """Return the first column that a file has and that is not zero throughout; else None.

    LAS has a column for each quantity, zero where the quantity was not measured.
    """
    present = (columns[name] for name in names if name in columns)
    return next((values for values in present if values.any()), None)


def _first_vectors(columns: Columns, names: Iterable[Vectors]) -> AnyArray | None:
    """Return the first three columns of vectors that a file has, (n, 3); None without any."""
    for axes in names:
        if all(name in columns for name in axes):
            vectors = np.stack([columns[name] for name in axes], axis=1)
            if vectors.any():
                return vectors
    return None


def _as_integers(classes: AnyArray) -> Ints:
    """Return classes as integers; ValueError if a class is no whole number."""
    numbers = classes.astype(np.int64)
    if not np.array_equal(numbers, classes):
        raise ValueError("classes of its points are not whole numbers")
    return numbers


def _as_srgb_bytes(colours: AnyArray) -> Bytes:
    """Return colours (n, 3) as bytes: of 8 or 16 bits, or real numbers from 0 to 1 or 255."""
    if colours.dtype == np.uint8:
        return colours
    values = np.nan_to_num(colours.astype(np.float64))
    highest = values.max()
    if highest <= 1 and colours.dtype.kind == "f":
        values = 255 * values
    elif highest > 255:
        values = values / 257  # 16 bits; several programs write 8 bits into the 16 of LAS
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def _left_out(content: _FileContent) -> list[str]:
    """Return the names of the columns that surfels do not keep and that are not zero."""
    columns = content.columns
    used: set[str] = set()
    for names in (_CLASSES, _INTENSITIES):
        used.update([name for name in names if name in columns][:1])
    for axes in (*_COLOURS, *_NORMALS, *_ORIGINS):
        used.update(axes)
    remaining = [name for name, values in columns.items() if name not in used and np.any(values)]
    return [printable(name) for name in [*remaining, *content.ignored]]


def _from_columns(columns: Columns) -> _FileContent:
    """Return the content of columns that include x, y and z; ValueError if an axis is missing."""
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its vertices have no {', '.join(missing)}")
    positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1).astype(np.float64)
    return _FileContent(positions, columns)


def _read_ply(path: Path) -> _FileContent:
    """Read the vertices of a .ply."""
    data = read_input(path)
    content = _from_columns(with_usual_names(read_ply_columns(data)))
    return replace(content, system=StatedSystem.of_comments(ply_comments(data)))


def _read_scans(path: Path) -> _FileContent:
    """Read a cloud of a format whose reader returns scans, joined in the frame of the file."""
    scans = SCAN_READERS[path.suffix.lower()](path)
    _check_count(sum(len(scan.positions) for scan in scans))
    return replace(_joined([_placed(scan) for scan in scans]), units_m=scans[0].units_m)


def _placed(scan: CloudScan) -> _FileContent:
    """Return a scan in the frame of the file, without the pulses that had no return."""
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
        columns |= _rotated(columns, _NORMALS, rotation, np.zeros(3))
        columns |= _rotated(columns, _ORIGINS, rotation, offset)
    if all(name in columns for name in _ORIGINS[0]):
        scanner = np.full(3, np.nan)  # an origin for each ray is more exact
    return _FileContent(
        positions,
        columns,
        np.tile(scanner, (len(positions), 1)),
        list(scan.unread),
        no_returns=no_returns,
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


def _joined(scans: Sequence[_FileContent]) -> _FileContent:
    """Return the content of scans in the frame of one file.

    A quantity that only some scans have is zero in the others.
    """
    kinds = {name: values.dtype for scan in scans for name, values in scan.columns.items()}
    columns = {
        name: np.concatenate(
            [scan.columns.get(name, np.zeros(len(scan.positions), kind)) for scan in scans]
        )
        for name, kind in kinds.items()
    }
    positions = np.concatenate([scan.positions for scan in scans])
    scanners = np.concatenate([scan.scanners for scan in scans if scan.scanners is not None])
    has_scanner = np.isfinite(scanners).any()
    return _FileContent(
        positions,
        columns,
        scanners if has_scanner else None,
        list(dict.fromkeys(name for scan in scans for name in scan.ignored)),
        no_returns=sum(scan.no_returns for scan in scans),
    )


def _check_count(count: int) -> None:
    """Raise LidarError if points would exceed the memory."""
    if (size := count * POINT_BYTES) > memory():
        raise LidarError(
            f"it has {count:,} points, which take {bytes_of(size)} of memory: thin it first."
        )


def _read_las(path: Path) -> _FileContent:
    """Read the points of a .las or .laz; LidarError if they exceed the memory."""
    system = las_system(path)
    with open_las(path) as reader:
        _check_count(reader.header.point_count)
        points = reader.read_points(-1)
        classes = noise_classes(reader.header)
    names = [name for name in points.point_format.dimension_names if name not in ("X", "Y", "Z")]
    positions = np.stack([points.x, points.y, points.z], axis=1)
    columns = {name: np.asarray(points[name]) for name in names}
    columns = {name: values for name, values in columns.items() if values.ndim == 1}
    return _FileContent(positions, columns, system=system, noise_classes=classes)


def _read_e57(path: Path) -> _FileContent:
    """Read all scans of an E57, joined in the frame of the file, with their scanners' positions."""
    need("pye57", "e57", "it is read")
    file = import_module("pye57").E57(str(path))
    try:
        headers = [file.get_header(number) for number in range(file.scan_count)]
        count = sum(header.point_count for header in headers)
        _check_count(count)
        Allowance(input_size(path), "thin it first").take(_E57_BYTES * count)
        scans = [_read_scan(file, number, header) for number, header in enumerate(headers)]
        system = e57_system(file)
    finally:
        file.close()
    if not scans:
        raise ValueError("it has no scans")
    return replace(_joined(scans), system=system, in_metres=True)


def _read_scan(file: Any, number: int, header: Any) -> _FileContent:
    """Return a scan of an E57 in the frame of the file."""
    columns = file.read_scan_raw(number, ignore_unsupported_fields=True)
    ignored = [name for name in header.point_fields if name not in columns]
    kind = "cartesian" if "cartesianX" in columns else "spherical"
    positions = _positions_of_scan(columns, kind)
    invalid = columns.pop(f"{kind}InvalidState", None)
    if invalid is not None and invalid.any():
        rows = np.flatnonzero(invalid == 0)
        positions = positions[rows]
        columns = {name: values[rows] for name, values in columns.items()}
    scanner = np.full(3, np.nan)
    if header.has_pose():
        pose = affine(header.rotation_matrix, header.translation)
        positions = positions @ pose[:3, :3].T + pose[:3, 3]
        scanner = pose[:3, 3]
    return _FileContent(positions, columns, np.tile(scanner, (len(positions), 1)), ignored)


def _positions_of_scan(columns: Columns, kind: str) -> Floats:
    """Take the coordinates of an E57 scan out of its columns; return Cartesian positions (n, 3)."""
    if kind == "cartesian":
        return np.stack([columns.pop(f"cartesian{axis}") for axis in "XYZ"], axis=1)
    range_m = columns.pop("sphericalRange")
    azimuth = columns.pop("sphericalAzimuth")
    elevation = columns.pop("sphericalElevation")
    across = range_m * np.cos(elevation)
    return np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), range_m * np.sin(elevation)], axis=1
    )


_READERS: dict[str, Callable[[Path], _FileContent]] = {
    ".ply": _read_ply,
    ".las": _read_las,
    ".laz": _read_las,
    ".e57": _read_e57,
    **dict.fromkeys(SCAN_READERS, _read_scans),
}
SUFFIXES = tuple(_READERS)
