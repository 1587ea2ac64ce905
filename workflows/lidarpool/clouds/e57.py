"""E57, a scan for each sweep, through pye57."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pye57
from pye57 import libe57

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import AnyArray, Floats
from lidarsim.base.extras import reading
from lidarsim.base.input_files import input_size
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.table import COLOURS, NORMAL
from lidarsim.scene.files.stated_system import StatedSystem, check_metric_format
from lidarsim.scene.transform import affine
from lidarsim.sweeps.sweeps import Sweeps

from ..base.fingerprint import fingerprint
from .file_points import FilePoints, check_count, joined
from .recording import Read, Recording, RecordingSource, SweepFiles
from .well_known_text import wkt

_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
_THIN = "thin it first"
_POINT_BYTES = 24  # least bytes of the coordinates of a point
_COLUMNS = {
    "colorRed": "red",
    "colorGreen": "green",
    "colorBlue": "blue",
    "rowIndex": "row",
    "columnIndex": "column",
}
_FIELDS = {f"nor:normal{name[-1].upper()}": name for name in NORMAL}  # {field: column}


def write_e57(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write each sweep that has points, in the sensor frame: pose, intensity, colours, normals.

    Poses are in the world, whose coordinate system is stored as WKT.

    Normals are in the extension for surface normals; 0, 0, 0 without a surface.
    """
    content = fingerprint(sweeps, len(cloud), np.asarray(cloud.bounds))
    normals = {*NORMAL} <= {column.name for column in cloud.table}
    file_class, fields = (_WithNormals, _normal_fields) if normals else (_File, nullcontext)
    system = "" if sweeps.epsg is None else wkt(sweeps.epsg)
    with _named_by(content), fields(), file_class(path, system) as file:
        if normals:
            file.image_file.extensionsAdd("nor", _NORMALS_URI)
        try:
            for sweep, points in enumerate(sweeps.points(cloud)):
                if len(points):
                    _write_scan(file, sweeps, sweep, points)
            file.close()
        except libe57.E57Exception as error:
            del file.image_file  # closing it would fail again
            raise OSError(f"{str(error).splitlines()[0]}; the disk may be full") from error


def _write_scan(file: Any, sweeps: Sweeps, sweep: int, points: Cloud) -> None:
    x, y, z = sweeps.compensated(sweep, points).T.copy()
    data = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
    if "intensity" in points.columns:
        data["intensity"] = points["intensity"]
    if {*COLOURS} <= {*points.columns}:
        data |= {f"color{name.capitalize()}": points[name] for name in COLOURS}
    if {*NORMAL} <= {*points.columns}:
        columns = sweeps.columns_compensated(sweep, points)
        data |= {field: np.nan_to_num(columns[name]) for field, name in _FIELDS.items()}
    quaternion = np.roll(sweeps.pose.quaternions[sweep], 1)  # w first
    position = sweeps.pose.positions[sweep]
    file.write_scan_raw(
        data, name=f"sweep {sweep}, motion compensated", rotation=quaternion, translation=position
    )


class _File(pye57.E57):
    """A new file whose header states a coordinate system, which pye57 leaves empty."""

    def __init__(self, path: Path, system: str) -> None:
        self._system = system
        self._in_header = False
        super().__init__(str(path), mode="w")

    def write_default_header(self) -> None:
        """Write the header, with the system as its coordinateMetadata."""
        self._in_header = True
        super().write_default_header()
        self._in_header = False

    @property
    def root(self) -> Any:
        """Root of the file, or an object that takes its fields while the header is written."""
        return SimpleNamespace(set=self._set_field) if self._in_header else super().root

    def _set_field(self, name: str, node: Any) -> None:
        if name == "coordinateMetadata":  # no field can be set twice
            node = libe57.StringNode(self.image_file, self._system)
        super().root.set(name, node)


class _WithNormals(_File):
    """A file whose scans have normals, which pye57 leaves out."""

    def make_buffers(self, field_names: Sequence[str], *arguments: Any, **options: Any) -> Any:
        """Return buffers with the fields of normals added."""
        return super().make_buffers([*field_names, *_FIELDS], *arguments, **options)


@contextmanager
def _normal_fields() -> Iterator[None]:
    """Have pye57 write fields of normals."""
    supported = pye57.e57.SUPPORTED_POINT_FIELDS
    library = pye57.e57.libe57

    def vector_node(image_file: Any, prototype: Any, codecs: Any) -> Any:
        for field in _FIELDS:
            node = libe57.FloatNode(image_file, 0.0, libe57.E57_SINGLE, -1.0, 1.0)
            prototype.set(field, node)
        return libe57.CompressedVectorNode(image_file, prototype, codecs)

    pye57.e57.SUPPORTED_POINT_FIELDS = supported | dict.fromkeys(_FIELDS, "f")
    pye57.e57.libe57 = SimpleNamespace(**vars(libe57) | {"CompressedVectorNode": vector_node})
    try:
        yield
    finally:
        pye57.e57.SUPPORTED_POINT_FIELDS = supported
        pye57.e57.libe57 = library


