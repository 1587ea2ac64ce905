"""Every format gives the same objects, and every broken file gives one clear error."""

import gzip
import importlib
import re
import struct
import subprocess
import sys
import types

import numpy as np
import pytest
import trimesh
from tests.meshes import PLY, write

from lidarscenes.files import formats as more_formats
from lidarscenes.files import rasters, usd
from lidarsim import LidarError, Scene
from lidarsim.scene.files.mesh_formats import endings, known_formats
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.transform import Transform

TEXT_STL = """solid a
facet normal 0 0 1
outer loop
vertex 1 0 0
vertex 0 0 0
vertex 0 1 0
endloop
endfacet
endsolid a
"""
OBJ = """# two objects
o Box
v {x} 0 0
v {x1} 0 0
v {x} 1 0
usemtl red
f 1 2 3
usemtl blue
f 1 3 2
o Ball
v 0 0 5
v 1 0 5
v 0 1 5
f 4 5 6
"""


@pytest.fixture
def two_objects():
    """Return a trimesh scene: a box at x = 10 of 1 x 2 x 3 m, and a ball at the origin."""
    scene = trimesh.Scene()
    scene.add_geometry(
        trimesh.creation.box((1, 2, 3)),
        node_name="Box A",
        geom_name="box",
        transform=trimesh.transformations.translation_matrix((10, 0, 0)),
    )
    scene.add_geometry(trimesh.creation.icosphere(1), node_name="Ball", geom_name="ball")
    return scene


def export(scene, suffix):
    content = scene.export(file_type=suffix[1:])
    return content if isinstance(content, bytes) else content.encode()


def triangles(meshes):
    """All triangles as rows, in an order that does not depend on how they were stored."""
    rows = np.concatenate([mesh.vertices[mesh.faces].mean(axis=1) for mesh in meshes])
    return rows[np.lexsort(rows.round(4).T)]


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl", ".ply", ".off", ".3mf"])
def test_formats_agree(tmp_path, two_objects, suffix):
    mesh = two_objects.to_mesh()
    names = {"two"}
    source = mesh
    if suffix in (".glb", ".3mf"):
        source = two_objects
        names = {"Box A", "Ball"}
    if suffix == ".obj":
        source = two_objects
        names = {"box", "ball"}
    path = write(tmp_path / f"two{suffix.upper()}", export(source, suffix))
    meshes = load_meshes(path, unit="m", up_axis="z")
    assert {mesh.name for mesh in meshes} == names
    assert sum(len(mesh.faces) for mesh in meshes) == len(mesh.faces)
    expected = mesh.triangles.mean(axis=1)
    np.testing.assert_allclose(
        triangles(meshes), expected[np.lexsort(expected.round(4).T)], atol=1e-5
    )


def test_gltf_is_turned_upright_unless_told(tmp_path, two_objects):
    path = write(tmp_path / "two.glb", export(two_objects, ".glb"))
    box = load_meshes(path)[0]
    # File (x, y, z) is world (x, -z, y): the box is 2 m high, its 3 m lie along y.
    np.testing.assert_allclose(np.ptp(box.vertices, axis=0), [1, 3, 2], atol=1e-6)
    as_it_is = load_meshes(path, up_axis="z")[0]
    np.testing.assert_allclose(np.ptp(as_it_is.vertices, axis=0), [1, 2, 3], atol=1e-6)


def test_obj_objects_keep_names_order_and_digits(tmp_path):
    text = OBJ.format(x="500000.123456", x1="500001.123456")
    meshes = load_meshes(write(tmp_path / "two.obj", text))
    assert [(mesh.name, len(mesh.faces)) for mesh in meshes] == [("Box", 2), ("Ball", 1)]
    assert meshes[0].vertices[:, 0].min() == 500000.123456


@pytest.mark.parametrize("kind", ["double", "float", "float32"])
def test_georeferenced_ply_keeps_all_digits_of_its_text(tmp_path, kind):
    scene = Scene.load(write(tmp_path / "geo.ply", PLY.replace("double", kind)))
    np.testing.assert_array_equal(scene.origin % 1, 0)
    world = scene.vertices + scene.origin
    np.testing.assert_array_equal(world.min(axis=0), [500000.123456, 4000000.5, 1])
    assert np.abs(scene.vertices[:, :2]).max() < 2


