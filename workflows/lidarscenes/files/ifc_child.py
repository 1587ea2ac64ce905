"""Script that `ifc.py` runs in a separate process to read an IFC building with ifcopenshell.

Invalid files can crash ifcopenshell, but this only affects the separate process. The script imports
nothing from lidarpool. It writes frames to standard output (see `child_process.py`): first the
building, then each shape that elements share, and finally the elements.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import sys
import zipfile
from collections.abc import Iterable
from typing import Any

import ifcopenshell
import ifcopenshell.geom
import numpy as np
from ifcopenshell.util.unit import calculate_unit_scale, get_unit_scale
from numpy.typing import NDArray

MAX_WAIT_S = 300  # time limit between two shapes; invalid files may never finish
_MAX_PARENTS = 100  # maximum depth of an element in a building; invalid files have cycles

_HEAD_BYTES = 2**16  # number of bytes in which the header must be found
_SCHEMA = re.compile(rb"FILE_SCHEMA\s*\(\s*\(\s*'([^']*)'", re.IGNORECASE)
# Schemas that are equivalent to a schema that the library supports. They differ only in attributes
# that do not affect shapes, and in the order of Normals and Closed in triangulated face sets, which
# are not used. The drafts of IFC4X3, _RC1 to _RC4, have more differences.
_SAME_SCHEMAS = {
    "IFC2X3_FINAL": "IFC2X3",
    "IFC2X3_TC1": "IFC2X3",
    "IFC4_ADD1": "IFC4",
    "IFC4_ADD2": "IFC4",
    "IFC4_ADD2_TC1": "IFC4",
    "IFC4X3": "IFC4X3_ADD2",
    "IFC4X3_ADD1": "IFC4X3_ADD2",
    "IFC4X3_TC1": "IFC4X3_ADD2",
}

# Classes, including their subclasses, whose shapes do not reflect light.
_UNREAD = {
    "IfcSpatialElement",
    "IfcSpatialStructureElement",  # type of IFC2X3
    "IfcFeatureElementSubtraction",  # openings
    "IfcAnnotation",
    "IfcGrid",
    "IfcVirtualElement",
    "IfcPort",
    "IfcPositioningElement",
    "IfcLinearPositioningElement",
    "IfcStructuralActivity",
    "IfcStructuralItem",
}
_TERRAIN = "IfcSite"
# Relations of an element, as its attribute and the attribute of the relation that refers to the
# parent.
_PARENTS = (
    ("ContainedInStructure", "RelatingStructure"),
    ("Decomposes", "RelatingObject"),
    ("Nests", "RelatingObject"),
    ("FillsVoids", "RelatingOpeningElement"),
    ("VoidsElements", "RelatingBuildingElement"),
    ("AdheresToElement", "RelatingElement"),
)
# Property sets that replace IfcMapConversion and IfcProjectedCRS in IFC2X3, in lower case.
_CONVERSION_SET = "epset_mapconversion"
_SYSTEM_SET = "epset_projectedcrs"
_MAP_NUMBERS = (
    "Eastings",
    "Northings",
    "OrthogonalHeight",
    "XAxisAbscissa",
    "XAxisOrdinate",
    "Scale",
)


class Building:
    """The elements in an IFC file."""

    def __init__(self, path: str, request: dict[str, Any], write: Any) -> None:
        self._file = _open(path, request["max_unpacked"])
        errors = [line for line in ifcopenshell.get_log().splitlines() if line.startswith("[error")]
        self._errors = [re.sub(r"^(\[[^]]*\] *)+", "", line)[:150] for line in errors]
        self._schema = ifcopenshell.schema_by_name(self._file.schema_identifier)
        self._storeys = request["storeys"]
        self._write = write
        self._ancestors: dict[str, list[str]] = {}  # {class: itself and its superclasses}

    def read(self) -> None:
        """Write all frames that describe the building."""
        storeys = self._file.by_type("IfcBuildingStorey")
        self._write(
            {
                "what": "building",
                "storeys": [storey.Name or storey.GlobalId for storey in storeys],
                "errors": len(self._errors),
                "first_error": next(iter(self._errors), ""),
                "unit_stated": self._states_unit(),
                "map": self._map_conversion(),
                "site": self._position_of_site(),
            }
        )
        elements = {element.id(): element for element in self._elements()}
        if elements:
            self._write_shapes(elements)
        else:
            self._write_elements([], [], [])

    def _elements(self) -> Iterable[Any]:
        """Yield the elements on the requested storeys whose shapes reflect light."""
        for product in self._file.by_type("IfcProduct"):
            ancestors = self._ancestors_of(product.is_a())
            if product.Representation is None:
                continue
            if not _UNREAD.isdisjoint(ancestors) and _TERRAIN not in ancestors:
                continue
            if self._storeys is None or self._storey_of(product) in self._storeys:
                yield product

    def _ancestors_of(self, name: str) -> list[str]:
        """Return the names of a class and all of its superclasses."""
        if name not in self._ancestors:
            names = []
            declaration = self._schema.declaration_by_name(name).as_entity()
            while declaration:
                names.append(declaration.name())
                declaration = declaration.supertype()
            self._ancestors[name] = names
        return self._ancestors[name]

    def _storey_of(self, element: Any) -> str | None:
        """Return the name of the storey that contains an element, or None."""
        for _ in range(_MAX_PARENTS):
            if element is None:
                return None
            if element.is_a("IfcBuildingStorey"):
                return str(element.Name or element.GlobalId)
            element = _parent(element)
        raise ValueError("the containment of its elements is circular")

    def _write_shapes(self, elements: dict[int, Any]) -> None:
        """Write each distinct shape, followed by the elements."""
        settings = ifcopenshell.geom.settings()
        settings.set("no-normals", True)
        settings.set("apply-default-materials", False)
        iterator = ifcopenshell.geom.iterator(
            settings, self._file, 1, include=list(elements.values())
        )
        shapes: dict[str, int] = {}  # {id of a shape: number of its frame}
        matrices = []
        rows = []
        is_valid = iterator.initialize()
        while is_valid:
            placed = iterator.get()
            geometry = placed.geometry
            element = elements.get(placed.id)
            # A wall that an opening removes completely has a shape without triangles.
            if element is not None and len(geometry.faces_buffer):
                if geometry.id not in shapes:
                    shapes[geometry.id] = len(shapes)
                    self._write_shape(geometry)
                rows.append(
                    [_name(element), element.is_a(), shapes[geometry.id], _material_of(element)]
                )
                matrices.append(np.frombuffer(placed.transformation_buffer, np.float64))
                elements.pop(placed.id)
            is_valid = iterator.next()
        # Sites may have an outline without a terrain.
        missing = [_name(item) for item in elements.values() if not item.is_a(_TERRAIN)]
        self._write_elements(rows, matrices, missing)

    def _write_elements(
        self, rows: list[Any], matrices: list[NDArray[Any]], missing: list[str]
    ) -> None:
        """Write the frame with all elements, including the names of elements without triangles."""
        self._write(
            {
                "what": "elements",
                "elements": rows,
                "ancestors": self._ancestors,
                "missing": missing[:3],
                "missing_count": len(missing),
            },
            np.array(matrices).reshape(-1, 4, 4).transpose(0, 2, 1),
        )

    def _write_shape(self, geometry: Any) -> None:
        """Write a shape's triangles and materials."""
        faces = np.frombuffer(geometry.faces_buffer, np.int32).reshape(-1, 3)
        # The styles of triangles are followed by those of curves.
        styles = np.frombuffer(geometry.material_ids_buffer, np.int32)[: len(faces)]
        self._write(
            {
                "what": "shape",
                "materials": [self._material(style) for style in geometry.materials],
            },
            np.frombuffer(geometry.verts_buffer, np.float64).reshape(-1, 3),
            faces,
            styles,
        )

    def _material(self, style: Any) -> dict[str, Any]:
        """Return a style's name, color, and transparency.

        The color is None if it is not stated.
        """
        color = style.get_color()
        rgb = [color.r(), color.g(), color.b()]
        transparency = style.transparency
        number = style.instance_id()
        name = getattr(self._file.by_id(number), "Name", None) if number > 0 else None
        return {
            "name": name or "",
            "color": rgb if np.isfinite(rgb).all() else None,
            "transparency": transparency if np.isfinite(transparency) else 0.0,
        }

    def _states_unit(self) -> bool:
        """Return True if the project specifies a length unit."""
        units = [unit for entry in self._file.by_type("IfcUnitAssignment") for unit in entry.Units]
        return any(getattr(unit, "UnitType", None) == "LENGTHUNIT" for unit in units)

    def _map_conversion(self) -> dict[str, Any] | None:
        """Return the map conversion with the values in the file, or None without a conversion.

        Entities take precedence over the property sets that replace them in IFC2X3. `ifc.py`
        validates and converts the values.
        """
        if not self._file.by_type("IfcProject"):
            return None
        stated = self._stated_operation() or self._stated_sets()
        if stated is None:
            return None
        return {"unit_m": calculate_unit_scale(self._file), "count": 1} | stated

    def _stated_operation(self) -> dict[str, Any] | None:
        """Return the first coordinate operation, or None. Only IFC4 and later have this class."""
        try:
            operations = self._file.by_type("IfcCoordinateOperation")
        except RuntimeError:  # IFC2X3 has no such class
            return None
        if not operations:
            return None
        operation = operations[0]
        system = operation.TargetCRS
        unit = getattr(system, "MapUnit", None)
        stated = {
            "system": getattr(system, "Name", None),
            "map_unit": None if unit is None else get_unit_scale(unit),
        }
        if operation.is_a("IfcRigidOperation"):
            coordinates = (operation.FirstCoordinate, operation.SecondCoordinate)
            return stated | {
                "Eastings": coordinates[0].wrappedValue,
                "Northings": coordinates[1].wrappedValue,
                "OrthogonalHeight": operation.Height,
                "is_angle": coordinates[0].is_a("IfcPlaneAngleMeasure"),
            }
        names = (*_MAP_NUMBERS, "FactorX", "FactorY", "FactorZ")
        return stated | {name: getattr(operation, name, None) for name in names}

    def _stated_sets(self) -> dict[str, Any] | None:
        """Return the map conversion from the property sets of any object, or None.

        According to the "User Guide for Geo-referencing in IFC", version 2, by buildingSMART, the
        project has the property sets. Some programs assign them to the site, and the case of the
        name varies.
        """
        sets: dict[str, list[dict[str, Any]]] = {_CONVERSION_SET: [], _SYSTEM_SET: []}
        for entity in self._file.by_type("IfcPropertySet"):
            found = sets.get((entity.Name or "").lower())
            properties = _properties(entity) if found is not None else {}
            if found is not None and properties not in found:
                found.append(properties)
        if not sets[_CONVERSION_SET]:
            return None
        conversion = sets[_CONVERSION_SET][0]
        system = sets[_SYSTEM_SET][0] if sets[_SYSTEM_SET] else {}
        return {
            "system": system.get("Name") or conversion.get("TargetCRS"),
            "map_unit": system.get("MapUnit") or conversion.get("MapUnit"),
            "count": max(map(len, sets.values())),
            **{name: conversion.get(name) for name in _MAP_NUMBERS},
        }

    def _position_of_site(self) -> list[float] | None:
        """Return the site's latitude and longitude in degrees, or None if they are not stated."""
        for site in self._file.by_type("IfcSite"):
            angles = [site.RefLatitude, site.RefLongitude]
            if all(angles) and any(map(any, angles)):
                weights = (1, 1 / 60, 1 / 3600, 1 / 3600e6)
                return [
                    sum(n * weight for n, weight in zip(angle, weights, strict=False))
                    for angle in angles
                ]
        return None


