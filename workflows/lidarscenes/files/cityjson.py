"""Read CityJSON and CityJSONSeq files, versions 1.0 to 2.0 (Ledoux et al. 2019, cityjson.org).

cjio is not used, because it triangulates in a Python loop and does not preserve names in its
exports.
"""

from __future__ import annotations

import io
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.errors import message_of
from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.vectors import matmul
from lidarsim.scene.colors import Colors, as_bytes
from lidarsim.scene.files.coordinate_systems import (
    crs_from_text,
    has_registry,
    horizontal_part,
    is_geocentric,
    linear_unit,
    scale_problem,
    suggested_epsg,
    vertical_datum,
)
from lidarsim.scene.files.polygons import check_corners, triangulate, triangulate_with_holes
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
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.words import plural

# ASPRS LAS 1.4 classes with patterns for the names of city objects, which begin with their types.
# Class 1 is for types without a class in LAS.
CLASSES = {
    1: ObjectClass(
        "unclassified",
        (
            "CityFurniture *",
            "CityObjectGroup *",
            "GenericCityObject *",
            "OtherConstruction *",
            "Tunnel* *",
            "+* *",
        ),
    ),
    2: ObjectClass("ground", ("LandUse *", "TINRelief *")),
    5: ObjectClass("high vegetation", ("PlantCover *", "SolitaryVegetationObject *")),
    6: ObjectClass("building", ("Building* *",)),
    9: ObjectClass("water", ("WaterBody *", "Waterway *")),
    10: ObjectClass("rail", ("Railway *",)),
    11: ObjectClass("road surface", ("Road *", "Transport*Square *")),
    17: ObjectClass("bridge deck", ("Bridge* *",)),
}

# Depth of the surfaces in the nested boundaries of a geometry.
_DEPTHS = {
    "MultiSurface": 1,
    "CompositeSurface": 1,
    "Solid": 2,
    "MultiSolid": 3,
    "CompositeSolid": 3,
}
_OPEN_SURFACES = ("ClosureSurface", "WaterClosureSurface")  # light passes through them
# EPSG codes of geographic coordinate systems in published CityJSON files and of countries.
_GEOGRAPHIC_SYSTEMS = {
    4167, 4171, 4258, 4267, 4269, 4283, 4326, 4490, 4612, 4617, 4674, 4937, 4939, 4979,
    6667, 6668, 6697, 7789, 7843, 7844, 7912, 9518, 9755, 9989,
}  # fmt: skip
_CODES = re.compile(r"(?i)\b(EPSG|ESRI)[:/]+(?:[\d.]*[:/]+)?(\d{4,6})\b")
_MAX_SLOPE = 100  # above this ratio of height to width, coordinates are assumed to be in degrees
_PARTS = "convert it to CityJSONSeq (.jsonl), which is read line by line, or export it in parts"

_Json = dict[str, Any]


class _Polygons(NamedTuple):
    """The polygons of all objects in a document.

    An owner is a tuple of an object index and a material index.
    """

    corners: list[Ints]  # vertices of the polygons without holes, one array per object
    sizes: list[int]  # number of corners of each polygon without holes
    owners: list[tuple[int, int]]  # owners of polygons without holes
    holed_faces: list[Ints]  # triangles of the polygons with holes
    holed_owners: list[tuple[int, int]]  # owners of these triangles


