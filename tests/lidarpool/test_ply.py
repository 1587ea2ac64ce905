"""Clouds come back bit by bit, or the file that was there before is untouched."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from lidarpool import ply
from lidarpool.cloud import Cloud
from lidarpool.errors import LidarpoolError
from lidarpool.ply import read_cloud, write_cloud


def sample(count, *, offset=0.0, seed=1):
    rng = np.random.default_rng(seed)
    return {
        "positions": rng.uniform(-25, 25, (count, 3)).round(2) + offset,
        "scan": np.sort(rng.integers(0, 108, count)).astype(np.int32),
        "ring": rng.integers(0, 65_536, count).astype(np.uint16),
        "object_id": rng.integers(-1, 2**31, count).astype(np.int32),
    }


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_round_trip(tmp_path, count):
    given = sample(count)
    size = write_cloud(tmp_path / "c.ply", **given)
    cloud = read_cloud(tmp_path / "c.ply")
    assert size == (tmp_path / "c.ply").stat().st_size
    assert len(cloud) == count
    assert cloud.positions.dtype == np.float32
    np.testing.assert_array_equal(cloud.positions, given["positions"].astype(np.float32))
    np.testing.assert_array_equal(cloud.scan, given["scan"])
    np.testing.assert_array_equal(cloud.ring, given["ring"])
    np.testing.assert_array_equal(cloud.object, given["object_id"])
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
    count = len(points)
    zeros = np.zeros(count, np.int32)
    write_cloud(path, points, zeros, zeros.astype(np.uint16), zeros, precision_m=step)
    back = read_cloud(path).positions
    assert np.abs(back - points).max() <= step / 20
    if back.dtype == np.float64:
        np.testing.assert_array_equal(back, points)


def test_georeferenced_points_are_kept_in_double_precision(tmp_path):
    given = sample(50, offset=[512_345.0, 5_403_210.0, 400.0])
    write_cloud(tmp_path / "c.ply", **given)
    np.testing.assert_array_equal(read_cloud(tmp_path / "c.ply").positions, given["positions"])


def test_open3d_reads_it_and_an_empty_one_has_the_same_properties(tmp_path):
    open3d = pytest.importorskip("open3d")
    given = sample(7)
    write_cloud(tmp_path / "c.ply", **given)
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "c.ply"))
    assert set(cloud.point) == {"positions", "scan", "ring", "object"}
    np.testing.assert_array_equal(cloud.point["ring"].numpy()[:, 0], given["ring"])
    write_cloud(tmp_path / "e.ply", **sample(0))
    head = (tmp_path / "c.ply").read_bytes().partition(b"end_header")[0]
    empty = (tmp_path / "e.ply").read_bytes().partition(b"end_header")[0]
    assert empty == head.replace(b"vertex 7", b"vertex 0")


def test_three_processes_write_the_same_bytes(tmp_path):
    code = (
        "import sys, numpy as np; from lidarpool.ply import write_cloud;"
        "n = 5000; r = np.random.default_rng(3);"
        "write_cloud(sys.argv[1], r.normal(size=(n, 3)), np.arange(n), np.arange(n), np.arange(n))"
    )
    digests = set()
    for seed in ("0", "1", "2"):
        path = tmp_path / f"{seed}.ply"
        environment = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(sys.path)}
        subprocess.run([sys.executable, "-c", code, str(path)], check=True, env=environment)
        digests.add(hashlib.sha256(path.read_bytes()).hexdigest())
    assert len(digests) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ring": np.full(5, 65_536)}, "ring holds 65536 to 65536"),
        ({"scan": np.full(5, 2**31)}, "scan holds"),
        ({"scan": np.full(5, 0.5)}, "scan holds"),
        ({"scan": np.zeros(4, np.int32)}, "given: "),
        ({"positions": np.zeros((5, 2))}, "given: "),
        ({"positions": np.full((5, 3), np.nan)}, "NaN"),
        ({"positions": np.full((5, 3), np.inf, np.float32)}, "NaN or infinite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, change, message):
    with pytest.raises(LidarpoolError, match=message):
        write_cloud(tmp_path / "c.ply", **(sample(5) | change))
    assert list(tmp_path.iterdir()) == []


def test_bad_targets(tmp_path):
    (tmp_path / "d.ply").mkdir()
    (tmp_path / "file").write_text("x")
    for path, message in [
        (tmp_path / "no" / "c.ply", "does not exist"),
        (tmp_path / "file" / "c.ply", "does not exist"),
        (tmp_path / "d.ply", "is a folder"),
        (tmp_path / "c.las", "must end in .ply"),
        (tmp_path / ("x" * 300 + ".ply"), "cannot be written: File name too long"),
    ]:
        with pytest.raises(LidarpoolError, match=message):
            write_cloud(path, **sample(5))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d.ply", "file"]


def existing(tmp_path):
    """A folder with an earlier result in it, and a check that nothing happened to it."""
    path = tmp_path / "c.ply"
    write_cloud(path, **sample(3))
    before = path.read_bytes()

    def untouched():
        return path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["c.ply"]

    return path, untouched


def test_a_disk_too_small_is_noticed_before_writing(tmp_path, monkeypatch):
    path, untouched = existing(tmp_path)
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(ply.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(LidarpoolError, match=r"needs 44,\d{3} bytes and its disk has 1,000 free"):
        write_cloud(path, **sample(1000))
    assert untouched()


@pytest.mark.parametrize("fault", ["cut", "changed", "fewer", "interrupted", "no space"])
def test_a_faulty_write_leaves_the_earlier_result(tmp_path, monkeypatch, fault):
    path, untouched = existing(tmp_path)
    write = ply._write_open3d

    def faulty(target, cloud):
        if fault == "fewer":
            cloud = Cloud(cloud.positions[1:], cloud.scan[1:], cloud.ring[1:], cloud.object[1:])
        write(target, cloud)
        data = bytearray(target.read_bytes())
        if fault == "cut":
            target.write_bytes(data[:-500])
        if fault == "changed":
            data[-1] ^= 1
            target.write_bytes(data)
        if fault == "interrupted":
            raise KeyboardInterrupt
        if fault == "no space":
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(ply, "_write_open3d", faulty)
    expected = {
        "cut": (LidarpoolError, "could not be written whole"),
        "changed": (LidarpoolError, "another object"),
        "fewer": (LidarpoolError, "999 of 1,000 points"),
        "interrupted": (KeyboardInterrupt, None),
        "no space": (LidarpoolError, "No space left"),
    }
    kind, message = expected[fault]
    with pytest.raises(kind, match=message):
        write_cloud(path, **sample(1000))
    assert untouched()


@pytest.fixture
def mounted(tmp_path):
    """Mount a tmpfs of 256 KiB, and unmount it afterwards."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    folder = tmp_path / "small"
    folder.mkdir()

    def mount(*options):
        command = ["mount", "-t", "tmpfs", "-o", ",".join(["size=256k", *options]), "none", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"cannot mount a tmpfs here: {done.stderr.strip()}")
        return folder

    yield mount
    subprocess.run(["umount", folder], capture_output=True, check=False)