def _open(path: str, max_unpacked: int) -> Any:
    """Open an IFC file. An .ifczip is unpacked in memory.

    Raises UnreadSchemaError if the library does not support the schema of the file.
    """
    if path.lower().endswith(".ifczip"):
        data = _unpacked(path, max_unpacked)
    else:
        with open(path, "rb") as stream:  # noqa: PTH123
            head = stream.read(_HEAD_BYTES)
            if _with_read_schema(head) == head:
                return ifcopenshell.open(path, ".ifc")
            data = head + stream.read()
    head = _with_read_schema(data[:_HEAD_BYTES])
    return ifcopenshell.file.from_string((head + data[_HEAD_BYTES:]).decode("latin-1"))


def _unpacked(path: str, max_bytes: int) -> bytes:
    """Return the content of the building file in an .ifczip."""
    with zipfile.ZipFile(path) as archive:
        entries = [e for e in archive.infolist() if e.filename.lower().endswith(".ifc")]
        if len(entries) != 1:
            raise ValueError(f"the archive contains {len(entries)} .ifc files; expected 1")
        if entries[0].file_size > max_bytes:
            raise ValueError(f"the archive unpacks to more than {max_bytes:,} bytes")
        with archive.open(entries[0]) as stream:
            data = stream.read(max_bytes)
    if b"END-ISO-10303-21" not in data[-200:]:
        raise ValueError("the end of the file is missing")
    return data


