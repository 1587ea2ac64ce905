"""Recordings of Rerun, read by Rerun's own reader of chunks."""

from __future__ import annotations

import signal
import subprocess
import sys
import urllib.request
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rerun", reason="needs rerun-sdk, 500 MB")

from rerun.chunk import RrdReader
from tests.lidarpool.test_viewers import ROOM
from tests.lidarpool.test_viewers import SCENARIO as VIEWED

from lidarfiles import save_cloud
from lidarfiles.clouds.boxes import Boxes
from lidarfiles.clouds.writing import ExportSpec
from lidarlive.playback.sources import open_source
from lidarsim import Cloud, LidarError
from lidarsim.motion.rotations import matrices
from lidarsim.sweeps.sweeps import SweepPoses

SCENARIO = VIEWED.replace("cloud: {", "cloud: {start: 2026-05-04T10:20:30.5Z, ")
UTM = np.array([431_000.0, 5_812_000.0, 40.0])


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """Return the sweeps, the points of each, and the content of pictures."""
    folder = tmp_path_factory.mktemp("scenario")
    (folder / "room.obj").write_text(ROOM)
    (folder / "s.yaml").write_text(SCENARIO)
    with open_source(folder / "s.yaml") as source:
        points = dict(source)
        return source.sweeps, [points[sweep] for sweep in sorted(points)], source.content()


def read(path):
    """Return {(entity, component): [(time in nanoseconds or None, values)]} of a recording."""
    rows = defaultdict(list)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        times = [None] * chunk.num_rows
        if "survey" in batch.schema.names:
            times = batch["survey"].cast("int64").to_pylist()
        for name in batch.schema.names:
            for time_ns, values in zip(times, batch[name].to_pylist(), strict=True):
                rows[chunk.entity_path, name].append((time_ns, values))
    return {key: sorted(entries, key=lambda entry: entry[0] or 0) for key, entries in rows.items()}


def pose(rows, entity, time_ns):
    """Return position and rotation of an entity in its parent at a time."""
    values = [
        next(value[0] for when, value in rows[entity, f"Transform3D:{part}"] if when == time_ns)
        for part in ("translation", "quaternion")
    ]
    return np.array(values[0]), matrices(np.array([values[1]]))[0]


def check(rows, sweeps, points_of_sweeps, origin):
    for sweep, points in enumerate(points_of_sweeps):
        sensor = sweeps.sensors[sweeps.sensor[sweep]]
        time_ns = round(sweeps.begins_ns[sweep])
        entity = f"/map/base_link/{sensor}/points"
        in_sensor = next(v for when, v in rows[entity, "Points3D:positions"] if when == time_ns)
        mount, mount_rotation = pose(rows, f"/map/base_link/{sensor}", time_ns)
        carrier, rotation = pose(rows, "/map/base_link", time_ns)
        on_carrier = np.array(in_sensor) @ mount_rotation.T + mount
        in_world = on_carrier @ rotation.T + carrier + origin
        assert np.abs(in_world - points.positions).max() < 1e-3  # Rerun has float32
        for name, expected in points.columns.items():
            values = next(v for when, v in rows[entity, name] if when == time_ns)
            assert np.array_equal(np.array(values, expected.dtype), expected), name
        boxes = Boxes.from_points(sweeps, sweep, points)
        for part, expected in (
            ("centers", boxes.centers - origin),
            ("half_sizes", boxes.sizes / 2),
            ("quaternions", boxes.quaternions),
        ):
            entries = rows["/map/actors", f"Boxes3D:{part}"]
            candidates = [values for when, values in entries if when == time_ns]
            assert any(np.allclose(values, expected, atol=1e-3) for values in candidates), part
    assert rows["/map/actors", "Boxes3D:labels"][0][1] == ["Car 1"]


def test_clouds_poses_boxes_and_scene_are_read_back(scanned, tmp_path):
    sweeps, points, content = scanned
    path = tmp_path / "cloud.rrd"
    ExportSpec("rrd").write(path, Cloud.concatenate(points), sweeps, content=lambda: content)
    rows = read(path)
    check(rows, sweeps, points, np.zeros(3))
    ((_, vertices),) = rows["/map/scene", "Mesh3D:vertex_positions"]
    bounds = [np.min(vertices, axis=0), np.max(vertices, axis=0)]
    assert np.allclose(bounds, content.scene.bounds)
    assert len(vertices) == 3 * len(content.scene.faces)
    ((_, normals),) = rows["/map/scene", "Mesh3D:vertex_normals"]
    assert np.allclose(np.abs(normals[0]), (0, 0, 1))  # of the floor
    ((_, strips),) = rows["/map/trajectories/roof", "LineStrips3D:strips"]
    assert np.allclose(strips[0], sweeps.pose.positions[sweeps.sensor == 0], atol=1e-5)
    stamps = [when for when, _ in rows["/map/base_link", "Transform3D:translation"]]
    assert stamps == sorted(np.rint(sweeps.begins_ns).astype(int).tolist())
    utc = [value for _, value in rows["/map/base_link", "utc"]]
    assert f"{utc[0]:%Y-%m-%dT%H:%M:%S.%f}" == "2026-05-04T10:20:30.500000"


def test_coordinates_of_maps_keep_their_precision(scanned, tmp_path):
    sweeps, points, _ = scanned

    def moved(poses):
        return SweepPoses(poses.positions + UTM, poses.quaternions)

    on_map = replace(sweeps, pose=moved(sweeps.pose), actor_poses=moved(sweeps.actor_poses))
    clouds = [replace(cloud, positions=cloud.positions + UTM) for cloud in points]
    cloud = replace(Cloud.concatenate(clouds), sweeps=lambda: on_map)
    assert save_cloud(cloud, tmp_path / "map.rrd") == []
    rows = read(tmp_path / "map.rrd")
    origin = [rows["/__properties/origin", axis][0][1][0] for axis in "xyz"]
    assert origin == [430_000, 5_810_000, 0]
    check(rows, on_map, clouds, np.array(origin))


@pytest.mark.skipif(sys.platform == "win32", reason="has no limits of files")
def test_a_full_disk_is_one_line_and_leaves_nothing(scanned, tmp_path):
    import resource

    sweeps, points, _ = scanned
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        with pytest.raises(LidarError, match="cannot be written"):
            ExportSpec("rrd").write(tmp_path / "cloud.rrd", Cloud.concatenate(points), sweeps)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [*tmp_path.iterdir()] == []


def test_a_server_on_loopback_ends_with_ctrl_c(tmp_path):
    (tmp_path / "room.obj").write_text(ROOM)
    (tmp_path / "s.yaml").write_text(SCENARIO)
    process = subprocess.Popen(
        [sys.executable, "-m", "lidarpool", "play", "s.yaml", "--as", "rerun", "--loop"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    ready = process.stdout.readline()
    page = ready.split("open ")[1].split("?")[0]
    assert page.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(page) as answer:
        assert b"rerun" in answer.read().lower()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in said
    with pytest.raises(OSError):
        urllib.request.urlopen(page, timeout=5)
