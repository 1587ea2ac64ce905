"""Files whose faces are polygons, .ply, .obj and .off, as programs write them."""

from __future__ import annotations

import itertools
import re
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from tests.meshes import PLY, write

from lidarsim import LidarError
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.files.polygons import MAX_CORNERS, triangulate, triangulate_with_holes

CORNERS = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 3]], dtype=float)
ROOF = [[0, 3, 2, 1], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]  # a square under four triangles
ROOF_AREA = 4 + 4 * np.sqrt(10)


def ply_roof(order, *, before="", after="", count="uchar", index="int", line="\n"):
    """A .ply of quadrangle and triangles, with more properties before and after the corners.

    Those before are a byte; those after a list of floats, as texture coordinates are.
    """
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = ["ply", f"format {kind} 1.0", "comment end_header is below", "element vertex 5"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"element face {len(ROOF)}"]
    header += [f"property uchar {before}"] * bool(before)
    header += [f"property list {count} {index} vertex_indices"]
    header += [f"property list uchar float {after}"] * bool(after)
    body = b"" if order else b"".join(b"%r %r %r\n" % tuple(row) for row in CORNERS.tolist())
    body = CORNERS.astype(f"{order}f8").tobytes() if order else body
    codes = {"uchar": "B", "uint": "I", "ushort": "H", "int": "i"}
    for face in ROOF:
        values = [("B", 7)] * bool(before) + [(codes[count], len(face))]
        values += [(codes[index], corner) for corner in face]
        values += [("B", 2), ("f", 0.5), ("f", 0.25)] if after else []
        if order:
            body += struct.pack(order + "".join(c for c, _ in values), *(v for _, v in values))
        else:
            body += " ".join(str(value) for _, value in values).encode() + line.encode()
    return "".join(part + line for part in [*header, "end_header"]).encode() + body


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize(
    "more",
    [
        {},
        {"before": "flags", "after": "texcoord"},
        {"count": "uint", "index": "ushort"},
        {"line": "\r\n"},
    ],
    ids=str,
)
def test_ply_faces_of_any_mixture(tmp_path, order, more):
    path = write(tmp_path / "roof.ply", ply_roof(order, **more))
    (roof,) = load_meshes(path)
    assert len(roof.faces) == 6
    mesh = trimesh.Trimesh(roof.vertices, roof.faces, process=False)
    assert mesh.area == pytest.approx(ROOF_AREA)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4)


@pytest.mark.extended
@pytest.mark.parametrize("order", ["", "<", ">"])
def test_a_cut_ply_of_mixed_faces_is_refused(tmp_path, order):
    content = ply_roof(order, after="texcoord").rstrip(b"\n")
    # Of the last number in a text, "0.25", a part may be missing that nobody misses.
    for cut in range(1 if order else 4, len(content), 3):
        with pytest.raises(LidarError):
            load_meshes(write(tmp_path / "roof.ply", content[:-cut]))


def test_more_bytes_than_a_ply_announces(tmp_path):
    path = write(tmp_path / "roof.ply", ply_roof("<") + b"\n\0")
    assert len(load_meshes(path)[0].faces) == 6
    with pytest.raises(LidarError, match="4 bytes more than declared"):
        load_meshes(write(path, ply_roof("<") + b"more"))


@pytest.mark.parametrize("kind", ["char", "int"])
@pytest.mark.parametrize("face", [0, 3])
def test_a_list_of_negative_length_is_not_the_rest_of_the_file(tmp_path, kind, face):
    path = tmp_path / "roof.ply"
    length = np.dtype({"char": "<i1", "int": "<i4"}[kind])
    lists = [(np.array(len(row), length), np.array(row, "<i4")) for row in ROOF]
    lists[face] = (np.array(-1, length), lists[face][1])
    header = ply_roof("<").partition(b"end_header\n")[0].replace(b"uchar", kind.encode())
    body = CORNERS.tobytes() + b"".join(part.tobytes() for row in lists for part in row)
    with pytest.raises(LidarError, match="a list in face has the length -1, but a whole number"):
        load_meshes(write(path, header + b"end_header\n" + body))


def test_a_ply_header_as_programs_write_it(tmp_path):
    header, _, body = PLY.partition("end_header\n")
    header = header.replace("ply\n", "ply  \ncomment von Jörg Müller\nobj_info 3 übrig\n\n")
    header = header.replace("vertex 4", "  vertex\t4 ")
    header = header.replace("double z", "double z\nproperty uchar red")
    lines = re.sub(r" 1$", " 1 0.5", body, flags=re.MULTILINE).replace("\n3", "\n\n  3").encode()
    path = write(tmp_path / "m.ply", header.encode("latin-1") + b"end_header \n" + lines)
    assert len(load_meshes(path)[0].faces) == 2


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_ply_faces_without_corners_and_elements_without_rows(tmp_path, order, recwarn):
    content = ply_roof(order).replace(
        b"end_header\n", b"element edge 0\nproperty int a\nend_header\n"
    )
    content = content.replace(b"face 5", b"face 6")
    empty = b"0\n" if not order else b"\0"
    (roof,) = load_meshes(write(tmp_path / "roof.ply", content + empty))
    assert len(roof.faces) == 6
    assert not recwarn.list


V = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "objects"),
    [
        (V + "f -4 -3 -2 -1\n", {"m": 2}),
        ("o A\n" + V + "f -4 -3 -2\no B\n" + V + "f -3 -2 -1\n", {"A": 1, "B": 1}),
        (V + "vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3//1\nf 1/1 3/1 4/1\n", {"m": 2}),
        (V.replace(" ", "\t") + "f\t1\t2\t3\n", {"m": 1}),
        (("  " + V + "f 1 2 3").replace("\n", "\r\n    "), {"m": 1}),
        (V + "f 1 2 \\\n3 4 # a square\n", {"m": 2}),
        ("v 0 0 0 1 0 0 # red\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\n", {"m": 1}),
        (V + "g left wing\nf 1 2 3\ng right\nf 1 2 3\ng left wing\nf 1 3 4\n",
         {"left wing": 2, "right": 1}),
        (V + "f 1 2 3\no A\ng one\nf 1 2 3\ng two\nf 1 3 4\n", {"m": 1, "A": 2}),
        ("mtllib gone.mtl\n" + V + "usemtl x\nf 1 2 3\nl 1 2\np 4\n", {"m": 1}),
        (V + "f 1 2\nf 1 2 3\n", {"m": 1}),
        ("\ufeffo Stühle 椅子\n" + V + "f 1 2 3\n", {"Stühle 椅子": 1}),
        (("o Stühle\n" + V + "f 1 2 3\n").encode("latin-1"), {"Stühle": 1}),
        ("o \x1b[31mred\x07\n" + V + "f 1 2 3\n", {"[31mred": 1}),
        (V + "v nan nan nan\nf 1 2 3\n", {"m": 1}),
    ],
)  # fmt: skip
def test_obj_as_programs_write_it(tmp_path, text, objects):
    meshes = load_meshes(write(tmp_path / "m.obj", text))
    assert {mesh.name: len(mesh.faces) for mesh in meshes} == objects


@pytest.mark.parametrize(
    ("text", "triangles"),
    [
        ("COFF 4 1 0\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n1 1 0 1 0 0 1\n0 1 0 1 0 0 1\n4 0 1 2 3", 2),
        ("OFF # of mine\n\n3 1 3\n0 0 0\n1 0 0 # right\n0 1 0\n3 0 1 2 255 0 0\n", 1),
        # As in ModelNet40.
        ("OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", 1),
        ("OFF\r\n4 2 0\r\n0 0 0\r\n1 0 0\r\n1 1 0\r\n0 1 0\r\n3 0 1 2\r\n2 0 1\r\n", 1),
    ],
)
def test_off_as_programs_write_it(tmp_path, text, triangles):
    assert len(load_meshes(write(tmp_path / "m.off", text))[0].faces) == triangles


# A wall with a door in it, an arrow, a comb and a spiral, anticlockwise.
SHAPES = {
    "triangle": [(0, 0), (2, 0), (0, 1)],
    "square": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "arrow": [(0, 0), (2, -1), (0, 3), (-2, -1)],
    "hexagon": [(2, 0), (1, 2), (-1, 2), (-2, 0), (-1, -2), (1, -2)],
    "wall": [(0, 0), (2, 0), (2, 2), (3, 2), (3, 0), (5, 0), (5, 3), (0, 3)],
    "comb": [(0, 0), (9, 0), (9, 5), (8, 1), (7, 5), (6, 1), (5, 5), (4, 1), (3, 5), (2, 1),
             (0, 5)],
    "spiral": [(0, 0), (6, 0), (6, 6), (1, 6), (1, 2), (4, 2), (4, 4), (3, 4), (3, 3), (2, 3),
               (2, 5), (5, 5), (5, 1), (0, 1)],
    "corner on an edge": [(0, 0), (1, 0), (2, 0), (2, 2), (1, 1), (0, 2)],
}  # fmt: skip


def area_vector(points):
    """Area with the direction of the outside (Newell)."""
    points = np.asarray(points, dtype=float) - points[0]
    return np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) / 2


def placed(shape, turn=0, shift=(0.0, 0.0, 0.0)):
    """A shape in space, standing upright and turned."""
    x, y = np.array(shape, dtype=float).T
    return np.stack([x * np.cos(turn), x * np.sin(turn), y], axis=1) + shift


def cut(vertices, *sizes):
    sizes = sizes or (len(vertices),)
    return triangulate(vertices, np.arange(sum(sizes)), np.array(sizes))


