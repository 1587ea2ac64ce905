"""Files whose faces are polygons, .ply, .obj and .off, as programs write them."""

import re
import struct

import numpy as np
import pytest
import trimesh
from tests.lidarpool.meshes import PLY, write

from lidarpool.base.errors import LidarpoolError
from lidarpool.scene.meshfile import load_meshes

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


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_a_cut_ply_of_mixed_faces_is_refused(tmp_path, order):
    content = ply_roof(order, after="texcoord").rstrip(b"\n")
    # Of the last number in a text, "0.25", a part may be missing that nobody misses.
    for cut in range(1 if order else 4, len(content), 3):
        with pytest.raises(LidarpoolError):
            load_meshes(write(tmp_path / "roof.ply", content[:-cut]))


def test_more_bytes_than_a_ply_announces(tmp_path):
    path = write(tmp_path / "roof.ply", ply_roof("<") + b"\n\0")
    assert len(load_meshes(path)[0].faces) == 6
    with pytest.raises(LidarpoolError, match="4 bytes more than announced"):
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
    with pytest.raises(LidarpoolError, match="broken"):
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


def test_a_wall_keeps_its_door_open(tmp_path):
    wall = [(0, 0), (2, 0), (2, 2), (3, 2), (3, 0), (5, 0), (5, 3), (0, 3)]
    rows = "".join(f"{x} 0 {z}\n" for x, z in wall)
    path = write(tmp_path / "wall.off", f"OFF 8 1 0\n{rows}8 0 1 2 3 4 5 6 7\n")
    (mesh,) = load_meshes(path)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area == pytest.approx(13)


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
