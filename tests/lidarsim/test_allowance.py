"""Files that unpack to far more than they are: refused in one line, before memory is taken."""

import base64
import itertools
import json
import subprocess
import sys
import zipfile

import pytest
import trimesh
from tests.meshes import NESTED

from lidarsim import LidarError
from lidarsim.io import allowance, input_files
from lidarsim.scene.files.meshfile import load_meshes

VERTEX = b'<vertex x="0" y="0" z="0"/>'
MODEL = (
    b"<model><resources><object id='1'><mesh><vertices>%s</vertices><triangles>"
    b"<triangle v1='0' v2='1' v3='2'/></triangles></mesh></object>%s</resources>"
    b"<build><item objectid='1'/></build></model>"
)
PLY = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty uchar x\n"
    "property uchar y\nproperty uchar z\nelement {} {}\nproperty list {} vertex_indices\n"
    "end_header\n"
)
CORNERS = b"\0\0\0\1\0\0\0\1\0"


def model(more=b"", thousands=0, method=zipfile.ZIP_DEFLATED):
    """Write a .3mf with so many vertices."""

    def write(path):
        before, after = (MODEL % (b"|", more)).split(b"|")
        with (
            zipfile.ZipFile(path, "w", method) as archive,
            archive.open("3D/3dmodel.model", "w") as file,
        ):
            file.write(before)
            for _ in range(thousands):
                file.write(VERTEX * 1000)
            file.write(after)

    return write


ONE_NODE = ({"mesh": 0},)


def gltf(accessor, primitives=1, nodes=ONE_NODE, roots=(0,)):
    """All vertices of the accessor are the twelve bytes of its buffer."""
    uri = "data:;base64," + base64.b64encode(bytes(12)).decode()
    header = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": list(roots)}],
        "nodes": list(nodes),
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * primitives}],
        "buffers": [{"byteLength": 12, "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": 12, "byteStride": 0}],
        "accessors": [{"componentType": 5126, "type": "VEC3"} | accessor],
    }
    return json.dumps(header).encode()


