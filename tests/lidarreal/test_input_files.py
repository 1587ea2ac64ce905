"""Input files: devices, pipes, sockets, pointers and false counts are rejected at once."""

import json
import os
import socket
import struct
import tracemalloc
from contextlib import closing

import numpy as np
import pytest
import trimesh

from lidarfiles import read_cloud
from lidarfiles.clouds.format_table import point_suffixes
from lidarreal import compare
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.points.point_scene import scene_from_points, surfel_mesh
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes import load_robot
from lidarscenes.helios import import_survey
from lidarsim import LidarError, load_sensor, load_trajectory
from lidarsim.io.input_files import open_input, read_input, read_input_text
from lidarsim.io.storage import Storage
from lidarsim.io.yamlfile import read_yaml
from lidarsim.scene.files.cloud_formats import SCAN_READERS
from lidarsim.scene.files.mesh_formats import endings
from lidarsim.scene.files.meshfile import load_meshes

RECORDINGS = (".ply", ".las", ".laz", ".mcap", ".pcap", ".osf", *SCAN_READERS)
TABLES = (".csv", ".tum", ".txt")
pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")


def traffic(path):
    """Build a scenario whose traffic is a file."""
    vehicles = {"types": "*", "box": [4, 2, 1.5]}
    trimesh.creation.box().export(path.with_name("place.stl"))
    section = {"file": path.name, "vehicles": [vehicles]}
    data = {"scene": {"files": "place.stl"}, "traffic": section}
    return prepare(Scenario.from_data(data, folder=path.parent))


def copies(path):
    """Build a scenario whose copies are those of a table."""
    entry = {"name": "Tree", "file": "tree.stl", "table": path.name}
    trimesh.creation.box().export(path.with_name("tree.stl"))
    data = {"scene": {"files": "tree.stl", "copies": [entry]}}
    return prepare(Scenario.from_data(data, folder=path.parent))


READERS = {
    **{f"mesh{suffix}": load_meshes for suffix in endings()},
    **{f"points{suffix}": scene_from_points for suffix in point_suffixes()},
    **{f"recording{suffix}": lambda path: compare(path, path) for suffix in RECORDINGS},
    **{f"trajectory{suffix}": load_trajectory for suffix in TABLES},
    "times.txt": lambda path: load_trajectory(kitti_beside(path), times=path),
    "robot.urdf": load_robot,
    "sensor.yaml": load_sensor,
    "calibration.yaml": lambda path: load_sensor("velodyne/vlp16", calibration=path),
    "calibration.json": lambda path: load_sensor("velodyne/vlp16", calibration=path),
    "calibration.csv": lambda path: load_sensor("velodyne/vlp16", calibration=path),
    "scenario.yaml": Scenario.load,
    "campaign.yaml": CampaignSpec.load,
    "cluster.yaml": read_yaml,
    "cloud.ply": read_cloud,
    "traffic.xml": traffic,
    "traffic.xml.gz": traffic,
    "copies.csv": copies,
    "survey.xml": lambda path: import_survey(
        path, path.with_name("out"), check=Scenario.load, surfels=surfel_mesh
    ),
}


def kitti_beside(path):
    poses = path.with_name("poses.txt")
    np.savetxt(poses, np.tile(np.eye(3, 4).reshape(1, 12), (3, 1)))
    return poses


def refused(read, path):
    """Return the message with which reading ends."""
    with pytest.raises(LidarError) as caught:
        read(path)
    message = str(caught.value)
    assert message.count("\n") <= 1 and len(message) < 500 + 2 * len(str(path)), message
    return message


@pytest.mark.extended(every=7)
@pytest.mark.parametrize("name", READERS)
def test_devices_pipes_and_sockets_are_refused_at_once(tmp_path, monkeypatch, name):
    path = tmp_path / name
    path.symlink_to("/dev/zero")
    assert "it is a device" in refused(READERS[name], path)
    path.unlink()
    os.mkfifo(path)
    assert "it is a pipe" in refused(READERS[name], path)
    link = tmp_path / "link"
    path.rename(link)
    path.symlink_to(link)
    assert "it is a pipe" in refused(READERS[name], path)
    path.unlink()
    with closing(socket.socket(socket.AF_UNIX)) as server:
        monkeypatch.chdir(tmp_path)  # addresses have at most 108 bytes
        server.bind(name)
        assert "it is a socket" in refused(READERS[name], path)


@pytest.mark.extended
@pytest.mark.parametrize("name", READERS)
def test_pointers_of_git_lfs_are_no_content(tmp_path, name):
    path = tmp_path / name
    path.write_text(
        f"version https://git-lfs.github.com/spec/v1\noid sha256:{64 * '0'}\nsize 123456\n"
    )
    assert "git lfs pull" in refused(READERS[name], path)


