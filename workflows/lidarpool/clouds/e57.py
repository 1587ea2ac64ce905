"""E57, a scan for each sweep, through pye57."""

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
from lidarsim.columns.table import COLOURS, NORMAL
from lidarsim.sweeps.sweeps import Sweeps

from ..base.fingerprint import fingerprint
from .well_known_text import wkt

_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
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
        """Root of the file; while the header is written, an object that takes its fields."""
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
