"""Mesh files made to do harm: they are refused with a reason, and reach nothing but themselves.

Each is read in a process of its own with little memory and little time, which notes every file
and every address that it opens.
"""

from __future__ import annotations

import base64
import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lidarpool.base.errors import LidarpoolError
from lidarpool.scene.meshfile import load_meshes

READER = """
import json, os, resource, signal, sys
from pathlib import Path
from lidarpool.base.errors import LidarpoolError
from lidarpool.scene.meshfile import load_meshes

import lidarpool.scene.dae  # whatever is imported late is imported now
load_meshes(sys.argv[1])
touched = []

def note(event, arguments):
    if event == "open" and isinstance(arguments[0], int):
        return  # what is open already
    if event in ("open", "socket.connect", "socket.getaddrinfo", "subprocess.Popen", "os.system"):
        touched.append([event, str(arguments[0 if event == "open" else 1])])

sys.addaudithook(note)
for path in sys.argv[2:]:
    if os.fork():
        if os.wait()[1]:
            print(json.dumps([path, "DIED", []]), flush=True)
        continue
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**30, used + 2**30))
    # Of its own time: on a busy machine a second of work may take longer than that.
    resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
    signal.alarm(240)  # where it waits
    touched.clear()
    try:
        said = f"{len(load_meshes(path))} meshes"
    except LidarpoolError as error:
        said = str(error)
    except BaseException as error:
        said = f"{type(error).__name__}: {error}"
    # The module path is that of an error's class, which may be looked up late.
    files = [thing for thing in touched if not thing[1].endswith((".py", ".pyc", ".so"))]
    print(json.dumps([path, said, files]), flush=True)
    os._exit(0)
"""

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
FACE = np.array([0, 1, 2], "<u4").tobytes()


# -- glTF ---------------------------------------------------------------------------------------


def embedded(data: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(data).decode()


def gltf(uri: str | None = None, accessors=(), counts=(3, 3), **more) -> str:
    """One triangle, with more accessors, other counts or other parts."""
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "N"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"uri": uri or embedded(VERTICES + FACE), "byteLength": 48}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": counts[0], "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": counts[1], "type": "SCALAR"},
            *accessors,
        ],
    }
    return json.dumps(header | more)


def absent(count: int) -> dict:
    """An accessor of numbers that are nowhere."""
    return {"componentType": 5126, "count": count, "type": "MAT4"}


PICTURE = {
    "images": [{"uri": "../outside.bin"}],
    "textures": [{"source": 0}],
    "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
}
ELSEWHERE = "only files in its own folder are read"
GROWS = "out of all proportion"
GLTF = {
    "up.gltf": (gltf("../outside.bin"), ELSEWHERE),
    "absolute.gltf": (gltf("/etc/passwd"), ELSEWHERE),
    "file scheme.gltf": (gltf("file:///etc/passwd"), ELSEWHERE),
    "http.gltf": (gltf("http://127.0.0.1:9/x.bin"), ELSEWHERE),
    "link.gltf": (gltf("link.bin"), ELSEWHERE),
    "escaped.gltf": (gltf("%2e%2e/outside.bin"), ELSEWHERE),
    "directory.gltf": (gltf("."), "is not a file"),
    "nul.gltf": (gltf("a\0b"), "broken"),
    "pipe.gltf": (gltf("pipe"), "is not a file"),
    "picture.gltf": (gltf(**PICTURE), "1 meshes"),
    "absent.gltf": (gltf(accessors=[absent(10**12)]), GROWS),
    "absent, many.gltf": (gltf(accessors=[absent(10**5)] * 1000), GROWS),
    "count.gltf": (gltf(counts=(10**30, 3)), GROWS),
    "negative.gltf": (gltf(counts=(-1, 3)), "a count of -1"),
    "fraction.gltf": (gltf(counts=(3, 2.5)), "a count of 2.5"),
    "cycle.gltf": (gltf(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]), "1 meshes"),
    "no list.gltf": (gltf(meshes=5), "broken"),
}