def test_a_full_disk(mounted, monkeypatch):
    folder = mounted()
    path, untouched = existing(folder)
    with pytest.raises(LidarpoolError, match="make room"):
        write_cloud(path, **sample(50_000))
    assert untouched()
    # Another process took the room after we had asked for it: Open3D says True here.
    usage = type("Usage", (), {"free": 10**9})
    monkeypatch.setattr(ply.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(LidarpoolError, match="could not be written whole"):
        write_cloud(path, **sample(50_000))
    assert untouched()
    monkeypatch.undo()
    write_cloud(path, **sample(2000))
    assert len(read_cloud(path)) == 2000


def test_a_read_only_folder(mounted):
    folder = mounted()
    path, untouched = existing(folder)
    remounted = subprocess.run(["mount", "-o", "remount,ro", folder], check=False)
    assert remounted.returncode == 0
    with pytest.raises(LidarpoolError, match="Read-only file system"):
        write_cloud(path, **sample(10))
    assert untouched()


def test_permissions_follow_the_umask(tmp_path):
    path = tmp_path / "c.ply"
    before = os.umask(0o027)
    try:
        write_cloud(path, **sample(3))
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o640


def test_reading_what_is_not_a_cloud(tmp_path):
    good = tmp_path / "good.ply"
    write_cloud(good, **sample(20))
    data = good.read_bytes()
    cases = {
        "cut": (data[:-1], "bytes there"),
        "longer": (data + b"\0", "bytes there"),
        "empty": (b"", "no header"),
        "ascii": (data.replace(b"binary_little_endian", b"ascii"), "no header"),
        "no ring": (data.replace(b"uint16 ring", b"uint16 rang"), "lacks ring"),
        "mesh": (data.replace(b"end_header", b"element face 0\nend_header"), "more than points"),
        "list": (data.replace(b"uint16 ring", b"list uchar int ring"), "list properties"),
    }
    for name, (content, message) in cases.items():
        path = tmp_path / f"{name}.ply"
        path.write_bytes(content)
        with pytest.raises(LidarpoolError, match=message):
            read_cloud(path)
    with pytest.raises(LidarpoolError, match="No such file"):
        read_cloud(tmp_path / "missing.ply")
    with pytest.raises(LidarpoolError, match="cannot be read"):
        read_cloud(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_refused_instead_of_waited_for(tmp_path):
    os.mkfifo(tmp_path / "cloud.ply")
    with pytest.raises(LidarpoolError, match="it is a pipe"):
        read_cloud(tmp_path / "cloud.ply")
