"""Read COLLADA files (.dae) according to specification 1.4.1 (Khronos Group, 2008).

Triangles are read with the diffuse colors and images of their materials. Lights, cameras, and
animations are not read.

pycollada is not used. It drops geometry with an unresolved material, skin, or morph, holes in
polygons, and offsets of accessors. It refuses comments, images without paths, and unusual colors,
and it reduces coordinates to single precision. assimp 5.4 is not used either. It refused twice as
many of 661 public files, skips missing geometries, reduces coordinates to single precision, and
crashes if nodes contain each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.io.xmlfile import xml_root
from lidarsim.numerics.arrays import AnyArray, Bytes, Floats, Ints
from lidarsim.numerics.vectors import matmul, norm
from lidarsim.scene.colors import Colors, as_bytes
from lidarsim.scene.files.companions import image_file
from lidarsim.scene.files.polygons import (
    check_corners,
    fan_triangles,
    triangulate,
    triangulate_with_holes,
    unroll_strip,
)
from lidarsim.scene.files.scene_graph import (
    SMALLER,
    Content,
    MeshFileError,
    Node,
    Piece,
    ReadOptions,
    join_pieces,
    placed_content,
    placed_nodes,
)
from lidarsim.scene.masks import MaskError, MaskNotes, Texture, Wrap, cache_with_errors, read_colors
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.transform import affine, rotation_about

_WRAPS: dict[str, Wrap] = {"CLAMP": "clamp", "BORDER": "clamp", "MIRROR": "mirror"}
_SURFACES = ("triangles", "polylist", "polygons", "tristrips", "trifans")


class _Inputs(NamedTuple):
    """The points of a primitive, and how the numbers in <p> are arranged."""

    points: Floats  # (v, 3)
    offset: int  # position of the point index among the numbers of a corner
    stride: int  # number of values per corner


def read_dae(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read a file's visual scene, including the colors and names of materials."""
    root = xml_root(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag != "COLLADA":
        raise MeshFileError(
            f"is an XML file, but not a COLLADA file. Its root element is <{root.tag[:40]}>"
        )
    allowance = Allowance(len(data), SMALLER)
    paint = _Effects(path, options, allowance) if options.colors else None
    document = _Document(root, allowance, paint, options)
    content = placed_content(placed_nodes(document.roots(), document.node, path.stem))
    content.notes = paint.notes.lines() if paint else []
    unit = root.find("asset/unit[@meter]")
    if unit is not None:
        meter = unit.attrib["meter"]
        content.unit_m = float(meter) if _is_number(meter, np.float64) else np.nan
        if not 0 < content.unit_m < np.inf:
            raise ValueError(f"the unit is {meter[:40]!r} meters, but it must be a positive number")
    axis = (root.findtext("asset/up_axis") or "").strip()
    content.up_axis = axis[:1].lower() if axis in ("X_UP", "Z_UP") else "y"  # default
    return content


class _Document:
    """The elements in a file, by ID.

    Each geometry is read only once.
    """

    def __init__(
        self, root: Element, allowance: Allowance, paint: _Effects | None, options: ReadOptions
    ) -> None:
        self._root = root
        self._allowance = allowance
        self._paint = paint
        self._names_materials = options.materials
        self._skins_at_rest = options.skins_at_rest
        # The tag is part of the key, because some programs give a scene and its node the same ID.
        self._ids: dict[tuple[str, str], Element] = {}
        for element in root.iter():
            self._ids.setdefault((element.tag, element.get("id", "")), element)
        self._geometry = cache(self._read_geometry)
        self._points = cache(self._read_points)
        self._floats = cache(_numbers)

    def roots(self) -> list[Element]:
        """Return a list with the visual scene that the file selects, or else the first one."""
        shown = self._root.find("scene/instance_visual_scene")
        if shown is not None:
            return [self._target(shown, "visual_scene")]
        return self._root.findall("library_visual_scenes/visual_scene")[:1]

    def node(self, element: Element) -> Node:
        """Read a <node> or a <visual_scene> as a node."""
        meshes: list[SceneMesh] = []
        children = []
        matrix = np.eye(4)
        is_skinned = False
        for child in element:
            if child.tag == "node":
                children.append(child)
            elif child.tag == "instance_node":
                children.append(self._target(child, "node"))
            elif child.tag == "instance_geometry":
                bound = self._bound_materials(child) if self._paint or self._names_materials else ()
                meshes += self._geometry(self._target(child, "geometry"), bound)
            elif child.tag == "instance_controller" and self._skins_at_rest:
                meshes += self._skin(self._target(child, "controller"), child)
                is_skinned = True
            elif child.tag == "instance_controller":
                raise MeshFileError(
                    "deforms vertices with a skin (skeleton) or a morph, which is not "
                    "supported. Apply the deformation before you export the file"
                )
            elif child.tag in _STEPS:
                matrix = matmul(matrix, _step(child))
            elif child.tag == "skew":
                raise MeshFileError(
                    "contains <skew>, which is not supported. Apply the transform before you "
                    "export the file"
                )
        name = element.get("name", "") if element.tag == "node" else ""
        return Node(name, matrix, meshes, children, skinned=is_skinned)

    def _skin(self, controller: Element, instance: Element) -> list[SceneMesh]:
        """Return the meshes of a skin in its rest pose, in file coordinates."""
        skin = controller.find("skin")
        if skin is None:
            raise MeshFileError(
                "deforms vertices with a morph, which is not supported. Apply the morph before "
                "you export the file"
            )
        bound = self._bound_materials(instance) if self._paint or self._names_materials else ()
        shape = skin.find("bind_shape_matrix")
        matrix = np.eye(4) if shape is None else _numbers(shape)
        if matrix.size != 16:
            raise ValueError(
                f"{_tag(skin)} has a bind_shape_matrix with {matrix.size} numbers; expected 16"
            )
        matrix = matrix.reshape(4, 4)
        return [
            mesh.affine_transform(mesh.name, matrix[:3, :3], matrix[:3, 3])
            for mesh in self._geometry(self._target(skin, "geometry"), bound)
        ]

    def _target(self, element: Element, kind: str) -> Element:
        """Return the element with the tag `kind` to which another element refers.

        Raises MeshFileError if it is not in the file.
        """
        url = element.get("source", element.get("url", ""))
        target = self._ids.get((kind, url[1:]), self._ids.get((kind, unquote(url[1:]))))
        if target is None or not url.startswith("#"):
            raise MeshFileError(
                f"contains <{element.tag}> with a reference to {url[:80]!r}, which is not in the "
                "file. Export it again"
            )
        return target

    def _read_geometry(
        self, geometry: Element, bound: tuple[tuple[str, Element], ...]
    ) -> list[SceneMesh]:
        """Return a geometry as a list with one mesh, or an empty list if it has no triangles.

        The primitives differ only in their materials. `bound` maps material symbols to the elements
        that they refer to.
        """
        name = geometry.get("name") or geometry.get("id") or ""
        for kind in ("convex_mesh", "brep"):
            if geometry.find(kind) is not None:
                raise MeshFileError(
                    f"contains <{kind}>, which is not supported. Export it as triangles"
                )
        materials = dict(bound)
        pieces = (
            self._piece(primitive, materials.get(primitive.get("material", "")))._replace(
                material=self._material_name(primitive, materials)
            )
            for primitive in geometry.findall("mesh/*")
            if primitive.tag in _SURFACES
        )
        return join_pieces(name, pieces, self._allowance)

    def _material_name(self, primitive: Element, materials: Mapping[str, Element]) -> str:
        """Return the name of a primitive's material, or an empty string."""
        symbol = primitive.get("material", "")
        if not self._names_materials or not symbol:
            return ""
        bound = materials.get(symbol)
        return symbol if bound is None else bound.get("name") or bound.get("id") or symbol

    def _bound_materials(self, instance: Element) -> tuple[tuple[str, Element], ...]:
        """Return pairs of a symbol and the material that a geometry instance assigns to it."""
        entries = instance.findall("bind_material/technique_common/instance_material")
        materials = [
            (entry.get("symbol", ""), self._ids.get(("material", entry.get("target", "")[1:])))
            for entry in entries
        ]
        return tuple((symbol, material) for symbol, material in materials if material is not None)

    def _piece(self, primitive: Element, material: Element | None) -> Piece:
        """Return a primitive's triangles, colored according to a material."""
        points, offset, stride = self._inputs(primitive)
        lists = [e for e in primitive.iter() if e.tag in ("p", "h")]
        numbers = map(_integers, lists)
        tables = [row[: len(row) // stride * stride].reshape(-1, stride) for row in numbers]
        corners = np.concatenate([np.zeros((0, stride), np.int64), *tables])
        bounds = np.cumsum([0, *map(len, tables)])
        list_corners = {e: np.arange(*bounds[k : k + 2]) for k, e in enumerate(lists)}
        check_corners(corners[:, offset], len(points))
        triangles = _triangles(primitive, points[corners[:, offset]], list_corners.__getitem__)
        rows = np.concatenate([np.zeros((0, 3), np.int64), *triangles])
        faces = corners[:, offset][rows]
        colors = None
        if self._paint and material is not None and len(faces):
            with self._paint.notes.record_color_error(
                material.get("name") or material.get("id") or ""
            ):
                colors = self._colors(self._paint, primitive, material, corners, rows)
        return Piece(points, faces, colors=colors)

    def _colors(
        self,
        paint: _Effects,
        primitive: Element,
        material: Element,
        corners: Ints,
        triangle_corners: Ints,
    ) -> Colors | None:
        """Return the colors of triangles, or None if the material's effect has no color.

        `corners` (c, stride) are the numbers in <p>, and `triangle_corners` (t, 3) are the rows of
        `corners` that form the triangles.
        """
        url = material.find("instance_effect[@url]")
        assert url is not None
        shade = paint.shade(self._target(url, "effect"), self._ids)
        if isinstance(shade, Texture):
            uv, offset = self._coordinates(primitive)
            return shade.colors(uv, corners[:, offset][triangle_corners])
        return None if shade is None else Colors.plain(shade, len(triangle_corners))

    def _coordinates(self, primitive: Element) -> tuple[Floats, int]:
        """Return texture coordinates. Also return the offset of their indices in <p>."""
        inputs = [e for e in primitive.findall("input") if e.get("semantic") == "TEXCOORD"]
        if not inputs:
            raise MaskError("texture coordinates are missing")
        first = min(inputs, key=lambda entry: _whole_number(entry, "set"))
        s, t = self._rows(self._target(first, "source"))[:, :2].T
        return np.column_stack([s, 1 - t]), _whole_number(first, "offset")

    def _inputs(self, primitive: Element) -> _Inputs:
        """Read the points of a primitive.

        Raises ValueError if there are none.
        """
        stride = 0
        points = None
        offset = 0
        for entry in primitive.findall("input"):
            entry_offset = _whole_number(entry, "offset")
            stride = max(stride, entry_offset + 1)
            if entry.get("semantic") == "VERTEX":
                points = self._points(self._target(entry, "vertices"))
                offset = entry_offset
        if points is None:
            raise ValueError(f"{_tag(primitive)} has no <input> with the semantic VERTEX")
        return _Inputs(points, offset, stride)

    def _read_points(self, vertices: Element) -> Floats:
        """Return the positions that <vertices> refers to."""
        entry = vertices.find("input[@semantic='POSITION']")
        if entry is None:
            raise ValueError(f"{_tag(vertices)} has no <input> with the semantic POSITION")
        source = self._target(entry, "source")
        rows = self._rows(source)
        accessor = source.findall("technique_common/accessor/param")
        # Parameters without a name are skipped.
        names = [parameter.get("name") for parameter in accessor]
        columns = [names.index(axis) for axis in "XYZ" if axis in names]
        if len(columns) != 3:
            return rows[:, :3]
        self._allowance.reserve(24 * len(rows))
        return rows[:, columns]

    def _rows(self, source: Element) -> Floats:
        """Return the numbers in a <source> as a table. Shape (count, stride)."""
        accessor = source.find("technique_common/accessor")
        if accessor is None:
            raise ValueError(f"{_tag(source)} has no <accessor>")
        numbers = self._floats(self._target(accessor, "float_array"))
        count = _whole_number(accessor, "count")
        stride = _whole_number(accessor, "stride", 1)
        offset = _whole_number(accessor, "offset")
        if min(count, offset, stride - 1) < 0 or offset + count * stride > len(numbers):
            raise ValueError(
                f"{_tag(source)} declares {count:,} x {stride} numbers but contains "
                f"{len(numbers):,}"
            )
        return numbers[offset : offset + count * stride].reshape(count, stride)


class _Effects:
    """Reads the diffuse colors of effects.

    Each image is read only once.
    """

    def __init__(self, path: Path, options: ReadOptions, allowance: Allowance) -> None:
        self.notes = MaskNotes()
        self._path = path
        self._options = options
        self._allowance = allowance
        self._texture = cache_with_errors(self._read_texture)

    def shade(self, effect: Element, ids: dict[tuple[str, str], Element]) -> Texture | Bytes | None:
        """Return the image or color of an effect, or None if it has neither."""
        diffuse = effect.find(".//technique/*/diffuse")
        if diffuse is None:
            return None
        texture = diffuse.find("texture")
        color = diffuse.findtext("color")
        if texture is None:
            if color is None:
                return None
            return as_bytes(np.array(color.split()[:3], np.float64)).reshape(1, 1, 3)
        # A texture refers to a sampler, which refers to a surface, which refers to an image. Some
        # programs omit the sampler or both.
        parameters = {e.get("sid", ""): e for e in effect.iter("newparam")}
        name = texture.get("texture", "")
        wrap_s = ""
        wrap_t = ""
        for _ in range(2):
            if (parameter := parameters.get(name)) is not None:
                wrap_s = parameter.findtext(".//wrap_s", wrap_s)
                wrap_t = parameter.findtext(".//wrap_t", wrap_t)
                image_name = (
                    parameter.findtext(".//source") or parameter.findtext(".//init_from") or ""
                )
                image_link = parameter.find(".//instance_image")
                name = image_name.strip() if image_link is None else image_link.get("url", "")[1:]
        image = ids.get(("image", name))
        if image is None:
            raise MaskError(f"its image {name[-80:]!r} is not defined in the file")
        file = image.findtext("init_from/ref") or image.findtext("init_from") or ""
        return self._texture((file.strip(), wrap_s, wrap_t))

    def _read_texture(self, key: tuple[str, str, str]) -> Texture:
        """Read an image as a texture.

        `key` consists of its name and the wrap modes along s and t.
        """
        name, *wraps = key
        file = image_file(self._path, name, self._options, self._allowance)
        wrap_s, wrap_t = (_WRAPS.get(wrap, "repeat") for wrap in wraps)
        image = read_colors(file, self._allowance, self.notes)
        return Texture(image, (wrap_s, wrap_t), self._allowance)


def _triangles(
    primitive: Element, points: Floats, corners: Callable[[Element], Ints]
) -> Iterator[Ints]:
    """Yield arrays of triangles for a primitive.

    `corners` returns the corners in a <p> or <h>.
    """
    lists = [corners(p) for p in primitive.findall("p")]
    if primitive.tag == "triangles":
        yield from (row[: len(row) // 3 * 3].reshape(-1, 3) for row in lists)
    elif primitive.tag == "tristrips":
        yield from map(unroll_strip, lists)
    elif primitive.tag == "trifans":
        yield from map(fan_triangles, lists)
    elif primitive.tag == "polylist" and lists:
        counts = primitive.find("vcount")
        sizes = np.zeros(0, np.int64) if counts is None else _integers(counts)
        joined_corners = np.concatenate(lists)
        if (sizes < 0).any() or sizes.sum() != len(joined_corners):
            raise ValueError(
                f"{_tag(primitive)} declares polygons with {sizes.sum():,} corners but contains "
                f"{len(joined_corners):,}"
            )
        yield triangulate(points, joined_corners, sizes)
    elif primitive.tag == "polygons":
        if lists:
            sizes = np.array([len(row) for row in lists])
            yield triangulate(points, np.concatenate(lists), sizes)
        for holed in primitive.findall("ph"):
            yield triangulate_with_holes(points, [corners(ring) for ring in holed])


def _integers(element: Element) -> Ints:
    return _words(element, np.int64, "integers")


def _numbers(element: Element) -> Floats:
    return _words(element, np.float64, "numbers")


def _words(element: Element, kind: type, expected: str) -> AnyArray:
    """Convert the text of an element to an array of the given type.

    Raises ValueError if the text contains anything else.
    """
    words = (element.text or "").split()
    try:
        return np.array(words, kind)
    except (ValueError, OverflowError) as error:
        word = next(word for word in words if not _is_number(word, kind))
        raise ValueError(
            f"{_tag(element)} contains {word[:40]!r}, but {expected} were expected"
        ) from error


def _is_number(word: str, kind: type) -> bool:
    """Return True if a word can be converted to the given number type."""
    try:
        np.array([word], kind)
    except (ValueError, OverflowError):
        return False
    return True


def _whole_number(element: Element, attribute: str, default: int = 0) -> int:
    """Return an attribute as an integer.

    Raises ValueError if it is not an integer.
    """
    text = element.get(attribute, str(default))
    try:
        return int(text)
    except ValueError as error:
        raise ValueError(
            f"{_tag(element)} has {attribute}={text[:40]!r}; expected an integer"
        ) from error


def _tag(element: Element) -> str:
    """Format the start tag of an element for messages, for example ``<source id='positions'>``."""
    name = element.get("id") or element.get("sid")
    return f"<{element.tag} id={name[:40]!r}>" if name else f"<{element.tag}>"


def _step(element: Element) -> Floats:
    """Return the matrix that a transform element describes.

    Raises ValueError if it has the wrong number of values.
    """
    numbers = _numbers(element)
    count, matrix_of = _STEPS[element.tag]
    if len(numbers) != count:
        raise ValueError(f"{_tag(element)} has {len(numbers)} numbers; expected {count}")
    return matrix_of(numbers)


def _rotate(numbers: Floats) -> Floats:
    """Return a rotation by an angle about an axis, or the identity if the axis is zero.

    The angle is in degrees.
    """
    *axis, degrees = numbers
    return affine(rotation_about(axis, degrees) if np.any(axis) else np.eye(3), np.zeros(3))


def _look_at(numbers: Floats) -> Floats:
    """Return the matrix for nine numbers: a camera position, a target, and an up vector."""
    eye, target, up = numbers.reshape(3, 3)
    z = (eye - target) / norm(eye - target)
    x = np.cross(up, z) / norm(np.cross(up, z))
    return affine(np.stack([x, np.cross(z, x), z], axis=1), eye)


_STEPS: dict[str, tuple[int, Callable[[Floats], Floats]]] = {  # {tag: (numbers, their matrix)}
    "translate": (3, lambda numbers: affine(np.eye(3), numbers)),
    "rotate": (4, _rotate),
    "scale": (3, lambda numbers: np.diag([*numbers, 1.0])),
    "matrix": (16, lambda numbers: numbers.reshape(4, 4)),
    "lookat": (9, _look_at),
}
