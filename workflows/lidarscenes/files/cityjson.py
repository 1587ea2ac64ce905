"""CityJSON and CityJSONSeq, after the specifications 1.0 to 2.0 (Ledoux et al. 2019; cityjson.org).

This is not cjio, which triangulates in a loop of Python and keeps no names in its exports.
"""

from __future__ import annotations

import io
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import Floats, Ints
from lidarsim.base.words import plural
from lidarsim.scene.colours import Colours, as_bytes
from lidarsim.scene.files.polygons import check_corners, triangulated, with_holes
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

# {class of ASPRS LAS 1.4: name, and patterns of city objects, whose names begin with their types};
# class 1 is for types that have no class in LAS.
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

# How deep surfaces are nested in the boundaries of a geometry.
_DEPTHS = {
    "MultiSurface": 1,
    "CompositeSurface": 1,
    "Solid": 2,
    "MultiSolid": 3,
    "CompositeSolid": 3,
}
_OPEN = ("ClosureSurface", "WaterClosureSurface")  # that nothing is where they are
# Geographic reference systems of CityJSON files that were seen, and those of countries.
_DEGREES = {4167, 4171, 4258, 4267, 4269, 4283, 4326, 4490, 4612, 4617, 4674, 4937, 4939, 4979,
            6667, 6668, 6697, 7789, 7843, 7844, 7912, 9518, 9755, 9989}  # fmt: skip
_STEEP = 100  # a city is not so many times as high as it is wide, unless in degrees
_PARTS = "convert it to CityJSONSeq (.jsonl), which is read line by line, or export it in parts"

_Json = dict[str, Any]