def draco():
    """Two thousand million triangles, by the header of packed data."""
    data = b"DRACO\2\2\1\0\0\0" + b"\x80\x94\xeb\xdc\7" + b"\3" + bytes(100)
    header = json.loads(gltf({"count": 3}))
    header["buffers"] = [
        {"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}
    ]
    header["bufferViews"] = [{"buffer": 0, "byteLength": len(data)}]
    packed = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    header["meshes"][0]["primitives"][0]["extensions"] = packed
    return json.dumps(header).encode()


def entities(inside):
    return f'<!DOCTYPE a [<!ENTITY a "<n/>">{NESTED}]><{inside}>&g;</{inside}>'.encode()


LAUGHS = b"a: &a [1,1,1,1,1,1,1,1,1,1]\n" + b"".join(
    f"{name}: &{name} [{','.join([f'*{of}'] * 10)}]\n".encode()
    for of, name in itertools.pairwise("abcdefg")
)
# {name of the file: (its content or what writes it, what is said of it)}
BOMBS = {
    "vertices.3mf": (model(thousands=12_000), "would unpack to at least 308.99 MiB"),
    "objects.3mf": (model(b"<object id='2'/>" * 300_000), "would unpack to at least 256"),
    "lzma.3mf": (model(b" " * 10_000_000, method=zipfile.ZIP_LZMA), "a method other than Deflate"),
    "colors.3mf": (model(b"<base/>" * 3_000_000), "would unpack to at least 256"),
    "attribute.3mf": (model(b"<a b='%s'/>" % (b"1" * 20_000_000)), "a tag or comment longer"),
    "entities.3mf": (None, "declares the XML entity"),
    "count.gltf": (
        gltf({"bufferView": 0, "count": 60_000_000}),
        "would unpack to at least 457.76 MiB",
    ),
    "sparse.gltf": (
        gltf({"count": 2_000_000_000, "sparse": {"count": 0}}),
        "would unpack to at least 22.35 GiB",
    ),
    "parts.gltf": (gltf({"bufferView": 0, "count": 30_000}, 3000), "would unpack to at least 256"),
    "placed.gltf": (
        gltf(
            {"bufferView": 0, "count": 1_500_000},
            nodes=[{"mesh": 0}, *({"children": [i] * 11} for i in range(4))],
            roots=[4],
        ),
        "places 14,641 objects with a total of 7,320,500,000 triangles",
    ),
    "draco.gltf": (draco(), "would unpack to at least 46.35 GiB"),
    "entities.dae": (entities("COLLADA"), "declares the XML entity"),
    "long.ply": (PLY.format(10**9, "face", 1, "uchar int").encode() + bytes(10**6), "fewer"),
    "rows.ply": (
        PLY.format(3, "face", 10**5, "uchar uchar").encode()
        + CORNERS
        + b"\3\0\1\2"
        + bytes(10**5)
        + b"\1",
        "more than declared",
    ),
    "laughs.yaml": (LAUGHS, "would unpack to at least "),
    "merged.yaml": (LAUGHS.replace(b"[1,1,1,1,1,1,1,1,1,1]", b"{x: 1}").replace(b"[*", b"{<<: [*")
                    .replace(b"]\n", b"]}\n"), "would unpack to at least "),
    "sensor.yaml": (
        b"name: x\nfiring_us: 1\nbeams: {elevation_deg: {first: 0, last: 1, count: 300000000}}\n",
        "count must be at most 1,000,000",
    ),
    "lasers.yaml": (
        b"num_lasers: 300000000\nlasers: [{laser_id: 0, vert_correction: 0, rot_correction: 0}]\n",
        "it must list each of the lasers 0 to 299999999",
    ),
}  # fmt: skip
READ = """
import re, sys
from pathlib import Path
import distributed, DracoPy
from lidarpool import LidarError, Scene, load_sensor
from lidarscenario.scenario import Scenario

READERS = {
    "sensor.yaml": load_sensor,
    "lasers.yaml": lambda path: load_sensor(calibration=path),
    ".yaml": Scenario.load,
}
def peak():  # ru_maxrss would be at least that of the process that started this one
    return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])

first = peak()
for name in sys.argv[1:]:
    path = Path(name)
    try:
        READERS.get(path.name, READERS.get(path.suffix, Scene.load))(path)
        print("read")
    except LidarError as error:
        print(str(error).replace(chr(10), chr(9)))
print((peak() - first) * 1024)
"""
MOST = 400 * 2**20  # bytes; before there was a limit, any of these took more, or minutes


@pytest.fixture
def bombs(tmp_path):
    """Write the files."""
    for name, (content, _) in BOMBS.items():
        path = tmp_path / name
        if callable(content):
            content(path)
        elif content is not None:
            path.write_bytes(content)
    with zipfile.ZipFile(tmp_path / "entities.3mf", "w") as archive:
        archive.writestr("3D/3dmodel.model", entities("model"))
    return [tmp_path / name for name in BOMBS]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_bombs_take_little_memory_and_say_what_they_are(bombs):
    pytest.importorskip("DracoPy", reason="the decoder of packed glTF is an extra")
    run = subprocess.run(
        [sys.executable, "-c", READ, *bombs], capture_output=True, text=True, check=True
    )
    *told, grown = run.stdout.splitlines()
    assert run.stderr == ""
    assert all(path.stat().st_size < 2.2e6 for path in bombs)
    for path, line, (_, message) in zip(bombs, told, BOMBS.values(), strict=True):
        assert line.startswith(str(path)) and message in line, line
        assert len(line) < 500 + len(str(path)) and "\t" not in line
    assert int(grown) < MOST, grown


@pytest.mark.parametrize("suffix", [".glb", ".3mf"])
def test_honest_files_are_far_below_the_limit(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 0)
    monkeypatch.setattr(allowance, "UNPACKED_TIMES", 50)
    path = tmp_path / f"ball{suffix}"
    trimesh.creation.icosphere(5).export(path)
    assert len(load_meshes(path)[0].faces) == 20480


def test_a_large_mesh_is_read_though_memory_is_short(tmp_path, monkeypatch):
    ball = trimesh.creation.icosphere(6)
    path = tmp_path / "ball.ply"
    ball.export(path)
    monkeypatch.setattr(allowance, "memory", lambda: 1 + path.stat().st_size)
    assert len(load_meshes(path)[0].faces) == 81920
    monkeypatch.setattr(input_files, "memory", lambda: path.stat().st_size - 1)
    with pytest.raises(LidarError, match=r"ball\.ply: it has .* exceeds the memory"):
        load_meshes(path)


def test_memory_is_at_most_what_a_control_group_allows(monkeypatch, tmp_path):
    limit = 3 * 2**30
    (tmp_path / "memory.max").write_text(f"{limit}\n")
    (tmp_path / "memory").mkdir()
    (tmp_path / "memory/memory.limit_in_bytes").write_text(f"{limit}\n")
    monkeypatch.setattr(allowance, "CONTROL_GROUPS", tmp_path)
    assert allowance.memory.__wrapped__() == limit
    for name in ("memory.max", "memory/memory.limit_in_bytes"):
        (tmp_path / name).write_text("max\n")
    assert allowance.memory.__wrapped__() > limit


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (900, "900 B"), (1234, "1.21 kiB"), (12_345_678, "11.77 MiB")],
)
def test_bytes_as_text(count, text):
    assert allowance.bytes_of(count) == text