def test_a_note_names_materials_that_are_a_pointer_of_git_lfs(tmp_path):
    (tmp_path / "a.mtl").write_text(
        f"version https://git-lfs.github.com/spec/v1\noid sha256:{64 * '0'}\nsize 123456\n"
    )
    path = tmp_path / "a.obj"
    path.write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl Glass\nf 1 2 3\n")
    notes = []
    load_meshes(path, report=notes.append)
    assert any("a.mtl (it is a Git LFS pointer. Download the file" in note for note in notes)


@pytest.mark.extended
@pytest.mark.parametrize(
    "name", [name for name in READERS if not name.startswith(("recording", "trajectory"))]
)  # those may be folders
def test_folders_are_no_files(tmp_path, name):
    path = tmp_path / name
    path.mkdir()
    assert "Is a directory" in refused(READERS[name], path)


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("suffix", endings(lambda row: row.advice))
def test_formats_that_are_not_read_say_what_to_do(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text("anything")
    assert f"a{suffix} cannot be read. " in refused(load_meshes, path)
    if suffix not in point_suffixes():
        assert f"a{suffix} cannot be read. " in refused(scene_from_points, path)


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("a.bag", "rosbags-convert"),
        ("a.glb", "Run a survey of it first"),
    ],
)
def test_recordings_that_are_not_read_say_what_to_do(tmp_path, name, advice):
    path = tmp_path / name
    path.write_text("anything")
    assert advice in refused(lambda path: compare(path, path), path)


def test_a_file_of_a_result_is_a_plain_file(tmp_path):
    os.mkfifo(tmp_path / "report.json")
    for read in (Storage.read, Storage.checksum):
        with pytest.raises(OSError, match="it is a pipe"):
            read(Storage.at(tmp_path), "report.json")


def test_text_loses_its_mark_and_the_ends_of_lines_of_other_systems(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert read_input_text(path) == "a\nb\nc\n"
    assert read_input(path, 4) == b"\xef\xbb\xbfa"
    with open_input(path) as file:
        assert file.read() == path.read_bytes()


# -- counts of headers ---------------------------------------------------------------------------


def pcd(count="1 1 1", points=10, data="ascii", body=b"1 2 3\n" * 10):
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
        f"COUNT {count}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\n"
        f"DATA {data}\n"
    )
    return head.encode() + body


def glb(count):
    header = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", 36, 0x004E4942) + bytes(36)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


MANY = 2_000_000_000
PLY = "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
FALSE_COUNTS = {
    "many.pcd": pcd("30000000 1 1"),
    "count.pcd": pcd("1 1 1000"),
    "points.pcd": pcd(points=MANY),
    "binary.pcd": pcd(points=MANY, data="binary", body=bytes(120)),
    "compressed.pcd": pcd(
        points=MANY // 12,
        data="binary_compressed",
        body=struct.pack("<II", 100, MANY // 12 * 12) + bytes(100),
    ),
    "text.ply": (PLY.format("ascii 1.0", MANY) + "end_header\n1 2 3\n").encode(),
    "binary.ply": (PLY.format("binary_little_endian 1.0", MANY) + "end_header\n").encode()
    + bytes(24),
    "faces.ply": (
        PLY.format("binary_little_endian 1.0", 3)
        + f"element face {MANY}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    + bytes(36)
    + struct.pack("<B3i", 3, 0, 1, 2),
    "a.stl": bytes(80) + struct.pack("<I", MANY) + bytes(50),
    "a.off": f"OFF\n{MANY} {MANY} 0\n0 0 0\n".encode(),
    "a.glb": glb(MANY),
    "a.vox": b"VOXEL SPACE\n#min_corner: 0 0 0\n#max_corner: 9 9 9\n#split: 99999 99999 99999\n"
    b"i j k PadBVTotal\n0 0 0 1\n",
}
RECORDED = [name for name in FALSE_COUNTS if name.endswith((".pcd", ".ply"))]
MESHED = [name for name in FALSE_COUNTS if not name.endswith(".pcd")]


def check_counts(read, path):
    tracemalloc.start()
    try:
        message = refused(read, path)
        assert tracemalloc.get_traced_memory()[1] < 50e6, message
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", MESHED)
def test_counts_of_meshes_are_compared_with_the_file(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(FALSE_COUNTS[name])
    check_counts(load_meshes, path)


@pytest.mark.parametrize("name", RECORDED)
@pytest.mark.parametrize("read", [scene_from_points, lambda path: compare(path, path)])
def test_counts_of_clouds_are_compared_with_the_file(tmp_path, name, read):
    path = tmp_path / name
    path.write_bytes(FALSE_COUNTS[name])
    check_counts(read, path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("read", [scene_from_points, lambda path: compare(path, path)])
def test_counts_of_las_are_compared_with_the_file(tmp_path, suffix, read):
    laspy = pytest.importorskip("laspy", reason="laspy is an extra")
    path = tmp_path / f"a{suffix}"
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.x, las.y, las.z = np.random.default_rng(0).random((3, 100))
    las.write(str(path))
    data = bytearray(path.read_bytes())
    data[247:255] = struct.pack("<Q", MANY)  # number of point records, LAS 1.4
    path.write_bytes(data)
    check_counts(read, path)