def read_cityjson(data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read the highest level of detail of each city object; a .jsonl line by line."""
    allowance = Allowance(len(data), _PARTS)

    def lines() -> Iterator[bytes]:
        whole = path.suffix.lower() != ".jsonl"
        return iter([data]) if whole else filter(bytes.strip, io.BytesIO(data))

    allowance.take(max(map(_unpacked, lines()), default=0))  # one is there at a time
    city = None
    for line in lines():
        document = json.loads(line)
        kind = document.get("type") if isinstance(document, dict) else None
        if city is None:
            if kind != "CityJSON":
                raise MeshFileError(
                    'is JSON, but not CityJSON: it does not begin with "type": "CityJSON" (a '
                    "scenario has the ending .yaml)"
                )
            city = _CityFile(document, allowance, wanted)
        elif kind != "CityJSONFeature":
            raise ValueError(f"a line is of the type {str(kind)[:40]!r}, not CityJSONFeature")
        city.add(document)
    if city is None:
        raise ValueError("no line has anything")
    return city.content()


def _unpacked(text: bytes) -> int:
    """Bytes that JSON takes at most while it is read."""
    return 5 * len(text) + 100 * text.count(b"[") + 300 * text.count(b"{") + 48 * text.count(b",")


class _CityFile:
    """Places of the objects in one file.

    Parameters
    ----------
    head
        The file, or the first line of a sequence.
    """

    def __init__(self, head: _Json, allowance: Allowance, wanted: ReadOptions) -> None:
        self._head = head
        self._allowance = allowance
        self._colours = wanted.colours
        self._named = wanted.materials
        version = str(head.get("version"))
        if not re.match(r"1\.[01]|2\.0", version):
            raise MeshFileError(
                f"is CityJSON {version[:20]}, and 1.0 to 2.0 are read: cjio FILE upgrade save NEW "
                "makes it one of them"
            )
        transform = head.get("transform", {"scale": [1, 1, 1], "translate": [0, 0, 0]})
        self._scale = np.array(transform["scale"], np.float64).reshape(3)
        self._translate = np.array(transform["translate"], np.float64).reshape(3)
        self._unscaled = "transform" not in head and version >= "1.1"
        self._placed: list[PlacedNode] = []
        self._templates: list[list[SceneMesh]] | None = None
        self._levels: Counter[float] = Counter()  # {level of detail: objects}
        self._left: Counter[str] = Counter()  # {what is not read: how often}

    def add(self, document: _Json) -> None:
        """Add the objects of a file or line."""
        points = _points(document["vertices"]) * self._scale + self._translate
        objects: dict[str, _Json] = document["CityObjects"]
        levels: dict[str, list[tuple[float, _Json]]] = {}
        parts: dict[str, float] = defaultdict(lambda: -np.inf)  # {object: finest of its parts}
        for key, one in objects.items():
            levels[key] = list(self._levelled(one.get("geometry") or ()))
            if one["type"].endswith("Part"):
                finest = max((level for level, _ in levels[key]), default=-np.inf)
                for parent in one.get("parents") or ():
                    parts[parent] = max(parts[parent], finest)
        wanted: list[tuple[str, list[_Json]]] = []
        for key, found in levels.items():
            # A building is a coarse whole if its parts are finer, else what they are not.
            best = max((level for level, _ in found), default=-np.inf)
            if not found or best < parts.get(key, -np.inf):
                continue
            self._levels[best] += 1
            name = f"{objects[key]['type']} {key}"
            surfaces = []
            for level, geometry in found:
                if level == best and geometry["type"] == "GeometryInstance":
                    self._place(name, geometry, points)
                elif level == best:
                    surfaces.append(geometry)
            wanted.append((name, surfaces))
        for meshes in self._built(points, wanted, document):
            self._placed += [PlacedNode(mesh, np.eye(4), mesh.name) for mesh in meshes]

    def _levelled(self, geometries: Sequence[_Json]) -> Iterator[tuple[float, _Json]]:
        """Surfaces, also of templates, and their levels of detail; counts what is not read."""
        for geometry in geometries:
            kind = geometry["type"]
            if kind == "GeometryInstance":
                templates = self._head["geometry-templates"]["templates"]
                yield _level(_item(templates, geometry["template"])), geometry
            elif kind in _DEPTHS:
                yield _level(geometry), geometry
            else:
                self._left[str(kind)[:40]] += 1

    def _place(self, name: str, geometry: _Json, points: Floats) -> None:
        """Place a template at a point."""
        if self._templates is None:
            given = self._head["geometry-templates"]
            shapes = [(f"template {k}", [one]) for k, one in enumerate(given["templates"])]
            vertices = _points(given["vertices-templates"])
            self._templates = self._built(vertices, shapes, self._head)
        (point,) = geometry["boundaries"]
        matrix = np.array(geometry["transformationMatrix"], np.float64).reshape(4, 4)
        matrix[:3, 3] += _item(points, point)
        meshes = _item(self._templates, geometry["template"])
        self._placed += [PlacedNode(mesh, matrix, name) for mesh in meshes]

    def _built(
        self, points: Floats, wanted: list[tuple[str, list[_Json]]], document: _Json
    ) -> list[list[SceneMesh]]:
        """Make a mesh of the surfaces of each object, or none if it has no triangles.

        All polygons of a document are cut at once, which takes a tenth of the time.
        """
        # of polygons without holes
        corners = [np.zeros(0, np.int64)]
        sizes = []
        owners: list[tuple[int, int]] = []  # of each its object and material
        cut: list[Ints] = []  # triangles of those with holes
        cut_owners: list[tuple[int, int]] = []
        for number, (name, geometries) in enumerate(wanted):
            own: list[int] = []
            try:
                for (outline, *holes), material in self._surfaces(geometries):
                    if holes:
                        rings = [_whole(ring) for ring in (outline, *holes)]
                        found = with_holes(
                            points, [r for r in rings if r is rings[0] or len(r) > 2]
                        )
                        cut.append(found)
                        cut_owners += [(number, material)] * len(found)
                    else:
                        own += outline
                        sizes.append(len(outline))
                        owners.append((number, material))
                corners.append(_whole(own))
                check_corners(corners[-1], len(points))
            except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
                raise ValueError(f"{name[:80]!r}: {error}") from error
        at = np.concatenate(corners)
        each = np.array(sizes, np.int64)
        self._allowance.take(100 * len(at))
        # With corners of its own for each polygon, a triangle tells which one it is of.
        simple = triangulated(points[at], np.arange(len(at)), each)
        polygon = np.searchsorted(np.cumsum(each), simple[:, 0], side="right")
        faces = np.concatenate([at[simple], *cut])
        owner = np.concatenate(
            [np.reshape(owners, (-1, 2))[polygon], np.reshape(cut_owners, (-1, 2))]
        ).astype(np.int64)
        if not len(faces):
            return [[] for _ in wanted]
        order = np.lexsort(owner.T[::-1])
        faces = faces[order]
        owner = owner[order]
        begins = np.flatnonzero(np.diff(owner, axis=0, prepend=-2).any(axis=1))
        pieces: list[list[Piece]] = [[] for _ in wanted]
        for some, (number, material) in zip(
            np.split(faces, begins[1:]), owner[begins].tolist(), strict=True
        ):
            painted = None
            named = ""
            if material >= 0:
                entry = document["appearance"]["materials"][material]
                if self._colours:
                    colour = as_bytes(entry.get("diffuseColor") or (0.8, 0.8, 0.8))
                    painted = Colours.plain(colour.reshape(1, 1, 3), len(some))
                named = str(entry.get("name") or "") if self._named else ""
            pieces[number].append(Piece(points, some, None, painted, named))
        return [
            join_pieces(name, some, self._allowance)
            for (name, _), some in zip(wanted, pieces, strict=True)
        ]

    def _surfaces(self, geometries: Sequence[_Json]) -> Iterator[tuple[list[list[int]], int]]:
        """Rings of polygons and the numbers of their materials, -1 for none."""
        for geometry in geometries:
            if geometry["type"] not in _DEPTHS:  # of a template
                self._left[str(geometry["type"])[:40]] += 1
                continue
            semantics = geometry.get("semantics") or {}
            kinds = dict(enumerate(one["type"] for one in semantics.get("surfaces") or ()))
            paint: _Json = {}
            if self._colours or self._named:  # of the first theme
                paint = next(iter((geometry.get("material") or {}).values()), {})
            marks = semantics.get("values"), paint.get("values", paint.get("value"))
            if self._colours and geometry.get("texture"):
                self._left["texture"] += 1
            for rings, kind, material in _flat(
                geometry["boundaries"], _DEPTHS[geometry["type"]], *marks
            ):
                if kinds.get(kind) in _OPEN:
                    self._left[kinds[kind]] += 1
                    continue
                yield rings, -1 if material is None else int(material)

    def content(self) -> Content:
        """All objects, in metres."""
        reference = (self._head.get("metadata") or {}).get("referenceSystem")
        found = re.search(r"EPSG\b.*?(\d+)$", str(reference))
        epsg = int(found[1]) if found else None
        ends = [np.zeros((1, 3)), *(one.mesh.bounds + one.matrix[:3, 3] for one in self._placed)]
        corners = np.concatenate(ends)[bool(self._placed) :]
        width, depth, height = np.ptp(corners, axis=0)
        near = np.abs(corners[:, :2]).max() <= 360
        if epsg in _DEGREES or (near and height > _STEEP * max(width, depth)):
            raise MeshFileError(
                f"has coordinates in degrees{f' (EPSG:{epsg})' if epsg else ''}, and metres are "
                "needed: reproject it, for example by cjio FILE crs_reproject EPSG save NEW"
            )
        content = placed_content(self._placed)
        content.unit_m = 1.0
        content.up_axis = "z"
        content.classes = CLASSES
        levels = [
            f"{plural(n, 'object')} of LoD {f'{level:g}' if level >= 0 else 'unknown'}"
            for level, n in sorted(self._levels.items(), reverse=True)
        ]
        if self._unscaled:
            content.notes.append("lacks its transform: its coordinates are taken as metres")
        if epsg:
            content.notes.append(f"is in EPSG:{epsg}: <cloud.epsg={epsg}> writes that to LAS")
        if len(levels) > 1:
            content.notes.append(f"has {', '.join(levels)}, which is the highest of each")
        if self._left:
            listed = ", ".join(f"{n} {kind}" for kind, n in self._left.items())
            content.notes.append(f"is read without {listed}")
        return content


def _points(rows: Any) -> Floats:
    """Coordinates (v, 3); ValueError if they are not."""
    points = np.array(rows or np.zeros((0, 3)), np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"its vertices are of the shape {points.shape}, not (v, 3)")
    return points


def _whole(numbers: Sequence[int]) -> Ints:
    """Whole numbers (n,); ValueError if they are not."""
    array = np.array(numbers or np.zeros(0, np.int64))
    if array.ndim != 1 or array.dtype != np.int64:
        raise ValueError("its boundaries are not nested as those of its type, or not whole numbers")
    return array


def _item(items: Any, number: Any) -> Any:
    if type(number) is not int or not 0 <= number < len(items):
        raise ValueError(f"{str(number)[:20]} is none of {len(items)} templates or vertices")
    return items[number]


def _level(geometry: _Json) -> float:
    try:
        return float(geometry["lod"])
    except (KeyError, TypeError, ValueError):
        return -1.0


def _flat(tree: Any, depth: int, *marks: Any) -> Iterator[tuple[Any, ...]]:
    """All that is so deep in nested lists, with its marks, which may be of all in a list."""
    if not depth:
        yield (tree, *marks)
        return
    for k, below in enumerate(tree):
        inner = [
            mark if not isinstance(mark, list) else mark[k] if k < len(mark) else None
            for mark in marks
        ]
        yield from _flat(below, depth - 1, *inner)