def test_solids_without_names_are_called_as_their_file(tmp_path):
    text = trimesh.creation.box().export(file_type="stl_ascii")
    text = f"\ufeff{text}\n{text}\n{text.replace('solid', 'solid lid')}"
    for ends in ("\n", "\r\n", "\r"):
        path = write(tmp_path / "part.stl", text.replace("\n", ends))
        assert Scene.load(path).names == ("part", "part.2", "lid")


def test_a_binary_stl_with_a_few_bytes_more_or_a_wrong_number(tmp_path):
    content = trimesh.creation.box().export(file_type="stl")
    path = write(tmp_path / "m.stl", content + bytes(49))
    assert len(load_meshes(path)[0].faces) == 12
    for number in (0, 5, 13):
        write(path, content[:80] + struct.pack("<I", number) + content[84:])
        with pytest.raises(LidarError, match=f"declares {number} triangles but has 12"):
            load_meshes(path)
    write(path, bytes(84))
    with pytest.raises(LidarError, match="contains no triangles"):
        load_meshes(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (gzip.compress(b"v 0 0 0\n", mtime=0), "is compressed"),
        (b"\n<!DOCTYPE html>", "is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"ply\nformat ascii 1.0\n", "appears to be a .ply file. Change its extension"),
        ("v 0 0 0\nf 1 1 1\n".encode("utf-16"), "encoded in UTF-16. Save it as UTF-8"),
    ],
)
def test_what_is_no_mesh_is_recognized(tmp_path, content, message):
    with pytest.raises(LidarError, match=message):
        load_meshes(write(tmp_path / "m.obj", content))


def test_objects_farther_than_anything_on_earth(tmp_path):
    """One is left out with a note, as of a body that fell for a long time; all are refused."""
    path = write(tmp_path / "m.obj", OBJ.format(x=0, x1=2e5))
    assert len(load_meshes(path)) == 2
    notes = []
    (near,) = load_meshes(path, unit="km", report=notes.append)
    assert near.name == "Ball" and np.abs(near.bounds).max() < 1e5
    assert [note.partition(" has objects ")[2] for note in notes] == [
        "farther than anything on Earth (2e+08 m from the origin), which were skipped: Box. Check "
        "their units and placement."
    ]
    away = Transform.from_parts((2e8, 0, 0))
    with pytest.raises(LidarError, match=r"Object 'Box' reaches 2e\+08 m from the origin, farther"):
        load_meshes(path, transform=away)


def test_mirrored_objects_keep_their_outside(tmp_path, two_objects):
    mesh = two_objects.to_mesh()
    path = write(tmp_path / "t.ply", mesh.export(file_type="ply"))
    mirrored = load_meshes(path, transform=Transform.from_parts(scale=(-1, 1, 1)))[0]
    assert trimesh.Trimesh(mirrored.vertices, mirrored.faces, process=False).volume == (
        pytest.approx(mesh.volume)
    )


