"""Readers of .obj, .off, .ply and .stl files, which contain vertices and polygons.

trimesh is not used because it fills nonconvex polygons beyond their outline, ignores unknown
content, and rejects negative indices in .obj files with several objects and binary .ply files with
triangles and quadrilaterals. assimp and Open3D reduce coordinates to single precision. plyfile
trusts the counts in headers, and its license would extend to programs that use it.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import CutShortError
from ...numerics.arrays import AnyArray, Bytes, Floats, Ints
from ...words import decode_name
from ..colors import Colors, as_bytes
from ..scene_mesh import SceneMesh
from .mtl import MtlMaterials
from .polygons import check_corners, triangulate
from .scene_graph import Content, MeshFileError, Piece, ReadOptions, join_pieces


def _ints(numbers: array[int]) -> Ints:
    """Wrap a Python array in a NumPy array without copying the data."""
    return np.frombuffer(numbers, np.int64)


def _int_array() -> array[int]:
    return array("q")


def _float_array() -> array[float]:
    return array("d")


# -- .obj ----------------------------------------------------------------------------------------

_MAX_COORDINATE = 1 << 62  # limit for the indices of texture coordinates


class _ObjTriangles(NamedTuple):
    vertices: Ints  # (t, 3), indices of vertices
    coordinates: Ints  # (t, 3), indices of texture coordinates
    materials: Ints  # (t,), indices of materials


@dataclass
class _ObjPolygons:
    """Polygons of an object that is being read.

    Arrays are used because lists would require ten times as much memory.
    """

    corners: array[int] = field(default_factory=_int_array)  # indices of vertices
    coordinates: array[int] = field(default_factory=_int_array)  # indices of texture coordinates
    sizes: array[int] = field(default_factory=_int_array)  # number of corners of each polygon
    materials: array[int] = field(default_factory=_int_array)  # material index of each polygon

    def triangles(self, vertices: Floats) -> _ObjTriangles:
        corners = _ints(self.corners)
        sizes = _ints(self.sizes)
        check_corners(corners, len(vertices))
        if not self.materials:  # polygons were read without materials
            faces = triangulate(vertices, corners, sizes)
            return _ObjTriangles(faces, faces, np.zeros(len(faces), np.int64))
        faces = triangulate(vertices[corners], np.arange(len(corners)), sizes)
        materials = np.repeat(_ints(self.materials), sizes)
        return _ObjTriangles(corners[faces], _ints(self.coordinates)[faces], materials[faces[:, 0]])


@dataclass
class _ObjContent:
    """Vertices, texture coordinates and polygons of a file."""

    objects: dict[tuple[str, int], _ObjPolygons]  # {(name, index of the 'o' statement): polygons}
    positions: array[float] = field(default_factory=_float_array)  # x, y, z of each vertex
    coordinates: array[float] = field(default_factory=_float_array)  # u, v
    tints: array[float] = field(default_factory=_float_array)  # red, green, blue of each vertex
    materials: list[bytes] = field(default_factory=list)  # names

    @cached_property
    def vertices(self) -> Floats:
        """Vertex positions of shape (v, 3)."""
        return np.frombuffer(self.positions).reshape(-1, 3)

    @cached_property
    def uv(self) -> Floats:
        """Texture coordinates of shape (c, 2)."""
        return np.frombuffer(self.coordinates).reshape(-1, 2)

    @cached_property
    def vertex_colors(self) -> Bytes | None:
        """Vertex colors of shape (v, 3), or None unless all vertices have a color."""
        if not self.tints or len(self.tints) != len(self.positions):
            return None
        return as_bytes(_color_shares(np.frombuffer(self.tints).reshape(-1, 3)))


def read_obj(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read a Wavefront (.obj) file.

    There is an object for each 'o' statement, or for each 'g' statement if there are no 'o'
    statements. If a name is repeated after 'o', it starts another object. After 'g', it continues
    the group, as the format defines. Objects are in the order of these statements and are not split
    by materials. If `options.masks` is not set, all triangles are opaque. Material files and images
    are only read if required by the options.
    """
    text = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = text.replace(b"\\\n", b" ").replace(b"\t", b" ")
    libraries = _obj_names(b"mtllib", text) if options.masks or options.colors else []
    materials = MtlMaterials(path, len(data), libraries, options)
    with_materials = materials.has_masks or options.colors or options.materials
    meshes = list[SceneMesh]()
    try:
        content = _parse_obj(text, path.stem, options.colors, with_materials)
        for (name, _), polygons in content.objects.items():
            pieces = _obj_pieces(content, polygons, materials, options)
            meshes += join_pieces(name, pieces)
    except (ValueError, OverflowError) as error:  # integers beyond 64 bits raise OverflowError
        raise ValueError(_obj_mistake(data, options.colors) or str(error)) from error
    return Content(meshes, notes=materials.notes.lines())


