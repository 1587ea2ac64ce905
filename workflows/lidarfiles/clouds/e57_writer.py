"""Writer of E57 files with the libE57 bindings of pye57, whose GUIDs are reproducible.

pye57 itself leaves the coordinate system and the creation time empty, and supports neither times,
return numbers nor normals.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pye57
from pye57 import libe57

from lidarsim.numerics.arrays import AnyArray, Floats

NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
_AXES = ("cartesianX", "cartesianY", "cartesianZ")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
# Integer fields with their entries in `indexBounds`.
_INDICES = {"rowIndex": "row", "columnIndex": "column", "returnIndex": "return"}
_MAX_COLOR = 255


class DateTime(NamedTuple):
    """GPS time in seconds, and whether it comes from an atomic clock."""

    gps_s: float
    is_atomic: bool


class ScanHeader(NamedTuple):
    """Description of a scan."""

    name: str
    position: Floats  # (3,), meters
    quaternion: Floats  # (4,), w first
    start: DateTime
    end: DateTime
    max_intensity: float  # upper limit of the intensities; the lower limit is 0


class E57Writer(pye57.E57):
    """A new E57 file.

    Parameters
    ----------
    path
        Path of the file.
    system
        Coordinate system of the poses as WKT, or an empty string.
    created
        Creation time.
    content
        Text from which the GUIDs are derived.
    """

    def __init__(self, path: Path, system: str, created: DateTime, content: str) -> None:
        self._system = system
        self._created = created
        self._content = content
        self._numbers = count()
        self._in_header = False
        super().__init__(str(path), mode="w")

    def write_default_header(self) -> None:
        """Write the header with the coordinate system, the creation time and the GUID."""
        self._in_header = True
        super().write_default_header()
        self._in_header = False

    @property
    def root(self) -> Any:
        """Root node of the file.

        While the header is written, this is a stand-in that intercepts the fields.
        """
        return SimpleNamespace(set=self._set_field) if self._in_header else super().root

    def _set_field(self, name: str, node: Any) -> None:
        # Nodes of pye57 are replaced here, because a field can only be set once.
        replaced = {
            "guid": self._guid,
            "coordinateMetadata": lambda: self._text(self._system),
            "creationDateTime": lambda: self._time(self._created),
        }
        super().root.set(name, replaced[name]() if name in replaced else node)

    def write_scan(self, header: ScanHeader, fields: Mapping[str, AnyArray]) -> None:
        """Append a scan.

        `fields` contains the values of the points by field, each with shape (n,). All fields except
        the Cartesian coordinates are optional.
        """
        scan = libe57.StructureNode(self.image_file)
        scan.set("guid", self._guid())
        scan.set("name", self._text(header.name))
        bounds = {
            f"{bound}{end}": self._integer(int(value))
            for field, bound in _INDICES.items()
            if field in fields
            for end, value in zip(("Minimum", "Maximum"), _limits(fields[field]), strict=True)
        }
        if bounds:
            scan.set("indexBounds", self._structure(bounds))
        if "intensity" in fields:
            limits = (0.0, header.max_intensity)
            scan.set("intensityLimits", self._limits_node(("intensity",), [limits]))
        if {*_COLORS} <= fields.keys():
            scan.set("colorLimits", self._limits_node(_COLORS, [(0, _MAX_COLOR)] * 3))
        box = [_limits(fields[axis]) for axis in _AXES]
        scan.set("cartesianBounds", self._limits_node("xyz", box))
        parts = {"rotation": ("wxyz", header.quaternion), "translation": ("xyz", header.position)}
        pose = {
            part: self._structure(dict(zip(names, map(self._real, values.tolist()), strict=True)))
            for part, (names, values) in parts.items()
        }
        scan.set("pose", self._structure(pose))
        scan.set("acquisitionStart", self._time(header.start))
        scan.set("acquisitionEnd", self._time(header.end))
        self._write_points(scan, fields)

    def _write_points(self, scan: Any, fields: Mapping[str, AnyArray]) -> None:
        """Add the points to a scan node, and the node to the file."""
        prototype = libe57.StructureNode(self.image_file)
        buffers = libe57.VectorSourceDestBuffer()
        arrays = []  # libE57 does not keep the arrays alive
        for field, values in fields.items():
            node, letter = self._field_node(field, values)
            prototype.set(field, node)
            array = np.empty(len(values), letter)  # libE57 takes "l" for 32 bits
            array[:] = values
            arrays.append(array)
            buffer = (self.image_file, field, array, len(array), True, True)
            buffers.append(libe57.SourceDestBuffer(*buffer))
        codecs = libe57.VectorNode(self.image_file, True)
        points = libe57.CompressedVectorNode(self.image_file, prototype, codecs)
        scan.set("points", points)
        self.data3d.append(scan)
        writer = points.writer(buffers)
        writer.write(len(arrays[0]))
        writer.close()

    def _field_node(self, field: str, values: AnyArray) -> tuple[Any, str]:
        """Return the prototype of a field, and the type code of its buffer."""
        low, high = _limits(values)
        if field in _COLORS:
            return libe57.IntegerNode(self.image_file, 0, 0, _MAX_COLOR), "B"
        if values.dtype.kind in "iu":
            return libe57.IntegerNode(self.image_file, int(low), int(low), int(high)), "q"
        if field == "timeStamp":
            return libe57.FloatNode(self.image_file, low, libe57.E57_DOUBLE, low, high), "d"
        if field in _NORMALS:
            return libe57.FloatNode(self.image_file, 0.0, libe57.E57_SINGLE, -1.0, 1.0), "f"
        middle = (low + high) / 2 if field in _AXES else low
        letter = "d" if field in _AXES else "f"
        return libe57.FloatNode(self.image_file, middle, libe57.E57_SINGLE, low, high), letter

    def _guid(self) -> Any:
        number = next(self._numbers)
        return self._text(f"{{{uuid.uuid5(uuid.NAMESPACE_OID, f'{self._content} {number}')}}}")

    def _text(self, text: str) -> Any:
        return libe57.StringNode(self.image_file, text)

    def _real(self, value: float) -> Any:
        return libe57.FloatNode(self.image_file, value)

    def _integer(self, value: int) -> Any:
        return libe57.IntegerNode(self.image_file, value)

    def _time(self, time: DateTime) -> Any:
        fields = {
            "dateTimeValue": self._real(time.gps_s),
            "isAtomicClockReferenced": self._integer(time.is_atomic),
        }
        return self._structure(fields)

    def _structure(self, fields: Mapping[str, Any]) -> Any:
        node = libe57.StructureNode(self.image_file)
        for name, value in fields.items():
            node.set(name, value)
        return node

    def _limits_node(self, names: Any, limits: Any) -> Any:
        """Return a structure with the minimum and the maximum of each name."""
        return self._structure(
            {
                f"{name}{end}": (self._integer if isinstance(value, int) else self._real)(value)
                for name, pair in zip(names, limits, strict=True)
                for end, value in zip(("Minimum", "Maximum"), pair, strict=True)
            }
        )


def _limits(values: AnyArray) -> tuple[float, float]:
    return float(values.min()), float(values.max())