def damaged(content, rng):
    """Content with one of the faults that disks, networks and editors make."""
    at, size = (int(rng.integers(n)) for n in (len(content), 40))
    number = rng.choice([b"-1", b"4294967295", b"9" * 20, b"1e999", b"nan", b"null"])
    return [
        content[:at] + bytes([content[at] ^ 1 << int(rng.integers(8))]) + content[at + 1 :],
        content[:at] + bytes(size) + content[at + size :],
        content[: at + size] + content[at:],
        content[:at] + re.sub(rb"\d+", number, content[at:], count=1),
    ][int(rng.integers(4))]


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl", ".ply", ".off", ".3mf", "ascii"])
def test_cuts_and_damage_end_in_meshes_or_in_one_clear_line(tmp_path, two_objects, suffix, capfd):
    source = two_objects if suffix in (".glb", ".obj", ".3mf") else two_objects.to_mesh()
    content = export(source, "_stl_ascii" if suffix == "ascii" else suffix)
    path = write(tmp_path / f"m{'.stl' if suffix == 'ascii' else suffix}", content)
    whole = sum(len(mesh.faces) for mesh in load_meshes(path))
    size = len(content)
    rng = np.random.default_rng(7)
    cuts = {*np.linspace(0, size - 1, 25).astype(int).tolist(), *range(size - 8, size)}
    cut = [content[:at] for at in cuts]
    refused = []
    for broken in [*cut, *(damaged(content, rng) for _ in range(40))]:
        try:
            meshes = load_meshes(write(path, broken))
        except LidarError as error:
            refused.append(broken)
            assert str(error).startswith(str(path))
            assert str(error).isprintable() and len(str(error)) < 400 + len(str(path))
        else:
            assert all(np.isfinite(mesh.vertices).all() for mesh in meshes)
            # Lines of .obj announce nothing, so that some cuts cannot be seen.
            if broken in cut and suffix != ".obj":
                assert sum(len(mesh.faces) for mesh in meshes) == whole, len(broken)
    assert len(refused) > 20
    assert capfd.readouterr() == ("", "")