# -- COLLADA ------------------------------------------------------------------------------------

DAE = """<?xml version="1.0"?>{doctype}
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
 <asset><up_axis>Z_UP</up_axis></asset>{images}
 <library_geometries><geometry id="g" name="shape"><mesh>
  <source id="p"><float_array id="a" count="9">{numbers}</float_array>
   <technique_common><accessor source="#a" count="3" stride="3">
    <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
   </accessor></technique_common></source>
  <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
  <triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
 </mesh></geometry></library_geometries>
 <library_nodes>{nodes}</library_nodes>
 <library_visual_scenes><visual_scene id="s">
  <node id="n" name="N">{here}</node>
 </visual_scene></library_visual_scenes>
 <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""
HERE = '<instance_geometry url="{}"/>'
NODE = '<instance_node url="#k{}"/>'


def dae(**parts: str) -> str:
    usual = {"doctype": "", "images": "", "numbers": "0 0 0 1 0 0 0 1 0", "nodes": ""}
    return DAE.format(**(usual | {"here": HERE.format("#g")} | parts))


def laughs(root: str) -> str:
    """Document type with an entity that stands for 10^9 others."""
    levels = "".join(
        f'<!ENTITY {name} "{f"&{of};" * 10}">'
        for of, name in zip("abcdefghi", "bcdefghij", strict=True)
    )
    return f'<!DOCTYPE {root} [<!ENTITY a "0 0 0 0 0 0 0 0 0 0">{levels}]>'


def doubled(levels: int) -> str:
    """Nodes that each contain the one before twice."""
    first = f'<node id="k0">{HERE.format("#g")}</node>'
    return first + "".join(
        f'<node id="k{i}">{NODE.format(i - 1) * 2}</node>' for i in range(1, levels + 1)
    )


DOCTYPE = "has a document type"
READ_FILE = '<!DOCTYPE C [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
IMAGE = (
    '<library_images><image id="i"><init_from>../outside.bin</init_from></image></library_images>'
)
DAES = {
    "laughs.dae": (dae(doctype=laughs("COLLADA"), numbers="&j;"), DOCTYPE),
    "laughs, utf-16.dae": (
        dae(doctype=laughs("COLLADA"), numbers="&j;").encode("utf-16"),
        DOCTYPE,
    ),
    "entity.dae": (dae(doctype=READ_FILE, numbers="&x;"), DOCTYPE),
    "dtd.dae": (dae(doctype='<!DOCTYPE C SYSTEM "http://127.0.0.1:9/x.dtd">'), DOCTYPE),
    "other file.dae": (dae(here=HERE.format("../other.dae#g")), "Invalid url"),
    "http.dae": (dae(here=HERE.format("http://127.0.0.1:9/x.dae#g")), "Invalid url"),
    "picture.dae": (dae(images=IMAGE), "1 meshes"),
    "doubled.dae": (dae(nodes=doubled(40), here=NODE.format(40)), "contain each other more than"),
    "cycle.dae": (dae(nodes=f'<node id="k0">{NODE.format(0)}</node>', here=NODE.format(0)), "bro"),
    "deep.dae": (dae(here="<node>" * 5000 + "</node>" * 5000), "broken"),
    "huge offset.dae": (dae().replace('offset="0"', 'offset="1000000000"'), "broken"),
}

# -- 3MF ----------------------------------------------------------------------------------------

MODEL = (
    '<?xml version="1.0"?>{doctype}'
    '<model unit="meter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
    '<resources><object id="1" name="m" type="model"><mesh><vertices>'
    '<vertex x="{x}" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/>'
    '</vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object>'
    "{objects}</resources><build>{items}</build></model>"
)
AT = "1 0 0 0 1 0 0 0 1 {} 0 0"


def packed(**files: str | bytes) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return memory.getvalue()


def model(doctype="", x="0", objects="", items='<item objectid="1"/>') -> str:
    return MODEL.format(doctype=doctype, x=x, objects=objects, items=items)


def threemf(**parts: str) -> bytes:
    return packed(**{"3D/3dmodel.model": model(**parts)})


def assembly(number: int, of: int, count: int, more: str = "") -> str:
    """An object of several copies of another, side by side."""
    copies = "".join(
        f'<component objectid="{of}" transform="{AT.format(i)}"{more}/>' for i in range(count)
    )
    return f'<object id="{number}" name="a{number}"><components>{copies}</components></object>'


LOST = "of the .* objects that it places can be read"
THREEMF = {
    "laughs.3mf": (threemf(doctype=laughs("model"), x="&j;"), DOCTYPE),
    "entity.3mf": (threemf(doctype=READ_FILE, objects="&x;"), DOCTYPE),
    "padded.3mf": (lambda: packed(**{"3D/3dmodel.model": model(), "pad": bytes(3 * 10**8)}), GROWS),
    "blanks.3mf": (lambda: threemf(objects=" " * 3 * 10**8), GROWS),
    "elsewhere.3mf": (
        threemf(
            objects=assembly(2, 1, 1, ' path="/../../etc/passwd"'), items='<item objectid="2"/>'
        ),
        "1 meshes",
    ),
    "cycle.3mf": (
        threemf(objects=assembly(2, 3, 1) + assembly(3, 2, 1), items='<item objectid="2"/>'),
        "recursion",
    ),
    "doubled.3mf": (
        threemf(
            objects="".join(assembly(i, i - 1, 2) for i in range(2, 30)),
            items='<item objectid="29"/>',
        ),
        "of the 268,435,456 objects that it places can be read",
    ),
}

# -- counts -------------------------------------------------------------------------------------

PLY = (
    "ply\nformat binary_little_endian 1.0\n{comment}"
    "element vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {faces}\nproperty list {kind} int vertex_indices\nend_header\n"
)


def ply(vertices="3", faces="1", kind="uchar", length=b"\3", comment="") -> bytes:
    header = PLY.format(vertices=vertices, faces=faces, kind=kind, comment=comment)
    return header.encode() + VERTICES + length + FACE


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
COUNTS = {
    "vertices.ply": (ply(vertices=str(10**12)), "broken"),
    "no faces.ply": (ply(faces="-3"), "-3 rows of face announced"),
    "list.ply": (ply(kind="uint", length=b"\xff\xff\xff\xff"), "broken"),
    "picture.ply": (ply(comment="comment TextureFile ../outside.bin\n"), "1 meshes"),
    "count.stl": (b"x" * 80 + b"\xff\xff\xff\xff" + bytes(16), "and has 0"),
    "count.off": ("OFF\n1000000000000 1000000000000 0\n0 0 0\n", "cut short"),
    "face.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n-1 0 1 2\n", "broken"),
    "strip.ply": (ply().replace(b"face 1", b"tristrips 1"), "1 meshes"),
    "wordless.ply": (b"ply\nformat ascii 1.0\nelement face 9\nend_header\n", "broken"),
    "index.obj": (TRIANGLE + "f 1 2 " + "9" * 30 + "\n", "broken"),
    "material.obj": ("mtllib ../outside.bin /etc/passwd\n" + TRIANGLE + "f 1 2 3\n", "1 meshes"),
}
CASES = GLTF | DAES | THREEMF | COUNTS | {
    "packed.dae": (packed(**{"x.dae": dae() + " " * 10**7}), "is a ZIP archive"),
}  # fmt: skip


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory) -> dict[str, tuple[str, list[list[str]]]]:
    """What was said of each file, and what its reader opened; {name: (words, [event, what])}."""
    if not Path("/proc/self/statm").exists():
        pytest.skip("limits the memory of a process by what it has, from /proc")
    folder = tmp_path_factory.mktemp("outer") / "inner"
    folder.mkdir()
    (folder.parent / "outside.bin").write_bytes(VERTICES + FACE)
    (folder / "link.bin").symlink_to(folder.parent / "outside.bin")
    os.mkfifo(folder / "pipe")
    for name, (content, _) in (CASES | {"good.gltf": (gltf(), "")}).items():
        write(folder / name, content() if callable(content) else content)
    done = subprocess.run(
        [sys.executable, "-c", READER, folder / "good.gltf", *(folder / name for name in CASES)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = {}
    for line in done.stdout.splitlines():
        path, said, touched = json.loads(line)
        # What it opens besides the file itself.
        found[Path(path).name] = said, [thing for thing in touched if thing[1] != path]
    return found


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file(name, outcomes):
    said, touched = outcomes[name]
    assert CASES[name][1] in said
    assert said.count("\n") <= 1
    assert len(said) < 600
    assert touched == []


def test_the_look_at_opened_files_sees_them(tmp_path):
    (tmp_path / "beside.bin").write_bytes(VERTICES + FACE)
    path = tmp_path / "m.gltf"
    path.write_text(gltf("beside.bin"))
    done = subprocess.run(
        [sys.executable, "-c", READER, path, path],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    _, said, touched = json.loads(done.stdout)
    assert said == "1 meshes"
    assert ["open", str(tmp_path / "beside.bin")] in touched


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_nested_components_are_all_there_or_refused(tmp_path):
    nested = assembly(2, 1, 3) + assembly(3, 2, 3)
    path = write(tmp_path / "9.3mf", threemf(objects=nested, items='<item objectid="3"/>'))
    assert len(load_meshes(path)) == 9
    # Of these trimesh finds 75.
    nested = assembly(2, 1, 10) + assembly(3, 2, 10)
    write(path, threemf(objects=nested, items='<item objectid="3"/>'))
    with pytest.raises(LidarpoolError, match="of the 100 objects that it places can be read"):
        load_meshes(path)


def test_copies_with_one_part_number_are_all_there_or_refused(tmp_path):
    items = '<item objectid="1" partnumber="{}"/><item objectid="1" partnumber="{}"/>'
    path = write(tmp_path / "p.3mf", threemf(items=items.format("A", "B")))
    assert len(load_meshes(path)) == 2
    write(path, threemf(items=items.format("A", "A")))
    with pytest.raises(LidarpoolError, match="1 of the 2 objects"):
        load_meshes(path)


@pytest.mark.parametrize(
    ("placed", "readable"),
    [
        ([("a", 7)], 1),
        ([("a", 7), ("b", 8)], 2),
        ([("a", 7), ("b", 7)], 0),  # the numbers of a file are its own
        ([("a", 1)], 0),  # that of an object of the model
        ([("a", 7), ("a", 7)], 0),  # two copies
        ([("two", 7), ("two", 8)], 0),  # an object of two parts, as slicers write it
    ],
)
def test_parts_in_other_files_of_a_3mf_are_told_apart_or_refused(tmp_path, placed, readable):
    components = "".join(
        f'<component path="/3D/Objects/{file}.model" objectid="{number}"/>'
        for file, number in placed
    )
    assembled = f'<object id="2"><components>{components}</components></object>'
    second = model().partition("<resources>")[2].partition("</resources>")[0]
    files = {
        "3D/3dmodel.model": model(objects=assembled, items='<item objectid="2"/>'),
        "3D/Objects/a.model": model(),
        "3D/Objects/b.model": model(),
        "3D/Objects/two.model": model(objects=second.replace('id="1"', 'id="2"')),
    }
    path = write(tmp_path / "s.3mf", packed(**files))
    if readable:
        assert [len(mesh.faces) for mesh in load_meshes(path)] == [1] * readable
    else:
        with pytest.raises(LidarpoolError, match="cannot be told apart"):
            load_meshes(path)


def test_nodes_of_a_dae_library_stand_where_they_are_named(tmp_path):
    path = write(tmp_path / "m.dae", dae(nodes=doubled(3), here=NODE.format(3)))
    assert len(load_meshes(path)) == 8
