"""Files of vertices and polygons: .obj, .off, .ply and .stl, with all their digits.

trimesh reads all four, but fills non-convex polygons beyond their outline, drops what it does not
understand, and refuses negative indices in .obj files of several objects and binary .ply files with
triangles and quadrangles. assimp and Open3D keep single precision. plyfile trusts the counts of
headers, and its licence would apply to a program that uses it.
"""

from __future__ import annotations

import re
import struct
from array import array
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import AnyArray, Floats, Ints
from ...base.words import as_text
from ..colours import Colours, as_bytes
from ..scene_mesh import SceneMesh
from .mtl import MtlMaterials
from .polygons import check_corners, triangulated
from .scene_graph import Content, MeshFileError, Piece, ReadOptions, join_pieces


def _ints(numbers: array[int]) -> Ints:
    return np.frombuffer(numbers, np.int64)


# -- .obj ----------------------------------------------------------------------------------------

_MOST = 1 << 62  # texture coordinates that a number may name


@dataclass
class _ObjPolygons:
    """Polygons of one object, while they are read; lists of Python would take ten times as much."""

    corners: array[int] = field(default_factory=lambda: array("q"))  # vertices, from 0
    places: array[int] = field(default_factory=lambda: array("q"))  # their texture coordinates
    sizes: array[int] = field(default_factory=lambda: array("q"))  # corners of each polygon
    kinds: array[int] = field(default_factory=lambda: array("q"))  # its material, a number

    def triangles(self, vertices: Floats) -> tuple[Ints, Ints, Ints]:
        """Vertices (t, 3), texture coordinates (t, 3) and materials (t,) of triangles."""
        corners = _ints(self.corners)
        sizes = _ints(self.sizes)
        check_corners(corners, len(vertices))
        if not self.kinds:  # as a whole, without materials
            own = triangulated(vertices, corners, sizes)
            return own, own, np.zeros(len(own), np.int64)
        own = triangulated(vertices[corners], np.arange(len(corners)), sizes)
        kinds = np.repeat(_ints(self.kinds), sizes)
        return corners[own], _ints(self.places)[own], kinds[own[:, 0]]