@pytest.mark.extended(every=4)
@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("m.obj", "", r"is empty \(0 bytes\)"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "line 4 is 'f 1 2 9', .*missing"),
        ("m.obj", "o a\nv 0 0 \\\n0\nv 1 0 x\n", "line 4 is 'v 1 0 x', but three numbers"),
        ("m.obj", "v 0 0 0\nf 1 1 1\nf -1 1 -1\nv 1 0 x\n", "line 4 is 'v 1 0 x', but three"),
        ("m.obj", "v 0 0 0\nf 1 1 1\nf 0 1 1\nv 1 0 0\n", "line 3 is 'f 0 1 1', .*missing"),
        ("m.obj", "v 0 0 0\nf 1 1 -2\nv 1 0 0\n", "line 2 is 'f 1 1 -2', .*missing"),
        ("m.obj", "v 0 0 0\nf 1 1 a/1\n", "line 2 is 'f 1 1 a/1', but vertex numbers"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "1 of the 3 vertices .* NaN"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\nv 5 5 5\n", "f -1 -2 -4.*missing"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "only triangles without an area"),
        ("m.obj", "v 1 2\nf 1 1 1\n", "line 1 is 'v 1 2', but three numbers"),
        ("m.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "line 6 is '3 0 1 7', .*0 to 2"),
        ("m.off", "OFF # a b\n\n3 1 0\n0 0 0\n1 0 z\n0 1 0\n3 0 1 2\n", "line 5 is '1 0 z', "),
        ("m.off", "# mine\n\nOFF\n3 1 0\n0 0 0\n1 0 z\n0 1 0\n3 0 1 2\n", "line 6 is '1 0 z', "),
        ("m.off", "OFF\n3 one 0\n", "line 2 is '3 one 0', but the numbers of vertices and faces"),
        ("m.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "truncated: .*2 faces are"),
        ("m.off", "OFF\n3 1 0\n0 0 0 1 0 0\n0 1 0\n3 0 1 2\n", "each in a separate line"),
        ("m.off", "OFF\n3 99999999999 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "faces are declared"),
        ("m.off", "OFF BINARY\n3 1 0\n", "binary OFF"),
        ("m.stl", "solid a\nfacet\n", "is truncated: .*does not end"),
        ("m.stl", TEXT_STL.replace("vertex 1 0 0", "vertex 1 0"), "line 4 is 'vertex 1 0', but"),
        ("m.stl", TEXT_STL.replace("vertex 1 0 0", "vertex 1 a 0"), "line 4 is 'vertex 1 a 0', "),
        ("m.stl", TEXT_STL.replace("vertex 1 0 0\n", ""), "ends in line 7 has 2 vertices"),
        ("m.ply", PLY.replace("element face 2", "element face 0"), "point cloud"),
        ("m.ply", PLY + "3 0 2 3\n", "more than declared"),
        ("m.ply", PLY.replace("double x", "double u"), "have no x"),
        ("m.ply", PLY.replace("3 0 2 3", "3 0 2 2.5"), "must be integers"),
        ("m.ply", PLY.replace("double z", "half z"), "line .* is 'property half z', but format, "),
        ("m.ply", PLY.replace("3 0 2 3", "3 0 b 3"), "line 15 has 'b', but a number"),
        ("m.ply", PLY.replace("3 0 2 3", "-3 0 2 3"), "a list in face has the length -3"),
        ("m.ply", PLY.replace("3 0 2 3", ""), "is truncated: 2 rows of face are declared"),
        ("m.ply", "plain text\n", "first line is not 'ply'"),
        ("m.ply", PLY.replace("3 0 2 3", "3 0 2 9"), "0 to 9"),
        ("m.ply", PLY.replace("element face", "element tristrips"), "triangle strips"),
        ("m.ply", PLY.partition("end_header")[0], "is truncated: .*no end_header line"),
        ("m.part", "LASF", "has the extension .part"),
        ("m.gltf", "[" * 100_000, "not contain valid JSON"),
        *[
            (
                f"m{suffix}",
                content,
                "cannot be read|truncated|no triangles|is not glTF|valid JSON|"
                "pip install|"
                "is not an AMAPVox",
            )
            for suffix in endings()
            for content in (np.random.default_rng(5).bytes(3000), b"no mesh\n" * 20, bytes(2000))
        ],
    ],
)
def test_bad_files(tmp_path, name, content, message):
    path = write(tmp_path / name, content)
    with pytest.raises(LidarError, match=message) as caught:
        load_meshes(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(path)) and str(caught.value).isprintable()


def test_missing_and_folders(tmp_path):
    (tmp_path / "d.glb").mkdir()
    with pytest.raises(LidarError, match="does not exist"):
        load_meshes(tmp_path / "no.glb")
    with pytest.raises(LidarError, match="cannot be read: Is a directory"):
        load_meshes(tmp_path / "d.glb")


def test_without_the_library_of_openusd_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(usd, "find_spec", lambda name: None)
    with pytest.raises(LidarError, match=r'pip install -e "\.\[usd\]" in a checkout of lidarpool'):
        load_meshes(write(tmp_path / "m.usda", "#usda 1.0\n"))


def test_readers_are_imported_with_the_first_file_of_their_format(tmp_path):
    path = tmp_path / "m.obj"
    write(path, OBJ.format(x=0, x1=1))
    code = (
        "import sys, lidarsim.scene.scene as scene\n"
        "known = ('gltf', 'polygon_files', 'dae', 'usd', 'rasters', 'cityjson', 'more_formats')\n"
        "ours = lambda: {m.rpartition('.')[2] for m in sys.modules if m.startswith('lidar')}\n"
        "imported = lambda: [name for name in known if name in ours()]\n"
        "print(*imported())\n"
        f"scene.Scene.load({str(path)!r})\n"
        "print(*imported())"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines() == ["", "polygon_files"]


def test_each_format_that_is_read_has_a_reader():
    rows = [row for row in known_formats() if not row.advice]
    assert all(callable(row.reader) for row in rows)
    named = [ending for row in known_formats() for ending in row.endings]
    assert len(named) == len({*named})
    assert {*endings(lambda row: row.own_options is rasters.RasterOptions)} == {*rasters.DRIVERS}


def test_formats_of_a_package_that_is_not_installed_name_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, more_formats.__name__, None)
    package = more_formats.__name__.partition(".")[0]
    with pytest.raises(
        LidarError, match=f"formats of {package}, run pip install -e ./kernels .* in a checkout"
    ):
        load_meshes(write(tmp_path / "m.usd", "#usda 1.0"))
    assert len(load_meshes(write(tmp_path / "m.obj", OBJ.format(x=0, x1=1)))) == 2


def test_a_package_that_lacks_another_one_is_not_taken_as_missing(tmp_path, monkeypatch):
    broken = types.ModuleType("broken")
    broken.__getattr__ = lambda name: importlib.import_module("no_such_library")
    monkeypatch.setitem(sys.modules, more_formats.__name__, broken)
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        load_meshes(write(tmp_path / "m.usd", "#usda 1.0"))
