"""COLLADA files, .dae, after its specification 1.4.1 by the Khronos Group (2008).

This is not pycollada, which drops geometry with a material, a skin or a morph that it does not
resolve, holes in polygons and offsets of accessors, refuses comments, pictures without paths and
odd colours, and keeps single precision; nor assimp 5.4, which refused twice as many of 661 public
files, skips missing geometries, keeps single precision, and ends the process if nodes contain each
other. Only triangles are read, not materials, pictures, lights, cameras and animations.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ..base.allowance import Allowance
from ..base.xmlfile import xml_root
from .mesh import Mesh
from .nodes import SMALLER, Content, MeshFileError, Node, Piece, instances, joined, settled
from .polygons import fanned, triangulated, unrolled, with_holes
from .transform import rotation_about

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_SURFACES = ("triangles", "polylist", "polygons", "tristrips", "trifans")


def read_dae(data: bytes, path: Path, colours: bool = False) -> Content:
    """Read the visual scene of a file."""
    root = xml_root(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag != "COLLADA":
        raise MeshFileError(f"is XML, but not COLLADA: it begins with <{root.tag[:40]}>")
    document = _Document(root, Allowance(len(data), SMALLER))
    content = settled(instances(document.roots(), document.node, path.stem))
    unit = root.find("asset/unit[@meter]")
    if unit is not None:
        content.unit_m = float(unit.attrib["meter"])
        if not 0 < content.unit_m < np.inf:
            raise ValueError(f"its unit is {content.unit_m} metres")
    axis = (root.findtext("asset/up_axis") or "").strip()
    content.up_axis = axis[:1].lower() if axis in ("X_UP", "Z_UP") else "y"  # by its standard
    return content


class _Document:
    """Elements by their ids; each geometry is read once."""

    def __init__(self, root: Element, allowance: Allowance) -> None:
        self._root, self._allowance = root, allowance
        # By kind, too: some programs give a scene and a node in it the same id.
        self._ids: dict[tuple[str, str], Element] = {}
        for element in root.iter():
            self._ids.setdefault((element.tag, element.get("id", "")), element)
        self._geometry = cache(self._read_geometry)
        self._points = cache(self._read_points)
        self._floats = cache(_numbers)

    def roots(self) -> list[Element]:
        """Visual scene of the file; by default the first."""
        shown = self._root.find("scene/instance_visual_scene")
        if shown is not None:
            return [self._target(shown, "visual_scene")]
        return self._root.findall("library_visual_scenes/visual_scene")[:1]

    def node(self, element: Element) -> Node:
        """<node>, or the <visual_scene> around all."""
        meshes: list[Mesh] = []
        children = []
        matrix = np.eye(4)
        for child in element:
            if child.tag == "node":
                children.append(child)
            elif child.tag == "instance_node":
                children.append(self._target(child, "node"))
            elif child.tag == "instance_geometry":
                meshes += self._geometry(self._target(child, "geometry"))
            elif child.tag == "instance_controller":
                raise MeshFileError(
                    "moves vertices by a skin (a skeleton) or a morph, which is not supported: "
                    "apply it, then export"
                )
            elif child.tag in _STEPS:
                matrix = matrix @ _STEPS[child.tag](_numbers(child))
            elif child.tag == "skew":
                raise MeshFileError("shears objects by <skew>, which is not supported: apply it")
        name = element.get("name", "") if element.tag == "node" else ""
        return Node(name, matrix, meshes, children)

    def _target(self, element: Element, kind: str) -> Element:
        """Element of a kind that another one names."""
        url = element.get("source", element.get("url", ""))
        found = self._ids.get((kind, url[1:]), self._ids.get((kind, unquote(url[1:]))))
        if found is None or not url.startswith("#"):
            raise MeshFileError(
                f"has an <{element.tag}> of {url[:80]!r}, which is not in the file: export it again"
            )
        return found

    def _read_geometry(self, geometry: Element) -> list[Mesh]:
        """One mesh of all primitives, which differ by material only; none without triangles."""
        name = geometry.get("name") or geometry.get("id") or ""
        for kind in ("convex_mesh", "brep"):
            if geometry.find(kind) is not None:
                raise MeshFileError(f"has a <{kind}>, which is not read: export it as triangles")
        faces: dict[Element, list[Int]] = {}  # {where their points are: faces}
        for primitive in geometry.findall("mesh/*"):
            if primitive.tag in _SURFACES:
                vertices, offset, stride = self._inputs(primitive)
                points = self._points(vertices)
                made = [f for f in _faces(primitive, points, offset, stride) if len(f)]
                faces.setdefault(vertices, []).extend(made)
        parts = (Piece(self._points(v), np.concatenate(f)) for v, f in faces.items() if f)
        return joined(name, parts, self._allowance)

    def _inputs(self, primitive: Element) -> tuple[Element, int, int]:
        """<vertices> of a primitive; place of their numbers in <p>, and numbers of each corner."""
        stride, found = 0, None
        for entry in primitive.findall("input"):
            offset = int(entry.get("offset", 0))
            stride = max(stride, offset + 1)
            if entry.get("semantic") == "VERTEX":
                found = self._target(entry, "vertices"), offset
        if found is None:
            raise ValueError(f"<{primitive.tag}> has no vertices")
        return *found, stride

    def _read_points(self, vertices: Element) -> Float:
        """Positions (v, 3) of <vertices>."""
        entry = vertices.find("input[@semantic='POSITION']")
        if entry is None:
            raise ValueError("<vertices> without positions")
        source = self._target(entry, "source")
        accessor = source.find("technique_common/accessor")
        if accessor is None:
            raise ValueError("positions without <accessor>")
        numbers = self._floats(self._target(accessor, "float_array"))
        count, stride = int(accessor.get("count", 0)), int(accessor.get("stride", 1))
        offset = int(accessor.get("offset", 0))
        if min(count, offset, stride - 1) < 0 or offset + count * stride > len(numbers):
            raise ValueError(
                f"{count:,} positions of {stride} numbers announced, {len(numbers):,} numbers there"
            )
        rows = numbers[offset : offset + count * stride].reshape(count, stride)
        # Skip a parameter without a name.
        names = [parameter.get("name") for parameter in accessor.findall("param")]
        columns = [names.index(axis) for axis in "XYZ" if axis in names]
        if len(columns) != 3:
            return rows[:, :3]
        self._allowance.take(24 * count)
        return rows[:, columns]


def _faces(primitive: Element, points: Float, offset: int, stride: int) -> Iterator[Int]:
    """Triangles (t, 3) of a primitive, piece by piece."""
    lists = [_corners(p, offset, stride) for p in primitive.findall("p")]
    if primitive.tag == "triangles":
        yield from (corners[: len(corners) // 3 * 3].reshape(-1, 3) for corners in lists)
    elif primitive.tag == "tristrips":
        yield from map(unrolled, lists)
    elif primitive.tag == "trifans":
        yield from map(fanned, lists)
    elif primitive.tag == "polylist" and lists:
        sizes = np.array((primitive.findtext("vcount") or "").split(), np.int64)
        corners = np.concatenate(lists)
        if (sizes < 0).any() or sizes.sum() != len(corners):
            raise ValueError(f"polygons of {sizes.sum():,} corners, {len(corners):,} are there")
        yield triangulated(points, corners, sizes)
    elif primitive.tag == "polygons":
        if lists:
            sizes = np.array([len(corners) for corners in lists])
            yield triangulated(points, np.concatenate(lists), sizes)
        for holed in primitive.findall("ph"):
            yield with_holes(points, [_corners(ring, offset, stride) for ring in holed])


def _corners(element: Element, offset: int, stride: int) -> Int:
    """Numbers of vertices in a <p> or <h>."""
    return np.array((element.text or "").split(), np.int64)[offset::stride]


def _numbers(element: Element) -> Float:
    return np.array((element.text or "").split(), np.float64)


def _translate(numbers: Float) -> Float:
    out = np.eye(4)
    out[:3, 3] = numbers
    return out


def _rotate(numbers: Float) -> Float:
    """Rotation about an axis, in degrees; some programs write no axis."""
    *axis, degrees = numbers
    out = np.eye(4)
    if np.any(axis):
        out[:3, :3] = rotation_about(axis, degrees)
    return out


def _look_at(numbers: Float) -> Float:
    eye, target, up = numbers.reshape(3, 3)
    z = (eye - target) / np.linalg.norm(eye - target)
    x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
    out = np.eye(4)
    out[:3] = np.stack([x, np.cross(z, x), z, eye], axis=1)
    return out


_STEPS = {
    "translate": _translate,
    "rotate": _rotate,
    "scale": lambda numbers: np.diag([*numbers, 1.0]),
    "matrix": lambda numbers: numbers.reshape(4, 4),
    "lookat": _look_at,
}
