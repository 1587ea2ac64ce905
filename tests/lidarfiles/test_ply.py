"""Clouds come back bit by bit, or the file that was there before is untouched."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from tests.drives import the_scene, the_sweeps

from lidarfiles import read_cloud, save_cloud
from lidarfiles.clouds import ply
from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarsim import Cloud, Column, LidarError
from lidarsim.sweeps.sweeps import Sweeps


def sample(count, *, offset=0.0, seed=1):
    rng = np.random.default_rng(seed)
    columns = {
        "scan": np.sort(rng.integers(0, 108, count)).astype(np.int32),
        "channel": rng.integers(0, 65_536, count).astype(np.uint16),
        "object": rng.integers(-1, 2**31, count).astype(np.int32),
    }
    return Cloud(rng.uniform(-25, 25, (count, 3)).round(2) + offset, columns)


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_round_trip(tmp_path, count):
    given = sample(count)
    save_cloud(given, tmp_path / "c.ply")
    cloud = read_cloud(tmp_path / "c.ply")
    assert len(cloud) == count
    assert cloud.positions.dtype == np.float32
    np.testing.assert_array_equal(cloud.positions, given.positions.astype(np.float32))
    for name, values in given.columns.items():
        np.testing.assert_array_equal(cloud[name], values)
        assert cloud[name].dtype == values.dtype
    assert [p.name for p in tmp_path.iterdir()] == ["c.ply"]


@settings(max_examples=25)
@given(
    npst.arrays(
        np.float64,
        st.tuples(st.integers(1, 20), st.just(3)),
        elements=st.floats(-1e7, 1e7, allow_nan=False),
    ),
    st.sampled_from([1e-6, 1e-3, 0.01, 1.0]),
)
def test_positions_err_by_less_than_a_twentieth_of_the_precision(tmp_path_factory, points, step):
    path = tmp_path_factory.mktemp("h") / "c.ply"
    save_cloud(Cloud(points, {}), path, precision_m=step)
    back = read_cloud(path).positions
    assert np.abs(back - points).max() <= step / 20
    if back.dtype == np.float64:
        np.testing.assert_array_equal(back, points)


def test_georeferenced_points_are_kept_in_double_precision(tmp_path):
    given = sample(50, offset=[512_345.0, 5_403_210.0, 400.0])
    save_cloud(given, tmp_path / "c.ply")
    np.testing.assert_array_equal(read_cloud(tmp_path / "c.ply").positions, given.positions)


@pytest.mark.parametrize(
    ("farthest_m", "precision_m", "position_type"),
    [
        # Below 16,384 m, single precision is off by up to 2^-11 m, the twentieth of 9.766 mm.
        (16_383.9, 0.00977, "f4"),
        (16_383.9, 0.00976, "f8"),
        (16_384.0, 0.00977, "f8"),
        (16_384.0, 0.01954, "f4"),
        (0.0, 1e-12, "f4"),
    ],
)
@pytest.mark.parametrize("side", [-1, 1])
def test_positions_are_double_where_single_precision_errs_by_a_twentieth(
    tmp_path, farthest_m, precision_m, position_type, side
):
    points = np.array([[0, 0, 0], [0, side * farthest_m, -1], [0.5, 0, 0]])
    save_cloud(Cloud(points * (farthest_m > 0), {}), tmp_path / "c.ply", precision_m=precision_m)
    head = (tmp_path / "c.ply").read_bytes().partition(b"end_header")[0]
    kind = {"f4": b"float", "f8": b"double"}[position_type]
    assert [line.split()[1] for line in head.splitlines() if line.startswith(b"property")] == (
        3 * [kind]
    )


@pytest.mark.parametrize(
    ("coordinates", "columns", "comments"),
    [
        (
            "world",
            ["scan"],
            ["crs: EPSG:25832", "class 3 road", "class 12 Stra\\xdfe"],
        ),
        (
            "sensor",
            ["scan", "material"],
            [
                "points in the sensor frame at the time of firing (motion is not compensated)",
                "class 3 road",
                "class 12 Stra\\xdfe",
                "material 0 brick",
                "material 1 Gl\\xe4s",
            ],
        ),
    ],
)
def test_comments_state_frame_system_and_names(tmp_path, coordinates, columns, comments):
    sweeps = replace(
        the_sweeps(the_scene()),
        coordinates=coordinates,
        epsg=25832,
        classes={3: "road", 12: "Stra\\xdfe"},
        materials=("brick", "Gläs"),
    )
    cloud = Cloud(np.eye(3), {name: np.zeros(3, np.int32) for name in columns})
    save_cloud(replace(cloud, sweeps=lambda: sweeps), tmp_path / "c.ply")
    lines = (tmp_path / "c.ply").read_bytes().partition(b"end_header")[0].decode().splitlines()
    found = [line.removeprefix("comment ") for line in lines if line.startswith("comment")]
    assert found == ["Created by Open3D", *comments]
    cloud = read_cloud(tmp_path / "c.ply")
    assert {*cloud.columns} == {*columns} and len(cloud) == 3


@pytest.mark.parametrize("block_bytes", [7, 100, 1 << 23])
@pytest.mark.parametrize("expected", [3, 20, 5_000])
def test_rows_move_if_the_header_gets_another_length(tmp_path, monkeypatch, expected, block_bytes):
    """In blocks, whichever way they go."""
    monkeypatch.setattr(ply, "FIRST_POINTS", 5)
    monkeypatch.setattr(ply, "_BLOCK_BYTES", block_bytes)
    cloud = sample(40)
    columns = {**dict(zip("xyz", cloud.positions.T, strict=True)), **cloud.columns}
    kind = np.dtype(np.float32)
    with ply.PlyAppender(
        tmp_path / "grown.ply", cloud.table, kind, Sweeps.unknown(), expected
    ) as file:
        for rows in (slice(0, 5), slice(5, 5), slice(5, 23), slice(23, 40)):
            count = rows.stop - rows.start
            file.append(count, [(name, values[rows]) for name, values in columns.items()])
        assert file.count == 40 and file.size == (tmp_path / "grown.ply").stat().st_size
        file.finish()
    save_cloud(cloud, tmp_path / "whole.ply")
    assert (tmp_path / "grown.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_open3d_reads_it_and_an_empty_one_has_the_same_properties(tmp_path):
    open3d = load_open3d()
    given = sample(7)
    save_cloud(given, tmp_path / "c.ply")
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "c.ply"))
    assert set(cloud.point) == {"positions", "scan", "ring", "object"}
    np.testing.assert_array_equal(cloud.point["ring"].numpy()[:, 0], given.channel)
    save_cloud(sample(0), tmp_path / "e.ply")
    head = (tmp_path / "c.ply").read_bytes().partition(b"end_header")[0]
    empty = (tmp_path / "e.ply").read_bytes().partition(b"end_header")[0]
    assert empty == head.replace(b"vertex 7", b"vertex 0")


def test_columns_of_every_type_come_back(tmp_path):
    """Types that Open3D does not write as they are are held in wider ones."""
    types = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"]
    own = tuple(Column(f"of_{name}", name, "", "") for name in types)
    columns = {c.name: np.array([0, 1, 100], c.dtype) for c in own}
    columns["of_i8"] = np.array([-(2**53), 0, 2**53])
    table = {"time": np.array([0, 1, 2**53]), "class": np.array([0, 1, 255])}
    save_cloud(Cloud(np.eye(3), columns | table, own), tmp_path / "c.ply")
    back = read_cloud(tmp_path / "c.ply")
    for name, values in (columns | table).items():
        np.testing.assert_array_equal(back[name], values, err_msg=name)
    assert back["time"].dtype == np.int64 and back["class"].dtype == np.uint16


def test_a_number_that_a_file_cannot_hold_is_refused(tmp_path):
    cloud = Cloud(np.zeros((1, 3)), {"time": np.array([2**53 + 1])})
    with pytest.raises(LidarError, match="'time' contains 9007199254740993, but PLY files store"):
        save_cloud(cloud, tmp_path / "c.ply")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fault", ["cut", "fewer", "interrupted", "no space"])
def test_a_faulty_write_leaves_the_earlier_result(tmp_path, monkeypatch, fault):
    path = tmp_path / "c.ply"
    save_cloud(sample(3), path)
    before = path.read_bytes()
    write = ply.write_with_open3d

    def faulty(target, cloud, real):
        write(target, cloud[1:] if fault == "fewer" else cloud, real)
        data = target.read_bytes()
        if fault == "cut":
            target.write_bytes(data[:-500])
        if fault == "interrupted":
            raise KeyboardInterrupt
        if fault == "no space":
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(ply, "write_with_open3d", faulty)
    expected = {
        "cut": (LidarError, "cannot be written"),
        "fewer": (LidarError, "999 of 1,000 points"),
        "interrupted": (KeyboardInterrupt, None),
        "no space": (LidarError, "No space left"),
    }
    kind, message = expected[fault]
    with pytest.raises(kind, match=message):
        save_cloud(sample(1000), path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("count", [0, 70, 1000])
def test_a_disk_without_room_is_told_the_size_of_the_file(tmp_path, monkeypatch, count):
    """Written in pieces of 300 points, the file needs room for itself and one of them."""
    monkeypatch.setattr(ply, "FIRST_POINTS", 300)
    path = tmp_path / "c.ply"
    free = 0
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free))
    with pytest.raises(LidarError, match="cannot be written: it requires") as caught:
        save_cloud(sample(count), path)
    numbers = re.search(
        r"requires ([\d,]+) bytes and temporarily another ([\d,]+) bytes", str(caught.value)
    )
    size, piece = (int(number.replace(",", "")) for number in numbers.groups())
    assert piece == min(count, 300) * (3 * 4 + 4 + 2 + 4)
    free = size + piece - 1
    with pytest.raises(LidarError, match=f"only {free:,} bytes are free on the disk"):
        save_cloud(sample(count), path)
    assert not any(tmp_path.iterdir())
    free += 1
    save_cloud(sample(count), path)
    assert path.stat().st_size == size


def test_permissions_follow_the_umask(tmp_path):
    path = tmp_path / "c.ply"
    before = os.umask(0o027)
    try:
        save_cloud(sample(3), path)
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o640


def test_reading_what_is_not_a_cloud(tmp_path):
    good = tmp_path / "good.ply"
    save_cloud(sample(20), good)
    data = good.read_bytes()
    cases = {
        "cut": (data[:-1], "but there are"),
        "empty": (b"", "no binary"),
        "ascii": (data.replace(b"binary_little_endian", b"ascii"), "no binary"),
        "no z": (data.replace(b"float z", b"float w"), "lacks z"),
        "mesh": (
            data.replace(b"end_header", b"element face 0\nend_header"),
            "elements other than points",
        ),
        "5000 digits": (data.replace(b"vertex 20", b"vertex " + b"9" * 5000), "bytes|Exceeds"),
        "below 0": (data.replace(b"vertex 20", b"vertex -1"), "no points"),
        "list": (data.replace(b"uint16 ring", b"list uchar int ring"), "list properties"),
    }
    for name, (content, message) in cases.items():
        path = tmp_path / f"{name}.ply"
        path.write_bytes(content)
        with pytest.raises(LidarError, match=message):
            read_cloud(path)
    with pytest.raises(LidarError, match="No such file"):
        read_cloud(tmp_path / "missing.ply")
    with pytest.raises(LidarError, match="cannot be read"):
        read_cloud(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_refused_instead_of_waited_for(tmp_path):
    os.mkfifo(tmp_path / "cloud.ply")
    with pytest.raises(LidarError, match="it is a pipe"):
        read_cloud(tmp_path / "cloud.ply")


@pytest.mark.extended
def test_it_comes_without_its_viewers_and_whole_to_whoever_imports_it():
    """Dash and Plotly take longer to import than all that writing needs.

    In a process of its own: pytest rewrites Dash, whose plugin it knows, and the many files of
    that can fail in Python 3.11 ("AST constructor recursion depth mismatch").
    """
    code = (
        f"import sys; sys.path[:] = {sys.path}; "
        "from lidarfiles.open3d_access.open3d_module import load_open3d; o3d = load_open3d(); "
        "assert not {'open3d', 'dash', 'plotly'} & set(sys.modules); "
        "import open3d; assert open3d.t.geometry is o3d.t.geometry is load_open3d().t.geometry"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["open3d", "open3d.pybind"])
def test_what_it_lacks(monkeypatch, name):
    for module in ("open3d", "open3d.pybind"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(LidarError, match=r"cannot be loaded.*pip install open3d-cpu"):
        load_open3d()