@contextmanager
def _named_by(content: str) -> Iterator[None]:
    """Derive the GUIDs of a file and its scans from a text, where pye57 draws random GUIDs."""
    numbers = count()
    uuid_module = pye57.e57.uuid
    pye57.e57.uuid = SimpleNamespace(
        uuid4=lambda: uuid.uuid5(uuid.NAMESPACE_OID, f"{content} {next(numbers)}")
    )
    try:
        yield
    finally:
        pye57.e57.uuid = uuid_module


# -- reading ---------------------------------------------------------------------------------


class _Scan(NamedTuple):
    """A scan of an E57 in the axes of its scanner, without its invalid points."""

    positions: Floats  # (n, 3)
    columns: dict[str, AnyArray]  # {field: (n,)}
    pose: Floats | None  # (4, 4), to the frame of the file
    unread: list[str]  # fields that pye57 does not read


def open_file(source: RecordingSource) -> Recording:
    """Open the scans of an E57, each in the axes of its scanner, with its pose."""
    with reading(source.name):
        size = input_size(source.path)
        file = pye57.E57(str(source.path))
        # A column of equal values takes no bytes, whatever the number of points.
        total = Allowance(size, _THIN, in_parts=True)
        for number in range(file.scan_count):
            total.take(_bytes_of_scan(file.get_header(number)))

        def read(number: int) -> Read:
            header = file.get_header(number)
            Allowance(size, _THIN).take(_bytes_of_scan(header))
            scan = _read_scan(file, number, header)
            columns = {_COLUMNS.get(name, name): values for name, values in scan.columns.items()}
            return scan.positions, columns, np.eye(4) if scan.pose is None else scan.pose

        notes: tuple[str, ...] = ()
        epsg = None
        system = _system(file)
        if system is not None and file.scan_count:
            points, _, pose = read(0)
            assert pose is not None  # every scan has a pose
            notes = tuple(check_metric_format(system, points @ pose[:3, :3].T + pose[:3, 3]))
            # Else the points are in no such system.
            epsg = system.epsg if system.horizontal_m == 1.0 else None
        sweeps = SweepFiles(file.scan_count, read, notes=notes, epsg=epsg)
    return source.of_sensors({"": sweeps})


def read_points(path: Path) -> FilePoints:
    """Read all scans, joined in the frame of the file, with their scanners' positions."""
    file = pye57.E57(str(path))
    try:
        headers = [file.get_header(number) for number in range(file.scan_count)]
        point_count = sum(header.point_count for header in headers)
        check_count(point_count)
        Allowance(input_size(path), _THIN).take(_POINT_BYTES * point_count)
        scans = [
            _in_file(_read_scan(file, number, header)) for number, header in enumerate(headers)
        ]
        system = _system(file)
    finally:
        file.close()
    if not scans:
        raise ValueError("it has no scans")
    return replace(joined(scans), system=system, in_metres=True)


def _in_file(scan: _Scan) -> FilePoints:
    """Return a scan in the frame of the file."""
    scanner = np.full(3, np.nan)
    positions = scan.positions
    if scan.pose is not None:
        positions = positions @ scan.pose[:3, :3].T + scan.pose[:3, 3]
        scanner = scan.pose[:3, 3]
    return FilePoints(positions, scan.columns, np.tile(scanner, (len(positions), 1)), scan.unread)


def _read_scan(file: Any, number: int, header: Any) -> _Scan:
    """Read a scan of an open `pye57.E57`."""
    columns = file.read_scan_raw(number, ignore_unsupported_fields=True)
    unread = [name for name in header.point_fields if name not in columns]
    kind = "cartesian" if "cartesianX" in columns else "spherical"
    positions = _positions_of_scan(columns, kind)
    invalid = columns.pop(f"{kind}InvalidState", None)
    if invalid is not None and invalid.any():
        rows = np.flatnonzero(invalid == 0)
        positions = positions[rows]
        columns = {name: values[rows] for name, values in columns.items()}
    pose = affine(header.rotation_matrix, header.translation) if header.has_pose() else None
    return _Scan(positions, columns, pose, unread)


def _positions_of_scan(columns: dict[str, AnyArray], kind: str) -> Floats:
    """Take the coordinates of an E57 scan out of its columns.

    Returns Cartesian positions (n, 3).
    """
    if kind == "cartesian":
        return np.stack([columns.pop(f"cartesian{axis}") for axis in "XYZ"], axis=1)
    range_m = columns.pop("sphericalRange")
    azimuth = columns.pop("sphericalAzimuth")
    elevation = columns.pop("sphericalElevation")
    across = range_m * np.cos(elevation)
    return np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), range_m * np.sin(elevation)], axis=1
    )


def _bytes_of_scan(header: Any) -> int:
    """Return the memory of the columns of a scan of an E57, of 8 bytes a number."""
    return 8 * int(header.point_count) * len(header.point_fields)


def _system(file: Any) -> StatedSystem | None:
    """Return the coordinate system that an open `pye57.E57` states (ASTM E2807, 8.4.2), or None."""
    root = file.root
    if not root.isDefined("coordinateMetadata"):
        return None
    text = str(root["coordinateMetadata"].value()).strip()
    return StatedSystem(text) if text else None
