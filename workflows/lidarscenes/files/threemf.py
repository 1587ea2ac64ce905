"""Read 3MF files according to the core, production, and materials specifications.

The specifications are by the 3MF Consortium (2018).

trimesh is not used, because it follows nested components only to a limited depth and confuses the
parts of inner files. assimp 5.4 is not used either. It does not read the parts of inner files,
ignores required extensions, and crashes if a property index is out of range.
"""

from __future__ import annotations

import io
import re
import zipfile
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from lidarsim.errors import CutShortError, message_of
from lidarsim.io.allowance import Allowance
from lidarsim.io.xmlfile import AT_END, PIECE_BYTES, parse_pieces, refuse_entity
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.colors import GRAY, Colors
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.files.scene_graph import (
    SMALLER,
    Content,
    MeshFileError,
    Node,
    ReadOptions,
    placed_content,
    placed_nodes,
)
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.words import plural

_UNITS_M = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}
# Required extensions that do not change shapes, or that are supported here.
_SUPPORTED = re.compile(r"/(material|production|securecontent)/")

# Memory that short elements need, in bytes.
_OBJECT_BYTES = 1000  # an object, a placement, or a color group
_COLOR_BYTES = 100  # a color or material in a group

_COLOR = re.compile(r"#([0-9A-Fa-f]{6})([0-9A-Fa-f]{2})?")  # sRGB, and an alpha that is ignored

_Key = tuple[str, str]  # inner file and ID of an object


@dataclass
class _MeshObject:
    """An object in a model. It is a mesh or consists of components."""

    name: str
    vertices: array[float] = field(default_factory=lambda: array("d"))
    faces: array[int] = field(default_factory=lambda: array("q"))
    components: list[_Placement] = field(default_factory=list)
    # Group ID and index of the default property, for triangles without a property.
    default_property: tuple[str, str] = ("", "0")
    shades: array[int] = field(default_factory=lambda: array("B"))  # shades of corners, if read
    materials: list[str] = field(default_factory=list)  # names of triangles, if read

    @cached_property
    def meshes(self) -> list[SceneMesh]:
        """The object as a list with one mesh, or an empty list if it has no triangles."""
        if not self.faces:
            return []
        vertices = np.frombuffer(self.vertices, np.float64).reshape(-1, 3)
        faces = np.frombuffer(self.faces, np.int64).reshape(-1, 3)
        colors = None
        corners = np.frombuffer(self.shades, np.uint8).reshape(-1, 3, 3)
        if (corners != GRAY).any():
            colors = Colors.from_vertex_colors(corners)
        materials = None
        if self.materials:
            names = tuple(dict.fromkeys(self.materials))
            rows = {name: row for row, name in enumerate(names)}
            index = np.array([rows[name] for name in self.materials], np.int32)
            materials = FaceMaterials(names, index if names[1:] else None)
            materials = materials if any(names) else None
        return [SceneMesh(self.name, vertices, faces, colors=colors, materials=materials)]


@dataclass(frozen=True, eq=False)
class _Placement:
    """A component or build item, that is, an object and the matrix that places it."""

    key: _Key
    name: str
    matrix: Floats


