"""Read IFC buildings (.ifc and .ifczip) with ifcopenshell (LGPL-3.0-or-later).

`ifc_child.py` reads the files in a separate process. The shapes of elements come from the geometry
iterator of ifcopenshell, with openings cut out.
"""

from __future__ import annotations

import math
import re
import sys
from collections import defaultdict
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from lidarsim.environment.extras import install_command
from lidarsim.io.allowance import UNPACKED_TIMES, Allowance, memory_share
from lidarsim.numerics.arrays import AnyArray, Floats
from lidarsim.numerics.elementary import arctan2
from lidarsim.scene.colors import Colors, as_bytes
from lidarsim.scene.files.coordinate_systems import (
    center_of,
    includes_offset,
    scale_problem,
    world_advice,
)
from lidarsim.scene.files.las_units import unit_by_name
from lidarsim.scene.files.scene_graph import (
    Content,
    MeshFileError,
    ObjectClass,
    Piece,
    PlacedNode,
    ReadOptions,
    join_pieces,
    placed_content,
)
from lidarsim.scene.masks import MaskNotes
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.declared import Several, Text, about
from lidarsim.words import plural

from .child_process import ReaderProcess

# {number: (name, IFC classes, including their subclasses)}. Numbers are ASPRS LAS 1.4 classes.
# Numbers from 64 on are user-defined, and 64 to 72 are used for roads.
_CLASSES: dict[int, tuple[str, tuple[str, ...]]] = {
    2: (
        "ground",
        ("IfcSite", "IfcGeographicElement", "IfcGeotechnicalElement", "IfcEarthworksElement"),
    ),
    73: ("wall", ("IfcWall", "IfcCurtainWall", "IfcPlate")),
    74: ("slab", ("IfcSlab",)),
    75: ("covering", ("IfcCovering",)),
    76: ("roof", ("IfcRoof",)),
    77: ("column or beam", ("IfcColumn", "IfcBeam", "IfcMember")),
    78: ("door", ("IfcDoor",)),
    79: ("window", ("IfcWindow",)),
    80: ("stair or ramp", ("IfcStair", "IfcStairFlight", "IfcRamp", "IfcRampFlight")),
    81: ("railing", ("IfcRailing",)),
    82: ("furniture", ("IfcFurnishingElement",)),
    83: ("pipe, duct or device", ("IfcDistributionElement",)),
}
_OTHER_CLASS = (1, "unclassified")

MIN_MEMORY_BYTES = 1024 * 2**20  # memory that the ifcopenshell process may use for any file
MEMORY_TIMES = 30  # additional memory as a multiple of the file size
_END = b"END-ISO-10303-21"
_END_BYTES = 200  # number of bytes in which the end mark must be found
_MAX_SCALE_ERROR = 0.1  # a larger deviation from 1 means that units do not match
_MAP_NUMBERS = (
    "Eastings",
    "Northings",
    "OrthogonalHeight",
    "XAxisAbscissa",
    "XAxisOrdinate",
    "Scale",
    "FactorX",
    "FactorY",
    "FactorZ",
)
_ADVICE = "export it in parts"
_EMPTY = "contains no elements with geometry, such as walls or slabs, in the selected storeys"


@dataclass(frozen=True)
class IfcOptions:
    """Options for reading IFC buildings."""

    storeys: Annotated[
        Annotated[Several[Text], Field(min_length=1)] | None,
        about("names of the storeys whose elements are read (default: all; .ifc only)"),
    ] = None