def _parse_obj(text: bytes, stem: str, with_colors: bool, with_materials: bool) -> _ObjContent:
    """Parse the lines of a Wavefront file.

    Polygons before the first named object belong to the object `stem`.
    """
    divider = b"o" if re.search(rb"^ *o ", text, re.MULTILINE) else b"g"
    polygons = _ObjPolygons()
    content = _ObjContent({(stem, 0): polygons})
    positions = content.positions
    material = 0
    materials = {b"": 0}  # {name: index}
    for line in text.split(b"\n"):
        key, _, value = line.lstrip(b" ").partition(b" ")
        if key == b"v":
            words = value.partition(b"#")[0].split()  # a weight or a color may follow
            if len(words) < 3:
                raise ValueError("a vertex has fewer than three numbers")
            positions.extend(map(float, words[:3]))
            if with_colors and len(words) >= 6:
                content.tints.extend(map(float, words[-3:]))
        elif key == b"f":
            value = value.partition(b"#")[0]
            corners = _obj_corners(value, len(positions) // 3)
            polygons.corners.extend(corners)
            polygons.sizes.append(len(corners))
            if with_materials:
                count = len(content.coordinates) // 2
                polygons.coordinates.extend(_obj_coordinate_rows(value, count))
                polygons.materials.append(material)
        elif key == divider:
            number = len(content.objects) if divider == b"o" else 0
            name = decode_name(value.strip()) or stem
            polygons = content.objects.setdefault((name, number), _ObjPolygons())
        elif key == b"usemtl":
            material = materials.setdefault(value.strip(), len(materials))
        elif key == b"vt" and with_materials:
            content.coordinates.extend(_obj_coordinates(value))
    content.materials = list(materials)
    return content


def _obj_pieces(
    content: _ObjContent, polygons: _ObjPolygons, materials: MtlMaterials, options: ReadOptions
) -> list[Piece]:
    """Split the triangles of an object into one piece per material."""
    vertices = content.vertices
    uv = content.uv
    tints = content.vertex_colors
    triangles = polygons.triangles(vertices)
    pieces = []
    for number in np.unique(triangles.materials).tolist():
        rows = np.flatnonzero(triangles.materials == number)
        material = content.materials[number]
        faces = triangles.vertices[rows]
        coordinates = triangles.coordinates[rows]
        cutout = materials.cutout(material, uv, coordinates)
        corner_colors = None if tints is None else tints[faces]
        colors = materials.colors(material, uv, coordinates, corner_colors)
        name = decode_name(material) if options.materials else ""
        pieces.append(Piece(vertices, faces, cutout, colors, name))
    return pieces


def _obj_names(key: bytes, text: bytes) -> list[bytes]:
    """Return the distinct values of all statements with a keyword, in order."""
    values = re.findall(rb"^ *%s +(.*)$" % key, text, re.MULTILINE)
    return list(dict.fromkeys(name.strip() for name in values))


def _obj_coordinates(value: bytes) -> list[float]:
    """Parse two texture coordinates.

    Both are NaN if a word is not a number.
    """
    try:
        u, v = [*map(float, value.partition(b"#")[0].split()[:2]), 0.0][:2]
    except ValueError:
        u = v = np.nan
    return [u, v]


def _obj_coordinate_rows(value: bytes, count: int) -> list[int]:
    """Return the texture coordinate indices of a face, or -1 for missing ones.

    `count` is the number of texture coordinates that have been read so far.
    """
    words = [word.split(b"/") for word in value.split()]
    try:
        numbers = [min(int(word[1]), _MAX_COORDINATE) for word in words]
    except (IndexError, ValueError):
        return [-1] * len(words)
    return [number - 1 if number >= 0 else max(-1, count + number) for number in numbers]


def _obj_corners(value: bytes, count: int) -> list[int]:
    """Return the vertex indices of a face.

    `count` is the number of vertices that have been read so far. Raise ValueError if a negative
    index refers to a vertex before the first one.
    """
    words = value.split()
    if b"/" in value:
        words = [word.partition(b"/")[0] for word in words]
    numbers = list(map(int, words))
    if numbers and min(numbers) <= 0:  # a single check, since negative numbers are rare
        if 0 in numbers or min(numbers) < -count:
            raise ValueError("a face refers to a missing vertex")
        return [number - 1 if number > 0 else count + number for number in numbers]
    return [number - 1 for number in numbers]


def _obj_mistake(data: bytes, with_colors: bool) -> str | None:
    """Describe the first invalid line of a file, or return None if there is none.

    Each line is checked without considering other lines.
    """
    total = len(re.findall(rb"^[ \t]*v[ \t]", data, re.MULTILINE))
    count = 0  # vertices read so far
    for number, line in _logical_lines(data):
        key, *words = line.partition(b"#")[0].split() or [b""]
        if key == b"v":
            count += 1
            colors = words[-3:] if with_colors and len(words) >= 6 else []
            if len(words) < 3 or not all(map(_is_real, [*words[:3], *colors])):
                return f"line {number} is '{_shown(line)}', but three numbers were expected after v"
        elif key == b"f":
            vertices = [word.partition(b"/")[0] for word in words]
            if not all(re.fullmatch(rb"[-+]?\d+", vertex) for vertex in vertices):
                return (
                    f"line {number} is '{_shown(line)}', but vertex numbers were expected after f"
                )
            if not all(
                1 <= int(vertex) <= total or -count <= int(vertex) < 0 for vertex in vertices
            ):
                return (
                    f"line {number} is '{_shown(line)}', which refers to a missing vertex. The "
                    f"file has {total:,} vertices"
                )
    return None


def _logical_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a file with their line numbers.

    Lines that end with a backslash are joined with the next line.
    """
    joined = b""
    first = 0
    for number, line in enumerate(re.split(rb"\r\n|\r|\n", data), 1):
        first = first or number
        joined += line
        if joined.endswith(b"\\"):
            joined = joined[:-1] + b" "
            continue
        yield first, joined
        joined = b""
        first = 0


def _is_real(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _shown(line: bytes) -> str:
    """Return the start of a line for error messages."""
    return decode_name(line.strip()[:60])


# -- .off ----------------------------------------------------------------------------------------

# Normals (N), colors (C) and texture coordinates (ST) can follow the position of a vertex. Some
# files have the counts in the same line as the keyword.
_OFF = re.compile(rb"(?:ST)?C?N?OFF(?![A-Z])", re.IGNORECASE)


def read_off(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read an Object File Format (.off) file as a single mesh.

    Vertex colors (COFF) are also read.
    """
    uncommented = re.sub(rb"#[^\r\n]*", b"", data).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = uncommented.lstrip()
    keyword = _OFF.match(text)
    text = text[keyword.end() if keyword else 0 :]
    if text.lstrip().upper().startswith(b"BINARY"):
        raise MeshFileError(
            "is a binary OFF file, which is not supported. Export it as text, or as .ply"
        )
    first_line = 1 + uncommented[: len(uncommented) - len(text)].count(b"\n")
    vertex_lines, face_lines = _off_lines(text, first_line)
    is_colored = options.colors and keyword is not None and keyword[0].upper() == b"COFF"
    vertices, tints = _off_vertices(vertex_lines, is_colored=is_colored)
    corners, sizes = _off_faces(face_lines, len(vertices))
    faces = triangulate(vertices, corners, sizes)
    colors = None
    if is_colored and len(tints) == len(vertices):
        colors = _vertex_colors(_color_shares(tints), faces)
    return Content(join_pieces(path.stem, [Piece(vertices, faces, None, colors)]))


_NumberedLine = tuple[int, list[bytes]]  # (line number, words)


def _off_lines(text: bytes, first_line: int) -> tuple[list[_NumberedLine], list[_NumberedLine]]:
    """Return the vertex lines and the face lines after the line with the counts.

    `first_line` is the line number of the first line of `text`.
    """
    lines = [
        (number, line.split())
        for number, line in enumerate(text.split(b"\n"), first_line)
        if line.strip()
    ]
    number, counts = lines.pop(0) if lines else (first_line, [])
    if len(counts) < 2 or not all(count.isdigit() for count in counts):
        raise ValueError(_off_mistake(number, counts, "the numbers of vertices and faces"))
    points, polygons = map(int, counts[:2])
    if len(lines) != points + polygons:
        failure = CutShortError if len(lines) < points + polygons else ValueError
        raise failure(
            f"{points:,} vertices and {polygons:,} faces are declared, each in a separate line, "
            f"but there are {len(lines):,} lines"
        )
    return lines[:points], lines[points:]


def _off_vertices(lines: Sequence[_NumberedLine], *, is_colored: bool) -> tuple[Floats, Floats]:
    """Parse the vertices, and the colors of those vertices that have one."""
    numbers = array("d")
    tints = array("d")
    for number, words in lines:
        try:
            x, y, z = map(float, words[:3])
            if is_colored and len(words) >= 6:
                tints.extend(map(float, words[3:6]))
        except ValueError as error:
            raise ValueError(_off_mistake(number, words, "x, y and z of a vertex")) from error
        numbers.extend((x, y, z))
    return np.frombuffer(numbers).reshape(-1, 3), np.frombuffer(tints).reshape(-1, 3)


def _off_faces(lines: Sequence[_NumberedLine], count: int) -> tuple[Ints, Ints]:
    """Return the corners of all faces and the number of corners of each face.

    `count` is the number of vertices.
    """
    corners = array("q")
    sizes = array("q")
    for number, words in lines:
        try:
            size = int(words[0])
            rows = list(map(int, words[1 : size + 1]))
        except ValueError:
            size = -1
            rows = []
        if len(rows) != size or (rows and not 0 <= min(rows) <= max(rows) < count):
            raise ValueError(
                _off_mistake(
                    number,
                    words,
                    f"a number of corners and that many vertex numbers from 0 to {count - 1:,}",
                )
            )
        corners.extend(rows)
        sizes.append(size)
    return _ints(corners), _ints(sizes)


def _off_mistake(number: int, words: Sequence[bytes], expected: str) -> str:
    return f"line {number} is '{_shown(b' '.join(words))}', but {expected} were expected"


def _color_shares(colors: Floats) -> Floats:
    """Scale colors to the range 0 to 1.

    If any value is above 1.5, all values are assumed to range from 0 to 255.
    """
    return colors / (255 if (colors > 1.5).any() else 1)


def _vertex_colors(shares: Floats, faces: Ints) -> Colors:
    """Convert vertex colors between 0 and 1 to face colors."""
    return Colors.from_vertex_colors(as_bytes(shares)[faces])


# -- .stl ----------------------------------------------------------------------------------------


def read_stl(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read a stereolithography (.stl) file.

    A binary file contains a single mesh. A text file contains a mesh for each solid.
    """
    announced = int.from_bytes(data[80:84], "little")
    # A few more bytes can follow. In a text file, the number does not match the size.
    if len(data) >= 84 and 0 <= len(data) - 84 - 50 * announced < 50:
        rows = np.frombuffer(data, np.uint8, 50 * announced, 84).reshape(-1, 50)
        corners = np.ascontiguousarray(rows[:, 12:48]).view("<f4").astype(np.float64)
        return Content(_stl_mesh(path.stem, corners.reshape(-1, 3)))
    text = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    solids = re.split(rb"^[ \t]*solid\b", text, flags=re.MULTILINE | re.IGNORECASE)[1:]
    if not solids:
        raise MeshFileError(
            f"declares {announced:,} triangles but has {max(0, len(data) - 84) // 50:,}. It is "
            "truncated, or not an .stl file"
        )
    meshes: list[SceneMesh] = []
    for solid in solids:
        head, _, body = solid.partition(b"\n")
        if b"endsolid" not in solid.lower():
            raise CutShortError("it does not end with 'endsolid'")
        words = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", body, re.IGNORECASE)
        try:
            vertices = np.array(list(map(float, chain.from_iterable(words)))).reshape(-1, 3)
        except ValueError as error:
            raise ValueError(_stl_mistake(text) or str(error)) from error
        facets = len(re.findall(rb"\bendfacet", body, re.IGNORECASE))
        if len(vertices) != 3 * facets:
            raise ValueError(
                _stl_mistake(text)
                or f"a solid has {len(vertices):,} vertices, but {facets:,} facets of three "
                "vertices each"
            )
        meshes += _stl_mesh(decode_name(head.strip()) or path.stem, vertices)
    return Content(meshes)


def _stl_mistake(text: bytes) -> str | None:
    """Describe the first error in a text file, or return None if all facets are valid."""
    count = 0
    for number, line in enumerate(text.split(b"\n"), 1):
        key, *words = line.lower().split() or [b""]
        if key == b"facet":
            count = 0
        elif key == b"vertex":
            count += 1
            if len(words) < 3 or not all(map(_is_real, words[:3])):
                return f"line {number} is '{_shown(line)}', but vertex x y z was expected"
        elif key == b"endfacet" and count != 3:
            return f"the facet that ends in line {number} has {count} vertices instead of three"
    return None


def _stl_mesh(name: str, corners: Floats) -> list[SceneMesh]:
    """Convert separate triangles to a list with one mesh.

    The list is empty if there are no triangles.
    """
    faces = np.arange(len(corners)).reshape(-1, 3)
    return [SceneMesh(name, corners, faces)] if len(faces) else []


# -- .ply ----------------------------------------------------------------------------------------

_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_LINE = (
    "but format, element NAME COUNT, property TYPE NAME, property list TYPE TYPE NAME or comment "
    "was expected"
)
_PLY_LISTS = ("vertex_indices", "vertex_index")
_PLY_COLORS = ("red", "green", "blue")


@dataclass
class _Element:
    """Declaration of an element in a .ply header."""

    name: str
    count: int
    # {name: (type of the values, type of the list length, or '' for a single value)}
    properties: dict[str, tuple[str, str]] = field(default_factory=dict)


class _PlyColumn(NamedTuple):
    """A property's values in all rows of an element."""

    numbers: AnyArray  # (sum of sizes,)
    sizes: Ints  # (rows,), number of values in each row


_PlyRows = dict[str, dict[str, _PlyColumn]]  # {element: {property: column}}


class _PlyHeader(NamedTuple):
    """The header of a .ply file, and the bytes that follow it."""

    elements: list[_Element]
    order: str  # byte order, or '' for text
    body: bytes
    lines: int  # number of header lines
    comments: list[str]  # including obj_info


def read_ply_mesh(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read a Stanford polygon (.ply) file.

    The file can be text or binary, and its polygons can have different numbers of corners. Vertex
    colors are the properties red, green and blue. They are integers, or floating-point numbers from
    0 to 1 or 255.
    """
    header = _ply_header(data)
    counts = {element.name: element.count for element in header.elements}
    # These are the declared types, which `_ply_rows` changes for text files.
    types = {element.name: element.properties for element in header.elements}
    if counts.get("tristrips"):
        raise MeshFileError("has triangle strips, which are not supported. Export it with faces")
    if not counts.get("face"):
        raise MeshFileError(
            "is a point cloud without faces. Convert it to a mesh with lidarpool scene points"
        )
    rows = _ply_rows(header)
    vertices = _ply_vertices(rows)
    faces = _ply_faces(rows, vertices)
    colors = None
    if options.colors and all(name in rows["vertex"] for name in _PLY_COLORS):
        colors = _ply_colors(rows, types["vertex"]["red"][0], faces)
    return Content(join_pieces(path.stem, [Piece(vertices, faces, None, colors)]))


def _ply_faces(rows: _PlyRows, vertices: Floats) -> Ints:
    name = next((name for name in _PLY_LISTS if name in rows["face"]), None)
    if name is None:
        raise ValueError(f"its faces have no {_PLY_LISTS[0]}")
    numbers, sizes = rows["face"][name]
    corners = numbers.astype(np.int64)
    if not np.array_equal(corners, numbers):
        raise ValueError("the vertex indices of faces must be integers")
    return triangulate(vertices, corners, sizes)


def _ply_colors(rows: _PlyRows, type_name: str, faces: Ints) -> Colors:
    """Convert the vertex colors, which are stored with the given type, to face colors."""
    columns = [rows["vertex"][name].numbers for name in _PLY_COLORS]
    colors = np.stack(columns, axis=1).astype(np.float64)
    kind = np.dtype(type_name)
    # Four-byte integers range from 0 to 255, like some floating-point colors.
    if kind.kind in "iu" and kind.itemsize < 4:
        return _vertex_colors(colors / np.iinfo(kind).max, faces)
    return _vertex_colors(_color_shares(colors), faces)


def read_ply_columns(data: bytes) -> dict[str, AnyArray]:
    """Read the vertex properties of a Stanford polygon (.ply) file, keyed by name.

    List properties are omitted. Each column has shape (n,).
    """
    rows = _ply_rows(_ply_header(data)).get("vertex", {})
    return {name: values for name, (values, sizes) in rows.items() if (sizes == 1).all()}


def ply_comments(data: bytes) -> list[str]:
    """Return the comments of a Stanford polygon (.ply) file, including obj_info lines."""
    return _ply_header(data).comments


def _ply_vertices(rows: _PlyRows) -> Floats:
    if missing := [axis for axis in "xyz" if axis not in rows.get("vertex", {})]:
        raise ValueError(f"its vertices have no {', '.join(missing)}")
    return np.stack([rows["vertex"][axis].numbers for axis in "xyz"], axis=1).astype(np.float64)


def _ply_header(data: bytes) -> _PlyHeader:
    """Parse the header of a .ply file, or raise ValueError if it is invalid."""
    header_match = re.match(rb"ply[ \t]*\r?\n(.*?\n)??end_header[ \t]*\r?\n", data, re.DOTALL)
    header_match = header_match or re.match(rb"ply\r(.*?\r)??end_header\r", data, re.DOTALL)
    if not header_match:
        if data.startswith(b"ply"):
            raise CutShortError("its header has no end_header line")
        raise ValueError("its first line is not 'ply'")
    elements: list[_Element] = []
    comments: list[str] = []
    order = ""
    for number, line in enumerate((header_match[1] or b"").decode("latin-1").splitlines(), 2):
        match line.split():
            case ["format", kind, *_] if kind in _PLY_ORDERS:
                order = _PLY_ORDERS[kind]
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name] if (
                elements and {length, kind} <= _PLY_TYPES.keys()
            ):
                elements[-1].properties[name] = _PLY_TYPES[kind], _PLY_TYPES[length]
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1].properties[name] = _PLY_TYPES[kind], ""
            case [] | ["comment" | "obj_info"]:
                pass
            case ["comment" | "obj_info", *words]:
                comments.append(" ".join(words))
            case _:
                raise ValueError(f"line {number} is '{line[:60]}', {_PLY_LINE}")
    lines = len(header_match[0].splitlines())
    return _PlyHeader(elements, order, data[header_match.end() :], lines, comments)


def _ply_rows(header: _PlyHeader) -> _PlyRows:
    """Return all rows of all elements.

    Text is read in double precision regardless of the declared type, because georeferenced vertices
    are often declared as `float` but have more digits.
    """
    elements, order, body, *_ = header
    if not order:
        try:
            words = np.array(list(map(float, body.split())))
        except ValueError as error:
            raise ValueError(_text_mistake(header) or str(error)) from error
        body = words.tobytes()
        for element in elements:
            kinds = element.properties.items()
            element.properties = {name: ("f8", "f8" * bool(n)) for name, (_, n) in kinds}
    rows: _PlyRows = {}
    start = 0
    for element in elements:
        if element.count and not element.properties:
            raise ValueError(f"rows of {element.name[:20]} are declared, but without properties")
        reader = _PlyElementReader(element, order or "=", body)
        rows[element.name], start = reader.read(start)
    remaining = body[start:].strip(b"\0\r\n\t ") if order else body[start:]
    if remaining:
        surplus = f"{len(remaining):,} bytes" if order else f"{len(remaining) // 8:,} numbers"
        raise ValueError(f"{surplus} more than declared")
    return rows


def _text_mistake(header: _PlyHeader) -> str | None:
    """Describe the first invalid line of a text body, or return None if there is none."""
    for number, line in enumerate(header.body.splitlines(), header.lines + 1):
        for word in line.split():
            if not _is_real(word):
                return f"line {number} has '{_shown(word)}', but a number was expected"
    return None


class _PlyElementReader:
    """A reader of an element's rows."""

    def __init__(self, element: _Element, order: str, body: bytes) -> None:
        self._element = element
        self._order = order
        self._body = body
        self._kinds = {
            name: np.dtype(order + kind) for name, (kind, _) in element.properties.items()
        }

    def read(self, start: int) -> tuple[dict[str, _PlyColumn], int]:
        """Return the columns of all properties, and the offset after the last row."""
        count = self._element.count
        sizes = [1] * len(self._kinds)
        stop = start
        if count:
            spans, stop = self._row(start)
            sizes = [size for _, size in spans]
        table_stop = start + (stop - start) * count
        if table_stop <= len(self._body):
            columns = self._equal_rows(start, sizes)
            if columns is not None:
                return columns, table_stop
        return self._unequal_rows(start)

    def _equal_rows(self, start: int, sizes: list[int]) -> dict[str, _PlyColumn] | None:
        """Read all rows as a table, or return None if rows have different numbers of values.

        In most files, all rows have the same number of values.
        """
        count = self._element.count
        properties = self._element.properties
        row: list[Any] = []
        for (name, (_, length)), size in zip(properties.items(), sizes, strict=True):
            row += [(f"{name} length", self._order + length, (1,))] if length else []
            row += [(name, self._kinds[name], (size,))]
        table = np.frombuffer(self._body, np.dtype(row), count, start)
        columns = {
            name: _PlyColumn(table[name].reshape(-1), np.full(count, size))
            for name, size in zip(properties, sizes, strict=True)
        }
        lists = [name for name, (_, length) in properties.items() if length]
        if all((table[f"{name} length"][:, 0] == columns[name].sizes).all() for name in lists):
            return columns
        return None

    def _unequal_rows(self, start: int) -> tuple[dict[str, _PlyColumn], int]:
        """Read rows with different numbers of values, and return the offset after the last row."""
        count = self._element.count
        spans = array("q")  # tuples would require ten times as much memory
        offset = start
        for _ in range(count):
            row_spans, offset = self._row(offset)
            spans.extend(chain.from_iterable(row_spans))
        raw = np.frombuffer(self._body, np.uint8)
        columns = {}
        table = np.frombuffer(spans, np.int64).reshape(count, len(self._kinds), 2)
        for column, (name, kind) in enumerate(self._kinds.items()):
            starts, sizes = table[:, column].T
            # Compute the offsets of all values in order.
            within_row = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
            offsets = np.repeat(starts, sizes) + kind.itemsize * within_row
            numbers = raw[offsets[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0]
            columns[name] = _PlyColumn(numbers, sizes)
        return columns, offset

    def _row(self, start: int) -> tuple[list[tuple[int, int]], int]:
        """Return the offset and length of each property in a row, and the offset after the row."""
        element = self._element
        body = self._body
        spans = []
        offset = start
        for name, (_, length) in element.properties.items():
            size = 1
            if length:
                if offset + int(length[1]) > len(body):
                    raise self._cut_short()
                (size,) = struct.unpack_from(self._order + np.dtype(length).char, body, offset)
                if not (0 <= size < np.inf and size == int(size)):
                    raise ValueError(
                        f"a list in {element.name[:20]} has the length {size:g}, but a whole "
                        "number of at least 0 was expected"
                    )
                offset += int(length[1])
                size = int(size)
            spans.append((offset, size))
            offset += size * self._kinds[name].itemsize
        if offset > len(body):
            raise self._cut_short()
        return spans, offset

    def _cut_short(self) -> CutShortError:
        count = self._element.count
        return CutShortError(
            f"{count:,} rows of {self._element.name[:20]} are declared, but there are fewer"
        )