def read_3mf(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the build items in a file, with colors from base materials and color groups."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        package = _Package(archive, Allowance(len(data), SMALLER), options)
        root = package.model(package.start())

        def node(placement: _Placement) -> Node:
            mesh_object = package.object(placement.key)
            return Node(
                placement.name or mesh_object.name,
                placement.matrix,
                mesh_object.meshes,
                mesh_object.components,
            )

        content = placed_content(placed_nodes(root.items, node, path.stem))
    content.unit_m = _UNITS_M[root.unit]
    content.up_axis = "z"
    if gray_count := sum(model.gray_count for model in package.models.values()):
        words = plural(gray_count, "triangle")
        content.notes.append(
            f"contains textures, which are not supported, or lacks colors. As a result, {words} "
            f"{'is' if gray_count == 1 else 'are'} gray"
        )
    return content


class _Package:
    """The inner files of an archive. Each one is read when an object in it is first placed."""

    def __init__(
        self, archive: zipfile.ZipFile, allowance: Allowance, options: ReadOptions
    ) -> None:
        self._archive = archive
        self._allowance = allowance
        self._options = options
        self.models: dict[str, _Model] = {}

    def start(self) -> str:
        """Return the name of the inner file that contains the model to build."""
        names = self._archive.namelist()
        relations = ""
        if "_rels/.rels" in names:
            relations = b"".join(self._pieces("_rels/.rels")).decode()
        for relation in re.findall(r"<Relationship\b[^>]*", relations):
            target = re.search(r'\bTarget\s*=\s*["\']/?([^"\']+)', relation)
            if target and re.search(r'/3dmodel["\']', relation):
                return target[1]
        for name in names:
            if name.lower() == "3d/3dmodel.model":
                return name
        raise ValueError("the archive does not contain 3D/3dmodel.model")

    def model(self, name: str) -> _Model:
        """Return an inner file, which is read on first use."""
        name = name.lstrip("/")
        if name not in self.models:
            pieces = self._pieces(name)
            self.models[name] = _Model(name, pieces, self._allowance, self._options)
        return self.models[name]

    def _pieces(self, name: str) -> Iterator[bytes]:
        """Yield the content of an inner file in pieces, never more than its stated size."""
        if name not in self._archive.namelist():
            raise ValueError(f"the archive does not contain {name[:80]!r}")
        entry = self._archive.getinfo(name)
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise MeshFileError(
                "is compressed with a method other than Deflate, which is not supported. Export "
                "it again with Deflate"
            )
        self._allowance.reserve(entry.file_size)
        with self._archive.open(entry) as file:
            while piece := file.read(PIECE_BYTES):
                yield piece

    def object(self, key: _Key) -> _MeshObject:
        """Return the object with the given key.

        Raises ValueError if it is not defined.
        """
        objects = self.model(key[0]).objects
        if key[1] not in objects:
            raise ValueError(f"object {key[1][:20]!r} is used but not defined")
        return objects[key[1]]


class _Model:
    """The objects and build items of an inner file.

    The file is parsed without building a tree, which would need ten times the size of the file.
    """

    def __init__(
        self, name: str, text: Iterable[bytes], allowance: Allowance, options: ReadOptions
    ) -> None:
        self.unit = "millimeter"
        self.gray_count = 0  # triangles whose colors are not in the file
        self._colors = options.colors
        self._names_materials = options.materials
        self._groups: dict[str, list[bytes]] = {}  # {number of a group: its colors}
        self._group: list[bytes] = []
        self._names: dict[str, list[str]] = {}  # {number of a group: names of its materials}
        self._names_of_group: list[str] = []
        self.objects: dict[str, _MeshObject] = {}
        self.items: list[_Placement] = []
        self._name = name
        self._allowance = allowance
        self._object = _MeshObject("")
        # Namespaces are ignored, because slicers do not declare all of them.
        self._readers: dict[str, Callable[[dict[str, str]], None]] = {
            "basematerials": self._begin_group,
            "colorgroup": self._begin_group,
            "base": self._add_color,
            "color": self._add_color,
            "object": self._begin_object,
            "component": lambda a: self._object.components.append(self._placement(a)),
            "item": lambda a: self.items.append(self._placement(a)),
            "model": self._begin_model,
        }
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._begin
        parser.EntityDeclHandler = refuse_entity
        try:
            for _ in parse_pieces(parser, text):
                pass
        except expat.ExpatError as error:
            if error.code not in AT_END:
                raise
            raise CutShortError(f"{name[:80]} ends inside an element") from error
        except (KeyError, OverflowError, ValueError) as error:
            raise ValueError(
                f"line {parser.CurrentLineNumber} of {name[:80]}: {message_of(error).rstrip('.')}"
            ) from error

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        """Process the start tag of an element."""
        tag = tag.rpartition(":")[2]
        if tag == "vertex":
            self._object.vertices.extend([float(attributes[axis]) for axis in "xyz"])
        elif tag == "triangle":
            self._object.faces.extend([int(attributes[corner]) for corner in ("v1", "v2", "v3")])
            if self._colors:
                self._shade(attributes)
            if self._names_materials:
                self._object.materials.append(self._material(attributes))
        elif tag in self._readers:
            self._readers[tag](attributes)
        elif tag in ("beamlattice", "booleanshape", "levelset"):
            raise MeshFileError(f"contains <{tag}>, which is not supported. Export it as triangles")

    def _begin_group(self, attributes: dict[str, str]) -> None:
        self._allowance.reserve(_OBJECT_BYTES)
        self._group = self._groups.setdefault(attributes["id"], [])
        self._names_of_group = self._names.setdefault(attributes["id"], [])

    def _add_color(self, attributes: dict[str, str]) -> None:
        """Add a color and its name to the current group."""
        self._allowance.reserve(_COLOR_BYTES)
        color = attributes.get("displaycolor", attributes.get("color", ""))
        match = _COLOR.fullmatch(color)
        self._group.append(bytes.fromhex(match[1]) if match else GRAY.tobytes())
        self._names_of_group.append(attributes.get("name", ""))

    def _begin_object(self, attributes: dict[str, str]) -> None:
        self._allowance.reserve(_OBJECT_BYTES)
        self._object = _MeshObject(attributes.get("name", ""))
        self._object.default_property = attributes.get("pid", ""), attributes.get("pindex", "0")
        self.objects[attributes["id"]] = self._object

    def _begin_model(self, attributes: dict[str, str]) -> None:
        """Read the unit of the model.

        Raises MeshFileError if the model requires an unsupported extension.
        """
        self.unit = attributes.get("unit", self.unit)
        for prefix in attributes.get("requiredextensions", "").split():
            extension = attributes.get(f"xmlns:{prefix}", prefix)
            if not _SUPPORTED.search(extension):
                raise MeshFileError(
                    f"requires the extension {extension[:80]}, which is not supported. Export it "
                    "without the extension"
                )

    def _material(self, attributes: dict[str, str]) -> str:
        """Return the name of the material at a triangle's first corner, or an empty string."""
        group, number = self._object.default_property
        index = int(attributes.get("p1", number))
        names = self._names.get(attributes.get("pid", group), [])
        return names[index] if 0 <= index < len(names) else ""

    def _shade(self, attributes: dict[str, str]) -> None:
        """Add the colors of a triangle's corners, or gray if there are none."""
        group, number = self._object.default_property
        group = attributes.get("pid", group)
        first = attributes.get("p1", number)
        indices = [int(attributes.get(name, first)) for name in ("p1", "p2", "p3")]
        colors = self._groups.get(group, [])
        has_colors = all(0 <= index < len(colors) for index in indices)
        self.gray_count += bool(group) and not has_colors
        for index in indices:
            self._object.shades.frombytes(colors[index] if has_colors else GRAY.tobytes())

    def _placement(self, attributes: dict[str, Any]) -> _Placement:
        """Read a component or a build item."""
        self._allowance.reserve(_OBJECT_BYTES)
        path = next((v for k, v in attributes.items() if k.rpartition(":")[2] == "path"), "")
        matrix = np.eye(4)
        if "transform" in attributes:
            numbers = np.array(attributes["transform"].split(), np.float64)
            if numbers.shape != (12,):
                raise ValueError(f"a transform has {len(numbers)} numbers; expected 12")
            matrix[:3] = numbers.reshape(4, 3).T
        key = path.lstrip("/") or self._name, attributes["objectid"]
        return _Placement(key, attributes.get("partnumber", ""), matrix)
