"""Scans of E57 files, which pye57 writes."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pye57
from pye57 import libe57

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.table import COLORS, NORMAL
from lidarsim.sweeps.sweeps import Sweeps

from ..base.fingerprint import fingerprint
from .e57 import MOVING
from .gps_time import gps_start_s
from .well_known_text import wkt

_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
_FIELDS = {f"nor:normal{name[-1].upper()}": name for name in NORMAL}  # {field: column}


def write_e57(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write the scans of a cloud (`E57`)."""
    content = fingerprint(sweeps, len(cloud), np.asarray(cloud.bounds))
    normals = {*NORMAL} <= {column.name for column in cloud.table}
    file_class, fields = (_WithNormals, _normal_fields) if normals else (_File, nullcontext)
    system = "" if sweeps.epsg is None else wkt(sweeps.epsg)
    highest = _highest_intensity(cloud)
    with _named_by(content), fields(), file_class(path, system, sweeps) as file:
        if normals:
            file.image_file.extensionsAdd("nor", _NORMALS_URI)
        try:
            for sweep, points in enumerate(sweeps.points(cloud)):
                if len(points):
                    _write_scan(file, sweeps, sweep, points, highest)
            file.close()
        except libe57.E57Exception as error:
            del file.image_file  # closing it would fail again
            raise OSError(f"{str(error).splitlines()[0]}. The disk may be full") from error


def _highest_intensity(cloud: CloudLike) -> float:
    """Return the highest intensity of a cloud, or 0 without intensities."""
    if all(column.name != "intensity" for column in cloud.table):
        return 0.0
    chunks = cloud.chunks()
    return max((float(chunk["intensity"].max(initial=0)) for chunk in chunks), default=0.0)


def _write_scan(
    file: Any, sweeps: Sweeps, sweep: int, points: Cloud, highest_intensity: float
) -> None:
    positions = sweeps.compensated(sweep, points)
    x, y, z = positions.T.copy()
    data = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
    if "intensity" in points.columns:
        data["intensity"] = points["intensity"]
    if {*COLORS} <= {*points.columns}:
        data |= {f"color{name.capitalize()}": points[name] for name in COLORS}
    if {*NORMAL} <= {*points.columns}:
        columns = sweeps.columns_compensated(sweep, points)
        data |= {field: np.nan_to_num(columns[name]) for field, name in _FIELDS.items()}
    quaternion = np.roll(sweeps.pose.quaternions[sweep], 1)  # w first
    position = sweeps.pose.positions[sweep]
    start_s = gps_start_s(sweeps)
    # Fields that pye57 would fill with zeros, with the limits of each scan, or with corners of the
    # bounds in world coordinates, which the format has in the frame of the points.
    header: dict[str, Any] = {
        "acquisitionStart_dateTimeValue": start_s + float(sweeps.begins_ns[sweep]) / 1e9,
        "acquisitionEnd_dateTimeValue": start_s + float(sweeps.ends_ns[sweep]) / 1e9,
        "acquisitionStart_isAtomicClockReferenced": sweeps.start_ns is not None,
        "acquisitionEnd_isAtomicClockReferenced": sweeps.start_ns is not None,
        "intensityMinimum": 0.0,
        "intensityMaximum": highest_intensity,
    }
    for axis, low, high in zip("xyz", positions.min(axis=0), positions.max(axis=0), strict=True):
        header |= {f"{axis}Minimum": float(low), f"{axis}Maximum": float(high)}
    file.write_scan_raw(
        data,
        name=_scan_name(sweeps, sweep),
        rotation=quaternion,
        translation=position,
        scan_header=SimpleNamespace(**header),
    )


def _scan_name(sweeps: Sweeps, sweep: int) -> str:
    """Return the name of a scan, such as "station 3" or "roof, sweep 1, motion compensated"."""
    sensor = sweeps.sensor[sweep]
    number = int(sweeps.numbers[sweep])
    per_station = int(np.count_nonzero(sweeps.sensor == sensor)) // sweeps.stations
    parts = [sweeps.sensors[sensor]] if len(sweeps.sensors) > 1 else []
    is_standing = not len(sweeps.knots)
    if is_standing:
        parts.append(f"station {max(int(sweeps.station_numbers[sweep]), 1)}")
    if not is_standing or per_station > 1:
        parts.append(f"sweep {number % per_station + 1}")
    return ", ".join(parts) + ("" if is_standing else MOVING)


class _File(pye57.E57):
    """A new file whose header states coordinate system and time, which pye57 leaves empty."""

    def __init__(self, path: Path, system: str, sweeps: Sweeps) -> None:
        self._system = system
        self._sweeps = sweeps
        self._in_header = False
        super().__init__(str(path), mode="w")

    def write_default_header(self) -> None:
        """Write the header, with the system as coordinateMetadata, and the creation time."""
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
        if name == "creationDateTime":
            has_start = self._sweeps.start_ns is not None
            time = libe57.FloatNode(self.image_file, gps_start_s(self._sweeps))
            node = libe57.StructureNode(self.image_file)
            node.set("dateTimeValue", time)
            node.set("isAtomicClockReferenced", libe57.IntegerNode(self.image_file, has_start))
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