def read_obj(data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read a Wavefront file: an object for each name after 'o', or 'g' without any 'o'.

    A repeated name begins another object after 'o', and continues the group after 'g', as the
    format says. Objects are in order of their first face; materials do not divide them. Without
    masks, triangles are solid; without these, colours and wanted materials, neither files of
    materials nor images are read.
    """
    masks = wanted.masks
    colours = wanted.colours
    text = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = text.replace(b"\\\n", b" ").replace(b"\t", b" ")
    divider = b"o" if re.search(rb"^ *o ", text, re.MULTILINE) else b"g"
    libraries = _obj_names(b"mtllib", text) if masks or colours else []
    materials = MtlMaterials(path, len(data), libraries, wanted)
    dressed = materials.has_masks or colours or wanted.materials
    numbers = array("d")
    coordinates = array("d")
    tints = array("d")
    parts = {(path.stem, 0): _ObjPolygons()}  # {(name, number of the line 'o'): polygons}
    # {material: its number}
    part = parts[path.stem, 0]
    kind = 0
    kinds = {b"": 0}
    for line in text.split(b"\n"):
        key, _, rest = line.lstrip(b" ").partition(b" ")
        if key == b"v":
            words = rest.partition(b"#")[0].split()  # a weight or a colour may follow
            if len(words) < 3:
                raise ValueError(f"a vertex has {len(words)} numbers, '{_shown(line)}'")
            numbers.extend(map(float, words[:3]))
            if colours and len(words) >= 6:
                tints.extend(map(float, words[-3:]))
        elif key == b"f":
            rest = rest.partition(b"#")[0]
            corners = _obj_corners(rest, len(numbers) // 3, line)
            part.corners.extend(corners)
            part.sizes.append(len(corners))
            if dressed:
                part.places.extend(_obj_places(rest, len(coordinates) // 2))
                part.kinds.append(kind)
        elif key == divider:
            key_of_part = as_text(rest.strip()) or path.stem, len(parts) if divider == b"o" else 0
            part = parts.setdefault(key_of_part, _ObjPolygons())
        elif key == b"usemtl":
            kind = kinds.setdefault(rest.strip(), len(kinds))
        elif key == b"vt" and dressed:
            coordinates.extend(_obj_coordinates(rest))
    vertices = np.frombuffer(numbers).reshape(-1, 3)
    uv = np.frombuffer(coordinates).reshape(-1, 2)
    tinted = None
    if colours and len(tints) == len(numbers):
        tinted = as_bytes(_shares(np.frombuffer(tints).reshape(-1, 3)))
    names = list(kinds)
    meshes = list[SceneMesh]()
    for (name, _), part in parts.items():
        faces, at, kind_of = part.triangles(vertices)
        pieces = []
        for number in np.unique(kind_of).tolist():
            rows = np.flatnonzero(kind_of == number)
            material = names[number]
            cutout = materials.cutout(material, uv, at[rows])
            corners_of = None if tinted is None else tinted[faces[rows]]
            shown = materials.colours(material, uv, at[rows], corners_of)
            named = as_text(material) if wanted.materials else ""
            pieces.append(Piece(vertices, faces[rows], cutout, shown, named))
        meshes += join_pieces(name, pieces)
    return Content(meshes, notes=materials.notes.lines())


def _obj_names(key: bytes, text: bytes) -> list[bytes]:
    """Find what follows a word at the beginning of lines, each once and in order."""
    found = re.findall(rb"^ *%s +(.*)$" % key, text, re.MULTILINE)
    return list(dict.fromkeys(name.strip() for name in found))


def _obj_coordinates(rest: bytes) -> list[float]:
    """Two texture coordinates; NaN where there is no number."""
    try:
        u, v = [*map(float, rest.partition(b"#")[0].split()[:2]), 0.0][:2]
    except ValueError:
        u = v = np.nan
    return [u, v]


def _obj_places(rest: bytes, count: int) -> list[int]:
    """Texture coordinates of a face's corners, from 0, or below; `count` are known so far."""
    words = [word.split(b"/") for word in rest.split()]
    try:
        numbers = [min(int(word[1]), _MOST) for word in words]
    except (IndexError, ValueError):
        return [-1] * len(words)
    return [number - 1 if number >= 0 else max(-1, count + number) for number in numbers]


def _obj_corners(rest: bytes, count: int, line: bytes) -> list[int]:
    """Vertices of a face, from 0; `count` are known so far."""
    words = rest.split()
    if b"/" in rest:
        words = [word.partition(b"/")[0] for word in words]
    numbers = list(map(int, words))
    if numbers and min(numbers) <= 0:  # rare, and found by this one check
        if 0 in numbers or min(numbers) < -count:
            raise ValueError(f"'{_shown(line)}' refers to a missing vertex")
        return [number - 1 if number > 0 else count + number for number in numbers]
    return [number - 1 for number in numbers]


def _shown(line: bytes) -> str:
    return as_text(line.strip()[:60])


# -- .off ----------------------------------------------------------------------------------------

# Normals (N), colours (C) and texture coordinates (ST) may follow the position of a vertex. Some
# files have the counts on the line of the word.
_OFF = re.compile(rb"(?:ST)?C?N?OFF(?![A-Z])", re.IGNORECASE)


def read_off(data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read an Object File Format file: one mesh; colours are those of vertices (COFF)."""
    text = re.sub(rb"#[^\r\n]*", b"", data).lstrip()
    found = _OFF.match(text)
    text = text[found.end() if found else 0 :]
    if text.lstrip().upper().startswith(b"BINARY"):
        raise MeshFileError("is binary OFF, which is not supported: export it as text, or as .ply")
    lines = [line.split() for line in text.splitlines() if line.strip()]
    counts = lines.pop(0) if lines else []
    if len(counts) < 2 or not all(count.isdigit() for count in counts):
        raise ValueError("no OFF header with the numbers of vertices and faces")
    points, polygons = map(int, counts[:2])
    if len(lines) != points + polygons:
        raise ValueError(
            f"{points:,} vertices and {polygons:,} faces announced, each in a line of its own, and "
            f"{len(lines):,} lines there"
        )
    numbers = array("d")
    tints = array("d")
    corners = array("q")
    sizes = array("q")
    coloured = wanted.colours and found is not None and found[0].upper() == b"COFF"
    for line in lines[:points]:
        if len(line) < 3:
            raise ValueError(f"a vertex has {len(line)} numbers")
        numbers.extend(map(float, line[:3]))  # a colour may follow
        if coloured and len(line) >= 6:
            tints.extend(map(float, line[3:6]))
    for line in lines[points:]:
        size = int(line[0])
        if not 0 <= size < len(line):
            raise ValueError(f"a face of {size} corners has {len(line) - 1}")
        corners.extend(map(int, line[1 : size + 1]))
        sizes.append(size)
    vertices = np.frombuffer(numbers).reshape(-1, 3)
    faces = triangulated(vertices, _ints(corners), _ints(sizes))
    shown = None
    if coloured and len(tints) == len(numbers):
        shown = _tinted(_shares(np.frombuffer(tints).reshape(-1, 3)), faces)
    return Content(join_pieces(path.stem, [Piece(vertices, faces, None, shown)]))


def _shares(colours: Floats) -> Floats:
    """Shares of colours that are written as 0 to 1 or, if one is above 1.5, as 0 to 255."""
    return colours / (255 if (colours > 1.5).any() else 1)


def _tinted(shares: Floats, faces: Ints) -> Colours:
    """Colours of vertices, (v, 3), 0 to 1."""
    return Colours.of_corners(as_bytes(shares)[faces])


# -- .stl ----------------------------------------------------------------------------------------


def read_stl(data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read a stereolithography file: one mesh if binary, one for each solid if text."""
    announced = int.from_bytes(data[80:84], "little")
    # A few more bytes may follow; in a text file the number does not fit.
    if len(data) >= 84 and 0 <= len(data) - 84 - 50 * announced < 50:
        rows = np.frombuffer(data, np.uint8, 50 * announced, 84).reshape(-1, 50)
        corners = np.ascontiguousarray(rows[:, 12:48]).view("<f4").astype(np.float64)
        return Content(_stl_mesh(path.stem, corners.reshape(-1, 3)))
    text = data.replace(b"\r", b"\n")
    solids = re.split(rb"^[ \t]*solid\b", text, flags=re.MULTILINE | re.IGNORECASE)[1:]
    if not solids:
        raise MeshFileError(
            f"announces {announced:,} triangles and has {max(0, len(data) - 84) // 50:,}: it is "
            "cut short, or not an .stl file"
        )
    meshes: list[SceneMesh] = []
    for solid in solids:
        head, _, body = solid.partition(b"\n")
        if b"endsolid" not in solid.lower():
            raise MeshFileError("is cut short: it does not end with 'endsolid'")
        words = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", body, re.IGNORECASE)
        vertices = np.array(list(map(float, chain.from_iterable(words)))).reshape(-1, 3)
        if len(vertices) != 3 * len(re.findall(rb"\bendfacet", body, re.IGNORECASE)):
            raise ValueError("a facet is not a triangle")
        meshes += _stl_mesh(as_text(head.strip()) or path.stem, vertices)
    return Content(meshes)


def _stl_mesh(name: str, corners: Floats) -> list[SceneMesh]:
    """One mesh of triangles that share no vertices."""
    faces = np.arange(len(corners)).reshape(-1, 3)
    return [SceneMesh(name, corners, faces)] if len(faces) else []


# -- .ply ----------------------------------------------------------------------------------------

_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_PLY_LISTS = ("vertex_indices", "vertex_index")
_PLY_COLOURS = ("red", "green", "blue")


@dataclass
class _Element:
    """An element of a .ply header."""

    name: str
    count: int
    # {name: (type of the number, type of the length where it is a list, else '')}
    properties: dict[str, tuple[str, str]] = field(default_factory=dict)


def read_ply_mesh(data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read a Stanford polygon file: text or binary, faces of any mixture.

    Colours are red, green and blue of its vertices: integers, or real numbers from 0 to 1 or 255.
    """
    elements, order, body = _ply_header(data)
    counts = {element.name: element.count for element in elements}
    # Their types, before text is read as real numbers.
    types = {element.name: element.properties for element in elements}
    if counts.get("tristrips"):
        raise MeshFileError("has triangle strips, which are not read: export it with faces")
    if not counts.get("face"):
        raise MeshFileError(
            "is a point cloud, it has no faces: make a mesh of it by lidarpool scene points"
        )
    rows = _ply_rows(elements, order, body)
    vertices = _ply_vertices(rows)
    name = next((name for name in _PLY_LISTS if name in rows["face"]), None)
    if name is None:
        raise ValueError(f"its faces have no {_PLY_LISTS[0]}")
    numbers, sizes = rows["face"][name]
    corners = numbers.astype(np.int64)
    if not np.array_equal(corners, numbers):
        raise ValueError("vertex indices of faces are not whole numbers")
    faces = triangulated(vertices, corners, sizes)
    shown = None
    if wanted.colours and all(name in rows["vertex"] for name in _PLY_COLOURS):
        given = np.stack([rows["vertex"][name][0] for name in _PLY_COLOURS], axis=1)
        given = given.astype(np.float64)
        kind = np.dtype(types["vertex"]["red"][0])
        # Integers of four bytes hold 0 to 255, too.
        small = kind.kind in "iu" and kind.itemsize < 4
        shown = _tinted(given / np.iinfo(kind).max if small else _shares(given), faces)
    return Content(join_pieces(path.stem, [Piece(vertices, faces, None, shown)]))


def read_ply_points(data: bytes) -> Floats:
    """Read the vertices of a Stanford polygon file: (n, 3)."""
    return _ply_vertices(_ply_rows(*_ply_header(data)))


def read_ply_columns(data: bytes) -> dict[str, AnyArray]:
    """Read the properties of vertices of a Stanford polygon file, but lists: {name: (n,)}."""
    rows = _ply_rows(*_ply_header(data)).get("vertex", {})
    return {name: values for name, (values, sizes) in rows.items() if (sizes == 1).all()}


def _ply_vertices(rows: _Rows) -> Floats:
    if missing := [axis for axis in "xyz" if axis not in rows.get("vertex", {})]:
        raise ValueError(f"its vertices have no {', '.join(missing)}")
    return np.stack([rows["vertex"][axis][0] for axis in "xyz"], axis=1).astype(np.float64)


def _ply_header(data: bytes) -> tuple[list[_Element], str, bytes]:
    """Elements, byte order ('' of text) and what follows the header."""
    found = re.match(rb"ply[ \t]*\r?\n(.*?\n)??end_header[ \t]*\r?\n", data, re.DOTALL)
    found = found or re.match(rb"ply\r(.*?\r)??end_header\r", data, re.DOTALL)
    if not found:
        raise ValueError("no PLY header, or cut within it")
    elements: list[_Element] = []
    order = ""
    for line in (found[1] or b"").decode("latin-1").splitlines():
        match line.split():
            case ["format", kind, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
            case ["element", name, count]:
                if int(count) < 0:
                    raise ValueError(f"{count} rows of {name[:20]} announced")
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name]:
                elements[-1].properties[name] = _PLY_TYPES[kind], _PLY_TYPES[length]
            case ["property", kind, name]:
                elements[-1].properties[name] = _PLY_TYPES[kind], ""
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"'{line[:60]}' is not a line of a PLY header")
    return elements, order, data[found.end() :]


# {element: {property: its numbers in all rows, how many each row has}}
_Rows = dict[str, dict[str, tuple[AnyArray, Ints]]]


def _ply_rows(elements: list[_Element], order: str, body: bytes) -> _Rows:
    """All rows of all elements.

    Text is read in double precision, whatever type its header states: georeferenced vertices are
    often declared `float` and have more digits.
    """
    if not order:
        words = np.array(list(map(float, body.split())))
        body = words.tobytes()
        for element in elements:
            kinds = element.properties.items()
            element.properties = {name: ("f8", "f8" * bool(n)) for name, (_, n) in kinds}
    rows: _Rows = {}
    at = 0
    for element in elements:
        if element.count and not element.properties:
            raise ValueError(f"rows of {element.name[:20]} announced, without content")
        rows[element.name], at = _element_rows(element, order or "=", body, at)
    rest = body[at:].strip(b"\0\r\n\t ") if order else body[at:]
    if rest:
        raise ValueError(f"{len(rest):,} bytes more than announced")
    return rows


def _element_rows(
    element: _Element, order: str, body: bytes, at: int
) -> tuple[dict[str, tuple[AnyArray, Ints]], int]:
    """Numbers and lengths of all properties, and the end of the rows."""
    count = element.count
    names = list(element.properties)
    kinds = {name: np.dtype(order + kind) for name, (kind, _) in element.properties.items()}
    first, end = (
        _ply_row(element, kinds, order, body, at) if count else ([(at, 1)] * len(names), at)
    )
    # The type of a row as long as the first: usually all are, and are read at once.
    row: list[Any] = []
    for (name, (_, length)), (_, n) in zip(element.properties.items(), first, strict=True):
        row += [(f"{name} length", order + length, (1,))] if length else []
        row += [(name, kinds[name], (n,))]
    if at + (end - at) * count <= len(body):
        table = np.frombuffer(body, np.dtype(row), count, at)
        found = {
            name: (table[name].reshape(-1), np.full(count, n))
            for name, (_, n) in zip(names, first, strict=True)
        }
        lists = [name for name in names if element.properties[name][1]]
        if all((table[f"{name} length"][:, 0] == found[name][1]).all() for name in lists):
            return found, at + (end - at) * count
    spans = array("q")  # tuples would take ten times as much
    for _ in range(count):
        each, at = _ply_row(element, kinds, order, body, at)
        spans.extend(chain.from_iterable(each))
    raw = np.frombuffer(body, np.uint8)
    found = {}
    columns = np.frombuffer(spans, np.int64).reshape(count, len(names), 2)
    for column, (name, kind) in enumerate(kinds.items()):
        starts, sizes = columns[:, column].T
        # Bytes of all numbers, in order.
        within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        places = np.repeat(starts, sizes) + kind.itemsize * within
        found[name] = raw[places[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0], sizes
    return found, at


def _ply_row(
    element: _Element, kinds: dict[str, np.dtype[Any]], order: str, body: bytes, at: int
) -> tuple[list[tuple[int, int]], int]:
    """Start and count of the numbers of each property of a row; the row's end."""
    out = []
    for name, (_, length) in element.properties.items():
        n = 1
        if length:
            (n,) = struct.unpack_from(order + np.dtype(length).char, body, at)
            if n < 0 or n != int(n):
                raise ValueError(f"a list has the length {n}")
            at = at + int(length[1])
            n = int(n)
        out.append((at, n))
        at += n * kinds[name].itemsize
    if at > len(body):
        raise ValueError(
            f"{element.count:,} rows of {element.name[:20]} announced, but there are fewer"
        )
    return out, at