def _with_read_schema(head: bytes) -> bytes:
    """Replace the schema name in a file header by an equivalent one that the library supports.

    Raises UnreadSchemaError if there is no equivalent schema.
    """
    stated = _SCHEMA.search(head)
    if stated is None:  # the library will refuse the file
        return head
    name = stated[1].decode("latin-1")
    names = [text for text in ifcopenshell.ifcopenshell_wrapper.schema_names() if "IFC" in text]
    if name.upper() in names:
        return head
    same = _SAME_SCHEMAS.get(name.strip().upper(), name.strip().upper())
    if same not in names:
        raise UnreadSchemaError(name[:40], sorted({*names, *_SAME_SCHEMAS}))
    return head[: stated.start(1)] + same.encode() + head[stated.end(1) :]


class UnreadSchemaError(Exception):
    """Raised if the library does not support the schema that a file uses.

    The arguments are the schema and the supported schemas.
    """


def _parent(element: Any) -> Any:
    """Return the element or spatial structure that directly contains an element, or None."""
    for attribute, parent in _PARENTS:
        relations = getattr(element, attribute, None)
        if relations:
            return getattr(relations[0], parent, None)
    return None


def _properties(entity: Any) -> dict[str, Any]:
    """Return the properties in a set that have a single value."""
    values = {}
    for item in entity.HasProperties or ():
        if item.is_a("IfcPropertySingleValue") and item.NominalValue is not None:
            value = item.NominalValue.wrappedValue
            values[item.Name] = value if isinstance(value, int | float) else str(value)
    return values