def read_cityjson(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read each city object at its highest level of detail.

    A .jsonl file is read line by line.
    """
    allowance = Allowance(len(data), _PARTS)

    def lines() -> Iterator[bytes]:
        is_single = path.suffix.lower() != ".jsonl"
        return iter([data]) if is_single else filter(bytes.strip, io.BytesIO(data))

    allowance.reserve(max(map(_unpacked_bytes, lines()), default=0))  # one line at a time
    city = None
    for line in lines():
        document = json.loads(line)
        kind = document.get("type") if isinstance(document, dict) else None
        if city is None:
            if kind != "CityJSON":
                raise MeshFileError(
                    'is a JSON file, but its "type" is not "CityJSON". '
                    "Scenarios must have the extension .yaml"
                )
            city = _CityFile(document, allowance, options)
        elif kind != "CityJSONFeature":
            raise ValueError(f"a line has the type {str(kind)[:40]!r} instead of 'CityJSONFeature'")
        city.add(document)
    if city is None:
        raise ValueError("all lines are empty")
    return city.content()


def _unpacked_bytes(text: bytes) -> int:
    """Estimate the peak memory for parsing a JSON text, in bytes."""
    return 5 * len(text) + 100 * text.count(b"[") + 300 * text.count(b"{") + 48 * text.count(b",")


class _CityFile:
    """The objects in a file, each of which is placed as a node.

    Parameters
    ----------
    head
        The file, or the first line of a sequence.
    allowance
        Memory that the content may occupy.
    options
        Options for reading.
    """

    def __init__(self, head: _Json, allowance: Allowance, options: ReadOptions) -> None:
        self._head = head
        self._allowance = allowance
        self._colors = options.colors
        self._names_materials = options.materials
        self._unit = options.unit  # unit that the user has specified
        version = str(head.get("version"))
        if not re.match(r"1\.[01]|2\.0", version):
            raise MeshFileError(
                f"uses CityJSON {version[:20]}, but only versions 1.0 to 2.0 are supported. "
                "Upgrade it with `cjio FILE upgrade save NEW`"
            )
        transform = head.get("transform", {"scale": [1, 1, 1], "translate": [0, 0, 0]})
        self._scale = np.array(transform["scale"], np.float64).reshape(3)
        self._translate = np.array(transform["translate"], np.float64).reshape(3)
        self._unscaled = "transform" not in head and version >= "1.1"
        self._placed: list[PlacedNode] = []
        self._templates: list[list[SceneMesh]] | None = None
        self._levels: Counter[float] = Counter()  # number of objects by level of detail
        self._unread: Counter[str] = Counter()  # number of unread items by kind

    def add(self, document: _Json) -> None:
        """Add the objects in a file, or in one line of a sequence."""
        points = _points(document["vertices"]) * self._scale + self._translate
        objects: dict[str, _Json] = document["CityObjects"]
        levels: dict[str, list[tuple[float, _Json]]] = {}
        # Finest level of detail of each object's parts.
        parts: dict[str, float] = defaultdict(lambda: -np.inf)
        for key, entry in objects.items():
            levels[key] = list(self._with_levels(entry.get("geometry") or ()))
            if entry["type"].endswith("Part"):
                finest = max((level for level, _ in levels[key]), default=-np.inf)
                for parent in entry.get("parents") or ():
                    parts[parent] = max(parts[parent], finest)
        surfaces_of_objects: list[tuple[str, list[_Json]]] = []
        for key, leveled in levels.items():
            # A building represents its parts unless these are more detailed.
            best = max((level for level, _ in leveled), default=-np.inf)
            if not leveled or best < parts.get(key, -np.inf):
                continue
            self._levels[best] += 1
            name = f"{objects[key]['type']} {key}"
            geometries_of_best = []
            for level, geometry in leveled:
                if level == best and geometry["type"] == "GeometryInstance":
                    self._place_template(name, geometry, points)
                elif level == best:
                    geometries_of_best.append(geometry)
            surfaces_of_objects.append((name, geometries_of_best))
        for meshes in self._meshes(points, surfaces_of_objects, document):
            self._placed += [PlacedNode(mesh, np.eye(4), mesh.name) for mesh in meshes]

    def _with_levels(self, geometries: Sequence[_Json]) -> Iterator[tuple[float, _Json]]:
        """Yield each geometry with its level of detail, and count geometries that are not read."""
        for geometry in geometries:
            kind = geometry["type"]
            if kind == "GeometryInstance":
                templates = self._head["geometry-templates"]["templates"]
                yield _level(_item(templates, geometry["template"])), geometry
            elif kind in _DEPTHS:
                yield _level(geometry), geometry
            else:
                self._unread[str(kind)[:40]] += 1

    def _place_template(self, name: str, geometry: _Json, points: Floats) -> None:
        """Place a template at the point that a geometry specifies."""
        if self._templates is None:
            templates = self._head["geometry-templates"]
            shapes = [(f"template {k}", [shape]) for k, shape in enumerate(templates["templates"])]
            vertices = _points(templates["vertices-templates"])
            self._templates = self._meshes(vertices, shapes, self._head)
        (point,) = geometry["boundaries"]
        matrix = np.array(geometry["transformationMatrix"], np.float64).reshape(4, 4)
        matrix[:3, 3] += _item(points, point)
        meshes = _item(self._templates, geometry["template"])
        self._placed += [PlacedNode(mesh, matrix, name) for mesh in meshes]

    def _meshes(
        self, points: Floats, objects: list[tuple[str, list[_Json]]], document: _Json
    ) -> list[list[SceneMesh]]:
        """Return the mesh of each object as a list, which is empty if it has no triangles.

        `objects` are names and geometries. It is ten times as fast to triangulate all polygons in a
        document at once.
        """
        faces, owners = self._triangles(points, self._polygons(points, objects))
        if not len(faces):
            return [[] for _ in objects]
        order = np.lexsort(owners.T[::-1])
        faces = faces[order]
        owners = owners[order]
        starts = np.flatnonzero(np.diff(owners, axis=0, prepend=-2).any(axis=1))
        groups = np.split(faces, starts[1:])
        pieces: list[list[Piece]] = [[] for _ in objects]
        for group, (number, material) in zip(groups, owners[starts].tolist(), strict=True):
            pieces[number].append(self._piece(points, group, material, document))
        return [
            join_pieces(name, object_pieces, self._allowance)
            for (name, _), object_pieces in zip(objects, pieces, strict=True)
        ]

    def _polygons(self, points: Floats, objects: list[tuple[str, list[_Json]]]) -> _Polygons:
        """Collect the polygons of all objects, and triangulate those with holes."""
        polygons = _Polygons([np.zeros(0, np.int64)], [], [], [], [])
        for number, (name, geometries) in enumerate(objects):
            corners: list[int] = []
            try:
                for (outline, *holes), material in self._surfaces(geometries):
                    if holes:
                        rings = [_integers(ring) for ring in (outline, *holes)]
                        faces = triangulate_with_holes(
                            points, [r for r in rings if r is rings[0] or len(r) > 2]
                        )
                        polygons.holed_faces.append(faces)
                        polygons.holed_owners.extend([(number, material)] * len(faces))
                    else:
                        corners += outline
                        polygons.sizes.append(len(outline))
                        polygons.owners.append((number, material))
                polygons.corners.append(_integers(corners))
                check_corners(polygons.corners[-1], len(points))
            except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
                raise ValueError(f"{name[:80]!r}: {message_of(error).rstrip('.')}") from error
        return polygons

    def _triangles(self, points: Floats, polygons: _Polygons) -> tuple[Ints, Ints]:
        """Triangulate polygons, and return the triangles and the owner of each triangle."""
        corners = np.concatenate(polygons.corners)
        sizes = np.array(polygons.sizes, np.int64)
        self._allowance.reserve(100 * len(corners))
        # Polygons do not share corners here, so each corner identifies the polygon of a triangle.
        simple = triangulate(points[corners], np.arange(len(corners)), sizes)
        polygon = np.searchsorted(np.cumsum(sizes), simple[:, 0], side="right")
        faces = np.concatenate([corners[simple], *polygons.holed_faces])
        owners = np.concatenate(
            [
                np.reshape(polygons.owners, (-1, 2))[polygon],
                np.reshape(polygons.holed_owners, (-1, 2)),
            ]
        ).astype(np.int64)
        return faces, owners

    def _piece(self, points: Floats, faces: Ints, material: int, document: _Json) -> Piece:
        """Apply the color and name of a material to triangles, unless its index is -1."""
        colors = None
        name = ""
        if material >= 0:
            entry = document["appearance"]["materials"][material]
            if self._colors:
                color = as_bytes(entry.get("diffuseColor") or (0.8, 0.8, 0.8))
                colors = Colors.plain(color.reshape(1, 1, 3), len(faces))
            name = str(entry.get("name") or "") if self._names_materials else ""
        return Piece(points, faces, None, colors, name)

    def _surfaces(self, geometries: Sequence[_Json]) -> Iterator[tuple[list[list[int]], int]]:
        """Yield the rings of each polygon, and the index of its material or -1."""
        for geometry in geometries:
            if geometry["type"] not in _DEPTHS:  # only in templates
                self._unread[str(geometry["type"])[:40]] += 1
                continue
            semantics = geometry.get("semantics") or {}
            kinds = dict(enumerate(surface["type"] for surface in semantics.get("surfaces") or ()))
            paint: _Json = {}
            if self._colors or self._names_materials:  # the first theme is used
                paint = next(iter((geometry.get("material") or {}).values()), {})
            values = semantics.get("values"), paint.get("values", paint.get("value"))
            if self._colors and geometry.get("texture"):
                self._unread["texture"] += 1
            for rings, kind, material in _surfaces_at(
                geometry["boundaries"], _DEPTHS[geometry["type"]], *values
            ):
                if kinds.get(kind) in _OPEN_SURFACES:
                    self._unread[kinds[kind]] += 1
                    continue
                yield rings, -1 if material is None else int(material)

    def content(self) -> Content:
        """Return all objects as scene content, in meters."""
        bounds = [
            np.zeros((1, 3)),
            *(node.mesh.bounds + node.matrix[:3, 3] for node in self._placed),
        ]
        corners = np.concatenate(bounds)[bool(self._placed) :]
        system = _System.from_head(self._head, corners)
        system.check(corners)
        if system.height_units != 1 and self._unit is None:
            matrix = np.diag([1.0, 1.0, system.height_units, 1.0])
            self._placed = [
                node._replace(matrix=matmul(matrix, node.matrix)) for node in self._placed
            ]
        content = placed_content(self._placed)
        content.unit_m = system.unit_m
        content.up_axis = "z"
        content.vertical_datum = "" if system.crs is None else vertical_datum(system.crs)
        content.classes = CLASSES
        levels = [
            f"{plural(n, 'object')} with LoD {f'{level:g}' if level >= 0 else 'unknown'}"
            for level, n in sorted(self._levels.items(), reverse=True)
        ]
        if self._unscaled:
            content.notes.append("has no transform. Its coordinates are assumed to be in meters")
        content.notes += system.notes(unit_given=self._unit is not None)
        if len(levels) > 1:
            content.notes.append(
                f"contains {', '.join(levels)}. Each object is read at its highest level of detail"
            )
        if self._unread:
            listed = ", ".join(f"{n} {kind}" for kind, n in self._unread.items())
            content.notes.append(f"contains unsupported content, which was skipped: {listed}")
        return content


@dataclass(frozen=True)
class _System:
    """The coordinate system that a file uses.

    Its properties are known if rasterio is installed.
    """

    name: str  # code, or empty
    epsg: int | None
    crs: Any  # None without rasterio, and if PROJ does not know the code
    is_of_angles: bool
    unit_m: float = 1.0  # unit of x and y, meters
    height_units: float = 1.0  # height unit divided by the unit of x and y

    @classmethod
    def from_head(cls, head: _Json, corners: Floats) -> _System:
        """Read the coordinate system from a file or from the first line of a sequence."""
        text = str((head.get("metadata") or {}).get("referenceSystem") or "")
        looks_like_angles = _looks_like_angles(corners)
        codes = _CODES.findall(text)  # the first code of a compound system is horizontal
        if not codes:
            return cls("", None, None, looks_like_angles or "CRS84" in text)
        authority, number = codes[0]
        name = f"{authority.upper()}:{number}"
        epsg = int(number) if authority.upper() == "EPSG" else None
        is_of_angles = looks_like_angles or epsg in _GEOGRAPHIC_SYSTEMS
        crs = None
        if has_registry():
            heights = f"+{codes[1][1]}" if len(codes) > 1 else ""
            crs = crs_from_text(name + heights) or crs_from_text(name)
        if crs is None:
            return cls(name, epsg, None, is_of_angles)
        horizontal, up_m = horizontal_part(crs)
        is_of_angles |= horizontal.is_geographic or is_geocentric(crs)
        _, unit_m = linear_unit(horizontal) or ("metre", 1.0)
        return cls(name, epsg, crs, is_of_angles, unit_m, (up_m or unit_m) / unit_m)

    def check(self, corners: Floats) -> None:
        """Raise MeshFileError if the coordinates are angles, or are not true to scale."""
        reproject = "Reproject it, for example with `cjio FILE crs_reproject {} save NEW`"
        if self.is_of_angles:
            raise MeshFileError(
                f"has coordinates in degrees{f' ({self.name})' if self.name else ''}, but meters "
                f"are required. {reproject.format('EPSG')}"
            )
        x, y = (corners[:, :2].min(axis=0) + corners[:, :2].max(axis=0)).tolist()
        problem = scale_problem(self.name, x / 2, y / 2, in_system=False) if self.name else ""
        if problem:
            code = None if self.crs is None else suggested_epsg(self.crs, x / 2, y / 2)
            raise MeshFileError(f"uses {self.name}, {problem}. {reproject.format(code or 'EPSG')}")

    def notes(self, *, unit_given: bool) -> list[str]:
        """Return notes on the coordinate system."""
        if self.unit_m != 1 and not unit_given:
            return [
                f"uses {self.name}, whose unit is {self.unit_m:.9g} m. Its coordinates were "
                "converted to meters"
            ]
        if self.epsg is None:
            return (
                [f"uses the coordinate system {self.name}, which was ignored"] if self.name else []
            )
        return [
            f"uses EPSG:{self.epsg}. To write this code to LAS files, use <world.epsg={self.epsg}>"
        ]


def _looks_like_angles(corners: Floats) -> bool:
    """Return True if a city's corners are apparently in degrees."""
    width, depth, height = np.ptp(corners, axis=0)
    is_small = np.abs(corners[:, :2]).max() <= 360
    return bool(is_small and height > _MAX_SLOPE * max(width, depth))


def _points(coordinates: Any) -> Floats:
    """Convert coordinates to an array with three columns.

    Raises ValueError if they have another shape.
    """
    try:
        points = np.array(coordinates or np.zeros((0, 3)), np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError("the vertices are not rows of three numbers") from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"the vertices have shape {points.shape}; expected (v, 3)")
    return points


def _integers(numbers: Sequence[int]) -> Ints:
    """Convert numbers to an int64 array.

    Raises ValueError if the values are not integers.
    """
    array = np.array(numbers or np.zeros(0, np.int64))
    if array.ndim != 1 or array.dtype != np.int64:
        raise ValueError(
            "the boundaries are not nested as the geometry type requires, or contain values "
            "that are not integers"
        )
    return array


def _item(items: Any, number: Any) -> Any:
    """Return the item with the given index.

    Raises ValueError if the index is invalid.
    """
    if type(number) is not int or not 0 <= number < len(items):
        raise ValueError(
            f"index {str(number)[:20]} is out of range for {len(items)} templates or vertices"
        )
    return items[number]


def _level(geometry: _Json) -> float:
    """Return a geometry's level of detail, or -1 if it is unknown."""
    try:
        return float(geometry["lod"])
    except (KeyError, TypeError, ValueError):
        return -1.0


def _surfaces_at(tree: Any, depth: int, *values: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the items at a given depth of nested lists, with the corresponding `values`."""
    if not depth:
        yield (tree, *values)
        return
    for k, below in enumerate(tree):
        inner_values = [
            value if not isinstance(value, list) else value[k] if k < len(value) else None
            for value in values
        ]
        yield from _surfaces_at(below, depth - 1, *inner_values)