def area_vectors(vertices, faces):
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_is_filled_wherever_its_outline_begins(name):
    for begin, direction in itertools.product(range(len(SHAPES[name])), (1, -1)):
        shape = (SHAPES[name][begin:] + SHAPES[name][:begin])[::direction]
        vertices = placed(shape, turn=0.3)
        faces = cut(vertices)
        assert len(faces) == len(shape) - 2
        whole = area_vector(vertices)
        parts = area_vectors(vertices, faces)
        np.testing.assert_allclose(parts.sum(axis=0), whole, atol=1e-12)
        # No triangle faces the other way, so that none lies outside of the outline.
        assert (parts @ whole > -1e-12).all()


@pytest.mark.extended
@given(
    st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=3, max_size=9),
    st.sampled_from([1.0, 1e-9, 1e8, float("nan")]),
)
def test_whatever_it_is_each_polygon_gives_triangles(points, scale):
    vertices = np.array(points, dtype=float) * scale
    faces = cut(vertices)
    assert 1 <= len(faces) <= len(points) - 2
    assert all(len(set(face)) == 3 for face in faces.tolist())
    # Its neighbors stay what they are.
    square = placed(SHAPES["square"])
    among = cut(np.concatenate([square, vertices, square]), 4, len(points), 4)
    np.testing.assert_array_equal(among[:2], [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(among[2:-2], faces + 4)
    np.testing.assert_array_equal(among[-2:], among[:2] + 4 + len(points))


# What they enclose is filled, each with what it has of area.
UNUSUAL = {
    "slit to a hole": ([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1),
                        (1, 1)], 15),
    "corner twice": ([(0, 0), (2, 0), (2, 0), (2, 2), (1, 1), (0, 2)], 3),
    "there and back": ([(0, 0), (2, 0), (2, 2), (2, 5), (2, 2), (0, 2)], 4),
    "two that touch": ([(0, 0), (2, 0), (2, 2), (4, 2), (4, 4), (2, 4), (2, 2), (0, 2)], 8),
}  # fmt: skip


@pytest.mark.parametrize("name", UNUSUAL)
def test_an_unusual_outline_is_filled(name):
    shape, area = UNUSUAL[name]
    for direction, shift, scale in itertools.product((1, -1), (0.0, 5e6), (1e-6, 1, 1e6)):
        vertices = placed(shape[::direction])[:, [0, 2, 1]] * scale
        faces = cut(vertices + shift * scale)
        whole = area_vector(vertices)
        parts = area_vectors(vertices, faces)
        np.testing.assert_allclose(np.linalg.norm(parts, axis=1).sum(), area * scale**2)
        assert (parts @ whole >= 0).all()


def test_a_warped_quadrangle_keeps_both_triangles():
    # Seen from above its outline crosses itself.
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0.1, 1, 3], [2, 1, 0]], dtype=float)
    assert len(cut(vertices)) == 2


@pytest.mark.parametrize("count", [5, 6, 7])
def test_warped_polygons_lose_no_triangle(count):
    rng = np.random.default_rng(count)
    lost = 0
    for _ in range(200):
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        radii = rng.uniform(0.2, 1, count)
        heights = rng.normal(0, 2, count)
        vertices = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
        faces = cut(vertices)
        assert len(faces) == count - 2
        parts = area_vectors(vertices, faces)
        np.testing.assert_allclose(parts.sum(axis=0), area_vector(vertices), atol=1e-9)
        far = vertices + np.array([5e5, 5e6, 100.0])
        np.testing.assert_array_equal(cut(far), faces, "the same far from the origin")
        lost += len(triangulate_with_holes(vertices, [np.arange(count)])) < count - 2
    assert lost > 20, "the clipper alone fills them"


def test_a_plane_polygon_is_clipped_though_its_numbers_are_rounded():
    shape, area = UNUSUAL["slit to a hole"]
    vertices = np.round(placed(np.array(shape) / 3, turn=0.3), 6)
    parts = area_vectors(vertices, cut(vertices))
    np.testing.assert_allclose(np.linalg.norm(parts, axis=1).sum(), area / 9, rtol=1e-4)


def test_corners_that_are_not_there():
    with pytest.raises(ValueError, match="vertices 0 to 3, counted from 0, but"):
        triangulate(np.zeros((3, 3)), np.array([0, 1, 3]), np.array([3]))


def test_an_outline_without_end_is_refused_unless_it_is_convex():
    angles = np.linspace(0, 2 * np.pi, MAX_CORNERS + 1, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    assert len(cut(circle)) == MAX_CORNERS - 1
    with pytest.raises(ValueError, match="Triangulate it"):
        cut(circle * (1 + 0.5 * (np.arange(len(angles)) % 2))[:, None])