def _name(element: Any) -> str:
    """Return an element's class and name as one text."""
    return f"{element.is_a()} {element.Name or element.GlobalId}"


def _material_of(element: Any) -> str:
    """Return the name of an element's material, or an empty string for layers and other sets."""
    for relation in getattr(element, "HasAssociations", None) or ():
        if relation.is_a("IfcRelAssociatesMaterial"):
            material = relation.RelatingMaterial
            if material is not None and material.is_a("IfcMaterial"):
                return material.Name or ""
    return ""


def main(path: str, request: dict[str, Any]) -> None:
    """Read a file, and write frames to the standard output."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    def write(frame: dict[str, Any], *arrays: NDArray[Any]) -> None:
        """Write a frame: a line of JSON, followed by the bytes of its arrays."""
        signal.alarm(0)  # the receiving process may take long
        kinds = [(array.dtype.str, array.shape) for array in arrays]
        output.write(json.dumps(frame | {"arrays": kinds}).encode() + b"\n")
        for array in arrays:
            output.write(np.ascontiguousarray(array).tobytes())
        signal.alarm(MAX_WAIT_S)

    try:
        Building(path, request, write).read()
    except UnreadSchemaError as error:
        schema, names = error.args
        write({"what": "schema", "schema": schema, "read": names})
    except MemoryError:  # treated like a crash of the library
        raise
    except Exception as error:  # ifcopenshell raises errors of any type
        if "shared_library::load" in str(error):  # caused by a lack of memory
            raise
        reason = " ".join(str(error).replace(path, os.path.basename(path)).split())  # noqa: PTH119
        write({"what": "error", "reason": (reason or type(error).__name__)[:300]})
    output.flush()


if __name__ == "__main__":
    message = json.loads(sys.argv[2])
    signal.alarm(MAX_WAIT_S)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    max_bytes = message["memory"] if hard_limit < 0 else min(message["memory"], hard_limit)
    resource.setrlimit(resource.RLIMIT_DATA, (max_bytes, hard_limit))
    main(sys.argv[1], message)
    os._exit(0)  # exit at once, because deleting a large building takes long