def read_ifc(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the elements of a building, optionally only those on certain storeys."""
    own: IfcOptions = options.own
    storeys = own.storeys
    is_packed = path.suffix.lower() == ".ifczip"
    if not is_packed and b"ISO-10303-21" not in data:
        raise ValueError("it does not start with ISO-10303-21")
    if find_spec("ifcopenshell") is None:
        command = install_command("lidarpool[ifc]")
        raise MeshFileError(
            f"is an IFC file, which requires ifcopenshell. Install it with `{command}`"
        )
    if sys.platform == "win32":  # memory limits of processes are not supported
        raise MeshFileError("is an IFC file, which is not supported on Windows. Export it as .glb")
    if not is_packed:
        _check_end(path)
    size = path.stat().st_size
    allowance = Allowance(size, _ADVICE)
    # Packed files have about a tenth of the size.
    memory = MIN_MEMORY_BYTES + MEMORY_TIMES * (10 * size if is_packed else size)
    child = ReaderProcess(
        Path(__file__).with_name("ifc_child.py"),
        "ifcopenshell",
        min(memory, MIN_MEMORY_BYTES + memory_share()),
        path.parent,
        hidden=("IFCOPENSHELL_",),
    )
    request = {
        "storeys": None if storeys is None else list(storeys),
        "max_unpacked": min(UNPACKED_TIMES * size, memory_share()),
    }
    shapes = _Shapes(options, allowance)
    building: dict[str, Any] = {}
    with closing(child.frames(path, request, lambda _, size: allowance.reserve(size))) as frames:
        for frame, arrays in frames:
            match frame["what"]:
                case "schema":
                    raise MeshFileError(
                        f"uses the IFC schema {frame['schema']!r}, but only "
                        f"{', '.join(frame['read'])} are supported. Export it with one of these "
                        "schemas"
                    )
                case "building":
                    building = frame
                    _check_storeys(storeys, frame["storeys"])
                case "shape":
                    shapes.add(frame, arrays)
                case "elements":
                    return _content(building, frame, arrays[0], shapes)
    raise ValueError("ifcopenshell returned no elements")


def _check_end(path: Path) -> None:
    """Check that a file is complete, because ifcopenshell reads truncated files silently."""
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - _END_BYTES, 0))
        if _END not in stream.read():
            raise ValueError("the end of the file is missing")


def _check_storeys(wanted: Sequence[str] | None, storeys: list[str]) -> None:
    """Check that a building has all requested storeys.

    Otherwise, raises MeshFileError with the names of its storeys.
    """
    missing = [name for name in wanted or () if name not in storeys]
    if missing:
        names = ", ".join(repr(name[:80]) for name in dict.fromkeys(storeys[:50]))
        if not names:
            raise MeshFileError("has no storeys. Remove the option `storeys`")
        raise MeshFileError(f"has no storey {missing[0][:80]!r}. Its storeys are {names}")


class _Shapes:
    """The meshes of all shapes in a file. Elements can share a shape."""

    def __init__(self, options: ReadOptions, allowance: Allowance) -> None:
        self.notes = MaskNotes()
        self._options = options
        self._allowance = allowance
        self._frames: list[tuple[dict[str, Any], list[AnyArray]]] = []
        self._meshes: dict[tuple[int, str], list[SceneMesh]] = {}

    def add(self, frame: dict[str, Any], arrays: list[AnyArray]) -> None:
        self._frames.append((frame, arrays))

    def meshes(self, number: int, name: str, plain_material: str) -> list[SceneMesh]:
        """Return a shape as a list with one mesh, or an empty list if it has no triangles.

        `plain_material` is the material name for faces without a style.
        """
        key = (number, plain_material if self._options.materials else "")
        if key not in self._meshes:
            self._meshes[key] = self._mesh(number, name, plain_material)
        return self._meshes[key]

    def _mesh(self, number: int, name: str, plain_material: str) -> list[SceneMesh]:
        """Return the mesh of a shape, with colors and materials if requested."""
        frame, (vertices, faces, styles) = self._frames[number]
        pieces = []
        for style in np.unique(styles).tolist():
            style_faces = faces[styles == style].astype(np.int64)
            material: dict[str, Any] = {"name": plain_material, "color": None, "transparency": 0}
            if 0 <= style < len(frame["materials"]):
                material = frame["materials"][style]
            if material["transparency"] > 0 and self._options.masks:
                self.notes.glass[material["name"]] = None
            colors = None
            if self._options.colors and material["color"] is not None:
                color = as_bytes(material["color"]).reshape(1, 1, 3)
                colors = Colors.plain(color, len(style_faces))
            material_name = material["name"] or plain_material if self._options.materials else ""
            pieces.append(Piece(vertices, style_faces, None, colors, material_name))
        return join_pieces(name, pieces, self._allowance)


def _content(
    building: dict[str, Any], frame: dict[str, Any], matrices: AnyArray, shapes: _Shapes
) -> Content:
    """Place the shapes of all elements, and add object classes and notes."""
    placed = [
        PlacedNode(mesh, matrix, name)
        for (name, _, number, material), matrix in zip(frame["elements"], matrices, strict=True)
        for mesh in shapes.meshes(number, name, material)
    ]
    missing = ""
    if count := frame["missing_count"]:
        names = ", ".join(map(repr, frame["missing"])) + ", …" * (count > len(frame["missing"]))
        missing = (
            f"{plural(count, 'element')} that ifcopenshell cannot convert to triangles: {names}"
        )
    if not placed:
        raise MeshFileError(f"contains only {missing}" if missing else _EMPTY)
    content = placed_content(placed)
    content.unit_m = 1.0
    content.up_axis = "z"
    content.classes = _classes({row[1] for row in frame["elements"]}, frame["ancestors"])
    content.notes = [*_reference_notes(building, center_of(content.meshes)), *shapes.notes.lines()]
    if missing:
        content.notes.append(f"was read without {missing}")
    if building["errors"]:
        content.notes.append(
            f"contains {plural(building['errors'], 'error')} that ifcopenshell ignored. The "
            f"first error is: {building['first_error']}"
        )
    if not building["unit_stated"]:
        content.unit_note = "does not specify a length unit. Meters are assumed, as in ifcopenshell"
    return content


def _classes(names: set[str], ancestors: dict[str, list[str]]) -> dict[int, ObjectClass]:
    """Return the semantic classes that correspond to the IFC classes in a file."""
    patterns: dict[tuple[int, str], list[str]] = defaultdict(list)
    for name in sorted(names):
        matches = (
            (number, title)
            for number, (title, members) in _CLASSES.items()
            if not set(members).isdisjoint(ancestors[name])
        )
        patterns[next(matches, _OTHER_CLASS)].append(f"{name} *")
    return {
        number: ObjectClass(title, tuple(rows))
        for (number, title), rows in sorted(patterns.items())
    }


def _reference_notes(building: dict[str, Any], middle: Floats) -> list[str]:
    """Return notes on the coordinate system stated in a file.

    `middle` (2,) is the center of the building in plan.
    """
    stated = building["map"]
    if stated is None:
        if building["site"] is None:
            return []
        latitude, longitude = building["site"]
        position = (
            f"{abs(latitude):.6g}° {'S' if latitude < 0 else 'N'}, "
            f"{abs(longitude):.6g}° {'W' if longitude < 0 else 'E'}"
        )
        return [f"contains a site position, {position}, which was ignored"]
    try:
        conversion = _MapConversion.from_file(stated)
    except ValueError as error:
        return [f"contains a map conversion that cannot be used because {error}"]
    epsg = re.search(r"(?i)\bepsg:{1,2}(\d{4,6})\b", conversion.system)
    system = f"EPSG:{epsg[1]}" if epsg else repr(conversion.system)
    offset_m = np.array(conversion.offset[:2]) * conversion.unit_m
    if includes_offset(middle, offset_m):
        where = system if conversion.system else "its coordinate system"
        return [
            f"is already in {where}. It also contains a map conversion with the same offset, which "
            "must not be applied again"
        ]
    if conversion.is_identity:
        if problem := scale_problem(system, *middle.tolist()) if epsg else "":
            return [f"uses {system}, {problem}"]
        return (
            [f"uses EPSG:{epsg[1]}. To write this code to LAS files, use <world.epsg={epsg[1]}>"]
            if epsg
            else []
        )
    return [_conversion_note(conversion, system, is_known=epsg is not None)]


def _conversion_note(conversion: _MapConversion, system: str, *, is_known: bool) -> str:
    """Describe a map conversion that moves, rotates, or scales a building.

    `is_known` states whether `system` is an EPSG code.
    """
    where = system if conversion.system else "its coordinate system"
    x, y, z = (number * conversion.unit_m for number in conversion.offset)
    if (
        problem := scale_problem(system, *conversion.offset[:2], in_system=False)
        if is_known
        else ""
    ):
        where += f", {problem}, unlike the meter of the building"
    moves = [f"translation [{x:.12g}, {y:.12g}, {z:.9g}]"]
    if conversion.heading_deg:
        moves.append(f"rotation_deg [0, 0, {conversion.heading_deg:.9g}]")
    if not conversion.is_true:
        scales = dict.fromkeys(f"{scale:.9g}" for scale in conversion.scales)
        moves.append(f"scale {next(iter(scales)) if len(scales) == 1 else _scale_list(conversion)}")
    all_of_it = "" if moves[1:] else f". {world_advice(x, y, z)}"
    ignored = ""
    if conversion.ignores_scale:
        ignored = (
            ". Its Scale of 1 does not convert project units to map units. The scale was ignored, "
            "and the units were used instead"
        )
    in_unit = "" if conversion.unit_m == 1 else " in meters"
    return (
        "contains a map conversion, which was not applied. To move the building to "
        f"{where}{in_unit}, use {' and '.join(moves)}{all_of_it}{ignored}"
    )


def _scale_list(conversion: _MapConversion) -> str:
    return f"[{', '.join(f'{scale:.9g}' for scale in conversion.scales)}]"


@dataclass(frozen=True)
class _MapConversion:
    """A building's map conversion, after validation."""

    system: str  # name of the coordinate system, or empty
    unit_m: float  # meters in the unit of the map
    offset: tuple[float, float, float]  # eastings, northings, height in the unit of the map
    heading_deg: float
    scales: tuple[float, float, float]  # along x, y and z, without the conversion of units
    ignores_scale: bool  # whether the stated scale is 1 although units differ

    @classmethod
    def from_file(cls, stated: dict[str, Any]) -> _MapConversion:
        """Validate the conversion that a file states.

        The map unit is that of the coordinate system. If none is stated, it is either meters or the
        project unit, whichever makes the scale close to 1. Without a scale, it is the project unit.
        A missing scale means that only units are converted. Raises ValueError if the conversion is
        inconsistent.
        """
        if stated["count"] > 1:
            raise ValueError(
                f"the file contains {stated['count']} property sets with different values for it"
            )
        if stated.get("is_angle"):
            raise ValueError("it is in longitude and latitude instead of meters")
        numbers = {name: _number(stated, name) for name in _MAP_NUMBERS}
        project_m = stated["unit_m"]
        scale = numbers["Scale"] or None
        unit_m = _map_unit_m(stated["map_unit"], project_m, scale)
        true_scale = 1.0 if scale is None else scale * unit_m / project_m
        ignores_scale = scale == 1 and abs(true_scale - 1) >= _MAX_SCALE_ERROR
        if ignores_scale:
            true_scale = 1.0
        elif not abs(true_scale - 1) < _MAX_SCALE_ERROR:
            raise ValueError(f"its scale, {true_scale:g}, is not consistent with its units")
        x, y, z = (true_scale * (numbers[f"Factor{axis}"] or 1.0) for axis in "XYZ")
        east, north, height = (numbers[name] or 0.0 for name in _MAP_NUMBERS[:3])
        abscissa = numbers["XAxisAbscissa"] or 0.0
        ordinate = numbers["XAxisOrdinate"] or 0.0
        return cls(
            str(stated["system"] or "")[:80],
            unit_m,
            (east, north, height),
            math.degrees(float(arctan2(ordinate, abscissa))),
            (x, y, z),
            ignores_scale,
        )

    @property
    def is_true(self) -> bool:
        """Whether lengths in the building are the same as on the map."""
        return all(abs(scale - 1) <= 1e-9 for scale in self.scales)

    @property
    def is_identity(self) -> bool:
        """Whether building coordinates equal map coordinates, apart from the unit."""
        return self.is_true and not any(self.offset) and not self.heading_deg


def _number(stated: dict[str, Any], name: str) -> float | None:
    """Return a number from a map conversion, or None if it is not stated.

    Property sets may contain it as text.
    """
    value = stated.get(name)
    if value is None or value == "":
        return None
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} is {str(value)[:40]!r}, which is not a number")
    return number


def _map_unit_m(unit: float | str | None, project_m: float, scale: float | None) -> float:
    """Return the length of a map unit in meters. Without a unit, infer it from the scale."""
    if isinstance(unit, str):
        unit_m = unit_by_name(unit)
        if unit_m is None:
            raise ValueError(f"its map unit {unit[:40]!r} is not a known length unit")
        return unit_m
    if unit is not None:
        return unit
    fits_project = scale is None or abs(scale - 1) < _MAX_SCALE_ERROR
    fits_meters = scale is not None and abs(scale / project_m - 1) < _MAX_SCALE_ERROR
    return 1.0 if fits_meters and not fits_project else project_m
